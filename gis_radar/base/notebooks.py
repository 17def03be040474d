"""Show results: cards of figures in notebooks, axes of plots, pictures in files.

Plain HTML in one piece: text is escaped, the picture is inside, nothing is loaded from elsewhere.

Matplotlib is imported where it is used, so that other work does not wait for it.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

from gis_radar.base.files import atomic_write
from gis_radar.base.words import tr

MOST_ROWS = 24  # of a table: about a screen
_CELL = "text-align:left;padding:1px 10px 1px 0"
_NAME_CELL = f"{_CELL};opacity:0.65;font-weight:normal"


def card(title: str, figures: Mapping[str, Any], *, picture: bytes = b"") -> str:
    """Return a result as HTML: its figures as rows of a table.

    Parameters
    ----------
    title : str
        Title of the result.
    figures : mapping
        Values by name; underscores in names become spaces.
    picture : bytes
        A PNG, shown beside the figures.
    """
    names = (str(name).replace("_", " ") for name in figures)
    rows = zip(names, map(_text, figures.values()), strict=True)
    return _card_html(title, _table(rows), picture)


def table_card(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a result as HTML: a table with a head, cut where it is long.

    Parameters
    ----------
    title : str
        Title of the result.
    columns : sequence of str
        The head.
    rows : sequence of sequences
        A value a column.
    """
    cells = [[_text(value) for value in row] for row in rows[:MOST_ROWS]]
    if len(rows) > MOST_ROWS:
        cells.append([f"... {len(rows) - MOST_ROWS} more"])
    return _card_html(title, _table(cells, head=columns), b"")


def _text(value: Any) -> str:
    """Return a value as a cell shows it: numbers with six digits, lists with commas."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e5 else f"{value:.2f}"
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_text(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value)) or "none"
    return "" if value is None else str(value)


def _table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return rows of texts as an HTML table, with a head, or with the first column as names."""
    lines = []
    if head:
        cells = "".join(f'<th style="{_NAME_CELL}">{escape(name)}</th>' for name in head)
        lines.append(f"<tr>{cells}</tr>")
    for first, *rest in rows:
        style = _CELL if head else _NAME_CELL
        cells = "".join(f'<td style="{_CELL}">{escape(text)}</td>' for text in rest)
        lines.append(f'<tr><th style="{style}">{escape(first)}</th>{cells}</tr>')
    return f"<table>{''.join(lines)}</table>"


def _card_html(title: str, table: str, picture: bytes) -> str:
    """Return a title, a table and a picture beside it as one element of HTML."""
    image = ""
    if picture:
        data = b64encode(picture).decode("ascii")
        image = f'<img alt="{escape(title)}" src="data:image/png;base64,{data}">'
    return (
        f"<div><strong>{escape(title)}</strong>"
        f'<div style="display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start">'
        f"<div>{table}</div>{image}</div></div>"
    )


_SMALL_IN, _SMALL_DPI = (4.6, 3.6), 80  # beside a card of figures
_MOST_TICKS = 5
_EDGE_IN = 0.1  # inches of margin around a picture
_LABELS_IN = 0.42  # inches that ticks and label of an axis take
FONTS: dict[Any, Any] = {"font.family": ["DejaVu Sans"], "text.usetex": False, "font.size": 8}


def axes_or_new(ax: Any, size_in: tuple[float, float] = (7.0, 6.0)) -> Any:
    """Return the axes, or those of a new figure of pyplot where `ax` is None."""
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt  # noqa: PLC0415 - chooses a window system

    return plt.figure(figsize=size_in, layout="constrained").add_subplot()


def label_map(ax: Any) -> None:
    """Give axes in metres of the map their labels and equal scales."""
    ax.set_aspect("equal")
    ax.set(xlabel=tr("easting, m"), ylabel=tr("northing, m"))
    ax.xaxis.set_major_locator(_locator(0.6))
    ax.yaxis.set_major_locator(_locator(1.0))
    ax.ticklabel_format(useOffset=False, style="plain")


def _locator(share: float) -> Any:
    """Return a locator of as many ticks as fit, at most `_MOST_TICKS`.

    `share` scales matplotlib's own count, which is for labels of four digits.
    """
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    class FewTicks(MaxNLocator):
        def __call__(self) -> Any:
            room = int(self.axis.get_tick_space() * share) if self.axis is not None else 1
            self.set_params(nbins=min(max(room, 1), _MOST_TICKS), min_n_ticks=1)
            return super().__call__()

    return FewTicks()


def legend_below(ax: Any, handles: Sequence[Any] | None = None) -> Any:
    """Write a legend below the axes of a map and their labels, at any height of the axes."""
    from matplotlib.transforms import ScaledTranslation  # noqa: PLC0415

    down = ScaledTranslation(0.0, -_LABELS_IN, ax.figure.dpi_scale_trans)
    return ax.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0.0),
        bbox_transform=ax.transAxes + down, ncols=2, frameon=False,
    )  # fmt: skip


def label_times(ax: Any) -> None:
    """Write UTC times along x, no longer than needed."""
    from matplotlib import dates  # noqa: PLC0415

    locator: Any = dates.AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator, tz=UTC))  # type: ignore[no-untyped-call]
    ax.set_xlabel("time, UTC")


@contextmanager
def picture_file(
    path: str | Path,
    size_in: tuple[float, float],
    dpi: int,
    *,
    tight: bool = False,
    font_pt: float = 8.0,
) -> Iterator[Any]:
    """Yield a new figure in the package's font and write it as PNG, without pyplot.

    Parameters
    ----------
    path : str or Path
        The picture; appears whole or not at all.
    size_in : (float, float)
        Width and height, inches.
    dpi : int
        Pixels an inch.
    tight : bool
        Fit the picture to what is drawn: axes of equal scales may outgrow a constrained layout.
    font_pt : float
        Size of its font, points.
    """
    import matplotlib as mpl  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    fonts = {"font.size": font_pt, "axes.titlesize": "medium"}
    with mpl.rc_context(FONTS | fonts):
        figure = Figure(figsize=size_in, dpi=dpi, layout="constrained")
        yield figure
        box = "tight" if tight else None
        with atomic_write(Path(path)) as part:
            figure.savefig(part, format="png", bbox_inches=box, pad_inches=_EDGE_IN)


def small_picture(draw: Callable[[Any], Any]) -> bytes:
    """Return what a function draws on axes as a small PNG, without pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=_SMALL_IN, dpi=_SMALL_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure.add_subplot())
    picture = BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()

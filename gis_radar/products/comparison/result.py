"""A comparison, and its files: a page to read, a table, a layer for QGIS, a map as a picture."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    NO_FIGURE,
    QUIET,
    THIN_SPACE,
    LayerNotes,
    Reporter,
    Text,
    add_layer,
    card,
    current_language,
    figure_text,
    iso_from_time,
    long_span,
    percent,
    picture_file,
    style_layers,
    tr,
    write_csv,
)
from gis_radar.measures import INTERVALS, PRESUMED
from gis_radar.products.comparison.rows import COMPARED, LESS, MORE, NOT_TOLD
from gis_radar.products.heatmap.style import text_template
from gis_radar.products.results_folder import write_results
from gis_radar.products.traffic_style import LineClass, class_style

Period = tuple[Any, Any]
_LAYER = "comparison"
# Classes of the difference in percent: colours without red and green, grey where none is reported.
_MOST = 999.0  # largest percentage shown, also for what was 0 before
_BREAKS = (-1000.0, -25.0, -10.0, -1e-9, 1e-9, 10.0, 25.0, 1000.0)
_COLOURS = ("#7f3b08", "#d08020", "#f0c080", "#9a9a9a", "#b2abd2", "#8073ac", "#2d004b")
_NOT_COMPARED: dict[str, Any] = {"color": "#dddddd", "linewidth": 1.2}
_SECTIONS = {
    1: Text("Better"), -1: Text("Worse"), 0: Text("Volumes and speeds"),
    None: Text("Cannot be told"),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Comparison of the traffic of two periods by lane.

    Parameters
    ----------
    table : GeoDataFrame
        A row for each lane and measure: `lane` (null for all stop lines together), `name`,
        `measure`, `before`, `after`, `difference`, `percent`, `se`, `low` and `high` (95 % interval
        of the difference), `p`, `p_corrected` (for the number of rows), `verdict` (`more`, `less`
        or `not told`), `units` (the compared units: days, times of day or intervals) and `count`
        (their number), `watchers` (the sensors), `stop_line` (`drawn` in the map, `presumed`, or
        null); the lane's line.
    left_out : DataFrame
        Lanes that cannot be compared: `lane`, `name`, `seen` (sensors before / after; where they
        are the same, the number of tiles in their sight).
    used : tuple of float
        Share of the rows of each period that were compared.
    before, after : tuple
        Begin and end of the data of each period, in the site's zone.
    doubts : sequence of str
        Doubts of poses and recordings.
    """

    table: gpd.GeoDataFrame
    left_out: pd.DataFrame
    used: tuple[float, float]
    before: Period
    after: Period
    doubts: Sequence[str] = ()

    def figures(self) -> dict[str, Any]:
        """Return the compared periods, and the number of lanes with a significant difference."""
        significant = self.table[self.table["verdict"] != NOT_TOLD]
        of_all, significant = (
            significant[significant["lane"].isna()],
            significant[significant["lane"].notna()],
        )
        changed = significant.groupby(["measure", "verdict"]).size()
        periods = {"before": self.before, "after": self.after}
        return {
            **{name: "/".join(map(iso_from_time, ends)) for name, ends in periods.items()},
            "lanes_compared": int(self.table["lane"].nunique()),
            "lanes_not_seen_alike": len(self.left_out),
            "share_of_before_used": round(self.used[0], 3),
            "share_of_after_used": round(self.used[1], 3),
            "compared_by": [Text(each) for each in sorted(set(self.table["units"]))],
            "lanes_with_a_change": {f"{name}, {way}": int(n) for (name, way), n in changed.items()},
            "all_stop_lines": dict(zip(of_all["measure"], of_all["verdict"], strict=True)),
        }

    def __repr__(self) -> str:
        known = self.figures()
        changes = sum(known["lanes_with_a_change"].values())
        return (
            f"Comparison({known['before']} with {known['after']}: {known['lanes_compared']} lanes, "
            f"{changes} changes told)"
        )

    def _repr_html_(self) -> str:
        return card("Before and after", self.figures())

    def write(
        self, folder: str | Path, *, language: str | None = None, reporter: Reporter = QUIET
    ) -> list[Path]:
        """Write all files into a folder, which appears whole or not at all.

        `compare.html` (one page, all inside), `compare.csv` (a row a lane and measure),
        `compare.gpkg` (a layer of lanes, coloured by the change of the volume), `compare.png` (maps
        of what changed).

        Parameters
        ----------
        folder : str or Path
            The folder; an earlier result there is replaced.
        language : str, optional
            Language of page and titles, `en` or `de`; by default the current one.
        reporter : Reporter
            Receives progress.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        OutputError
            If the folder cannot be written, or holds other files.
        """
        writers: dict[str, Callable[[Path], object]] = {
            "compare.csv": lambda path: write_csv(path, _rounded(self.table)),
            "compare.gpkg": partial(_write_layer, self.table),
            "compare.png": partial(draw_changes, self),
            "compare.html": partial(_write_page, self),
        }
        return write_results(
            folder, writers, name="compare", stage="writing the comparison", language=language,
            reporter=reporter,
        )  # fmt: skip


def wide_table(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return a row for each lane, with `..._before`, `_after`, `_se`, `_verdict`, `_change`.

    These are columns of each measure. `..._change` is the difference in percent where one is found,
    else 0; null where the lane has no such measure.
    """
    table = table[table["lane"].notna()].astype({"lane": np.int64})
    lanes = table.drop_duplicates("lane").set_index("lane")[["name", "watchers", "geometry"]]
    columns: dict[str, Any] = {}
    for measure in COMPARED:
        rows = table[table["measure"] == measure].set_index("lane").reindex(lanes.index)
        is_significant = rows["verdict"].notna() & (rows["verdict"] != NOT_TOLD)
        for name in ("before", "after", "se", "verdict"):
            columns[f"{measure}_{name}"] = rows[name]
        change = rows["percent"].fillna(np.sign(rows["difference"]) * _MOST).clip(-_MOST, _MOST)
        columns[f"{measure}_change"] = change.where(is_significant, 0.0).where(
            rows["verdict"].notna()
        )
    wide = pd.concat([lanes[["name", "watchers"]], pd.DataFrame(columns)], axis=1).reset_index()
    return gpd.GeoDataFrame(wide, geometry=lanes["geometry"].to_numpy(), crs=table.crs)


def _rounded(table: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return a comparison for people: no digits far below the errors, probabilities to 1e-6."""
    shown = pd.DataFrame(table.drop(columns="geometry"))
    digits = {
        name: 6 if name in {"p", "p_corrected"} else 4
        for name in shown
        if pd.api.types.is_float_dtype(shown[name])
    }
    return shown.round(digits)


def _write_layer(table: gpd.GeoDataFrame, path: Path) -> None:
    measure = next(iter(COMPARED))
    # with metadata of a layer, GDAL makes the tables that titles need
    metadata = {"shows": measure}
    add_layer(wide_table(table), path, _LAYER, geometry_type="LineString", layer_metadata=metadata)
    notes = LayerNotes(tr("Comparison"), tr("What changed by lane between two periods"), {})
    style = class_style(f"{measure}_change", change_classes())
    style_layers(
        path, {_LAYER: style}, name="change", about="change of the volume", notes={_LAYER: notes}
    )


def change_classes() -> Iterator[LineClass]:
    """Yield the classes of change, percent."""
    for (low, high), colour in zip(pairwise(_BREAKS), _COLOURS, strict=True):
        if low < 0.0 < high:
            label = tr("no change is told")
        elif low == _BREAKS[0] or high == _BREAKS[-1]:
            bound = high if low == _BREAKS[0] else low
            more = tr("over {percent} % more", percent=f"{bound:g}")
            label = more if bound > 0 else tr("over {percent} % less", percent=f"{-bound:g}")
        else:
            near, far = sorted((abs(low), abs(high)))
            ends = {"low": f"{near:.0f}", "high": f"{far:.0f}"}
            more = tr("{low} to {high} % more", **ends)
            label = more if low > 0 else tr("{low} to {high} % less", **ends)
        yield LineClass(low, high, colour, label)


def draw_changes(comparison: Comparison, path: Path) -> None:
    """Write maps of the changes as PNG: one each of volume, speed and occupancy."""
    from matplotlib.lines import Line2D  # noqa: PLC0415 - where it draws

    table = wide_table(comparison.table)
    measures = list(COMPARED)[:3]
    with picture_file(path, (12.0, 5.2), 130, font_pt=9.0) as figure:
        for ax, measure in zip(figure.subplots(1, len(measures)), measures, strict=True):
            known = table[table[f"{measure}_before"].notna()]
            table.plot(ax=ax, **_NOT_COMPARED)
            change = known[f"{measure}_change"].to_numpy(np.float64)
            k = np.clip(np.searchsorted(_BREAKS, change, side="right") - 1, 0, len(_COLOURS) - 1)
            known.plot(ax=ax, color=np.array(_COLOURS)[k].tolist(), linewidth=2.6)
            ax.set_title(tr(COMPARED[measure].title), y=1.0)  # else a wide one is moved up and out
            ax.set_axis_off()
            ax.set_aspect("equal")
        lines = [
            Line2D([], [], color=each.colour, linewidth=3.0, label=each.label)
            for each in change_classes()
        ]
        lines.append(Line2D([], [], label=tr("not compared"), **_NOT_COMPARED))
        figure.legend(handles=lines, loc="outside lower center", ncols=4, frameon=False)


def _write_page(comparison: Comparison, path: Path) -> None:
    picture = path.with_suffix(".png").read_bytes()
    path.write_text(page_of(comparison, picture), encoding="utf-8")


def page_of(comparison: Comparison, picture: bytes) -> str:
    """Return the page (HTML): what got better, what worse, what cannot be told."""
    template = text_template(Path(__file__).parent / "page.html.jinja")
    rows = list(change_rows(comparison.table))
    before, after = (
        long_span(begin.to_pydatetime(), end.to_pydatetime(), begin.tzinfo)
        for begin, end in (comparison.before, comparison.after)
    )
    lanes = comparison.table["lane"].nunique()
    basis = tr(
        "Lanes compared, which the same sensors saw alike: {lanes}, with {before} of the intervals "
        "before and {after} of those after. A difference is told where chance gives one in less "
        "than 5 % of all comparisons, however many lanes there are.",
        lanes=lanes, before=percent(comparison.used[0], 0), after=percent(comparison.used[1], 0),
    )  # fmt: skip
    if rows and all(row["section"] is None for row in rows):
        basis += " " + tr(
            "No difference is told. That does not prove that nothing changed: the intervals below "
            "say how much may have."
        )
    page: str = template.render(
        title=tr("Before and after: traffic by lane"), language=current_language(), tr=tr,
        before=before, after=after, basis=basis,
        doubts=[*_cautions(comparison.table), *map(tr, comparison.doubts)],
        picture=f"data:image/png;base64,{base64.b64encode(picture).decode()}",
        sections=[
            (tr(title), [row for row in rows if row["section"] == section])
            for section, title in _SECTIONS.items()
        ],
        left_out=comparison.left_out.to_dict("records"),
    )  # fmt: skip
    return page.removesuffix("\n")


def _cautions(table: gpd.GeoDataFrame) -> list[str]:
    """Return cautions for the reader about the compared data."""
    apart = table["units"] == INTERVALS
    cautions = list[str]()
    if apart.all():
        cautions.append(
            tr("The periods share no times of day: what differs may be the time of day.")
        )
    elif apart.any():
        cautions.append(tr("What rests on intervals may differ by the time of day."))
    if table["stop_line"].eq(PRESUMED).any():
        cautions.append(
            tr("Queues of lanes for which the map draws no stop line are measured from a presumed "
               "one, at the end of the lane before the junction.")
        )  # fmt: skip
    return cautions


def _signed(change: float) -> str:
    """Return a change in percent with its sign."""
    return f"{'+' if change > 0.0 else ''}{figure_text(change, 0)}{THIN_SPACE}%"


def change_rows(table: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield the rows of the page, those with the surest differences first."""
    for row in table.sort_values(["p_corrected", "lane"]).to_dict("records"):
        measure = COMPARED[row["measure"]]
        sign = {MORE: 1, LESS: -1}.get(row["verdict"])
        words = NO_FIGURE if sign is None else tr(measure.more if sign > 0 else measure.less)
        share = "" if sign is None or not row["before"] else f" ({_signed(row['percent'])})"
        half_width = 0.5 * (row["high"] - row["low"])
        difference = figure_text(row["difference"], measure.digits)
        error = f" ± {figure_text(half_width, measure.digits)}" if np.isfinite(half_width) else ""
        yield {
            "name": row["name"], "measure": tr(measure.title),
            "before": figure_text(row["before"], measure.digits),
            "after": figure_text(row["after"], measure.digits), "difference": difference + error,
            "section": None if sign is None else sign * measure.better,
            "words": words + share, "units": f"{row['count']} {tr(row['units'])}",
        }  # fmt: skip

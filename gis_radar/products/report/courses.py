"""Time-space diagrams of queues: vehicles on their way to a stop line, and the queue's back."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from textwrap import fill
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure as MplFigure
from PIL import Image

from gis_radar.base import (
    FONTS,
    STEPS_PER_SECOND,
    TRACK_EVERY_STEPS,
    Clock,
    Floats,
    Integers,
    Text,
    figure_text,
    tr,
)
from gis_radar.dataset import Dataset, LaneTraffic
from gis_radar.measures import JOINED_M, PRESUMED, QueueCourse
from gis_radar.products.heatmap.picture import (
    INK,
    NARROW_IN,
    SOFT,
    for_a_phone,
    image_of_figure,
    png,
)
from gis_radar.products.report.chart import times_below
from gis_radar.products.report.content import Figure

MOST_COURSES = 3  # lanes, which fill two thirds of a page
DIAGRAM_S = 900.0  # time in a diagram: over more, the lines of vehicles merge into grey
_COURSE_IN, _COURSE_DPI = (7.2, 1.9), 150  # of one lane
_NARROW_COURSE_IN = 1.7  # its height on a phone
_BEYOND_M, LEAST_M, _MOST_M = 12.0, 45.0, 250.0  # shown beyond the line; least and most before it
_LEAST_ABOVE_M = 2.0  # shown beyond a stop line at the end of its lane
_AROUND = 1.5  # shown before the line, as a multiple of the longest queue
_BROKEN_STEPS = 3 * TRACK_EVERY_STEPS  # without a state, after which a line ends
_QUEUE, _UNSEEN = "#ba1c4d", "#d5dade"
_LETTERS_PT, _NARROW_PT = 8.0, 6.5  # size of letters; on a phone
_TITLE_LETTERS = 95.0  # letters in a title x points of a letter / inches of width


class LongQueue(NamedTuple):
    """A lane with a queue: its number and name, how far it reached (m) and about when."""

    lane: int
    name: str
    longest_m: float
    moment: datetime


def draw_courses(
    dataset: Dataset, queues: Sequence[LongQueue], span: tuple[datetime, datetime], clock: Clock,
    *, paths: bool,
) -> list[Figure]:  # fmt: skip
    """Draw the trajectories of vehicles to the stop lines of lanes, and the backs of their queues.

    Parameters
    ----------
    dataset : Dataset
        The dataset; without exact tables nothing is drawn.
    queues : sequence of LongQueue
        Lanes from top to bottom.
    span : (datetime, datetime)
        Time of the report; of more than 15 minutes, 15 minutes around each queue are drawn.
    clock : Clock
        Clock for the times below.
    paths : bool
        Whether the trajectories are drawn, or the queues alone.

    Returns
    -------
    list of Figure
        One figure, or none.
    """
    windows = [(each, *_window(each.moment, *span)) for each in queues]
    courses = [(*part, _course(dataset, part[0].lane, *part[1:])) for part in windows]
    if not all(each for *_, each in courses):
        return []
    wide, narrow = (
        _diagrams(courses, (width_in, height_in), letters_pt, clock, paths=paths)
        for width_in, height_in, letters_pt in (
            (*_COURSE_IN, _LETTERS_PT), (NARROW_IN, _NARROW_COURSE_IN, _NARROW_PT),
        )
    )  # fmt: skip
    named = "; ".join(
        f"{each.name}: {figure_text(each.longest_m)} m" for each in queues
    )  # fmt: skip
    return [
        Figure(
            png=png(wide), narrow=png(for_a_phone(narrow)), width=wide.width, height=wide.height,
            caption=" ".join(map(tr, (_QUEUES, *([_WAYS] if paths else [])))),
            alt=tr("Time-space diagrams of the longest queues. {lanes}.", lanes=named),
        )
    ]  # fmt: skip


_QUEUES = Text(
    "The lanes with the longest queues. Outlined and red is the queue, from the stop line back to "
    "its end. Grey without an outline: not seen."
)
_WAYS = Text(
    "Each thin line is the way of one vehicle to the stop line, level where it stands; a line that "
    "begins or ends on the way was found or lost there."
)


def course_title(row: pd.Series) -> str:
    """Return the title of a diagram: the lane's name, and whether its stop line is presumed.

    Parameters
    ----------
    row : Series
        Row of :meth:`gis_radar.Dataset.traffic`.
    """
    is_presumed = row["stop_line"] == PRESUMED
    return tr("{lane}, presumed stop line", lane=row["name"]) if is_presumed else str(row["name"])


_MARK = "*"
_PRESUMED = Text(
    "The map draws no stop line for this junction: the queue is measured from the end of the lane "
    "before it, where a stop line is presumed."
)


def longest_queue_text(row: pd.Series) -> str:
    """Return the longest queue of a lane, m; `at least` where it reaches the end of sight.

    One from a presumed stop line has a mark, which :func:`presumed_note` explains.

    Parameters
    ----------
    row : Series
        Row of :meth:`gis_radar.Dataset.traffic`, whose `queue_max_m` is known.
    """
    mark = _MARK if row["stop_line"] == PRESUMED else ""
    text = figure_text(float(row["queue_max_m"])) + mark
    ends_in_sight = row["queue_max_m"] < row["sight_m"] - JOINED_M
    return text if ends_in_sight or row["queue_max_m"] == 0.0 else tr("at least {m}", m=text)


def presumed_note(rows: pd.DataFrame) -> list[str]:
    """Return what the mark of queues from presumed stop lines says, if any of them has it.

    Parameters
    ----------
    rows : DataFrame
        Rows of :meth:`gis_radar.Dataset.traffic`.
    """
    marked = rows["stop_line"].eq(PRESUMED) & rows["queue_max_m"].notna()
    return [_MARK + tr(_PRESUMED)] if marked.any() else []


def _window(moment: datetime, begin: datetime, end: datetime) -> tuple[datetime, datetime]:
    """Return the time that a diagram shows: `DIAGRAM_S` around a moment, within the report's."""
    length = min(timedelta(seconds=DIAGRAM_S), end - begin)
    first = min(max(moment - length / 2, begin), end - length)
    return first, first + length


def _course(dataset: Dataset, lane: int, begin: datetime, end: datetime) -> list[QueueCourse]:
    """Return the course of a queue, a part an hour; none where exact tables were deleted."""
    span = dataset.span(begin, end)
    traffic = LaneTraffic.of(dataset)
    return traffic.courses(dataset.records(span), lane, span) if span else []


def _diagrams(
    courses: Sequence[tuple[LongQueue, datetime, datetime, list[QueueCourse]]],
    size_in: tuple[float, float], letters_pt: float, clock: Clock, *, paths: bool,
) -> Image.Image:  # fmt: skip
    """Return the diagrams of lanes below each other."""
    width_in, height_in = size_in
    dpi = _COURSE_DPI if width_in > NARROW_IN else 2 * _COURSE_DPI
    with mpl.rc_context(FONTS | {"font.size": letters_pt, "axes.titlesize": "medium"}):
        figure = MplFigure(
            figsize=(width_in, height_in * len(courses)), dpi=dpi, layout="constrained"
        )
        axes = figure.subplots(len(courses), 1, squeeze=False)[:, 0]
        for ax, (queue, begin, end, parts) in zip(axes, courses, strict=True):
            for part in parts:
                _draw(ax, part, begin, paths=paths)
            near, far = np.concatenate([each.seen[:, 2:] for each in parts]).T
            shown_m = (min(far.max(initial=0.0), _MOST_M), max(near.min(initial=0.0), -_BEYOND_M))
            letters = round(_TITLE_LETTERS * width_in / letters_pt)
            named = queue._replace(name=fill(queue.name, letters))
            _lay_out(ax, named, begin, end, shown_m, clock)
        figure.supylabel(tr("metres before the stop line"), fontsize=letters_pt, color=SOFT)
        return image_of_figure(figure).convert("RGB").quantize(128, dither=Image.Dither.NONE)


def _draw(ax: Axes, course: QueueCourse, begin: datetime, *, paths: bool) -> None:
    """Draw visible road, queue and trajectories of one hour; x is seconds from `begin`."""

    def to_s(steps: Floats | Integers) -> Floats:
        return np.asarray(steps, np.float64) / STEPS_PER_SECOND - begin.timestamp()

    first, after, near, far = course.seen.T
    corners = [
        (to_s(first), near),
        (to_s(after), near),
        (to_s(after), far),
        (to_s(first), far),
    ]
    boxes = np.stack([np.column_stack(each) for each in corners], axis=1)
    ax.add_collection(PolyCollection(list(boxes), facecolors="white", edgecolors="white", lw=0.3))
    back = np.nan_to_num(course.back_m)
    ax.fill_between(
        to_s(course.back_step), 0.0, back, step="post", color=_QUEUE, alpha=0.3, lw=0.0, zorder=3
    )
    shown = np.where(course.back_m > 0.0, course.back_m, np.nan)
    ax.step(to_s(course.back_step), shown, where="post", color=_QUEUE, lw=1.1, zorder=4)
    if not paths:
        return
    new = np.diff(course.vehicle, prepend=-1) != 0
    new |= np.diff(course.step, prepend=0) > _BROKEN_STEPS
    points = np.column_stack([to_s(course.step), course.to_line_m])
    lines = np.split(points, np.flatnonzero(new)[1:])
    ax.add_collection(LineCollection(lines, colors=INK, linewidths=0.45, alpha=0.75, zorder=5))


def _lay_out(
    ax: Axes, queue: LongQueue, begin: datetime, end: datetime, shown_m: tuple[float, float],
    clock: Clock,
) -> None:  # fmt: skip
    """Give axes their scale, times and title: vehicles drive upwards, to the line."""
    seconds = (end - begin).total_seconds()
    reach = min(max(queue.longest_m * _AROUND, LEAST_M), shown_m[0])
    above = min(shown_m[1], -_LEAST_ABOVE_M)
    ax.set(xlim=(0.0, seconds), ylim=(reach, above), facecolor=_UNSEEN)
    ax.axhline(0.0, color=INK, lw=1.2, zorder=6)
    step_s = 10.0 if seconds <= DIAGRAM_S / 3.0 else 60.0
    first = begin - timedelta(seconds=begin.timestamp() % step_s)
    edges = [first + timedelta(seconds=step_s * k) for k in range(int(seconds / step_s) + 2)]
    edges = [each for each in edges if begin <= each <= end]
    places = np.array([(each - begin).total_seconds() for each in edges])
    ticks = times_below(edges, places, clock) if len(edges) > 1 else []
    ax.set_xticks([at for at, _ in ticks], [label for _, label in ticks])
    ax.set_title(queue.name, loc="left", color=INK, fontweight="bold", parse_math=False)
    ax.tick_params(colors=SOFT, length=2.5)
    for side in ax.spines.values():
        side.set(color=SOFT, linewidth=0.6)

"""The pictures of the map, a frame an interval, and what each shows in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gis_radar.crs import name_of
from gis_radar.poses.pose import Pose
from gis_radar.progress import Reporter
from gis_radar.report.canvas import Canvas, canvas_of, png
from gis_radar.report.content import Figure, Frame, MapPart
from gis_radar.report.lanes import LaneTally, Seconds, Span, Traffic
from gis_radar.report.overlay import lane_map, overlay_of
from gis_radar.report.words import Clock, count, percent
from gis_radar.tiles.tiles import quads

MOST_FRAMES = 96
MOST_PIXELS = 2_200_000  # of a picture
ALL_PIXELS = 70_000_000  # of all together: a browser holds four bytes of each
STAGE = "drawing the maps"


@dataclass(frozen=True, kw_only=True)
class Group:
    """Intervals that one picture shows.

    Parameters
    ----------
    span : (datetime, datetime)
        Begin of the first, end of the last.
    size : int
        How many.
    """

    span: Span
    size: int


def groups_of(intervals: Sequence[Span]) -> list[Group]:
    """Return the intervals as pictures show them: singly, or several at a time where many."""
    size = -(-len(intervals) // MOST_FRAMES)
    parts = [intervals[i : i + size] for i in range(0, len(intervals), size)]
    return [Group(span=(part[0][0], part[-1][1]), size=len(part)) for part in parts]


def canvas_for(traffic: Traffic) -> Canvas:
    """Lay the canvas of all pictures: the more pictures, the coarser."""
    frames = len(groups_of(traffic.intervals)) + 1
    most = min(MOST_PIXELS, ALL_PIXELS // frames)
    return canvas_of(quads(traffic.tiles), traffic.overall.observed > 0, most)


def frames_of(
    traffic: Traffic, canvas: Canvas, tally: LaneTally, clock: Clock, reporter: Reporter
) -> list[Frame]:
    """Read the intervals, draw them, and count them by lane; no frame where there is but one."""
    frames = []
    reader = traffic.by_interval()
    groups = groups_of(traffic.intervals)
    for done, group in enumerate(groups, start=1):
        seconds = _next(reader, group, tally)
        if len(traffic.intervals) > 1:
            text = _sentence(seconds, tally)
            picture = canvas.paint(seconds.occupancy)
            frames.append(Frame(label=clock.span(*group.span), text=text, picture=picture))
        reporter.progress(STAGE, done, len(groups))
    return frames


def _next(reader: Iterator[Seconds], group: Group, tally: LaneTally) -> Seconds:
    """Return the sum over a group's intervals."""
    parts = [next(reader) for _ in range(group.size)]
    for part in parts:
        tally.add(part)
    if len(parts) == 1:
        return parts[0]
    return Seconds(*(np.sum([part[i] for part in parts], axis=0) for i in (0, 1)))


def _sentence(seconds: Seconds, tally: LaneTally) -> str:
    """Say what a map shows: the busiest lane, and how much was observed and hit."""
    seen, hit = seconds.observed > 0, seconds.occupied > 0
    if not seen.any():
        return "Nothing was observed."
    share = float(np.count_nonzero(hit) / np.count_nonzero(seen))
    facts = f"{percent(share, 0)} of {count(int(seen.sum()), 'observed tile')} hit."
    occupied, observed = tally.sums(seconds)
    if not occupied.any():
        return f"No tile was hit; {count(int(seen.sum()), 'tile')} observed."
    of_lanes = np.divide(occupied, observed, out=np.zeros(len(observed)), where=observed > 0)
    top = int(of_lanes.argmax())
    busiest = f"Busiest is lane {tally.lanes[top].number}, occupied {percent(of_lanes[top])}"
    return f"{busiest} of the observed time; {facts}"


def map_part(
    traffic: Traffic,
    canvas: Canvas,
    frames: Sequence[Frame],
    tally: LaneTally,
    poses: Sequence[Pose],
    sources: Sequence[str],
) -> MapPart:
    """Put the map together, with what it is and whose."""
    whole = Frame(
        label="Whole time",
        text=_sentence(traffic.overall, tally),
        picture=canvas.paint(traffic.overall.occupancy),
    )
    size = groups_of(traffic.intervals)[0].size
    note = ""
    if size > 1:
        note = (
            f"The heat map has {count(len(traffic.intervals), 'interval')}; each picture shows "
            f"{size} of them together. The tables hold each."
        )
    sensors = " Triangles: sensors; dashed: their range and opening angle." if poses else ""
    crs = traffic.crs
    told = (
        f"North is up on the grid of {crs.name} ({name_of(crs)[:24]}).{sensors} "
        "Where tiles overlap, the busiest is on top."
    )
    given = f" Sources: {'; '.join(sources)}." if sources else ""
    return MapPart(
        whole=whole,
        frames=frames,
        overlay=png(overlay_of(canvas, poses)),
        width=canvas.width,
        height=canvas.height,
        caption=told + given,
        note=note,
    )


def lane_figure(traffic: Traffic, canvas: Canvas, tally: LaneTally, table: pd.DataFrame) -> Figure:
    """Draw where the lanes are; those that the table shows are named, the busiest first."""
    named = table.loc[table["occupancy"].notna(), "lane"].tolist()
    picture = lane_map(canvas, traffic.tiles, tally.lanes, named)
    return Figure(
        png=png(picture), width=canvas.width, height=canvas.height,
        caption="The lanes, and the numbers of those observed; arrows show where they lead.",
        alt=(
            f"Map of {count(len(tally.lanes), 'lane')} with their numbers. The table says of "
            "each where it leads and how long it is."
        ),
    )  # fmt: skip

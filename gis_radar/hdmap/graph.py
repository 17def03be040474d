"""Lane graph: find the lanelets at a point and the place on them, and the successors of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from gis_radar.base import Floats, Integers, NoAnswerError, compiled, ranges
from gis_radar.hdmap.curves import lane_headings
from gis_radar.hdmap.tagging import is_driven

_STEP_M = 1.0  # between samples: on a curve of 10 m radius their chord is 1 cm off the arc
LANE_MARGIN_M = 1.0  # added on both sides of a lane: a vehicle's middle is rarely farther outside
_FIELD_CELL_M = 1.0  # side of a cell of a :class:`LaneField`
_JOIN_M = 1.5  # between ends of lanelets that follow each other without shared nodes: half a lane
_JOIN_RAD = np.radians(30.0)  # between their directions
_MOST_LANES_AT_POINT = 8  # lanelets that may overlap at one point
_LEVEL_M = 2.0  # roads that differ less in height are on one level (the contract)

FieldArrays: TypeAlias = tuple[Integers, Integers, Integers, Integers, Floats]


@dataclass(frozen=True, kw_only=True)
class LaneGraph:
    """The driven lanelets of a map, sampled along their centres.

    Parameters
    ----------
    lanelet_id : (n,) int64 array
        Ids, ascending.
    length_m : (n,) array
        Length of the centre line.
    first : (n + 1,) int64 array
        Index of the first sample of each lanelet; at the end, the number of samples.
    points : (m, 3) array
        Samples, metres from `origin` in the map frame; heights NaN where unknown.
    s_m : (m,) array
        Distance of a sample from the start of its lanelet, metres.
    heading : (m,) array
        Direction of travel at a sample, radians counter-clockwise from grid east.
    half_width_m : (m,) array
        Half of the lanelet's width at a sample.
    successors : list of int64 arrays
        Positions of the lanelets that follow each.
    origin : (2,) array
        Easting and northing of the local (0, 0).
    """

    lanelet_id: Integers
    length_m: Floats
    first: Integers
    points: Floats
    s_m: Floats
    heading: Floats
    half_width_m: Floats
    successors: list[Integers]
    origin: Floats

    @cached_property
    def field(self) -> LaneField:
        """The graph as arrays for compiled code, which finds the lanes at a point."""
        return LaneField.of(self)

    @cached_property
    def reversed(self) -> LaneGraph:
        """The graph as it is driven when time runs backward."""
        spans = pairwise(self.first.tolist())
        order = np.concatenate([np.arange(end - 1, begin - 1, -1) for begin, end in spans])
        lane = np.repeat(np.arange(len(self.lanelet_id)), np.diff(self.first))
        before: list[list[int]] = [[] for _ in self.lanelet_id]
        for index, following in enumerate(self.successors):
            for other in following.tolist():
                before[other].append(index)
        return replace(
            self,
            points=self.points[order],
            s_m=self.length_m[lane] - self.s_m[order],
            heading=self.heading[order] + np.pi,
            half_width_m=self.half_width_m[order],
            successors=[np.array(each, np.int64) for each in before],
        )

    def place(self, lane: int, s_m: Floats) -> tuple[Floats, Floats]:
        """Return local points (k, 2) and headings (k,) at distances along a lanelet.

        Parameters
        ----------
        lane : int
            Position of the lanelet.
        s_m : (k,) array
            Metres from its start; distances beyond its ends give its ends.
        """
        part = slice(self.first[lane], self.first[lane + 1])
        s = self.s_m[part]
        points = np.column_stack([np.interp(s_m, s, self.points[part, k]) for k in range(2)])
        return points, np.interp(s_m, s, self._unwrapped[part])

    def by_metre(self, lane: int) -> tuple[Floats, Floats]:
        """Return points (k, 2) at 0.5, 1.5, ... m along a lanelet, and unit vectors to its left.

        They are kept: lines along lanes ask for them again and again.
        """
        if lane not in self._by_metre:
            points, heading = self.place(lane, np.arange(0.5, float(self.length_m[lane])))
            left = np.column_stack([-np.sin(heading), np.cos(heading)])
            self._by_metre[lane] = points, left
        return self._by_metre[lane]

    @cached_property
    def _by_metre(self) -> dict[int, tuple[Floats, Floats]]:
        return {}

    @cached_property
    def _unwrapped(self) -> Floats:
        """Headings of the samples, without jumps along a lanelet."""
        spans = pairwise(self.first.tolist())
        return np.concatenate([np.unwrap(self.heading[begin:end]) for begin, end in spans])


def lane_graph(lanelets: gpd.GeoDataFrame) -> LaneGraph:
    """Build the graph of the lanelets that vehicles drive on.

    Lanelets that share no nodes follow each other where the end of one lies within `_JOIN_M` of the
    start of the other and both point the same way.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.

    Raises
    ------
    NoAnswerError
        If no lanelet is for vehicles.
    """
    driven = lanelets["participants"].map(is_driven).astype(bool)
    table = lanelets[driven].sort_values("lanelet_id")
    if table.empty:
        raise NoAnswerError("the map has no lanelet for vehicles", hint="check the map's tags")
    parts = [_sampled(*row) for row in zip(table["left"], table["right"], strict=True)]
    first = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])]).astype(np.int64)
    points = np.vstack([part[0] for part in parts])
    origin = np.floor(points[:, :2].min(axis=0))
    ids = table["lanelet_id"].to_numpy(np.int64)
    graph = LaneGraph(
        lanelet_id=ids,
        length_m=np.array([part[1][-1] for part in parts]),
        first=first,
        points=points - [*origin, 0.0],
        s_m=np.concatenate([part[1] for part in parts]),
        heading=np.concatenate([part[2] for part in parts]),
        half_width_m=np.concatenate([part[3] for part in parts]),
        successors=[],
        origin=origin,
    )
    graph.successors.extend(_successors(graph, table))
    headings = lane_headings(
        list(zip(table["left"], table["right"], strict=True)),
        [np.linspace(0.0, 1.0, count) for count in np.diff(first).tolist()],
        [each.tolist() for each in graph.successors],
    )
    return replace(graph, heading=np.concatenate(headings))


def _sampled(
    left: shapely.LineString, right: shapely.LineString
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return points (m), distances (m), headings (rad) and half widths (m) along a lanelet."""
    count = max(int(np.ceil(max(left.length, right.length) / _STEP_M)), 1) + 1
    share = np.linspace(0.0, 1.0, count)
    sides = [
        shapely.get_coordinates(
            shapely.line_interpolate_point(line, share, normalized=True), include_z=True
        )
        for line in (left, right)
    ]
    middle = 0.5 * (sides[0] + sides[1])
    gaps = np.diff(middle[:, :2], axis=0)
    lengths = np.hypot(gaps[:, 0], gaps[:, 1])
    s_m = np.concatenate([[0.0], np.cumsum(lengths)])
    chord_heading = np.arctan2(gaps[:, 1], gaps[:, 0])
    unwrapped = np.unwrap(np.concatenate([chord_heading[:1], chord_heading, chord_heading[-1:]]))
    heading = 0.5 * (unwrapped[:-1] + unwrapped[1:])
    half = 0.5 * np.hypot(*(sides[0] - sides[1])[:, :2].T)
    return middle, s_m, heading, half


def _successors(graph: LaneGraph, table: gpd.GeoDataFrame) -> list[Integers]:
    """Return the positions of each lanelet's successors: those stated, and those by `_JOIN_M`."""
    position = {ref: index for index, ref in enumerate(graph.lanelet_id.tolist())}
    starts, ends = graph.first[:-1], graph.first[1:] - 1
    successors = []
    for index, named in enumerate(table["successors"]):
        gap = graph.points[starts] - graph.points[ends[index]]
        turn = np.cos(graph.heading[starts] - graph.heading[ends[index]])
        level = ~(np.abs(gap[:, 2]) > _LEVEL_M)
        near = (np.hypot(gap[:, 0], gap[:, 1]) < _JOIN_M) & (turn > np.cos(_JOIN_RAD)) & level
        near[index] = False
        stated = [position[ref] for ref in named if ref in position]
        successors.append(
            np.union1d(np.flatnonzero(near), np.array(stated, np.int64)).astype(np.int64)
        )
    return successors


@dataclass(frozen=True, kw_only=True)
class LaneField:
    """Segments of lanes by cell of a grid, for compiled code.

    Parameters
    ----------
    arrays : tuple of arrays
        Arguments of :func:`lanes_at`: for each cell, the index of its first entry in the next
        array, whose entries are indices of the samples at which segments begin; columns and rows of
        the grid; the position of each sample's lanelet; and the samples (x, y, height, s, heading,
        half width, and the metres by which the grid's corner lies south-west of the origin).
    """

    arrays: FieldArrays

    @classmethod
    def of(cls, graph: LaneGraph) -> LaneField:
        """Return the field of a graph."""
        lane_of = np.repeat(np.arange(len(graph.lanelet_id)), np.diff(graph.first))
        shift = float(graph.half_width_m.max()) + LANE_MARGIN_M
        size = graph.points[:, :2].max(axis=0) + 2.0 * shift
        columns, rows = (int(side / _FIELD_CELL_M) + 1 for side in size)
        heads = np.flatnonzero(np.diff(lane_of) == 0)
        ends = np.stack([graph.points[heads, :2], graph.points[heads + 1, :2]])
        reach = np.maximum(graph.half_width_m[heads], graph.half_width_m[heads + 1]) + LANE_MARGIN_M
        low = np.floor((ends.min(axis=0) - reach[:, None] + shift) / _FIELD_CELL_M).astype(np.int64)
        high = np.floor((ends.max(axis=0) + reach[:, None] + shift) / _FIELD_CELL_M).astype(
            np.int64
        )
        low, high = np.maximum(low, 0), np.minimum(high, [columns - 1, rows - 1])
        wide = high - low + 1
        number = np.repeat(np.arange(len(heads)), wide[:, 0] * wide[:, 1])
        within = ranges(np.zeros(len(heads), np.int64), wide[:, 0] * wide[:, 1])
        row = low[number, 1] + within // wide[number, 0]
        column = low[number, 0] + within % wide[number, 0]
        cell = row * columns + column
        order = np.argsort(cell, kind="stable")
        count = np.bincount(cell, minlength=columns * rows)
        first = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        samples = np.column_stack(
            [
                graph.points, graph.s_m, graph.heading, graph.half_width_m,
                np.full(len(graph.s_m), shift),
            ]
        )  # fmt: skip
        grid = np.array([columns, rows], np.int64)
        segment = heads[number[order]].astype(np.int64)
        return cls(arrays=(first, segment, grid, lane_of.astype(np.int64), samples))

    def lanes(self, points: Floats) -> pd.DataFrame:
        """Return the lanes at local points: `point lane s_m d_m heading half_width_m height_m`."""
        names = ["point", "lane", "s_m", "d_m", "heading", "half_width_m", "height_m"]
        columns = dict(zip(names, self.lane_rows(points).T, strict=True))
        integers = {name: columns[name].astype(np.int64) for name in ("point", "lane")}
        return pd.DataFrame(columns | integers)

    def lane_rows(self, points: Floats) -> Floats:
        """Return the lanes at local points (n, 7), in the columns of :meth:`lanes`."""
        return _all_lanes(np.ascontiguousarray(points[:, :2]), self.arrays)


@compiled
def lanes_at(
    x: float, y: float, field: FieldArrays, out: Floats
) -> int:  # pragma: no cover - compiled
    """Fill rows of `out` with the lanes at a local point; return their number.

    A row has lane, s (m), d (m, left of the centre), heading (rad), half width (m), height (m). A
    lane is at a point between its ends, within its width and `LANE_MARGIN_M`.
    """
    first, segment, size, lane_of, samples = field
    shift = samples[0, 6]
    column, row = int((x + shift) / _FIELD_CELL_M), int((y + shift) / _FIELD_CELL_M)
    if x + shift < 0.0 or y + shift < 0.0 or column >= size[0] or row >= size[1]:
        return 0
    cell, found = row * size[0] + column, 0
    for k in range(first[cell], first[cell + 1]):
        i = segment[k]
        t, d = _on_segment(x, y, i, lane_of, samples)
        if np.isnan(t):
            continue
        slot = found
        for j in range(found):
            if int(out[j, 0]) == lane_of[i]:
                slot = j
        if slot == len(out) or (slot < found and abs(out[slot, 2]) <= abs(d)):
            continue
        found = max(found, slot + 1)
        out[slot, 0], out[slot, 2] = lane_of[i], d
        # s, heading, half width and height are interpolated along the segment
        for place, column in ((1, 3), (3, 4), (4, 5), (5, 2)):
            begin, end = samples[i, column], samples[i + 1, column]
            out[slot, place] = begin + t * (end - begin)
    return found


@compiled
def _share(x: float, y: float, i: int, samples: Floats) -> float:  # pragma: no cover - compiled
    """Return the place of a point along a segment as a share of its length; NaN if that is 0."""
    bx, by = samples[i + 1, 0] - samples[i, 0], samples[i + 1, 1] - samples[i, 1]
    length2 = bx * bx + by * by
    if length2 <= 0.0:
        return np.nan
    return float(((x - samples[i, 0]) * bx + (y - samples[i, 1]) * by) / length2)


@compiled
def _on_segment(
    x: float, y: float, i: int, lane_of: Integers, samples: Floats
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Return the share along a segment and the distance to its left (m) of a point; NaN if off it.

    A point in the wedge outside a corner belongs to the segment before it and to that after it.
    """
    off_segment = (np.nan, np.nan)
    t = _share(x, y, i, samples)
    if t < 0.0:
        # before the lane, or on the segment before
        if i == 0 or lane_of[i - 1] != lane_of[i] or _share(x, y, i - 1, samples) <= 1.0:
            return off_segment
    elif t > 1.0:
        last = i + 2 >= len(lane_of) or lane_of[i + 2] != lane_of[i]
        if last or _share(x, y, i + 1, samples) >= 0.0:
            return off_segment
    elif np.isnan(t):
        return off_segment
    ax, ay = samples[i, 0], samples[i, 1]
    bx, by = samples[i + 1, 0] - ax, samples[i + 1, 1] - ay
    t = min(max(t, 0.0), 1.0)
    d = (bx * (y - ay) - by * (x - ax)) / np.hypot(bx, by)
    half = samples[i, 5] + t * (samples[i + 1, 5] - samples[i, 5])
    return (t, d) if abs(d) <= half + LANE_MARGIN_M else off_segment


@compiled
def _all_lanes(points: Floats, field: FieldArrays) -> Floats:
    """Return a row for each point and lane at it: the point's index, then as :func:`lanes_at`."""
    rows = np.empty((_MOST_LANES_AT_POINT * len(points), 7))
    count = 0
    for i in range(len(points)):
        out = rows[count : count + _MOST_LANES_AT_POINT, 1:]
        found = lanes_at(points[i, 0], points[i, 1], field, out)
        rows[count : count + found, 0] = i
        count += found
    return rows[:count].copy()

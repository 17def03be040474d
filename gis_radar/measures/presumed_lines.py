"""Presumed stop lines: where vehicles wait at a junction for which the map draws no stop line.

They wait at the end of the lanelet before the junction. A way on from it lies in a junction if it
soon meets one that comes from elsewhere and leads in another direction there: one that crosses it,
or that it joins after a turn. So roads that only fork, widen, or merge at a small angle have none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import scipy

from gis_radar.base import Floats, Integers, ranges
from gis_radar.hdmap import SAME_LEVEL_M, Lane, quads

_SOON_M = 30.0  # from the begin of a way through a junction, within which it meets another one
_MEET_M = 1.0  # between the middles of ways that meet; lanes side by side are over 2 m apart
_ALIKE = math.cos(math.radians(30.0))  # least cosine of the angle between directions that are alike
_POINT_M = 0.5  # between points of a middle


class _Points(NamedTuple):
    """Points of the middles of lanelets: places, directions, metres along, heights; and whose."""

    lanelet: Integers
    place: Floats
    direction: Floats
    along_m: Floats
    height_m: Floats


def presumed_lines_m(
    tiles: gpd.GeoDataFrame, lanes: Sequence[Lane], after: Sequence[tuple[int, ...]],
    stop_line_m: Floats,
) -> Floats:  # fmt: skip
    """Return the metres along each lane to its presumed stop line; NaN where it has none.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    lanes : sequence of Lane
        Their lanes.
    after : sequence of tuples of int
        Positions of the lanes that follow each.
    stop_line_m : (n,) array
        Metres along each lane to the stop line that the map draws; NaN where it draws none. Where
        it draws one before a junction, it draws all: the other ways have right of way.
    """
    points, length_m = _points_of(tiles, lanes)
    first = np.cumsum([0, *(len(each.lanelets) for each in lanes)])
    lane = np.repeat(np.arange(len(lanes)), np.diff(first))
    end_m = np.cumsum(length_m)
    end_m -= (end_m - length_m)[first[lane]]
    following = [
        [k + 1] if k + 1 < first[lane[k] + 1] else first[[*after[lane[k]]]].tolist()
        for k in range(len(lane))
    ]
    left_m, behind_line = end_m - stop_line_m[lane], set[int]()
    for k in np.flatnonzero((left_m >= 0.0) & (left_m < length_m)).tolist():
        ahead = _ahead(k, following, length_m).items()
        behind_line |= {way for way, far_m in ahead if left_m[k] + far_m <= _SOON_M}
    waits = _waiting(following, length_m, _meetings(points, len(lane)), behind_line)
    line_m = np.full(len(lanes), np.nan)
    line_m[lane[waits]] = end_m[waits]  # the last one of a lane
    return np.where(np.isnan(stop_line_m), line_m, np.nan)


def _waiting(
    following: Sequence[Sequence[int]], length_m: Floats, met: Sequence[Mapping[int, float]],
    behind_line: set[int],
) -> Integers:  # fmt: skip
    """Return the lanelets at whose end vehicles wait before a junction."""
    ahead = [_ahead(k, following, length_m) for k in range(len(following))]
    before = list[int]()
    for k, ways in enumerate(ahead):
        others = {
            other for way, far_m in ways.items() if way != k
            for other, along_m in met[way].items() if far_m + along_m <= _SOON_M
        } - ways.keys()  # fmt: skip
        if others and not others & behind_line and not met[k].keys() - ways.keys():
            before.append(k)
    # where roads fork in a junction, they do so at its begin, else the last lanelet counts
    inside = {
        way for k in before if len(following[k]) > 1
        for way, far_m in ahead[k].items() if way != k and far_m + length_m[way] <= _SOON_M
    }  # fmt: skip
    before = [k for k in before if k not in inside]
    passed = {k for k in before if len(following[k]) == 1 and following[k][0] in before}
    return np.array([k for k in before if k not in passed], np.int64)


def _points_of(tiles: gpd.GeoDataFrame, lanes: Sequence[Lane]) -> tuple[_Points, Floats]:
    """Return the points of all lanelets, numbered in the order of lanes, and their lengths."""
    rows = np.concatenate([each.rows for each in lanes])
    number = {ref: k for k, ref in enumerate(ref for each in lanes for ref in each.lanelets)}
    lanelet = np.array([number[ref] for ref in tiles["lanelet_id"].to_numpy()[rows].tolist()])
    corners = quads(tiles)[rows]
    begin, end = ((corners[:, i] + corners[:, j]) / 2.0 for i, j in ((0, 3), (1, 2)))
    s_m, tile_m = (tiles[name].to_numpy(np.float64)[rows] for name in ("s_m", "length_m"))
    count = np.ceil(tile_m / _POINT_M).astype(np.int64)
    tile = np.repeat(np.arange(len(rows)), count)
    part = ranges(np.zeros(len(rows), np.int64), count) / count[tile]
    way = end - begin
    direction = way / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    length_m = np.zeros(len(number))
    np.maximum.at(length_m, lanelet, s_m + tile_m)
    height_m = tiles["height_m"].to_numpy(np.float64)[rows]
    return _Points(
        lanelet[tile], begin[tile] + part[:, None] * way[tile], direction[tile],
        s_m[tile] + part * tile_m[tile], height_m[tile],
    ), length_m  # fmt: skip


def _meetings(points: _Points, count: int) -> list[dict[int, float]]:
    """Return where each lanelet first meets others, m from its begin: those that lead elsewhere."""
    low = points.place.min(axis=0)
    soon = np.flatnonzero(points.along_m <= _SOON_M)
    tree, whole = (scipy.spatial.cKDTree(each - low) for each in (points.place[soon], points.place))
    near = tree.query_ball_tree(whole, _MEET_M)
    of = np.repeat(soon, [len(each) for each in near])
    other = np.concatenate([np.zeros(0, np.int64), *(np.array(each, np.int64) for each in near)])
    begin = np.searchsorted(points.lanelet, points.lanelet[of])
    alike = (points.direction[begin] * points.direction[other]).sum(axis=1) > _ALIKE
    apart = np.abs(points.height_m[of] - points.height_m[other]) > SAME_LEVEL_M
    met: list[dict[int, float]] = [{} for _ in range(count)]
    for i, k in np.stack([of, other])[:, ~alike & ~apart].T.tolist():
        met[points.lanelet[i]].setdefault(int(points.lanelet[k]), float(points.along_m[i]))
    return met


def _ahead(start: int, following: Sequence[Sequence[int]], length_m: Floats) -> dict[int, float]:
    """Return the lanelets that begin soon after the end of one, and how far, m; and itself."""
    far_m, waiting = {start: 0.0}, [start]
    while waiting:
        at = waiting.pop()
        for each in following[at]:
            begins_m = far_m[at] + (float(length_m[at]) if at != start else 0.0)
            if begins_m <= _SOON_M + _MEET_M and begins_m < far_m.get(each, math.inf):
                far_m[each] = begins_m
                waiting.append(each)
    return far_m

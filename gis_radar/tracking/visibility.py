"""Visibility: tiles that are observed, and not hidden by other vehicles for too long.

Other vehicles hide a tile from a sensor where the line of sight to its centre, a little over the
road, crosses the box of a vehicle that does not occupy the tile itself; of several sensors that
observe it, all have to be hidden. A step that is not observed ends the time for which it is hidden.
A long vehicle hides as the rectangle of its length. Radar waves that pass under a car are
neglected: they give some detections from behind it, but not reliably.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers, compiled
from gis_radar.measures import PoseSight
from gis_radar.poses import Pose
from gis_radar.scans import TARGET_M
from gis_radar.tracking.footprints import MOST_PARTS, CrossLines, Footprints, clip_box, is_occupied

HIDDEN_S = 10.0  # a tile stays visible for so long while other vehicles hide it (the contract)
# A run of visible steps is split into seen and unseen where other vehicles hide the tile for so
# long: a passing vehicle hides it for less, through which tracks continue.
_UNSEEN_S = 1.0
# Steps between two checks of the lines of sight, which are also checked when sensors change: a
# vehicle at 15 m/s moves 3 m in 0.2 s, which is little against 10 s of hiding.
CHECK_STEPS = 4
# Height of a sensor over the road where tiles have no heights: a mast or a signal head stands 4 to
# 6 m high.
_SENSOR_OVER_ROAD_M = 5.0
BINS = 720  # bins of azimuth around a sensor: half a degree, a tenth of a car at 20 m


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Lines of sight from a pose, by azimuth and range.

    Parameters
    ----------
    sensor : (4,) array
        x, y from the origin of the cross-lines, height of the sensor, height of the road below.
    first : (BINS + 1,) int64 array
        Index of the first ray in each bin of azimuth.
    tile : (n,) int64 array
        Positions of the tiles.
    ends : (n, 4) array
        x, y, height of the target, and its distance in the plane, metres.
    lowest_m : float
        Least height of the targets, metres.
    """

    sensor: Floats
    first: Integers
    tile: Integers
    ends: Floats
    lowest_m: float

    @classmethod
    def of(cls, pose: Pose, tile: Integers, targets: Floats, origin: Floats) -> Rays:
        """Return the rays to some tiles, whose (n, 3) targets may have unknown heights."""
        x, y = pose.position[:2] - origin
        height = float(pose.position[2])
        road_m = height - _SENSOR_OVER_ROAD_M
        if np.isfinite(targets[:, 2]).any():
            road_m = float(np.nanmedian(targets[:, 2]))
        level = np.where(np.isnan(targets[:, 2]), road_m, targets[:, 2]) + TARGET_M
        apart = targets[:, :2] - (x, y)
        range_m = np.hypot(*apart.T)
        turn = np.arctan2(apart[:, 1], apart[:, 0]) % (2 * math.pi)
        place = np.minimum((turn * BINS / (2 * math.pi)).astype(np.int64), BINS - 1)
        order = np.lexsort((range_m, place))
        ends = np.column_stack([targets[:, :2], level, range_m])[order]
        first = np.searchsorted(place[order], np.arange(BINS + 1))
        lowest_m = float(level.min()) if len(level) else road_m
        sensor = np.array([x, y, height, road_m])
        return cls(sensor=sensor, first=first, tile=tile[order], ends=ends, lowest_m=lowest_m)


class Visibility:
    """Runs of visible tiles, from footprints and frames that come in ascending time.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    lines : CrossLines
        Cross-lines of the tiles.
    sights : mapping
        Sights of the sensors' poses, by name.
    """

    def __init__(
        self, tiles: gpd.GeoDataFrame, lines: CrossLines, sights: Mapping[str, PoseSight]
    ) -> None:
        self._lines = lines
        self._tile_id = tiles["tile_id"].to_numpy(np.int64)
        middle = shapely.get_coordinates(shapely.centroid(tiles.geometry.array)) - lines.origin
        self._targets = np.column_stack([middle, lines.height_m])
        self._sights, self._rays = sights, dict[str, Rays]()
        count = len(tiles)
        self._hidden = np.zeros(count, np.int64)  # hidden steps in a row
        self._begun = np.full(count, -1)  # first step of an open run
        self._seen = np.ones(count, np.bool_)  # whether its steps are not hidden
        self._stamps = np.full((count, 3), -1)
        self._reached = -1
        self._checked = -1  # step of the latest check of lines of sight with the same sights
        self._active: list[str] = []
        self._ended: list[Integers] = []

    def advance(
        self, footprints: Footprints, height_m: Floats, valid_runs: pd.DataFrame,
        span: tuple[int, int], queries: tuple[Integers, Integers],
    ) -> Booleans:  # fmt: skip
        """Advance over a span, whose end is exclusive.

        Parameters
        ----------
        footprints : Footprints
            Footprints of the span.
        height_m : (n,) array
            Height of the vehicle of each, metres.
        valid_runs : DataFrame
            `sight, first_step, last_step`: runs of steps in which frames are valid.
        span : (int, int)
            First step, and the step after the last.
        queries : (step, tile)
            (q,) int64 arrays: steps, ascending, of the span or the last one before it, and
            positions of tiles.

        Returns
        -------
        (q,) bool array
            Whether the tile was visible in the step.
        """
        step, tile = queries
        answers = np.zeros(len(step), np.bool_)
        before = step < span[0]
        answers[before] = (self._begun[tile[before]] >= 0) & (step[before] == self._reached)
        if span[0] != self._reached + 1:
            self._end_runs(np.flatnonzero(self._begun >= 0))
            self._active = []
            self._hidden[:] = 0
        for begin, after, active in _segments(valid_runs, span):
            rays = [self._rays_of(name) for name in active]
            observed = np.zeros(len(self._hidden), np.int64)
            for each in rays:
                observed[each.tile] += 1
            if active != self._active:
                self._active, self._checked = active, -1
            self._reached = begin - 1
            self._end_runs(np.flatnonzero((self._begun >= 0) & (observed == 0)))
            self._hidden[observed == 0] = 0
            low, high = np.searchsorted(footprints.step, [begin, after])
            first, last = np.searchsorted(step, [begin, after])
            self._advance_steps(
                footprints, height_m, rays, observed, (begin, after, int(low), int(high)),
                (step[first:last], tile[first:last], answers[first:last]),
            )  # fmt: skip
            self._reached = after - 1
        return answers

    def _advance_steps(
        self, footprints: Footprints, height_m: Floats, rays: list[Rays], observed: Integers,
        part: tuple[int, int, int, int], queries: tuple[Integers, Integers, Booleans],
    ) -> None:  # fmt: skip
        """Advance over a part of a span in which the same sights are observed."""
        if not rays:
            return
        begin, after, low, high = part
        offsets = np.cumsum([0, *(len(each.tile) for each in rays)])
        self._ended.append(
            _watch_steps(
                begin, after,
                footprints.step[low:high], footprints.boxes[low:high],
                footprints.level_m[low:high], height_m[low:high], footprints.path[low:high],
                footprints.points, footprints.begins, self._lines.lines,
                np.stack([each.sensor for each in rays]),
                np.stack([o + each.first for o, each in zip(offsets, rays, strict=False)]),
                np.concatenate([each.tile for each in rays]),
                np.concatenate([each.ends for each in rays]),
                np.array([each.lowest_m for each in rays]),
                observed, np.flatnonzero(observed), self._hidden, self._begun, self._seen,
                self._stamps, round(HIDDEN_S * STEPS_PER_SECOND),
                round(_UNSEEN_S * STEPS_PER_SECOND), CHECK_STEPS, self._checked, *queries,
            )
        )  # fmt: skip
        first_check = begin if self._checked < 0 else self._checked
        self._checked = max(first_check, (after - 1) // CHECK_STEPS * CHECK_STEPS)

    def flush(self) -> Integers:
        """End all runs at the last step so far; return those since the last call, (n, 4).

        The columns are tile, first and last step, and whether nothing hid the tile in these steps.
        """
        self._end_runs(np.flatnonzero(self._begun >= 0))
        found = np.concatenate([np.empty((0, 4), np.int64), *self._ended])
        self._ended = []
        return found

    def _end_runs(self, tile: Integers) -> None:
        """End the runs of some tiles at the last step so far."""
        begun = self._begun[tile]
        reached = np.full(len(tile), self._reached)
        self._ended.append(np.column_stack([tile, begun, reached, self._seen[tile]]))
        self._begun[tile], self._seen[tile] = -1, True

    def _rays_of(self, name: str) -> Rays:
        """Return the lines of sight of a sight, made once."""
        if name not in self._rays:
            seen = self._sights[name]
            tile = np.searchsorted(self._tile_id, seen.tile_id)
            self._rays[name] = Rays.of(seen.pose, tile, self._targets[tile], self._lines.origin)
        return self._rays[name]


def _segments(valid_runs: pd.DataFrame, span: tuple[int, int]) -> list[tuple[int, int, list[str]]]:
    """Return the parts of a span in which the same sights are observed, with their names."""
    begin = valid_runs["first_step"].to_numpy(np.int64)
    after = valid_runs["last_step"].to_numpy(np.int64) + 1
    kept = (after > span[0]) & (begin < span[1])
    begin, after = np.maximum(begin[kept], span[0]), np.minimum(after[kept], span[1])
    names = valid_runs["sight"][kept].tolist()
    edges = np.unique([*begin, *after, *span])
    active: dict[int, set[str]] = {edge: set() for edge in edges.tolist()}
    starts, ends = np.searchsorted(edges, begin), np.searchsorted(edges, after)
    for name, start, end in zip(names, starts.tolist(), ends.tolist(), strict=True):
        for edge in edges[start:end].tolist():
            active[edge].add(name)
    found: list[tuple[int, int, list[str]]] = []
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        sights = sorted(active[low])
        if found and found[-1][2] == sights:
            found[-1] = (found[-1][0], high, sights)
        else:
            found.append((low, high, sights))
    return found


@compiled
def _crosses(
    sensor: Floats, end: Floats, box: Floats, bottom_m: float, top_m: float
) -> bool:  # pragma: no cover - compiled
    """Return whether a line of sight crosses a box that does not contain its end."""
    low, high = clip_box(
        sensor[0], sensor[1], end[0], end[1], box[0], box[1], box[2], box[3], box[4], box[5]
    )
    if high <= low or high >= 1.0:
        return False
    one, other = sensor[2] + low * (end[2] - sensor[2]), sensor[2] + high * (end[2] - sensor[2])
    return bool(min(one, other) < top_m and max(one, other) > bottom_m)


@compiled
def _azimuths(sensor: Floats, box: Floats) -> tuple[float, float, float, float]:  # pragma: no cover
    """Return the range of azimuths of a box, in bins, and the range of its distances."""
    x, y = box[0] - sensor[0], box[1] - sensor[1]
    apart, reach = math.sqrt(x * x + y * y), math.sqrt(box[4] * box[4] + box[5] * box[5])
    if apart <= reach:
        return 0.0, BINS - 1.0, 0.0, apart + reach
    middle = math.atan2(y, x)
    low = high = 0.0
    for along in (-box[4], box[4]):
        for left in (-box[5], box[5]):
            corner_x = x + along * box[2] - left * box[3]
            corner_y = y + along * box[3] + left * box[2]
            turn = math.atan2(corner_y, corner_x) - middle
            turn -= 2 * math.pi * round(turn / (2 * math.pi))
            low, high = min(low, turn), max(high, turn)
    per = BINS / (2 * math.pi)
    return (middle + low) * per, (middle + high) * per, apart - reach, apart + reach


@compiled
def _cast_shadow(  # noqa: PLR0917
    sensor: Floats, first: Integers, ray_tile: Integers, ends: Floats, lowest_m: float,
    box: Floats, level_m: float, height_m: float, path: int, points: Floats, begins: Booleans,
    lines: Floats, stamps: Integers, step: int, mark: int, shares: Floats,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Count in `stamps` from how many sensors each tile is hidden by a box.

    Its columns are the step of the count, the number of sensors, and the mark of the last one.
    """
    low, high, nearest, farthest = _azimuths(sensor, box)
    bottom = sensor[3] if math.isnan(level_m) else level_m
    top = bottom + height_m
    limit = np.inf
    if sensor[2] > top:  # beyond, the lines of sight pass above the box
        limit = farthest * max(1.0, (sensor[2] - lowest_m) / (sensor[2] - top))
    for turn in range(math.floor(low), math.floor(high) + 1):
        place = turn % BINS
        k, after = first[place], first[place + 1]
        k += np.searchsorted(ends[k:after, 3], nearest)
        while k < after and ends[k, 3] <= limit:
            tile = ray_tile[k]
            if (
                not (stamps[tile, 0] == step and stamps[tile, 2] == mark)
                and _crosses(sensor, ends[k], box, bottom, top)
                and not is_occupied(lines[tile], box, path, points, begins, shares)
            ):
                if stamps[tile, 0] != step:
                    stamps[tile, 0], stamps[tile, 1] = step, 0
                stamps[tile, 1] += 1
                stamps[tile, 2] = mark
            k += 1


@compiled
def _watch_steps(  # noqa: C901, PLR0912, PLR0917 - calls between compiled functions cost
    begin: int, after: int, step: Integers, boxes: Floats, level_m: Floats, height_m: Floats,
    path: Integers, points: Floats, begins: Booleans, lines: Floats, sensors: Floats,
    first: Integers, ray_tile: Integers, ends: Floats, lowest_m: Floats, observed: Integers,
    watched: Integers, hidden: Integers, begun: Integers, seen: Booleans, stamps: Integers,
    most: int, least: int, every: int, checked: int, query_step: Integers,
    query_tile: Integers, answers: Booleans,
) -> Integers:  # pragma: no cover - compiled  # fmt: skip
    """Process steps in which the same views are observed; return the runs that ended."""
    out = np.empty((1024, 4), np.int64)
    shares = np.empty((2 * MOST_PARTS, 2))
    done = state = query = 0
    for now in range(begin, after):
        low = state
        while state < len(step) and step[state] == now:
            state += 1
        if checked < 0 or now % every == 0:
            checked = now
        for view in range(len(sensors) if checked == now else 0):
            for k in range(low, state):
                _cast_shadow(
                    sensors[view], first[view], ray_tile, ends, lowest_m[view],
                    boxes[k], level_m[k], height_m[k], path[k], points, begins,
                    lines, stamps, now, view, shares,
                )  # fmt: skip
        for tile in watched:
            if stamps[tile, 0] == checked and stamps[tile, 1] == observed[tile]:
                hidden[tile] += 1
            else:
                hidden[tile] = 0
            if begun[tile] < 0:
                if hidden[tile] <= most:
                    begun[tile], seen[tile] = now, hidden[tile] < least
                continue
            if seen[tile] and hidden[tile] >= least:
                change = max(now + 1 - least, begun[tile])
            elif hidden[tile] > most or (not seen[tile] and hidden[tile] == 0):
                change = now
            else:
                continue
            if change > begun[tile]:
                if done == len(out):
                    wider = np.empty((2 * len(out), 4), np.int64)
                    wider[:done] = out
                    out = wider
                out[done, 0], out[done, 1], out[done, 2] = tile, begun[tile], change - 1
                out[done, 3] = seen[tile]
                done += 1
            begun[tile] = -1 if hidden[tile] > most else change
            seen[tile] = hidden[tile] == 0
        while query < len(query_step) and query_step[query] == now:
            answers[query] = begun[query_tile[query]] >= 0
            query += 1
    return out[:done].copy()  # its end is empty

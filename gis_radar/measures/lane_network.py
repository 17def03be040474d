"""The network of lanes for measures: lines at which vehicles are counted, and following lanes.

Junctions are found from the order of lanes. A *connector* leads from a branch to a merge and has no
stop line. A *turn* leads from a lane to the next one that is no connector: over connectors, or
directly where the lane has a stop line (its lanelets then reach through the junction) or where
roads branch and merge without one. If one way on from a lane is a turn, all are; if a lane only
widens into lanes with stop lines, none is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.hdmap import joining, lanes_of, quads
from gis_radar.measures.presumed_lines import presumed_lines_m

_JOIN_M = 0.5  # largest distance from the middle of a lane's end to that of the next one's begin
_QUEUE_REACH_M = 500.0  # distance from the stop line up to which queues are followed
DRAWN, PRESUMED = "drawn", "presumed"  # stop lines: of the map; where it draws none
# Longest road without a vehicle within a queue, or before it: two cars. Road that vehicles hide
# does not count.
JOINED_M = 10.0


class Turn(NamedTuple):
    """A way from a lane to the next over the connectors `via`; all are positions of lanes."""

    start: int
    end: int
    via: tuple[int, ...]


class QueueStrips(NamedTuple):
    """Lanes on which a queue at a stop line may stand, sorted by stop line and distance from it.

    Parameters
    ----------
    lane, stop_lane : (k,) int64 arrays
        Positions of the lane, and of the lane with the stop line.
    ahead : (k,) int64 array
        Strip that follows towards the line; -1 at the line.
    to_line_m : (k,) array
        Distance from the begin of the lane to the stop line, metres.
    """

    lane: Integers
    stop_lane: Integers
    ahead: Integers
    to_line_m: Floats

    def of_stop(self, stop: int) -> range:
        """Return the strips of a stop line."""
        return range(*np.searchsorted(self.stop_lane, [stop, stop + 1]).tolist())

    def path_to(self, strip: int) -> Integers:
        """Return the strips from the stop line back to a strip, both included."""
        strips = [strip]
        while strips[-1] >= 0:
            strips.append(int(self.ahead[strips[-1]]))
        return np.array(strips[-2::-1], np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneNetwork:
    """Lanes with their tiles.

    Parameters
    ----------
    lane : (n,) int64 array
        Numbers of the lanes, ascending.
    length_m : (n,) array
        Lengths along the middle.
    line_m : (n,) array
        Place along the lane at which vehicles are counted: its stop line, else its middle.
    has_stop_line : (n,) bool array
        Whether that is a stop line of the map.
    queue_line_m : (n,) array
        Place along the lane from which queues are measured: the map's stop line, else the presumed
        one; NaN where there is neither.
    free_speed : (n,) array
        Speed without other traffic, m/s; NaN where unknown.
    lanelet_id, lanelet_lane : (m,) int64 arrays
        Lanelets, ascending, and the positions of their lanes.
    offset_m : (m,) array
        Place along its lane at which a lanelet begins.
    tile_id, tile_lane : (t,) int64 arrays
        Tiles in the order of lanes and along them, and the positions of their lanes.
    tile_m, tile_length_m : (t,) arrays
        Place along its lane at which a tile begins, and its length.
    after : sequence of tuples of int
        Positions of the lanes that follow each.
    """

    lane: Integers
    length_m: Floats
    line_m: Floats
    has_stop_line: Booleans
    queue_line_m: Floats
    free_speed: Floats
    lanelet_id: Integers
    lanelet_lane: Integers
    offset_m: Floats
    tile_id: Integers
    tile_lane: Integers
    tile_m: Floats
    tile_length_m: Floats
    after: Sequence[tuple[int, ...]]

    @classmethod
    def of(
        cls,
        tiles: gpd.GeoDataFrame,
        stop_line_m: Mapping[int, float] | None = None,
        free_speed_kmh: Mapping[int, float] | None = None,
    ) -> LaneNetwork:
        """Return the network of tiles.

        Parameters
        ----------
        tiles : GeoDataFrame
            All tiles.
        stop_line_m, free_speed_kmh : mapping, optional
            By number of the lane: place of its stop line, m along it, and its speed without other
            traffic, km/h; NaN or missing where there is none.
        """
        lanes = lanes_of(tiles)
        s_m, tile_length = (tiles[name].to_numpy(np.float64) for name in ("s_m", "length_m"))
        lanelet = tiles["lanelet_id"].to_numpy(np.int64)
        rows = np.concatenate([each.rows for each in lanes])
        lane_of_row = np.repeat(np.arange(len(lanes)), [len(each.rows) for each in lanes])
        ends = pd.Series((s_m + tile_length)[rows]).groupby(lanelet[rows]).max()
        offset = _offsets([each.lanelets for each in lanes], ends)
        length = np.array([sum(ends[ref] for ref in each.lanelets) for each in lanes], np.float64)
        number = np.array([each.number for each in lanes], np.int64)
        stop = np.clip(_values_by_lane(number, stop_line_m), 0.0, length)
        after = _after(tiles, [each.rows for each in lanes])
        presumed = presumed_lines_m(tiles, lanes, after, stop)
        ids = np.array(sorted(offset), np.int64)
        lane_of = dict(zip(lanelet[rows].tolist(), lane_of_row.tolist(), strict=True))
        return cls(
            lane=number, length_m=length, has_stop_line=np.isfinite(stop),
            line_m=np.where(np.isfinite(stop), stop, length / 2.0),
            queue_line_m=np.where(np.isfinite(stop), stop, presumed),
            free_speed=_values_by_lane(number, free_speed_kmh) / 3.6,
            lanelet_id=ids, lanelet_lane=np.array([lane_of[ref] for ref in ids.tolist()], np.int64),
            offset_m=np.array([offset[ref] for ref in ids.tolist()], np.float64),
            tile_id=tiles["tile_id"].to_numpy(np.int64)[rows], tile_lane=lane_of_row,
            tile_m=s_m[rows] + np.array([offset[ref] for ref in lanelet[rows].tolist()]),
            tile_length_m=tile_length[rows], after=after,
        )  # fmt: skip

    def place(self, lanelet_id: Integers, s_m: Floats) -> tuple[Integers, Floats]:
        """Return the lane's position and the metres along it, for places along lanelets.

        They are -1 and NaN for lanelets that are not in the network.
        """
        at = np.minimum(np.searchsorted(self.lanelet_id, lanelet_id), len(self.lanelet_id) - 1)
        known = (self.lanelet_id[at] == lanelet_id) & np.isfinite(s_m)
        lane = np.where(known, self.lanelet_lane[at], -1)
        along = np.clip(self.offset_m[at] + s_m, 0.0, self.length_m[lane])
        return lane, np.where(known, along, np.nan)

    def tile_at(self, lane: Integers, along_m: Floats) -> Integers:
        """Return the position of the tile at each place on a lane; -1 where `lane` is -1."""
        room = float(self.length_m.max()) + 1.0
        inside = np.nan_to_num(along_m)
        keys = self.tile_lane * room + self.tile_m
        tile = np.searchsorted(keys, np.maximum(lane, 0) * room + inside, side="right") - 1
        first = np.searchsorted(self.tile_lane, np.maximum(lane, 0))
        return np.where(lane >= 0, np.maximum(tile, first), -1)

    @property
    def stop_line(self) -> list[str | None]:
        """Kind of the stop line of each lane, `drawn` or `presumed`; None without one."""
        return [
            DRAWN if is_drawn else None if math.isnan(at_m) else PRESUMED
            for is_drawn, at_m in zip(self.has_stop_line, self.queue_line_m, strict=True)
        ]

    @property
    def connector(self) -> Booleans:
        """Mask of the connectors: from a branch to a merge, without a stop line."""
        before = self.before
        return np.array(
            [
                not self.has_stop_line[k]
                and any(len(self.after[each]) > 1 for each in before[k])
                and any(len(before[each]) > 1 for each in self.after[k])
                for k in range(len(self.lane))
            ],
            np.bool_,
        )

    @property
    def before(self) -> list[list[int]]:
        """Positions of the lanes that lead to each."""
        leading: list[list[int]] = [[] for _ in self.lane]
        for k, following in enumerate(self.after):
            for each in following:
                leading[each].append(k)
        return leading

    def turns(self) -> list[Turn]:
        """Return the turns, by start and end."""
        connector, turns = self.connector, list[Turn]()
        for start in np.flatnonzero(~connector).tolist():
            paths: list[tuple[int, tuple[int, ...]]] = [(each, ()) for each in self.after[start]]
            seen, ends = {start}, dict[int, Turn]()
            while paths:
                lane, via = paths.pop(0)
                if connector[lane] and lane not in seen:
                    seen.add(lane)
                    paths += [(each, (*via, lane)) for each in self.after[lane]]
                elif not connector[lane] and (lane not in ends or (via and not ends[lane].via)):
                    ends[lane] = Turn(start, lane, via)
            if any(each.via or self._is_turn(start, each.end) for each in ends.values()):
                turns += [ends[end] for end in sorted(ends)]
        return turns

    def _is_turn(self, start: int, end: int) -> bool:
        """Return whether a lane that follows without connector is a turn, not one fanning out."""
        return bool(self.has_stop_line[start] or not self.has_stop_line[end])

    @cached_property
    def queue_strips(self) -> QueueStrips:
        """Lanes on which queues may stand: back to other stop lines, or 500 m.

        Presumed lines end only queues at presumed lines.
        """
        before, rows = self.before, list[tuple[int, int, int, float]]()
        has_any = np.isfinite(self.queue_line_m)
        for stop in np.flatnonzero(has_any).tolist():
            ends = self.has_stop_line if self.has_stop_line[stop] else has_any
            waiting, seen = [(float(self.queue_line_m[stop]), stop, -1)], set[int]()
            while waiting:
                to_line, lane_at, ahead = heappop(waiting)
                if lane_at in seen:
                    continue
                seen.add(lane_at)
                rows.append((lane_at, stop, ahead, to_line))
                if to_line < _QUEUE_REACH_M:
                    for k in before[lane_at]:
                        if not ends[k]:
                            further = to_line + float(self.length_m[k])
                            heappush(waiting, (further, k, len(rows) - 1))
        lane, stop_lane, ahead_of, metres = zip(*rows, strict=True) if rows else ((), (), (), ())
        return QueueStrips(
            np.array(lane, np.int64), np.array(stop_lane, np.int64), np.array(ahead_of, np.int64),
            np.array(metres, np.float64),
        )  # fmt: skip

    def sight_m(self, tile_id: Integers) -> Floats:
        """Return how far before its stop line each lane is in sight.

        Parameters
        ----------
        tile_id : (k,) int64 array
            Tiles in sight.

        Returns
        -------
        (n,) array
            Metres from the stop line to the farthest tile in sight that a queue can reach, as one
            does not go on over more than `JOINED_M` out of sight; NaN for lanes without a stop
            line, drawn or presumed. Where lanes merge before the line, the way that is in sight
            farthest counts.
        """
        strips, in_sight = self.queue_strips, np.isin(self.tile_id, tile_id)
        far = np.where(np.isfinite(self.queue_line_m), 0.0, np.nan)
        # by strip: how far sight reaches, and whether no gap has ended it
        reached = {-1: (0.0, True)}
        for strip, (lane, ahead) in enumerate(zip(strips.lane, strips.ahead, strict=True)):
            reach, is_open = reached[int(ahead)]
            if is_open:
                first, last = np.searchsorted(self.tile_lane, [lane, lane + 1])
                seen = first + np.flatnonzero(in_sight[first:last])[::-1]
                away = strips.to_line_m[strip] - self.tile_m[seen]
                near = np.maximum(away - self.tile_length_m[seen], 0.0)
                away, near = away[away > 0.0], near[away > 0.0]
                wide = near - np.append(reach, away)[: len(away)] > JOINED_M
                joined = away[: np.argmax(wide)] if wide.any() else away
                reach, is_open = max(reach, joined.max(initial=0.0)), not wide.any()
            reached[strip] = reach, is_open
            far[strips.stop_lane[strip]] = max(far[strips.stop_lane[strip]], reach)
        return far


def _offsets(chains: Sequence[Sequence[int]], ends: pd.Series) -> dict[int, float]:
    """Return, by lanelet, the metres along its lane at which it begins."""
    offsets = {}
    for chain in chains:
        begin_m = 0.0
        for ref in chain:
            offsets[ref] = begin_m
            begin_m += float(ends[ref])
    return offsets


def _values_by_lane(lane: Integers, values: Mapping[int, float] | None) -> Floats:
    known = values or {}
    return np.array([known.get(each, math.nan) for each in lane.tolist()], np.float64)


def _after(tiles: gpd.GeoDataFrame, rows: Sequence[Integers]) -> list[tuple[int, ...]]:
    """Return, for each lane, the positions of the lanes that begin at its end in its direction."""
    corners = quads(tiles)
    starts = np.array([corners[each[0]][[3, 0]].ravel() for each in rows])
    ends = np.array([corners[each[-1]][[2, 1]].ravel() for each in rows])
    return [tuple(found) for found in joining(starts, ends, _JOIN_M)]

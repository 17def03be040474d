"""Compare sight with what moves in a recording.

A scan shows what stood when it was flown. Two findings contradict it: directions in which nothing
ever moves although vehicles pass there (a wall built since), and hidden tiles with as much movement
as others (a house pulled down). The movement to expect on a tile follows from its distance and from
the movement elsewhere on its lanelet, seen by any sensor: counts are fitted as the product of a
range profile of each sensor and a flow of each lanelet. Ghosts of facades, and lorries visible over
a wall, amount to a small share of that.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Reporter, Text
from gis_radar.scans.sight.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW, Sight
from gis_radar.scans.sight.tiles import SightTiles

Table: TypeAlias = Floats  # sums by direction and distance from a sensor
CAR_REFLECTION_M = 1.0  # over the road: between the sills and the roof of a car
# Least absolute range rate of movement, over that of leaves and most walkers; and farthest height
# from CAR_REFLECTION_M over a tile's road: detections beyond are of another level.
MOVEMENT_MPS, MOVEMENT_LEVEL_M = 1.0, 2.5
# Size of the cells in which recorded movement is compared with sight: a sector is wider than a
# radar's bearing error and narrower than a house, a ring is as long as the least driveway.
_SECTOR_DEG, _RING_M = 1.0, 10.0
_SECTORS_IN_ROW = 3  # least width of a contradiction: a single one is an edge with bearing errors
# A cell is empty below this share of the expected movement (ghosts of facades are a tenth at most),
# if so many frames with movement are expected in it and beyond.
_EMPTY_SHARE, _LEAST_IN_SECTOR = 0.1, 2.0
# Least frames with movement that are missing, or seen though hidden, in a run of sectors: half a
# dozen vehicles, each seen in several frames of several sectors.
_LEAST_FRAMES = 100.0
# Least frames from one place for a comparison: five minutes at 20 Hz, three cycles of a signal. In
# less time lanes stay empty by chance.
JUDGED_FRAMES = 6000
# Least share of the expected movement that contradicts `hidden`: ghosts, and lorries visible over a
# wall, give less.
_MOVING_SHARE = 0.3
_ROUNDS = 8  # of the fit of profiles and flows; four give the same tiles


@dataclass(frozen=True, kw_only=True)
class MovingHits:
    """Numbers of frames with movement on each tile, by one sensor from one pose.

    Parameters
    ----------
    sight : Sight
        Sight of the sensor from that pose.
    count : (n,) int64 array
        Number of frames with a moving detection on each tile, in the order of the tiles.
    frames : int
        Number of all frames from that pose.
    """

    sight: Sight
    count: Integers = field(repr=False)
    frames: int


@dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Tiles on which a recording contradicts sight.

    Parameters
    ----------
    sight : Sight
        Sight of the sensor from one pose.
    no_movement, movement : (n,) bool array
        Tiles in sight without the expected movement; hidden tiles with movement.
    """

    sight: Sight
    no_movement: Booleans = field(repr=False)
    movement: Booleans = field(repr=False)


def find_contradictions(hits: Sequence[MovingHits], tiles: SightTiles) -> list[Contradiction]:
    """Find where recordings contradict sight.

    Parameters
    ----------
    hits : sequence of MovingHits
        Movement by sensor and pose; that of all sensors gives the flow on lanelets.
    tiles : SightTiles
        The tiles of all sights.

    Returns
    -------
    list of Contradiction
        One for each of the hits, in order.
    """
    _, lanelet = np.unique(tiles.lanelet_id, return_inverse=True)
    polar = [_Polar.of(each.sight, tiles) for each in hits]
    fitted = [each.sight.state == IN_SIGHT for each in hits]
    contradictions: list[Contradiction] = []
    for _ in range(2):  # in the first round, tiles that are hidden in fact make the flow too low
        expected = _expected(hits, polar, fitted, lanelet)
        contradictions = [
            _compare(each, place, wanted)
            for each, place, wanted in zip(hits, polar, expected, strict=True)
        ]
        fitted = [
            tiles_fitted & ~each.no_movement
            for tiles_fitted, each in zip(fitted, contradictions, strict=True)
        ]
    return contradictions


def report_contradictions(found: Iterable[Contradiction], reporter: Reporter) -> None:
    """Warn, a line a sensor, of tiles that a recording contradicts."""
    counts: dict[str, list[int]] = {}
    for each in found:
        both = counts.setdefault(each.sight.pose.sensor, [0, 0])
        both[0] += int(np.count_nonzero(each.no_movement))
        both[1] += int(np.count_nonzero(each.movement))
    for sensor, (still, moving) in counts.items():
        parts = []
        if still:
            parts.append(Text("nothing moves on {} tiles in sight where vehicles pass", still))
        if moving:
            parts.append(Text("something moves on {} hidden tiles", moving))
        if parts:
            reporter.warn(
                "the recording of {} contradicts its sight: {}; was it built or pulled "
                "down since the scan, do vehicles stand in the way, or is the pose off?",
                sensor,
                Text("; ").join(parts),
            )


@dataclass(frozen=True, kw_only=True)
class _Polar:
    """Place of each tile in a polar table around a sensor, of sectors and rings.

    `ring` and `sector` are those of the tile, `hidden` is the ring in which its obstacle begins;
    `shape` the numbers of sectors and of rings.
    """

    ring: Integers
    sector: Integers
    hidden: Integers
    shape: tuple[int, int]

    @classmethod
    def of(cls, sight: Sight, tiles: SightTiles) -> _Polar:
        offset = tiles.centres[:, :2] - sight.pose.position[:2]
        range_m = np.hypot(*offset.T)
        turns = round(360.0 / _SECTOR_DEG)
        sector = np.floor(np.degrees(np.arctan2(*offset.T[::-1])) / _SECTOR_DEG) % turns
        seen = range_m[sight.state != OUT_OF_VIEW]
        most = math.ceil((float(seen.max()) if len(seen) else 0.0) / _RING_M) + 1
        ring = np.minimum(range_m / _RING_M, most - 1)
        hidden = np.minimum(np.nan_to_num(sight.hidden_at_m) / _RING_M, most - 1)
        return cls(
            ring=ring.astype(np.int64),
            sector=sector.astype(np.int64),
            hidden=hidden.astype(np.int64),
            shape=(turns, most),
        )

    def table(self, values: Integers | Floats, ring: Integers) -> Table:
        """Return the sums of values by sector and `ring`."""
        key = self.sector * self.shape[1] + ring
        sums = np.bincount(key, values.astype(np.float64), minlength=math.prod(self.shape))
        return np.asarray(sums.reshape(self.shape), np.float64)


def _expected(
    hits: Sequence[MovingHits],
    polar: Sequence[_Polar],
    fitted: Sequence[Booleans],
    lanelet: Integers,
) -> list[Floats]:
    """Return, by sensor, the number of frames with movement to expect on each tile in view."""
    lanelets = int(lanelet.max(initial=-1)) + 1
    flow = np.ones(lanelets)
    profiles = [np.ones(place.shape[1]) for place in polar]
    for _ in range(_ROUNDS):
        counted, modelled = np.zeros(lanelets), np.zeros(lanelets)
        for k, (each, place, rows) in enumerate(zip(hits, polar, fitted, strict=True)):
            ring, lane, count = place.ring[rows], lanelet[rows], each.count[rows]
            rings = place.shape[1]
            seen = np.bincount(ring, count, minlength=rings)
            profiles[k] = _ratio(seen, each.frames * np.bincount(ring, flow[lane], minlength=rings))
            counted += np.bincount(lane, count, minlength=lanelets)
            rate = each.frames * profiles[k][ring]
            modelled += np.bincount(lane, rate, minlength=lanelets)
        flow = _ratio(counted, modelled)
    return [
        each.frames * profile[place.ring] * flow[lanelet] * (each.sight.state != OUT_OF_VIEW)
        for each, place, profile in zip(hits, polar, profiles, strict=True)
    ]


def _ratio(part: Any, whole: Any) -> Floats:
    """Return the ratio of two arrays, 0 where the divisor is not positive."""
    return np.asarray(np.divide(part, whole, out=np.zeros(len(part)), where=whole > 0))


def _compare(hits: MovingHits, polar: _Polar, expected: Floats) -> Contradiction:
    """Return the tiles on which the movement counted by one sensor contradicts sight."""
    in_sight, hidden = hits.sight.state == IN_SIGHT, hits.sight.state == HIDDEN
    empty = _empty_beyond(
        polar.table(hits.count * in_sight, polar.ring),
        polar.table(expected * in_sight, polar.ring),
    )
    counted = polar.table(hits.count * hidden, polar.hidden)
    wanted = polar.table(expected * hidden, polar.hidden)
    moving = (counted > 0) & (wanted > 0) & (counted >= _MOVING_SHARE * wanted)
    visible = _in_wide_runs(moving, np.where(moving, counted, 0.0))
    return Contradiction(
        sight=hits.sight,
        no_movement=in_sight & empty[polar.sector, polar.ring],
        movement=hidden & visible[polar.sector, polar.hidden],
    )


def _empty_beyond(counted: Table, wanted: Table) -> Booleans:
    """Return the cells from which outwards the expected movement is missing."""
    left, missed = _from_far(counted), _from_far(wanted)
    empty = (counted <= _EMPTY_SHARE * wanted) & (wanted > 0)
    empty &= (left <= _EMPTY_SHARE * missed) & (missed >= _LEAST_IN_SECTOR)
    return _in_wide_runs(np.logical_or.accumulate(empty, axis=1), wanted)


def _from_far(table: Table) -> Table:
    """Return, for each cell, the sum over its ring and all farther ones of its sector."""
    return np.asarray(np.cumsum(table[:, ::-1], axis=1)[:, ::-1])


def _in_wide_runs(cells: Booleans, weight: Table) -> Booleans:
    """Return the cells in runs of `_SECTORS_IN_ROW` or more sectors and `_LEAST_FRAMES` weight."""
    with_cells: Booleans = np.any(cells, axis=1)
    turns = len(with_cells)
    first = int(np.argmin(with_cells))  # begin outside a run, which may go on past the last sector
    order = (first + np.arange(turns)) % turns
    run = np.cumsum(~with_cells[order])
    weight_of_sector = np.where(cells, weight, 0.0).sum(axis=1)[order]
    width = np.bincount(run, with_cells[order])
    heavy = np.bincount(run, weight_of_sector * with_cells[order]) >= _LEAST_FRAMES
    kept = np.zeros_like(with_cells)
    kept[order] = with_cells[order] & (heavy & (width >= _SECTORS_IN_ROW))[run]
    return cells & kept[:, None]

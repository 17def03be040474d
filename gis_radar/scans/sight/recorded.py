"""Compare sight with what moves in a recording, and correct what the recording contradicts.

A scan shows what stood when it was flown. Two things contradict it: directions in which nothing
ever moves although vehicles pass there (a wall since the flight), and hidden tiles on which as much
moves as on others (a house pulled down). How much is expected on a tile follows from its distance
and from how much moves elsewhere on its lanelet, seen by any sensor: the counts are fitted as the
product of a profile of range a sensor and a flow a lanelet. Ghosts of facades and lorries that look
over a wall come to a small share of that.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeAlias

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Reporter, Text
from gis_radar.hdmap import TileEngine
from gis_radar.poses import Pose
from gis_radar.recordings import Detections
from gis_radar.scans.sight.sight import (
    HIDDEN,
    IN_SIGHT,
    NOT_IN_SCAN,
    NOTHING,
    OUT_OF_VIEW,
    Sight,
    SightTiles,
)

NO_MOVEMENT, MOVEMENT = "nothing moves in sight", "moves where hidden"
Table: TypeAlias = Floats  # sums by direction and distance from a sensor
REFLECTION_M = 1.0  # over the road: between the sills and the roof of a car
# Least absolute range rate of what moves: leaves and walkers stay below; what is farther from
# REFLECTION_M over a tile's road is of another level.
MOVEMENT_MPS, MOVEMENT_LEVEL_M = 1.0, 2.5
# Recorded movement is compared with sight in cells of this direction and distance: wider than a
# radar's error of bearing, narrower than a house; the least driveway between two walls.
SECTOR_DEG, RING_M = 1.0, 10.0
SECTORS_IN_ROW = 3  # width of a contradiction: one alone is an edge, smeared by bearing errors
# A cell is empty where less than this share of the expected movement is there, as ghosts of facades
# come to a tenth at most; and where so many frames with movement are expected from it on outwards.
EMPTY_SHARE, LEAST_IN_SECTOR = 0.1, 2.0
# Frames of movement missed, or seen though hidden, in a run of sectors before it counts: half a
# dozen vehicles, each seen in several frames of several sectors.
LEAST_FRAMES = 100.0
# A recording is compared from so many frames from one place on: five minutes at 20 Hz, three cycles
# of a signal. In less time ways stay empty by chance.
JUDGED_FRAMES = 6000
# Least share of the expected movement where hidden: ghosts and lorries that look over a wall give
# less.
MOVING_SHARE = 0.3
ROUNDS = 8  # of the fit of profiles and flows; four give the same tiles


@dataclass(frozen=True, kw_only=True)
class MovingHits:
    """In how many frames something moved on each tile, as a sensor saw it from one pose.

    Parameters
    ----------
    sight : Sight
        What the sensor sees from there.
    count : (n,) int64 array
        Frames with a moving detection on a tile, in the order of the tiles.
    frames : int
        All frames from there.
    """

    sight: Sight
    count: Integers = field(repr=False)
    frames: int

    @classmethod
    def of(cls, sight: Sight, counters: Sequence[MovementCounter]) -> Self:
        """Add up what was counted from one place, at least once."""
        count = np.sum([each.count for each in counters], axis=0)
        return cls(sight=sight, count=count, frames=sum(each.frames for each in counters))


@dataclass(kw_only=True)
class MovementCounter:
    """Counts the frames in which something moves on each tile, as batches of a recording come.

    Parameters
    ----------
    tiles : SightTiles
        All tiles.
    engine : TileGrid or TileTree
        Finds the tiles that points fall in.
    count : (n,) int64 array
        Frames with a moving detection on a tile.
    frames : int
        All frames.
    """

    tiles: SightTiles
    engine: TileEngine
    count: Integers = field(init=False, repr=False)
    frames: int = 0

    def __post_init__(self) -> None:
        self.count = np.zeros(len(self.tiles.tile_id), np.int64)

    def add(self, batch: Detections, pose: Pose, *, road_m: float = math.nan) -> None:
        """Add whole frames, seen from a pose; `road_m` as of :meth:`Pose.to_map`."""
        stamps, frame = np.unique(batch.time, return_inverse=True)
        self.frames += len(stamps)
        moves = batch.present & (np.abs(batch.range_rate) >= MOVEMENT_MPS)
        place = pose.to_map(batch.points[moves], road_m=road_m)
        point, tile = self.engine.assign(place[:, 0], place[:, 1])
        over_m = place[point, 2] - self.tiles.height[tile] - REFLECTION_M
        kept = ~(np.abs(over_m) > MOVEMENT_LEVEL_M)  # not known: it counts
        pairs = np.unique(frame[moves][point[kept]] * len(self.count) + tile[kept])
        self.count += np.bincount(pairs % len(self.count), minlength=len(self.count))


@dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Tiles of which a recording and sight say different things.

    Parameters
    ----------
    sight : Sight
        As it was.
    no_movement, movement : (n,) bool array
        Tiles in sight where nothing moves although it should; hidden ones where something does.
    count, expected : (n,) array
        Frames with something moving on a tile, as recorded and as expected of one in sight.
    """

    sight: Sight
    no_movement: Booleans = field(repr=False)
    movement: Booleans = field(repr=False)
    count: Integers = field(repr=False)
    expected: Floats = field(repr=False)

    def corrected(self, sight: Sight | None = None) -> Sight:
        """Return sight as the recording shows it; also that of another pose of the same place."""
        sight = self.sight if sight is None else sight
        hides = self.no_movement & (sight.state == IN_SIGHT)
        frees = self.movement & (sight.state == HIDDEN)
        return replace(
            sight,
            state=np.where(hides, HIDDEN, np.where(frees, IN_SIGHT, sight.state)).astype(np.uint8),
            hider=np.where(hides, NOT_IN_SCAN, np.where(frees, NOTHING, sight.hider)).astype(
                np.uint8
            ),
            hidden_at_m=np.where(hides | frees, np.nan, sight.hidden_at_m),
        )

    @property
    def tiles(self) -> int:
        """How many tiles there are."""
        return int(np.count_nonzero(self.no_movement | self.movement))


def find_contradictions(hits: Sequence[MovingHits], tiles: SightTiles) -> list[Contradiction]:
    """Find where recordings contradict sight.

    Parameters
    ----------
    hits : sequence of MovingHits
        Of each sensor and pose; those of all sensors together give the flow on the lanelets.
    tiles : SightTiles
        The tiles of all sights.

    Returns
    -------
    list of Contradiction
        One for each of the hits, in order.
    """
    _, lanelet = np.unique(tiles.lanelet_id, return_inverse=True)
    polar = [_Polar.of(each.sight, tiles) for each in hits]
    kept = [each.sight.state == IN_SIGHT for each in hits]
    found: list[Contradiction] = []
    for _ in range(2):  # shadows make the flow too low at first
        expected = _expected(hits, polar, kept, lanelet)
        found = [
            _compare(each, place, wanted)
            for each, place, wanted in zip(hits, polar, expected, strict=True)
        ]
        kept = [now & ~each.no_movement for now, each in zip(kept, found, strict=True)]
    return found


def report_contradictions(found: Iterable[Contradiction], reporter: Reporter) -> None:
    """Warn, a line a sensor, of tiles that a recording contradicts."""
    counts: dict[str, list[int]] = {}
    for each in found:
        both = counts.setdefault(each.sight.pose.sensor, [0, 0])
        both[0] += int(np.count_nonzero(each.no_movement))
        both[1] += int(np.count_nonzero(each.movement))
    for sensor, (still, moving) in counts.items():
        parts = [
            *(
                [Text("nothing moves on {} tiles in sight where vehicles pass", still)]
                if still
                else []
            ),
            *([Text("something moves on {} hidden tiles", moving)] if moving else []),
        ]
        if parts:
            reporter.warn(
                "the recording of {} contradicts its sight: {}; was it built or pulled "
                "down since the scan, or is the pose off? gis-radar sight --recording "
                "lists the tiles and corrects sight",
                sensor,
                Text("; ").join(parts),
            )


@dataclass(frozen=True, kw_only=True)
class _Polar:
    """Direction and distance of all tiles from a sensor, as positions in a table."""

    away: Integers
    turn: Integers
    hidden: Integers
    shape: tuple[int, int]

    @classmethod
    def of(cls, sight: Sight, tiles: SightTiles) -> _Polar:
        offset = tiles.centres[:, :2] - sight.pose.position[:2]
        range_m = np.hypot(*offset.T)
        turns = round(360.0 / SECTOR_DEG)
        turn = np.floor(np.degrees(np.arctan2(*offset.T[::-1])) / SECTOR_DEG) % turns
        seen = range_m[sight.state != OUT_OF_VIEW]
        most = math.ceil((float(seen.max()) if len(seen) else 0.0) / RING_M) + 1
        ring = np.minimum(range_m / RING_M, most - 1)
        hidden = np.minimum(np.nan_to_num(sight.hidden_at_m) / RING_M, most - 1)
        return cls(
            away=ring.astype(np.int64),
            turn=turn.astype(np.int64),
            hidden=hidden.astype(np.int64),
            shape=(turns, most),
        )

    def table(self, values: Integers | Floats, ring: Integers) -> Table:
        """Return the sums of values by direction and ring."""
        key = self.turn * self.shape[1] + ring
        sums = np.bincount(key, values.astype(np.float64), minlength=math.prod(self.shape))
        return np.asarray(sums.reshape(self.shape), np.float64)


def _expected(
    hits: Sequence[MovingHits], polar: Sequence[_Polar], kept: Sequence[Booleans], lanelet: Integers
) -> list[Floats]:
    """Return how many frames with something moving each tile in view of each sensor should have."""
    lanelets = int(lanelet.max(initial=-1)) + 1
    flow = np.ones(lanelets)
    profiles = [np.ones(place.shape[1]) for place in polar]
    for _ in range(ROUNDS):
        got, wanted = np.zeros(lanelets), np.zeros(lanelets)
        for k, (each, place, rows) in enumerate(zip(hits, polar, kept, strict=True)):
            ring, lane, count = place.away[rows], lanelet[rows], each.count[rows]
            rings = place.shape[1]
            seen = np.bincount(ring, count, minlength=rings)
            profiles[k] = _share(seen, each.frames * np.bincount(ring, flow[lane], minlength=rings))
            got += np.bincount(lane, count, minlength=lanelets)
            rate = each.frames * profiles[k][ring]
            wanted += np.bincount(lane, rate, minlength=lanelets)
        flow = _share(got, wanted)
    return [
        each.frames * profile[place.away] * flow[lanelet] * (each.sight.state != OUT_OF_VIEW)
        for each, place, profile in zip(hits, polar, profiles, strict=True)
    ]


def _share(part: Any, whole: Any) -> Floats:
    return np.asarray(np.divide(part, whole, out=np.zeros(len(part)), where=whole > 0))


def _compare(hits: MovingHits, polar: _Polar, expected: Floats) -> Contradiction:
    """Return the tiles of one sensor where counted and expected movement contradict sight."""
    in_sight, hidden = hits.sight.state == IN_SIGHT, hits.sight.state == HIDDEN
    empty = _empty_beyond(
        polar.table(hits.count * in_sight, polar.away),
        polar.table(expected * in_sight, polar.away),
    )
    counted = polar.table(hits.count * hidden, polar.hidden)
    wanted = polar.table(expected * hidden, polar.hidden)
    lively = (counted > 0) & (wanted > 0) & (counted >= MOVING_SHARE * wanted)
    freed = _in_wide_runs(lively, np.where(lively, counted, 0.0))
    return Contradiction(
        sight=hits.sight,
        no_movement=in_sight & empty[polar.turn, polar.away],
        movement=hidden & freed[polar.turn, polar.hidden],
        count=hits.count,
        expected=expected,
    )


def _empty_beyond(counted: Table, wanted: Table) -> Booleans:
    """Return the rings of each direction beyond which nothing moves although much should."""
    left, missed = _from_far(counted), _from_far(wanted)
    empty = (counted <= EMPTY_SHARE * wanted) & (wanted > 0)
    empty &= (left <= EMPTY_SHARE * missed) & (missed >= LEAST_IN_SECTOR)
    return _in_wide_runs(np.logical_or.accumulate(empty, axis=1), wanted)


def _from_far(table: Table) -> Table:
    """Return the sums over a ring and all beyond it."""
    return np.asarray(np.cumsum(table[:, ::-1], axis=1)[:, ::-1])


def _in_wide_runs(cells: Booleans, weight: Table) -> Booleans:
    """Return the cells in runs of directions that are wide enough and weigh enough."""
    some: Booleans = np.any(cells, axis=1)
    turns = len(some)
    first = int(np.argmin(some))  # a run may go on over the last direction
    order = (first + np.arange(turns)) % turns
    number = np.cumsum(~some[order])
    weighs = np.where(cells, weight, 0.0).sum(axis=1)[order]
    width = np.bincount(number, some[order])
    heavy = np.bincount(number, weighs * some[order]) >= LEAST_FRAMES
    kept = np.zeros_like(some)
    kept[order] = some[order] & (heavy & (width >= SECTORS_IN_ROW))[number]
    return cells & kept[:, None]

"""Stretches of a lane on which nothing ever moves although vehicles pass before and behind them.

Who drives along a lanelet passes all of it. Where a sensor is said to see a stretch on which it
never met anything, while it did on both sides, something is wrong: a house hides it that no scan
shows, the map is wrong there, or the view is too wide. It reads as observed and empty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from gis_radar.base import Booleans, Floats, Integers, Text
from gis_radar.scans.sight.recorded import MovingHits
from gis_radar.scans.sight.sight import IN_SIGHT, SightTiles

# Lanelets are looked at in pieces of this length: a car's, so that the radar meets a vehicle
# several times on each.
PIECE_M = 5.0
# A piece is empty where less than this share of the expected movement is there. Who queues on one
# side and drives freely past the piece is met ten times less often there.
SHARE = 0.01
# Frames with movement on a tile expected on such a stretch before it counts: some fifty vehicles on
# a car's length.
LEAST_FRAMES = 100.0
SHARED = 0.05  # a tile covered by another lanelet's by this share tells nothing of its own lane


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A stretch on which nothing moved.

    Parameters
    ----------
    lanelet_id : int
        The lanelet.
    tiles : int
        How many tiles it is.
    expected : float
        Frames with movement on one of them that its lanelet's other tiles let expect.
    """

    lanelet_id: int
    tiles: int
    expected: float


def find_gaps(hits: Sequence[MovingHits], tiles: SightTiles) -> list[Gap]:
    """Find stretches in sight on which nothing moves although it does before and behind them.

    Parameters
    ----------
    hits : sequence of MovingHits
        Of each sensor and pose; they count together.
    tiles : SightTiles
        The tiles of all sights, in the order of lanelets and places in them.

    Returns
    -------
    list of Gap
        In the order of the tiles.
    """
    count = np.zeros(len(tiles.tile_id))
    frames = np.zeros(len(tiles.tile_id))
    for each in hits:
        seen = each.sight.state == IN_SIGHT
        count[seen] += each.count[seen]
        frames[seen] += each.frames
    bins = _bins(tiles, frames > 0)
    counted, looked = bins.sums(count), bins.sums(frames)
    moved = counted > 0
    empty = _empty(counted, _expected(counted, looked, moved, bins))
    if not empty.any():
        return []
    # Less is expected of own pieces alone: no other stretch can have an empty piece then.
    asked = moved & np.isin(bins.stretch, bins.stretch[empty])
    moved &= ~_shared(tiles, bins, asked)
    return list(_gaps(bins, counted, _expected(counted, looked, moved, bins)))


@dataclass(frozen=True, kw_only=True)
class _Bins:
    """Pieces of lanelets, some metres long, of tiles that follow each other and are all in sight.

    Parameters
    ----------
    of_tile : (n,) int64 array
        The piece of each tile; -1 where it is in nobody's sight.
    known : (n,) bool array
        Tiles in sight.
    stretch : (b,) int64 array
        For each piece the stretch of lanelet, without a gap in sight, that it is of.
    lanelet : (b,) int64 array
        Its lanelet.
    """

    of_tile: Integers
    known: Booleans
    stretch: Integers
    lanelet: Integers

    def sums(self, values: Floats) -> Floats:
        """Return the sum of values a tile over each piece."""
        number = len(self.lanelet)
        sums = np.bincount(self.of_tile[self.known], values[self.known], minlength=number)
        return np.asarray(sums, np.float64)


def _bins(tiles: SightTiles, known: Booleans) -> _Bins:
    place = np.flatnonzero(known)
    lanelet = tiles.lanelet_id[place]
    new = np.ones(len(place), np.bool_)
    new[1:] = (np.diff(place) > 1) | (np.diff(lanelet) != 0)
    stretch = np.cumsum(new) - 1
    middle = tiles.quads[place].mean(axis=1)
    ahead_m = np.hypot(*np.diff(middle, axis=0, prepend=middle[:1]).T)
    along = np.cumsum(np.where(new, 0.0, ahead_m))
    along -= along[new][stretch]
    key = stretch * (1 << 32) + (along / PIECE_M).astype(np.int64)
    _, first, piece = np.unique(key, return_index=True, return_inverse=True)
    of_tile = np.full(len(known), -1)
    of_tile[place] = piece
    return _Bins(of_tile=of_tile, known=known, stretch=stretch[first], lanelet=lanelet[first])


def _expected(counted: Floats, looked: Floats, moved: Booleans, bins: _Bins) -> Floats:
    """Return the movement that each piece should have, as the busiest on its quieter side has."""
    rate = np.where(moved, counted / np.maximum(looked, 1.0), 0.0)
    before, behind = _most_before(rate, bins.stretch), _most_behind(rate, bins.stretch)
    return np.asarray(np.minimum(before, behind) * looked)


def _most_before(rate: Floats, stretch: Integers) -> Floats:
    """Return the greatest rate of the pieces before each in its stretch."""
    found = np.zeros(len(rate))
    for k in range(1, len(rate)):
        if stretch[k] == stretch[k - 1]:
            found[k] = max(found[k - 1], rate[k - 1])
    return found


def _most_behind(rate: Floats, stretch: Integers) -> Floats:
    """Return the greatest rate of the pieces behind each in its stretch."""
    return _most_before(rate[::-1], stretch[::-1])[::-1]


def _empty(counted: Floats, expected: Floats) -> Booleans:
    return (expected > 0) & (counted <= SHARE * expected)


def _shared(tiles: SightTiles, bins: _Bins, asked: Booleans) -> Booleans:
    """Return those of some pieces that have a tile which overlaps one of another lanelet."""
    found = np.zeros(len(asked), np.bool_)
    mine = bins.known & np.append(asked, False)[bins.of_tile]
    low, high = tiles.quads.min(axis=1), tiles.quads.max(axis=1)
    near = (low <= high[mine].max(axis=0)).all(axis=1) & (high >= low[mine].min(axis=0)).all(axis=1)
    shapes = np.full(len(near), None)
    shapes[near] = shapely.polygons(tiles.quads[near])
    one, other = shapely.STRtree(shapes).query(shapes[mine], predicate="intersects")
    one = np.flatnonzero(mine)[one]
    apart = tiles.lanelet_id[one] != tiles.lanelet_id[other]
    one, other = one[apart], other[apart]
    shared = shapely.area(shapely.intersection(shapes[one], shapes[other]))
    found[bins.of_tile[one[shared > SHARED * shapely.area(shapes[one])]]] = True
    return found


def _gaps(bins: _Bins, counted: Floats, expected: Floats) -> Iterator[Gap]:
    """Yield runs of empty pieces that are long enough, and from which enough is expected."""
    empty = _empty(counted, expected)
    begins = empty.copy()
    begins[1:] &= ~(empty[:-1] & (np.diff(bins.stretch) == 0))
    run = np.cumsum(begins) - 1
    size = bins.sums(np.ones(len(bins.of_tile)))
    for number in range(int(begins.sum())):
        mine = empty & (run == number)
        missed = float(expected[mine].sum())
        if missed >= LEAST_FRAMES:
            yield Gap(
                lanelet_id=int(bins.lanelet[mine][0]), tiles=int(size[mine].sum()), expected=missed
            )


def gap_warning(gaps: Sequence[Gap]) -> str:
    """Return one line on all gaps; empty where there are none."""
    if not gaps:
        return ""
    count, first = sum(each.tiles for each in gaps), max(gaps, key=lambda each: each.expected)
    return Text(
        "{} tiles are never passed although vehicles pass before and behind them, most "
        "on lanelet {}: they read as observed and empty; do houses hide them ({}), is "
        "the map wrong there, or the view too wide?",
        count,
        first.lanelet_id,
        "--scan",
    )

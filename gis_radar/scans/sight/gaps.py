"""Find stretches of a lane without any movement although vehicles pass before and behind them.

A vehicle that drives along a lanelet passes all of it. A stretch in sight without movement between
stretches with movement shows an error: a house hides it that no scan shows, the map is wrong there,
or the view is too wide. Uncorrected, such a stretch counts as observed and empty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from gis_radar.base import Booleans, Floats, Integers, Text
from gis_radar.scans.sight.recorded import MovingHits
from gis_radar.scans.sight.sight import IN_SIGHT
from gis_radar.scans.sight.tiles import SightTiles

# Lanelets are divided into pieces of this length, a car's: a vehicle is detected several times on
# each.
PIECE_M = 5.0
# A piece is empty below this share of the expected movement. It must be small: vehicles that queue
# on one side and pass the piece freely are detected ten times less often on it.
SHARE = 0.01
# Least sum over the stretch of expected frames with movement on a tile: some fifty vehicles on a
# car's length.
LEAST_FRAMES = 100.0
SHARED = 0.05  # share of a tile under another lanelet's from which on its movement may be of either


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A stretch on which nothing moved.

    Parameters
    ----------
    lanelet_id : int
        The lanelet.
    tiles : int
        Number of its tiles.
    expected : float
        Sum over its tiles of the frames with movement to expect from the rest of the lanelet.
    """

    lanelet_id: int
    tiles: int
    expected: float


def find_gaps(hits: Sequence[MovingHits], tiles: SightTiles) -> list[Gap]:
    """Find stretches in sight on which nothing moves although it does before and behind them.

    Parameters
    ----------
    hits : sequence of MovingHits
        Movement by sensor and pose; they are added up.
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
    # Without shared pieces less is expected, so only stretches with an empty piece need the check.
    asked = moved & np.isin(bins.stretch, bins.stretch[empty])
    moved &= ~_shared(tiles, bins, asked)
    return list(_gaps(bins, counted, _expected(counted, looked, moved, bins)))


@dataclass(frozen=True, kw_only=True)
class _Bins:
    """Pieces of lanelets, `PIECE_M` long, of consecutive tiles that are all in sight.

    Parameters
    ----------
    of_tile : (n,) int64 array
        Number of each tile's piece; -1 where the tile is in no sensor's sight.
    known : (n,) bool array
        Tiles in a sensor's sight.
    stretch : (b,) int64 array
        For each piece, the number of its stretch: a run of tiles of a lanelet all in sight.
    lanelet : (b,) int64 array
        Lanelet of each piece.
    """

    of_tile: Integers
    known: Booleans
    stretch: Integers
    lanelet: Integers

    def sums(self, values: Floats) -> Floats:
        """Return the sums over each piece of values by tile."""
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
    """Return the frames with movement to expect on each piece, by the rates on its quieter side."""
    rate = np.where(moved, counted / np.maximum(looked, 1.0), 0.0)
    before, behind = _most_before(rate, bins.stretch), _most_behind(rate, bins.stretch)
    return np.asarray(np.minimum(before, behind) * looked)


def _most_before(rate: Floats, stretch: Integers) -> Floats:
    """Return, for each piece, the greatest rate of the earlier ones in its stretch."""
    found = np.zeros(len(rate))
    for k in range(1, len(rate)):
        if stretch[k] == stretch[k - 1]:
            found[k] = max(found[k - 1], rate[k - 1])
    return found


def _most_behind(rate: Floats, stretch: Integers) -> Floats:
    """Return, for each piece, the greatest rate of the later ones in its stretch."""
    return _most_before(rate[::-1], stretch[::-1])[::-1]


def _empty(counted: Floats, expected: Floats) -> Booleans:
    return (expected > 0) & (counted <= SHARE * expected)


def _shared(tiles: SightTiles, bins: _Bins, asked: Booleans) -> Booleans:
    """Return which of the asked pieces have a tile that overlaps one of another lanelet."""
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
    """Yield the runs of empty pieces on which at least `LEAST_FRAMES` are expected."""
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

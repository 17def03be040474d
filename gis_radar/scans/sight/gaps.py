"""Find stretches of a lane without any movement although vehicles pass before and behind them.

A vehicle that drives along a lanelet passes all of it. A stretch in sight without movement between
stretches with movement shows an error: a house hides it that no scan shows, the map is wrong there,
or the view is too wide. Uncorrected, such a stretch counts as observed and empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely

from gis_radar.base import Floats, Integers, Text
from gis_radar.scans.sight.recorded import MovingHits
from gis_radar.scans.sight.sight import IN_SIGHT
from gis_radar.scans.sight.tiles import SightTiles

# Lanelets are divided into pieces of this length, a car's: a vehicle is detected several times on
# each.
_PIECE_M = 5.0
# A piece is empty below this share of the expected movement. It must be small: vehicles that queue
# on one side and pass the piece freely are detected ten times less often on it.
_EMPTY_SHARE = 0.01
# Least sum over the stretch of expected frames with movement on a tile: some fifty vehicles on a
# car's length.
_LEAST_FRAMES = 100.0
# share of a tile under another lanelet's from which on its movement may be of either
_SHARED_AREA = 0.05


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
    count, frames = np.zeros((2, len(tiles.tile_id)))
    for each in hits:
        seen = each.sight.state == IN_SIGHT
        count[seen] += each.count[seen]
        frames[seen] += each.frames
    place = np.flatnonzero(frames > 0)
    pieces, of_tile = _pieces(tiles, place, count, frames)
    moved = pieces["count"] > 0
    empty = _empty_pieces(pieces, moved)
    if not empty.any():
        return []
    # Without shared pieces less is expected, so only stretches with an empty piece need the check.
    to_check = moved & pieces["stretch"].isin(pieces["stretch"][empty])
    shared_tiles = _shared_tiles(tiles, place[to_check.to_numpy()[of_tile]])
    moved &= ~pieces.index.isin(np.unique(of_tile[np.isin(place, shared_tiles)]))
    empty = _empty_pieces(pieces, moved)
    run = (empty.ne(empty.shift()) | pieces["stretch"].diff().ne(0)).cumsum()
    pieces["expected"] = _expected(pieces, moved)
    found = pieces[empty].groupby(run[empty])
    columns = found["lanelet"].first(), found["tiles"].sum(), found["expected"].sum()
    return [
        Gap(lanelet_id=ref, tiles=size, expected=expected)
        for ref, size, expected in zip(*(each.tolist() for each in columns), strict=True)
        if expected >= _LEAST_FRAMES
    ]


def _pieces(
    tiles: SightTiles, place: Integers, count: Floats, frames: Floats
) -> tuple[pd.DataFrame, Integers]:
    """Return pieces of lanelets, `_PIECE_M` long, of consecutive tiles that are all in sight.

    Parameters
    ----------
    tiles : SightTiles
        All tiles.
    place : (k,) int64 array
        Positions of the tiles in sight.
    count, frames : (n,) arrays
        Sums to be made over each piece.

    Returns
    -------
    pieces : DataFrame
        By piece: `stretch` (the number of its run of tiles of a lanelet that are all in sight),
        `lanelet`, `tiles` (their number), `count`, `frames`.
    of_tile : (k,) int64 array
        The piece of each tile in sight.
    """
    lanelet = tiles.lanelet_id[place]
    new = np.ones(len(place), np.bool_)
    new[1:] = (np.diff(place) > 1) | (np.diff(lanelet) != 0)
    stretch = np.cumsum(new) - 1
    middle = tiles.quads[place].mean(axis=1)
    ahead_m = np.hypot(*np.diff(middle, axis=0, prepend=middle[:1]).T)
    along = np.cumsum(np.where(new, 0.0, ahead_m))
    along -= along[new][stretch]
    table = pd.DataFrame({"stretch": stretch, "lanelet": lanelet, "tiles": 1})
    table = table.assign(count=count[place], frames=frames[place])
    grouped = table.groupby([stretch, (along / _PIECE_M).astype(np.int64)])
    first = {name: (name, "first") for name in ("stretch", "lanelet")}
    sums = {name: (name, "sum") for name in ("tiles", "count", "frames")}
    of_tile = np.asarray(grouped.ngroup(), np.int64)
    return grouped.agg(**first, **sums).reset_index(drop=True), of_tile


def _expected(pieces: pd.DataFrame, moved: pd.Series) -> pd.Series:
    """Return the frames with movement to expect on each piece, by the rates on its quieter side."""
    rate = (pieces["count"] / pieces["frames"].clip(lower=1.0)).where(moved, 0.0)
    before, behind = (_most_earlier(each, pieces["stretch"]) for each in (rate, rate[::-1]))
    return before.clip(upper=behind.sort_index()) * pieces["frames"]


def _most_earlier(rate: pd.Series, stretch: pd.Series) -> pd.Series:
    """Return, for each piece, the greatest rate of those before it in its stretch."""
    return rate.groupby(stretch).cummax().groupby(stretch).shift(fill_value=0.0)


def _empty_pieces(pieces: pd.DataFrame, moved: pd.Series) -> pd.Series:
    expected = _expected(pieces, moved)
    return (expected > 0) & (pieces["count"] <= _EMPTY_SHARE * expected)


def _shared_tiles(tiles: SightTiles, asked: Integers) -> Integers:
    """Return which tiles overlap one of another lanelet."""
    low, high = tiles.quads.min(axis=1), tiles.quads.max(axis=1)
    near = (low <= high[asked].max(axis=0)).all(axis=1) & (high >= low[asked].min(axis=0)).all(
        axis=1
    )
    shapes = np.full(len(near), None)
    shapes[near] = shapely.polygons(tiles.quads[near])
    of_asked, overlapping = shapely.STRtree(shapes).query(shapes[asked], predicate="intersects")
    of_asked = asked[of_asked]
    apart = tiles.lanelet_id[of_asked] != tiles.lanelet_id[overlapping]
    of_asked, overlapping = of_asked[apart], overlapping[apart]
    shared = shapely.area(shapely.intersection(shapes[of_asked], shapes[overlapping]))
    return np.asarray(of_asked[shared > _SHARED_AREA * shapely.area(shapes[of_asked])])


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

"""Occupancy of tiles with its standard error, from the steps in which they were occupied.

Occupancy is an estimate of the share of time with a vehicle on a tile. Its error is that of a
finite number of runs of steps, each of which may be too long, too short, or not there at all:

- the ends of a run are known as well as the ends of a vehicle: to `RUN_END_SHARE` of its length,
  and to `RUN_END_MOST_S` at most, however long the vehicle stood;
- a run may be of no vehicle, and one may be missing: the error is `FALSE_SHARE` of the length of a
  run that was seen, and `INFERRED_SHARE` of one that was inferred while nothing was measured;
- while other vehicles hide a tile nothing is measured there, on empty road as under vehicles: for
  `HIDDEN_SHARE` of that time only the tile's mean occupancy is known;
- all vehicles may be shifted along the lane, as poses and maps are
  (:mod:`gis_radar.dataset.traffic.shifts`): occupancy is then that of the place so far ahead or
  behind;
- across it, a pose that is off by more than half of a tile's width puts them on the next lane, as
  often to the left as to the right.

With T the length of a run, V the visible time, H the hidden part of it, c the occupancy, d its
change by the shift along the lane, p the probability of another lane, l and r the occupancy of the
lanes beside it (0 where there is none),
`se = sqrt(sum(min(RUN_END_SHARE T, RUN_END_MOST_S)^2 + (FALSE_SHARE T)^2 or (INFERRED_SHARE T)^2)
/ V^2 + (HIDDEN_SHARE H / V)^2 c (1 - c) + d^2 + p ((l - c)^2 + (r - c)^2) / 2)`, and at least
`LEAST_ERROR_S / V`. Runs are independent, hidden times and shifts are not. The first sum is
the dataset's `occupied_variance` (:mod:`gis_radar.dataset.days.tile_counts`), the hidden time its
`inferred_steps`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Booleans, Floats, Integers
from gis_radar.dataset import Shifts, chance_of_others, lanes_beside
from gis_radar.hdmap import lanes_of
from gis_radar.products.heatmap.style import UNCERTAIN_FROM, UNCERTAIN_SEEN

OCCUPANCY_DEFINITIONS = {
    "visible_s": (
        "seconds in which the tile was visible: 0.05 s for each step of 50 ms in which it was "
        "observed and not hidden by other vehicles for more than 10 s on end"
    ),
    "occupied_s": "seconds in which the tile was visible and a vehicle was on it",
    "occupancy": "occupied_s / visible_s, 0 to 1; no data where not visible",
    "occupancy_se": "standard error of occupancy as an estimate for this period",
}
# Root of the variance of the hidden time, relative to its length, as of runs that were inferred. Of
# the tiles hidden for over a tenth of the time, in two simulated places, 6 and 45 % are within two
# standard errors without it, 50 and 71 % with it.
HIDDEN_SHARE = 0.7
LEAST_ERROR_S = 0.1  # least error of the occupied time: two steps
_LONGEST_M = 1e5  # longer than any lanelet
# Tables hold the roots of standard errors by interval in parts of a 32767th, the largest number of
# two bytes: 0.0001 is kept to 0.3 %, larger ones better.
ERROR_UNIT = 1.0 / 32767**2


def summed(counts: NDArray[Any], interval: int | slice | None) -> Integers:
    """Return the steps of an interval, or the sums over several; over all where it is None."""
    if isinstance(interval, int):
        return np.asarray(counts[interval], np.int64)
    rows = slice(None) if interval is None else interval
    return np.asarray(counts[rows].sum(axis=0, dtype=np.int64))


def shares_of_tiles(
    seen: Integers, tiles: int, part: Integers, whole: Integers
) -> tuple[Floats, Floats, Floats]:
    """Return seconds of a part and of the whole, and their quotient, of all tiles.

    Parameters
    ----------
    seen : (k,) int64 array
        Positions of the tiles that were counted.
    tiles : int
        Number of all tiles.
    part, whole : (k,) int64 arrays
        Steps of the counted tiles.

    Returns
    -------
    three (tiles,) float64 arrays
        Where the whole is 0, the others are NaN.
    """
    known = whole > 0
    place = seen[known]
    part_s, whole_s, share = np.full(tiles, np.nan), np.zeros(tiles), np.full(tiles, np.nan)
    part_s[place] = part[known] / STEPS_PER_SECOND
    whole_s[seen] = whole / STEPS_PER_SECOND
    share[place] = part[known] / whole[known]
    return part_s, whole_s, share


class OccupancyShares(NamedTuple):
    """Occupancy of each tile with its error, in the order of the tiles.

    Parameters
    ----------
    visible_s, occupied_s : (n,) float64 arrays
        Seconds; where a tile was never visible, `visible_s` is 0 and `occupied_s` NaN.
    occupancy, occupancy_se : (n,) float64 arrays
        Their quotient and its standard error, NaN where not visible.
    """

    visible_s: Floats
    occupied_s: Floats
    occupancy: Floats
    occupancy_se: Floats

    def uncertain(self, least_visible_s: float) -> Booleans:
        """Return which tiles are uncertain, and hatched on maps.

        These are tiles whose standard error is as large as the occupancy and at least 2 percentage
        points, and tiles visible for less than `least_visible_s`.
        """
        vague = self.occupancy_se >= np.maximum(self.occupancy, UNCERTAIN_FROM)
        return (self.visible_s > 0.0) & (vague | (self.visible_s < least_visible_s))


@dataclass(frozen=True, kw_only=True, eq=False)
class Occupancy:
    """Steps in which tiles were visible and occupied, for the tiles that some view sees.

    Parameters
    ----------
    visible, occupied : (intervals, k) uint32 arrays
        Steps.
    error : (intervals, k) float32 array
        Standard error of the occupancy; NaN where not visible.
    error_whole : (k,) float32 array
        Standard error over the whole time.
    """

    visible: NDArray[np.uint32]
    occupied: NDArray[np.uint32]
    error: NDArray[np.float32]
    error_whole: NDArray[np.float32]

    def shares(self, seen: Integers, tiles: int, interval: int | slice | None) -> OccupancyShares:
        """Return the values of all tiles, of which `seen` are counted here."""
        visible, error = summed(self.visible, interval), np.full(tiles, np.nan)
        occupied_s, visible_s, share = shares_of_tiles(
            seen, tiles, summed(self.occupied, interval), visible
        )
        error[seen[visible > 0]] = self._error(interval, visible)[visible > 0]
        return OccupancyShares(visible_s, occupied_s, share, error)

    def least_visible_s(self, interval: int | slice | None) -> float:
        """Return half of a tile's longest visible time (s); of an interval, that in any of them."""
        if isinstance(interval, int):
            longest = self.visible.max(initial=0)
        else:
            longest = summed(self.visible, interval).max(initial=0)
        return UNCERTAIN_SEEN * float(longest) / STEPS_PER_SECOND

    def _error(self, interval: int | slice | None, visible: Any) -> Floats:
        if interval is None:
            return np.asarray(self.error_whole, np.float64)
        if isinstance(interval, int):
            return np.asarray(self.error[interval], np.float64)
        parts = np.nan_to_num(self.error[interval]) * self.visible[interval]
        apart = np.sqrt((parts**2).sum(axis=0)) / np.maximum(visible, 1)
        return np.asarray(np.fmax(apart, self.error_whole))  # shifts do not average out


def surest(share: Floats, error: Floats) -> int:
    """Return the tile whose share less its standard error is highest.

    The highest share alone would be that of the least known tile.
    """
    return int(np.nanargmax(share - np.nan_to_num(error)))


def mean_occupancy(tiles: gpd.GeoDataFrame, shares: OccupancyShares) -> tuple[float, float]:
    """Return the mean occupancy over tiles and visible time, and its standard error.

    A missed or false vehicle affects all tiles of its lane: the errors of a lane's tiles are taken
    as one error, those of different lanes as independent. On ten simulated sites the true mean was
    within two standard errors on nine.
    """
    total_s = float(shares.visible_s.sum())
    if total_s == 0.0:
        return float("nan"), float("nan")
    error_s = np.nan_to_num(shares.visible_s * shares.occupancy_se)
    by_lane = [error_s[lane.rows].sum() for lane in lanes_of(tiles)]
    occupied_s = float(np.nansum(shares.occupied_s))
    return occupied_s / total_s, float(np.linalg.norm(by_lane)) / total_s


def occupancy_of(
    sums: Mapping[str, Floats], whole_sums: Mapping[str, Floats], tiles: gpd.GeoDataFrame,
    seen: Integers, shifts: Shifts,
) -> Occupancy:  # fmt: skip
    """Return the occupancy of tiles with its standard error.

    Parameters
    ----------
    sums : mapping
        By the names of the columns of `tile_counts`, sums by interval and tile: (intervals, k).
    whole_sums : mapping
        The same sums over the whole time, from quarters of an hour, at whose edges runs are cut.
    tiles : GeoDataFrame
        All tiles, by ascending `tile_id`.
    seen : (k,) int64 array
        Positions of the tiles that were counted.
    shifts : Shifts
        Common shifts of the vehicles on each tile.
    """
    names = ("visible_steps", "occupied_steps", "occupied_variance", "inferred_steps")
    lanes = _Shifted.of(tiles, seen, shifts)
    errors = [lanes.error(*each) for each in zip(*(sums[name] for name in names), strict=True)]
    error_whole = lanes.error(*(whole_sums[name].sum(axis=0) for name in names))
    visible, occupied = (sums[name].astype(np.uint32) for name in names[:2])
    return Occupancy(
        visible=visible, occupied=occupied, error=_rounded(np.stack(errors)),
        error_whole=error_whole.astype(np.float32),
    )  # fmt: skip


def error_roots(errors: Floats) -> Integers:
    """Return roots of standard errors, 0 to 1, as whole numbers for tables."""
    return np.rint(np.sqrt(errors / ERROR_UNIT)).astype(np.int64)


def _rounded(errors: Floats) -> NDArray[np.float32]:
    """Round standard errors as tables do, so that a map read back is the same."""
    roots = error_roots(np.nan_to_num(errors))
    return np.where(np.isnan(errors), np.nan, roots * roots * ERROR_UNIT).astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Shifted:
    """Tiles on one axis, one lanelet after the other, with the shift of each."""

    seen: Integers
    at_m: Floats
    ends: tuple[Floats, Floats]
    beside: Integers  # (2, k) tiles beside the counted ones, -1 where there is none
    other_lane: Floats  # probability that a vehicle is on one of these

    @classmethod
    def of(cls, tiles: gpd.GeoDataFrame, seen: Integers, shifts: Shifts) -> _Shifted:
        lanelet = np.unique(tiles["lanelet_id"].to_numpy(np.int64), return_inverse=True)[1]
        middle = tiles["s_m"].to_numpy(float) + tiles["length_m"].to_numpy(float) / 2
        at_m = _LONGEST_M * lanelet + middle
        first, last = np.full((2, lanelet.max() + 1), [[np.inf], [-np.inf]])
        np.minimum.at(first, lanelet, at_m)
        np.maximum.at(last, lanelet, at_m)
        ends = (
            np.clip(at_m + step, first[lanelet], last[lanelet])[seen]
            for step in (-shifts.along, shifts.along)
        )
        return cls(
            seen=seen, at_m=at_m, ends=tuple(ends), beside=lanes_beside(tiles)[:, seen],
            other_lane=chance_of_others(shifts, tiles)[seen],
        )  # fmt: skip

    def error(self, visible: Any, occupied: Any, squares: Floats, hidden: Floats) -> Floats:
        """Return the standard error of occupancy of the counted tiles, NaN where not visible."""
        time, occupancy = np.maximum(visible, 1), occupied / np.maximum(visible, 1)
        share = np.full(len(self.at_m), np.nan)
        share[self.seen] = np.where(visible > 0, occupancy, np.nan)
        unknown = (HIDDEN_SHARE * hidden) ** 2 * occupancy * (1.0 - occupancy)
        beside = np.append(np.nan_to_num(share), 0.0)[self.beside] - occupancy
        shifted = self._change(share) ** 2 + self.other_lane * (beside**2).mean(axis=0)
        least = LEAST_ERROR_S / STEP_S / time
        error = np.sqrt((squares + unknown) / time**2 + shifted)
        return np.where(visible > 0, np.clip(error, np.minimum(least, 1.0), 1.0), np.nan)

    def _change(self, share: Floats) -> Floats:
        """Return the change of a share of the counted tiles by the shift, of both directions."""
        there = (np.interp(end, self.at_m, share) for end in self.ends)
        return np.asarray(np.fmax(*(np.nan_to_num(np.abs(t - share[self.seen])) for t in there)))

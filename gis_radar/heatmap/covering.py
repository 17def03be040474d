"""Count in how many steps each tile was visible and covered, with the error of the share.

Coverage is an estimate of the share of time with a vehicle on a tile. Its error is that of a
finite number of runs of steps, each of which may be too long, too short, or not there at all:

- the ends of a run are known as well as the ends of a vehicle: `end_share` of its length of time,
  and no more than `end_most_s`, however long the vehicle stood;
- a run may be of no vehicle, and one may be missing: `false_share` of a run that was seen, and
  `inferred_share` of one that was inferred while nothing was measured, of its whole length;
- while other vehicles hide a tile nothing is measured there, on empty road as under vehicles: of
  `hidden_share` of that time only the coverage at large is known;
- all vehicles may be shifted along the lane by `shift_m`, as poses and maps are: that much of the
  change of coverage from tile to tile.

With T the length of a run, V the visible time, H the hidden part of it, and c the coverage,
`se = sqrt(sum(min(end_share T, end_most_s)^2 + (false_share T)^2 or (inferred_share T)^2) / V^2
+ (hidden_share H / V)^2 c (1 - c) + (shift_m dc/ds)^2)`, and at least `least_s / V`. Runs are
independent of each other, hidden times are not.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gis_radar.arrays import Booleans, Floats, Integers, ranges
from gis_radar.errors import InputError
from gis_radar.heatmap.intervals import Timeline
from gis_radar.heatmap.style import UNCERTAIN_FROM, UNCERTAIN_SEEN
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.frame_steps import Runs
from gis_radar.progress import Reporter
from gis_radar.steps import STEP_S, STEPS_PER_SECOND
from gis_radar.tiles.lanes import lanes_of
from gis_radar.vehicles import Vehicles
from gis_radar.vehicles.provenance import poses_of
from gis_radar.vehicles.tables import BLOCK_STEPS

COVERAGE_DEFINITIONS = {
    "visible_s": (
        "seconds in which the tile was visible: 0.05 s for each step of 50 ms in which it was "
        "observed and not hidden by other vehicles for more than 10 s on end"
    ),
    "covered_s": "seconds in which the tile was visible and a vehicle was on it",
    "coverage": "covered_s / visible_s, 0 to 1; no data where not visible",
    "coverage_se": "standard error of coverage as an estimate for this period",
}


@dataclass(frozen=True, kw_only=True)
class CoverageErrorSettings:
    """Constants of the standard error of coverage; its docstring's module has the formula.

    Parameters
    ----------
    end_share : float
        Error of a run by the ends of its vehicle, as a share of its length: both ends of a car of
        4.5 m are known to 0.5 m.
    end_most_s : float
        No more than this, seconds: both ends of a vehicle that stops, at 1.5 m/s.
    false_share : float
        Root of the variance of a run that was seen, relative to its length, by vehicles that are
        none and such that are missing: 5 % of each.
    inferred_share : float
        The same of a run that was inferred: 25 % of each kind.
    hidden_share : float
        Root of the variance of the hidden time, relative to its length, as of runs that were
        inferred. Of the tiles hidden for over a tenth of the time, in two simulated places, 6 and
        45 % are within two standard errors without it, 50 and 71 % with it.
    shift_m : float
        Error along the lane that all vehicles share, metres: poses 0.14 m, map 0.25 m.
    least_s : float
        Least error of the covered time, seconds: two steps.
    """

    end_share: float = 0.16
    end_most_s: float = 0.5
    false_share: float = 0.3
    inferred_share: float = 0.7
    hidden_share: float = 0.7
    shift_m: float = 0.3
    least_s: float = 0.1


ERRORS = CoverageErrorSettings()
# Tables hold the roots of standard errors by interval in parts of a 32767th, the largest number of
# two bytes: 0.0001 is kept to 0.3 %, larger ones better.
ERROR_UNIT = 1.0 / 32767**2


class CoverageShares(NamedTuple):
    """One value a tile, in the order of the tiles.

    Parameters
    ----------
    visible_s, covered_s : (n,) float64 arrays
        Seconds; visible is 0 where never, covered is NaN there.
    coverage, coverage_se : (n,) float64 arrays
        Their quotient and its standard error, NaN where not visible.
    """

    visible_s: Floats
    covered_s: Floats
    coverage: Floats
    coverage_se: Floats

    def uncertain(self, least_visible_s: float) -> Booleans:
        """Return what maps hatch.

        That is where the standard error is as large as the coverage and at least 2 percentage
        points, and where a tile was visible for less than so long.
        """
        vague = self.coverage_se >= np.maximum(self.coverage, UNCERTAIN_FROM)
        return (self.visible_s > 0.0) & (vague | (self.visible_s < least_visible_s))


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """Steps in which tiles were visible and covered, for the tiles that some view sees.

    Parameters
    ----------
    visible, covered : (intervals, k) uint32 arrays
        Steps.
    error : (intervals, k) float32 array
        Standard error of the coverage; NaN where not visible.
    error_whole : (k,) float32 array
        That of the whole time.
    """

    visible: NDArray[np.uint32]
    covered: NDArray[np.uint32]
    error: NDArray[np.float32]
    error_whole: NDArray[np.float32]

    def shares(self, seen: Integers, tiles: int, interval: int | slice | None) -> CoverageShares:
        """Return the values of all tiles, of which `seen` are counted here."""
        part = slice(interval) if interval is None else interval
        visible, covered = (
            counts[part] if isinstance(part, int) else counts[part].sum(axis=0, dtype=np.int64)
            for counts in (self.visible, self.covered)
        )
        known = visible > 0
        found = [np.zeros(tiles), *(np.full(tiles, np.nan) for _ in range(3))]
        found[0][seen] = visible / STEPS_PER_SECOND
        place = seen[known]
        found[1][place] = covered[known] / STEPS_PER_SECOND
        found[2][place] = covered[known] / visible[known]
        found[3][place] = self._error(interval, visible)[known]
        return CoverageShares(*found)

    def least_visible_s(self, interval: int | slice | None) -> float:
        """Return half of the longest visible time of a tile; of one interval, of that in any."""
        if isinstance(interval, int):
            longest = self.visible.max(initial=0)
        else:
            part = self.visible[slice(interval) if interval is None else interval]
            longest = part.sum(axis=0, dtype=np.int64).max(initial=0)
        return UNCERTAIN_SEEN * float(longest) / STEPS_PER_SECOND

    def _error(self, interval: int | slice | None, visible: Any) -> Floats:
        if interval is None:
            return np.asarray(self.error_whole, np.float64)
        if isinstance(interval, int):
            return np.asarray(self.error[interval], np.float64)
        parts = np.nan_to_num(self.error[interval]) * self.visible[interval]
        return np.asarray(np.sqrt((parts**2).sum(axis=0)) / np.maximum(visible, 1))


def surest(share: Floats, error: Floats) -> int:
    """Return the tile whose share is highest with its standard error taken off.

    The highest share alone would be that of the tile of which least is known.
    """
    return int(np.nanargmax(share - np.nan_to_num(error)))


def mean_coverage(tiles: gpd.GeoDataFrame, shares: CoverageShares) -> tuple[float, float]:
    """Return the mean coverage over tiles and visible time, and its standard error.

    A vehicle that was missed, or is none, is so all along its lane: the errors of a lane's tiles
    are taken as one error, those of different lanes as independent. On ten simulated sites the
    true mean was within two standard errors on nine.
    """
    total_s = float(shares.visible_s.sum())
    if total_s == 0.0:
        return float("nan"), float("nan")
    error_s = np.nan_to_num(shares.visible_s * shares.coverage_se)
    by_lane = [error_s[lane.rows].sum() for lane in lanes_of(tiles)]
    covered_s = float(np.nansum(shares.covered_s))
    return covered_s / total_s, float(np.linalg.norm(by_lane)) / total_s


def require_same_origin(occupancy: Occupancy, vehicles: Vehicles) -> None:
    """Refuse vehicles that were not made from what the occupancy was made from.

    Raises
    ------
    InputError
        If tiles, sensors, poses or sight differ.
    """
    made = vehicles.provenance
    sights = {json.dumps(s.get("sight", "view only"), sort_keys=True) for s in occupancy.sources}
    pairs = (
        ("tiles", occupancy.fingerprint, made.fingerprint),
        ("sensors", occupancy.sensors, vehicles.sensors),
        ("poses", poses_of(occupancy.sources), made.poses),
        ("sight", sights, {json.dumps(made.sight, sort_keys=True)}),
    )
    for what, mine, other in pairs:
        if mine != other:
            shown = f": {_short(mine)}, {_short(other)}" if what in {"tiles", "sensors"} else ""
            raise InputError(
                f"{occupancy.place} and {vehicles.place} have different {what}{shown}",
                hint="make both from the same recordings, poses, tiles and scans",
            )


def _short(value: Any) -> str:
    return value if isinstance(value, str) else ", ".join(value)


def count_coverage(
    vehicles: Vehicles,
    tiles: gpd.GeoDataFrame,
    seen: Integers,
    timeline: Timeline,
    both: Runs,
    reporter: Reporter,
) -> Coverage:
    """Count visible and covered steps of tiles, block by block.

    Parameters
    ----------
    vehicles : Vehicles
        Read once.
    tiles : GeoDataFrame
        All tiles, by ascending `tile_id`.
    seen : (k,) int64 array
        Positions of the tiles to count.
    timeline : Timeline
        The intervals.
    both : Runs
        The steps that count.
    reporter : Reporter
        Where progress goes.

    Raises
    ------
    InputError
        If a run names a tile that is not there.
    """
    column = np.full(len(tiles), -1)
    column[seen] = np.arange(len(seen))
    shape = (len(timeline), len(seen))
    visible, covered = (np.zeros(shape, np.uint32) for _ in range(2))
    squares, whole = np.zeros(shape), np.zeros(len(seen))
    hidden = np.zeros(shape)
    tile_ids = tiles["tile_id"].to_numpy(np.int64)
    for number, block in enumerate(vehicles.blocks()):
        shown, under = (
            _runs_at(table, tile_ids, column) for table in (block.visible, block.covered)
        )
        shown = _within(shown, both)
        under = _while(under, _joined(shown), block.number * BLOCK_STEPS)
        whole += np.bincount(under["at"], _square_of(under), len(seen))
        for runs, counts in ((shown, visible), (under, covered)):
            parts = _by_interval(runs, timeline)
            place = parts["interval"].to_numpy() * len(seen) + parts["at"].to_numpy()
            steps = (parts["last"] - parts["first"] + 1).to_numpy()
            np.add.at(counts.reshape(-1), place, steps.astype(np.uint32))
            if counts is covered:
                np.add.at(squares.reshape(-1), place, _square_of(parts))
            else:
                np.add.at(hidden.reshape(-1), place, np.where(parts["seen"], 0, steps))
        reporter.progress("counting vehicles", number + 1, None)
    slopes = _LaneSlopes.of(tiles, seen)
    counted = zip(visible, covered, squares, hidden, strict=True)
    errors = [slopes.error(*each) for each in counted]
    total = visible.sum(axis=0, dtype=np.int64), covered.sum(axis=0, dtype=np.int64)
    return Coverage(
        visible=visible, covered=covered, error=_rounded(np.stack(errors)),
        error_whole=slopes.error(*total, whole, hidden.sum(axis=0)).astype(np.float32),
    )  # fmt: skip


def error_roots(errors: Floats) -> Integers:
    """Return roots of standard errors, 0 to 1, as the whole numbers that tables hold."""
    return np.rint(np.sqrt(errors / ERROR_UNIT)).astype(np.int64)


def _rounded(errors: Floats) -> NDArray[np.float32]:
    """Return standard errors as tables hold them, so that a map read back is the same."""
    roots = error_roots(np.nan_to_num(errors))
    return np.where(np.isnan(errors), np.nan, roots * roots * ERROR_UNIT).astype(np.float32)


def _runs_at(table: pd.DataFrame, tile_ids: Integers, column: Integers) -> pd.DataFrame:
    """Return the runs of tiles that are counted: `at`, their columns, `first`, `last`, `seen`."""
    wanted = table["tile_id"].to_numpy(np.int64)
    position = np.minimum(np.searchsorted(tile_ids, wanted), len(tile_ids) - 1)
    if (unknown := wanted[tile_ids[position] != wanted]).size:
        raise InputError(f"the vehicles name tile {unknown[0]}, which the tiles lack")
    runs = pd.DataFrame(
        {
            "at": column[position],
            "first": table["first_step"].to_numpy(np.int64),
            "last": table["last_step"].to_numpy(np.int64),
            "seen": table.get("seen", True),
        }
    )
    return runs[runs["at"] >= 0].sort_values(["at", "first"], ignore_index=True)


def _within(runs: pd.DataFrame, steps: Runs) -> pd.DataFrame:
    """Return the parts of runs in a set of steps."""
    first = np.searchsorted(steps.last, runs["first"])
    count = np.searchsorted(steps.first, runs["last"], side="right") - first
    return _parts(runs, count, steps.first[at := ranges(first, count)], steps.last[at])


def _joined(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs of a tile that follow each other as one, be they of seen steps or not."""
    at, first, last = (runs[name].to_numpy(np.int64) for name in ("at", "first", "last"))
    follows = (np.diff(at, prepend=-1) == 0) & (first == np.append(-1, last[:-1]) + 1)
    begins = np.flatnonzero(~follows)
    ends = np.append(begins[1:], len(runs)) - 1
    return pd.DataFrame({"at": at[begins], "first": first[begins], "last": last[ends]})


def _while(runs: pd.DataFrame, others: pd.DataFrame, begin: int) -> pd.DataFrame:
    """Return the parts of runs while others of the same tile last; all of one block."""
    shift = others["at"].to_numpy() * BLOCK_STEPS - begin
    first, last = (others[name].to_numpy() + shift for name in ("first", "last"))
    mine = runs["at"].to_numpy() * BLOCK_STEPS - begin
    low = np.searchsorted(last, runs["first"] + mine)
    count = np.searchsorted(first, runs["last"] + mine, side="right") - low
    at = ranges(low, count)
    return _parts(runs, count, *(others[name].to_numpy()[at] for name in ("first", "last")))


def _by_interval(runs: pd.DataFrame, timeline: Timeline) -> pd.DataFrame:
    """Return the parts of runs in each interval, with its number."""
    first = np.searchsorted(timeline.end, runs["first"], side="right")
    count = np.searchsorted(timeline.begin, runs["last"], side="right") - first
    interval = ranges(first, count)
    parts = _parts(runs, count, timeline.begin[interval], timeline.end[interval] - 1)
    return parts.assign(interval=interval)


def _parts(runs: pd.DataFrame, count: Any, first: Integers, last: Integers) -> pd.DataFrame:
    """Repeat runs, each so often, and cut them to a span each."""
    found = runs.iloc[np.repeat(np.arange(len(runs)), count)].reset_index(drop=True)
    return found.assign(
        first=np.maximum(found["first"], first), last=np.minimum(found["last"], last)
    )


def _square_of(runs: pd.DataFrame) -> Floats:
    """Return the variance of the length of runs, steps squared."""
    steps = (runs["last"] - runs["first"] + 1).to_numpy(np.float64)
    ends = np.minimum(ERRORS.end_share * steps, ERRORS.end_most_s / STEP_S)
    share = np.where(runs["seen"], ERRORS.false_share, ERRORS.inferred_share)
    return np.asarray(ends**2 + (share * steps) ** 2, np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class _LaneSlopes:
    """The tiles before and after each tile of a lanelet, to see how coverage changes along it."""

    seen: Integers
    s_m: Floats
    linked: NDArray[np.bool_]  # whether a tile follows the one before it in the table

    @classmethod
    def of(cls, tiles: gpd.GeoDataFrame, seen: Integers) -> _LaneSlopes:
        lanelet, index = (tiles[n].to_numpy(np.int64) for n in ("lanelet_id", "index"))
        linked = np.zeros(len(tiles) + 1, np.bool_)
        linked[1:-1] = (lanelet[1:] == lanelet[:-1]) & (np.diff(index) == 1)
        middle = tiles["s_m"].to_numpy(float) + tiles["length_m"].to_numpy(float) / 2
        return cls(seen=seen, s_m=middle, linked=linked)

    def error(self, visible: Any, covered: Any, squares: Floats, hidden: Floats) -> Floats:
        """Return the standard error of coverage of the counted tiles, NaN where not visible."""
        time, coverage = np.maximum(visible, 1), covered / np.maximum(visible, 1)
        share = np.full(len(self.s_m), np.nan)
        share[self.seen] = np.where(visible > 0, coverage, np.nan)
        unknown = (ERRORS.hidden_share * hidden) ** 2 * coverage * (1.0 - coverage)
        slope = self._slope(share)[self.seen]
        least = ERRORS.least_s / STEP_S / time
        found = np.sqrt((squares + unknown) / time**2 + (ERRORS.shift_m * slope) ** 2)
        return np.where(visible > 0, np.clip(found, np.minimum(least, 1.0), 1.0), np.nan)

    def _slope(self, share: Floats) -> Floats:
        """Return the steepest change of a share towards the tile before or after, a metre."""
        change = np.zeros(len(share) + 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            steps = np.abs(np.diff(share)) / np.diff(self.s_m)
        change[1:-1] = np.where(self.linked[1:-1], np.nan_to_num(steps), 0.0)
        return np.maximum(change[:-1], change[1:])

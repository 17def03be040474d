"""Scores of an estimated coverage against the true one, over tiles in sight."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from true_coverage import TrueCoverage

from gis_radar.arrays import Floats
from gis_radar.heatmap.covering import count_coverage
from gis_radar.heatmap.intervals import Timeline
from gis_radar.progress import QUIET
from gis_radar.steps import STEP_S
from gis_radar.vehicles import read_vehicles

BUSY = 0.01  # a tile with more is one that vehicles use
WITHIN = 2.0  # standard errors; 95 % of the errors should be


@dataclass(frozen=True, kw_only=True)
class CoverageScore:
    """How well an estimated coverage agrees with the truth.

    Parameters
    ----------
    tiles : int
        Tiles that are truly in sight and visible in some step.
    true_mean : float
        Their mean true coverage.
    answered : float
        Share of them, by visible time, for which there is an estimate; what follows is over these.
    rank : float
        Spearman's rank correlation.
    scale : float
        Sum of the estimates over the sum of the truth.
    mae_percent : float
        Mean absolute error, percent of the time.
    r2 : float
        Coefficient of determination.
    false_zeros : float
        Share of the tiles covered for over a hundredth of the time that are estimated as empty.
    false_busy : float
        Share of the tiles that are never covered which are estimated at over a hundredth.
    beyond : float
        Estimates for tiles that are not truly in sight, as a share of all estimates.
    within_2_se : float
        Share of the tiles whose error is within two standard errors, where these are given.
    """

    tiles: int
    true_mean: float
    answered: float
    rank: float
    scale: float
    mae_percent: float
    r2: float
    false_zeros: float
    false_busy: float
    beyond: float
    within_2_se: float = float("nan")


def score_coverage(truth: TrueCoverage, table: pd.DataFrame) -> CoverageScore:
    """Return the score of a table of estimates.

    Parameters
    ----------
    truth : TrueCoverage
        What is true.
    table : DataFrame
        ``tile_id`` and ``coverage`` in [0, 1], NaN where there is no estimate, or ``covered_s`` and
        ``visible_s``; where there is, ``coverage_se``.
    """
    given = (
        with_coverage(table)
        .dropna(subset="coverage")
        .drop(columns=["covered_s", "visible_s"], errors="ignore")
    )
    true = truth.table()
    true = true[true["visible_s"] > 0.0]
    both = true.merge(given, on="tile_id", how="left", suffixes=("", "_given"))
    told = both["coverage_given"].notna()
    answered = both.loc[told, "visible_s"].sum() / max(both["visible_s"].sum(), 1e-9)
    both = both[told]
    exact, estimate = both["coverage"].to_numpy(), both["coverage_given"].to_numpy()
    error = np.full(len(both), np.nan)
    if "coverage_se" in both:
        error = np.abs(estimate - exact) / np.maximum(both["coverage_se"].to_numpy(), 1e-9)
    return CoverageScore(
        tiles=len(true),
        true_mean=float(true["coverage"].mean()),
        answered=float(answered),
        **agreement(estimate, exact),
        beyond=float(1.0 - given["tile_id"].isin(true["tile_id"]).mean()) if len(given) else np.nan,
        within_2_se=float((error < WITHIN).mean()) if np.isfinite(error).any() else np.nan,
    )


def with_coverage(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the column ``coverage``, from the seconds where it is not there."""
    if "coverage" in table:
        return table
    with np.errstate(invalid="ignore", divide="ignore"):
        return table.assign(coverage=table["covered_s"] / table["visible_s"])


def agreement(estimate: Floats, exact: Floats) -> dict[str, float]:
    """Return rank, scale, error, R2 and false zeros of estimates beside exact values."""
    if len(exact) == 0:
        names = ("rank", "scale", "mae_percent", "r2", "false_zeros", "false_busy")
        return dict.fromkeys(names, float("nan"))
    busy, empty = exact > BUSY, exact == 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        constant = np.ptp(exact) == 0.0 or np.ptp(estimate) == 0.0
        spread = np.sum((exact - exact.mean()) ** 2)
        return {
            "rank": np.nan if constant else float(spearmanr(estimate, exact).statistic),
            "scale": float(np.divide(estimate.sum(), exact.sum())),
            "mae_percent": float(100.0 * np.abs(estimate - exact).mean()),
            "r2": float(1.0 - np.divide(np.sum((estimate - exact) ** 2), spread)),
            "false_zeros": float((estimate[busy] == 0.0).mean()) if busy.any() else 0.0,
            "false_busy": float((estimate[empty] > BUSY).mean()) if empty.any() else 0.0,
        }


def coverage_of_folder(folder: Path, tiles: gpd.GeoDataFrame | None = None) -> pd.DataFrame:
    """Return the coverage of a folder of vehicles: covered and visible runs, summed by tile.

    With tiles, also the standard error that the package states.
    """
    table = _summed(folder)
    return table if tiles is None else table.merge(standard_errors(folder, tiles), on="tile_id")


def standard_errors(folder: Path, tiles: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return ``tile_id coverage_se`` over the whole time, as a heat map states it."""
    vehicles = read_vehicles(folder)
    tiles = tiles.sort_values("tile_id", ignore_index=True)
    seen, steps = np.arange(len(tiles)), vehicles.covered_frames()
    first, last = int(steps.first[0]), int(steps.last[-1])
    timeline = Timeline(begin=np.array([first]), end=np.array([last + 1]))
    counted = count_coverage(vehicles, tiles, seen, timeline, steps, QUIET)
    error = counted.shares(seen, len(tiles), None).coverage_se
    return pd.DataFrame({"tile_id": tiles["tile_id"], "coverage_se": error})


def _summed(folder: Path) -> pd.DataFrame:
    visible = pd.read_parquet(folder / "visible.parquet")
    covered = pd.read_parquet(folder / "covered.parquet")
    seconds = {
        f"{name}_s": (runs["last_step"] - runs["first_step"] + 1).groupby(runs["tile_id"]).sum()
        * STEP_S
        for name, runs in (("visible", visible), ("covered", _within(covered, visible)))
    }
    table = pd.DataFrame(seconds).reset_index().fillna({"covered_s": 0.0})
    return table[table["visible_s"] > 0.0]


def _within(covered: pd.DataFrame, visible: pd.DataFrame) -> pd.DataFrame:
    """Return the parts of covered runs that are visible."""
    pairs = covered.merge(visible, on="tile_id", suffixes=("", "_visible"))
    first = pairs[["first_step", "first_step_visible"]].max(axis=1)
    last = pairs[["last_step", "last_step_visible"]].min(axis=1)
    parts = pd.DataFrame({"tile_id": pairs["tile_id"], "first_step": first, "last_step": last})
    return parts[first <= last]


def plain(score: CoverageScore) -> dict[str, float]:
    """Return a score as a dict."""
    return asdict(score)

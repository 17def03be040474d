"""Scores of an estimated occupancy against the true one, over tiles in sight."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from true_occupancy import TrueOccupancy

from gis_radar.arrays import Floats

BUSY = 0.01  # a tile with more is one that vehicles use
WITHIN = 2.0  # standard errors; 95 % of the errors should be


@dataclass(frozen=True, kw_only=True)
class OccupancyScore:
    """How well an estimated occupancy agrees with the truth.

    Parameters
    ----------
    tiles : int
        Tiles that are truly in sight and visible in some step.
    true_mean : float
        Their mean true occupancy.
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
        Share of the tiles occupied for over a hundredth of the time that are estimated as empty.
    false_busy : float
        Share of the tiles that are never occupied which are estimated at over a hundredth.
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


def score_occupancy(truth: TrueOccupancy, table: pd.DataFrame) -> OccupancyScore:
    """Return the score of a table of estimates.

    Parameters
    ----------
    truth : TrueOccupancy
        What is true.
    table : DataFrame
        ``tile_id`` and ``occupancy`` in [0, 1], NaN where there is none, or ``occupied_s`` and
        ``visible_s``; where there is, ``occupancy_se``.
    """
    given = (
        with_occupancy(table)
        .dropna(subset="occupancy")
        .drop(columns=["occupied_s", "visible_s"], errors="ignore")
    )
    true = truth.table()
    true = true[true["visible_s"] > 0.0]
    both = true.merge(given, on="tile_id", how="left", suffixes=("", "_given"))
    told = both["occupancy_given"].notna()
    answered = both.loc[told, "visible_s"].sum() / max(both["visible_s"].sum(), 1e-9)
    both = both[told]
    exact, estimate = both["occupancy"].to_numpy(), both["occupancy_given"].to_numpy()
    error = np.full(len(both), np.nan)
    if "occupancy_se" in both:
        error = np.abs(estimate - exact) / np.maximum(both["occupancy_se"].to_numpy(), 1e-9)
    return OccupancyScore(
        tiles=len(true),
        true_mean=float(true["occupancy"].mean()),
        answered=float(answered),
        **agreement(estimate, exact),
        beyond=float(1.0 - given["tile_id"].isin(true["tile_id"]).mean()) if len(given) else np.nan,
        within_2_se=float((error < WITHIN).mean()) if np.isfinite(error).any() else np.nan,
    )


def with_occupancy(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the column ``occupancy``, from the seconds where it is not there."""
    if "occupancy" in table:
        return table
    with np.errstate(invalid="ignore", divide="ignore"):
        return table.assign(occupancy=table["occupied_s"] / table["visible_s"])


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


def plain(score: OccupancyScore) -> dict[str, float]:
    """Return a score as a dict."""
    return asdict(score)

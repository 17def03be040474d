"""Scores of an estimated occupancy against the true one, over tiles in sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from true_occupancy import TrueOccupancy, middle_lines

import gis_radar as gr
from gis_radar.base import STEP_S, Booleans, Floats

RANGES_M = (0.0, 50.0, 100.0, 200.0)
HIDDEN_SHARE = 0.1  # of the visible time: other vehicles hide a tile of the group `hidden` longer
STANDING_S = 2.0  # mean time for which a vehicle occupies a tile of the group `standing`, at least
WITHIN_SIGMAS = 2.0  # 95 % of the errors should be


@dataclass(frozen=True, kw_only=True)
class OccupancyScore:
    """Agreement of an estimated occupancy with the truth.

    Parameters
    ----------
    tiles : int
        Tiles that are truly in sight and visible in some step.
    true_mean : float
        Their mean true occupancy.
    answered : float
        Share of them, by visible time, for which there is an estimate; the rest is over these.
    rank : float
        Spearman's rank correlation.
    scale : float
        Sum of the estimates over the sum of the truth.
    mae_percent : float
        Mean absolute error, percent of the time.
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
    beyond: float
    within_2_se: float = float("nan")


def score_occupancy(truth: TrueOccupancy, table: pd.DataFrame) -> OccupancyScore:
    """Return the score of a table of estimates.

    Parameters
    ----------
    truth : TrueOccupancy
        The truth.
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
        within_2_se=float((error < WITHIN_SIGMAS).mean()) if np.isfinite(error).any() else np.nan,
    )


def with_occupancy(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the column ``occupancy``, computed from seconds where it is missing."""
    if "occupancy" in table:
        return table
    with np.errstate(invalid="ignore", divide="ignore"):
        return table.assign(occupancy=table["occupied_s"] / table["visible_s"])


def agreement(estimate: Floats, exact: Floats) -> dict[str, float]:
    """Return rank, scale and mean error of estimates beside exact values."""
    if len(exact) == 0:
        return dict.fromkeys(("rank", "scale", "mae_percent"), float("nan"))
    constant = np.ptp(exact) == 0.0 or np.ptp(estimate) == 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            "rank": np.nan if constant else float(spearmanr(estimate, exact).statistic),
            "scale": float(np.divide(estimate.sum(), exact.sum())),
            "mae_percent": float(100.0 * np.abs(estimate - exact).mean()),
        }


def score_by_tiles(
    truth: TrueOccupancy, table: pd.DataFrame, tiles: gpd.GeoDataFrame, poses: Sequence[gr.Pose]
) -> dict[str, dict[str, float]]:
    """Return the agreement by groups of tiles: by range, hidden or not, moving or standing."""
    given = with_occupancy(table).set_index("tile_id")["occupancy"]
    true = truth.table()
    estimate, exact = true["tile_id"].map(given).to_numpy(np.float64), true["occupancy"].to_numpy()
    known = np.isfinite(estimate) & np.isfinite(exact)
    groups = _tile_groups(tiles, truth, poses)
    return {name: agreement(estimate[known & g], exact[known & g]) for name, g in groups.items()}


def _tile_groups(
    tiles: gpd.GeoDataFrame, truth: TrueOccupancy, poses: Sequence[gr.Pose]
) -> dict[str, Booleans]:
    """Return by group which of the truth's tiles are in it."""
    place = middle_lines(tiles.set_index("tile_id").loc[truth.tile_id]).mean(axis=1)
    eyes = np.array([pose.position[:2] for pose in poses])
    reach = np.hypot(*np.moveaxis(place[:, None] - eyes, -1, 0)).min(axis=1)
    hidden = (truth.blocked & truth.visible).sum(axis=1) > HIDDEN_SHARE * truth.visible.sum(axis=1)
    begins = truth.occupied[:, 0] + (truth.occupied[:, 1:] & ~truth.occupied[:, :-1]).sum(axis=1)
    stays = truth.occupied.sum(axis=1) * STEP_S / np.maximum(begins, 1)
    busy = begins > 0
    return {
        **{f"{a:.0f}-{b:.0f} m": (a <= reach) & (reach < b) for a, b in pairwise(RANGES_M)},
        "plain view": ~hidden, "hidden": hidden, "moving": busy & (stays < STANDING_S),
        "standing": busy & (stays >= STANDING_S), "empty": ~busy,
    }  # fmt: skip

"""Where an estimated occupancy is wrong: by range, by what hides, by standing and moving traffic.

Tiles are grouped by the truth alone. Steps are compared one by one: what is missed in plain view,
what is missed while other vehicles hide it, what is false.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import geopandas as gpd
import numpy as np
import pandas as pd
from score import agreement, with_occupancy
from true_occupancy import TrueOccupancy, middle_lines

import gis_radar as gr
from gis_radar.arrays import Booleans
from gis_radar.steps import STEP_S

RANGES_M = (0.0, 50.0, 100.0, 200.0)
HIDDEN = 0.1  # share of the visible time in which other vehicles hide a tile
STANDS_S = 2.0  # a tile on which vehicles stay so long on average is one where they stand
BESIDE = 8  # tiles, 4 m: a false step so near to a true one is a vehicle that is not well placed


def tile_groups(
    tiles: gpd.GeoDataFrame, truth: TrueOccupancy, poses: Sequence[gr.Pose]
) -> dict[str, Booleans]:
    """Return groups of the truth's tiles."""
    place = middle_lines(tiles.set_index("tile_id").loc[truth.tile_id]).mean(axis=1)
    eyes = np.array([pose.position[:2] for pose in poses])
    reach = np.hypot(*np.moveaxis(place[:, None] - eyes, -1, 0)).min(axis=1)
    visible = truth.visible.sum(axis=1)
    hidden = (truth.blocked & truth.visible).sum(axis=1) > HIDDEN * visible
    begins = truth.occupied[:, 0] + (truth.occupied[:, 1:] & ~truth.occupied[:, :-1]).sum(axis=1)
    stays = truth.occupied.sum(axis=1) * STEP_S / np.maximum(begins, 1)
    busy = begins > 0
    return {
        **{f"{a:.0f}-{b:.0f} m": (a <= reach) & (reach < b) for a, b in pairwise(RANGES_M)},
        "plain view": ~hidden, "hidden": hidden, "moving": busy & (stays < STANDS_S),
        "standing": busy & (stays >= STANDS_S), "empty": ~busy,
    }  # fmt: skip


def by_group(
    truth: TrueOccupancy, table: pd.DataFrame, groups: dict[str, Booleans]
) -> dict[str, dict[str, float]]:
    """Return rank, scale, error and the share within two standard errors of each group."""
    given = with_occupancy(table).set_index("tile_id")
    true = truth.table()
    estimate = true["tile_id"].map(given["occupancy"]).to_numpy(np.float64)
    exact = true["occupancy"].to_numpy()
    error = np.full(len(true), np.nan)
    if "occupancy_se" in given:
        stated = true["tile_id"].map(given["occupancy_se"]).to_numpy(np.float64)
        error = np.abs(estimate - exact) / np.maximum(stated, 1e-9)
    told = np.isfinite(estimate) & np.isfinite(exact)
    found = {}
    for name, group in groups.items():
        chosen = told & group
        figures = agreement(estimate[chosen], exact[chosen])
        figures["tiles"] = float(chosen.sum())
        known = error[chosen & np.isfinite(error)]
        figures["within_2_se"] = float((known < 2.0).mean()) if len(known) else float("nan")
        found[name] = figures
    return found


def step_errors(
    occupied: Booleans, tiles: gpd.GeoDataFrame, truth: TrueOccupancy
) -> dict[str, float]:
    """Return what is missed and what is false, as shares of the truly occupied and visible time.

    `late` is what a vehicle covers that is there, but up to 4 m from where it was put; `false` the
    rest.
    """
    given = occupied & truth.visible
    true = truth.occupied & truth.visible
    total = max(int(true.sum()), 1)
    missed, false = true & ~given, given & ~true
    near = _spread(truth.occupied, tiles, truth)
    return {
        "missed_in_view": float((missed & ~truth.blocked).sum() / total),
        "missed_hidden": float((missed & truth.blocked).sum() / total),
        "misplaced": float((false & near).sum() / total),
        "false_in_view": float((false & ~near & ~truth.blocked).sum() / total),
        "false_hidden": float((false & ~near & truth.blocked).sum() / total),
    }


def _spread(occupied: Booleans, tiles: gpd.GeoDataFrame, truth: TrueOccupancy) -> Booleans:
    """Return where a tile of the same lanelet within 4 m is occupied."""
    known = tiles.set_index("tile_id").loc[truth.tile_id]
    lanelet, index = (known[name].to_numpy(np.int64) for name in ("lanelet_id", "index"))
    order = np.lexsort((index, lanelet))
    count = np.zeros((len(order) + 1, occupied.shape[1]), np.int32)
    np.cumsum(occupied[order], axis=0, out=count[1:])
    key = np.unique(lanelet[order], return_inverse=True)[1] * 1_000_000 + index[order]
    low = np.searchsorted(key, key - BESIDE)
    high = np.searchsorted(key, key + BESIDE, side="right")
    near = np.empty_like(occupied)
    near[order] = count[high] > count[low]
    return near

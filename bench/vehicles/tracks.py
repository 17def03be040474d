"""Recall, precision and errors of estimated vehicles beside the true ones.

Only states that are *due* count: the vehicle's middle is on a tile that is visible in the step. A
state that is not due may be matched, and is neither missed nor false.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from true_occupancy import TrueOccupancy, middle_lines
from true_traffic import HEAVY_M, TrueTraffic

from gis_radar.base import Booleans, Floats, Integers

MATCH_M = 4.0  # distance of states of one vehicle, at most
DOUBLE_M = 8.0  # a false vehicle so near to a true one is its double
EVERY_STEPS = 10  # in which states are compared
ON_TILE_M = 2.0  # from a tile's middle to a vehicle on it: half of a lane and a little
ASIDE_M = 1.5  # vehicles farther apart across the lane do not overlap
LEAST_DUE_S = 1.0  # vehicles that are due for less do not count
FOUND_SHARE = 0.5  # of its due time in which a found or real vehicle is matched, at least
COLUMNS = ("vehicle", "step", "easting", "northing", "heading", "speed", "length")


@dataclass(frozen=True, kw_only=True)
class Scored:
    """States that are compared, a row a vehicle and step.

    Parameters
    ----------
    true, given : DataFrame
        `COLUMNS` (heading in rad), ``due``; sorted by step.
    """

    true: pd.DataFrame = field(repr=False)
    given: pd.DataFrame = field(repr=False)


def compared(
    tiles: gpd.GeoDataFrame, truth: TrueOccupancy, traffic: TrueTraffic, given: pd.DataFrame
) -> Scored:
    """Return the states that are compared, with whether they are due."""
    seen = tiles[tiles["tile_id"].isin(truth.tile_id)]
    middles = middle_lines(seen).mean(axis=1)
    tree = cKDTree(middles)
    last = truth.first_step + truth.occupied.shape[1] - 1
    sides = {}
    for name, table in (("true", traffic.states[list(COLUMNS)]), ("given", given)):
        inside = table["step"].between(truth.first_step, last)
        rows = table[inside & ((table["step"] - truth.first_step) % EVERY_STEPS == 0)]
        rows = rows.sort_values(["step", "vehicle"], ignore_index=True)
        place = rows[["easting", "northing"]].to_numpy()
        away, tile = tree.query(place, distance_upper_bound=ON_TILE_M)
        on, tile = np.isfinite(away), np.minimum(tile, len(middles) - 1)
        step = rows["step"].to_numpy() - truth.first_step
        sides[name] = rows.assign(due=on & truth.visible[tile, step])
    return Scored(**sides)


def similarity(true: pd.DataFrame, given: pd.DataFrame) -> Floats:
    """Return the overlap along the lane of each pair: intersection over union of lengths."""
    heading = true["heading"].to_numpy()[:, None]
    east = given["easting"].to_numpy() - true["easting"].to_numpy()[:, None]
    north = given["northing"].to_numpy() - true["northing"].to_numpy()[:, None]
    along = np.cos(heading) * east + np.sin(heading) * north
    aside = np.cos(heading) * north - np.sin(heading) * east
    one, other = true["length"].to_numpy()[:, None] / 2.0, given["length"].to_numpy() / 2.0
    both = np.minimum(one, along + other) - np.maximum(-one, along - other)
    union = np.maximum(one, along + other) - np.minimum(-one, along - other)
    return np.where(np.abs(aside) < ASIDE_M, np.maximum(both, 0.0) / union, 0.0)


def by_step(scored: Scored) -> list[tuple[pd.DataFrame, pd.DataFrame]]:
    """Return the true and the given rows of each step."""
    sides = (scored.true, scored.given)
    steps = np.unique(np.concatenate([side["step"].to_numpy() for side in sides]))
    ends = [np.searchsorted(side["step"].to_numpy(), [steps, steps + 1]).T for side in sides]
    return [
        (scored.true.iloc[a:b], scored.given.iloc[c:d])
        for (a, b), (c, d) in zip(*(e.tolist() for e in ends), strict=True)
    ]


def matched(scored: Scored) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Match states within 4 m at each step, by the least sum of squared distances.

    Returns
    -------
    true, given : DataFrame
        The rows, with ``match`` (the row of the other table, -1: none); of the given ones
        ``doubled``: not matched, and near a true one.
    """
    true = scored.true.assign(match=-1)
    given = scored.given.assign(match=-1, doubled=False)
    for one, other in by_step(scored):
        places = [side[["easting", "northing"]].to_numpy() for side in (one, other)]
        if len(one) == 0 or len(other) == 0:
            continue
        apart = np.hypot(*np.moveaxis(places[0][:, None] - places[1], -1, 0))
        row, column = assign(apart)
        true.loc[one.index[row], "match"] = other.index[column].to_numpy()
        given.loc[other.index[column], "match"] = one.index[row].to_numpy()
        given.loc[other.index[apart.min(axis=0) < DOUBLE_M], "doubled"] = True
    given["doubled"] &= given["match"] < 0
    return true, given


def assign(apart: Floats) -> tuple[Integers, Integers]:
    """Return the pairs within 4 m of the best assignment, from all distances."""
    row, column = linear_sum_assignment(np.minimum(apart, MATCH_M) ** 2)
    near = apart[row, column] < MATCH_M
    return row[near], column[near]


def score_tracks(scored: Scored) -> dict[str, float]:
    """Return all figures of estimated vehicles."""
    true, given = matched(scored)
    recall, real = true["match"].to_numpy() >= 0, given["match"].to_numpy() >= 0
    due, claimed = true["due"].to_numpy(), given["due"].to_numpy()
    return {
        "recall": _share(recall, due),
        "precision": _share(real, claimed),
        "doubled": _share(given["doubled"].to_numpy(), claimed),
        "found": _vehicles(true, recall),
        "real": _vehicles(given, real),
        **_errors(true, given),
    }


def _share(flags: Booleans, among: Booleans) -> float:
    return float(flags[among].mean()) if among.any() else float("nan")


def _vehicles(table: pd.DataFrame, good: Booleans) -> float:
    """Return the share of the vehicles that are matched in half of their due time."""
    rows = pd.Series(good[table["due"]]).groupby(table.loc[table["due"], "vehicle"].to_numpy())
    share = rows.mean()[rows.size() * EVERY_STEPS * 0.05 >= LEAST_DUE_S]
    return float((share >= FOUND_SHARE).mean()) if len(share) else float("nan")


def _errors(true: pd.DataFrame, given: pd.DataFrame) -> dict[str, float]:
    """Return errors of place, speed and length of states that are due and matched."""
    pair = true[true["due"] & (true["match"] >= 0)]
    if len(pair) == 0:
        names = ("along_m", "across_m", "speed_mps", "length_m", "length_bias_m")
        return dict.fromkeys((*names, "two_groups"), float("nan"))
    other = given.loc[pair["match"]]
    east, north = ((other[c].to_numpy() - pair[c].to_numpy()) for c in ("easting", "northing"))
    cos, sin = np.cos(pair["heading"]), np.sin(pair["heading"])
    speed = np.abs(other["speed"].to_numpy() - pair["speed"].to_numpy())
    groups = [pair["vehicle"].to_numpy(), other["vehicle"].to_numpy()]
    lengths = pd.DataFrame({"true": pair["length"].to_numpy(), "given": other["length"].to_numpy()})
    each = lengths.groupby(groups).agg({"true": "first", "given": "mean"})
    longer = each["given"] - each["true"]
    return {
        "along_m": float(np.sqrt(np.mean((cos * east + sin * north) ** 2))),
        "across_m": float(np.sqrt(np.mean((cos * north - sin * east) ** 2))),
        "speed_mps": float(np.median(speed)),
        "length_m": float(longer.abs().median()),
        "length_bias_m": float(longer.mean()),
        "two_groups": float(((each["given"] > HEAVY_M) == (each["true"] > HEAVY_M)).mean()),
    }

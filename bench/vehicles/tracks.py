"""Estimated vehicles beside the true ones: found or not, how far off, and HOTA.

Only what is due counts: a vehicle whose middle is on a tile that is visible in the step. A vehicle
that is not due may be matched, and is neither missed nor false.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from true_occupancy import TrueOccupancy, middle_lines
from true_traffic import HEAVY_M, TrueTraffic

import gis_radar as gr
from gis_radar.arrays import Booleans, Floats, Integers

CUT_M, POWER = 4.0, 2.0  # of GOSPA
EVERY = 10  # steps; states are compared so often
ON_TILE_M = 2.0  # a lane's half and a little
ASIDE_M = 1.5  # vehicles farther apart across the lane do not overlap
STANDING_MPS = 5.0 / 3.6
ALPHAS = np.arange(0.05, 0.96, 0.05)
SEEN_S, FOUND = 1.0, 0.5  # vehicles due for less do not count; found or real in half of the time
RANGES_M = (0.0, 50.0, 100.0, 200.0)
COLUMNS = ("vehicle", "step", "easting", "northing", "heading", "speed", "length")


@dataclass(frozen=True, kw_only=True)
class Scored:
    """What is compared, a row a vehicle and step.

    Parameters
    ----------
    true, given : DataFrame
        `COLUMNS` (heading in rad), ``due``, ``hidden``, ``range_m``; sorted by step.
    """

    true: pd.DataFrame = field(repr=False)
    given: pd.DataFrame = field(repr=False)


def compared(
    tiles: gpd.GeoDataFrame, truth: TrueOccupancy, poses: list[gr.Pose], traffic: TrueTraffic,
    given: pd.DataFrame,
) -> Scored:  # fmt: skip
    """Return the states that are compared, with what is due."""
    seen = tiles[tiles["tile_id"].isin(truth.tile_id)]
    middles = middle_lines(seen).mean(axis=1)
    tree, eyes = cKDTree(middles), np.array([pose.position[:2] for pose in poses])
    last = truth.first_step + truth.occupied.shape[1] - 1
    sides = {}
    for name, table in (("true", traffic.states[list(COLUMNS)]), ("given", given)):
        inside = table["step"].between(truth.first_step, last)
        rows = table[inside & ((table["step"] - truth.first_step) % EVERY == 0)]
        rows = rows.sort_values(["step", "vehicle"], ignore_index=True)
        place = rows[["easting", "northing"]].to_numpy()
        away, tile = tree.query(place, distance_upper_bound=ON_TILE_M)
        on, tile = np.isfinite(away), np.minimum(tile, len(middles) - 1)
        step = rows["step"].to_numpy() - truth.first_step
        reach = np.hypot(*np.moveaxis(place[:, None] - eyes, -1, 0)).min(axis=1)
        sides[name] = rows.assign(
            due=on & truth.visible[tile, step],
            hidden=on & truth.blocked[tile, step],
            range_m=reach,
        )
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


def matched(scored: Scored) -> tuple[pd.DataFrame, pd.DataFrame, float]:
    """Match states within 4 m at each step, as GOSPA does.

    Returns
    -------
    true, given : DataFrame
        The rows, with ``match``: the row of the other side, -1 where there is none.
    gospa : float
        Root mean square over the steps, metres (p 2, c 4 m).
    """
    true = scored.true.assign(match=-1)
    given = scored.given.assign(match=-1)
    costs = []
    for one, other in by_step(scored):
        places = (side[["easting", "northing"]].to_numpy() for side in (one, other))
        row, column, apart = assign(*places)
        true.loc[one.index[row], "match"] = other.index[column].to_numpy()
        given.loc[other.index[column], "match"] = one.index[row].to_numpy()
        due = one["due"].to_numpy()[row] | other["due"].to_numpy()[column]
        alone = _left(one["due"], row) + _left(other["due"], column)
        costs.append(np.sum(apart[due] ** POWER) + alone * CUT_M**POWER / 2.0)
    gospa = float(np.sqrt(np.mean(costs))) if costs else float("nan")
    return true, given, gospa


def _left(due: pd.Series, taken: Integers) -> int:
    """Return how many that are due were not taken."""
    flags = due.to_numpy().copy()
    flags[taken] = False
    return int(flags.sum())


def assign(one: Floats, other: Floats) -> tuple[Integers, Integers, Floats]:
    """Return the pairs of places within 4 m that GOSPA's best assignment makes, and distances."""
    apart = np.hypot(*np.moveaxis(one[:, None] - other, -1, 0)) if len(one) and len(other) else None
    if apart is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    row, column = linear_sum_assignment(np.minimum(apart, CUT_M) ** POWER)
    near = apart[row, column] < CUT_M
    return row[near], column[near], apart[row, column][near]


def hota(scored: Scored) -> dict[str, float]:
    """Return HOTA, its detection and its association part, over the overlap along the lane.

    As Luiten et al., HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking (2021).
    """
    steps = [pair for pair in map(_counted, by_step(scored)) if pair is not None]
    none = np.zeros(0, np.int64)
    one, other = (
        {v: k for k, v in enumerate(np.unique(np.concatenate([none, *names])).tolist())}
        for names in ([p[0] for p in steps], [p[1] for p in steps])
    )
    rows = [np.array([one[v] for v in a], np.int64) for a, _, _ in steps]
    columns = [np.array([other[v] for v in b], np.int64) for _, b, _ in steps]
    shape, alike = (len(one), len(other)), [s for _, _, s in steps]
    often = [np.bincount(np.concatenate([none, *x]), minlength=n)
             for x, n in zip((rows, columns), shape, strict=True)]  # fmt: skip
    could = np.zeros(shape)
    for row, column, score in zip(rows, columns, alike, strict=True):
        union = score.sum(axis=0) + score.sum(axis=1)[:, None] - score
        could[np.ix_(row, column)] += np.divide(score, union, out=np.zeros_like(score),
                                                where=union > 0.0)  # fmt: skip
    overall = could / np.maximum(often[0][:, None] + often[1] - could, 1e-9)
    together = np.zeros((len(ALPHAS), *shape))
    hits = np.zeros(len(ALPHAS))
    for row, column, score in zip(rows, columns, alike, strict=True):
        a, b = linear_sum_assignment(-overall[np.ix_(row, column)] * score)
        for k, alpha in enumerate(ALPHAS):
            good = score[a, b] >= alpha - 1e-9
            hits[k] += good.sum()
            together[k, row[a[good]], column[b[good]]] += 1
    joint = together / np.maximum(often[0][:, None] + often[1] - together, 1)
    association = (together * joint).sum(axis=(1, 2)) / np.maximum(hits, 1)
    detection = hits / np.maximum(often[0].sum() + often[1].sum() - hits, 1)
    return {
        "hota": float(np.sqrt(detection * association).mean()),
        "det_a": float(detection.mean()),
        "ass_a": float(association.mean()),
    }


def _counted(pair: tuple[pd.DataFrame, pd.DataFrame]) -> tuple[Integers, Integers, Floats] | None:
    """Return the vehicles of a step that count, and how much they overlap."""
    one, other = pair
    alike, due = similarity(one, other), one["due"].to_numpy()
    on_due = (alike[due] > 0.0).any(axis=0) if due.any() else np.zeros(len(other), np.bool_)
    on_others = (alike[~due] > 0.0).any(axis=0) if (~due).any() else np.zeros(len(other), np.bool_)
    kept = on_due | (other["due"].to_numpy() & ~on_others)
    if not due.any() and not kept.any():
        return None
    names = one["vehicle"].to_numpy()[due], other["vehicle"].to_numpy()[kept]
    return (*names, alike[due][:, kept])


def score_tracks(scored: Scored, kinds: dict[int, str]) -> dict[str, Any]:
    """Return all figures of estimated vehicles."""
    true, given, gospa = matched(scored)
    recall = true["match"].to_numpy() >= 0
    due, claimed = true["due"].to_numpy(), given["due"].to_numpy()
    real = given["match"].to_numpy() >= 0
    return {
        "recall": _share(recall, due),
        "precision": _share(real, claimed),
        "gospa_m": gospa,
        **hota(scored),
        "found": _vehicles(true, recall),
        "real": _vehicles(given, real),
        **_errors(true, given),
        "by": {
            **{f"recall, {n}": _share(recall, due & c) for n, c in _classes(true, kinds).items()},
            **{f"precision, {n}": _share(real, claimed & c) for n, c in _ranges(given).items()},
        },
    }


def _share(flags: Booleans, among: Booleans) -> float:
    return float(flags[among].mean()) if among.any() else float("nan")


def _vehicles(table: pd.DataFrame, good: Booleans) -> float:
    """Return the share of the vehicles that are matched in half of the time they are due."""
    rows = pd.Series(good[table["due"]]).groupby(table.loc[table["due"], "vehicle"].to_numpy())
    share = rows.mean()[rows.size() * EVERY * 0.05 >= SEEN_S]
    return float((share >= FOUND).mean()) if len(share) else float("nan")


def _ranges(table: pd.DataFrame) -> dict[str, Booleans]:
    reach, slow = table["range_m"].to_numpy(), np.abs(table["speed"].to_numpy()) < STANDING_MPS
    ends = pairwise(RANGES_M)
    return {f"{low:.0f}-{high:.0f} m": (low <= reach) & (reach < high) for low, high in ends} | {
        "moving": ~slow, "standing": slow, "hidden": table["hidden"].to_numpy(),
    }  # fmt: skip


def _classes(true: pd.DataFrame, kinds: dict[int, str]) -> dict[str, Booleans]:
    heavy = true["length"].to_numpy() > HEAVY_M
    two = (true["vehicle"].map(kinds) == "motorcycle").to_numpy()
    return _ranges(true) | {"heavy": heavy, "car": ~heavy & ~two, "motorcycle": two}


def _errors(true: pd.DataFrame, given: pd.DataFrame) -> dict[str, float]:
    """Return errors of place, speed and length of what is due and matched."""
    pair = true[true["due"] & (true["match"] >= 0)]
    if len(pair) == 0:
        names = ("along_m", "across_m", "speed_mps", "speed_90_mps", "length_m", "length_bias_m")
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
        "speed_90_mps": float(np.quantile(speed, 0.9)),
        "length_m": float(longer.abs().median()),
        "length_bias_m": float(longer.mean()),
        "two_groups": float(((each["given"] > HEAVY_M) == (each["true"] > HEAVY_M)).mean()),
    }

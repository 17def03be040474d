"""Why vehicles are false or missed, by what stands or walks there and by what was detected.

A false state is a second one on a true vehicle (double), on a walker or cyclist, on a parked car,
or of nothing (ghost). A missed one is hidden, or without a detection for a second before and after
(no data), or is there to be found.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from peers import steps_with_detections
from scenes import SceneFiles
from scipy.spatial import cKDTree
from tracks import Scored, matched
from true_traffic import NO_VEHICLES

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.steps import step_of

DOUBLE_M, PERSON_M, PARKED_M = 8.0, 3.0, 3.5
SILENT_STEPS = 20


def causes(site: SceneFiles, scored: Scored) -> dict[str, float]:
    """Return false states by cause, and missed ones, as shares of those due."""
    true, given, _ = matched(scored)
    false = given[given["due"] & (given["match"] < 0)]
    missed = true[true["due"] & (true["match"] < 0)]
    claimed, due = max(int(given["due"].sum()), 1), max(int(true["due"].sum()), 1)
    double = near(false, true, DOUBLE_M)
    person = ~double & near(false, _persons(site), PERSON_M)
    parked = ~double & ~person & _parked(site, false)
    silent = _silent(site, missed)
    hidden = missed["hidden"].to_numpy()
    return {
        "double": double.sum() / claimed,
        "person": person.sum() / claimed,
        "parked": parked.sum() / claimed,
        "ghost": (~double & ~person & ~parked).sum() / claimed,
        "missed_while_hidden": hidden.sum() / due,
        "missed_no_data": (silent & ~hidden).sum() / due,
        "missed_with_data": (~silent & ~hidden).sum() / due,
    }


def near(rows: pd.DataFrame, others: pd.DataFrame, within_m: float) -> Booleans:
    """Return which rows have one of the others near them in the same step."""
    found = np.zeros(len(rows), np.bool_)
    by_step = dict(iter(others.groupby("step")[["easting", "northing"]]))
    place, steps = rows[["easting", "northing"]].to_numpy(), rows["step"].to_numpy()
    for step in np.unique(steps):
        if step in by_step:
            at = np.flatnonzero(steps == step)
            away = place[at][:, None] - by_step[step].to_numpy()
            found[at] = np.hypot(away[..., 0], away[..., 1]).min(axis=1) < within_m
    return found


def _persons(site: SceneFiles) -> pd.DataFrame:
    """Return the places of walkers and cyclists."""
    table = pd.read_parquet(site.folder / "vehicles.parquet")
    if "kind" not in table:
        return pd.DataFrame({"step": [], "easting": [], "northing": []})
    rows = table[table["kind"].isin(NO_VEHICLES)]
    return rows.assign(step=step_of(rows["t"].to_numpy()))[["step", "easting", "northing"]]


def _parked(site: SceneFiles, rows: pd.DataFrame) -> Booleans:
    """Return which rows are on or beside a parked car."""
    path = site.folder / "standing.npz"
    if not path.exists() or len(rows) == 0:
        return np.zeros(len(rows), np.bool_)
    with np.load(path) as kept:
        centres: Floats = kept["centre"][:, :2]
    if len(centres) == 0:
        return np.zeros(len(rows), np.bool_)
    away = cKDTree(centres).query(rows[["easting", "northing"]].to_numpy())[0]
    return np.asarray(away < PARKED_M)


def _silent(site: SceneFiles, rows: pd.DataFrame) -> Booleans:
    """Return which states of true vehicles have no detection within a second."""
    heard = steps_with_detections(site, site.traffic().states)
    known = {v: np.sort(at.to_numpy()) for v, at in heard.groupby("vehicle")["at"]}
    silent = np.ones(len(rows), np.bool_)
    for k, (vehicle, step) in enumerate(zip(rows["vehicle"], rows["step"], strict=True)):
        steps: Integers = known.get(vehicle, np.zeros(0, np.int64))
        low, high = np.searchsorted(steps, [step - SILENT_STEPS, step + SILENT_STEPS + 1])
        silent[k] = low == high
    return silent

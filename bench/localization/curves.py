"""Curves: how localization depends on the start, on the length of the recording, on traffic."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from table import SENSORS, figures
from town import PER_HOUR, SETS, town_folder
from trials import METHODS, Result, Trial, ring, spread

DISTANCES_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
TURNS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0)
WINDOWS = (200, 400, 700, 1000, 1500, 2000)
DENSITIES = (300.0, 700.0, 1300.0, PER_HOUR)
STARTS, QUICK_STARTS = 2, 1
TURNED_WITHIN_M = 5.0
OTHER_SET = "DO"
CURVES = {
    "distance": ("distance of the start from the truth, m", DISTANCES_M),
    "heading": (f"error of the given heading, degrees (starts within {TURNED_WITHIN_M:.0f} m)",
                TURNS_DEG),
    "window": ("frames (20 a second)", WINDOWS),
    "density": ("vehicles an hour in town", DENSITIES),
}  # fmt: skip
# The way a user would ask: ours without a heading, ICP with one, which it needs.
WAYS = ("lane", "lane, heading given", "icp, heading given")


def plan(folder: Path, *, quick: bool) -> list[Trial]:
    """Return the trials of all curves."""
    starts = QUICK_STARTS if quick else STARTS
    return [
        *_distance(folder, starts),
        *_heading(folder, max(1, starts // 2)),
        *_window(folder, max(1, starts // 2)),
        *_density(folder, max(1, starts // 2), quick=quick),
    ]


def _distance(folder: Path, starts: int) -> list[Trial]:
    rng = np.random.default_rng(11)
    return [
        Trial(
            group=f"distance {reach_m} {WAYS[0] if method == 'lane' else WAYS[2]}",
            folder=folder,
            name=f"DO_{sensor}",
            method=method,
            offset=(float(offset[0]), float(offset[1])),
            heading_off=None if method == "lane" else float(rng.uniform(-10.0, 10.0)),
        )
        for reach_m in DISTANCES_M
        for sensor in SENSORS
        for offset in ring(reach_m, starts, rng)
        for method in METHODS
    ]


def _heading(folder: Path, starts: int) -> list[Trial]:
    rng = np.random.default_rng(12)
    return [
        Trial(
            group=f"heading {turn_deg} {method}, heading given",
            folder=folder,
            name=f"DO_{sensor}",
            method=method,
            offset=(float(offset[0]), float(offset[1])),
            heading_off=side * turn_deg,
        )
        for turn_deg in TURNS_DEG
        for sensor in SENSORS
        for side, offset in zip((-1.0, 1.0), ring(TURNED_WITHIN_M, 2, rng), strict=True)
        if side > 0.0 or starts > 1
        for method in METHODS
    ]


def _window(folder: Path, starts: int) -> list[Trial]:
    names = [f"{set_name}_{sensor}" for set_name in SETS for sensor in SENSORS]
    return [
        trial
        for frames in WINDOWS
        for method in METHODS
        for trial in spread(
            folder, names, f"window {frames} {_way(method)}", method=method, count=starts, seed=13,
            frames=frames, heading_deg=None if method == "lane" else 10.0,
        )
    ]  # fmt: skip


def _density(folder: Path, starts: int, *, quick: bool) -> list[Trial]:
    towns = {PER_HOUR: folder} | {rate: other_town(rate) for rate in other_rates(quick=quick)}
    return [
        trial
        for per_hour, town in sorted(towns.items())
        for method in METHODS
        for trial in spread(
            town, [f"{OTHER_SET}_{sensor}" for sensor in SENSORS],
            f"density {per_hour} {_way(method)}", method=method, count=2 * starts, seed=14,
            heading_deg=None if method == "lane" else 10.0,
        )
    ]  # fmt: skip


def other_rates(*, quick: bool) -> list[float]:
    """Return the densities of traffic beside the town's own, vehicles an hour."""
    return [rate for rate in (DENSITIES[1:2] if quick else DENSITIES) if rate != PER_HOUR]


def other_town(per_hour: float) -> Path:
    """Return the folder of the town with other traffic; made where missing."""
    return town_folder(f"town_{per_hour:.0f}", per_hour, (OTHER_SET,))


def _way(method: str) -> str:
    return WAYS[0] if method == "lane" else WAYS[2]


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Return figures by curve, way and value."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.trial.group, []).append(result)
    made: dict[str, Any] = {}
    for curve, (_, values) in CURVES.items():
        for way in WAYS:
            named = {str(v): groups.get(f"{curve} {v} {way}") for v in values}
            if any(named.values()):
                ways = made.setdefault(curve, {})
                ways[way] = {v: figures(rows) for v, rows in named.items() if rows}
    return made


def markdown(made: dict[str, Any]) -> str:
    """Return a table a curve: right / refused / wrong, and the median 2D error."""
    lines = []
    for curve, ways in made.items():
        values = list(next(iter(ways.values())))
        lines += ["", f"{CURVES[curve][0]}: right / refused / wrong, median 2D error", ""]
        lines += [f"| | {' | '.join(values)} |", "|---" * (1 + len(values)) + "|"]
        for way, by_value in ways.items():
            cells = [
                "{right:.0%} / {refused:.0%} / {wrong:.0%}, {flat_median:.2f} m".format(**f)
                for f in by_value.values()
            ]
            lines.append(f"| {way} | {' | '.join(cells)} |")
    return "\n".join(lines)

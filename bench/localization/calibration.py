"""Calibration: do errors keep to the covariance, over many places, sensors and traffics?

The combinations are made once and kept in out/bench-localization/calibration; a change of the
simulator makes them anew.

    python bench/localization/calibration.py                 all, on two processes
    python bench/localization/calibration.py --count 20      the first twenty

Reported: per component the share of errors within 1 and 2 sigma (normal: 68 and 95 %), the root
mean square of error over sigma (1), bias; NEES, the squared error in units of the covariance
(mean 6, median 5.3); and every answer that is wrong, refused or far beyond its sigma.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from combinations import combination
from conditions import CONDITIONS, TEXTBOOK, folder_name
from places import OUT, disc, errors, read_ground
from scipy.stats import chi2
from workers import PROCESSES, workers

import gis_radar as gr

COMPONENTS = ("easting", "northing", "height", "roll", "pitch", "yaw")
COUNT = 120
RIGHT_M, RIGHT_DEG = 1.0, 1.0
FAR_NEES = float(chi2.ppf(0.9999, 6))


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one combination.

    Parameters
    ----------
    number : int
        Of the combination.
    about : dict
        What was drawn.
    outcome : str
        `right`, `wrong` (over 1 m or 1 degree off), `unfixed` (reported as not observable) or
        `refused`.
    error, sigma : list of float
        Found minus true and one standard deviation, in the order of `COMPONENTS`, m and degrees.
    nees : float
        Squared error in units of the covariance.
    said : str
        Why it was refused.
    """

    number: int
    about: dict[str, Any]
    outcome: str
    error: list[float] = field(default_factory=list)
    sigma: list[float] = field(default_factory=list)
    nees: float = math.nan
    fitness: float = math.nan
    vehicles: int = 0
    said: str = ""


def measure(number: int, conditions: str = TEXTBOOK) -> Outcome:
    """Localize one combination from a start within 10 m, no heading given."""
    folder = combination(number, conditions)
    about = json.loads((folder / "about.json").read_text())
    true, ground = gr.read_pose(folder / "R1.json"), read_ground(folder)
    start = true.position[:2] + disc(np.random.default_rng([number, 5]), 1, 10.0)[0]
    try:
        found = gr.localize(
            folder / "R1.parquet", ground.roads, ground.road, guess=(start[0], start[1])
        )
    except gr.NoAnswerError as refusal:
        return Outcome(number=number, about=about, outcome="refused", said=str(refusal))
    error = errors(found.pose, true)
    sigma = [found.pose.evidence["sigma"][name] for name in COMPONENTS]
    off = error * [1.0, 1.0, 1.0, *np.radians([1.0] * 3)]
    nees = float(off @ np.linalg.solve(np.array(found.pose.evidence["covariance"]), off))
    right = np.hypot(*error[:2]) < RIGHT_M and abs(error[5]) < RIGHT_DEG
    outcome = "right" if found.observable else "unfixed"
    return Outcome(
        number=number,
        about=about,
        outcome=outcome if right or not found.observable else "wrong",
        error=error.tolist(),
        sigma=sigma,
        nees=nees,
        fitness=found.fitness,
        vehicles=found.vehicles,
    )


def run(
    numbers: Sequence[int], processes: int = PROCESSES, *, conditions: str = TEXTBOOK
) -> list[Outcome]:
    """Measure combinations on several processes; a line each as they come in."""
    outcomes = []
    with workers(processes) as pool:
        for outcome in pool.imap_unordered(partial(measure, conditions=conditions), numbers):
            outcomes.append(outcome)
            print(line(outcome), flush=True)
    return sorted(outcomes, key=lambda o: o.number)


def line(outcome: Outcome) -> str:
    """Return an outcome in one line: error / sigma, component by component."""
    begin = f"{outcome.number:4d} {outcome.about['plan']:11s}{outcome.outcome:9s}"
    if not outcome.error:
        return f"{begin} {outcome.said}"
    pairs = zip(outcome.error, outcome.sigma, strict=True)
    return f"{begin}{outcome.nees:8.1f}  " + "  ".join(f"{e:+.3f}/{s:.3f}" for e, s in pairs)


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of the table."""
    answered = [o for o in outcomes if o.outcome == "right"]
    error = np.array([o.error for o in answered]).reshape(-1, 6)
    sigma = np.array([o.sigma for o in answered]).reshape(-1, 6)
    nees = np.array([o.nees for o in answered])
    ratio = error / sigma
    unfixed = [o for o in outcomes if o.outcome == "unfixed"]
    return {
        "combinations": len(outcomes),
        **{k: sum(o.outcome == k for o in outcomes) for k in _OUTCOMES},
        "components": {
            name: {
                "within_1_sigma": float((np.abs(ratio[:, k]) < 1.0).mean()),
                "within_2_sigma": float((np.abs(ratio[:, k]) < 2.0).mean()),
                "rms_error_over_sigma": float(np.sqrt((ratio[:, k] ** 2).mean())),
                "bias": float(error[:, k].mean()),
                "rms_error": float(np.sqrt((error[:, k] ** 2).mean())),
                "median_sigma": float(np.median(sigma[:, k])),
            }
            for k, name in enumerate(COMPONENTS)
        },
        "nees_mean": float(nees.mean()),
        "nees_median": float(np.median(nees)),
        "nees_within_95": float((nees < chi2.ppf(0.95, 6)).mean()),
        "unfixed_nees_median": float(np.median([o.nees for o in unfixed])) if unfixed else None,
        "far_beyond_sigma": [o.number for o in answered if o.nees > FAR_NEES],
    }


_OUTCOMES = ("right", "wrong", "unfixed", "refused")


def table(figures: dict[str, Any]) -> str:
    """Return the figures as Markdown."""
    rows = [
        "| component | within 1 sigma | within 2 sigma | rms / sigma | bias | rms | median sigma |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, f in figures["components"].items():
        unit = "m" if name in {"easting", "northing", "height"} else "deg"
        rows.append(
            f"| {name} | {f['within_1_sigma']:.0%} | {f['within_2_sigma']:.0%} "
            f"| {f['rms_error_over_sigma']:.2f} | {f['bias']:+.3f} {unit} "
            f"| {f['rms_error']:.3f} {unit} | {f['median_sigma']:.3f} {unit} |"
        )
    counts = ", ".join(f"{figures[k]} {k}" for k in _OUTCOMES)
    nees = (
        f"{figures['combinations']} combinations: {counts}. NEES of the right ones: mean "
        f"{figures['nees_mean']:.1f} (expected 6), median {figures['nees_median']:.1f} (5.3), "
        f"{figures['nees_within_95']:.0%} within the 95 % bound (12.6)."
    )
    return "\n".join([*rows, "", nees])


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("--conditions", choices=CONDITIONS, default=TEXTBOOK)
    parser.add_argument("--json", type=Path, help="where the figures go")
    options = parser.parse_args()
    kept = OUT / folder_name("calibration", options.conditions) / "outcomes.json"
    file = options.json or kept
    begin = time.perf_counter()
    numbers = range(options.first, options.first + options.count)
    outcomes = run(numbers, options.processes, conditions=options.conditions)
    figures = summary(outcomes)
    file.parent.mkdir(parents=True, exist_ok=True)
    report = {"summary": figures, "outcomes": [asdict(o) for o in outcomes]}
    file.write_text(json.dumps(report, indent=1) + "\n")
    print(f"\n{table(figures)}\n\n{time.perf_counter() - begin:.0f} s; {file}")


if __name__ == "__main__":
    main()

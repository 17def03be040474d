"""Ablation: the method `lane` with one stage less, each against the same trials.

Every stage is turned off by settings (`gis_radar.calibration.settings`). Trials: each sensor of
the sites and of the town's set DO, from a start within 10 m; a straight road and a mirrored
recording, where no confident answer is right. All variants of a trial run one after the other, so
that what has come in at any time compares.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from places import OUT, write_moving
from straight import straight_folder
from table import figures
from town import MASTS, town_folder
from trials import COMPASS_DEG, Result, Trial, run, spread
from workers import PROCESSES, workers

import gis_radar as gr
from gis_radar.calibration.settings import Schedule
from gis_radar.poses.files import write_pose

AT_ONCE = Schedule(scales_m=(0.0,), rounds=30)
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "all stages": {},
    "no levelling": {"search.level_rounds": 0},
    "no mirrored check": {"answer.mirror_share": math.inf},
    "one finalist": {"hypotheses.finalists": 1},
    "no full look at rivals": {"hypotheses.rival": 1e-9},
    "no look around": {"hypotheses.looks": 0},
    "walkers not left out": {"traces.walk_mps": 0.0},
    "no rough to fine": dict.fromkeys((f"hypotheses.{s}" for s in ("rough", "settle", "fine")),
                                      AT_ONCE),
    "last fit at one scale": {"hypotheses.fine": AT_ONCE},
    "heights not adapted": {"adaptation.least": 10**9},
    "side strength not adapted": {"adaptation.most_factor": 1.0},
    "no profile likelihood": {"answer.valley_steps_m": ()},
    "no bias of streets": {"answer.street_sigma_m": (0.0, 0.0)},
    "no Doppler gate in the matching": {"lanes.slack_mps": math.inf},
}  # fmt: skip
STARTS = 1
FIXED, NO_ANSWER = "fixed", "no answer"
WITHIN = 2.0  # sigmas; 95 % of errors should be
HEADS = (
    "2D median", "2D mean", "height", "yaw", "right", "refused", "wrong", "within 2 sigma",
    "confident of nothing", "CPU s",
)  # fmt: skip


def plan(*, quick: bool, town: bool = True) -> list[Trial]:
    """Return the trials, each in all variants; a quick look takes the first sensor of each place.

    Parameters
    ----------
    quick : bool
        A look.
    town : bool
        The town too, which takes a while to be made.
    """
    sys.path.append(str(Path(__file__).resolve().parents[1]))  # what all benches share
    from simulated import sites  # noqa: PLC0415
    from sites import site_folder  # noqa: PLC0415 - needs it

    trials = []
    for number, site in enumerate(sites()):
        folder = site_folder(site)
        names = sorted(path.stem for path in folder.glob("R*.parquet"))
        trials += _starts(folder, names[: 1 if quick else None], seed=23 + number)
    if town and not quick:
        trials += _starts(town_folder("town"), [f"DO_{mast.sensor}" for mast in MASTS], seed=29)
    none = [(straight_folder(), "R1"), (_mirrored(), "R1")]
    trials += [
        replace(trial, group=NO_ANSWER)
        for folder, name in none
        for trial in _starts(folder, [name], seed=31)
    ]
    return [
        replace(trial, changes=tuple(changes.items()))
        for trial in trials
        for changes in VARIANTS.values()
    ]


def _starts(folder: Path, names: Sequence[str], *, seed: int) -> list[Trial]:
    """Return starts at each sensor; every other one without a heading."""
    trials = spread(
        folder, names, FIXED, method="lane", count=STARTS, seed=seed, heading_deg=COMPASS_DEG
    )
    return [replace(t, heading_off=None) if k % 2 else t for k, t in enumerate(trials)]


def _mirrored() -> Path:
    """Return the folder of a recording whose y axis points to the right; made where missing."""
    folder, sample = OUT / "mirrored", OUT / "sites" / gr.sample_folder().name
    if (folder / "R1.json").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("map.osm", "road.npy"):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to((sample / name).resolve())
    recording = pd.read_parquet(sample / "R1.parquet")
    write_moving(recording.assign(y=-recording["y"]), folder / "R1.parquet")
    write_pose(gr.read_pose(sample / "R1.json"), folder / "R1.json")
    return folder


def measure(trials: Sequence[Trial], *, processes: int = PROCESSES) -> list[Result]:
    """Make the trials, a line each as they come in."""
    results = []
    with workers(processes) as pool:
        for result in pool.imap(run, trials, chunksize=len(VARIANTS)):
            results.append(result)
            where = f"{result.trial.folder.name} {result.trial.name}"
            off = [f"{e:+.3f}" for e in result.error] or result.said
            print(f"{where:16s} {variant_of(result):32s} {off} {result.seconds:.1f} s", flush=True)
    return results


def variant_of(result: Result) -> str:
    """Return the name of the variant that gave a result."""
    changes = dict(result.trial.changes)
    return next(name for name, value in VARIANTS.items() if value == changes)


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Return figures by variant."""
    return {
        name: _figures([r for r in results if variant_of(r) == name])
        for name in VARIANTS
        if any(variant_of(r) == name for r in results)
    }


def _figures(results: Sequence[Result]) -> dict[str, Any]:
    fixed = [r for r in results if r.trial.group == FIXED]
    right = [r for r in fixed if r.right and r.sigma]
    ratio = np.array([np.divide(r.error, r.sigma) for r in right]).reshape(-1, 6)
    none = [r for r in results if r.trial.group == NO_ANSWER]
    return {
        **figures(fixed),
        "seconds": float(np.mean([r.seconds for r in results])),
        "within_2_sigma": float((np.abs(ratio) < WITHIN).mean()) if len(ratio) else math.nan,
        "confident_of_nothing": sum(not r.refused and r.observable for r in none),
        "no_answer_trials": len(none),
    }


def plain(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return the results as plain values, without paths of this machine."""
    rows = []
    for result in results:
        row = asdict(replace(result, trial=replace(result.trial, changes=())))
        row["trial"]["folder"] = result.trial.folder.name
        rows.append({"variant": variant_of(result), **row})
    return rows


def markdown(made: Mapping[str, Any]) -> str:
    """Return a row a variant."""
    lines = [
        f"| stage | {' | '.join(HEADS)} |",
        "|---" * (1 + len(HEADS)) + "|",
    ]
    for name, f in made.items():
        metres = [f"{f[k]:.3f}" for k in ("flat_median", "flat_mean", "height", "yaw")]
        shares = [f"{f[k]:.0%}" for k in ("right", "refused", "wrong", "within_2_sigma")]
        none = f"{f['confident_of_nothing']} of {f['no_answer_trials']}"
        lines.append(f"| {' | '.join([name, *metres, *shares, none])} | {f['seconds']:.1f} |")
    return "\n".join(lines)

"""Trials: a sensor of the town, a start, a method; and what came of it."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from places import Ground, disc, errors, read_ground
from workers import workers

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.calibration import LOCALIZATION
from gis_radar.files import atomic_write

METHODS = ("lane", "icp")
RIGHT_M, RIGHT_DEG = 1.0, 1.0
NEAR_M, COMPASS_DEG = 10.0, 22.5  # half the angle between two words of a compass


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One localization to be made.

    Parameters
    ----------
    group : str
        What it is compared with.
    folder : Path
        Of the town, with map and road.
    name : str
        Of the recording and the pose, without ending.
    method : str
        `lane` or `icp`.
    offset : (float, float)
        Of the guess from the truth, metres to the east and to the north.
    heading_off : float or None
        Of the heading from the true yaw, degrees; None where none is given.
    frames : int
        How many frames at the end of the recording count.
    changes : tuple of (str, value)
        Settings of the localization other than the defaults, by dotted name.
    """

    group: str
    folder: Path
    name: str
    method: str
    offset: tuple[float, float]
    heading_off: float | None
    frames: int = 2000
    changes: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of a trial.

    Parameters
    ----------
    trial : Trial
        The trial.
    error : tuple of float
        East, north, height (m) and roll, pitch, yaw (degrees), found minus true; empty where the
        answer was refused.
    observable : bool
        What the answer states of itself.
    sigma : tuple of float
        One standard deviation of each component; empty where none is given.
    seconds : float
        Of the processor, all threads; a clock on the wall would count the neighbours too.
    said : str
        Why it was refused.
    """

    trial: Trial
    error: tuple[float, ...] = ()
    observable: bool = True
    sigma: tuple[float, ...] = ()
    seconds: float = field(default=0.0, compare=False)
    said: str = ""

    @property
    def refused(self) -> bool:
        """Whether there is no answer."""
        return not self.error

    @property
    def flat_m(self) -> float:
        """Distance of the answer from the truth on the plan."""
        return math.hypot(self.error[0], self.error[1])

    @property
    def right(self) -> bool:
        """Whether the answer lies within 1 m and 1 degree of the truth."""
        return bool(self.error) and self.flat_m < RIGHT_M and abs(self.error[5]) < RIGHT_DEG

    @property
    def wrong(self) -> bool:
        """Whether it is answered, said to be fixed, and not right."""
        return bool(self.error) and self.observable and not self.right


def run(trial: Trial) -> Result:
    """Make one trial."""
    true, ground = _truth(trial.folder, trial.name), _ground(trial.folder)
    guess = (true.easting + trial.offset[0], true.northing + trial.offset[1])
    heading = None if trial.heading_off is None else true.yaw + trial.heading_off
    recording = _cut(trial.folder / f"{trial.name}.parquet", trial.frames)
    begin = time.process_time()
    try:
        found = gr.localize(
            recording, ground.roads, ground.road, guess=guess, heading=heading,
            method=trial.method, settings=LOCALIZATION.changed(dict(trial.changes)),
        )  # fmt: skip
    except gr.NoAnswerError as refusal:
        return Result(trial=trial, said=str(refusal), seconds=time.process_time() - begin)
    return Result(
        trial=trial,
        error=tuple(errors(found.pose, true).tolist()),
        observable=found.observable,
        sigma=tuple(found.pose.evidence.get("sigma", {}).values()),
        seconds=time.process_time() - begin,
    )


def run_all(trials: Sequence[Trial], *, what: str) -> list[Result]:
    """Make trials on all processes; they come back in their order."""
    begin = time.perf_counter()
    results: list[Result] = []
    # neighbours in the list share map and recording: a worker takes some at a time
    with workers() as pool:
        for result in pool.imap(run, trials, chunksize=5):
            results.append(result)
            if len(results) % 50 == 0 or len(results) == len(trials):
                spent = time.perf_counter() - begin
                print(f"{what}: {len(results)} of {len(trials)} trials, {spent:.0f} s", flush=True)
    return results


def spread(
    folder: Path, names: Iterable[str], group: str, *, method: str, count: int, seed: int,
    within_m: float = NEAR_M, heading_deg: float | None = COMPASS_DEG, frames: int = 2000,
) -> list[Trial]:  # fmt: skip
    """Return trials from starts all over a disc around the truth, for each recording.

    Parameters
    ----------
    folder, names, group, method, frames
        As in :class:`Trial`.
    count : int
        Starts a recording; the first so many of an endless list, the same for every method.
    seed : int
        Decides where.
    within_m : float
        Radius of the disc.
    heading_deg : float or None
        The heading is off by up to so much; None gives no heading.
    """
    trials = []
    for number, name in enumerate(names):
        place, turn = np.random.default_rng([seed, number]).spawn(2)
        offsets = np.vstack([disc(place, 1, within_m) for _ in range(count)])
        turns = turn.uniform(-1.0, 1.0, count)
        for offset, share in zip(offsets.tolist(), turns.tolist(), strict=True):
            trials.append(
                Trial(
                    group=group,
                    folder=folder,
                    name=name,
                    method=method,
                    offset=(offset[0], offset[1]),
                    heading_off=None if heading_deg is None else share * heading_deg,
                    frames=frames,
                )
            )
    return trials


def ring(reach_m: float, count: int, rng: np.random.Generator) -> Floats:
    """Return offsets at one distance, (n, 2) metres, evenly all around."""
    turn = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(count) / count
    return reach_m * np.column_stack([np.cos(turn), np.sin(turn)])


@functools.cache
def _ground(folder: Path) -> Ground:
    return read_ground(folder)


@functools.cache
def _truth(folder: Path, name: str) -> gr.Pose:
    return gr.read_pose(folder / f"{name}.json")


def _cut(recording: Path, frames: int) -> Path:
    """Return a recording of the last frames only; the whole one has 2000."""
    if frames >= 2000:
        return recording
    made = recording.parent / f"last_{frames}" / recording.name
    if not made.exists() or made.stat().st_mtime < recording.stat().st_mtime:
        table = pd.read_parquet(recording)
        table = table[table["time"] >= np.unique(table["time"])[-frames]]
        made.parent.mkdir(exist_ok=True)
        with atomic_write(made) as part:
            table.to_parquet(part, index=False)
    return made

"""Trials: a sensor of a place, a start, a method; and what came of it."""

from __future__ import annotations

import functools
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from places import Ground, disc, errors, read_ground

import gis_radar as gr

METHODS = ("lane", "icp")
COMPONENTS = ("easting", "northing", "height", "roll", "pitch", "yaw")
RIGHT_M, RIGHT_DEG = 1.0, 1.0
NEAR_M, COMPASS_DEG = 10.0, 22.5  # half the angle between two words of a compass
PROCESSES = 2
Given = TypeVar("Given")
Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One localization to be made.

    Parameters
    ----------
    group : str
        What it is compared with.
    folder : Path
        Of the place, with map and road.
    name : str
        Of the recording and the pose, without ending.
    method : str
        `lane` or `icp`.
    offset : (float, float)
        Of the guess from the truth, metres to the east and to the north.
    heading_off : float or None
        Of the heading from the true yaw, degrees; None where none is given.
    """

    group: str
    folder: Path
    name: str
    method: str
    offset: tuple[float, float]
    heading_off: float | None = None


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
    nees : float
        Squared error in units of the covariance; NaN where none is given.
    seconds : float
        Of the processor, all threads; a clock on the wall would count the neighbours too.
    """

    trial: Trial
    error: tuple[float, ...] = ()
    observable: bool = True
    sigma: tuple[float, ...] = ()
    nees: float = math.nan
    seconds: float = field(default=0.0, compare=False)

    @property
    def refused(self) -> bool:
        """Whether there is no answer."""
        return not self.error

    @property
    def right(self) -> bool:
        """Whether the answer lies within 1 m and 1 degree of the truth."""
        if self.refused:
            return False
        return math.hypot(*self.error[:2]) < RIGHT_M and abs(self.error[5]) < RIGHT_DEG

    @property
    def wrong(self) -> bool:
        """Whether it is answered, said to be fixed, and not right."""
        return bool(self.error) and self.observable and not self.right


def run(trial: Trial) -> Result:
    """Make one trial."""
    true, ground = gr.read_pose(trial.folder / f"{trial.name}.json"), _ground(trial.folder)
    guess = (true.easting + trial.offset[0], true.northing + trial.offset[1])
    heading = None if trial.heading_off is None else true.yaw + trial.heading_off
    begin = time.process_time()
    try:
        found = gr.localize(
            trial.folder / f"{trial.name}.parquet", ground.roads, ground.road, guess=guess,
            heading=heading, method=trial.method,
        )  # fmt: skip
    except gr.NoAnswerError:
        return Result(trial=trial, seconds=time.process_time() - begin)
    seconds = time.process_time() - begin
    error, evidence = errors(found.pose, true), found.pose.evidence
    sigma = evidence.get("sigma", {})
    return Result(
        trial=trial,
        error=tuple(error.tolist()),
        observable=found.observable,
        sigma=tuple(sigma[name] for name in COMPONENTS) if sigma else (),
        nees=_nees(error, evidence["covariance"]) if "covariance" in evidence else math.nan,
        seconds=seconds,
    )


def _nees(error: np.ndarray, covariance: Any) -> float:
    off = np.append(error[:3], np.radians(error[3:]))
    return float(off @ np.linalg.solve(np.array(covariance), off))


@functools.cache
def _ground(folder: Path) -> Ground:
    return read_ground(folder)


def run_all(trials: Sequence[Trial]) -> list[Result]:
    """Make trials on all processes; they come back in their order."""
    return in_workers(run, trials)


def in_workers(work: Callable[[Given], Made], given: Sequence[Given]) -> list[Made]:
    """Do some work in new processes of one thread each; return what is made in order."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    begin = time.perf_counter()
    made: list[Made] = []
    # neighbours in the list share map and recording: a worker takes some at a time
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        for each in pool.imap(work, given, chunksize=5):
            made.append(each)
            if len(made) % 50 == 0:
                spent = time.perf_counter() - begin
                print(f"{len(made)} of {len(given)}, {spent:.0f} s", flush=True)
    return made


def spread(
    folder: Path, names: Iterable[str], group: str, *, method: str, count: int, seed: int,
    heading_deg: float | None = None,
) -> list[Trial]:  # fmt: skip
    """Return trials from starts all over a disc around the truth, for each recording.

    Parameters
    ----------
    folder, names, group, method
        As in :class:`Trial`.
    count : int
        Starts a recording; the first so many of an endless list, the same for every method.
    seed : int
        Decides where.
    heading_deg : float or None
        The heading is off by up to so much; None gives no heading.
    """
    trials = []
    for number, name in enumerate(names):
        place, turn = np.random.default_rng([seed, number]).spawn(2)
        offsets = np.vstack([disc(place, 1, NEAR_M) for _ in range(count)])
        turns = turn.uniform(-1.0, 1.0, count)
        for (east, north), share in zip(offsets.tolist(), turns.tolist(), strict=True):
            off = None if heading_deg is None else share * heading_deg
            trials.append(
                Trial(
                    group=group, folder=folder, name=name, method=method, offset=(east, north),
                    heading_off=off,
                )
            )  # fmt: skip
    return trials

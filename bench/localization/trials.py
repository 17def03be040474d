"""Trials of localization: a sensor, a guess and a method, with the result."""

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
from places import Ground, disc_offsets, errors, read_ground

import gis_radar as gr

METHODS = ("lane", "icp")
COMPONENTS = ("easting", "northing", "height", "roll", "pitch", "yaw")
RIGHT_M, RIGHT_DEG = 1.0, 1.0  # errors of a right answer, at most
# How far guesses are off: in place; in yaw (half the angle between two of eight compass words).
NEAR_M, COMPASS_DEG = 10.0, 22.5
PROCESSES = 2
Given = TypeVar("Given")
Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A localization to run.

    Parameters
    ----------
    group : str
        Row of the table in which it counts.
    folder : Path
        Folder of the place, with map and road.
    name : str
        File name of recording and pose, without suffix.
    method : str
        `lane` or `icp`.
    offset : (float, float)
        Guess minus truth, metres to the east and to the north.
    heading_off : float or None
        Heading minus true yaw, degrees; None: no heading is given.
    """

    group: str
    folder: Path
    name: str
    method: str
    offset: tuple[float, float]
    heading_off: float | None = None


@dataclass(frozen=True, kw_only=True)
class Result:
    """Result of a trial.

    Parameters
    ----------
    trial : Trial
        The trial.
    error : tuple of float
        East, north, height (m) and roll, pitch, yaw (degrees), found minus true; empty where the
        answer was refused.
    observable : bool
        Whether the answer says that the scene fixes it.
    sigma : tuple of float
        One standard deviation of each component; empty where none is given.
    nees : float
        Squared error in units of the covariance; NaN where none is given.
    seconds : float
        CPU time, all threads.
    """

    trial: Trial
    error: tuple[float, ...] = ()
    observable: bool = True
    sigma: tuple[float, ...] = ()
    nees: float = math.nan
    seconds: float = field(default=0.0, compare=False)

    @property
    def refused(self) -> bool:
        """Whether the answer was refused."""
        return not self.error

    @property
    def right(self) -> bool:
        """Whether the answer lies within 1 m and 1 degree of the truth."""
        if self.refused:
            return False
        return math.hypot(*self.error[:2]) < RIGHT_M and abs(self.error[5]) < RIGHT_DEG

    @property
    def wrong(self) -> bool:
        """Whether the answer says `observable` and is not right."""
        return bool(self.error) and self.observable and not self.right


def run(trial: Trial) -> Result:
    """Run a trial."""
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
    """Return the normalised estimation error squared (NEES); 6 in the mean if consistent."""
    off = np.append(error[:3], np.radians(error[3:]))
    return float(off @ np.linalg.solve(np.array(covariance), off))


@functools.cache
def _ground(folder: Path) -> Ground:
    return read_ground(folder)


def run_all(trials: Sequence[Trial]) -> list[Result]:
    """Run trials on all processes; return the results in their order."""
    return in_workers(run, trials)


def in_workers(work: Callable[[Given], Made], given: Sequence[Given]) -> list[Made]:
    """Call `work` with each item in new processes of one thread; return results in order."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    begin = time.perf_counter()
    made: list[Made] = []
    # neighbours in the list share map and recording: a worker takes five at a time
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
    """Return trials with guesses spread over a disc around the truth, for each recording.

    Parameters
    ----------
    folder, names, group, method
        As in :class:`Trial`.
    count : int
        Guesses a recording; fewer are the first ones of more, the same for every method.
    seed : int
        Seed of the guesses.
    heading_deg : float or None
        Largest error of the heading; None gives no heading.
    """
    trials = []
    for number, name in enumerate(names):
        place, turn = np.random.default_rng([seed, number]).spawn(2)
        offsets = np.vstack([disc_offsets(place, 1, NEAR_M) for _ in range(count)])
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

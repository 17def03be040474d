"""Sets of steps, kept as runs of consecutive ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gis_radar.arrays import Integers


@dataclass(frozen=True, kw_only=True)
class Runs:
    """A set of steps: runs that ascend and do not touch.

    Parameters
    ----------
    first, last : (n,) int64 arrays
        First and last step of each run, inclusive.
    """

    first: Integers
    last: Integers

    @classmethod
    def of(cls, steps: Integers) -> Runs:
        """Return the set of the given steps, which ascend; repetition changes nothing."""
        return union([cls(first=steps, last=steps)])

    def __len__(self) -> int:
        return len(self.first)

    @property
    def steps(self) -> int:
        """Number of steps in the set."""
        return int((self.last - self.first + 1).sum())

    def before(self, step: Integers) -> Integers:
        """Return how many steps of the set come before each of the given steps."""
        length = self.last - self.first + 1
        done = np.concatenate([[0], np.cumsum(length)])
        run = np.searchsorted(self.first, step) - 1
        begun = run >= 0
        inside = np.minimum(step - self.first[run], length[run]) if len(self) else 0
        return np.where(begun, done[np.maximum(run, 0)] + inside, 0)

    def within(self, first: int, last: int) -> Runs:
        """Return the part of the set from step `first` to step `last`, inclusive."""
        kept = (self.last >= first) & (self.first <= last)
        return Runs(
            first=np.maximum(self.first[kept], first), last=np.minimum(self.last[kept], last)
        )

    def nearest(self, step: int) -> int:
        """Return the step of the set nearest to `step`."""
        inside = np.clip(step, self.first, self.last)
        return int(inside[np.argmin(np.abs(inside - step))])


def union(parts: Sequence[Runs]) -> Runs:
    """Return the steps that are in any of the sets, each of them once."""
    first = np.concatenate([part.first for part in parts])
    order = np.argsort(first, kind="stable")
    first = first[order]
    reached = np.maximum.accumulate(np.concatenate([part.last for part in parts])[order])
    apart = first[1:] > reached[:-1] + 1
    begins, ends = np.ones(len(first), np.bool_), np.ones(len(first), np.bool_)
    begins[1:] = ends[:-1] = apart
    return Runs(first=first[begins], last=reached[ends])


COLUMNS = ("sensor", "view", "first_step", "last_step")


def runs_in(frames: pd.DataFrame) -> Runs:
    """Return the rows of a table of frames as they stand, as runs."""
    return Runs(
        first=frames["first_step"].to_numpy(np.int64), last=frames["last_step"].to_numpy(np.int64)
    )


def frames_table(frames: pd.DataFrame) -> pd.DataFrame:
    """Return a table of frames in its one form: fewest runs, ordered by sensor, view and step."""
    pieces = []
    for (sensor, view), group in frames.groupby(["sensor", "view"], sort=True):
        runs = union([runs_in(group)])
        pieces.append(
            pd.DataFrame(
                {"sensor": sensor, "view": view, "first_step": runs.first, "last_step": runs.last}
            )
        )
    empty = pd.DataFrame({"sensor": [], "view": [], "first_step": [], "last_step": []})
    table = pd.concat(pieces, ignore_index=True) if pieces else empty
    kinds = {"sensor": str, "view": str, "first_step": np.int64, "last_step": np.int64}
    return table.astype(kinds)[list(COLUMNS)]

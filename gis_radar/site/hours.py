"""Hours of a site: which of its recordings tell of which hour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd

from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.settings import DEFAULTS

HOUR_STEPS = 3600 * STEPS_PER_SECOND


@dataclass(frozen=True, kw_only=True)
class Hour:
    """A whole hour, UTC, in which a sensor has frames.

    Parameters
    ----------
    number : int
        Hours since 1970.
    recordings : mapping of str to tuple of Path
        By sensor, what was recorded in it or so near to it that it helps to know its vehicles.
    """

    number: int
    recordings: Mapping[str, tuple[Path, ...]]

    @property
    def name(self) -> str:
        """Its begin, as files are named."""
        return f"{datetime.fromtimestamp(3600 * self.number, UTC):%Y%m%dT%HZ}"

    @property
    def span(self) -> tuple[int, int]:
        """Its first and its last step."""
        return self.number * HOUR_STEPS, (self.number + 1) * HOUR_STEPS - 1


def hours_of(counted: Mapping[str, Mapping[Path, Path]]) -> list[Hour]:
    """Return the hours in which any sensor has frames, ascending.

    Parameters
    ----------
    counted : mapping of str to mapping of Path to Path
        By sensor and recording, the folder of its occupancy.
    """
    inside: set[int] = set()
    near: dict[int, dict[str, list[Path]]] = {}
    for sensor, parts in counted.items():
        for recording, part in parts.items():
            frames = pd.read_parquet(part / "frames.parquet", columns=["first_step", "last_step"])
            inside |= _hours(frames, 0)
            for hour in _hours(frames, DEFAULTS.blocks.margin_steps):
                near.setdefault(hour, {}).setdefault(sensor, []).append(recording)
    return [
        Hour(number=hour, recordings={name: tuple(each) for name, each in near[hour].items()})
        for hour in sorted(inside)
    ]


def _hours(frames: pd.DataFrame, margin_steps: int) -> set[int]:
    """Return the hours of runs of steps, with so many steps before and after."""
    first = (frames["first_step"].to_numpy(np.int64) - margin_steps) // HOUR_STEPS
    last = (frames["last_step"].to_numpy(np.int64) + margin_steps) // HOUR_STEPS
    pairs = {*zip(first.tolist(), last.tolist(), strict=True)}
    return {hour for begin, end in pairs for hour in range(begin, end + 1)}

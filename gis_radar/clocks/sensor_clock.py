"""The clock of a sensor: how far it is ahead, and the file of clocks."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import InputError
from gis_radar.files import whole_file
from gis_radar.steps import seconds_from_iso

MOST_DRIFT_PPM = 10_000.0  # a hundred times that of a bad quartz: a unit is mistaken


@dataclass(frozen=True, kw_only=True)
class SensorClock:
    """How far the clock of a sensor is ahead of the reference.

    Parameters
    ----------
    offset_s : float
        Seconds by which it is ahead at the time `at`; its time stamps are later by that much.
    drift_ppm : float
        By how much it runs fast, microseconds a second.
    at : float
        UNIX seconds on its own clock at which the offset holds.
    sigma_s, drift_sigma_ppm : float
        One standard deviation of both; NaN where not known.
    """

    offset_s: float
    drift_ppm: float = 0.0
    at: float = 0.0
    sigma_s: float = math.nan
    drift_sigma_ppm: float = math.nan

    def __post_init__(self) -> None:
        if not (math.isfinite(self.offset_s) and math.isfinite(self.at)):
            raise InputError(f"clock offset is {self.offset_s} s, expected a number")
        if not abs(self.drift_ppm) <= MOST_DRIFT_PPM:
            raise InputError(
                f"clock drift is {self.drift_ppm} ppm, expected at most {MOST_DRIFT_PPM:g}"
            )

    def corrected(self, time: Floats) -> Floats:
        """Return times (UNIX seconds) of this clock as the reference would have stamped them."""
        ahead = self.offset_s + self.drift_ppm * 1e-6 * (np.asarray(time) - self.at)
        return np.asarray(time - ahead, dtype=np.float64)

    def as_dict(self) -> dict[str, Any]:
        """Return its entry in a file of clocks; unknown values are left out."""
        moment = datetime.fromtimestamp(self.at, UTC).isoformat(timespec="milliseconds")
        numbers = {
            "offset_s": self.offset_s,
            "sigma_s": self.sigma_s,
            "drift_ppm": self.drift_ppm,
            "drift_sigma_ppm": self.drift_sigma_ppm,
        }
        known = {name: value for name, value in numbers.items() if math.isfinite(value)}
        return known | {"at": moment.replace("+00:00", "Z")}


def write_clocks(record: Mapping[str, Any], path: str | Path) -> None:
    """Write a file of clocks (JSON), whole or not at all."""
    with whole_file(Path(path)) as part:
        text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
        part.write_text(text + "\n", encoding="utf-8")


def read_clocks(path: str | Path) -> dict[str, SensorClock]:
    """Read a file of clocks: JSON with `clocks`, by sensor `offset_s`, `drift_ppm`, `at`.

    Raises
    ------
    InputError
        If it cannot be read, or a clock in it has impossible values.
    """
    try:
        record = json.loads(Path(path).read_text(encoding="utf-8-sig"))
        clocks = dict(record["clocks"])
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not a file of clocks", hint="make one with: gis-radar clocks"
        ) from error
    return {str(sensor): _clock_of(entry, f"{path}: {sensor}") for sensor, entry in clocks.items()}


def _clock_of(entry: Any, what: str) -> SensorClock:
    if not isinstance(entry, dict) or "offset_s" not in entry:
        raise InputError(f"{what}: lacks offset_s")
    numbers = {
        name: entry[name]
        for name in ("offset_s", "sigma_s", "drift_ppm", "drift_sigma_ppm")
        if name in entry
    }
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{what}: {name} is {value!r}, expected a number")
    drifts = numbers.get("drift_ppm", 0.0) != 0.0
    if drifts and "at" not in entry:
        raise InputError(f"{what}: has a drift but not the time `at` which its offset holds")
    at = seconds_from_iso(str(entry["at"]), what=f"{what}: at") if "at" in entry else 0.0
    try:
        return SensorClock(at=at, **numbers)
    except InputError as error:
        raise InputError(f"{what}: {error.message}") from error

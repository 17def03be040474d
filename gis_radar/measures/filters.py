"""Filters for the detections that count."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gis_radar.base import UsageError, require_kinds


@dataclass(frozen=True, kw_only=True)
class Filters:
    """Filters for the detections that count; by default all do.

    Stopped vehicles have no Doppler shift, and planners look for queues, so the default keeps
    detections at rest. The paper, "Local Sensor Data Processing", names the three filters.

    Parameters
    ----------
    min_speed : float, optional
        Least absolute range rate, m/s.
    min_rcs : float, optional
        Least radar cross section, dBm2.
    clearance : (float, float), optional
        Lowest and highest height over the tile's road, metres: the clearance profile.
    elevation_error_deg : float
        One standard deviation of the radar's elevation, degrees; the clearance profile widens with
        range by `sigmas` of them.
    sigmas : float
        2 keeps 95 % of the detections that are within the profile.
    levels_apart_m : float
        Height difference, metres, under which tiles are on one level: more than a crossfall or a
        kerb, less than the least clearance of a bridge (4.5 m).
    """

    min_speed: float | None = None
    min_rcs: float | None = None
    clearance: tuple[float, float] | None = None
    elevation_error_deg: float = 0.5
    sigmas: float = 2.0
    levels_apart_m: float = 2.5

    def __post_init__(self) -> None:
        require_kinds(self, UsageError)
        if self.min_speed is not None and not self.min_speed >= 0.0:
            raise UsageError("least speed is {} m/s, expected 0 or more", self.min_speed)
        if self.min_rcs is not None and not math.isfinite(self.min_rcs):
            raise UsageError("least cross section is {} dBm2, expected a number", self.min_rcs)
        if self.clearance is not None and not self.clearance[0] < self.clearance[1]:
            low, high = self.clearance
            raise UsageError("clearance is {} to {} m, expected lowest before highest", low, high)
        if not (self.sigmas >= 0.0 and self.levels_apart_m >= 0.0):
            raise UsageError("sigmas and levels_apart_m are {} and {}, expected 0 or more",
                             self.sigmas, self.levels_apart_m)  # fmt: skip
        if not 0.0 <= self.elevation_error_deg < 45.0:
            raise UsageError(
                "elevation error is {} deg, expected 0 to 45", self.elevation_error_deg
            )

    @property
    def widening(self) -> float:
        """Metres that the clearance profile widens, up and down, for each metre of range."""
        return math.tan(math.radians(self.sigmas * self.elevation_error_deg))

"""Settings of the hit share: its constants, with unit and reason, and which detections count."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gis_radar.base import CLOCK_SET_S, UsageError


@dataclass(frozen=True, kw_only=True)
class HitSettings:
    """Constants of the hit share; those in effect are in `dataset.json`.

    Which detections count is set by :class:`gis_radar.Filters`.

    Parameters
    ----------
    validity_s : float
        Validity of a frame where no cycle is stated, seconds: two
        cycles of 50 ms, so that one lost frame leaves no gap.
    cycles_valid : float
        How long a frame is valid where a cycle is stated, in cycles: over any jitter, under two, so
        that time without frames is not observed.
    view_shared_m, view_shared_deg : float
        A pose of a track shares the view of an earlier one that is so near, metres and degrees:
        half a tile, and about the sigma of a tracked angle. Smaller values make more views; hits
        do not depend on them.
    views_compared : int
        Latest views of a track that a pose is compared with; bounds the work of long tracks.
    road_tiles : int
        Nearest tiles of a view whose median height is the road's for detections without elevation:
        100 m of lane, where the height matters: 5 m shift a place by 0.6 m at 20 m, 0.1 m at 120 m.
    moving_mps : float
        A detection moves from this absolute range rate on, m/s: over the Doppler noise of a radar
        (0.1 to 0.3 m/s) and of leaves. For the frame log only.
    wild_mps : float
        No vehicle is faster, m/s (250 km/h). For the frame log only.
    slow_cycle : float
        Warn of a sensor whose cycle is so many times the validity: 10 % of the steps empty.
    range_share, reach_share : float
        Warn where this share of the detections lies within less than `reach_share` of the range of
        the view (the contract: 99.9 % and 0.8).
    clock_set_s : float
        An earlier time stamp, UNIX seconds, is that of a clock that was never set.
    """

    validity_s: float = 0.1
    cycles_valid: float = 1.5
    view_shared_m: float = 0.25
    view_shared_deg: float = 0.2
    views_compared: int = 64
    road_tiles: int = 200
    moving_mps: float = 0.5
    wild_mps: float = 70.0
    slow_cycle: float = 1.1
    range_share: float = 0.999
    reach_share: float = 0.8
    clock_set_s: float = CLOCK_SET_S


HIT_DEFAULTS = HitSettings()


@dataclass(frozen=True, kw_only=True)
class Filters:
    """Which detections count; by default all.

    A stopped vehicle has no Doppler, and a queue is what planners look for: so the default
    keeps what stands still. (The paper, "Local Sensor Data Processing", names these three.)

    Parameters
    ----------
    min_speed : float, optional
        Least absolute range rate, m/s.
    min_rcs : float, optional
        Least radar cross section, dBm2.
    clearance : (float, float), optional
        Lowest and highest height over the tile's road, metres: the clearance profile.
    elevation_error_deg : float
        One standard deviation of the radar's elevation; the clearance profile widens with range
        by `sigmas` of them.
    sigmas : float
        2: of the detections within the profile 95 % stay.
    levels_apart_m : float
        Tiles nearer in height belong to one level, metres: over a crossfall or a kerb, under the
        least clearance of a bridge (4.5 m).
    """

    min_speed: float | None = None
    min_rcs: float | None = None
    clearance: tuple[float, float] | None = None
    elevation_error_deg: float = 0.5
    sigmas: float = 2.0
    levels_apart_m: float = 2.5

    def __post_init__(self) -> None:
        if self.min_speed is not None and not self.min_speed >= 0.0:
            raise UsageError("least speed is {} m/s, expected 0 or more", self.min_speed)
        if self.min_rcs is not None and not math.isfinite(self.min_rcs):
            raise UsageError("least cross section is {} dBm2, expected a number", self.min_rcs)
        if self.clearance is not None and not self.clearance[0] < self.clearance[1]:
            low, high = self.clearance
            raise UsageError("clearance is {} to {} m, expected lowest before highest", low, high)
        if not 0.0 <= self.elevation_error_deg < 45.0:
            raise UsageError(
                "elevation error is {} deg, expected 0 to 45", self.elevation_error_deg
            )

    @property
    def widening(self) -> float:
        """By how much the clearance profile widens a metre of range, to either side, metres."""
        return math.tan(math.radians(self.sigmas * self.elevation_error_deg))

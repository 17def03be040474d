"""Settings of the occupancy: the constants of its algorithm, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass

from gis_radar.clocks.settings import CLOCK_SET_S


@dataclass(frozen=True, kw_only=True)
class OccupancySettings:
    """Constants of the occupancy; those in effect are written to its `manifest.json`.

    Which detections count is set by :class:`gis_radar.Filters`, how long a frame holds by `cycles`.

    Parameters
    ----------
    view_shared_m, view_shared_deg : float
        A pose of a track shares the view of an earlier one that is so near, metres and degrees:
        half a tile, and about the sigma of a tracked angle. Smaller values make more views; hits
        do not depend on them.
    views_compared : int
        Latest views of a track that a pose is compared with; bounds the work of long tracks.
    moving_mps : float
        A detection moves from this absolute range rate on, m/s: over the Doppler noise of a radar
        (0.1 to 0.3 m/s) and of leaves. For the frame log only.
    wild_mps : float
        No vehicle is faster, m/s (250 km/h). For the frame log only.
    cycle_frames : int
        Frames from which `cycles="auto"` takes the median cycle: 200 s at 20 Hz, in which the
        median of a jitter of 5 ms is known to 0.1 ms.
    slow_cycle : float
        Warn of a sensor whose cycle is so many steps long and not stated: 10 % of the steps empty.
    range_share, reach_share : float
        Warn where this share of the detections lies within less than `reach_share` of the range of
        the view (the contract: 99.9 % and 0.8).
    clock_set_s : float
        An earlier time stamp, UNIX seconds, is that of a clock that was never set.
    """

    view_shared_m: float = 0.25
    view_shared_deg: float = 0.2
    views_compared: int = 64
    moving_mps: float = 0.5
    wild_mps: float = 70.0
    cycle_frames: int = 4000
    slow_cycle: float = 1.1
    range_share: float = 0.999
    reach_share: float = 0.8
    clock_set_s: float = CLOCK_SET_S


DEFAULTS = OccupancySettings()

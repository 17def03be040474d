"""Settings of data quality: the thresholds of its verdicts."""

from __future__ import annotations

from dataclasses import dataclass

from gis_radar.clocks.settings import CLOCK_SET_S


@dataclass(frozen=True, kw_only=True)
class QualitySettings:
    """Thresholds by which the hour of a sensor is at fault; those in effect are in the figures.

    Shares are of the frames, if not stated else. The verdicts follow those of loop detectors (PeMS,
    Chen et al. 2003); the thresholds are far from what the simulated sites give (no fault).

    Parameters
    ----------
    least_share : float
        Received of the frames expected, at least.
    high, high_share : float
        Share of the seen tiles hit in a frame that is high, and how many frames may be high.
    least_moving : float
        Share of the detections that move, at least: a street at night has some.
    most_doubled, most_repeated : float
        Frames that follow within half a cycle, or repeat the positions of the one before.
    most_wild : float
        Share of the detections faster than any vehicle: noise gives some.
    frames_judged : int
        Of fewer frames, 5 s at 20 Hz, only their number is judged.
    clock_set_s : float
        An earlier hour, UNIX seconds, is that of a clock that was never set.
    """

    least_share: float = 0.6
    high: float = 0.7
    high_share: float = 0.2
    least_moving: float = 0.001
    most_doubled: float = 0.05
    most_repeated: float = 0.2
    most_wild: float = 0.02
    frames_judged: int = 100
    clock_set_s: float = CLOCK_SET_S


DEFAULTS = QualitySettings()

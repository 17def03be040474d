"""Settings of the tracking: every constant of its algorithms, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import radians
from typing import Any

from scipy.special import gammaincinv

from gis_radar.localization.settings import DEFAULTS as LOCALIZATION
from gis_radar.localization.settings import LocalizationSettings, Schedule, changed

HOUR_S = 3600.0

Six = tuple[float, float, float, float, float, float]
_WINDOW = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=12)
_FAR = replace(LOCALIZATION.solver.far, rounds=12)


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """All settings of the tracking.

    Vectors of six are easting, northing, height and turns about the map's axes: metres, radians.

    Parameters
    ----------
    cycle_s : float
        Time between two corrected poses, seconds (the paper).
    least_cycle : float
        A last cycle shorter than that share of one gives no pose.
    drift : (6,) tuple
        1 sigma of how far a mast bends within an hour, in sun and wind.
    by_hand : (6,) tuple
        1 sigma of a start pose that states none: measured with tape, compass and spirit level.
    least_sigma : (6,) tuple
        Least sigma of a start pose; keeps the covariance regular.
    noise_share : float
        Share of the variance of a localized pose that is noise of its window; the rest, errors
        of the map and the model, is in every window.
    near : (6,) tuple
        1 sigma of the prior under which a window is fitted: around the expected pose, wide.
    window : Schedule
        Fit of a window: it starts within decimetres.
    least_known, unknown : float
        Information of the data below that share of the prior's is none, and counts as `unknown`.
    reach_grows : float
        Lanes are sampled so many times as far as the traces reach, so that it is done rarely.
    other_lane, other_lane_m : float
        A pose a lane off refutes the start where the vehicles prefer it by so many standard
        deviations (one more than separates two answers of a localization), and it is so far off.
    lengths_s : tuple of float
        Newest parts of the window that are tested for a move: a short one soon shows a blow, but
        holds few vehicles; a long one shows a shift of some decimetres.
    false_alarms : float
        Moves reported an hour where none was; at most, as if all tests were independent.
    suspect : float
        Level of chi2 above which a move is looked for and the pose's sigma widened.
    newest_tracks : int
        Least vehicles in a tested part; it grows until it holds them.
    mature_s : float
        Seconds of data before a tested part from which the pose is known.
    settled_s : float
        A deviation that does not last so long is a shake, seconds.
    latest_s : float
        Newest seconds in which the new pose must still be the better one.
    slice_s : float
        Resolution of the time of a move, seconds: half a second to either side.
    back_s : float
        How long ago a move is looked for, seconds: within the window of 100 s, less `mature_s`.
    change_rounds : int
        Time and pose of a move are estimated in turn so often.
    knock : (6,) tuple
        1 sigma of how far a blow moves a sensor that is still in use.
    far : Schedule
        Fit after a suspected move.
    farthest : float
        Where no near fit lies on lanes, the pose is searched within so many sigmas of `knock`.
    lost_s : float
        `moved` with unknown pose after so many seconds of rejected fits: a whole window.
    localization : LocalizationSettings
        Of window, traces, lanes and fits.
    """

    cycle_s: float = 5.0
    least_cycle: float = 0.5
    drift: Six = (0.02, 0.02, 0.01, radians(0.1), radians(0.1), radians(0.1))
    by_hand: Six = (1.0, 1.0, 1.0, radians(2.0), radians(2.0), radians(2.0))
    least_sigma: Six = (1e-3, 1e-3, 1e-3, radians(1e-3), radians(1e-3), radians(1e-3))
    noise_share: float = 0.3
    near: Six = (1.0, 1.0, 1.0, radians(2.0), radians(2.0), radians(2.0))
    window: Schedule = _WINDOW
    least_known: float = 0.05
    unknown: float = 1e-4
    reach_grows: float = 1.2
    other_lane: float = 3.5
    other_lane_m: float = 1.0
    lengths_s: tuple[float, ...] = (20.0, 60.0)
    false_alarms: float = 0.01
    suspect: float = 0.95
    newest_tracks: int = 8
    mature_s: float = 30.0
    settled_s: float = 15.0
    latest_s: float = 8.0
    slice_s: float = 1.0
    back_s: float = 75.0
    change_rounds: int = 2
    knock: Six = (0.7, 0.7, 0.4, radians(3.0), radians(3.0), radians(4.0))
    far: Schedule = _FAR
    farthest: float = 4.0
    lost_s: float = 100.0
    localization: LocalizationSettings = field(default_factory=LocalizationSettings)

    @property
    def gate(self) -> float:
        """Largest chi2 of six degrees of freedom that is chance, by `false_alarms`."""
        tests = HOUR_S / self.cycle_s * len(self.lengths_s)  # an hour
        return chi2_quantile(1.0 - self.false_alarms / tests)

    @property
    def suspect_chi2(self) -> float:
        """Chi2 of six degrees of freedom above which a move is looked for."""
        return chi2_quantile(self.suspect)

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults, by dotted name."""
        return changed(self, DEFAULTS)


def chi2_quantile(level: float) -> float:
    """Return the quantile of chi2 of six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * gammaincinv(3.0, level))


DEFAULTS = TrackingSettings()

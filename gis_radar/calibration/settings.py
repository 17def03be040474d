"""What may be set of localization and monitor; what differs goes into a pose's evidence.

Other constants of its algorithms stand beside their use. What is assumed of vehicles and radars is
in :mod:`gis_radar.calibration.model`: those constants carry an uncertainty that enters an answer's
covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import radians
from typing import Any

import scipy

LEVER_M = 50.0  # a turn counts as the metres by which it moves what is so far off: usual traces


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Under which widths, and with how many steps, one call of the solver runs.

    Parameters
    ----------
    scales_m : tuple of float
        Widening of all spreads (root of squares), stage by stage. A fit comes back from about
        twice the first scale; only with 0 last is it an optimum of the model itself.
    rounds : int
        Most Gauss-Newton steps a stage.
    """

    scales_m: tuple[float, ...]
    rounds: int


@dataclass(frozen=True, kw_only=True)
class TraceSettings:
    """How moving detections become tracks and samples.

    Parameters
    ----------
    frames, least_frames : int
        Window, 100 s at 20 Hz (the paper's n_f); fewer are refused: 5 s show no traffic.
    min_speed_mps : float
        Least absolute range rate (the paper).
    segment_s : float
        A stream of vehicles that never breaks counts as several tracks of this length.
    walk_mps : float
        Tracks that are slower by range rates and way may be of walkers, with their limbs.
    most : int
        Samples in all; cost grows in proportion.
    """

    frames: int = 2000
    least_frames: int = 100
    min_speed_mps: float = 0.15
    segment_s: float = 8.0
    walk_mps: float = 2.7
    most: int = 6000


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """How the traces are levelled and laid on a grid of places and headings.

    Parameters
    ----------
    guess_m : float
        How far a guess may be off (contract).
    heading_tolerance : float
        Radians either way of a given heading: 25 degrees (contract) and some slack.
    """

    guess_m: float = 15.0
    heading_tolerance: float = radians(30.0)


@dataclass(frozen=True, kw_only=True)
class HypothesisSettings:
    """How starts are fitted and ranked.

    Parameters
    ----------
    rough, settle, fine : Schedule
        First fit of every candidate, fit of each finalist, fit to all samples.
    finalists : int
        Most hypotheses that are fitted to the end.
    rival : float
        Standard deviations behind the first that earn a full look, which brings a hypothesis
        nearer by about half of one; more than `AnswerSettings.clear`.
    looks : int
        How often better optima are looked for, at most, each time around the last best one.
    """

    rough: Schedule = Schedule(scales_m=(1.5, 0.75, 0.3), rounds=4)
    settle: Schedule = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=4)
    fine: Schedule = Schedule(scales_m=(0.2, 0.1, 0.0), rounds=30)
    finalists: int = 4
    rival: float = 3.5
    looks: int = 4


@dataclass(frozen=True, kw_only=True)
class AnswerSettings:
    """What an answer must show, and how certain it is.

    Parameters
    ----------
    street_sigma_m : (2,) tuple
        1 sigma, from street to street, of lanes as drawn, and of the scan's heights.
    lane_sigma_m : (2,) tuple
        1 sigma, from lane to lane, of where all its drivers keep, to the left of the middle: on
        straight lanes, in bends. So they did at three recorded junctions.
    map_sigma_m : float
        1 sigma of the map's place, to the east and to the north: maps and tracks that were recorded
        apart lay 0.3 to 0.5 m off each other.
    unfixed_m, unfixed_rad : (3,) tuples
        Sigmas from which on a scene does not fix easting, northing, height; roll, pitch, yaw.
        One metre is the paper's accuracy; with 2 degrees a far trace is a lane off.
    valley_steps_m : tuple of float
        How far along the least-known direction the profile of the likelihood is taken; none turns
        it off.
    least_tracks : int
        Vehicles; fewer leave the seven components of the state unfixed.
    least_fitness : float
        Share of traces on lanes. Right answers show 0.8 to 0.99, those a lane off 0.6 to 0.8.
    clear : float
        Standard deviations by which the vehicles must prefer an answer to every other
        (99.4 %, one-sided).
    mirror_share : float
        A mirrored recording is fitted where its search score is at least this share of the
        recording's own; infinite turns the check off.
    """

    street_sigma_m: tuple[float, float] = (0.3, 0.2)
    lane_sigma_m: tuple[float, float] = (0.18, 0.36)
    map_sigma_m: float = 0.15
    unfixed_m: tuple[float, float, float] = (1.0, 1.0, 0.5)
    unfixed_rad: tuple[float, float, float] = (radians(2.0), radians(2.0), radians(1.0))
    valley_steps_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    least_tracks: int = 5
    least_fitness: float = 0.6
    clear: float = 2.5
    mirror_share: float = 1.0


@dataclass(frozen=True, kw_only=True)
class LocalizationSettings:
    """All settings of the localization.

    Parameters
    ----------
    traces, search, hypotheses, answer : settings records
        Of the method `lane`, step by step; of those of `icp` the guess and the answer.
    """

    traces: TraceSettings = field(default_factory=TraceSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    hypotheses: HypothesisSettings = field(default_factory=HypothesisSettings)
    answer: AnswerSettings = field(default_factory=AnswerSettings)

    def changed(self, changes: Mapping[str, Any]) -> LocalizationSettings:
        """Return the settings with other values, by dotted name: `{"hypotheses.finalists": 1}`."""
        settings = self
        for name, value in changes.items():
            group, _, constant = name.partition(".")
            part = replace(getattr(settings, group), **{constant: value})
            settings = replace(settings, **{group: part})
        return settings

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults, by dotted name."""
        return changed(self, LOCALIZATION)


def changed(settings: Any, defaults: Any, path: str = "") -> dict[str, Any]:
    """Return the fields of a settings record that differ from another's, by dotted name."""
    found: dict[str, Any] = {}
    for part in fields(settings):
        value, default = getattr(settings, part.name), getattr(defaults, part.name)
        if is_dataclass(value):
            found |= changed(value, default, f"{path}{part.name}.")
        elif value != default:
            found[f"{path}{part.name}"] = value
    return found


LOCALIZATION = LocalizationSettings()
# Of the windows of one recording, whose errors by map and drivers are the same.
OF_WINDOWS = LOCALIZATION.changed({"answer.lane_sigma_m": (0.0, 0.0), "answer.map_sigma_m": 0.0})

HOUR_S = 3600.0

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class AlarmSettings:
    """Settings of the change detector by vehicles, against the sensor's own first hour.

    Lengths across a lane are means of a vehicle in a cell. *Measured* is on two hours of the sample
    junction, simulated as recorded (`bench/alarm.py`).

    Parameters
    ----------
    block_s : float
        Traffic is summed by blocks, and tested at the end of each.
    settle_s : float
        A vehicle counts in the block so long after its last detection, when none may follow.
    blocks : tuple of int
        Newest blocks that are tested: five for a strong move, nine for a small one (with
        `settle_s` within ten minutes), thirty for light traffic.
    share : float
        The tested blocks are at most that share of all there are: no alarm before 15 minutes,
        nine blocks are tested from 27 on, thirty from 90 on.
    reference_h, reference_vehicles : float, int
        The reference is the first hour; then it forgets within an hour or so many vehicles,
        whichever takes longer, to follow what changes slowly.
    dispersion, dispersion_blocks : float
        Ratio of the scatter between blocks to what independent vehicles make (broken tracks,
        platoons; measured 1.4 to 2.1): before it is measured at the sensor, and how many blocks
        that counts for.
    outlier : float
        Standard deviations of drivers' habit on a stretch from which on it is no habit but an
        obstacle, which weighs less and less.
    gate : float
        Score beyond which a move is noticed: 0.2 false alarms a month, 95 % under 2.0, by the tail
        of 240 hours of changing traffic (`bench/alarm.py`).
    """

    block_s: float = 60.0
    settle_s: float = 7.0
    blocks: tuple[int, ...] = (5, 9, 30)
    share: float = 0.34
    reference_h: float = 1.0
    reference_vehicles: int = 1000
    dispersion: float = 2.0
    dispersion_blocks: float = 20.0
    outlier: float = 2.0
    gate: float = 24.0


@dataclass(frozen=True, kw_only=True)
class MonitorSettings:
    """What may be set of the calibration monitor.

    Vectors of six are easting, northing, height and turns about the map's axes: metres, radians.

    Parameters
    ----------
    cycle_s : float
        Time between two corrected poses, seconds (the paper).
    drift : (6,) tuple
        1 sigma of how far a mast bends within an hour, in sun and wind.
    by_hand : (6,) tuple
        1 sigma of a start pose that states none: measured with tape, compass and spirit level.
    lengths_s : tuple of float
        Newest parts of the window that are tested for a move: a short one soon shows a blow, but
        holds few vehicles; a long one shows a shift of some decimetres.
    false_alarms : float
        Moves reported an hour where none was; at most, as if all tests were independent.
    suspect : float
        Level of chi2 above which a move is looked for and the pose's sigma widened.
    agreement : float
        Standard errors by which its vehicles must prefer the move, each counting as one.
        Measured where both other figures are beyond chance: at rest in light traffic 0.1 to 1.5,
        within 25 s of a turn by a degree 1.9 to 2.2, after a shift of half a metre 2.6 to 3.3.
    knock : (6,) tuple
        1 sigma of how far a blow moves a sensor that is still in use.
    lost_s : float
        `moved` with unknown pose after so many seconds of rejected fits: a whole window.
    alarm : AlarmSettings
        Of small moves, by where vehicles drive.
    localization : LocalizationSettings
        Of window, traces, lanes and fits. Where the map lies and drivers keep is the same in every
        window: it moves no pose, and the start pose states it.
    """

    cycle_s: float = 5.0
    drift: Six = (0.02, 0.02, 0.01, radians(0.1), radians(0.1), radians(0.1))
    by_hand: Six = (1.0, 1.0, 1.0, radians(2.0), radians(2.0), radians(2.0))
    lengths_s: tuple[float, ...] = (20.0, 60.0)
    false_alarms: float = 0.01
    suspect: float = 0.95
    agreement: float = 1.65
    knock: Six = (0.7, 0.7, 0.4, radians(3.0), radians(3.0), radians(4.0))
    lost_s: float = 100.0
    alarm: AlarmSettings = field(default_factory=AlarmSettings)
    localization: LocalizationSettings = OF_WINDOWS

    @property
    def gate(self) -> float:
        """Largest chi2 of six degrees of freedom that is chance, by `false_alarms`."""
        tests = HOUR_S / self.cycle_s * len(self.lengths_s)  # an hour
        return chi2_quantile(1.0 - self.false_alarms / tests)

    @property
    def median_chi2(self) -> float:
        """Median of chi2 of six degrees of freedom."""
        return chi2_quantile(0.5)

    @property
    def suspect_chi2(self) -> float:
        """Chi2 of six degrees of freedom above which a move is looked for."""
        return chi2_quantile(self.suspect)

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults, by dotted name."""
        return changed(self, MONITOR)


def chi2_quantile(level: float) -> float:
    """Return the quantile of chi2 of six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * scipy.special.gammaincinv(3.0, level))


MONITOR = MonitorSettings()
ALARM = MONITOR.alarm

"""Settings of the localization that may be set; those that differ go into a pose's evidence.

Other constants of its algorithms stand beside their use. What is assumed of vehicles and radars is
in :mod:`gis_radar.calibration.model`: those constants carry an uncertainty that enters an answer's
covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import radians
from typing import Any

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
class LaneSettings:
    """Which lanes a detection may lie on.

    Parameters
    ----------
    slack_mps : float
        Range rates may disagree with a lane by noise and the turning of a long vehicle.
    """

    slack_mps: float = 0.5


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """How the traces are levelled and laid on a grid of places and headings.

    Parameters
    ----------
    guess_m : float
        How far a guess may be off (contract).
    heading_tolerance : float
        Radians either way of a given heading: 25 degrees (contract) and some slack.
    level_rounds : int
        Reweighted fits of the plane; it settles in five to eight.
    """

    guess_m: float = 15.0
    heading_tolerance: float = radians(30.0)
    level_rounds: int = 12


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
class AdaptationSettings:
    """What is estimated of the radar and the vehicles of a recording.

    Parameters
    ----------
    least : int
        Samples near enough; with fewer no heights are estimated.
    most_factor : float
        Largest factor on the side strength that is tried, up and down.
    """

    least: int = 200
    most_factor: float = 4.0


@dataclass(frozen=True, kw_only=True)
class AnswerSettings:
    """What an answer must show, and how certain it is.

    Parameters
    ----------
    street_sigma_m : (2,) tuple
        1 sigma, from street to street, of lanes as drawn and driven, and of the scan's heights.
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
    unfixed_m: tuple[float, float, float] = (1.0, 1.0, 0.5)
    unfixed_rad: tuple[float, float, float] = (radians(2.0), radians(2.0), radians(1.0))
    valley_steps_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    least_tracks: int = 5
    least_fitness: float = 0.6
    clear: float = 2.5
    mirror_share: float = 1.0


@dataclass(frozen=True, kw_only=True)
class IcpSettings:
    """The paper's registration.

    Parameters
    ----------
    voxel_m : float
        Edge of the voxels of traces and road (the paper).
    eps_m, min_points : float, int
        DBSCAN of the traces' voxels: gaps between the lanes of a street stay closed.
    distances_m : tuple of float
        Correspondence distances: large, then two voxels and one (the paper).
    iterations : int
        Most at each distance.
    """

    voxel_m: float = 0.5
    eps_m: float = 2.0
    min_points: int = 10
    distances_m: tuple[float, ...] = (10.0, 1.0, 0.5)
    iterations: int = 60


@dataclass(frozen=True, kw_only=True)
class LocalizationSettings:
    """All settings of the localization.

    Parameters
    ----------
    traces, lanes, search, hypotheses, adaptation, answer : settings records
        Of the method `lane`, step by step.
    icp : IcpSettings
        Of the method `icp`.
    """

    traces: TraceSettings = field(default_factory=TraceSettings)
    lanes: LaneSettings = field(default_factory=LaneSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    hypotheses: HypothesisSettings = field(default_factory=HypothesisSettings)
    adaptation: AdaptationSettings = field(default_factory=AdaptationSettings)
    answer: AnswerSettings = field(default_factory=AnswerSettings)
    icp: IcpSettings = field(default_factory=IcpSettings)

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

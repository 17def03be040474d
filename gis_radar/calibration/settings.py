"""Settings of the localization: every constant of its algorithms, with unit and reason.

Those of traces and lanes are in `trace_settings`. What is assumed of vehicles and radars is not
here but in :mod:`gis_radar.calibration.model`: those constants carry an uncertainty that enters an
answer's covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import log, radians
from typing import Any

import numpy as np

from gis_radar.calibration.trace_settings import LaneSettings, TraceSettings

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
class SearchSettings:
    """How the traces are levelled and laid on a grid of places and headings.

    Parameters
    ----------
    guess_m : float
        How far a guess may be off (contract).
    slack_m : float
        Searched beyond it.
    heading_tolerance : float
        Radians either way of a given heading: 25 degrees (contract) and some slack.
    tilt : float
        1 sigma of how far masts and roads lean, radians.
    level_spread_m, level_elevation : float
        1 sigma of reflections about the levelled plane: vehicles, and elevation noise (radians).
    level_rounds : int
        Reweighted fits of the plane; it settles in five to eight.
    samples : int
        Traces scored; cost in proportion.
    sights : int
        Bins of the direction of sight, 5.6 degrees.
    spread_m, step_m, yaw_step : float
        Bell across a lane, grid of places, grid of headings (radians). Steps are at most one
        spread, or 50 m off half of one.
    beside : float
        Cosine by which a lane's direction may disagree with the Doppler's sign (15 degrees).
    near_m, near_rad : float
        Closer peaks are one.
    candidates, known_candidates : int
        Peaks that are fitted, without and with a heading; cost in proportion.
    """

    guess_m: float = 15.0
    slack_m: float = 2.0
    heading_tolerance: float = radians(30.0)
    tilt: float = radians(6.0)
    level_spread_m: float = 0.5
    level_elevation: float = radians(0.6)
    level_rounds: int = 12
    samples: int = 900
    sights: int = 64
    spread_m: float = 2.0
    step_m: float = 2.0
    yaw_step: float = radians(2.0)
    beside: float = 0.25
    near_m: float = 3.0
    near_rad: float = radians(5.0)
    candidates: int = 10
    known_candidates: int = 4


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """The robust part of the likelihood, and when a fit has converged.

    Parameters
    ----------
    stray_share : float
        Share of detections that are on no vehicle: ghosts and multipath.
    stray_width_m, stray_height_m : float
        Over which width and height these spread evenly.
    front : tuple of float
        Where a front or rear reflects, in half widths: the middles of its thirds.
    view_edge : float
        Radians inside the field of view within which a height counts; beyond it only the tall
        are seen.
    far : Schedule
        From a lane off.
    settled_m, settled_sigmas : float
        A step shorter than either ends a stage: far below the noise.
    at_rest_m, at_rest_sigmas : float
        Where no shorter step helps, one shorter than either is convergence too: it promised to
        lower the cost by one at most, as faces that come and go make bumps of that size.
    shrink, least_share : float
        A step that does not help is divided by `shrink`, down to this share.
    least_curvature : float
        Where the curvature is no minimum's, the share of the weights' information that counts.
    floor : float
        Information of what nothing fixes, 1/m^2: a kilometre.
    """

    stray_share: float = 0.1
    stray_width_m: float = 8.0
    stray_height_m: float = 8.0
    front: tuple[float, ...] = (-2.0 / 3.0, 0.0, 2.0 / 3.0)
    view_edge: float = radians(1.0)
    far: Schedule = Schedule(scales_m=(1.5, 0.75, 0.3, 0.0), rounds=6)
    settled_m: float = 5e-3
    settled_sigmas: float = 0.02
    at_rest_m: float = 0.1
    at_rest_sigmas: float = 1.5
    shrink: float = 3.0
    least_share: float = 0.05
    least_curvature: float = 0.05
    floor: float = 1e-6

    @property
    def no_vehicle(self) -> float:
        """Loss of a sample that is on no vehicle."""
        return float(-np.log(self.stray_share * np.sqrt(2.0 * np.pi) / self.stray_width_m))


@dataclass(frozen=True, kw_only=True)
class HypothesisSettings:
    """How starts are fitted and ranked.

    Parameters
    ----------
    reflection_m, reflection_sigma_m : float
        Prior of the mean height of reflections: between wheel hubs and belt lines.
    rough_samples : int
        Enough to rank hypotheses; cost in proportion.
    rough, settle, fine : Schedule
        First fit of every candidate, fit of each finalist, fit to all samples.
    finalists, gone : int, float
        Most of them, and how many standard deviations behind the first none is one.
    rival : float
        Standard deviations behind the first that earn a full look, which brings a hypothesis
        nearer by about half of one; more than `AnswerSettings.clear`.
    twin_m, twin_rad : (3,) tuples
        Closer fits are one: easting, northing, height; turns about the axes.
    look_m, look_steps : float, (2,) tuple of int
        Grid around an optimum on which better ones are looked for: half a vehicle's width apart,
        and so many steps to all sides and turns, which count at `AnswerSettings.lever_m`.
    look_scale_m, look_samples, look_places : float, int, int
        Widening of the spreads there (drivers differ by as much), samples that are looked at, and
        how many of the lowest places are fitted.
    looks, look_gain : int, float
        Most looks, each around the last's best; what one must gain (a sigma costs 0.5).
    """

    reflection_m: float = 0.6
    reflection_sigma_m: float = 0.25
    rough_samples: int = 1000
    rough: Schedule = Schedule(scales_m=(1.5, 0.75, 0.3), rounds=4)
    settle: Schedule = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=4)
    fine: Schedule = Schedule(scales_m=(0.2, 0.1, 0.0), rounds=30)
    finalists: int = 4
    gone: float = 5.0
    rival: float = 3.5
    twin_m: tuple[float, float, float] = (0.3, 0.3, 0.5)
    twin_rad: tuple[float, float, float] = (radians(0.5), radians(0.5), radians(0.3))
    look_m: float = 0.5
    look_steps: tuple[int, int] = (3, 2)
    look_scale_m: float = 0.3
    look_samples: int = 400
    look_places: int = 4
    looks: int = 4
    look_gain: float = 1.0


@dataclass(frozen=True, kw_only=True)
class AdaptationSettings:
    """What is estimated of the radar and the vehicles of a recording.

    Parameters
    ----------
    edge_m, edge_sigma_m : float
        Bumpers, sills and wheels end that far over the road (ground clearance 0.12 to 0.3 m).
    nodes : int
        Of the quadrature over the gamma distribution of heights above the edge.
    tall_share, tall_m : float, (2,) tuple
        Share of bodies, and between which heights above the edge they reflect.
    stray_share, stray_m : float
        Share of strays, and over which height.
    near_m : float
        Farther samples fix no heights: 0.6 degrees are 0.8 m.
    least, most : int
        Samples: fewer are too few, more cost time only.
    noise_m : float
        1 sigma of the heights of scan and map.
    start, low, high : (3,) tuples
        Edge (m), scale (m) and elevation noise (radians): start of the fit and its bounds.
    most_factor, factors : float, int
        Largest factor on the side strength that is tried, up and down, and how many.
    factor_sigma : float
        1 sigma of the logarithm of that factor in the prior.
    step : float
        Of numerical derivatives.
    bent_shares, bent_rounds : tuple of float, int
        Shares of the elevation's variance that may last, and rounds in which the effects settle.
    """

    edge_m: float = 0.2
    edge_sigma_m: float = 0.07
    nodes: int = 16
    tall_share: float = 0.2
    tall_m: tuple[float, float] = (0.2, 2.8)
    stray_share: float = 0.05
    stray_m: float = 8.0
    near_m: float = 80.0
    least: int = 200
    most: int = 1500
    noise_m: float = 0.05
    start: tuple[float, float, float] = (0.2, 0.2, radians(0.5))
    low: tuple[float, float, float] = (-1.5, 0.05, radians(0.1))
    high: tuple[float, float, float] = (2.0, 0.6, radians(2.0))
    most_factor: float = 4.0
    factors: int = 17
    factor_sigma: float = log(2.0)
    step: float = 1e-4
    bent_shares: tuple[float, ...] = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
    bent_rounds: int = 4


@dataclass(frozen=True, kw_only=True)
class AnswerSettings:
    """What an answer must show, and how certain it is.

    Parameters
    ----------
    street_sigma_m : (2,) tuple
        1 sigma, from street to street, of lanes as drawn and driven, and of the scan's heights.
    street_m : float
        Length of a street section with a bias of its own.
    unfixed_m, unfixed_rad : (3,) tuples
        Sigmas from which on a scene does not fix easting, northing, height; roll, pitch, yaw.
        One metre is the paper's accuracy; with 2 degrees a far trace is a lane off.
    lever_m : float
        Metres that a turn counts as in steps, hops, eigenvalues and along a valley.
    valley : Schedule
        Fit at each step along the least-known direction.
    valley_steps_m : tuple of float
        How far along it the profile of the likelihood is taken; none turns it off.
    least_rise, clear_rise : float
        Rise of the cost: of one standard deviation, and of ten, where a place is excluded.
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
    same_chi2 : float
        Squared standard deviations within which two answers are one (99.9 %, 3 components).
    one_answer_m, one_answer_rad : float
        Optima that near to each other are one answer with a larger sigma: nearer than lanes are,
        and what drivers off the middle of their lanes can make of one.
    least_scanned : float
        Share of lanes in reach that the scanned road must cover.
    slack_m : float
        An answer may lie that much farther off than a guess may.
    """

    street_sigma_m: tuple[float, float] = (0.3, 0.2)
    street_m: float = 60.0
    unfixed_m: tuple[float, float, float] = (1.0, 1.0, 0.5)
    unfixed_rad: tuple[float, float, float] = (radians(2.0), radians(2.0), radians(1.0))
    lever_m: float = LEVER_M
    valley: Schedule = Schedule(scales_m=(0.3, 0.0), rounds=4)
    valley_steps_m: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    least_rise: float = 0.5
    clear_rise: float = 50.0
    least_tracks: int = 5
    least_fitness: float = 0.6
    clear: float = 2.5
    mirror_share: float = 1.0
    same_chi2: float = 16.0
    one_answer_m: float = 1.0
    one_answer_rad: float = radians(3.0)
    least_scanned: float = 0.3
    slack_m: float = 5.0


@dataclass(frozen=True, kw_only=True)
class IcpSettings:
    """The paper's registration.

    Parameters
    ----------
    voxel_m : float
        Edge of the voxels of traces and road (the paper).
    eps_m, min_points : float, int
        DBSCAN of the traces' voxels: gaps between the lanes of a street stay closed.
    profile_m : float
        How far the pose is moved to measure how well the road fixes it: farther than the slack
        between traces and kerb, in which the cost is flat.
    distances_m : tuple of float
        Correspondence distances: large, then two voxels and one (the paper).
    iterations : int
        Most at each distance.
    mast_m : float
        Height of a usual mast, where the guess has none.
    headings : int
        Tried where none is given, evenly around.
    farthest : float
        An answer farther off than so many times the error of a guess is refused.
    """

    voxel_m: float = 0.5
    eps_m: float = 2.0
    min_points: int = 10
    profile_m: float = 2.0
    distances_m: tuple[float, ...] = (10.0, 1.0, 0.5)
    iterations: int = 60
    mast_m: float = 5.0
    headings: int = 8
    farthest: float = 2.0


@dataclass(frozen=True, kw_only=True)
class LocalizationSettings:
    """All settings of the localization.

    Parameters
    ----------
    traces, lanes, search, solver, hypotheses, adaptation, answer : settings records
        Of the method `lane`, step by step.
    icp : IcpSettings
        Of the method `icp`.
    """

    traces: TraceSettings = field(default_factory=TraceSettings)
    lanes: LaneSettings = field(default_factory=LaneSettings)
    search: SearchSettings = field(default_factory=SearchSettings)
    solver: SolverSettings = field(default_factory=SolverSettings)
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

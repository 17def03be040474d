"""Register a window of traffic to the lanes, starting near the right pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.base import QUIET, Floats, Integers, NoAnswerError, Reporter
from gis_radar.calibration.monitoring.kalman_filter import (
    Estimate,
    Measurement,
    covariance_from_angles,
)
from gis_radar.calibration.registration.adaptation import adapted
from gis_radar.calibration.registration.certainty import advantage, certainty
from gis_radar.calibration.registration.hypotheses import (
    HEADING_TOLERANCE,
    find_hypotheses,
    prior_at,
    rough,
)
from gis_radar.calibration.registration.lanes import Lanes, Scene
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.solver import FAR, Fit, Prior, Schedule, cost_at, solve
from gis_radar.calibration.registration.state import POSE_PART, REFLECTION, SIZE, State
from gis_radar.calibration.registration.traces import (
    Moving,
    Samples,
    link_tracks,
    thin,
    vehicles_of,
)
from gis_radar.calibration.single.lane_method import LEAST_FITNESS, LEAST_TRACKS, lanes_around
from gis_radar.calibration.single.result import Problem

# 1 sigma of the wide prior, around the expected pose, with which a window is fitted.
NEAR = np.array([1.0, 1.0, 1.0, *np.radians([2.0, 2.0, 2.0])])
# Schedule of the fit of a window, which starts within decimetres.
WINDOW_SCHEDULE = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=12)
# Information of the data below this share of the prior's is taken for none and set to UNKNOWN.
_LEAST_DATA = 0.05
_UNKNOWN = 1e-4
# Factor on the range of traces for sampling lanes, so that it is seldom repeated
_REACH_GROWS = 1.2
# A pose a lane off contradicts the start pose with this z score (1 more than for ambiguous
# localizations) and distance.
_OTHER_LANE = 3.5
_OTHER_LANE_M = 1.0
# Schedule of a first fit from a lane off; fits that return to within half of _OTHER_LANE_M are not
# continued.
_LANE_OFF = Schedule(scales_m=(0.75, 0.3), rounds=3)
_FARTHEST = 4.0  # largest distance of a searched pose, in sigmas of its prior


def data_alone(fit: Fit, prior: Prior) -> Measurement:
    """Return the measurement by the data of a fit, with the prior removed.

    With the prior, every window would confirm the pose before it. In coordinates where the prior
    has unit variance, the fit has information `1 + m` and the data `m` along each eigenvector, and
    the data's pose is farther from the prior's mean by the factor `(1 + m) / m`.

    Parameters
    ----------
    fit : Fit
        A registration.
    prior : Prior
        The prior of the fit.
    """
    known = certainty(fit, map_sigma_m=0.0)
    quaternion = _quaternion(fit.state)
    unit = np.diag(prior.information[POSE_PART, POSE_PART]) ** -0.5
    total, noise = (
        covariance_from_angles(quaternion, part) / np.outer(unit, unit)
        for part in (known.covariance, known.noise)
    )
    values, vectors = np.linalg.eigh(np.linalg.inv(total))
    data = values - 1.0
    informed = data > _LEAST_DATA
    offset = fit.state.difference(prior.mean)[POSE_PART] / unit
    factor = np.where(informed, values / np.where(informed, data, 1.0), 0.0)
    step = np.zeros(SIZE)
    step[POSE_PART] = unit * (vectors @ (factor * (vectors.T @ offset)))
    state = prior.mean.moved(step)
    # in directions without information only the noise is scaled, not the common error
    noise_scale = np.sqrt(values / np.where(informed, data, _UNKNOWN))
    common_scale = np.where(informed, noise_scale, 1.0)
    noise, common = (
        _scaled_covariance(part, vectors * grows @ vectors.T, unit)
        for part, grows in ((noise, noise_scale), (total - noise, common_scale))
    )
    return Measurement(
        position=state.position,
        quaternion=_quaternion(state),
        covariance=noise + common,
        noise=noise,
    )


def _scaled_covariance(covariance: Floats, scale: Floats, unit: Floats) -> Floats:
    """Return a covariance in units of `unit`, scaled by a matrix, in metres and radians."""
    scaled = scale @ covariance @ scale.T * np.outer(unit, unit)
    return np.asarray((scaled + scaled.T) / 2.0)


def _quaternion(state: State) -> Floats:
    return np.asarray(Rotation.from_matrix(state.R_map_sensor).as_quat(canonical=True))


@dataclass(frozen=True, kw_only=True)
class WindowTraffic:
    """Moving detections of a span of time, with their tracks.

    Parameters
    ----------
    moving : Moving
        The detections.
    number : (n,) array
        Number of the track of each detection.
    """

    moving: Moving
    number: Integers

    @classmethod
    def of(cls, moving: Moving) -> WindowTraffic:
        """Link the detections of a window to tracks."""
        return cls(moving=moving, number=link_tracks(moving))

    def between(self, begin: float, end: float) -> WindowTraffic:
        """Return the traffic between two times (UNIX seconds), the end exclusive."""
        low, high = np.searchsorted(self.moving.time, [begin, end])
        part = slice(int(low), int(high))
        _, number = np.unique(np.append(self.number[part], -1), return_inverse=True)
        begin, end = max(begin, self.moving.begin), min(end, self.moving.end)
        moving = replace(self.moving.where(part), begin=begin, end=end)
        return WindowTraffic(moving=moving, number=number[:-1] - 1)

    @cached_property
    def vehicles(self) -> int:
        """Number of vehicles; a vehicle may have several tracks."""
        return len(np.unique(vehicles_of(self.moving, self.number)))

    def samples(self) -> Samples:
        """Return the samples for a registration."""
        return thin(self.moving, self.number)


@dataclass(frozen=True, kw_only=True)
class WindowFit:
    """Fit of a window, and the pose that it measures.

    Parameters
    ----------
    measurement : Measurement
        The pose by the data alone.
    fit : Fit
        The registration.
    samples : Samples
        The samples that were registered.
    on_lanes : bool
        Whether at least `LEAST_FITNESS` of the samples are on lanes.
    """

    measurement: Measurement
    fit: Fit
    samples: Samples
    on_lanes: bool

    @property
    def trusted(self) -> bool:
        """Whether the fit converged with the samples on lanes."""
        return self.fit.converged and self.on_lanes


class WindowFitter:
    """Fits windows of traffic to the lanes around a sensor.

    Parameters
    ----------
    problem : Problem
        Map, road and approximate position of the sensor.
    reporter : Reporter
        Receives remarks.
    """

    def __init__(self, problem: Problem, *, reporter: Reporter = QUIET) -> None:
        self._problem = problem
        self._reporter = reporter
        self._reach_m = 0.0
        self._lanes: Lanes | None = None
        self._model = MODEL
        self._reflections: tuple[float, float] | None = None  # mean and information

    def _lanes_for(self, samples: Samples) -> Lanes:
        """Return the lanes within reach of samples."""
        reach_m = float(np.percentile(np.hypot(*samples.points[:, :2].T), 99.5))
        if self._lanes is None or reach_m > self._reach_m:
            grow, reporter = _REACH_GROWS, self._reporter
            self._reach_m, self._reporter = grow * reach_m, QUIET  # remarks only once
            self._lanes = lanes_around(self._problem, samples, reporter, grow=grow)
        return self._lanes

    def scene(self, samples: Samples) -> Scene:
        """Return the scene of samples and the lanes within their reach."""
        return Scene(
            lanes=self._lanes_for(samples),
            samples=samples,
            lane_sigma_m=(0.0, 0.0),
            keeps_lanes=False,
        )

    def fit(
        self,
        traffic: WindowTraffic,
        centre: Estimate,
        reflection_m: float,
        *,
        near: Floats = NEAR,
        start: State | None = None,
        schedule: Schedule = WINDOW_SCHEDULE,
    ) -> WindowFit | None:
        """Fit a window of traffic to the lanes near a pose; None where it holds too few vehicles.

        Parameters
        ----------
        traffic : WindowTraffic
            The window's traffic.
        centre : Estimate
            Centre of the prior.
        reflection_m : float
            Mean height of reflections, metres, of the prior.
        near : (6,) array
            1 sigma of the prior: metres, radians.
        start : State, optional
            Start of the fit; by default the centre.
        schedule : Schedule
            As for :func:`gis_radar.calibration.registration.solver.solve`.
        """
        if traffic.vehicles < LEAST_TRACKS:
            return None
        samples = traffic.samples()
        prior = self._prior(centre.state(reflection_m), near)
        begin = prior.mean if start is None else start
        fit = solve(self.scene(samples), begin, prior, schedule=schedule, model=self._model)
        return WindowFit(
            measurement=data_alone(fit, prior),
            fit=fit,
            samples=samples,
            on_lanes=fit.fitness >= LEAST_FITNESS,
        )

    def find(
        self, traffic: WindowTraffic, centre: Estimate, reflection_m: float, *, near: Floats
    ) -> WindowFit | None:
        """Search a pose within `_FARTHEST` sigmas at which the traffic fits; None if none is found.

        Parameters
        ----------
        traffic, centre, reflection_m, near
            As for :meth:`fit`.
        """
        samples, state = traffic.samples(), centre.state(reflection_m)
        heading = float(state.yaw_pitch_roll[0]), HEADING_TOLERANCE
        for hypothesis in find_hypotheses(self.scene(samples), heading=heading):
            offset = hypothesis.fit.state.difference(state)[POSE_PART] / near
            if np.abs(offset).max() < _FARTHEST:
                fit = self.fit(traffic, centre, reflection_m, near=near, start=hypothesis.fit.state)
                return fit if fit is not None and fit.trusted else None
        return None

    def cost(self, samples: Samples, state: State) -> float:
        """Return the cost of samples at a pose, a negative log likelihood."""
        return cost_at(self.scene(samples), state, model=self._model)

    def adapt(self, window_fit: WindowFit) -> None:
        """Adapt prior and model of later fits to this radar, by a trusted fit."""
        samples, fit = window_fit.samples, window_fit.fit
        before = Prior(mean=fit.state, information=np.zeros((SIZE, SIZE)))
        after, self._model = adapted(self.scene(samples), fit, before, MODEL)
        if after is not before:
            known = float(after.information[REFLECTION, REFLECTION])
            self._reflections = after.mean.reflection, known

    def _prior(self, centre: State, near: Floats) -> Prior:
        """Return the prior about a state, with 1 sigma `near` and the adapted reflections."""
        information = prior_at(centre).information.copy()
        information[POSE_PART, POSE_PART] = np.diag(near**-2.0)
        if self._reflections is not None:
            mean_m, information[REFLECTION, REFLECTION] = self._reflections
            centre = replace(centre, reflection=mean_m)
        return Prior(mean=centre, information=information)

    def refuse_other_lane(self, window_fit: WindowFit) -> None:
        """Refuse a fit if a pose that is a lane off fits significantly better.

        Raises
        ------
        NoAnswerError
            If there is such a pose.
        """
        scene, state_found = rough(self.scene(window_fit.samples)), window_fit.fit.state

        def fit_at(state: State, schedule: Schedule = FAR) -> Fit:
            prior = replace(prior_at(state), mean=state)
            return solve(scene, state, prior, schedule=schedule)

        def apart_m(one: Fit, other: Fit) -> float:
            return float(np.hypot(*one.state.difference(other.state)[:2]))

        refitted = fit_at(state_found, _LANE_OFF)
        starts = [
            (state, fit_at(state, _LANE_OFF)) for state in _states_a_lane_off(scene, window_fit.fit)
        ]
        distinct = [state for state, fit in starts if apart_m(fit, refitted) > _OTHER_LANE_M / 2.0]
        own = fit_at(state_found) if distinct else refitted
        for other in map(fit_at, distinct):
            away_m = apart_m(other, own)
            z_score = advantage(other, own, scene.samples)
            if z_score > _OTHER_LANE and away_m > _OTHER_LANE_M:
                raise NoAnswerError(
                    "{}: the traffic fits clearly better with the sensor {:.1f} m from "
                    "its start pose",
                    self._problem.name,
                    away_m,
                    hint="find the pose with gis-radar localize",
                )


def _states_a_lane_off(scene: Scene, fit: Fit) -> list[State]:
    """Return the fit's state moved by a lane's width along and across the direction of traffic."""
    lanes, used = scene.lanes, fit.matches.lane[fit.matches.found]
    if len(used) == 0:
        return []
    # mean of doubled angles: both directions of a street are one
    turn = np.arctan2(lanes.along[used, 1], lanes.along[used, 0])
    sides = np.angle(np.mean(np.exp(2j * turn))) / 2.0 + np.arange(4) * np.pi / 2.0
    width_m = float(np.median(lanes.width_m[used]))
    moves = width_m * np.column_stack([np.cos(sides), np.sin(sides), np.zeros(4)])
    return [replace(fit.state, position=fit.state.position + move) for move in moves]

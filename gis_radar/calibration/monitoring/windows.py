"""Register a window of traffic to the lanes, from a pose that is nearly right."""

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
from gis_radar.calibration.registration.state import POSE, REFLECTION, SIZE, State
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
WINDOW = Schedule(scales_m=(0.3, 0.1, 0.0), rounds=12)
# Information of the data below this share of the prior's counts as none, and is set to UNKNOWN.
LEAST_KNOWN = 0.05
UNKNOWN = 1e-4
# Lanes are sampled so many times as far as the traces reach, so that they are seldom sampled anew.
REACH_GROWS = 1.2
# A pose a lane off refutes the start if vehicles prefer it by so many standard deviations (one more
# than separates two answers of a localization), and if it is at least so far off.
OTHER_LANE = 3.5
OTHER_LANE_M = 1.0
# Schedule of a first fit from a lane off: most come back to within half of OTHER_LANE_M, and are
# fitted no further.
LANE_OFF = Schedule(scales_m=(0.75, 0.3), rounds=3)
# Sigmas of a blow within which the pose is searched where no fit nearby lies on lanes.
FARTHEST = 4.0


def data_alone(fit: Fit, prior: Prior) -> Measurement:
    """Remove the prior from a fit; else every window would confirm the pose before it.

    In coordinates where the prior has variance one along each axis, `1 + m` is the information of
    the fit and `m` that of the data; the data's pose is farther off by `(1 + m) / m`.

    Parameters
    ----------
    fit : Fit
        A registration.
    prior : Prior
        The prior of the fit.
    """
    known = certainty(fit, map_sigma_m=0.0)
    quaternion = _quaternion(fit.state)
    unit = np.diag(prior.information[POSE, POSE]) ** -0.5
    whole, noise = (
        covariance_from_angles(quaternion, part) / np.outer(unit, unit)
        for part in (known.covariance, known.noise)
    )
    values, vectors = np.linalg.eigh(np.linalg.inv(whole))
    data = values - 1.0
    seen = data > LEAST_KNOWN
    away = fit.state.difference(prior.mean)[POSE] / unit
    farther = np.where(seen, values / np.where(seen, data, 1.0), 0.0)
    step = np.zeros(SIZE)
    step[POSE] = unit * (vectors @ (farther * (vectors.T @ away)))
    there = prior.mean.moved(step)
    # the common error does not grow in directions in which this window holds no information
    noise_grows = np.sqrt(values / np.where(seen, data, UNKNOWN))
    common_grows = np.where(seen, noise_grows, 1.0)
    noise, common = (
        _stretched(part, vectors * grows @ vectors.T, unit)
        for part, grows in ((noise, noise_grows), (whole - noise, common_grows))
    )
    return Measurement(
        position=there.position,
        quaternion=_quaternion(there),
        covariance=noise + common,
        noise=noise,
    )


def _stretched(part: Floats, stretch: Floats, unit: Floats) -> Floats:
    wide = stretch @ part @ stretch.T * np.outer(unit, unit)
    return np.asarray((wide + wide.T) / 2.0)


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
        The track of each.
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
        """Number of vehicles; the parts of a track that was cut count as one."""
        return len(np.unique(vehicles_of(self.moving, self.number)))

    def samples(self) -> Samples:
        """Return the samples for a registration."""
        return thin(self.moving, self.number)


@dataclass(frozen=True, kw_only=True)
class WindowFit:
    """The fit of a window, and the pose that it measures.

    Parameters
    ----------
    measurement : Measurement
        The pose, from the data alone.
    fit : Fit
        The registration.
    samples : Samples
        The samples that were registered.
    on_lanes : bool
        Whether the traffic is on the lanes.
    """

    measurement: Measurement
    fit: Fit
    samples: Samples
    on_lanes: bool

    @property
    def trusted(self) -> bool:
        """Whether the fit converged, with the traffic on the lanes."""
        return self.fit.converged and self.on_lanes


class WindowFitter:
    """Fitter of windows of traffic to the lanes around a sensor.

    Parameters
    ----------
    problem : Problem
        Map, road and place of the sensor.
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

    def lanes(self, samples: Samples) -> Lanes:
        """Return the lanes within reach of samples."""
        reach_m = float(np.percentile(np.hypot(*samples.points[:, :2].T), 99.5))
        if self._lanes is None or reach_m > self._reach_m:
            grow, reporter = REACH_GROWS, self._reporter
            self._reach_m, self._reporter = grow * reach_m, QUIET  # remarks only once
            self._lanes = lanes_around(self._problem, samples, reporter, grow=grow)
        return self._lanes

    def scene(self, samples: Samples) -> Scene:
        """Return samples with the lanes within their reach."""
        return Scene(
            lanes=self.lanes(samples), samples=samples, lane_sigma_m=(0.0, 0.0), keeps_lanes=False
        )

    def fit(
        self,
        traffic: WindowTraffic,
        centre: Estimate,
        reflection_m: float,
        *,
        near: Floats = NEAR,
        start: State | None = None,
        schedule: Schedule = WINDOW,
    ) -> WindowFit | None:
        """Fit a window of traffic to the lanes near a pose; None where it holds too few vehicles.

        Parameters
        ----------
        traffic : WindowTraffic
            The window's traffic.
        centre : Estimate
            Centre of the prior.
        reflection_m : float
            Height of the vehicles' reflections so far, metres.
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
        """Search the pose farther around where the traffic fits no lanes; None if none is found.

        Parameters
        ----------
        traffic, centre, reflection_m, near
            As for :meth:`fit`.
        """
        samples, state = traffic.samples(), centre.state(reflection_m)
        heading = float(state.yaw_pitch_roll[0]), HEADING_TOLERANCE
        for tried in find_hypotheses(self.scene(samples), heading=heading):
            away = tried.fit.state.difference(state)[POSE] / near
            if np.abs(away).max() < FARTHEST:
                found = self.fit(traffic, centre, reflection_m, near=near, start=tried.fit.state)
                return found if found is not None and found.trusted else None
        return None

    def cost(self, samples: Samples, state: State) -> float:
        """Return the cost of samples at a pose, a negative log likelihood."""
        return cost_at(self.scene(samples), state, model=self._model)

    def adapt(self, found: WindowFit) -> None:
        """Adapt prior and model to this radar by a trusted fit, starting from the defaults."""
        samples, fit = found.samples, found.fit
        before = Prior(mean=fit.state, information=np.zeros((SIZE, SIZE)))
        after, self._model = adapted(self.scene(samples), fit, before, MODEL)
        if after is not before:
            known = float(after.information[REFLECTION, REFLECTION])
            self._reflections = after.mean.reflection, known

    def _prior(self, centre: State, near: Floats) -> Prior:
        information = prior_at(centre).information.copy()
        information[POSE, POSE] = np.diag(near**-2.0)
        if self._reflections is not None:
            mean_m, information[REFLECTION, REFLECTION] = self._reflections
            centre = replace(centre, reflection=mean_m)
        return Prior(mean=centre, information=information)

    def refuse_other_lane(self, found: WindowFit) -> None:
        """Refuse a pose where the same data fit clearly better on a neighbouring lane.

        Raises
        ------
        NoAnswerError
            If the vehicles prefer a pose that is a lane off.
        """
        part, here = rough(self.scene(found.samples)), found.fit.state

        def at(state: State, schedule: Schedule = FAR) -> Fit:
            prior = replace(prior_at(state), mean=state)
            return solve(part, state, prior, schedule=schedule)

        def apart_m(one: Fit, other: Fit) -> float:
            return float(np.hypot(*one.state.difference(other.state)[:2]))

        back = at(here, LANE_OFF)
        tried = [(state, at(state, LANE_OFF)) for state in _a_lane_off(part, found.fit)]
        away = [state for state, fit in tried if apart_m(fit, back) > OTHER_LANE_M / 2.0]
        first = at(here) if away else back
        for other in map(at, away):
            away_m = apart_m(other, first)
            z_score = advantage(other, first, part.samples)
            if z_score > OTHER_LANE and away_m > OTHER_LANE_M:
                raise NoAnswerError(
                    "{}: the traffic fits clearly better with the sensor {:.1f} m from "
                    "its start pose",
                    self._problem.name,
                    away_m,
                    hint="find the pose with gis-radar localize",
                )


def _a_lane_off(scene: Scene, fit: Fit) -> list[State]:
    """Return the fit's state moved by a lane to every side of the main directions of traffic."""
    lanes, used = scene.lanes, fit.matches.lane[fit.matches.found]
    if len(used) == 0:
        return []
    # twice the angle: both directions of a street are one
    turn = np.arctan2(lanes.along[used, 1], lanes.along[used, 0])
    sides = np.angle(np.mean(np.exp(2j * turn))) / 2.0 + np.arange(4) * np.pi / 2.0
    width_m = float(np.median(lanes.width_m[used]))
    moves = width_m * np.column_stack([np.cos(sides), np.sin(sides), np.zeros(4)])
    return [replace(fit.state, position=fit.state.position + move) for move in moves]

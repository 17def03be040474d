"""Fit a pose that is nearly right to the lanes: how far, and to which side, the given one is off.

A cause of a fault is named only if nothing is off once what it says is corrected (:func:`fits_if`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from gis_radar.base import Floats, Text
from gis_radar.calibration.check.evidence import MEAN_REFLECTION_M, LaneMap
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.mistakes import Mistake, within_half_turn
from gis_radar.calibration.findings import sense, side
from gis_radar.calibration.monitoring.kalman_filter import Measurement, covariance_of_angles
from gis_radar.calibration.monitoring.windows import NEAR, WINDOW_SCHEDULE, data_alone
from gis_radar.calibration.registration.certainty import MAP_SIGMA_M, PLACE, PLANE, along_valley
from gis_radar.calibration.registration.hypotheses import LOOK_SCALE_M, few_samples, prior_at
from gis_radar.calibration.registration.lanes import Scene
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.solver import Fit, Prior, cost_at, solve_likeliest
from gis_radar.calibration.registration.state import POSE_PART, SIZE, State
from gis_radar.calibration.registration.traces import thin
from gis_radar.poses import ANGLES, Pose

_LEAST_FITNESS = 0.75  # least share of the samples that lie on lanes at a pose that is fitted
# Place and heading are surveyed each by itself, and one mistake is of one of them: 1 sigma of the
# other, as 0.3 m, here or 60 m ahead, is a usual survey (east and north, metres; degrees).
_SURVEYED_M, _SURVEYED_DEG = 0.2, 0.3
_SINGLE = 0.0027  # least likelihood (three standard errors) of the other one at a single mistake
# Prior in place of NEAR where map or radar has no heights: height, roll and pitch stay as given.
_LEVEL = np.array([*NEAR[:2], 0.01, 1e-4, 1e-4, NEAR[5]])
_TURN_Z = 5  # of the state: the turn about the vertical
# Starts: the given pose, a metre to each side, and of those that are turned by so many degrees
# there or a metre aside the one of the lowest cost.
_SIDES_M = (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
_TURNED_DEG = (-1.0, 1.0)
# A pose is doubted if it is farther off than maps, drivers' habits and a careful survey together
# (metres; degrees of yaw, pitch, roll; standard errors), and refused if it is TOO_FAR times as far
# off, and _FAR_SIGMAS, as standard errors assume usual habits of drivers.
OFF_M, OFF_DEG, OFF_SIGMAS = 0.7, (0.7, 1.5, 2.5), 3.0
TOO_FAR, _FAR_SIGMAS = 2.0, 5.0
# A pose fits only if the traffic would show an error larger than this (metres; degrees of yaw,
# pitch, roll): a third of a lane's width, here or 60 m ahead, and tilts that would be refused.
_SHOWS_M, _SHOWS_DEG = 1.0, (1.0, TOO_FAR * OFF_DEG[1], TOO_FAR * OFF_DEG[2])
_LIKELY = 2.0  # standard errors by which a pose may be farther off than it is measured to be
_FARTHEST_M, _FARTHEST_DEG = 20.0, 20.0  # farther off is another place, turned farther other lanes


@dataclass(frozen=True, kw_only=True)
class FittedPose:
    """A given pose beside the one that the traffic on its lanes shows.

    Parameters
    ----------
    pose : Pose
        As given.
    prior : Prior
        Around that pose, in local coordinates.
    scene : Scene
        The lanes and the traffic.
    fit : Fit
        The likeliest of several starts, with the profile along its least-known direction.
    heights : bool
        Whether height and tilt were compared.
    """

    pose: Pose
    prior: Prior
    scene: Scene
    fit: Fit
    heights: bool

    @property
    def centre(self) -> State:
        """The given pose in local coordinates."""
        return self.prior.mean

    @cached_property
    def seen(self) -> Measurement:
        """The pose by the traffic, in local coordinates."""
        return _measured(self.fit, self.prior)


def fit_pose(excerpt: Excerpt, lanes: LaneMap) -> FittedPose | None:
    """Fit the usual pose of an excerpt to the lanes; None where no fit converges around it.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    """
    pose = excerpt.usual
    near = lanes.around(pose, excerpt.reach_m)
    if near is None:
        return None
    moving, track = excerpt.as_usual
    heights = near.points[:, 2][np.isfinite(near.points[:, 2])]
    measured = len(heights) > 0 and bool(np.isfinite(moving.points).all())
    if not measured:
        road_m = float(np.median(heights)) + MEAN_REFLECTION_M if len(heights) else np.nan
        points = (pose.to_map(moving.points, road_m=road_m) - pose.position) @ pose.R_map_sensor
        near = replace(near, points=near.points * [1.0, 1.0, np.nan])
        moving = replace(moving, points=points)
    scene = Scene(lanes=near, samples=thin(moving, track))
    centre = State(
        position=pose.position - [*near.origin, 0.0], R_map_sensor=pose.R_map_sensor,
        reflection=MEAN_REFLECTION_M,
    )  # fmt: skip
    prior = prior_at(centre)
    information = prior.information.copy()
    information[POSE_PART, POSE_PART] = np.diag((NEAR if measured else _LEVEL) ** -2.0)
    prior = Prior(mean=centre, information=information)
    fit = along_valley(scene, _likeliest(scene, prior), prior, MODEL)
    if not fit.converged or fit.fitness < _LEAST_FITNESS:
        return None
    return FittedPose(pose=pose, prior=prior, scene=scene, fit=fit, heights=measured)


def _likeliest(scene: Scene, prior: Prior) -> Fit:
    """Return the likeliest fit of several starts, as many stop beside the right place."""
    steps = np.zeros((len(_SIDES_M) * (1 + len(_TURNED_DEG)), SIZE))
    steps[:, PLANE] = [(*to, turn) for turn in np.radians((0.0, *_TURNED_DEG)) for to in _SIDES_M]
    starts = [prior.mean.moved(step) for step in steps]
    level, turned = starts[: len(_SIDES_M)], starts[len(_SIDES_M) :]
    few = few_samples(scene)
    likeliest = min(turned, key=lambda start: cost_at(few, start, scale_m=LOOK_SCALE_M))
    return solve_likeliest(scene, [*level, likeliest], prior, schedule=WINDOW_SCHEDULE)


def mistakes_apart(seen: Measurement, centre: State) -> list[tuple[Measurement, float]]:
    """Return a measured pose if only the place of the given one is wrong, and if only its yaw is.

    Each has the likelihood that the other one, surveyed by itself, is as far off as is measured.

    Parameters
    ----------
    seen : Measurement
        The pose by the traffic, in local coordinates.
    centre : State
        The given pose.
    """
    away, spread = _away(seen, centre), seen.covariance
    found = []
    for right, sigma in (([_TURN_Z], np.radians(_SURVEYED_DEG)), (PLACE, _SURVEYED_M)):
        own = spread[np.ix_(right, right)] + sigma**2 * np.eye(len(right))
        gain = spread[:, right] @ np.linalg.inv(own)
        step = away.copy()
        step[POSE_PART] -= gain @ away[right]
        there = centre.moved(step)
        one = replace(
            seen, position=there.position, covariance=spread - gain @ spread[right],
            quaternion=Rotation.from_matrix(there.R_map_sensor).as_quat(),
        )  # fmt: skip
        square = float(away[right] @ np.linalg.solve(own, away[right]))
        found.append((one, float(scipy.stats.chi2.sf(square, len(right)))))
    return found


def single_mistakes(seen: Measurement, centre: State) -> list[Measurement]:
    """Return a measured pose as one mistake, of place or yaw, the likelier first.

    As both at once, as it was measured, only if no single one explains it.

    Parameters
    ----------
    seen : Measurement
        The pose by the traffic, in local coordinates.
    centre : State
        The given pose.
    """
    found = sorted(mistakes_apart(seen, centre), key=lambda each: -each[1])
    return [one for one, chance in found if chance > _SINGLE] or [seen]


def _measured(fit: Fit, prior: Prior) -> Measurement:
    """Return the pose by the data alone in directions that they fix better than the prior does.

    In other directions, as along a street, the prior held the fit, and the data's pose would be
    an extrapolation. A pose is surveyed without the map, so that the error of the map's place
    counts, as in a localization.
    """
    seen = data_alone(fit, prior)
    unit = np.diag(prior.information[POSE_PART, POSE_PART]) ** -0.5
    away = _away(seen, prior.mean)
    values, vectors = np.linalg.eigh(seen.covariance / np.outer(unit, unit))
    known = vectors[:, values < 1.0]
    away[POSE_PART] = unit * (known @ (known.T @ (away[POSE_PART] / unit)))
    there = prior.mean.moved(away)
    quaternion = Rotation.from_matrix(there.R_map_sensor).as_quat()
    covariance = seen.covariance.copy()
    covariance[PLACE, PLACE] += MAP_SIGMA_M**2
    return replace(seen, position=there.position, quaternion=quaternion, covariance=covariance)


def _away(seen: Measurement, centre: State) -> Floats:
    """Return the step of a state from a centre to a measured pose."""
    turn = Rotation.from_quat(seen.quaternion).as_matrix()
    return replace(centre, position=seen.position, R_map_sensor=turn).difference(centre)


@dataclass(frozen=True, kw_only=True)
class Off:
    """How far a pose is off, and what to set.

    Parameters
    ----------
    amount, sigma : float
        How far it is off and one standard error, metres or degrees.
    least : float
        Largest error of a pose that is not doubted.
    text, right : Text
        How the sensor would have to be moved, with the error, and the right value, for a message.
    """

    amount: float
    sigma: float
    least: float
    text: Text
    right: Text

    @property
    def far(self) -> bool:
        """Whether it is off for sure."""
        return self.amount > max(self.least, OFF_SIGMAS * self.sigma)

    @property
    def too_far(self) -> bool:
        """Whether the pose is refused."""
        return self.far and self.amount > max(TOO_FAR * self.least, _FAR_SIGMAS * self.sigma)


def offs_of(pose: Pose, seen: Measurement, centre: State) -> list[Off]:
    """Return how far a pose is off in place, yaw, pitch and roll.

    Parameters
    ----------
    pose : Pose
        As given.
    seen : Measurement
        The pose by the traffic, in local coordinates.
    centre : State
        The given pose in these.
    """
    off_m, sigma_m = _aside(seen, centre)
    east, north = (seen.position - centre.position)[:2].tolist()
    text = Text(
        "{:.2f} \u00b1 {:.2f} m away: {:.2f} m to the {} and {:.2f} m to the {}",
        off_m, sigma_m, abs(east), side(east, 0.0), abs(north), side(0.0, north),
    )  # fmt: skip
    right = Text("easting {:.2f}, northing {:.2f}", pose.easting + east, pose.northing + north)
    offs = [Off(amount=off_m, sigma=sigma_m, least=OFF_M, text=text, right=right)]
    for k, (turn, sigma) in enumerate(turns_of(pose, seen)):
        text = _turned(ANGLES[k], turn, sigma)
        angle = within_half_turn(getattr(pose, ANGLES[k]) + turn)
        right = Text("{} {:.2f} deg", ANGLES[k], angle)
        offs.append(Off(amount=abs(turn), sigma=sigma, least=OFF_DEG[k], text=text, right=right))
    return offs


def _turned(name: str, turn: float, sigma: float) -> Text:
    """Return how the sensor would have to be turned, as somebody sees it who stands there."""
    amount = abs(turn), sigma
    if name == "pitch":
        way = Text("down") if turn > 0.0 else Text("up")
        return Text("tilted {:.2f} \u00b1 {:.2f} deg {}", *amount, way)
    if name == "roll":
        return Text("rolled {:.2f} \u00b1 {:.2f} deg {}, seen from behind", *amount, sense(-turn))
    return Text("turned {:.2f} \u00b1 {:.2f} deg {}, seen from above", *amount, sense(turn))


def discrepancy(fitted: FittedPose) -> list[Off]:
    """Return by what a given pose is off, by the likeliest mistake; nothing where it is right.

    Parameters
    ----------
    fitted : FittedPose
        Of the sensor.
    """
    mistakes = single_mistakes(fitted.seen, fitted.centre)
    ways = (offs_of(fitted.pose, each, fitted.centre) for each in mistakes)
    far = ([each for each in offs if each.far] for offs in ways)
    return next(filter(None, far), [])


def hidden(pose: Pose, seen: Measurement, centre: State) -> list[Text]:
    """Return what of a pose may be off so far that it should show, and does not.

    Parameters
    ----------
    pose, seen, centre
        As for :func:`offs_of`.
    """
    of_place, of_yaw = (each for each, _ in mistakes_apart(seen, centre))
    off_m, sigma_m = _aside(of_place, centre)
    values, axes = np.linalg.eigh(of_place.covariance[:2, :2])
    widest = OFF_SIGMAS * float(np.sqrt(values[-1])), axes[:, -1]
    likely = off_m + _LIKELY * sigma_m, (of_place.position - centre.position)[:2]
    most_m, axis = max(widest, likely, key=lambda each: each[0])
    found = []
    if most_m > _SHOWS_M:
        sides = side(*axis), side(*-axis)
        found.append(Text("{:.1f} m to the {} or {}", min(most_m, _FARTHEST_M), *sides))
    turns = turns_of(pose, of_yaw)
    for name, (turn, sigma), least in zip(ANGLES, turns, _SHOWS_DEG, strict=True):
        most_deg = max(OFF_SIGMAS * sigma, abs(turn) + _LIKELY * sigma)
        if most_deg > least:
            found.append(Text("{:.1f} deg of {}", min(most_deg, _FARTHEST_DEG), name))
    return found


def _aside(seen: Measurement, centre: State) -> tuple[float, float]:
    """Return the distance in the plane of a measured pose from a place, and its error, metres.

    Distance over error is that of the covariance in the plane (Mahalanobis).
    """
    gap, spread = (seen.position - centre.position)[:2], seen.covariance[:2, :2]
    off_m = float(np.hypot(*gap))
    return off_m, off_m / max(float(np.sqrt(gap @ np.linalg.solve(spread, gap))), 1e-9)


def turns_of(pose: Pose, seen: Measurement) -> list[tuple[float, float]]:
    """Return the turns from a pose to a measured one, of yaw, pitch and roll, with errors, degrees.

    Parameters
    ----------
    pose : Pose
        As given.
    seen : Measurement
        The pose by the traffic.
    """
    angles = Rotation.from_quat(seen.quaternion).as_euler("ZYX", degrees=True)
    spread = covariance_of_angles(seen.quaternion, seen.covariance)
    sigmas = np.degrees(np.sqrt(np.diag(spread)[5:2:-1]))
    turns = [within_half_turn(a - getattr(pose, n)) for a, n in zip(angles, ANGLES, strict=True)]
    return list(zip(turns, sigmas.tolist(), strict=True))


def fits_if(excerpt: Excerpt, lanes: LaneMap, mistake: Mistake) -> bool:
    """Return whether the traffic fits pose and map once a mistake is corrected.

    A pose that a search found is only a place from which one is to be found: there the traffic must
    fit some pose.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    mistake : Mistake
        The mistake.
    """
    if mistake.signless:
        return True  # which sign each range rate had is not known
    fitted = fit_pose(mistake.corrected(excerpt), lanes)
    return fitted is not None and (mistake.searched or not discrepancy(fitted))

"""Fit a pose that is nearly right to the lanes, and measure what one mistake of it would be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from gis_radar.base import Floats
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.rivals import REFLECTION_M, LaneMap
from gis_radar.calibration.monitoring.kalman_filter import Measurement
from gis_radar.calibration.monitoring.windows import NEAR, WINDOW, data_alone
from gis_radar.calibration.registration.certainty import MAP_SIGMA_M, PLACE, PLANE, along_valley
from gis_radar.calibration.registration.hypotheses import LOOK_SCALE_M, few_samples, prior_at
from gis_radar.calibration.registration.lanes import Scene
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.solver import Fit, Prior, cost_at, solve_likeliest
from gis_radar.calibration.registration.state import POSE, SIZE, State
from gis_radar.calibration.registration.traces import thin
from gis_radar.poses import Pose

LEAST_FITNESS = 0.75  # least share of the samples that lie on lanes at a pose that is fitted
# Place and heading are surveyed each by itself, and one mistake is of one of them: 1 sigma of the
# other, as 0.3 m, here or 60 m ahead, is a usual survey (east and north, metres; degrees).
SURVEYED_M, SURVEYED_DEG = 0.2, 0.3
SINGLE = 0.0027  # least likelihood (three standard errors) of the other one at a single mistake
# Prior in place of NEAR where map or radar has no heights: height, roll and pitch stay as given.
LEVEL = np.array([*NEAR[:2], 0.01, 1e-4, 1e-4, NEAR[5]])
TURN_Z = 5  # of the state: the turn about the vertical
# Starts: the given pose, a metre to each side, and of those that are turned by so many degrees
# there or a metre aside the one of the lowest cost.
SIDES_M = (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
TURNED_DEG = (-1.0, 1.0)


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
    near = lanes.around(pose, lanes.reach_m(excerpt))
    if near is None:
        return None
    moving, track = excerpt.as_usual
    heights = near.points[:, 2][np.isfinite(near.points[:, 2])]
    measured = len(heights) > 0 and bool(np.isfinite(moving.points).all())
    if not measured:
        road_m = float(np.median(heights)) + REFLECTION_M if len(heights) else np.nan
        points = (pose.to_map(moving.points, road_m=road_m) - pose.position) @ pose.R_map_sensor
        near = replace(near, points=near.points * [1.0, 1.0, np.nan])
        moving = replace(moving, points=points)
    scene = Scene(lanes=near, samples=thin(moving, track))
    centre = State(
        position=pose.position - [*near.origin, 0.0], R_map_sensor=pose.R_map_sensor,
        reflection=REFLECTION_M,
    )  # fmt: skip
    prior = prior_at(centre)
    information = prior.information.copy()
    information[POSE, POSE] = np.diag((NEAR if measured else LEVEL) ** -2.0)
    prior = Prior(mean=centre, information=information)
    fit = along_valley(scene, _likeliest(scene, prior), prior, MODEL)
    if not fit.converged or fit.fitness < LEAST_FITNESS:
        return None
    return FittedPose(pose=pose, prior=prior, scene=scene, fit=fit, heights=measured)


def _likeliest(scene: Scene, prior: Prior) -> Fit:
    """Return the likeliest fit of several starts, as many stop beside the right place."""
    steps = np.zeros((len(SIDES_M) * (1 + len(TURNED_DEG)), SIZE))
    steps[:, PLANE] = [(*to, turn) for turn in np.radians((0.0, *TURNED_DEG)) for to in SIDES_M]
    starts = [prior.mean.moved(step) for step in steps]
    level, turned = starts[: len(SIDES_M)], starts[len(SIDES_M) :]
    few = few_samples(scene)
    likeliest = min(turned, key=lambda start: cost_at(few, start, scale_m=LOOK_SCALE_M))
    return solve_likeliest(scene, [*level, likeliest], prior, schedule=WINDOW)


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
    for right, sigma in (([TURN_Z], np.radians(SURVEYED_DEG)), (PLACE, SURVEYED_M)):
        own = spread[np.ix_(right, right)] + sigma**2 * np.eye(len(right))
        gain = spread[:, right] @ np.linalg.inv(own)
        step = away.copy()
        step[POSE] -= gain @ away[right]
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
    return [one for one, chance in found if chance > SINGLE] or [seen]


def _measured(fit: Fit, prior: Prior) -> Measurement:
    """Return the pose by the data alone in directions that they fix better than the prior does.

    In other directions, as along a street, the prior held the fit, and the data's pose would be
    an extrapolation. A pose is surveyed without the map, so that the error of the map's place
    counts, as in a localization.
    """
    seen = data_alone(fit, prior)
    unit = np.diag(prior.information[POSE, POSE]) ** -0.5
    away = _away(seen, prior.mean)
    values, vectors = np.linalg.eigh(seen.covariance / np.outer(unit, unit))
    known = vectors[:, values < 1.0]
    away[POSE] = unit * (known @ (known.T @ (away[POSE] / unit)))
    there = prior.mean.moved(away)
    quaternion = Rotation.from_matrix(there.R_map_sensor).as_quat()
    covariance = seen.covariance.copy()
    covariance[PLACE, PLACE] += MAP_SIGMA_M**2
    return replace(seen, position=there.position, quaternion=quaternion, covariance=covariance)


def _away(seen: Measurement, centre: State) -> Floats:
    """Return the step of a state from a centre to a measured pose."""
    turn = Rotation.from_quat(seen.quaternion).as_matrix()
    return replace(centre, position=seen.position, R_map_sensor=turn).difference(centre)

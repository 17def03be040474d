"""Adjust the poses of several sensors together by their correspondences, by least squares."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gis_radar.base import Floats, Integers, NoAnswerError, Text
from gis_radar.calibration.registration.certainty import PLANE, cluster_robust, is_fixed, stated
from gis_radar.calibration.registration.solver import at_most
from gis_radar.calibration.several.correspondences import (
    FACES,
    PLANAR,
    SHARE,
    Names,
    Rows,
    effects,
    mean_gaps,
    stretches,
)
from gis_radar.poses import COMPONENTS, Pose

_HALF_LENGTH_SIGMA_M = 0.25  # 1 sigma of the mean half length of vehicles
_HALF_WIDTH_SIGMA_M = 0.1  # 1 sigma of their mean half width
_SIDE_SIGMA = math.log(1.5)  # 1 sigma of the logarithm of the side strength
# 1 sigma, along and across, of the gap between two radars that all vehicles on a stretch of a lane
# share: 0.2 to 0.3 and 0.1 m at the true poses of two simulators.
STRETCH_SIGMA_M = (0.3, 0.1)
CLOCK_SIGMA_S = 0.02  # 1 sigma of a clock's offset: NTP on a local network
# The same of clocks that are not synchronised; with larger offsets, vehicles are not paired.
FREE_CLOCK_S = 1.0
# Degrees of freedom of Student's t for a pair's gap: about one pair of ten is wrong.
_FREEDOM_T = 4.0

_ITERATIONS = 8  # of weights and poses in turn; they converge in three or four
_POSES = 2 * PLANAR  # unknowns: the poses of both sensors
_UNKNOWNS = _POSES + FACES + 2  # with face constants and both clocks: 11
Edge = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Normal equations of the pairs of two sensors, with vehicles' random effects eliminated.

    Parameters
    ----------
    information : (pairs, 13, 13) array
        Information about 13 unknowns: the poses of both (6), the face constants (3), both clocks
        (2), and the gap that vehicles on a stretch of road share (2).
    gradient : (pairs, 13) array
        Gradient of the cost by these unknowns, at the current poses.
    gap, slope, covariance : (pairs, 2), (pairs, 2, 13), (pairs, 2, 2) arrays
        Mean gap of each pair in metres, its Jacobian, and its covariance among vehicles.
    stretch : (pairs,) array
        Number of the stretch of road.
    """

    information: Floats
    gradient: Floats
    gap: Floats
    slope: Floats
    covariance: Floats
    stretch: Integers

    def chi2(self, step: Floats) -> Floats:
        """Return the chi-square of each pair's mean gap after a step of the first 11 unknowns."""
        gap = self.gap + self.slope[:, :, :_UNKNOWNS] @ step
        return np.asarray(np.einsum("pi,pij,pj->p", gap, np.linalg.inv(self.covariance), gap))

    def normal_equations(self, weight: Floats, step: Floats) -> tuple[Floats, Floats]:
        """Return the information about the first 11 unknowns, and each pair's gradient by them.

        The gap that vehicles on a stretch share is eliminated.

        Parameters
        ----------
        weight : (pairs,) array
            Weight of each pair.
        step : (11,) array
            Step from the current poses at which the gradient is evaluated.
        """
        information = weight[:, None, None] * self.information
        gradient = weight[:, None] * self.gradient + information[:, :, :_UNKNOWNS] @ step
        reduced, gradients = np.zeros((_UNKNOWNS, _UNKNOWNS)), gradient[:, :_UNKNOWNS].copy()
        prior = np.diag(np.square(STRETCH_SIGMA_M) ** -1.0)
        for number in np.unique(self.stretch):
            rows = self.stretch == number
            here = information[rows].sum(axis=0)
            gain = here[:_UNKNOWNS, _UNKNOWNS:] @ np.linalg.inv(
                here[_UNKNOWNS:, _UNKNOWNS:] + prior
            )
            reduced += here[:_UNKNOWNS, :_UNKNOWNS] - gain @ here[_UNKNOWNS:, :_UNKNOWNS]
            gradients[rows] -= gradient[rows, _UNKNOWNS:] @ gain.T
        return reduced, gradients


def sum_correspondences(rows: Rows) -> Correspondences:
    """Return the normal equations of each pair, with its vehicle's random effects eliminated."""
    stretch_slope = np.broadcast_to(np.eye(2), (len(rows.gap), 2, 2))
    slope = np.concatenate([rows.poses, rows.constants, rows.clocks, stretch_slope], axis=2)
    by_effect, variances = effects(rows)
    weight = SHARE / rows.variance

    def by_pair(a: Floats, b: Floats) -> Floats:
        each = np.einsum("rik,ri,ril->rkl", a, weight, b)
        return np.asarray(np.add.reduceat(each, rows.first, axis=0))

    gap = rows.gap[:, :, None]
    effect_covariance = np.linalg.inv(np.diag(1.0 / variances) + by_pair(by_effect, by_effect))
    coupling = by_pair(slope, by_effect)
    gain = coupling @ effect_covariance
    mean, covariance = mean_gaps(rows, np.zeros((_POSES, _POSES)))
    return Correspondences(
        information=by_pair(slope, slope) - gain @ np.swapaxes(coupling, 1, 2),
        gradient=(by_pair(slope, gap) - gain @ by_pair(by_effect, gap))[:, :, 0],
        gap=mean,
        slope=rows.means(slope),
        covariance=covariance,
        stretch=stretches(rows),
    )


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Result of an adjustment of poses.

    Parameters
    ----------
    step : (n, 3) array
        Adjusted poses less those before: easting, northing (m), yaw (radians).
    covariance : (3 n, 3 n) array
        Covariance of the adjusted poses.
    clocks_s : (n,) array
        Offset of each clock, positive when ahead, seconds.
    clock_covariance : (n, n) array
        Covariance of the offsets, s^2.
    misfit : dict
        By pair of sensors, the chi-square (three degrees of freedom) of the difference between
        the poses from single localization and those from correspondences.
    """

    step: Floats
    covariance: Floats
    clocks_s: Floats
    clock_covariance: Floats
    misfit: Mapping[Edge, float]

    @property
    def clock_gap(self) -> tuple[float, float]:
        """Offset of the second clock less that of the first, and 1 sigma, both in seconds."""
        gap = np.array([-1.0, 1.0])
        variance = gap @ self.clock_covariance[:2, :2] @ gap
        return float(gap @ self.clocks_s[:2]), float(np.sqrt(variance))


def adjust(
    correspondences: Mapping[Edge, Correspondences],
    away: Floats,
    covariances: Sequence[Floats],
    *,
    clocks_s: Sequence[float] | None = None,
    comparison_only: Collection[Edge] = (),
) -> Adjusted:
    """Adjust the poses of sensors, and their clocks, by correspondences and single localizations.

    Traffic in both directions separates an error of a clock from one of a place; where all traffic
    goes one way, the sigma of a clock becomes large. Pairs have Student's t weights. The covariance
    is cluster-robust with the vehicles as clusters, never below the model's and never above that of
    the single localizations.

    Parameters
    ----------
    correspondences : mapping
        By pair of sensors.
    away : (n, 3) array
        The current poses less those of single localization.
    covariances : sequence of (3, 3) arrays
        Covariance of each pose by single localization.
    clocks_s : sequence of float, optional
        Standard deviations of the clocks; by default `CLOCK_SIGMA_S` each.
    comparison_only : collection of (int, int)
        Pairs of sensors whose `misfit` is computed, but whose correspondences are not used.
    """
    n = len(covariances)
    clock_sigmas = [CLOCK_SIGMA_S] * n if clocks_s is None else list(clocks_s)
    prior = np.zeros((PLANAR * n + FACES + n, PLANAR * n + FACES + n))
    single = shared_covariance(covariances)
    prior[: PLANAR * n, : PLANAR * n] = np.linalg.inv(single)
    nuisance = _nuisance_information(clock_sigmas)
    prior[PLANAR * n :, PLANAR * n :] = np.diag(nuisance)
    start = np.concatenate([away.ravel(), np.zeros(FACES + n)])
    step = np.zeros(len(prior))
    for _ in range(_ITERATIONS):
        weights = {edge: _weights(matched, step[_unknowns_of(edge, n)])
                   for edge, matched in correspondences.items()}  # fmt: skip
        information, scores = prior.copy(), []
        for edge, matched in correspondences.items():
            if edge in comparison_only:
                continue
            index, weight = _unknowns_of(edge, n), weights[edge]
            edge_information, gradients = matched.normal_equations(weight, step[index])
            information[np.ix_(index, index)] += edge_information
            padded = np.zeros((len(weight), len(prior)))
            padded[:, index] = gradients
            scores.append(padded)
        clusters = np.vstack([np.zeros((0, len(prior))), *scores])
        step = step - np.linalg.solve(information, clusters.sum(axis=0) + prior @ (start + step))
    inverse = np.asarray(np.linalg.inv(information))
    if len(clusters):
        inverse = cluster_robust(inverse, clusters, prior, unknowns=PLANAR)
    covariance = inverse[: PLANAR * n, : PLANAR * n]
    misfit = {
        edge: _contradiction(matched, weights[edge], away[list(edge)],
                             [covariances[i] for i in edge],
                             _nuisance_information([clock_sigmas[i] for i in edge]))
        for edge, matched in correspondences.items()
    }  # fmt: skip
    return Adjusted(
        step=step[: PLANAR * n].reshape(n, PLANAR),
        covariance=at_most(covariance, single),
        clocks_s=step[PLANAR * n + FACES :],
        clock_covariance=inverse[PLANAR * n + FACES :, PLANAR * n + FACES :],
        misfit=misfit,
    )


def shared_covariance(covariances: Sequence[Floats]) -> Floats:
    """Return the joint covariance of single localizations, which share errors of map and model.

    The covariance between two poses is not known; it is set to the parallel sum of their own ones
    in the plane: half of each where they are equal, that of the better one where the other is far
    worse, so that a sensor placed by another has no smaller sigma than that one.
    """
    n = len(covariances)
    plane_information = [np.linalg.inv(own)[:2, :2] for own in covariances]
    common = np.linalg.inv(np.sum(plane_information, axis=0)) if n > 1 else np.zeros((2, 2))
    joint = np.zeros((n, PLANAR, n, PLANAR))
    joint[:, :2, :, :2] = common[None, :, None, :]
    for i, own in enumerate(covariances):
        joint[i, :, i] = own
    return joint.reshape(n * PLANAR, n * PLANAR)


def _nuisance_information(clocks_s: Sequence[float]) -> Floats:
    """Return the inverse variances of the face constants and of the clocks."""
    faces = [_HALF_LENGTH_SIGMA_M, _HALF_WIDTH_SIGMA_M, _SIDE_SIGMA]
    return np.array([*faces, *clocks_s]) ** -2.0


def _unknowns_of(edge: Edge, n: int) -> list[int]:
    """Return the indices of the 11 unknowns of a pair among those of all sensors."""
    one, other = (list(range(PLANAR * i, PLANAR * i + PLANAR)) for i in edge)
    after = PLANAR * n + FACES
    return [*one, *other, *range(PLANAR * n, after), after + edge[0], after + edge[1]]


def _weights(matched: Correspondences, step: Floats) -> Floats:
    """Return the Student's t weight of each pair by its chi-square."""
    return np.asarray((_FREEDOM_T + 2.0) / (_FREEDOM_T + matched.chi2(step)))


def _contradiction(
    matched: Correspondences,
    weight: Floats,
    away: Floats,
    covariances: Sequence[Floats],
    nuisance: Floats,
) -> float:
    """Return the chi-square of the poses of a pair by correspondences less by localization."""
    information, gradients = matched.normal_equations(weight, np.zeros(_UNKNOWNS))
    gradient = gradients.sum(axis=0) - information[:, :_POSES] @ away.ravel()
    inner = np.linalg.inv(information[_POSES:, _POSES:] + np.diag(nuisance))
    gain = information[:_POSES, _POSES:] @ inner
    reduced_gradient = gradient[:_POSES] - gain @ gradient[_POSES:]
    known = information[:_POSES, :_POSES] - gain @ information[_POSES:, :_POSES]
    covariance = np.zeros((_POSES, _POSES))
    covariance[:PLANAR, :PLANAR], covariance[PLANAR:, PLANAR:] = covariances
    scatter = known + known @ covariance @ known
    scale = np.sqrt(np.maximum(np.diag(scatter), 1e-12))
    unit = np.linalg.pinv(scatter / np.outer(scale, scale), rcond=1e-6, hermitian=True)
    return float((reduced_gradient / scale) @ unit @ (reduced_gradient / scale))


def planar_covariance(pose: Pose) -> Floats:
    """Return the covariance of easting, northing (m) and yaw (radians), (3, 3)."""
    return stated_covariance(pose)[np.ix_(PLANE, PLANE)]


def stated_covariance(pose: Pose) -> Floats:
    """Return the (6, 6) covariance that a pose states.

    Raises
    ------
    NoAnswerError
        If it states none.
    """
    covariance = pose.parsed_evidence().covariance
    if covariance is None:
        raise NoAnswerError(
            "{}: its pose states no covariance",
            pose.sensor,
            hint=Text("localize it with {} lane", "--method"),
        )
    return covariance


def moved(pose: Pose, step: Floats) -> Pose:
    """Move a pose by easting, northing (m), yaw (rad), the other components by its covariance."""
    covariance = stated_covariance(pose)
    plane_covariance = covariance[np.ix_(PLANE, PLANE)]
    full_step = covariance[:, PLANE] @ np.linalg.solve(plane_covariance, step)
    full_step[PLANE] = step
    east, north, up, roll, pitch, yaw = (float(v) for v in full_step)
    turned = pose.yaw + math.degrees(yaw)
    return replace(
        pose,
        easting=pose.easting + east,
        northing=pose.northing + north,
        height=pose.height + up,
        roll=pose.roll + math.degrees(roll),
        pitch=pose.pitch + math.degrees(pitch),
        yaw=(turned + 180.0) % 360.0 - 180.0,
    )


def with_gain(pose: Pose, plane: Floats, name: str, pairs: Mapping[Names, int]) -> Pose:
    """Return a pose with a new covariance in the plane, and with sigma before and after."""
    before = stated_covariance(pose)
    plane_before = before[np.ix_(PLANE, PLANE)]
    regression = before[:, PLANE] @ np.linalg.inv(plane_before)
    after = before + regression @ (plane - plane_before) @ regression.T
    after = (after + after.T) / 2.0
    old, new = (stated(each) for each in (before, after))
    others = sorted({each for pair in pairs for each in pair} - {name})
    gained = {
        COMPONENTS[i]: {
            when: each["sigma"][COMPONENTS[i]] for when, each in (("before", old), ("after", new))
        }
        for i in PLANE
    }
    evidence = {
        **pose.evidence,
        **new,
        "observable": is_fixed(after),
        "together": {"sensors": others, "pairs": sum(pairs.values()), "gained": gained},
    }
    return replace(pose, evidence=evidence)

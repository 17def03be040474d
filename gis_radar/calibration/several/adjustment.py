"""Poses of several sensors adjusted together by their correspondences, by least squares."""

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

HALF_LENGTH_SIGMA_M = 0.25  # 1 sigma of the mean half length of vehicles
HALF_WIDTH_SIGMA_M = 0.1  # 1 sigma of their mean half width
SIDE_SIGMA = math.log(1.5)  # 1 sigma of the logarithm of the side strength
# 1 sigma, along and across, of the gap that all vehicles on a stretch of a lane have in common
# between two radars: 0.2 to 0.3 and 0.1 m at the true poses of two simulators.
STRETCH_SIGMA_M = (0.3, 0.1)
CLOCK_S = 0.02  # offset of a sensor's clock, one standard deviation: NTP on a local network
# The same for unsynchronised clocks: at a larger offset no vehicle finds its pair.
FREE_CLOCK_S = 1.0
# Degrees of freedom of Student's t for a pair's misfit: every tenth pair or so is wrong.
FREEDOM_T = 4.0

STEPS = 8  # of weights and poses in turn; they settle after three or four
OWN = 2 * PLANAR  # unknowns of a pair's poses
SHARED = OWN + FACES + 2  # these with the constants of the faces and both clocks: eleven
Edge = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Evidence of the pairs of two sensors, each vehicle's own effects eliminated.

    Parameters
    ----------
    information : (pairs, 13, 13) array
        About 13 unknowns: the poses of both (6), the constants of the faces (3), both clocks (2),
        and the gap common to a stretch of road (2).
    gradient : (pairs, 13) array
        Of the cost by these unknowns, at the present poses.
    gap, slope, covariance : (pairs, 2), (pairs, 2, 13), (pairs, 2, 2) arrays
        The mean gap in metres, its derivative, and its covariance among vehicles.
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
        """Return the misfit (chi-square) of each pair after a step of the first 11 unknowns."""
        gap = self.gap + self.slope[:, :, :SHARED] @ step
        return np.asarray(np.einsum("pi,pij,pj->p", gap, np.linalg.inv(self.covariance), gap))

    def summed(self, weight: Floats, step: Floats) -> tuple[Floats, Floats]:
        """Return the information about the first 11 unknowns, and each pair's part of the gradient.

        The gap common to a stretch is eliminated.

        Parameters
        ----------
        weight : (pairs,) array
            Weight of each pair.
        step : (11,) array
            Step from the present poses at which the gradient is taken.
        """
        known = weight[:, None, None] * self.information
        gradient = weight[:, None] * self.gradient + known[:, :, :SHARED] @ step
        total, parts = np.zeros((SHARED, SHARED)), gradient[:, :SHARED].copy()
        alike = np.diag(np.square(STRETCH_SIGMA_M) ** -1.0)
        for number in np.unique(self.stretch):
            on = self.stretch == number
            here = known[on].sum(axis=0)
            gain = here[:SHARED, SHARED:] @ np.linalg.inv(here[SHARED:, SHARED:] + alike)
            total += here[:SHARED, :SHARED] - gain @ here[SHARED:, :SHARED]
            parts[on] -= gradient[on, SHARED:] @ gain.T
        return total, parts


def sum_correspondences(rows: Rows) -> Correspondences:
    """Sum up the moments of each pair, with the random effects of its vehicle eliminated."""
    alike = np.broadcast_to(np.eye(2), (len(rows.gap), 2, 2))
    slope = np.concatenate([rows.poses, rows.constants, rows.clocks, alike], axis=2)
    by_effect, variances = effects(rows)
    weight = SHARE / rows.variance

    def total(a: Floats, b: Floats) -> Floats:
        each = np.einsum("rik,ri,ril->rkl", a, weight, b)
        return np.asarray(np.add.reduceat(each, rows.first, axis=0))

    gap = rows.gap[:, :, None]
    inner = np.linalg.inv(np.diag(1.0 / variances) + total(by_effect, by_effect))
    coupled = total(slope, by_effect)
    gain = coupled @ inner
    mean, covariance = mean_gaps(rows, np.zeros((OWN, OWN)))
    return Correspondences(
        information=total(slope, slope) - gain @ np.swapaxes(coupled, 1, 2),
        gradient=(total(slope, gap) - gain @ total(by_effect, gap))[:, :, 0],
        gap=mean,
        slope=rows.means(slope),
        covariance=covariance,
        stretch=stretches(rows),
    )


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Poses adjusted together.

    Parameters
    ----------
    step : (n, 3) array
        From the poses before to the adjusted ones: easting, northing (m), yaw (radians).
    covariance : (3 n, 3 n) array
        Of the adjusted poses.
    clocks_s : (n,) array
        How far each clock is ahead.
    clock_covariance : (n, n) array
        Of the clocks, s^2.
    misfit : dict
        By pair of sensors, the chi-square (three degrees of freedom) of the difference between
        the single answers and the correspondences.
    """

    step: Floats
    covariance: Floats
    clocks_s: Floats
    clock_covariance: Floats
    misfit: Mapping[Edge, float]

    @property
    def clock_gap(self) -> tuple[float, float]:
        """By how much the second clock is ahead of the first, and 1 sigma, both in seconds."""
        gap = np.array([-1.0, 1.0])
        variance = gap @ self.clock_covariance[:2, :2] @ gap
        return float(gap @ self.clocks_s[:2]), float(np.sqrt(variance))


def adjust(
    correspondences: Mapping[Edge, Correspondences],
    away: Floats,
    covariances: Sequence[Floats],
    *,
    clocks_s: Sequence[float] | None = None,
    held: Collection[Edge] = (),
) -> Adjusted:
    """Adjust the poses of sensors, and their clocks, by correspondences and single answers.

    Traffic in opposite directions separates an error of a clock from one of a place; where all
    traffic goes one way, the sigma of a clock becomes large. Pairs have Student's t weights. The
    covariance is cluster-robust with the vehicles as clusters, never below the model's and never
    above that of the single answers.

    Parameters
    ----------
    correspondences : mapping
        By pair of sensors.
    away : (n, 3) array
        The present poses less the single answers.
    covariances : sequence of (3, 3) arrays
        Of the single answers.
    clocks_s : sequence of float, optional
        Standard deviations of the clocks; by default `CLOCK_S` each.
    held : collection of (int, int)
        Pairs of sensors that are only compared: their correspondences move no pose.
    """
    n = len(covariances)
    clocks = [CLOCK_S] * n if clocks_s is None else list(clocks_s)
    prior = np.zeros((PLANAR * n + FACES + n, PLANAR * n + FACES + n))
    single = shared_covariance(covariances)
    prior[: PLANAR * n, : PLANAR * n] = np.linalg.inv(single)
    nuisance = _nuisance(clocks)
    prior[PLANAR * n :, PLANAR * n :] = np.diag(nuisance)
    start = np.concatenate([away.ravel(), np.zeros(FACES + n)])
    step = np.zeros(len(prior))
    for _ in range(STEPS):
        weights = {edge: _weights(matched, step[_index(edge, n)])
                   for edge, matched in correspondences.items()}  # fmt: skip
        information, scores = prior.copy(), []
        for edge, matched in correspondences.items():
            if edge in held:
                continue
            at, weight = _index(edge, n), weights[edge]
            known, parts = matched.summed(weight, step[at])
            information[np.ix_(at, at)] += known
            each = np.zeros((len(weight), len(prior)))
            each[:, at] = parts
            scores.append(each)
        clusters = np.vstack([np.zeros((0, len(prior))), *scores])
        step = step - np.linalg.solve(information, clusters.sum(axis=0) + prior @ (start + step))
    inverse = np.asarray(np.linalg.inv(information))
    if len(clusters):
        inverse = cluster_robust(inverse, clusters, prior, unknowns=PLANAR)
    covariance = inverse[: PLANAR * n, : PLANAR * n]
    misfit = {
        edge: _misfit(matched, weights[edge], away[list(edge)], [covariances[i] for i in edge],
                      _nuisance([clocks[i] for i in edge]))
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
    """Return the covariance of several single answers, which have map and model in common.

    How much they have in common is not known. The parallel sum of their covariances in the plane is
    taken: half of each where two are alike, all of the better one's where the other is far worse,
    so that a sensor placed by another is no surer than that one.
    """
    n = len(covariances)
    given = [np.linalg.inv(each)[:2, :2] for each in covariances]
    common = np.linalg.inv(np.sum(given, axis=0)) if n > 1 else np.zeros((2, 2))
    whole = np.zeros((n, PLANAR, n, PLANAR))
    whole[:, :2, :, :2] = common[None, :, None, :]
    for i, each in enumerate(covariances):
        whole[i, :, i] = each
    return whole.reshape(n * PLANAR, n * PLANAR)


def _nuisance(clocks_s: Sequence[float]) -> Floats:
    """Return the inverse variances of the constants of the faces, and of the clocks."""
    faces = [HALF_LENGTH_SIGMA_M, HALF_WIDTH_SIGMA_M, SIDE_SIGMA]
    return np.array([*faces, *clocks_s]) ** -2.0


def _index(edge: Edge, n: int) -> list[int]:
    """Return the indices of the eleven unknowns of a pair of sensors."""
    one, other = (list(range(PLANAR * i, PLANAR * i + PLANAR)) for i in edge)
    after = PLANAR * n + FACES
    return [*one, *other, *range(PLANAR * n, after), after + edge[0], after + edge[1]]


def _weights(matched: Correspondences, step: Floats) -> Floats:
    """Return the weight of each pair by its misfit."""
    return np.asarray((FREEDOM_T + 2.0) / (FREEDOM_T + matched.chi2(step)))


def _misfit(
    matched: Correspondences,
    weight: Floats,
    away: Floats,
    covariances: Sequence[Floats],
    nuisance: Floats,
) -> float:
    """Return the chi-square of the difference of correspondences and single answers of a pair."""
    information, parts = matched.summed(weight, np.zeros(SHARED))
    gradient = parts.sum(axis=0) - information[:, :OWN] @ away.ravel()
    inner = np.linalg.inv(information[OWN:, OWN:] + np.diag(nuisance))
    gain = information[:OWN, OWN:] @ inner
    reduced = gradient[:OWN] - gain @ gradient[OWN:]
    known = information[:OWN, :OWN] - gain @ information[OWN:, :OWN]
    both = np.zeros((OWN, OWN))
    both[:PLANAR, :PLANAR], both[PLANAR:, PLANAR:] = covariances
    scatter = known + known @ both @ known
    scale = np.sqrt(np.maximum(np.diag(scatter), 1e-12))
    unit = np.linalg.pinv(scatter / np.outer(scale, scale), rcond=1e-6, hermitian=True)
    return float((reduced / scale) @ unit @ (reduced / scale))


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
    """Move a pose by easting, northing (m), yaw (rad); the rest follows by its covariance."""
    covariance = stated_covariance(pose)
    known = covariance[np.ix_(PLANE, PLANE)]
    whole = covariance[:, PLANE] @ np.linalg.solve(known, step)
    whole[PLANE] = step
    east, north, up, roll, pitch, yaw = (float(v) for v in whole)
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
    """Return a pose with a new covariance in the plane, and the evidence of what it gained."""
    before = stated_covariance(pose)
    known = before[np.ix_(PLANE, PLANE)]
    share = before[:, PLANE] @ np.linalg.inv(known)
    after = before + share @ (plane - known) @ share.T
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

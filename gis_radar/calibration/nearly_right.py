"""Measure how far a pose that nearly fits is off, and whether the traffic would show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from gis_radar.base import Floats, Text
from gis_radar.calibration.certainty import (
    CLEAR_RISE,
    MAP_SIGMA_M,
    PLACE,
    PLANE,
    advantage,
    along_valley,
)
from gis_radar.calibration.excerpt import Excerpt
from gis_radar.calibration.explanations import (
    CLEAR,
    FITTING,
    FOUND_SHARE,
    ONE_PLACE,
    likeliest,
    scored,
)
from gis_radar.calibration.findings import (
    FITS,
    RECORD_MORE,
    UNKNOWN,
    UNKNOWN_CAUSE,
    Finding,
    either,
    wrong,
)
from gis_radar.calibration.hypotheses import prior_at
from gis_radar.calibration.kalman_filter import Measurement, covariance_of_angles
from gis_radar.calibration.lanes import Scene
from gis_radar.calibration.model import MODEL
from gis_radar.calibration.pace import PACE, lengthened
from gis_radar.calibration.range_scale import RangeScale
from gis_radar.calibration.rivals import (
    FARTHEST_M,
    REFLECTION_M,
    SAME_DEG,
    SAME_PLACE_M,
    LaneMap,
    Rival,
    found_poses,
    score,
    ways_to_be_wrong,
)
from gis_radar.calibration.solver import Fit, Prior, solve
from gis_radar.calibration.state import LEVER_M, POSE, SIZE, State
from gis_radar.calibration.traces import thin
from gis_radar.calibration.windows import NEAR, WINDOW, data_alone
from gis_radar.poses import Pose

# A pose is doubted if it is farther off than maps, drivers' habits and a careful survey together
# (metres; degrees of yaw, pitch, roll; standard errors), and refused if it is TOO_FAR times as far
# off, and FAR_SIGMAS, as standard errors assume usual habits of drivers.
OFF_M, OFF_DEG, OFF_SIGMAS = 0.7, (0.7, 1.5, 2.5), 3.0
TOO_FAR, FAR_SIGMAS = 2.0, 5.0
# A pose fits only if the traffic would show an error larger than this (metres; degrees of yaw,
# pitch, roll): a third of a lane's width, here or 60 m ahead, and tilts that would be refused.
SHOWS_M, SHOWS_DEG = 1.0, (1.0, TOO_FAR * OFF_DEG[1], TOO_FAR * OFF_DEG[2])
# A pose is off if the vehicles prefer the fitted one by so many standard deviations (99.4 %,
# one-sided), as the answer of a localization is preferred to every other.
PREFERRED = 2.5
RISEN = 0.5  # share of the predicted rise of the cost from which on a fit is no rival
HELD = 1e-4  # 1 sigma of the place (metres) and yaw (radians) of a pose that is held as given
# Place and heading are surveyed each by itself, and one mistake is of one of them: 1 sigma of the
# other, as 0.3 m, here or 60 m ahead, is a usual survey (east and north, metres; degrees).
SURVEYED_M, SURVEYED_DEG = 0.2, 0.3
SINGLE = 0.0027  # least likelihood (three standard errors) of the other one at a single mistake
LIKELY = 2.0  # standard errors by which a pose may be farther off than it is measured to be
# Prior in place of NEAR where map or radar has no heights: height, roll and pitch stay as given.
LEVEL = np.array([*NEAR[:2], 0.01, 1e-4, 1e-4, NEAR[5]])
FARTHEST_DEG = 20.0  # a pose turned farther would put the traffic on other lanes
TURNS = ("yaw", "pitch", "roll")
TURN_Z = 5  # of the state: the turn about the vertical
STARTS_M = (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)  # east, north
HINTED = 1.5  # standard errors from which a scale of range may explain a pose that is off
OPEN = (0.0, 1.0, -1.0, 2.0, -2.0)  # standard errors from a measured scale of range that are tried

POSE_OFF, MAY_BE_OFF = Text("its pose is off"), Text("its pose may be off")


def pose_off(excerpt: Excerpt, lanes: LaneMap, found: Finding, pace: RangeScale | None) -> Finding:
    """Return how far a pose that nearly fits is off, or whether the traffic would show that.

    Ranges may be too long instead where the pose is right with a scale of range within its error.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    found : Finding
        The finding that most vehicles drive along lanes.
    pace : RangeScale or None
        The measured scale of range.
    """
    off = _fitted_off(excerpt, lanes, found)
    if pace is None or off.cause not in {POSE_OFF, MAY_BE_OFF}:
        return off
    for scale in (pace.factor + pace.sigma * np.array(OPEN)).tolist():
        moving = replace(excerpt.moving, points=excerpt.moving.points / scale)
        scaled = replace(excerpt, moving=moving)
        if abs(scale - 1.0) > PACE and not _is_off(_fitted_off(scaled, lanes, found)):
            both = off, lengthened(replace(pace, factor=scale))
            cause, advice = either((each.cause, each.advice) for each in both)
            return replace(off, cause=cause, advice=advice)
    return off


def _is_off(found: Finding) -> bool:
    return found.verdict != UNKNOWN and bool(found.cause)


def _fitted_off(excerpt: Excerpt, lanes: LaneMap, found: Finding) -> Finding:
    pose = excerpt.usual
    near = lanes.around(pose, lanes.reach_m(excerpt))
    if near is None:
        return _unfitted(found)
    moving, track = excerpt.as_usual
    heights = near.points[:, 2][np.isfinite(near.points[:, 2])]
    if len(heights) and np.isfinite(moving.points).all():
        samples = thin(moving, track)
        return _compared(excerpt, lanes, Scene(lanes=near, samples=samples), found, NEAR)
    road_m = float(np.median(heights)) + REFLECTION_M if len(heights) else np.nan
    points = (pose.to_map(moving.points, road_m=road_m) - pose.position) @ pose.R_map_sensor
    level = replace(near, points=near.points * [1.0, 1.0, np.nan])
    samples = thin(replace(moving, points=points), track)
    found = _compared(excerpt, lanes, Scene(lanes=level, samples=samples), found, LEVEL)
    evidence = Text(
        "{}; without heights of map and radar, height and tilt are not compared", found.evidence
    )
    return replace(found, evidence=evidence)


def _compared(
    excerpt: Excerpt, lanes: LaneMap, scene: Scene, found: Finding, sigmas: Floats
) -> Finding:
    """Compare the usual pose with a fit whose prior has 1 sigma of `sigmas` around that pose."""
    pose = excerpt.usual
    centre = State(
        position=pose.position - [*scene.lanes.origin, 0.0], R_map_sensor=pose.R_map_sensor,
        reflection=REFLECTION_M,
    )  # fmt: skip
    prior = prior_at(centre)
    information = prior.information.copy()
    information[POSE, POSE] = np.diag(sigmas**-2.0)
    prior = Prior(mean=centre, information=information)
    fits = _fits(scene, prior)
    fit = along_valley(scene, min(fits, key=lambda each: each.cost), prior, MODEL)
    if not fit.converged or fit.fitness < FITTING:
        return _elsewhere(excerpt, lanes, pose, found.evidence) or _unfitted(found)
    seen = _measured(fit, prior)
    beyond = _beyond(excerpt, seen, centre, found.evidence)
    if beyond is not None and rests_at(fits, fit, centre) and not _prefers(scene, fit, prior):
        if beyond.refused:  # it is off, but whether the fitted pose is the right one is open
            return wrong(beyond.evidence, UNKNOWN_CAUSE, ONE_PLACE)
        gap = np.zeros(SIZE)
        gap[PLANE] = _away(seen, centre)[PLANE]
        both = seen.covariance + np.outer(gap, gap)[POSE, POSE] / 2.0
        seen = replace(seen, covariance=both)
        beyond = _beyond(excerpt, seen, centre, found.evidence)
    return beyond or _shown(excerpt, seen, centre, found)


def rests_at(fits: list[Fit], best: Fit, given: State) -> bool:
    """Return whether a fit that is nearly as likely as the best comes to rest at the given pose.

    It is nearer to that pose than to the best fit, and its cost is neither so high that its place
    is excluded, nor has it risen as the curvature predicts. Then two poses are rivals. Else the
    traffic shows one, and its distance in standard errors tells all: gains in likelihood near an
    optimum amount to half of that.

    Parameters
    ----------
    fits : list of Fit
        Fits from several starts.
    best : Fit
        The likeliest.
    given : State
        The given pose.
    """
    lever_m = np.array([1.0, 1.0, LEVER_M])
    for fit in fits:
        away, step = (fit.state.difference(each) for each in (given, best.state))
        nearer = np.linalg.norm(lever_m * away[PLANE]) < np.linalg.norm(lever_m * step[PLANE])
        rise = 0.5 * float(step @ best.information @ step)
        if nearer and fit.cost - best.cost < min(RISEN * rise, CLEAR_RISE):
            return True
    return False


def _prefers(scene: Scene, fit: Fit, prior: Prior) -> bool:
    """Return whether the vehicles clearly prefer a fit to the place and yaw of its prior."""
    information = prior.information.copy()
    information[PLANE, PLANE] = HELD**-2.0  # heights and tilt are fitted
    held = replace(prior, information=information)
    given = solve(scene, prior.mean, held, schedule=WINDOW)
    return advantage(fit, given, scene.samples) >= PREFERRED


def _unfitted(found: Finding) -> Finding:
    """Return the finding for a pose around which no fit converges: doubt stays, else unknown."""
    if found.cause:
        return found
    evidence = Text("{}, but no pose is fitted to them", found.evidence)
    return replace(found, verdict=UNKNOWN, evidence=evidence, advice=RECORD_MORE)


def _fits(scene: Scene, prior: Prior) -> list[Fit]:
    """Return fits from several starts, as many stop beside the right place."""
    fits = []
    for east, north in STARTS_M:
        step = np.zeros(len(prior.information))
        step[:2] = east, north
        fits.append(solve(scene, prior.mean.moved(step), prior, schedule=WINDOW))
    return fits


def _shown(excerpt: Excerpt, seen: Measurement, centre: State, found: Finding) -> Finding:
    """Return that a pose fits, or unknown where the traffic would not show an error."""
    if found.cause:
        return found
    of_place, of_yaw = (each for each, _ in _single(seen, centre))
    off_m, sigma_m = _aside(of_place, centre)
    widest_m = float(np.sqrt(np.linalg.eigvalsh(of_place.covariance[:2, :2])[-1]))
    most_m = max(OFF_SIGMAS * widest_m, off_m + LIKELY * sigma_m)
    most_deg = [
        max(OFF_SIGMAS * sigma, abs(turn) + LIKELY * sigma)
        for turn, sigma in _turned(excerpt.usual, of_yaw)
    ]
    hidden_deg = [each for each, least in zip(most_deg, SHOWS_DEG, strict=True) if each > least]
    if most_m <= SHOWS_M and not hidden_deg:
        return found
    evidence = Text(
        "{}, but a pose up to {:.1f} m or {:.1f} deg off would hardly show",
        found.evidence, min(most_m, FARTHEST_M),
        min(max(hidden_deg, default=most_deg[0]), FARTHEST_DEG),
    )  # fmt: skip
    crossing = Text("record more traffic, on crossing lanes, too")
    return replace(found, verdict=UNKNOWN, evidence=evidence, advice=crossing)


def _single(seen: Measurement, centre: State) -> list[tuple[Measurement, float]]:
    """Return a measured pose if only the place of the given one is wrong, and if only its yaw is.

    Each has the likelihood that the other one, surveyed by itself, is as far off as is measured.
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
    found = sorted(_single(seen, centre), key=lambda each: -each[1])
    return [one for one, chance in found if chance > SINGLE] or [seen]


def _aside(seen: Measurement, centre: State) -> tuple[float, float]:
    """Return the distance in the plane of a measured pose from a place, and its error, metres.

    Distance over error is that of the covariance in the plane (Mahalanobis).
    """
    gap, spread = (seen.position - centre.position)[:2], seen.covariance[:2, :2]
    off_m = float(np.hypot(*gap))
    return off_m, off_m / max(float(np.sqrt(gap @ np.linalg.solve(spread, gap))), 1e-9)


def _turned(pose: Pose, seen: Measurement) -> list[tuple[float, float]]:
    """Return yaw, pitch and roll of a pose less those of a measured one, each with error, deg."""
    angles = Rotation.from_quat(seen.quaternion).as_euler("ZYX", degrees=True)
    spread = covariance_of_angles(seen.quaternion, seen.covariance)
    sigmas = np.degrees(np.sqrt(np.diag(spread)[5:2:-1]))
    turns = [
        (a - getattr(pose, n) + 180.0) % 360.0 - 180.0 for a, n in zip(angles, TURNS, strict=True)
    ]
    return list(zip(turns, sigmas.tolist(), strict=True))


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


def _elsewhere(excerpt: Excerpt, lanes: LaneMap, pose: Pose, evidence: str) -> Finding | None:
    """Return the finding that a search finds another pose where no fit near it converges."""
    tried = scored(excerpt, lanes, found_poses(excerpt, lanes))
    best = likeliest(excerpt, score(excerpt, lanes), tried, FOUND_SHARE)[:1]
    for rival, each in best:
        there = rival.turned(pose)
        off_m, turn = rival.off(pose)
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            if_so = Text("{}, {:.0%} if that is corrected", evidence, each.share)
            if rival.twofold(pose):
                return wrong(if_so, UNKNOWN_CAUSE, ONE_PLACE)
            named = _with_name(excerpt, there.yaw, SAME_DEG[0]) if off_m < SAME_PLACE_M else rival
            return wrong(if_so, (named or rival).cause, (named or rival).advice)
    return None


def _with_name(excerpt: Excerpt, yaw: float, within: float) -> Rival | None:
    """Return the named mistake, if any, that turns the usual pose to a yaw (degrees)."""
    pose = excerpt.usual
    turned = [each for each in ways_to_be_wrong(excerpt, {}) if each.off(pose)[1] != 0.0]
    near = [
        each
        for each in turned
        if abs((each.turned(pose).yaw - yaw + 180.0) % 360.0 - 180.0) < within
    ]
    return near[0] if near else None


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
        Amount with error, and the right value, for a message.
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
        return self.far and self.amount > max(TOO_FAR * self.least, FAR_SIGMAS * self.sigma)


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
    place = pose.position[:2] + (seen.position - centre.position)[:2]
    text = Text("{:.2f} ± {:.2f} m", off_m, sigma_m)
    right = Text("easting {:.2f}, northing {:.2f}", *place.tolist())
    offs = [Off(amount=off_m, sigma=sigma_m, least=OFF_M, text=text, right=right)]
    turns = _turned(pose, seen)
    for name, (turn, sigma), least in zip(TURNS, turns, OFF_DEG, strict=True):
        text = Text("{} {:.2f} ± {:.2f} deg", name, turn, sigma)
        angle = (getattr(pose, name) + turn + 180.0) % 360.0 - 180.0
        right = Text("{} {:.2f}", name, angle)
        offs.append(Off(amount=abs(turn), sigma=sigma, least=least, text=text, right=right))
    return offs


def _instead(told: list[Off], other: list[Off]) -> list[Off]:
    """Return by what of place and yaw a pose may be off instead; nothing beside a tilt."""
    if any(each.far for each in told[2:]):
        return []
    return [
        each
        for one, each in zip(told[:2], other[:2], strict=True)
        if not one.far and each.amount > each.least
    ]


def _beyond(excerpt: Excerpt, seen: Measurement, centre: State, evidence: str) -> Finding | None:
    """Return the finding that the pose is off, where a measured pose is too far from it.

    The right pose contradicts the traffic if it does by one way to be wrong; each likely way is
    told by which it is so far off.
    """
    pose, mistakes = excerpt.usual, single_mistakes(seen, centre)
    ways = [offs_of(pose, each, centre) for each in mistakes]
    first = next((k for k, offs in enumerate(ways) if any(each.far for each in offs)), None)
    if first is None:
        return None
    far = [each for each in ways[first] if each.far]
    told = [far] + [_instead(ways[first], offs) for k, offs in enumerate(ways) if k != first]
    told = [each for each in told if each]
    by, right = (
        Text(", or by ").join(Text(", ").join(each.text for each in way) for way in told),
        Text(", or ").join(Text(", ").join(each.right for each in way) for way in told),
    )
    put = Text("{}; by them it is off by {}", evidence, by)
    advice = Text("set {} in its pose, or find it with gis-radar localize", right)
    if not any(each.too_far for each in far):
        return Finding(sensor="", verdict=FITS, evidence=put, cause=MAY_BE_OFF, advice=advice)
    place, yaw = ways[first][:2]
    if yaw.far and place.amount < max(TOO_FAR * OFF_M, OFF_SIGMAS * place.sigma):
        turn = _turned(pose, mistakes[first])[0][0]
        named = _with_name(excerpt, pose.yaw + turn, OFF_SIGMAS * yaw.sigma)
        if named is not None:
            return wrong(put, named.cause, named.advice)
    return wrong(put, POSE_OFF, advice)


def lengths_off(excerpt: Excerpt, lanes: LaneMap, pace: RangeScale | None) -> Finding | None:
    """Return the finding that ranges are too long, where range rates hint at it and lanes agree.

    Parameters
    ----------
    excerpt : Excerpt
        What moved.
    lanes : LaneMap
        The map.
    pace : RangeScale or None
        How far ranges change as range rates state.
    """
    if pace is None or abs(pace.factor - 1.0) <= max(PACE, HINTED * pace.sigma):
        return None
    scaled = score(excerpt, lanes, Rival(scale=pace.factor))
    return lengthened(pace) if scaled.ahead_of(score(excerpt, lanes)) > CLEAR else None

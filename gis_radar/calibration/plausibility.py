"""Plausibility: whether poses and recordings fit each other and the map, before results rest on it.

What moved is explained in rival ways on equal terms: as given, and by the mistakes that people
make. A sensor fits, does not fit (by which mistake, or by none that is known), or shows too little
traffic to tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.base import QUIET, Reporter, Text
from gis_radar.calibration.clocks import SensorClock
from gis_radar.calibration.excerpt import LEAST_VEHICLES, WILD_MPS, Excerpt, iso, read_excerpt
from gis_radar.calibration.findings import FITS, UNKNOWN, WRONG, Finding, wrong
from gis_radar.calibration.hypotheses import prior_at
from gis_radar.calibration.kalman_filter import Measurement
from gis_radar.calibration.lane_detections import LaneDetections
from gis_radar.calibration.lanes import Scene
from gis_radar.calibration.odd_clocks import odd_clocks
from gis_radar.calibration.range_scale import SIGN, RangeScale, measure_range_scale
from gis_radar.calibration.rivals import (
    AGAINST,
    NEAR_DEG,
    REFLECTION_M,
    SAME_DEG,
    SAME_PLACE_M,
    LaneMap,
    Rival,
    Score,
    best_split,
    found_poses,
    lower_or_tilted,
    on_lanes,
    other_yaws,
    score,
    ways_to_be_wrong,
)
from gis_radar.calibration.solver import Fit, Prior, solve
from gis_radar.calibration.state import POSE, State
from gis_radar.calibration.traces import thin
from gis_radar.calibration.windows import NEAR, WINDOW, data_alone
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Recording

STAGE = "checking poses and recordings"

FITTING = 0.75  # share of vehicles on lanes from which a pose fits; right ones show 0.85 and more
# A rival explains so many more of the vehicles, so many of all, clearly (standard errors) more;
# rivals within BESIDE of it are as likely, and causes that are estimated are so much better.
MORE, LEAST_SHARE, CLEAR, BESIDE = 0.2, 0.65, 4.0, 3.0
# A pose that is searched explains some of any traffic: it has to explain so much, and so much more
# than a mistake that has a name.
FOUND_SHARE, FITTED_MORE = 0.8, 0.05
# Where no rival fits, a pose is wrong whose lanes explain no more than any yaw's do by chance, or
# less than is asked of a rival; up to FITTING it is doubted, as maps lack lanes.
OVER_CHANCE = 0.1
# Share of the vehicles that right poses put on lanes at least, and the standard errors by which it
# is missed with few vehicles.
RIGHT_SHARE, BELOW = 0.84, 3.0
MOST_CAUSES = 2  # that are as likely: of more, none is named
HIGH_M = 1.5  # median height over the road that is off by more: vehicles, poles, bridges differ so
# A pose is doubted that is farther off than maps, drivers' habits and a careful survey together may
# be (metres, degrees, standard errors), and refused where it is twice as far, and clearly: standard
# errors rest on how drivers usually keep to their lanes.
OFF_M, OFF_DEG, OFF_SIGMAS = 0.7, (0.7, 1.5, 2.5), 3.0
TOO_FAR, FAR_SIGMAS = 2.0, 5.0
TURNS = ("yaw", "pitch", "roll")
# Of change of range over range rates: as far off 1, standard errors; standard errors from which it
# may explain a pose that is off; farther off 1 it is another unit; and the largest standard error
# (share) of what is no motion at random.
PACE, PACE_SIGMAS, HINTED, LENGTHENED, SURE_PACE = 0.02, 3.0, 1.5, 0.25, 0.05
OPEN = (0.0, 1.0, -1.0, 2.0, -2.0)  # standard errors within which a scale of range may be
LEAST_YARDS = 1.075  # from there on ranges that are longer look like yards, a factor of 1.094
FROZEN_FRAMES = 20  # equal frames on end: a second; by chance there are no two
# Vehicles on either side of a change, and its log likelihood ratio over none: odds of 3,000, and
# of 20 where a mistake explains what is on one side.
LEAST_PART, CHANGED, EXPLAINED = 8, 8.0, 3.0

UNKNOWN_CAUSE = Text("cause unknown")
BESIDE_LANES = Text("many vehicles drive beside the lanes")
POSE_OFF = Text("its pose is off")
ONE_PLACE = Text("are map, pose and recording of one place?")


@dataclass(frozen=True, kw_only=True)
class RecordedSensor:
    """A sensor of a site with what it recorded.

    Parameters
    ----------
    recordings : sequence of Recording
        Its recordings.
    tracks : sequence of PoseTrack
        As many, in order.
    clock : SensorClock, optional
        How far its clock is ahead.
    """

    recordings: Sequence[Recording]
    tracks: Sequence[PoseTrack]
    clock: SensorClock | None = None


def check_plausibility(
    sensors: Mapping[str, RecordedSensor], lanes: LaneMap, *, reporter: Reporter = QUIET
) -> tuple[Finding, ...]:
    """Check whether the poses and recordings of a site fit each other and the map.

    Parameters
    ----------
    sensors : mapping of str to RecordedSensor
        By name.
    lanes : LaneMap
        The map.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    tuple of Finding
        One a sensor, by name.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    found, seen = dict[str, Finding](), dict[str, LaneDetections]()
    excerpts = {
        name: read_excerpt(each.recordings, each.tracks, each.clock)
        for name, each in sorted(sensors.items())
    }
    poses = {
        name: each.usual if each.poses else sensors[name].tracks[0].poses[0]
        for name, each in excerpts.items()
    }
    for done, (name, excerpt) in enumerate(excerpts.items()):
        reporter.progress(STAGE, done, len(sensors))
        others = {other: pose for other, pose in poses.items() if other != name}
        found[name] = judge(name, excerpt, lanes, others)
        if found[name].verdict == FITS and len(sensors) > 1:
            seen[name] = on_lanes(excerpt, lanes)
    found |= odd_clocks(seen)
    reporter.progress(STAGE, len(sensors), len(sensors))
    return tuple(found.values())


def judge(sensor: str, excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding:
    """Judge one sensor by what moved before it.

    Parameters
    ----------
    sensor : str
        Its name.
    excerpt : Excerpt
        What moved.
    lanes : LaneMap
        The map.
    others : mapping of str to Pose
        The poses of the site's other sensors.
    """
    pace = None if excerpt.wild else measure_range_scale(excerpt.moving)
    found = _odd_recording(excerpt) or _odd_pace(pace) or _too_little(excerpt)
    found = found or _changed(excerpt, lanes, others) or _by_lanes(excerpt, lanes, others)
    if found.verdict == FITS:
        found = _longer(excerpt, lanes, pace) or _off(excerpt, lanes, found, pace) or found
    if found.cause == AGAINST.cause and not _sure(pace):  # both turn the direction of travel
        cause = Text(" or ").join([found.cause, SIGN.looks])
        found = replace(found, cause=cause, advice=Text(" or ").join([found.advice, SIGN.advice]))
    if found.verdict == FITS and not _sure(pace):
        verdict = found.verdict if found.cause else UNKNOWN
        evidence = Text("{}, scale of range not fitted", found.evidence)
        found = replace(found, verdict=verdict, evidence=evidence)
    return replace(found, sensor=sensor)


def _too_little(excerpt: Excerpt) -> Finding | None:
    if excerpt.vehicles >= LEAST_VEHICLES:
        return None
    evidence = Text("{} vehicles move, {} are needed", excerpt.vehicles, LEAST_VEHICLES)
    return Finding(sensor="", verdict=UNKNOWN, evidence=evidence)


def _odd_recording(excerpt: Excerpt) -> Finding | None:
    """Return what a recording itself shows to be wrong, without map and pose."""
    if excerpt.frozen is not None and excerpt.frozen[2] >= FROZEN_FRAMES:
        begin, end, frames = excerpt.frozen
        evidence = Text("{} frames from {} to {} are the same", frames, iso(begin), iso(end))
        return wrong(evidence, Text("the recording is frozen"), Text("leave that time out"))
    if excerpt.wild:
        evidence = Text("{:,} detections are faster than {:g} m/s", excerpt.wild, WILD_MPS)
        advice = Text("range_rate is m/s")
        return wrong(evidence, Text("range rates look like cm/s or mm/s"), advice)
    return None


def _odd_pace(pace: RangeScale | None) -> Finding | None:
    """Return why ranges do not change as the range rates state."""
    if pace is None or not _sure(pace):
        return None
    if pace.absolute:
        return wrong(_paced(pace), pace.likely, pace.advice)
    if abs(pace.factor - 1.0) <= max(PACE, PACE_SIGMAS * pace.sigma):
        return None
    lengths = [each for each in pace.mistakes if each.of_positions]
    if pace.mistakes and not lengths:
        return wrong(_paced(pace), pace.likely, pace.advice)
    if lengths or abs(pace.factor - 1.0) <= LENGTHENED:
        return _lengthened(pace)
    return wrong(_paced(pace), UNKNOWN_CAUSE, Text("look at the units of the recording"))


def _sure(pace: RangeScale | None) -> bool:
    """Return whether a scale of range is known: without, nothing is known of the range rates."""
    return pace is not None and pace.sigma <= SURE_PACE * abs(pace.factor)


def _paced(pace: RangeScale) -> Text:
    return Text(
        "ranges change {:.3f} ± {:.3f} times as fast as the range rates state",
        pace.factor,
        pace.sigma,
    )


def _lengthened(pace: RangeScale) -> Finding:
    cause: str = Text("ranges are {:.1%} too long, or range rates too low", pace.factor - 1.0)
    if pace.factor < 1.0:
        cause = Text("ranges are {:.1%} too short, or range rates too high", 1.0 - pace.factor)
    # an error may reach from a few percent to yards
    if pace.mistakes and not 1.0 + PACE < pace.factor < LEAST_YARDS:
        return wrong(_paced(pace), pace.likely, pace.advice)
    advice = Text("divide x, y and z by {0:.3f}, or multiply range_rate by it", pace.factor)
    return wrong(_paced(pace), cause, advice)


def _by_lanes(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding:
    """Compare rival explanations of where vehicles drive."""
    given, flat = score(excerpt, lanes), score(excerpt, lanes, Rival(heights=False))
    known = flat.over[np.isfinite(flat.over)]
    high = len(known) > 0 and abs(float(np.median(known)) - REFLECTION_M) > HIGH_M
    evidence = Text("{:.0%} of {} vehicles drive along lanes", given.share, len(given.on))
    if given.share >= FITTING and not high:
        return Finding(sensor="", verdict=FITS, evidence=evidence)
    rivals = ways_to_be_wrong(excerpt, others) + (lower_or_tilted(excerpt, flat) if high else [])
    least = given.share + (0.0 if high else MORE)
    best = _likeliest(excerpt, given, _scored(excerpt, lanes, rivals), least)
    yaws: Tried = []
    if given.share < FITTING:
        searched = _scored(excerpt, lanes, found_poses(excerpt, lanes))
        found = _likeliest(excerpt, given, searched, max(least, FOUND_SHARE))
        if found and (not best or _clearly_better(found[0][1], best[0][1])):
            best = found
        yaws = _scored(excerpt, lanes, other_yaws(excerpt.usual))
    if best:
        if_so = Text("{}, {:.0%} if so", evidence, best[0][1].share)
        twofold = best[0][0].twofold(excerpt.usual)
        if twofold or len(best) > MOST_CAUSES or _by_chance(excerpt, best[0], yaws):
            return wrong(if_so, UNKNOWN_CAUSE, ONE_PLACE)
        causes, advice = ([getattr(r, name) for r, _ in best] for name in ("cause", "advice"))
        return wrong(if_so, Text(" or ").join(causes), Text(" or ").join(advice))
    chance = max((each.share for _, each in yaws), default=0.0)
    drawn = RIGHT_SHARE - BELOW * np.sqrt(RIGHT_SHARE * (1.0 - RIGHT_SHARE) / len(given.on))
    if given.share < min(max(LEAST_SHARE, min(chance + OVER_CHANCE, FITTING)), drawn):
        by_chance = Text("{}, {:.0%} if turned at random", evidence, chance)
        return wrong(by_chance, UNKNOWN_CAUSE, ONE_PLACE)
    beside = {} if given.share >= FITTING else {
        "cause": BESIDE_LANES,
        "advice": Text("does the map lack lanes, or is the pose another sensor's?"),
    }  # fmt: skip
    return Finding(sensor="", verdict=FITS, evidence=evidence, **beside)


Tried = list[tuple[Rival, Score]]


def _scored(excerpt: Excerpt, lanes: LaneMap, rivals: Iterable[Rival]) -> Tried:
    return [(rival, score(excerpt, lanes, rival)) for rival in rivals]


def _clearly_better(fitted: Score, named: Score) -> bool:
    """Return whether what was searched explains more than a mistake with a name can."""
    return fitted.share >= named.share + FITTED_MORE and fitted.ahead_of(named) > BESIDE


def _likeliest(excerpt: Excerpt, given: Score, tried: Tried, least: float) -> Tried:
    """Return the rivals that explain most, clearly more than what is given, and their equals."""
    good = [
        one
        for one in tried
        if one[1].share >= max(least, LEAST_SHARE) and one[1].ahead_of(given) >= CLEAR
    ]
    good.sort(key=lambda one: -float(one[1].fit.sum()))
    alike = [one for one in good if one is good[0] or good[0][1].ahead_of(one[1]) < BESIDE]
    alike.sort(key=lambda one: (one[0].twofold(excerpt.usual), one[0].fitted))
    kept: Tried = []
    for one in alike:  # of two that are the same, the simpler; two mistakes at once only for want
        if kept and one[0].twofold(excerpt.usual):
            break
        if not any(one[0].same_as(other, excerpt.usual) for other, _ in kept):
            kept.append(one)
    return kept


def _by_chance(excerpt: Excerpt, best: tuple[Rival, Score], yaws: Tried) -> bool:
    """Return whether a yaw that nobody asked for explains as much: then neither is the cause."""
    rival, explains = best
    yaw = rival.turned(excerpt.usual).yaw
    return any(
        explains.ahead_of(each) < BESIDE
        and abs((other.turned(excerpt.usual).yaw - yaw + 180.0) % 360.0 - 180.0) > NEAR_DEG
        for other, each in yaws
    )


def _changed(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding | None:
    """Return what is wrong from some moment on, or until then, where the rest fits."""
    numbers, first = np.unique(excerpt.vehicle, return_index=True)
    order = np.argsort(excerpt.time[first], kind="stable")
    driving = score(excerpt, lanes).driving[order]
    split, gain = best_split(driving, LEAST_PART)
    if gain < EXPLAINED:
        return None
    when = float(excerpt.time[first[order[split]]])
    late = np.isin(excerpt.vehicle, numbers[order[split:]])
    until, since = (_by_lanes(excerpt.where(rows), lanes, others) for rows in (~late, late))
    bad = since if until.verdict == FITS else until
    if until.verdict == since.verdict or (gain < CHANGED and bad.cause == UNKNOWN_CAUSE):
        return None
    if until.verdict == WRONG:
        return replace(until, cause=Text("until {}: {}", iso(when), until.cause))
    return replace(since, cause=Text("from {} on: {}", iso(when), since.cause))


def _longer(excerpt: Excerpt, lanes: LaneMap, pace: RangeScale | None) -> Finding | None:
    """Return that ranges are too long where range rates hint at it, and lanes bear it out."""
    if pace is None or abs(pace.factor - 1.0) <= max(PACE, HINTED * pace.sigma):
        return None
    scaled = score(excerpt, lanes, Rival(scale=pace.factor))
    return _lengthened(pace) if scaled.ahead_of(score(excerpt, lanes)) > CLEAR else None


def _off(
    excerpt: Excerpt, lanes: LaneMap, found: Finding, pace: RangeScale | None
) -> Finding | None:
    """Return by how much a pose is off that nearly fits, where the traffic shows it clearly.

    Or ranges are too long, as much as their scale leaves open, where the pose is not off then.
    """
    off = _fitted_off(excerpt, lanes, found)
    if off is None or pace is None or off.cause != POSE_OFF:
        return off
    for scale in (pace.factor + pace.sigma * np.array(OPEN)).tolist():
        moving = replace(excerpt.moving, points=excerpt.moving.points / scale)
        if abs(scale - 1.0) > PACE and not _fitted_off(
            replace(excerpt, moving=moving), lanes, found
        ):
            both = off, _lengthened(replace(pace, factor=scale))
            causes, advice = ([getattr(f, n) for f in both] for n in ("cause", "advice"))
            return replace(off, cause=Text(" or ").join(causes), advice=Text(" or ").join(advice))
    return off


def _fitted_off(excerpt: Excerpt, lanes: LaneMap, found: Finding) -> Finding | None:
    pose = excerpt.usual
    points = excerpt.moving.points
    if not np.isfinite(points).all():
        return None  # without elevation, no pose is fitted
    samples = thin(*excerpt.as_usual)
    near = lanes.around(pose, lanes.reach_m(points))
    if near is None or not np.isfinite(near.points[:, 2]).any():
        return None
    centre = State(
        position=pose.position - [*near.origin, 0.0], R_map_sensor=pose.R_map_sensor,
        reflection=REFLECTION_M,
    )  # fmt: skip
    prior = prior_at(centre)
    information = prior.information.copy()
    information[POSE, POSE] = np.diag(np.array(NEAR) ** -2.0)
    prior = Prior(mean=centre, information=information)
    fit = solve(Scene(lanes=near, samples=samples), centre, prior, schedule=WINDOW)
    if not fit.converged or fit.fitness < FITTING:
        return _elsewhere(excerpt, lanes, pose, found.evidence)
    return _beyond(excerpt, _measured(fit, prior), centre, found.evidence)


def _measured(fit: Fit, prior: Prior) -> Measurement:
    """Return the pose that the data alone show, where they know it better than the prior.

    Along other directions, as down a street, the fit went as far as the prior let it: the data's
    pose would be extrapolated from there.
    """
    seen, unit = data_alone(fit, prior), np.array(NEAR)
    turn = Rotation.from_quat(seen.quaternion).as_matrix()
    there = replace(prior.mean, position=seen.position, R_map_sensor=turn)
    away = there.difference(prior.mean)
    values, vectors = np.linalg.eigh(seen.covariance / np.outer(unit, unit))
    known = vectors[:, values < 1.0]
    away[POSE] = unit * (known @ (known.T @ (away[POSE] / unit)))
    there = prior.mean.moved(away)
    quaternion = Rotation.from_matrix(there.R_map_sensor).as_quat()
    return replace(seen, position=there.position, quaternion=quaternion)


def _elsewhere(excerpt: Excerpt, lanes: LaneMap, pose: Pose, evidence: str) -> Finding | None:
    """Return that a pose is off from which no fit comes to rest, but which a search finds."""
    tried = _scored(excerpt, lanes, found_poses(excerpt, lanes))
    best = _likeliest(excerpt, score(excerpt, lanes), tried, FOUND_SHARE)[:1]
    for rival, each in best:
        there = rival.turned(pose)
        off_m, turn = rival.off(pose)
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            if_so = Text("{}, {:.0%} if so", evidence, each.share)
            if rival.twofold(pose):
                return wrong(if_so, UNKNOWN_CAUSE, ONE_PLACE)
            named = _with_name(excerpt, there.yaw, SAME_DEG[0]) if off_m < SAME_PLACE_M else rival
            return wrong(if_so, (named or rival).cause, (named or rival).advice)
    return None


def _with_name(excerpt: Excerpt, yaw: float, within: float) -> Rival | None:
    """Return the mistake with a name that turns the usual pose to a yaw."""
    pose = excerpt.usual
    turned = [each for each in ways_to_be_wrong(excerpt, {}) if each.off(pose)[1] != 0.0]
    near = [
        each
        for each in turned
        if abs((each.turned(pose).yaw - yaw + 180.0) % 360.0 - 180.0) < within
    ]
    return near[0] if near else None


def _beyond(excerpt: Excerpt, seen: Measurement, centre: State, evidence: str) -> Finding | None:
    """Return what of a measured pose is farther off than it may be."""
    pose = excerpt.usual
    gap, spread = (seen.position - centre.position)[:2], seen.covariance[:2, :2]
    off_m = float(np.hypot(*gap))
    sigma_m = float(np.sqrt(gap @ spread @ gap)) / max(off_m, 1e-9)
    angles = Rotation.from_quat(seen.quaternion).as_euler("ZYX", degrees=True)
    sigmas = np.degrees(np.sqrt(np.diag(seen.covariance)[5:2:-1]))
    place, text = pose.position[:2] + gap, Text("{:.2f} ± {:.2f} m", off_m, sigma_m)
    there = Text("easting {:.2f}, northing {:.2f}", *place.tolist())
    seen_off = [(off_m, sigma_m, OFF_M, text, there)]
    for name, angle, sigma, least in zip(TURNS, angles, sigmas, OFF_DEG, strict=True):
        turn = (angle - getattr(pose, name) + 180.0) % 360.0 - 180.0
        text = Text("{} {:.2f} ± {:.2f} deg", Text(name), turn, sigma)
        seen_off.append((abs(turn), sigma, least, text, Text("{} {:.2f}", Text(name), angle)))
    far = [each for each in seen_off if each[0] > max(each[2], OFF_SIGMAS * each[1])]
    if not far:
        return None
    put = Text("{}, and show it off by {}", evidence, Text(", ").join(each[3] for each in far))
    advice = Text("set {}", Text(", ").join(each[4] for each in far))
    if any(off > max(TOO_FAR * least, FAR_SIGMAS * sigma) for off, sigma, least, *_ in far):
        stands = off_m < max(TOO_FAR * OFF_M, OFF_SIGMAS * sigma_m)
        named = _with_name(excerpt, float(angles[0]), OFF_SIGMAS * sigmas[0]) if stands else None
        if named is not None and seen_off[1] in far:
            return wrong(put, named.cause, named.advice)
        return wrong(put, POSE_OFF, advice)
    doubt = Text("its pose may be off")
    return Finding(sensor="", verdict=FITS, evidence=put, cause=doubt, advice=advice)

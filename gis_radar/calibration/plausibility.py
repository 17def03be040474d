"""Plausibility: whether poses and recordings fit each other and the map, before results rest on it.

What moved is explained in rival ways on equal terms: as given, and by the mistakes that people
make. A sensor fits, does not fit (by which mistake, or by none that is known), or shows too little
traffic to tell.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.calibration.clock_offsets import measured_offset
from gis_radar.calibration.clocks import SensorClock
from gis_radar.calibration.excerpt import WILD_MPS, Excerpt, iso, read_excerpt
from gis_radar.calibration.hypotheses import prior_at
from gis_radar.calibration.kalman_filter import Measurement
from gis_radar.calibration.lane_detections import LaneDetections
from gis_radar.calibration.lanes import Scene
from gis_radar.calibration.range_scale import BY_TIMES, RangeScale, measure_range_scale
from gis_radar.calibration.rivals import (
    REFLECTION_M,
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
from gis_radar.calibration.solver import Prior, solve
from gis_radar.calibration.state import POSE, State
from gis_radar.calibration.traces import thin
from gis_radar.calibration.windows import NEAR, WINDOW, data_alone
from gis_radar.errors import NoAnswerError
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Recording
from gis_radar.texts import Text

STAGE = "checking poses and recordings"
FITS, WRONG = Text("fits"), Text("does not fit")
UNKNOWN = Text("too little traffic to tell")

LEAST_VEHICLES = 10  # fewer tell nothing
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
HIGH_M = 1.5  # median height over the road that is off by more: vehicles, poles, bridges differ so
# A pose is doubted that is farther off than maps, drivers' habits and a careful survey together may
# be (metres, degrees, standard errors), and refused where it is twice as far, and clearly: standard
# errors rest on how drivers usually keep to their lanes.
OFF_M, OFF_DEG, OFF_SIGMAS = 0.7, (0.7, 1.5, 2.5), 3.0
TOO_FAR, FAR_SIGMAS = 2.0, 5.0
TURNS = ("yaw", "pitch", "roll")
# Of change of range over range rates: as far off 1, standard errors, vehicles; standard errors from
# which it may explain a pose that is off; farther off 1 it is another unit; and the largest
# standard error (share) of what is no motion at random.
PACE, PACE_SIGMAS, LEAST_PACED, HINTED, LENGTHENED, SURE_PACE = 0.02, 3.0, 5, 1.5, 0.25, 0.05
YARDS = 1.075  # from there on ranges that are longer look like yards, a factor of 1.094
FROZEN_FRAMES = 20  # equal frames on end: a second; by chance there are no two
# Vehicles on either side of a change, and its log likelihood ratio over none (odds of 3,000).
LEAST_PART, CHANGED = 8, 8.0
CLOCK_S, CLOCK_SIGMAS = 0.3, 5.0  # between sensors with a common view: a car's length and more

UNKNOWN_CAUSE = Text("cause unknown")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What the check found of a sensor.

    Parameters
    ----------
    sensor : str
        Its name.
    verdict : str
        `FITS`, `WRONG` or `UNKNOWN`.
    evidence : str
        The numbers that it rests on.
    cause, advice : str
        What is probably wrong and what to do; empty where nothing is.
    """

    sensor: str
    verdict: str
    evidence: str
    cause: str = ""
    advice: str = ""

    @property
    def doubt(self) -> str:
        """What results say that go on anyway; empty where all fits."""
        if self.verdict == WRONG:
            return Text("{}; it is accepted anyway", self.line)
        return self.line if self.verdict != FITS or self.cause else ""

    @property
    def reason(self) -> str:
        """The cause with its evidence, or the evidence alone."""
        return Text("{} ({})", self.cause, self.evidence) if self.cause else self.evidence

    @property
    def line(self) -> Text:
        """The finding in a line."""
        return Text("{}: {}: {}", self.sensor, self.verdict, self.reason)


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


class ImplausibleError(NoAnswerError):
    """Sensors whose poses and recordings do not fit each other or the map.

    Parameters
    ----------
    template, *values, hint
        As for every error.
    findings : tuple of Finding
        What was found of these sensors.
    """

    def __init__(  # by the message alone, too: so errors come back from worker processes
        self, template: str, /, *values: Any, hint: str = "", findings: tuple[Finding, ...] = ()
    ) -> None:
        super().__init__(template, *values, hint=hint)
        self.findings = findings


def refuse_implausible(
    findings: Sequence[Finding], accepted: Collection[str], reporter: Reporter
) -> None:
    """Refuse sensors that do not fit; warn of those that are accepted, or show too little.

    Parameters
    ----------
    findings : sequence of Finding
        As from :func:`check_plausibility`.
    accepted : collection of str
        Sensors to go on with anyway.
    reporter : Reporter
        Receives the warnings.

    Raises
    ------
    ImplausibleError
        Naming all sensors that do not fit.
    """
    refused = tuple(
        each for each in findings if each.verdict == WRONG and each.sensor not in accepted
    )
    if refused:
        accept = Text(", ").join(Text("{} {}", "--accept", each.sensor) for each in refused)
        advice = Text("; ").join(Text("{}: {}", each.sensor, each.advice) for each in refused)
        raise ImplausibleError(
            "{}",
            Text("; ").join(each.line for each in refused),
            hint=Text("{}; or go on anyway: {}", advice, accept),
            findings=refused,
        )
    for each in findings:
        if each.doubt:
            reporter.warn("{}", each.doubt)


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
    poses = {name: each.tracks[0].poses[0] for name, each in sensors.items()}
    found, seen = dict[str, Finding](), dict[str, LaneDetections]()
    for done, (name, each) in enumerate(sorted(sensors.items())):
        reporter.progress(STAGE, done, len(sensors))
        excerpt = read_excerpt(each.recordings, each.tracks, each.clock)
        others = {other: pose for other, pose in poses.items() if other != name}
        found[name] = judge(name, excerpt, lanes, others)
        if found[name].verdict == FITS and len(sensors) > 1:
            seen[name] = on_lanes(excerpt, lanes)
    found |= _odd_clocks(seen)
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
        found = _longer(excerpt, lanes, pace) or _off(excerpt, lanes, found) or found
    return replace(found, sensor=sensor)


def _wrong(evidence: str, cause: str, advice: str) -> Finding:
    return Finding(sensor="", verdict=WRONG, evidence=evidence, cause=cause, advice=advice)


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
        return _wrong(evidence, Text("the recording is frozen"), Text("leave that time out"))
    if excerpt.wild:
        evidence = Text("{:,} detections are faster than {:g} m/s", excerpt.wild, WILD_MPS)
        advice = Text("range_rate is m/s")
        return _wrong(evidence, Text("range rates look like cm/s or mm/s"), advice)
    return None


def _odd_pace(pace: RangeScale | None) -> Finding | None:
    """Return why ranges do not change as the range rates state."""
    if pace is None or pace.vehicles < LEAST_PACED or pace.sigma > SURE_PACE * abs(pace.factor):
        return None
    if pace.absolute:
        return _wrong(_paced(pace), pace.likely, Text("range_rate is positive when receding"))
    if abs(pace.factor - 1.0) <= max(PACE, PACE_SIGMAS * pace.sigma):
        return None
    if pace.likely and not pace.likely.startswith("positions"):
        advice = Text("multiply range_rate by {:.3f}", pace.factor)
        if pace.likely in BY_TIMES:
            advice = Text(
                "multiply range_rate by {0:.3f}, or time if the clock is off", pace.factor
            )
        return _wrong(_paced(pace), pace.likely, advice)
    if pace.likely or abs(pace.factor - 1.0) <= LENGTHENED:
        return _lengthened(pace)
    return _wrong(_paced(pace), UNKNOWN_CAUSE, Text("look at the units of the recording"))


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
    if pace.likely and not 1.0 + PACE < pace.factor < YARDS:
        cause = pace.likely
    return _wrong(
        _paced(pace),
        cause,
        Text("divide x, y and z by {0:.3f}, or multiply range_rate by it", pace.factor),
    )


def _by_lanes(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding:
    """Compare rival explanations of where vehicles drive."""
    given, flat = score(excerpt, lanes), score(excerpt, lanes, Rival(heights=False))
    known = flat.over[np.isfinite(flat.over)]
    high = len(known) > 0 and abs(float(np.median(known)) - REFLECTION_M) > HIGH_M
    evidence = Text("{:.0%} of {} vehicles drive along lanes", given.share, len(given.on))
    if given.share >= FITTING and not high:
        return Finding(sensor="", verdict=FITS, evidence=evidence)
    least = given.share + (0.0 if high else MORE)
    tried = [(r, score(excerpt, lanes, r)) for r in ways_to_be_wrong(excerpt, others)]
    best = _likeliest(given, tried, least)
    fitted = [(0.0, least, lower_or_tilted(excerpt, flat) if high else [])]
    if given.share < FITTING:
        fitted.append((FITTED_MORE, max(least, FOUND_SHARE), found_poses(excerpt, lanes)))
    for more, enough, rivals in fitted:
        better = _likeliest(given, [(r, score(excerpt, lanes, r)) for r in rivals], enough)[:1]
        if better and (not best or _clearly_better(better[0][1], best[0][1], more)):
            best = better
    if best:
        if_so = Text("{}, {:.0%} if so", evidence, best[0][1].share)
        causes, advice = ([getattr(r, name) for r, _ in best] for name in ("cause", "advice"))
        return _wrong(if_so, Text(" or ").join(causes), Text(" or ").join(advice))
    yaws = other_yaws(excerpt.poses[0]) if given.share < FITTING else ()
    chance = max((score(excerpt, lanes, rival).share for rival in yaws), default=0.0)
    if given.share < max(LEAST_SHARE, min(chance + OVER_CHANCE, FITTING)):
        by_chance = Text("{}, {:.0%} if turned at random", evidence, chance)
        return _wrong(by_chance, UNKNOWN_CAUSE, Text("are map, pose and recording of one place?"))
    beside = {} if given.share >= FITTING else {
        "cause": Text("many vehicles drive beside the lanes"),
        "advice": Text("does the map lack lanes, or is the pose another sensor's?"),
    }  # fmt: skip
    return Finding(sensor="", verdict=FITS, evidence=evidence, **beside)


def _clearly_better(fitted: Score, named: Score, more: float) -> bool:
    """Return whether what was fitted explains more than a mistake with a name can."""
    return fitted.share >= named.share + more and fitted.ahead_of(named) > BESIDE


Tried = list[tuple[Rival, Score]]


def _likeliest(given: Score, tried: Tried, least: float) -> Tried:
    """Return the rivals that explain most, clearly more than what is given; of equals two."""
    good = [
        one
        for one in tried
        if one[1].share >= max(least, LEAST_SHARE) and one[1].ahead_of(given) >= CLEAR
    ]
    good.sort(key=lambda one: -float(one[1].fit.sum()))
    return [one for one in good[:2] if one is good[0] or good[0][1].ahead_of(one[1]) < BESIDE]


def _changed(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding | None:
    """Return what is wrong from some moment on, or until then, where the rest fits."""
    numbers, first = np.unique(excerpt.vehicle, return_index=True)
    order = np.argsort(excerpt.time[first], kind="stable")
    driving = score(excerpt, lanes).driving[order]
    split, gain = best_split(driving, LEAST_PART)
    if gain < CHANGED:
        return None
    when = float(excerpt.time[first[order[split]]])
    late = np.isin(excerpt.vehicle, numbers[order[split:]])
    until, since = (_by_lanes(excerpt.where(rows), lanes, others) for rows in (~late, late))
    if until.verdict == since.verdict:
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


def _off(excerpt: Excerpt, lanes: LaneMap, found: Finding) -> Finding | None:
    """Return by how much a pose is off that nearly fits, where the traffic shows it clearly."""
    pose = excerpt.poses[int(np.bincount(excerpt.pose).argmax())]
    points = excerpt.moving.points
    if not np.isfinite(points).all():
        return None  # without elevation, no pose is fitted
    samples = thin(excerpt.moving, excerpt.track)
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
    return _beyond(pose, data_alone(fit, prior), centre, found.evidence)


def _elsewhere(excerpt: Excerpt, lanes: LaneMap, pose: Pose, evidence: str) -> Finding | None:
    """Return that a pose is off from which no fit comes to rest, but which a search finds."""
    tried = [(rival, score(excerpt, lanes, rival)) for rival in found_poses(excerpt, lanes)]
    best = _likeliest(score(excerpt, lanes), tried, FOUND_SHARE)[:1]
    for rival, each in best:
        there = rival.turned(pose)
        off_m = np.hypot(*(there.position - pose.position)[:2])
        turn = (there.yaw - pose.yaw + 180.0) % 360.0 - 180.0
        if off_m > TOO_FAR * OFF_M or abs(turn) > TOO_FAR * OFF_DEG[0]:
            return _wrong(Text("{}, {:.0%} if so", evidence, each.share), rival.cause, rival.advice)
    return None


def _beyond(pose: Pose, seen: Measurement, centre: State, evidence: str) -> Finding | None:
    """Return what of a measured pose is farther off than it may be."""
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
        return _wrong(put, Text("its pose is off"), advice)
    doubt = Text("its pose may be off")
    return Finding(sensor="", verdict=FITS, evidence=put, cause=doubt, advice=advice)


def _odd_clocks(seen: Mapping[str, LaneDetections]) -> dict[str, Finding]:
    """Return the sensors that see vehicles at other times than those with a common view."""
    odd: dict[str, list[tuple[str, float, float]]] = {}
    for one, other in combinations(seen, 2):
        try:
            offset = measured_offset(seen[one], seen[other])
        except NoAnswerError:  # no common view
            continue
        if abs(offset.offset_s) > max(CLOCK_S, CLOCK_SIGMAS * offset.sigma_s):
            odd.setdefault(one, []).append((other, -offset.offset_s, offset.sigma_s))
            odd.setdefault(other, []).append((one, offset.offset_s, offset.sigma_s))
    told = dict[str, Finding]()
    while odd:  # who contradicts most is off; of two, the later by name
        name = max(sorted(odd), key=lambda each: (len(odd[each]), each))
        other, ahead_s, sigma_s = odd[name][0]
        told[name] = replace(
            _wrong(
                Text("{:+.2f} ± {:.2f} s by vehicles that both see", ahead_s, sigma_s),
                Text("its clock and that of {} are apart", other),
                Text("find the offset with gis-radar clocks"),
            ),
            sensor=name,
        )
        odd = {
            key: left
            for key, pairs in odd.items()
            if key != name and (left := [each for each in pairs if each[0] != name])
        }
    return told

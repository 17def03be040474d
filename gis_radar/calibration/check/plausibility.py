"""Check whether poses and recordings fit each other and the map, before results rest on them.

The likelihood of the traffic with the given pose is compared with that after usual mistakes are
corrected. A sensor fits, does not fit (the cause is named, or unknown), or has too little traffic
for a verdict.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from gis_radar.base import QUIET, Booleans, Floats, Reporter, Text, seconds_from_iso
from gis_radar.calibration.check.evidence import LaneMap, score
from gis_radar.calibration.check.excerpt import LEAST_VEHICLES, Excerpt, read_excerpts
from gis_radar.calibration.check.explanations import compare_explanations, least_share
from gis_radar.calibration.check.faults import iso
from gis_radar.calibration.check.mistakes import AGAINST
from gis_radar.calibration.check.nearly_right import judge_offset
from gis_radar.calibration.check.odd_clocks import CONTRADICTION_S, odd_clocks, on_lanes
from gis_radar.calibration.findings import (
    FITS,
    RECORD_MORE,
    UNKNOWN,
    UNKNOWN_CAUSE,
    WRONG,
    Cause,
    Finding,
    judged,
    wrong,
)
from gis_radar.calibration.range_scale import measure_range_scale
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.calibration.timing.lane_detections import LaneDetections
from gis_radar.calibration.unit_mistakes import ABSOLUTE, odd_scale
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Recording

_STAGE = "checking poses and recordings"

_LEAST_SIDE = 8  # least number of vehicles on either side of a change
# Least log likelihood ratio of a change over none: odds of 3,000, and of 20 where a mistake
# explains the traffic on one side.
_CHANGED, _EXPLAINED = 8.0, 3.0
_MOVED = Text(
    "a sensor that was moved is two in a site file, with the recordings until then and from then on"
)
_POSE_OFF = "its pose is off"  # begin of such a cause
_SIDES = "until {}: {}", "from {} on: {}"  # of a moment
# Where the static surroundings stay, only these causes are named from a moment on: any other would
# have moved them.
_RATE_CAUSES = AGAINST.text, ABSOLUTE.text


@dataclass(frozen=True, kw_only=True)
class RecordedSensor:
    """A sensor of a site with its recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        The sensor's recordings.
    tracks : sequence of PoseTrack
        The pose track of each recording; empty where the pose is not known.
    clock : SensorClock, optional
        Offset of the sensor's clock; none by default.
    """

    recordings: Sequence[Recording]
    tracks: Sequence[PoseTrack] = ()
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
        One for each sensor, in the order of their names.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    findings, lane_detections = dict[str, Finding](), dict[str, LaneDetections]()
    excerpts = {
        name: read_excerpts(each.recordings, each.tracks, each.clock)
        for name, each in sorted(sensors.items())
    }
    first_excerpts = {name: next(remaining) for name, remaining in excerpts.items()}
    poses = {
        name: each.usual if each.poses else sensors[name].tracks[0].poses[0]
        for name, each in first_excerpts.items()
    }
    for done, name in enumerate(first_excerpts):
        reporter.progress(_STAGE, done, len(sensors))
        others = {other: pose for other, pose in poses.items() if other != name}
        remaining = chain([first_excerpts[name]], excerpts[name])
        finding, excerpt = judge(name, remaining, lanes, others)
        findings[name] = _moment_by_own_clock(finding, sensors[name].clock)
        if findings[name].verdict == FITS and len(sensors) > 1:
            lane_detections[name] = on_lanes(excerpt, lanes)
    for name, finding in odd_clocks(lane_detections).items():
        findings[name] = _told_correction(finding, sensors[name].clock)
    reporter.progress(_STAGE, len(sensors), len(sensors))
    return tuple(findings.values())


def _moment_by_own_clock(finding: Finding, clock: SensorClock | None) -> Finding:
    """Return a finding with its moment by the sensor's clock, as its recordings have it."""
    if clock is None or not finding.moment:
        return finding
    moment = seconds_from_iso(finding.moment, what="moment")
    return replace(finding, moment=iso(float(clock.shown(np.array(moment)))))


def _told_correction(finding: Finding, clock: SensorClock | None) -> Finding:
    """Return a finding on a clock with the correction that was given for it, which may be wrong."""
    # a wrong sign errs by twice as much
    if clock is None or abs(clock.offset_s) < CONTRADICTION_S / 2.0:
        return finding
    corrected = Text("its times were corrected by {:+.2f} s: is the sign right?", -clock.offset_s)
    return replace(finding, advice=Text("{}; {}", corrected, finding.advice))


def check_recordings(
    sensors: Mapping[str, RecordedSensor], *, reporter: Reporter = QUIET
) -> tuple[Finding, ...]:
    """Check recordings whose poses are not yet known: frozen frames, units, signs, traffic.

    Parameters
    ----------
    sensors : mapping of str to RecordedSensor
        By name.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    tuple of Finding
        Findings on sensors that do not fit or have too little traffic, in the order of names.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    findings = []
    for done, (name, each) in enumerate(sorted(sensors.items())):
        reporter.progress(_STAGE, done, len(sensors))
        excerpt = next(read_excerpts(each.recordings, clock=each.clock))
        finding = (
            excerpt.fault
            or odd_scale(measure_range_scale(excerpt.moving))
            or _too_little_traffic(excerpt)
        )
        findings += [replace(finding, sensor=name)] if finding is not None else []
    reporter.progress(_STAGE, len(sensors), len(sensors))
    return tuple(findings)


def judge(
    sensor: str, excerpts: Iterable[Excerpt], lanes: LaneMap, others: Mapping[str, Pose]
) -> tuple[Finding, Excerpt]:
    """Judge one sensor by its traffic.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    excerpts : iterable of Excerpt
        Excerpts of its recordings; the next one is read while the traffic is too little.
    lanes : LaneMap
        The map.
    others : mapping of str to Pose
        The poses of the site's other sensors.

    Returns
    -------
    Finding
        The finding on the sensor.
    Excerpt
        The excerpt on which it rests.
    """
    for excerpt in excerpts:
        finding = _judge_excerpt(excerpt, lanes, others)
        if finding.verdict != UNKNOWN:
            break
    return replace(finding, sensor=sensor), excerpt


def _judge_excerpt(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding:
    """Return the finding of the first check that has one; the last check always has one."""
    if excerpt.fault is not None:
        return excerpt.fault
    scale = measure_range_scale(excerpt.moving)
    units_known = scale is not None and scale.known
    finding = (
        odd_scale(scale)
        or _sensor_replaced(excerpt, lanes, others)
        or _few_vehicles(excerpt, lanes, others, units_known=units_known)
        or _fault_from_moment(excerpt, lanes, others)
        or compare_explanations(excerpt, lanes, others, units_known=units_known)
    )
    if finding.verdict != FITS:
        return finding
    finding = judge_offset(excerpt, lanes, finding, scale)
    if finding.verdict != FITS or units_known:
        return finding
    evidence = Text(
        "{}, too few approach or recede to compare ranges with range rates", finding.evidence
    )
    if finding.cause:
        return replace(finding, evidence=evidence)
    return judged(UNKNOWN, evidence, Cause("", RECORD_MORE))


def _too_little_traffic(excerpt: Excerpt) -> Finding | None:
    """Return the finding that there are fewer than `LEAST_VEHICLES`, if so."""
    if excerpt.vehicles >= LEAST_VEHICLES:
        return None
    evidence = Text("{} vehicles move, {} are needed", excerpt.vehicles, LEAST_VEHICLES)
    if len(excerpt.moving) == 0:  # nothing moves, or the radar does not measure it
        evidence = Text("{}; no range rate is over {:g} m/s", evidence, MIN_SPEED_MPS)
    return judged(UNKNOWN, evidence, Cause("", RECORD_MORE))


def _few_vehicles(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose], *, units_known: bool
) -> Finding | None:
    """Return the finding on a sensor with too little traffic for a verdict, if so.

    A few vehicles do not confirm a pose, but may show a mistake that explains them; where no
    mistake does, they may be walkers beside the road.
    """
    little, few = _too_little_traffic(excerpt), excerpt.vehicles
    if little is None or few == 0 or score(excerpt, lanes).share >= least_share(few):
        return little
    found = compare_explanations(excerpt, lanes, others, units_known=units_known)
    if found.verdict == WRONG and found.cause != UNKNOWN_CAUSE:
        return found
    return replace(little, evidence=Text("{}; {}", little.evidence, found.evidence))


def _sensor_replaced(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]
) -> Finding | None:
    """Return the finding that the static surroundings change: another sensor, or it was moved."""
    change = excerpt.scene_change
    if change is None or change.time is None:
        return None
    for cause, fault in _faults_of_sides(excerpt, change.time, lanes, others):
        if cause != UNKNOWN_CAUSE:
            return fault
    evidence = Text(
        "across that moment {:.0%} of what stands around it stays where it was, "
        "across others {:.0%}",
        change.share, change.usual,
    )  # fmt: skip
    cause = Text(
        "from {} on it is another sensor's recording, or the sensor was moved", iso(change.time)
    )
    advice = Text(
        "give each recording with the pose of its sensor and time; {} follows one that was "
        "moved, and its CSV goes wherever a pose goes",
        "gis-radar track",
    )
    return replace(wrong(evidence, Cause(cause, advice)), moment=iso(change.time))


def _fault_from_moment(
    excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]
) -> Finding | None:
    """Return the finding on a fault that the traffic shows before or after a moment only."""
    first_rows = np.unique(excerpt.vehicle, return_index=True)[1]
    order = np.argsort(excerpt.time[first_rows], kind="stable")
    driving = score(excerpt, lanes).driving[order]
    split, gain = _best_split(driving, _LEAST_SIDE)
    sides = driving[:split], driving[split:]
    if gain < _EXPLAINED or all(each.mean() < least_share(len(each)) for each in sides):
        return None  # where neither side fits, the fault is there all the time
    when = float(excerpt.time[first_rows[order[split]]])
    if min(each.vehicles for each in excerpt.split_at(when)) < _LEAST_SIDE:
        return None  # most vehicles are there from one moment on, as in a queue
    faults = _faults_of_sides(excerpt, when, lanes, others)
    if len(faults) != 1:
        return None
    [(cause, fault)] = faults
    same_scene = excerpt.scene_change is not None  # compared without a change: same place and axes
    unlikely = gain < _CHANGED and cause == UNKNOWN_CAUSE
    return None if unlikely or (same_scene and cause not in _RATE_CAUSES) else fault


def _faults_of_sides(
    excerpt: Excerpt, when: float, lanes: LaneMap, others: Mapping[str, Pose]
) -> list[tuple[str, Finding]]:
    """Return what is wrong until a moment and from it on, where there is traffic enough to tell.

    Each is a cause, and the finding that states it with the time.
    """
    faults = []
    sides = zip(excerpt.split_at(when), _SIDES, ("", iso(when)), strict=True)
    for side, template, moment in sides:
        if side.vehicles >= _LEAST_SIDE:
            found = compare_explanations(side, lanes, others)
            if found.verdict == WRONG:
                cause, advice = Text(template, iso(when), found.cause), found.advice
                if found.cause.startswith(_POSE_OFF):
                    advice = Text("{}; {}", advice, _MOVED)
                dated = replace(found, cause=cause, advice=advice, moment=moment)
                faults.append((found.cause, dated))
    return faults


def _best_split(driving: Booleans, least: int) -> tuple[int, float]:
    """Return the index at which the share of true values changes, and its log likelihood ratio.

    The ratio is of two shares over one share for all; either side has at least `least` values.
    """
    count, total = len(driving), int(driving.sum())
    before = np.arange(least, count - least + 1).astype(np.float64)
    if len(before) == 0:
        return 0, 0.0
    hits = np.cumsum(driving)[before.astype(np.int64) - 1].astype(np.float64)

    def likelihood(hit: Floats, of: Floats) -> Floats:
        share = np.clip(hit / of, 1e-9, 1.0 - 1e-9)
        return np.asarray(hit * np.log(share) + (of - hit) * np.log(1.0 - share))

    split_likelihood = likelihood(hits, before) + likelihood(total - hits, count - before)
    gain = split_likelihood - likelihood(np.array([float(total)]), np.array([float(count)]))
    best = int(gain.argmax())
    return int(before[best]), float(gain[best])

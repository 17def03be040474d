"""Check whether poses and recordings fit each other and the map, before results rest on them.

The traffic is explained in rival ways on equal terms: as given, and by usual mistakes. A sensor
fits, does not fit (by a named mistake, or by an unknown one), or has too little traffic for a
verdict.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from gis_radar.base import QUIET, Reporter, Text
from gis_radar.calibration.check.excerpt import (
    LEAST_VEHICLES,
    WILD_MPS,
    Excerpt,
    iso,
    read_excerpts,
)
from gis_radar.calibration.check.explanations import by_lanes, least_share
from gis_radar.calibration.check.nearly_right import pose_off
from gis_radar.calibration.check.odd_clocks import odd_clocks
from gis_radar.calibration.check.rivals import (
    AGAINST,
    LaneMap,
    best_split,
    on_lanes,
    score,
    signs_lost,
)
from gis_radar.calibration.findings import (
    FITS,
    RECORD_MORE,
    UNKNOWN,
    UNKNOWN_CAUSE,
    WRONG,
    Finding,
    either,
    wrong,
)
from gis_radar.calibration.range_scale import measure_range_scale
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.calibration.timing.lane_detections import LaneDetections
from gis_radar.calibration.unit_mistakes import ABSOLUTE, FEET, SIGN, YARDS, odd_scale
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Recording

STAGE = "checking poses and recordings"

MOST_DOUBLED = 0.1  # share of a recording's detections; by chance there are none
FROZEN_FRAMES = 20  # equal frames in a row: a second at 20 Hz; by chance there are no two
# Least vehicles on either side of a change, and its log likelihood ratio over no change: odds of
# 3,000, and of 20 where a mistake explains the traffic on one side.
LEAST_PART, CHANGED, EXPLAINED = 8, 8.0, 3.0
OF_RATES = AGAINST.cause, ABSOLUTE.looks  # causes that leave the surroundings as they are


@dataclass(frozen=True, kw_only=True)
class RecordedSensor:
    """A sensor of a site with its recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        The sensor's recordings.
    tracks : sequence of PoseTrack
        As many, in order; none where the pose is not known.
    clock : SensorClock, optional
        How far the sensor's clock is ahead.
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
    found, seen = dict[str, Finding](), dict[str, LaneDetections]()
    more = {
        name: read_excerpts(each.recordings, each.tracks, each.clock)
        for name, each in sorted(sensors.items())
    }
    first = {name: next(excerpts) for name, excerpts in more.items()}
    poses = {
        name: each.usual if each.poses else sensors[name].tracks[0].poses[0]
        for name, each in first.items()
    }
    for done, name in enumerate(first):
        reporter.progress(STAGE, done, len(sensors))
        others = {other: pose for other, pose in poses.items() if other != name}
        excerpts = chain([first[name]], more[name])
        found[name], excerpt = judge(name, excerpts, lanes, others)
        if found[name].verdict == FITS and len(sensors) > 1:
            seen[name] = on_lanes(excerpt, lanes)
    found |= odd_clocks(seen)
    reporter.progress(STAGE, len(sensors), len(sensors))
    return tuple(found.values())


def check_recordings(
    sensors: Mapping[str, RecordedSensor], *, reporter: Reporter = QUIET
) -> tuple[Finding, ...]:
    """Check recordings alone, where poses are not yet known: frozen frames, units, signs, traffic.

    Parameters
    ----------
    sensors : mapping of str to RecordedSensor
        By name.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    tuple of Finding
        What does not fit, or shows too little traffic, in the order of names; nothing on others.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    found = []
    for done, (name, each) in enumerate(sorted(sensors.items())):
        reporter.progress(STAGE, done, len(sensors))
        excerpt = next(read_excerpts(each.recordings, clock=each.clock))
        odd = _odd_recording(excerpt) or odd_scale(measure_range_scale(excerpt.moving))
        odd = odd or _too_little(excerpt)
        found += [replace(odd, sensor=name)] if odd is not None else []
    reporter.progress(STAGE, len(sensors), len(sensors))
    return tuple(found)


def judge(
    sensor: str, excerpts: Iterable[Excerpt], lanes: LaneMap, others: Mapping[str, Pose]
) -> tuple[Finding, Excerpt]:
    """Judge one sensor by its traffic.

    Parameters
    ----------
    sensor : str
        Its name.
    excerpts : iterable of Excerpt
        Excerpts of its recordings; the next one is read where the traffic is too little.
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
        found = _judged(excerpt, lanes, others)
        if found.verdict != UNKNOWN:
            break
    return replace(found, sensor=sensor), excerpt


def _judged(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding:
    scale = None if excerpt.wild else measure_range_scale(excerpt.moving)
    is_known = scale is not None and scale.known
    found = _odd_recording(excerpt) or odd_scale(scale) or _replaced(excerpt, lanes, others)
    found = found or _too_little(excerpt) or _changed(excerpt, lanes, others)
    units = () if is_known else (FEET, YARDS)
    found = found or by_lanes(excerpt, lanes, others, units)
    if found.verdict == FITS:
        found = pose_off(excerpt, lanes, found, scale)
    other = None
    if found.cause == AGAINST.cause and not is_known:  # both turn the direction of travel
        other = SIGN
    if found.cause == SIGN.looks and signs_lost(excerpt):  # where all approach, both are the same
        other = ABSOLUTE
    if other is not None:
        cause, advice = either([(found.cause, found.advice), (other.looks, other.advice)])
        found = replace(found, cause=cause, advice=advice)
    if found.verdict == FITS and not is_known:
        evidence = Text(
            "{}, too few approach or recede to compare ranges with range rates", found.evidence
        )
        found = replace(found, evidence=evidence)
        if not found.cause:
            found = replace(found, verdict=UNKNOWN, advice=RECORD_MORE)
    return found


def _too_little(excerpt: Excerpt) -> Finding | None:
    if excerpt.vehicles >= LEAST_VEHICLES:
        return None
    evidence = Text("{} vehicles move, {} are needed", excerpt.vehicles, LEAST_VEHICLES)
    return Finding(sensor="", verdict=UNKNOWN, evidence=evidence, advice=RECORD_MORE)


def _odd_recording(excerpt: Excerpt) -> Finding | None:
    """Return the finding on faults that a recording shows without map and pose, if any."""
    if excerpt.frozen is not None and excerpt.frozen[2] >= FROZEN_FRAMES:
        begin, end, frames = excerpt.frozen
        evidence = Text("{} frames from {} to {} are the same", frames, iso(begin), iso(end))
        return wrong(evidence, Text("the recording is frozen"), Text("leave that time out"))
    if excerpt.doubled > MOST_DOUBLED:
        evidence = Text("{:.0%} of the moving detections are twice in it", excerpt.doubled)
        cause = Text("a file was joined with a copy of itself")
        return wrong(evidence, cause, Text("leave each detection once"))
    infinite = int(np.isinf(excerpt.moving.range_rate).sum())
    if excerpt.wild and 2 * infinite > excerpt.wild:  # another unit makes all of them large
        evidence = Text("{:,} range rates are infinite", infinite)
        advice = Text("a detection without a range rate has NaN there")
        return wrong(evidence, Text("the recording is damaged, or was converted wrongly"), advice)
    if excerpt.wild:
        evidence = Text("{:,} detections are faster than {:g} m/s", excerpt.wild, WILD_MPS)
        advice = Text("range_rate is m/s")
        return wrong(evidence, Text("range rates look like cm/s or mm/s"), advice)
    return None


def _replaced(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding | None:
    """Return the finding that data are another sensor's from a moment on, by its surroundings."""
    change = excerpt.scene_change
    if change is None or change.time is None:
        return None
    when = iso(change.time)
    parts = zip(excerpt.parted(change.time), ("until {}: {}", "from {} on: {}"), strict=True)
    for part, template in parts:
        if part.vehicles < LEAST_PART:  # too little traffic, as at night, to name a cause
            continue
        bad = by_lanes(part, lanes, others)
        if bad.verdict == WRONG and bad.cause != UNKNOWN_CAUSE:
            return replace(bad, cause=Text(template, when, bad.cause))
    evidence = Text(
        "across that moment {:.0%} of what stands around it stays where it was, "
        "across others {:.0%}",
        change.share, change.usual,
    )  # fmt: skip
    return wrong(
        evidence,
        Text("from {} on it is another sensor's recording, or the sensor was moved", when),
        Text(
            "give each recording with the pose of its sensor and time; {} follows one that was "
            "moved, and its CSV goes wherever a pose goes",
            "gis-radar track",
        ),
    )


def _changed(excerpt: Excerpt, lanes: LaneMap, others: Mapping[str, Pose]) -> Finding | None:
    """Return the finding on a fault before or after a moment, where the rest fits."""
    first = np.unique(excerpt.vehicle, return_index=True)[1]
    order = np.argsort(excerpt.time[first], kind="stable")
    driving = score(excerpt, lanes).driving[order]
    split, gain = best_split(driving, LEAST_PART)
    parts = driving[:split], driving[split:]
    if gain < EXPLAINED or all(each.mean() < least_share(len(each)) for each in parts):
        return None  # where neither part fits, the fault is there all the time
    when = float(excerpt.time[first[order[split]]])
    until, since = (by_lanes(part, lanes, others) for part in excerpt.parted(when))
    bad = since if until.verdict == FITS else until
    if until.verdict == since.verdict or (gain < CHANGED and bad.cause == UNKNOWN_CAUSE):
        return None
    same_place = excerpt.scene_change is not None  # place and axes are those of before
    if same_place and bad.cause not in OF_RATES:
        return None
    if until.verdict == WRONG:
        return replace(until, cause=Text("until {}: {}", iso(when), until.cause))
    return replace(since, cause=Text("from {} on: {}", iso(when), since.cause))

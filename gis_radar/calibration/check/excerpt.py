"""Excerpts: segments of a sensor's recordings, spread over their time, and the traffic in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, iso_from_step, step_of
from gis_radar.calibration.check.scene_change import (
    SceneChange,
    detect_scene_change,
    share_of_alternating_scenes,
)
from gis_radar.calibration.registration.traces import (
    MIN_SPEED_MPS,
    MOST_WALKERS,
    NONE,
    Moving,
    link_tracks,
    top_speeds,
    vehicles_of,
)
from gis_radar.calibration.single.moving import NO_OFFSET, recorded_between
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Detections, Recording, constant_value

SEGMENT_S = 20.0  # length of a segment: a vehicle crosses the view in it
LEAST_SEGMENTS = 5  # together as long as the window of a localization
MOST_SEGMENTS = 33  # for quiet nights; of 5, 9, 17, 33 segments the earlier are among the later
ENOUGH_VEHICLES = 30  # an excerpt with so many is complete: no further segments are read
LEAST_VEHICLES = 10  # fewer give no verdict
CYCLING_MPS = 7.0  # 25 km/h: cyclists ride at 5 m/s on average, motors of pedelecs stop at 7
SAME_PLACE_M = 1.0  # poses of a pose track that are farther apart are different places
PER_TRACK = 40  # most detections that a track keeps: more add no information
# So many detections faster than this (m/s) cannot be vehicles, in m/s or in km/h.
TOO_FAST_MPS, LEAST_TOO_FAST = 300.0, 30
LEAST_REPEATED = 2  # smaller frames equal the one before by chance


@dataclass(frozen=True, kw_only=True)
class Excerpt:
    """Traffic in segments of a sensor's recordings.

    Parameters
    ----------
    moving : Moving
        All moving detections, their times corrected by the clock.
    track : (m,) array
        Number of the track of each moving detection; `NONE` for those on no track.
    moving_pose : (m,) array
        Index in `poses` of the pose in force at each moving detection.
    frozen : (begin, end, frames) or None
        The longest run of equal frames: its begin and end, UNIX seconds, and number of frames.
    duplicate_share : float
        Share of the moving detections that repeat another one of their frame.
    scene_change : SceneChange or None
        Change of the static surroundings of the sensor; None where too few cells are static.
    alternating : float
        Share of static surroundings that two kinds of frames have in common, if they alternate; 1
        where none do. It is low for frames of two sensors.
    constant : dict
        The value of those of `range_rate` and `z` that is the same in all detections, by name.
    too_fast : int
        Number of impossibly fast detections, 0 below `LEAST_TOO_FAST`; else no tracks are linked.
    time, points, range_rate : arrays
        Detections on tracks, thinned: UNIX seconds, (n, 3) metres in the sensor frame, m/s.
    vehicle : (n,) array
        Number of the vehicle of each thinned detection, from 0.
    pose : (n,) array
        Index in `poses` of the pose in force at each thinned detection.
    poses : tuple of Pose
        The poses that were in force.
    """

    moving: Moving
    track: Integers
    moving_pose: Integers
    frozen: tuple[float, float, int] | None
    duplicate_share: float
    scene_change: SceneChange | None = None
    alternating: float = 1.0
    constant: dict[str, float] = field(default_factory=dict)
    too_fast: int
    time: Floats
    points: Floats
    range_rate: Floats
    vehicle: Integers
    pose: Integers
    poses: tuple[Pose, ...]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def vehicles(self) -> int:
        """Number of vehicles with thinned detections."""
        return len(np.unique(self.vehicle))

    @cached_property
    def reach_m(self) -> float:
        """99.5 % quantile of the ranges of moving detections, metres; 0 without any."""
        range_m = np.linalg.norm(np.nan_to_num(self.moving.points), axis=1)
        return float(np.percentile(range_m, 99.5)) if len(range_m) else 0.0

    @property
    def usual(self) -> Pose:
        """The pose that was in force for most of the moving detections."""
        return self.poses[int(np.bincount(self.moving_pose).argmax())]

    @property
    def as_usual(self) -> tuple[Moving, Integers]:
        """The moving detections in the sensor frame of the usual pose, and their tracks.

        Detections of poses more than `SAME_PLACE_M` away are left out; tracks are numbered anew,
        from 0 without gaps.
        """
        usual, points = self.usual, self.moving.points.copy()
        near = np.ones(len(points), dtype=bool)
        for number, pose in enumerate(self.poses):
            rows = self.moving_pose == number
            if np.linalg.norm(pose.position - usual.position) > SAME_PLACE_M:
                near[rows] = False
            elif pose != usual:
                offset = pose.to_map(points[rows]) - usual.position
                points[rows] = offset @ usual.R_map_sensor
        moving = replace(self.moving, points=points).where(near)
        track, on = self.track[near], self.track[near] != NONE
        track[on] = np.unique(track[on], return_inverse=True)[1]
        return moving, track

    def split_at(self, when: float) -> tuple[Excerpt, Excerpt]:
        """Split the excerpt at a time (UNIX s), each vehicle to the side of its first detection."""
        first = np.full(int(self.vehicle.max(initial=-1)) + 1, np.inf)
        np.minimum.at(first, self.vehicle, self.time)
        late, since = first[self.vehicle] >= when, self.moving.time >= when
        return self._where(~late, ~since), self._where(late, since)

    def _where(self, on_tracks: Booleans, moving: Booleans) -> Excerpt:
        """Return the selected detections, of the thinned ones on tracks and of all moving ones."""
        names = ("time", "points", "range_rate", "vehicle", "pose")
        return replace(
            self, track=self.track[moving], moving_pose=self.moving_pose[moving],
            moving=self.moving.where(moving),
            **{name: getattr(self, name)[on_tracks] for name in names},
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Detections of several recordings, in order of time; `source` is the recording's index."""

    time: Floats
    points: Floats
    range_rate: Floats
    source: Integers


def read_excerpts(
    recordings: Sequence[Recording],
    tracks: Sequence[PoseTrack] = (),
    clock: SensorClock | None = None,
) -> Iterator[Excerpt]:
    """Yield excerpts of a sensor's recordings, each with more segments than the one before.

    The first one has `ENOUGH_VEHICLES` where the recordings do; callers read on when they need
    more traffic. The choice of segments depends on the recordings' first and last times and on
    their traffic alone.

    Parameters
    ----------
    recordings : sequence of Recording
        The recordings of one sensor.
    tracks : sequence of PoseTrack
        The pose track of each recording; empty where the pose is not known.
    clock : SensorClock, optional
        Offset of the sensor's clock; none by default.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    spans, count = [recorded_between(each) for each in recordings], LEAST_SEGMENTS
    length_s = sum(end - begin for begin, end in spans)
    while True:
        rows = _read_rows(recordings, _segment_begins(spans, count), clock or NO_OFFSET)
        excerpt = _excerpt(rows, tracks)
        last = SEGMENT_S * count >= length_s or count >= MOST_SEGMENTS
        if last or excerpt.vehicles >= ENOUGH_VEHICLES or excerpt.too_fast:
            excerpt = replace(excerpt, scene_change=_scene_change(rows, tracks) if tracks else None)
            del rows  # the caller may keep this generator for long before asking for more
            yield excerpt
        if last:
            return
        count = 2 * count - 1


def _segment_begins(spans: Sequence[tuple[float, float]], count: int) -> list[Floats]:
    """Return the begins of each recording's segments, UNIX s, spread evenly over all recordings."""
    length = np.array([end - begin for begin, end in spans])
    ends = np.cumsum(length)
    step = max(SEGMENT_S, (ends[-1] - SEGMENT_S) / (count - 1))
    offsets = step * np.arange(count)
    offsets = offsets[offsets < max(ends[-1], SEGMENT_S)]
    recording = np.minimum(np.searchsorted(ends, offsets, side="right"), len(spans) - 1)
    begins = [
        spans[k][0] + offsets[recording == k] - (ends[k] - length[k]) for k in range(len(spans))
    ]
    if step == SEGMENT_S:
        return begins
    # on a common grid of time, so that segments of sensors with a common view coincide
    return [np.unique(np.floor(each / SEGMENT_S) * SEGMENT_S) for each in begins]


def _read_rows(
    recordings: Sequence[Recording], begins: Sequence[Floats], clock: SensorClock
) -> _Rows:
    """Read the segments of all recordings, with times corrected by the clock."""
    empty = np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, np.int64)
    columns = [empty]
    for number, (recording, segment_begins) in enumerate(zip(recordings, begins, strict=True)):
        for rows in _read_segments(recording, segment_begins):
            source = np.full(len(rows), number)
            columns.append((clock.corrected(rows.time), rows.points, rows.range_rate, source))
    time, points, rate, source = (np.concatenate(each) for each in zip(*columns, strict=True))
    order = np.argsort(time, kind="stable")
    return _Rows(
        time=time[order], points=points[order], range_rate=rate[order], source=source[order]
    )


def _read_segments(recording: Recording, begins: Floats) -> Iterator[Detections]:
    """Yield the detections of a recording in the segments that begin at these times (UNIX s)."""
    if recording.batches_from is None:  # the format has no random access: read all of it
        for rows in recording.read() if len(begins) else ():
            segment = np.maximum(np.searchsorted(begins, rows.time, side="right") - 1, 0)
            yield rows.take(
                (rows.time >= begins[segment]) & (rows.time < begins[segment] + SEGMENT_S)
            )
        return
    for begin in begins.tolist():
        for rows in recording.read_between(begin, begin + SEGMENT_S):
            yield rows.take((rows.time >= begin) & (rows.time < begin + SEGMENT_S))


def _excerpt(rows: _Rows, tracks: Sequence[PoseTrack]) -> Excerpt:
    """Return the excerpt of detections: tracks, thinned samples and faults; no scene change yet."""
    moves = np.abs(rows.range_rate) > MIN_SPEED_MPS
    frames = np.unique(rows.time)
    moving = Moving(
        time=rows.time[moves], points=rows.points[moves], range_rate=rows.range_rate[moves],
        frames=len(frames), begin=float(frames[0]) if len(frames) else np.nan,
        end=float(frames[-1]) if len(frames) else np.nan,
    )  # fmt: skip
    level = replace(moving, points=np.nan_to_num(moving.points))  # z is NaN without elevation
    too_fast = int((np.abs(moving.range_rate) > TOO_FAST_MPS).sum())
    too_fast = too_fast if too_fast >= LEAST_TOO_FAST else 0
    track = np.full(len(moving), NONE) if too_fast else link_tracks(level)
    vehicle = vehicles_of(level, track)
    thinned = _thinned(track)
    thinned = thinned[~_maybe_cyclists(level, track, vehicle)[track[thinned]]]
    poses, moving_pose = _poses_in_force(moving.time, rows.source[moves], tracks)
    return Excerpt(
        moving=moving, track=track, moving_pose=moving_pose, frozen=_longest_frozen_run(rows),
        duplicate_share=_duplicate_share(moving, rows.source[moves]),
        alternating=share_of_alternating_scenes(rows.time, rows.points, rows.range_rate),
        constant=_constant_columns(rows), too_fast=too_fast,
        time=moving.time[thinned],
        points=moving.points[thinned], range_rate=moving.range_rate[thinned],
        vehicle=vehicle[track[thinned]], pose=moving_pose[thinned], poses=poses,
    )  # fmt: skip


def _thinned(track: Integers) -> Integers:
    """Return indices of detections on tracks, thinned evenly to `PER_TRACK` a track, ascending."""
    rows = np.flatnonzero(track != NONE)
    rows = rows[np.argsort(track[rows], kind="stable")]
    first, count = np.unique(track[rows], return_index=True, return_counts=True)[1:]
    rank = np.arange(len(rows)) - np.repeat(first, count)
    step = np.repeat(-(-count // PER_TRACK), count)
    return np.sort(rows[rank % np.maximum(step, 1) == 0])


def _maybe_cyclists(moving: Moving, track: Integers, vehicle: Integers) -> Booleans:
    """Return for each track whether it may be of a cyclist or walker, who need not keep to lanes.

    These are tracks of objects never faster than `CYCLING_MPS`, if more than `MOST_WALKERS` of all
    objects are so slow and `LEAST_VEHICLES` are faster: in a jam all vehicles are slow.
    """
    if len(vehicle) == 0:
        return np.zeros(0, dtype=bool)
    top = np.zeros(int(vehicle.max()) + 1)
    np.maximum.at(top, vehicle, top_speeds(moving, track))
    slow = top <= CYCLING_MPS
    leave_out = slow.mean() > MOST_WALKERS and (~slow).sum() >= LEAST_VEHICLES
    return np.asarray(slow[vehicle] & leave_out)


def _poses_in_force(
    time: Floats, source: Integers, tracks: Sequence[PoseTrack]
) -> tuple[tuple[Pose, ...], Integers]:
    """Return the poses in force, and for each time the index of its pose."""
    poses, pose_index = list[Pose](), np.zeros(len(time), np.int64)
    for k, track in enumerate(tracks):
        rows = np.flatnonzero(source == k)
        in_force = track.at(time[rows])
        for index in np.unique(in_force).tolist():
            pose_index[rows[in_force == index]] = len(poses)
            poses.append(track.poses[index])
    return tuple(poses), pose_index


def _scene_change(rows: _Rows, tracks: Sequence[PoseTrack]) -> SceneChange | None:
    """Return the change of what stands around the sensor, placed in the map by its poses."""
    poses, pose_index = _poses_in_force(rows.time, rows.source, tracks)
    places = np.full((len(rows.time), 2), np.nan)
    for number, pose in enumerate(poses):
        rows_of_pose = pose_index == number
        places[rows_of_pose] = pose.to_map(np.nan_to_num(rows.points[rows_of_pose]))[:, :2]
    places[~np.isfinite(rows.points[:, :2]).all(axis=1)] = np.nan
    return detect_scene_change(rows.time, places, rows.range_rate)


def _longest_frozen_run(rows: _Rows) -> tuple[float, float, int] | None:
    """Return begin, end and number of frames of the longest run of equal frames, or None."""
    present = np.isfinite(rows.points[:, 0])
    time = rows.time[present]
    frames, first, count = np.unique(time, return_index=True, return_counts=True)
    if len(frames) == 0:
        return None
    values = np.column_stack([rows.points, rows.range_rate])[present]
    values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
    sums = np.add.reduceat(values, first)
    same = (np.diff(count) == 0) & (np.diff(sums, axis=0) == 0.0).all(axis=1)
    same = np.append(False, same & (count[1:] >= LEAST_REPEATED))
    # number of frames up to each one that in a row equal the frame before them
    total = np.cumsum(same)
    run = total - np.maximum.accumulate(np.where(same, 0, total))
    last = int(run.argmax())
    length = int(run[last])
    return (float(frames[last - length]), float(frames[last]), length + 1) if length else None


def _constant_columns(rows: _Rows) -> dict[str, float]:
    """Return those of `range_rate` and `z` that are the same in all detections, with the value."""
    columns = {"range_rate": rows.range_rate, "z": rows.points[:, 2]}
    values = {name: constant_value(column) for name, column in columns.items()}
    return {name: value for name, value in values.items() if value is not None}


def _duplicate_share(moving: Moving, source: Integers) -> float:
    """Return the share of detections that repeat another one of the same recording and frame."""
    values = np.column_stack([source, moving.time, moving.points, moving.range_rate])
    values = np.nan_to_num(values[np.lexsort(values.T)])
    return float((np.diff(values, axis=0) == 0.0).all(axis=1).sum() / max(len(values), 1))


def iso(time: float) -> str:
    """Format a time (UNIX seconds) as ISO 8601 text for a message."""
    return iso_from_step(int(step_of(np.array(time))))

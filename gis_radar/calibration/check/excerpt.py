"""Excerpts: segments of a sensor's recordings, spread over their time, and the traffic in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.check.faults import Rows, find_fault
from gis_radar.calibration.check.scene_change import SceneChange, detect_scene_change
from gis_radar.calibration.findings import Finding
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
from gis_radar.recordings import Detections, Recording

_SEGMENT_S = 20.0  # length of a segment: a vehicle crosses the view in it
_LEAST_SEGMENTS = 5  # together as long as the window of a localization
_MOST_SEGMENTS = 33  # for quiet nights; of 5, 9, 17, 33 segments the earlier are among the later
_ENOUGH_VEHICLES = 30  # an excerpt with so many is complete: no further segments are read
LEAST_VEHICLES = 10  # fewer give no verdict
_CYCLING_MPS = 7.0  # 25 km/h: cyclists ride at 5 m/s on average, motors of pedelecs stop at 7
_SAME_PLACE_M = 1.0  # poses of a pose track that are farther apart are different places
_PER_TRACK = 40  # most detections that a track keeps: more add no information


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
    reach_m : float
        99.5 % quantile of the ranges of moving detections; 0 without any.
    fault : Finding or None
        What is wrong with the recorded values themselves; then no tracks are linked.
    scene_change : SceneChange or None
        Change of the static surroundings of the sensor; None where too few cells are static.
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
    reach_m: float
    fault: Finding | None
    scene_change: SceneChange | None = None
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

    @property
    def one_sign(self) -> bool:
        """Whether all range rates of detections on tracks have one sign."""
        return bool((self.range_rate > 0.0).all() or (self.range_rate < 0.0).all())

    @property
    def usual(self) -> Pose:
        """The pose that was in force for most of the moving detections."""
        return self.poses[int(np.bincount(self.moving_pose).argmax())]

    @property
    def as_usual(self) -> tuple[Moving, Integers]:
        """The moving detections in the sensor frame of the usual pose, and their tracks.

        Detections of poses more than `_SAME_PLACE_M` away are left out; tracks are numbered anew,
        from 0 without gaps.
        """
        usual, points = self.usual, self.moving.points.copy()
        near = np.ones(len(points), dtype=bool)
        for number, pose in enumerate(self.poses):
            rows = self.moving_pose == number
            if np.linalg.norm(pose.position - usual.position) > _SAME_PLACE_M:
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


def read_excerpts(
    recordings: Sequence[Recording],
    tracks: Sequence[PoseTrack] = (),
    clock: SensorClock | None = None,
) -> Iterator[Excerpt]:
    """Yield excerpts of a sensor's recordings, each with more segments than the one before.

    The first one has `_ENOUGH_VEHICLES` where the recordings do; callers read on when they need
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
    spans, count = [recorded_between(each) for each in recordings], _LEAST_SEGMENTS
    length_s = sum(end - begin for begin, end in spans)
    while True:
        rows = _read_rows(recordings, _segment_begins(spans, count), clock or NO_OFFSET)
        excerpt = _excerpt(rows, tracks)
        last = _SEGMENT_S * count >= length_s or count >= _MOST_SEGMENTS
        if last or excerpt.vehicles >= _ENOUGH_VEHICLES or excerpt.fault is not None:
            excerpt = replace(excerpt, scene_change=_scene_change(rows, tracks) if tracks else None)
            del rows  # the caller may keep this generator for long before asking for more
            yield excerpt
        if last:
            return
        count = 2 * count - 1


def _segment_begins(spans: Sequence[tuple[float, float]], count: int) -> list[Floats]:
    """Return the begins of each recording's segments, UNIX s, spread evenly over all recordings.

    Where they would overlap, the recordings are read whole, however short each is.
    """
    length = np.array([end - begin for begin, end in spans])
    ends = np.cumsum(length)
    step = (ends[-1] - _SEGMENT_S) / (count - 1)
    if step <= _SEGMENT_S:
        return [begin + np.arange(0.0, end - begin + 1e-3, _SEGMENT_S) for begin, end in spans]
    offsets = step * np.arange(count)
    recording = np.minimum(np.searchsorted(ends, offsets, side="right"), len(spans) - 1)
    begins = [
        spans[k][0] + offsets[recording == k] - (ends[k] - length[k]) for k in range(len(spans))
    ]
    # on a common grid of time, so that segments of sensors with a common view coincide
    return [np.unique(np.floor(each / _SEGMENT_S) * _SEGMENT_S) for each in begins]


def _read_rows(
    recordings: Sequence[Recording], begins: Sequence[Floats], clock: SensorClock
) -> Rows:
    """Read the segments of all recordings, with times corrected by the clock."""
    empty = np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, np.int64)
    columns = [empty]
    for number, (recording, segment_begins) in enumerate(zip(recordings, begins, strict=True)):
        for rows in _read_segments(recording, segment_begins):
            source = np.full(len(rows), number)
            columns.append((clock.corrected(rows.time), rows.points, rows.range_rate, source))
    time, points, rate, source = (np.concatenate(each) for each in zip(*columns, strict=True))
    order = np.argsort(time, kind="stable")
    return Rows(
        time=time[order], points=points[order], range_rate=rate[order], source=source[order]
    )


def _read_segments(recording: Recording, begins: Floats) -> Iterator[Detections]:
    """Yield the detections of a recording in the segments that begin at these times (UNIX s)."""
    if recording.batches_from is None:  # the format has no random access: read all of it
        for rows in recording.read() if len(begins) else ():
            segment = np.maximum(np.searchsorted(begins, rows.time, side="right") - 1, 0)
            yield rows.take(
                (rows.time >= begins[segment]) & (rows.time < begins[segment] + _SEGMENT_S)
            )
        return
    for begin in begins.tolist():
        for rows in recording.read_between(begin, begin + _SEGMENT_S):
            yield rows.take((rows.time >= begin) & (rows.time < begin + _SEGMENT_S))


def _excerpt(rows: Rows, tracks: Sequence[PoseTrack]) -> Excerpt:
    """Return the excerpt of detections: tracks, thinned samples and faults; no scene change yet."""
    moves = np.abs(rows.range_rate) > MIN_SPEED_MPS
    frames = np.unique(rows.time)
    moving = Moving(
        time=rows.time[moves], points=rows.points[moves], range_rate=rows.range_rate[moves],
        frames=len(frames), begin=float(frames[0]) if len(frames) else np.nan,
        end=float(frames[-1]) if len(frames) else np.nan,
    )  # fmt: skip
    fault = find_fault(rows, moves)
    level = replace(moving, points=np.nan_to_num(moving.points))  # z is NaN without elevation
    track = np.full(len(moving), NONE) if fault is not None else link_tracks(level)
    vehicle = vehicles_of(level, track)
    thinned = _thinned(track)
    thinned = thinned[~_maybe_cyclists(level, track, vehicle)[track[thinned]]]
    poses, moving_pose = _poses_in_force(moving.time, rows.source[moves], tracks)
    range_m = np.linalg.norm(level.points, axis=1)
    return Excerpt(
        moving=moving, track=track, moving_pose=moving_pose, fault=fault,
        reach_m=float(np.percentile(range_m, 99.5)) if len(range_m) else 0.0,
        time=moving.time[thinned], points=moving.points[thinned],
        range_rate=moving.range_rate[thinned], vehicle=vehicle[track[thinned]],
        pose=moving_pose[thinned], poses=poses,
    )  # fmt: skip


def _thinned(track: Integers) -> Integers:
    """Return indices of detections on tracks, thinned evenly to `_PER_TRACK` a track, ascending."""
    rows = np.flatnonzero(track != NONE)
    rows = rows[np.argsort(track[rows], kind="stable")]
    first, count = np.unique(track[rows], return_index=True, return_counts=True)[1:]
    rank = np.arange(len(rows)) - np.repeat(first, count)
    step = np.repeat(-(-count // _PER_TRACK), count)
    return np.sort(rows[rank % np.maximum(step, 1) == 0])


def _maybe_cyclists(moving: Moving, track: Integers, vehicle: Integers) -> Booleans:
    """Return for each track whether it may be of a cyclist or walker, who need not keep to lanes.

    These are tracks of objects never faster than `_CYCLING_MPS`, if more than `MOST_WALKERS` of all
    objects are so slow and `LEAST_VEHICLES` are faster: in a jam all vehicles are slow.
    """
    if len(vehicle) == 0:
        return np.zeros(0, dtype=bool)
    top = np.zeros(int(vehicle.max()) + 1)
    np.maximum.at(top, vehicle, top_speeds(moving, track))
    slow = top <= _CYCLING_MPS
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


def _scene_change(rows: Rows, tracks: Sequence[PoseTrack]) -> SceneChange | None:
    """Return the change of what stands around the sensor, placed in the map by its poses."""
    poses, pose_index = _poses_in_force(rows.time, rows.source, tracks)
    places = np.full((len(rows.time), 2), np.nan)
    for number, pose in enumerate(poses):
        rows_of_pose = pose_index == number
        places[rows_of_pose] = pose.to_map(np.nan_to_num(rows.points[rows_of_pose]))[:, :2]
    places[~np.isfinite(rows.points[:, :2]).all(axis=1)] = np.nan
    return detect_scene_change(rows.time, places, rows.range_rate)

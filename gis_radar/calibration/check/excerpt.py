"""Excerpt: pieces of a sensor's recordings, spread over their time, and the traffic in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, iso_from_step, step_of
from gis_radar.calibration.check.scene_change import SceneChange, detect_scene_change
from gis_radar.calibration.registration.traces import (
    CREEPING,
    MIN_SPEED_MPS,
    NONE,
    Moving,
    link_tracks,
    top_speeds,
    vehicles_of,
)
from gis_radar.calibration.single.moving import RIGHT, recorded_between
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Detections, Recording

PIECE_S = 20.0  # length of a piece: a vehicle crosses the view in it
PIECES = 5  # least number of pieces: together as long as the window of a localization
MOST_PIECES = 33  # for quiet nights; of 5, 9, 17, 33 pieces the earlier ones are among the later
ENOUGH = 30  # vehicles from which on no further pieces are read
LEAST_VEHICLES = 10  # with fewer vehicles nothing is concluded
CYCLING_MPS = 7.0  # 25 km/h: cyclists go at 5 and 1, pedelecs are held to that
CORRECTED_M = 1.0  # poses of a pose track that are farther apart are different places
PER_TRACK = 40  # most detections of a track that are kept: more add nothing
WILD_MPS, LEAST_WILD = 300.0, 30  # no unit that is m/s or km/h shows so many so fast
LEAST_REPEATED = 2  # least detections of a frame that cannot be repeated by chance


@dataclass(frozen=True, kw_only=True)
class Excerpt:
    """Traffic in pieces of a sensor's recordings.

    Parameters
    ----------
    moving : Moving
        All moving detections, their times corrected by the clock.
    track : (m,) array
        The track of each moving detection, `NONE` for those of none.
    held : (m,) array
        Index in `poses` of the pose in force at each moving detection.
    frozen : (begin, end, frames) or None
        The longest run of equal frames: its begin and end, UNIX seconds, and number of frames.
    doubled : float
        Share of the moving detections that are in their frame a second time.
    scene_change : SceneChange or None
        Whether the static surroundings of the sensor change; None where too little stands.
    wild : int
        Number of impossibly fast detections; where it is not 0, no tracks are linked.
    time, points, range_rate : arrays
        Detections on tracks, thinned: UNIX seconds, (n, 3) metres in the sensor frame, m/s.
    vehicle : (n,) array
        Number of the vehicle of each, from 0.
    pose : (n,) array
        Index in `poses` of the pose in force.
    poses : tuple of Pose
        The poses that were in force.
    """

    moving: Moving
    track: Integers
    held: Integers
    frozen: tuple[float, float, int] | None
    doubled: float
    scene_change: SceneChange | None = None
    wild: int
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
        """How many vehicles there are."""
        return len(np.unique(self.vehicle))

    @cached_property
    def reach_m(self) -> float:
        """Range that 99.5 % of the moving detections stay below, metres."""
        off_m = np.linalg.norm(np.nan_to_num(self.moving.points), axis=1)
        return float(np.percentile(off_m, 99.5)) if len(off_m) else 0.0

    @property
    def usual(self) -> Pose:
        """The pose that was in force for most of the moving detections."""
        return self.poses[int(np.bincount(self.held).argmax())]

    @property
    def as_usual(self) -> tuple[Moving, Integers]:
        """The moving detections as seen from the usual pose, and their tracks.

        Detections from another place, farther off than poses are corrected, are left out; tracks
        are numbered anew, from 0 without gaps.
        """
        usual, points = self.usual, self.moving.points.copy()
        near = np.ones(len(points), dtype=bool)
        for number, pose in enumerate(self.poses):
            mine = self.held == number
            if np.linalg.norm(pose.position - usual.position) > CORRECTED_M:
                near[mine] = False
            elif pose != usual:
                there = pose.to_map(points[mine]) - usual.position
                points[mine] = there @ usual.R_map_sensor
        moving = replace(self.moving, points=points).where(near)
        track, on = self.track[near], self.track[near] != NONE
        track[on] = np.unique(track[on], return_inverse=True)[1]
        return moving, track

    def parted(self, when: float) -> tuple[Excerpt, Excerpt]:
        """Split the excerpt at a time (UNIX seconds); a vehicle belongs to where it appears."""
        first = np.full(int(self.vehicle.max(initial=-1)) + 1, np.inf)
        np.minimum.at(first, self.vehicle, self.time)
        late, since = first[self.vehicle] >= when, self.moving.time >= when
        return self._where(~late, ~since), self._where(late, since)

    def _where(self, kept: Booleans, moving: Booleans) -> Excerpt:
        names = ("time", "points", "range_rate", "vehicle", "pose")
        return replace(
            self, track=self.track[moving], held=self.held[moving],
            moving=self.moving.where(moving),
            **{name: getattr(self, name)[kept] for name in names},
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Rows of several recordings, in order of time."""

    time: Floats
    points: Floats
    range_rate: Floats
    source: Integers


def read_excerpts(
    recordings: Sequence[Recording],
    tracks: Sequence[PoseTrack] = (),
    clock: SensorClock | None = None,
) -> Iterator[Excerpt]:
    """Yield excerpts of a sensor's recordings, with more and more pieces, as far as there are any.

    The first has `ENOUGH` vehicles where the recordings do; the next ones are for callers to whom
    that is too little. Which pieces they hold follows from the first and last times of the
    recordings and from their traffic alone.

    Parameters
    ----------
    recordings : sequence of Recording
        The recordings of one sensor.
    tracks : sequence of PoseTrack
        As many, in order; none where the pose is not known.
    clock : SensorClock, optional
        How far the sensor's clock is ahead.

    Raises
    ------
    InputError
        If a recording is damaged.
    """
    spans, count = [recorded_between(each) for each in recordings], PIECES
    length_s = sum(end - begin for begin, end in spans)
    while True:
        rows = _rows(recordings, _begins(spans, count), clock or RIGHT)
        found = _excerpt(rows, tracks)
        last = PIECE_S * count >= length_s or count >= MOST_PIECES
        if last or found.vehicles >= ENOUGH or found.wild:
            found = replace(found, scene_change=_scene_change(rows, tracks) if tracks else None)
            del rows  # the caller may keep this generator for long before asking for more
            yield found
        if last:
            return
        count = 2 * count - 1


def _begins(spans: Sequence[tuple[float, float]], count: int) -> list[Floats]:
    """Return the begins (UNIX seconds) of each recording's pieces, spread evenly over its time."""
    length = np.array([end - begin for begin, end in spans])
    until = np.cumsum(length)
    step = max(PIECE_S, (until[-1] - PIECE_S) / (count - 1))
    at = step * np.arange(count)
    at = at[at < max(until[-1], PIECE_S)]
    of = np.minimum(np.searchsorted(until, at, side="right"), len(spans) - 1)
    found = [spans[k][0] + at[of == k] - (until[k] - length[k]) for k in range(len(spans))]
    if step == PIECE_S:
        return found
    # on a common grid of time, so that pieces of sensors with a common view coincide
    return [np.unique(np.floor(each / PIECE_S) * PIECE_S) for each in found]


def _rows(recordings: Sequence[Recording], begins: Sequence[Floats], clock: SensorClock) -> _Rows:
    none = np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, np.int64)
    parts = [none]
    for number, (recording, at) in enumerate(zip(recordings, begins, strict=True)):
        for rows in _pieces(recording, at):
            source = np.full(len(rows), number)
            parts.append((clock.corrected(rows.time), rows.points, rows.range_rate, source))
    time, points, rate, source = (np.concatenate(each) for each in zip(*parts, strict=True))
    order = np.argsort(time, kind="stable")
    return _Rows(
        time=time[order], points=points[order], range_rate=rate[order], source=source[order]
    )


def _pieces(recording: Recording, begins: Floats) -> Iterator[Detections]:
    """Yield the rows of some pieces of a recording."""
    if recording.batches_from is None:  # such a format is read from its begin only
        for rows in recording.read() if len(begins) else ():
            at = np.maximum(np.searchsorted(begins, rows.time, side="right") - 1, 0)
            yield rows.take((rows.time >= begins[at]) & (rows.time < begins[at] + PIECE_S))
        return
    for begin in begins.tolist():
        for rows in recording.read_between(begin, begin + PIECE_S):
            yield rows.take((rows.time >= begin) & (rows.time < begin + PIECE_S))


def _excerpt(rows: _Rows, tracks: Sequence[PoseTrack]) -> Excerpt:
    moves = np.abs(rows.range_rate) > MIN_SPEED_MPS
    frames = np.unique(rows.time)
    moving = Moving(
        time=rows.time[moves], points=rows.points[moves], range_rate=rows.range_rate[moves],
        frames=len(frames), begin=float(frames[0]) if len(frames) else np.nan,
        end=float(frames[-1]) if len(frames) else np.nan,
    )  # fmt: skip
    level = replace(moving, points=np.nan_to_num(moving.points))  # z is NaN without elevation
    wild = int((np.abs(moving.range_rate) > WILD_MPS).sum())
    wild = wild if wild >= LEAST_WILD else 0
    number = np.full(len(moving), NONE) if wild else link_tracks(level)
    vehicle = vehicles_of(level, number)
    kept = _thinned(number)
    kept = kept[~_cycling(level, number, vehicle)[number[kept]]]
    poses, held = _in_force(moving.time, rows.source[moves], tracks)
    return Excerpt(
        moving=moving, track=number, held=held, frozen=_frozen(rows),
        doubled=_doubled(moving, rows.source[moves]), wild=wild,
        time=moving.time[kept],
        points=moving.points[kept], range_rate=moving.range_rate[kept],
        vehicle=vehicle[number[kept]], pose=held[kept], poses=poses,
    )  # fmt: skip


def _thinned(track: Integers) -> Integers:
    """Return rows of detections on tracks, evenly thinned over each, in order of time."""
    on = np.flatnonzero(track != NONE)
    on = on[np.argsort(track[on], kind="stable")]
    first, count = np.unique(track[on], return_index=True, return_counts=True)[1:]
    rank = np.arange(len(on)) - np.repeat(first, count)
    every = np.repeat(-(-count // PER_TRACK), count)
    return np.sort(on[rank % np.maximum(every, 1) == 0])


def _cycling(moving: Moving, track: Integers, vehicle: Integers) -> Booleans:
    """Return which tracks may be of cyclists or walkers, who need not keep to lanes.

    These are the tracks of objects never faster than `CYCLING_MPS`, where such are many and enough
    others drive: in a jam all vehicles creep.
    """
    if len(vehicle) == 0:
        return np.zeros(0, dtype=bool)
    top = np.zeros(int(vehicle.max()) + 1)
    np.maximum.at(top, vehicle, top_speeds(moving, track))
    slow = top <= CYCLING_MPS
    leave_out = slow.mean() > CREEPING and (~slow).sum() >= LEAST_VEHICLES
    return np.asarray(slow[vehicle] & leave_out)


def _in_force(
    time: Floats, source: Integers, tracks: Sequence[PoseTrack]
) -> tuple[tuple[Pose, ...], Integers]:
    """Return the poses in force, and for each time the index of its pose."""
    poses, number = list[Pose](), np.zeros(len(time), np.int64)
    for k, track in enumerate(tracks):
        mine = np.flatnonzero(source == k)
        held = track.at(time[mine])
        for index in np.unique(held).tolist():
            number[mine[held == index]] = len(poses)
            poses.append(track.poses[index])
    return tuple(poses), number


def _scene_change(rows: _Rows, tracks: Sequence[PoseTrack]) -> SceneChange | None:
    """Return whether the static surroundings change in the map, given the poses."""
    poses, held = _in_force(rows.time, rows.source, tracks)
    places = np.full((len(rows.time), 2), np.nan)
    for number, pose in enumerate(poses):
        mine = held == number
        places[mine] = pose.to_map(np.nan_to_num(rows.points[mine]))[:, :2]
    places[~np.isfinite(rows.points[:, :2]).all(axis=1)] = np.nan
    return detect_scene_change(rows.time, places, rows.range_rate)


def _frozen(rows: _Rows) -> tuple[float, float, int] | None:
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
    # where a run of equal frames ends, and how many equal the one before in it
    total = np.cumsum(same)
    run = total - np.maximum.accumulate(np.where(same, 0, total))
    last = int(run.argmax())
    length = int(run[last])
    return (float(frames[last - length]), float(frames[last]), length + 1) if length else None


def _doubled(moving: Moving, source: Integers) -> float:
    """Return the share of detections that are in their frame of one recording a second time."""
    values = np.column_stack([source, moving.time, moving.points, moving.range_rate])
    values = np.nan_to_num(values[np.lexsort(values.T)])
    return float((np.diff(values, axis=0) == 0.0).all(axis=1).sum() / max(len(values), 1))


def iso(time: float) -> str:
    """Format a time (UNIX seconds) as ISO 8601 text for a message."""
    return iso_from_step(int(step_of(np.array(time))))

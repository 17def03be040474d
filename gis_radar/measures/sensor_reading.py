"""Read the frames of one sensor in the window of an hour, and the tiles that they hit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gis_radar.base import STEP_S, STEP_US, Floats, InputError, Integers, iso_from_step, step_of
from gis_radar.hdmap import Numbers, TileGrid
from gis_radar.measures.counting_loop import FRAME_POSE, TILES_HIT, TIME_US
from gis_radar.measures.filters import Filters
from gis_radar.measures.frame_hash import HashedFrames, hash_frames
from gis_radar.measures.frames import rows_of, whole_frames
from gis_radar.measures.hit_counter import NO_TILES, Counted, HitCounter, rows_of_detections
from gis_radar.measures.hour import LONGEST_VALID_STEPS, HourWindow
from gis_radar.measures.placing import PoseNumbers
from gis_radar.measures.pose_sights import PlacedRecording, PoseSight, first_since_move
from gis_radar.measures.validity import FrameTimes
from gis_radar.recordings import Detections, RangeCounts, has_height
from gis_radar.scans import SightTiles

_NEVER_US = -(2**62)  # a time before all others


@dataclass(frozen=True, kw_only=True)
class HitTarget:
    """Tiles that detections are assigned to, and filters, the same for all recordings.

    Parameters
    ----------
    road : SightTiles
        All tiles, by ascending id.
    grid : TileGrid
        Grid of the same tiles.
    filters : Filters
        Filters for the detections that count.
    rcs : bool
        Whether radar cross sections are read; the frames' hashes then include them.
    """

    road: SightTiles
    grid: TileGrid
    filters: Filters
    rcs: bool


@dataclass(kw_only=True)
class RecordingCounts:
    """Counts of a recording for remarks about it, over one hour or more.

    Parameters
    ----------
    rows, hits : int
        Number of rows, and of hits of a tile by a frame.
    times : FrameTimes
        First and last frame, and the gaps between frames.
    ranges : (r,) int64 array
        Number of detections by range, as in :class:`RangeCounts`.
    lacks_elevation : bool
        Whether the sensor measures no elevation.
    movement : dict
        Number of frames with movement on each tile, by the name of the first sight since the sensor
        was moved last.
    frames : dict
        Number of all frames, by the same name.
    repeated : int
        Number of frames that are equal to an earlier one of the sensor in the hour's window.
    """

    rows: int = 0
    hits: int = 0
    times: FrameTimes = field(default_factory=FrameTimes)
    ranges: Integers = field(default_factory=lambda: RangeCounts().counts)
    lacks_elevation: bool = False
    movement: dict[str, Integers] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    repeated: int = 0

    def add(self, counts: RecordingCounts) -> None:
        """Add the counts of another hour."""
        self.rows, self.hits = self.rows + counts.rows, self.hits + counts.hits
        self.times.join(counts.times)
        self.ranges = self.ranges + counts.ranges
        self.lacks_elevation |= counts.lacks_elevation
        self.repeated += counts.repeated
        for sight, count in counts.movement.items():
            self.movement[sight] = self.movement.get(sight, 0) + count
        for sight, frames in counts.frames.items():
            self.frames[sight] = self.frames.get(sight, 0) + frames


@dataclass(frozen=True, kw_only=True)
class SensorHour:
    """The frames of a sensor in a window, and the tiles that they hit.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    sources : sequence of PlacedRecording
        Its recordings, by their first frame.
    frames : HashedFrames
        All frames of the window, each once.
    source, pose : (f,) int64 arrays
        For each frame, the number of its recording, and that of the pose in force in its track.
    counted : (g, 7) int64 array
        The frames of the hour and just before it, with the columns of
        :mod:`gis_radar.measures.counting_loop`.
    tile : list of int32 arrays
        Positions of the tiles that these frames hit, frame by frame.
    evidence : list of RecordingCounts
        Counts of each recording.
    """

    sensor: str
    sources: Sequence[PlacedRecording]
    frames: HashedFrames
    source: Integers
    pose: Integers
    counted: Integers
    tile: list[Numbers]
    evidence: list[RecordingCounts]

    @property
    def sights(self) -> list[PoseSight]:
        """Sights of all poses of all sources, one after the other."""
        return [sight for source in self.sources for sight in source.sights]

    @property
    def place(self) -> Integers:
        """Index into :attr:`sights` of the pose in force at each frame of the window."""
        begins = np.cumsum([0, *(len(source.sights) for source in self.sources)])
        return np.asarray(begins[self.source] + self.pose)


def read_sensor(
    sources: Sequence[PlacedRecording],
    window: HourWindow,
    target: HitTarget,
    *,
    count_hits: bool = True,
) -> SensorHour:
    """Read the recordings of a sensor in the window of an hour.

    Frames that two recordings hold of the same time must be equal, and count once.

    Parameters
    ----------
    sources : sequence of PlacedRecording
        All recordings of one sensor, by their first frame.
    window : HourWindow
        The hour.
    target : HitTarget
        Tiles and filters.
    count_hits : bool
        Whether to count hits, or only to read the frames.

    Raises
    ------
    InputError
        If a recording is damaged, or two differ in the time that both hold.
    """
    readings: list[_Reading] = []
    for source in sources:
        until = max((each.last_us for each in readings), default=_NEVER_US)
        reading = _Reading(source=source, window=window, target=target, until_us=until)
        reading.read(count_hits=count_hits)
        _refuse_difference(reading, readings)
        readings.append(reading)
    counted = [frames for part in readings for frames in part.counted]
    return SensorHour(
        sensor=sources[0].track.sensor,
        sources=sources,
        frames=HashedFrames.join([part.fresh for part in readings]),
        source=np.repeat(np.arange(len(readings)), [len(part.fresh) for part in readings]),
        pose=np.concatenate([NO_TILES, *(part.poses() for part in readings)]),
        counted=np.concatenate([np.empty((0, FRAME_POSE + 1), np.int64), *counted]),
        tile=[tile for part in readings for tile in part.tile],
        evidence=[part.evidence for part in readings],
    )


@dataclass(kw_only=True)
class _Reading:
    """The frames of one recording in the window, and the tiles that they hit."""

    source: PlacedRecording
    window: HourWindow
    target: HitTarget
    until_us: int  # time up to which earlier recordings of the sensor count
    frames: HashedFrames = field(default_factory=lambda: HashedFrames.join([]))
    counted: list[Integers] = field(default_factory=list)
    tile: list[Numbers] = field(default_factory=list)
    evidence: RecordingCounts = field(default_factory=RecordingCounts)

    @property
    def last_us(self) -> int:
        return int(self.frames.time_us[-1]) if len(self.frames) else _NEVER_US

    @property
    def fresh(self) -> HashedFrames:
        """The frames that no earlier recording holds."""
        return self.frames.take(self.frames.time_us > self.until_us)

    def poses(self) -> Integers:
        """Return the index of the pose of the track in force at each fresh frame."""
        return self.source.track.at(self.fresh.time)

    def read(self, *, count_hits: bool) -> None:
        """Read the rows of the window; count hits of frames that may be valid in the hour."""
        hashed: list[HashedFrames] = []
        counter = _Counter(self)
        first_us, after_us = self.window.span_us
        since_us = (self.window.begin - LONGEST_VALID_STEPS) * STEP_US
        for rows, time, shift_us in self._batches():
            begin, end = rows_between(time, first_us, after_us)
            of_window = rows_of(rows, slice(begin, end))
            hashed.append(hash_frames(time[begin:end], of_window, rcs=self.target.rcs))
            low, high = rows_between(
                time, max(since_us, self.until_us + 1), self.window.end * STEP_US
            )
            if count_hits and low < high:
                counter.add(rows, time, shift_us, low, high)
        counter.end()
        self.frames = HashedFrames.join(hashed)

    def _batches(self) -> Iterator[tuple[Detections, Floats, Integers]]:
        """Yield whole frames around the window, with corrected times (s) and corrections (us)."""
        clock = self.source.clock
        first, after = self.window.span
        limits = np.array([first - 1, after + 1]) * STEP_S
        begin, end = limits if clock is None else clock.shown(limits)
        for rows in whole_frames(self.source.recording.read_between(float(begin), float(end))):
            if clock is None:
                yield rows, rows.time, NO_TILES
                continue
            time = clock.corrected(rows.time)
            step_of(time[[0, -1]])  # refuses times outside the known years
            yield rows, time, np.rint((time - rows.time) * 1e6).astype(np.int64)


class _Counter:
    """Counter of the hits of a recording."""

    def __init__(self, reading: _Reading) -> None:
        self._reading, target = reading, reading.target
        self._ranges = RangeCounts()
        self._counter = HitCounter(
            target.road, target.grid, filters=target.filters,
            ranges=self._ranges,
        )  # fmt: skip
        self._placed: dict[int, PoseNumbers] = {}
        self._places = first_since_move(reading.source.track.poses)

    def add(
        self, detections: Detections, time: Floats, shift_us: Integers, low: int, high: int
    ) -> None:
        """Count rows that follow those so far."""
        reading = self._reading
        source, evidence = reading.source, reading.evidence
        rows = rows_of_detections(detections, time, shift_us)
        for index, begin, end in source.track.runs(time[low:high]):
            counter = evidence.movement.setdefault(
                source.sights[self._places[index]].name,
                np.zeros(len(reading.target.road.tile_id), np.int64),
            )
            placing = self._placing(index)
            first, last = low + begin, low + end
            for counted in self._counter.add(rows, first, last, placing, movement=counter):
                self._take(counted)
        if detections.present.any():
            evidence.lacks_elevation |= not has_height(detections)
        evidence.rows += high - low

    def _placing(self, index: int) -> PoseNumbers:
        if index not in self._placed:
            source = self._reading.source
            pose, road_m = source.track.poses[index], source.sights[index].road_m
            self._placed[index] = PoseNumbers.of(pose, road_m=road_m, number=index)
        return self._placed[index]

    def end(self) -> None:
        """Close the open frame."""
        reading = self._reading
        self._take(self._counter.end())
        reading.evidence.ranges = self._ranges.counts
        for frames in reading.counted:
            of_hour = frames[frames[:, TIME_US] >= reading.window.begin * STEP_US]
            if len(of_hour):
                reading.evidence.times.add(of_hour[:, TIME_US])
                reading.evidence.hits += int(of_hour[:, TILES_HIT].sum())
            for index, count in zip(
                *np.unique(of_hour[:, FRAME_POSE], return_counts=True), strict=True
            ):
                sight = reading.source.sights[self._places[index]].name
                frames_of_sight = reading.evidence.frames
                frames_of_sight[sight] = frames_of_sight.get(sight, 0) + int(count)

    def _take(self, counted: Counted) -> None:
        self._reading.counted.append(counted.frames)
        self._reading.tile.append(counted.tile)


def rows_between(time: Floats, first_us: int, after_us: int) -> tuple[int, int]:
    """Return begin and end of the rows, of ascending times (s), in [`first_us`, `after_us`)."""
    edges = np.rint(time[[0, -1]] * 1e6)
    if edges[0] >= first_us and edges[1] < after_us:
        return 0, len(time)
    begin, end = np.searchsorted(np.rint(time * 1e6), [first_us, max(first_us, after_us)])
    return int(begin), int(end)


def _refuse_difference(reading: _Reading, earlier: Sequence[_Reading]) -> None:
    """Refuse a recording that differs from earlier ones in the time that they share."""
    repeated = reading.frames.take(reading.frames.time_us <= reading.until_us)
    if len(repeated) == 0:
        return
    earlier_frames = HashedFrames.join([each.fresh for each in earlier])
    first, last = int(repeated.time_us[0]), min(reading.until_us, reading.last_us)
    known_frames = earlier_frames.take(
        (earlier_frames.time_us >= first) & (earlier_frames.time_us <= last)
    )
    length = min(len(known_frames), len(repeated))
    is_different = (known_frames.time_us[:length] != repeated.time_us[:length]) | (
        known_frames.hash[:length] != repeated.hash[:length]
    )
    if len(known_frames) == len(repeated) and not is_different.any():
        return
    place = int(is_different.argmax()) if is_different.any() else length
    at_us = int(min(each.time_us[place] for each in (known_frames, repeated) if place < len(each)))
    other_path = next(
        each.source.recording.path for each in reversed(earlier)
        if len(each.frames) and each.frames.time_us[0] <= at_us
    )  # fmt: skip
    raise InputError(
        "{}: differs from {} at {}: both are of {}",
        reading.source.recording.path,
        other_path,
        iso_from_step(at_us // STEP_US),
        reading.source.track.sensor,
        hint="leave one of them away, or cut it where the other begins",
    )

"""Registry of a dataset: its recordings, the poses of their sensors, and the poses' sights.

`recordings.parquet` is the state of a dataset: it lists by recording the hours that were made with
it. An hour that a recording reaches into and does not list has to be made again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import (
    STEP_US,
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    InputError,
    Text,
    iso_from_step,
    step_of,
)
from gis_radar.calibration import SensorClock
from gis_radar.dataset.files.parts import (
    digest_of,
    hour_of_step,
    single_file,
    write_single_file,
)
from gis_radar.dataset.files.pose_book import PoseBook
from gis_radar.dataset.files.tables import RECORDINGS
from gis_radar.measures import PlacedRecording, PoseSight, digest_of_sights
from gis_radar.poses import PoseTrack
from gis_radar.recordings import Recording, has_height, open_recording

_LONGEST_GAP_S = 24 * 3600.0
"""Longest time without frames within a recording; in a longer gap its clock was set."""
# Least share of detections with range rates; formats have them of all or of none
_LEAST_RATES = 0.5


@dataclass(frozen=True, kw_only=True)
class RecordingEntry:
    """A recording of a dataset: a row of `recordings`.

    Parameters
    ----------
    path, digest : str
        The file, and the SHA-256 of its bytes.
    sensor, pose : str
        Name of the sensor, and of its pose or pose track.
    first_time, last_time : float
        First and last frame, UNIX seconds, corrected.
    clock_offset, clock_drift_ppm, clock_at : float
        As in :class:`gis_radar.calibration.SensorClock`; all 0 where its clock is right.
    validity_s : float
        How long its frames are valid, seconds.
    rows : int
        Number of rows of the file.
    has_rates, has_elevation : bool
        Whether it has range rates, and measures elevation.
    hours : frozenset of int
        Hours since 1970 that were made with it.
    sights : str, optional
        Digest of the sights of its poses; None while they are being replaced.
    """

    path: str
    digest: str
    sensor: str
    pose: str
    first_time: float
    last_time: float
    clock_offset: float = 0.0
    clock_drift_ppm: float = 0.0
    clock_at: float = 0.0
    validity_s: float
    rows: int
    has_rates: bool
    has_elevation: bool
    hours: frozenset[int] = frozenset()
    sights: str | None = None

    @property
    def key(self) -> tuple[str, float, str]:
        """Sort key: sensor, first frame, digest."""
        return self.sensor, self.first_time, self.digest

    @property
    def clock(self) -> SensorClock | None:
        """The sensor's clock; None where it is right."""
        if self.clock_offset == 0.0 and self.clock_drift_ppm == 0.0:
            return None
        return SensorClock(
            offset_s=self.clock_offset, drift_ppm=self.clock_drift_ppm, at=self.clock_at
        )

    @cached_property
    def steps(self) -> tuple[int, int]:
        """First and last step with a frame."""
        first, last = (round(time * 1e6) // STEP_US for time in (self.first_time, self.last_time))
        return first, last

    @property
    def own_hours(self) -> range:
        """The hours from its first to its last frame."""
        first, last = map(hour_of_step, self.steps)
        return range(first, last + 1)

    def reached_hours(self, margin: int) -> range:
        """Return the hours whose window, with `margin` steps, overlaps the time of its frames."""
        first, last = self.steps
        return range((first - margin) // STEPS_PER_HOUR, (last + margin) // STEPS_PER_HOUR + 1)

    def has_same_inputs(self, other: RecordingEntry) -> bool:
        """Return whether another entry has the same rows, pose and clock."""
        return replace(self, path="", hours=frozenset()) == replace(
            other, path="", hours=frozenset()
        )


@dataclass(frozen=True, kw_only=True)
class Registry:
    """Recordings and poses of a dataset.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    fingerprint : str
        Fingerprint of its tiles.
    entries : tuple of RecordingEntry
        The recordings, sorted by sensor, first frame and digest.
    poses : PoseBook
        Poses of all recordings.
    """

    folder: Path
    fingerprint: str
    entries: tuple[RecordingEntry, ...] = ()
    poses: PoseBook = field(default_factory=PoseBook)

    @classmethod
    def read(
        cls, folder: Path, fingerprint: str, *, hour: int | None = None, margin: int = 0
    ) -> Registry:
        """Read the registry of a dataset, or its recordings that reach into one hour.

        Parameters
        ----------
        folder : Path
            Folder of the dataset.
        fingerprint : str
            Fingerprint of its tiles.
        hour : int, optional
            The hour since 1970.
        margin : int
            Steps on either side of the hour.

        Raises
        ------
        InputError
            If a table is damaged, or of another dataset.
        """
        recordings = single_file(RECORDINGS, folder, fingerprint).read()
        book = PoseBook.read(folder, fingerprint, recordings)
        if hour is not None:  # a year's recordings as Python objects take seconds
            recordings = recordings.filter(_near_hour(recordings, hour, margin))
        try:
            entries = [
                RecordingEntry(**{**row, "hours": frozenset(row["hours"])})
                for row in recordings.to_pylist()
            ]
            if hour is not None:
                entries = [each for each in entries if hour in each.reached_hours(margin)]
            used = book.of(each.pose for each in entries)  # raises KeyError if one is missing
            digests = {name: digest_of_sights(each) for name, each in used.sights.items()}
            entries = [  # None where `measure` was killed before it wrote them
                replace(each, sights=digests[each.pose]) if each.sights is None else each
                for each in entries
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("{}: damaged: {}", folder, f"{error!r:.200}") from error
        entries.sort(key=attrgetter("key"))
        return cls(folder=folder, fingerprint=fingerprint, entries=tuple(entries), poses=book)

    def write_poses(self, poses: PoseBook) -> None:
        """Write poses and their sights, replacing the present tables."""
        poses.write(self.folder, self.fingerprint)

    def write_recordings(self) -> None:
        """Write the table of recordings, with the hours that were made with each."""
        entries = sorted(self.entries, key=attrgetter("key"))
        table = {name: list(map(attrgetter(name), entries)) for name in RECORDINGS.names}
        table["hours"] = list(map(sorted, table["hours"]))
        write_single_file(RECORDINGS, self.folder, table, self.fingerprint)

    @property
    def hours(self) -> list[int]:
        """The hours that the dataset must have: from the first to the last of each recording."""
        return sorted({hour for each in self.entries for hour in each.own_hours})

    def by_hour(self, margin: int) -> dict[int, list[RecordingEntry]]:
        """Return for each hour the recordings that reach into its window, in their order."""
        entries: dict[int, list[RecordingEntry]] = {}
        for each in self.entries:
            for hour in each.reached_hours(margin):
                entries.setdefault(hour, []).append(each)
        return entries

    def missing_hours(self, margin: int) -> list[int]:
        """Return the hours that have to be made."""
        reaching = self.by_hour(margin)
        return [
            hour for hour in self.hours if any(hour not in each.hours for each in reaching[hour])
        ]

    def without_hours(self, hours: Iterable[int]) -> Registry:
        """Return the registry without some hours, which are then made again."""
        gone = frozenset(hours)
        entries = (
            each if gone.isdisjoint(each.hours) else replace(each, hours=each.hours - gone)
            for each in self.entries
        )
        return replace(self, entries=tuple(entries))

    def with_hours(self, hours: Iterable[int], margin: int) -> Registry:
        """Return the registry with some hours as made with all recordings that reach into them."""
        made = frozenset(hours)
        entries = []
        for each in self.entries:
            more = made.intersection(each.reached_hours(margin)) - each.hours
            entries.append(replace(each, hours=each.hours | more) if more else each)
        return replace(self, entries=tuple(entries))

    def placing(self, entry: RecordingEntry) -> Placing:
        """Return a recording with its poses."""
        return entry, self.poses.tracks[entry.pose], self.poses.sights[entry.pose]


def _near_hour(recordings: pa.Table, hour: int, margin: int) -> pa.ChunkedArray:
    """Return which recordings have frames in an hour, its margin and a second on either side."""
    around_s = margin / STEPS_PER_SECOND + 1.0
    begin_s = hour * 3600.0
    return pc.and_(
        pc.less_equal(recordings["first_time"], begin_s + 3600.0 + around_s),
        pc.greater_equal(recordings["last_time"], begin_s - around_s),
    )


Placing: TypeAlias = tuple[RecordingEntry, PoseTrack, Sequence[PoseSight]]
"""A recording, its pose track, and the sight of each pose."""


def source_of(
    entry: RecordingEntry, track: PoseTrack, sights: Sequence[PoseSight]
) -> PlacedRecording:
    """Open a recording with its poses, clock and validity."""
    return PlacedRecording(
        recording=open_recording(entry.path), track=track, track_name=entry.pose, sights=sights,
        clock=entry.clock,
    )  # fmt: skip


def touched_hours(
    hours: Iterable[int], entries: Iterable[RecordingEntry], margin: int
) -> list[int]:
    """Return those of some hours into which recordings reach, ascending."""
    reached = {hour for each in entries for hour in each.reached_hours(margin)}
    return sorted(reached.intersection(hours))


def validity_by_sensor(entries: Iterable[RecordingEntry]) -> dict[str, float]:
    """Return how many seconds the frames of each sensor are valid.

    Raises
    ------
    InputError
        If recordings of a sensor state different times.
    """
    first_entries: dict[str, RecordingEntry] = {}
    for entry in entries:
        earlier = first_entries.setdefault(entry.sensor, entry)
        if earlier.validity_s != entry.validity_s:
            raise InputError(
                "{}: frames of {} are valid for {:g} ms, those of {} for {:g} ms",
                entry.path,
                entry.sensor,
                1000 * entry.validity_s,
                earlier.path,
                1000 * earlier.validity_s,
                hint=Text("state the same {} for all recordings of a sensor, or none", "--cycle"),
            )
    return {sensor: each.validity_s for sensor, each in first_entries.items()}


def refuse_two_sensors(entry: RecordingEntry, other: RecordingEntry) -> None:
    """Refuse a recording that is given for two sensors.

    Raises
    ------
    InputError
        Always.
    """
    raise InputError(
        "{}: is given for {}, and for {} as {}",
        entry.path,
        entry.sensor,
        other.sensor,
        other.path,
        hint="give each sensor its own recording",
    )


def entry_of(source: PlacedRecording, validity_s: float) -> RecordingEntry:
    """Read a recording's entry: digest, time, rows, whether it has range rates and elevation.

    Raises
    ------
    InputError
        If it cannot be read, or its times jump by more than a day.
    """
    recording, clock = source.recording, source.clock
    path = Path(recording.path).resolve()
    first, last, rows, has_rates, has_elevation = _read_summary(recording)
    times = np.array([first, last])
    begin, end = (times if clock is None else clock.corrected(times)).tolist()
    step_of(np.array([begin, end]))
    stated_clock = SensorClock(offset_s=0.0) if clock is None else clock
    is_right = stated_clock.offset_s == 0.0 and stated_clock.drift_ppm == 0.0
    return RecordingEntry(
        path=path.as_posix(), digest=digest_of(path), sensor=source.track.sensor,
        pose=source.track_name, sights=digest_of_sights(source.sights), first_time=begin,
        last_time=end, clock_offset=stated_clock.offset_s, clock_drift_ppm=stated_clock.drift_ppm,
        clock_at=0.0 if is_right else stated_clock.at, validity_s=validity_s, rows=rows,
        has_rates=has_rates, has_elevation=has_elevation,
    )  # fmt: skip


def _read_summary(recording: Recording) -> tuple[float, float, int, bool, bool]:
    """Return first and last time, rows, and whether detections have range rates and elevation."""
    spans = recording.time_spans() if recording.time_spans is not None else None
    stated = spans is not None and all(last - first <= _LONGEST_GAP_S for first, last in spans)
    first = last = math.nan
    rows, has_rates, has_elevation, detections, rates = 0, False, True, 0, 0
    for batch in recording.read():
        time = batch.time if rows == 0 else np.concatenate([[last], batch.time])
        if len(gap := np.flatnonzero(np.diff(time) > _LONGEST_GAP_S)):
            _refuse_gap(recording, *time[gap[0] : gap[0] + 2].tolist())
        first, last = (float(time[0]) if rows == 0 else first), float(time[-1])
        rows += len(batch)
        if detections == 0 and batch.present.any():
            has_elevation = has_height(batch)
        detections += int(batch.present.sum())
        rates += int(np.isfinite(batch.range_rate[batch.present]).sum())
        has_rates = rates > _LEAST_RATES * detections
        if stated and has_rates:
            break
    if stated and spans is not None and recording.rows is not None:
        for (_, before), (after, _) in pairwise(spans):
            if after - before > _LONGEST_GAP_S:
                _refuse_gap(recording, before, after)
        first, last, rows = spans[0][0], spans[-1][1], recording.rows
    return first, last, rows, has_rates or detections == 0, has_elevation


def _refuse_gap(recording: Recording, last: float, then: float) -> None:
    before, after = (iso_from_step(int(step)) for step in step_of(np.array([last, then])))
    raise InputError(
        "{}: its times jump from {} to {}",
        recording.path,
        before,
        after,
        hint="convert and name recordings of different days one by one; or, if the sensor's clock "
        "was set, cut it there",
    )


def refuse_swapped(recordings: Sequence[Recording], tracks: Sequence[PoseTrack]) -> None:
    """Refuse a recording that is named like a sensor, but given for another one.

    The name is the file's or, where that is no sensor's, the one that `convert` wrote into it.
    """
    sensors = {track.sensor for track in tracks}
    stems = [Path(each.path).stem for each in recordings]
    names = [
        stem if stem in sensors else each.sensor
        for stem, each in zip(stems, recordings, strict=True)
    ]
    own = {named for named, track in zip(names, tracks, strict=True) if named == track.sensor}
    others = sensors - own
    for recording, named, track in zip(recordings, names, tracks, strict=True):
        if named in others and named != track.sensor:
            raise InputError(
                "{}: is given with the pose of {}, beside one of {}",
                recording.path,
                track.sensor,
                named,
                hint="name recordings and poses in the same order",
            )

"""The way of each sensor's frames through clock and order to a recording, and what came of it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from gis_radar.errors import InputError
from gis_radar.formats.frame_times import Clock, FrameClock
from gis_radar.formats.frames import Frame, Reading, counted
from gis_radar.formats.order import Doubles, FrameOrder
from gis_radar.formats.recorder import RecordingFile


@dataclass(frozen=True, kw_only=True)
class SensorRecording:
    """What became of one sensor's frames.

    Parameters
    ----------
    path : Path
        The recording.
    sensor : str
        Source address, topic or name.
    frames, empty_frames, detections : int
        How many are in it.
    begin, end : float
        UNIX seconds of the first and the last frame.
    clock : str
        Whose times they are: `sensor`, `recorder`, or `sensor, then recorder`.
    """

    path: Path
    sensor: str
    frames: int
    empty_frames: int
    detections: int
    begin: float
    end: float
    clock: str


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What became of the inputs.

    Parameters
    ----------
    recordings : tuple of SensorRecording
        One a sensor.
    left_out : mapping of str to int
        What was dropped or mended, by kind.
    """

    recordings: tuple[SensorRecording, ...]
    left_out: Mapping[str, int]

    @property
    def outputs(self) -> list[Path]:
        """The files."""
        return [recording.path for recording in self.recordings]

    def figures(self) -> dict[str, Any]:
        """Return what is worth a look, by name."""
        recordings = self.recordings
        return {
            "sensors": [recording.sensor for recording in recordings],
            "clock": [recording.clock for recording in recordings],
            "begin": _iso(min(recording.begin for recording in recordings)),
            "end": _iso(max(recording.end for recording in recordings)),
            "frames": sum(recording.frames for recording in recordings),
            "empty_frames": sum(recording.empty_frames for recording in recordings),
            "detections": sum(recording.detections for recording in recordings),
            **self.left_out,
        }

    def __repr__(self) -> str:
        told = self.figures()
        files = ", ".join(str(path) for path in self.outputs)
        return (
            f"Conversion({files}: {told['frames']} frames, {told['detections']} detections, "
            f"{told['begin']} to {told['end']})"
        )


class _Track:
    """One sensor's way from frames as they come to rows of its recording."""

    def __init__(self, sensor: str, file: RecordingFile, clock: Clock, reading: Reading) -> None:
        self.file = file
        self.clock = FrameClock(sensor, clock, reading.reporter)
        self.doubles = Doubles()
        self.order = FrameOrder(sensor)
        self._counts = reading.counts

    def put(self, frame: Frame) -> None:
        if self.doubles.is_new(frame):
            self._put_in_order(self.clock.feed(frame.sound(self._counts)))

    def finish(self) -> None:
        self._put_in_order(self.clock.finish())
        self._write(self.order.finish())
        self.file.close()

    def _put_in_order(self, timed: Iterator[tuple[float, Frame]]) -> None:
        for time, frame in timed:
            self._write(self.order.put(time, frame))

    def _write(self, timed: Iterator[tuple[float, Frame]]) -> None:
        for time, frame in timed:
            self.file.add(time, frame)


class Tracks:
    """The sensors of a conversion, as they turn up.

    Parameters
    ----------
    folder : Path
        Where their recordings grow.
    place : Path
        Where the recording shall be, or what those of several sensors are named after.
    clock : str
        Whose times count.
    reading : Reading
        What readers are told, and where they count.
    """

    def __init__(self, folder: Path, place: Path, clock: Clock, reading: Reading) -> None:
        self._folder, self._place = folder, place
        self._clock, self._reading = clock, reading
        self._tracks: dict[str, _Track] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for track in self._tracks.values():
            track.file.abandon()

    @property
    def parts(self) -> list[Path]:
        """The files as they grow, a sensor each."""
        return [track.file.path for track in self._tracks.values()]

    def put(self, frame: Frame) -> None:
        """Take the next frame of whichever sensor."""
        track = self._tracks.get(frame.sensor)
        if track is None:
            part = self._folder / f"{len(self._tracks)}.parquet"
            file = RecordingFile(part, self._place)
            track = _Track(frame.sensor, file, self._clock, self._reading)
            self._tracks[frame.sensor] = track
        track.put(frame)

    def finish(self) -> Conversion:
        """Finish all recordings."""
        if not self._tracks:
            raise InputError(
                "no usable frame in the inputs",
                hint=f"left out: {counted(self._reading.counts) or 'nothing'}",
            )
        for sensor, track in self._tracks.items():
            track.finish()
            if track.file.left_out:
                columns = ", ".join(sorted(track.file.left_out))
                said = f"{sensor}: columns that came late are left out: {columns}"
                self._reading.reporter.log(said, "warning")
        counts = Counter(self._reading.counts)
        for track in self._tracks.values():
            counts["duplicates"] += track.doubles.count
            counts["reordered_frames"] += track.order.late
        recordings = tuple(
            SensorRecording(
                path=path,
                sensor=sensor,
                frames=track.file.frames,
                empty_frames=track.file.empty_frames,
                detections=track.file.detections,
                begin=track.file.begin,
                end=track.file.end,
                clock=", then ".join(track.clock.used),
            )
            for path, (sensor, track) in zip(
                _places(self._place, list(self._tracks)), self._tracks.items(), strict=True
            )
        )
        return Conversion(recordings=recordings, left_out=dict(sorted((+counts).items())))


def _places(place: Path, sensors: list[str]) -> list[Path]:
    """Return where the recordings go: `place` itself, or for several sensors beside it."""
    if len(sensors) == 1:
        return [place]
    words = [re.sub(r"[^\w.-]+", "_", sensor).strip("_.") or "sensor" for sensor in sensors]
    if len(set(words)) < len(words):  # two sensors may have one name once it is fit for a file
        words = [f"{word}_{number}" for number, word in enumerate(words)]
    return [place.with_name(f"{place.stem}.{word}{place.suffix}") for word in words]


def _iso(time: float) -> str:
    text = datetime.fromtimestamp(time, tz=UTC).isoformat(timespec="milliseconds")
    return text.replace("+00:00", "Z")

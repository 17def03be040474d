"""Convert inputs of any known format to recordings: one Parquet file for each sensor."""

from __future__ import annotations

import re
from collections import Counter, OrderedDict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    OutputError,
    Reporter,
    Text,
    UsageError,
    atomic_writes,
    first_line,
    placed,
    refuse_inputs,
)
from gis_radar.recordings.formats import format_of
from gis_radar.recordings.frame_clock import CLOCKS, Clock, FrameClock
from gis_radar.recordings.frame_order import REORDERED_FRAMES, FrameOrder, merged
from gis_radar.recordings.frames import Format, Frame, ReaderContext, counts_text
from gis_radar.recordings.recording_file import RecordingFile


@dataclass(frozen=True, kw_only=True)
class SensorRecording:
    """Recording of one sensor, as written.

    Parameters
    ----------
    path : Path
        The recording.
    sensor : str
        Source address, topic or name.
    frames, empty_frames, detections : int
        Numbers of them in it.
    begin, end : float
        UNIX seconds of the first and the last frame.
    clock : str
        Source of the times: `sensor` (its own clock), `header stamp` (which may be by the sensor's
        clock, or by that of the computer at arrival), `file name`, `time column`, `recorder`;
        `sensor at the recorder's rate` where its clock ran slow or fast; `sensor, then recorder`
        where the source changed.
    elevation : bool
        Whether the sensor measures elevation; if not, z is NaN throughout.
    """

    path: Path
    sensor: str
    frames: int
    empty_frames: int
    detections: int
    begin: float
    end: float
    clock: str
    elevation: bool = True


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """Result of a conversion.

    Parameters
    ----------
    recordings : tuple of SensorRecording
        One a sensor.
    left_out : mapping of str to int
        Numbers of what was dropped or mended, by kind.
    remarks : tuple of str
        How unclear fields were read, and what is not known.
    """

    recordings: tuple[SensorRecording, ...]
    left_out: Mapping[str, int]
    remarks: tuple[str, ...] = ()

    @property
    def outputs(self) -> list[Path]:
        """The files."""
        return [recording.path for recording in self.recordings]

    def figures(self) -> dict[str, Any]:
        """Return key figures by name."""
        recordings = self.recordings
        return {
            "sensors": [recording.sensor for recording in recordings],
            "clock": [recording.clock for recording in recordings],
            **(
                {}
                if all(recording.elevation for recording in recordings)
                else {"elevation": [recording.elevation for recording in recordings]}
            ),
            "begin": _iso(min(recording.begin for recording in recordings)),
            "end": _iso(max(recording.end for recording in recordings)),
            "frames": sum(recording.frames for recording in recordings),
            "empty_frames": sum(recording.empty_frames for recording in recordings),
            "detections": sum(recording.detections for recording in recordings),
            **self.left_out,
            **({"remarks": list(self.remarks)} if self.remarks else {}),
        }

    def __repr__(self) -> str:
        shown = self.figures()
        files = ", ".join(str(path) for path in self.outputs)
        return (
            f"Conversion({files}: {shown['frames']} frames, {shown['detections']} detections, "
            f"{shown['begin']} to {shown['end']})"
        )


_NO_ELEVATION = Text(
    "measures no elevation (z is missing or 0 throughout): x and y are at the slant "
    "range; height, pitch, roll and clearance cannot be had from it"
)
_IDENTITIES_KEPT = 4 * REORDERED_FRAMES  # latest frames among which duplicates are found
# Share of a sensor's frames at which an earlier input goes on after another one, from which on to
# warn that inputs are of several sensors: a second recorder of one sensor only fills gaps.
_ALTERNATING = 0.1


class _SensorFrames:
    """Writer of one sensor's frames: drops duplicates, gives times, sorts, and writes."""

    def __init__(
        self, sensor: str, file: RecordingFile, clock: Clock, context: ReaderContext
    ) -> None:
        self.file = file
        self.clock = FrameClock(sensor, clock, context.reporter)
        self.duplicates = self.alternations = 0
        self._input: int | None = None
        self._inputs = set[int]()
        self._identities: OrderedDict[object, None] = OrderedDict()
        self.order = FrameOrder(sensor)
        self._counts = context.counts

    def put(self, frame: Frame, number: int) -> None:
        if frame.identity is not None:
            if frame.identity in self._identities:
                self.duplicates += 1
                return
            self._identities[frame.identity] = None
            if len(self._identities) > _IDENTITIES_KEPT:
                self._identities.popitem(last=False)
        self.alternations += number != self._input and number in self._inputs
        self._input = number
        self._inputs.add(number)
        self._put_in_order(self.clock.feed(frame.without_unusable(self._counts)))

    def finish(self) -> None:
        self._put_in_order(self.clock.finish())
        for ready in self.order.finish():
            self.file.add(*ready)
        self.file.close()

    def _put_in_order(self, timed: Iterator[tuple[float, Frame]]) -> None:
        for time, frame in timed:
            for ready in self.order.put(time, frame):
                self.file.add(*ready)


def _remark(sensor: str, frames: _SensorFrames, context: ReaderContext) -> None:
    """Warn of what is odd in the frames of a sensor."""
    if frames.alternations > _ALTERNATING * frames.file.frames:
        context.reporter.warn(
            "{}: frames of several inputs alternate in time: are they of one sensor? Each "
            "sensor needs a recording of its own",
            sensor,
        )
    if frames.file.left_out:
        columns = ", ".join(sorted(frames.file.left_out))
        late = Text("{}: columns that came late are left out: {}", sensor, columns)
        context.reporter.warn(late)
    if frames.file.elevation is False:
        context.remark(Text("{}: {}", sensor, _NO_ELEVATION))


def _finished(
    by_sensor: Mapping[str, _SensorFrames], place: Path, context: ReaderContext
) -> Conversion:
    """Finish all recordings, by sensor in order of their first frames."""
    if not by_sensor:
        raise InputError(
            "no usable frame in the inputs",
            hint=Text("left out: {}", counts_text(context.counts) or "nothing"),
        )
    for sensor, sensor_frames in by_sensor.items():
        sensor_frames.finish()
        _remark(sensor, sensor_frames, context)
    counts = Counter(context.counts)
    left_out = counts["invalid_detections"] + counts["absurd_detections"]
    if left_out and not any(each.file.detections for each in by_sensor.values()):
        raise InputError(
            "no detection has a usable position",
            hint=Text("left out: {}", counts_text(counts)),
        )
    for sensor_frames in by_sensor.values():
        counts["duplicates"] += sensor_frames.duplicates
        counts["reordered_frames"] += sensor_frames.order.late
    recordings = tuple(
        SensorRecording(
            path=path,
            sensor=sensor,
            frames=sensor_frames.file.frames,
            empty_frames=sensor_frames.file.empty_frames,
            detections=sensor_frames.file.detections,
            begin=sensor_frames.file.begin,
            end=sensor_frames.file.end,
            clock=", then ".join(sensor_frames.clock.used),
            elevation=sensor_frames.file.elevation is not False,
        )
        for path, (sensor, sensor_frames) in zip(
            _output_paths(place, [*by_sensor]), by_sensor.items(), strict=True
        )
    )
    return Conversion(
        recordings=recordings,
        left_out=dict(sorted((+counts).items())),
        remarks=tuple(context.remarks),
    )


def _output_paths(place: Path, sensors: list[str]) -> list[Path]:
    """Return the path of each sensor's recording: `place`, or for several sensors beside it."""
    if len(sensors) == 1:
        return [place]
    words = [re.sub(r"[^\w.-]+", "_", sensor).strip("_.") or "sensor" for sensor in sensors]
    if len(set(words)) < len(words):  # names may be equal once they are fit for files
        words = [f"{word}_{number}" for number, word in enumerate(words)]
    return [place.with_name(f"{place.stem}.{word}{place.suffix}") for word in words]


def _iso(time: float) -> str:
    text = datetime.fromtimestamp(time, tz=UTC).isoformat(timespec="milliseconds")
    return text.replace("+00:00", "Z")


def convert(
    inputs: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    sensor: str | None = None,
    columns: Mapping[str, str] | None = None,
    time_unit: str = "s",
    clock: Clock = "auto",
    duration_s: float | None = None,
    reporter: Reporter = QUIET,
) -> Conversion:
    """Make recordings from radar data of any known format.

    Frames are put in order of time, duplicates and detections without a position are left out and
    counted, and frames without detections are kept. Memory does not grow with the length.

    Parameters
    ----------
    inputs : str, Path, or several
        Captures, bags, folders of point clouds, tables, or an address such as
        `udp://224.0.2.2:42102`. Several are merged by time.
    output : str or Path
        The recording, `.parquet`. Where the inputs have several sensors, each has a file of its
        own: `OUT.parquet` becomes `OUT.10.13.1.113.parquet`, and so on.
    sensor : str, optional
        Only this sensor (source address, topic).
    columns : mapping of str to str, optional
        Field by column of a recording, for clouds and tables; a leading minus turns the sign.
    time_unit : str
        Unit of times in tables: `s`, `ms`, `us` or `ns` since 1970.
    clock : str
        Clock that counts: `auto` takes the sensor's if it is right, else the recorder's.
    duration_s : float, optional
        Seconds to listen to an address; without it until Ctrl-C.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    UsageError
        If the options do not fit the inputs.
    InputError
        If an input is of no known format, damaged or without radar, or time goes back too far.
    OutputError
        If the recording cannot be written, or would replace an input.

    Examples
    --------
    >>> import gis_radar as gr
    >>> import pandas as pd
    >>> place = {"x": [20.0, 19.2], "y": [1.0, 1.0], "z": [-3.0, -3.0]}
    >>> frames = {"time": [1749713400.0, 1749713400.1], **place, "range_rate": -8.0, "rcs": 5.0}
    >>> pd.DataFrame(frames).to_csv("radar.csv", index=False)
    >>> gr.convert("radar.csv", "R1.parquet")
    Conversion(R1.parquet: 2 frames, 2 detections, 2025-06-12T07:30:00.000Z to ...)
    """
    sources = [inputs] if isinstance(inputs, str | Path) else list(inputs)  # addresses, too
    names, place = [str(source) for source in sources], Path(output)
    formats = [format_of(name) for name in names]
    _refuse_options(formats, place, clock=clock, duration_s=duration_s)
    refuse_inputs(place, *names)
    context = ReaderContext(
        columns=columns or {},
        time_unit=time_unit,
        sensor=sensor,
        duration_s=duration_s,
        reporter=reporter,
    )
    opened = [partial(_read, form, name) for form, name in zip(formats, names, strict=True)]
    inputs_text = names[0] + (Text(" and {} more", len(names) - 1) if len(names) > 1 else "")
    by_sensor: dict[str, _SensorFrames] = {}
    with atomic_writes(place) as (private, places), ExitStack() as unfinished:
        for number, frame in merged(opened, context):
            if (sensor_frames := by_sensor.get(frame.sensor)) is None:
                part = private / f"{len(by_sensor)}.parquet"
                file = RecordingFile(part, place, context.counts, sensor=frame.sensor)
                sensor_frames = by_sensor[frame.sensor] = _SensorFrames(
                    frame.sensor, file, clock, context
                )
                unfinished.callback(file.abandon)
            try:
                sensor_frames.put(frame, number)
            except InputError as error:  # not by `placed`, which would take a tenth of the time
                raise InputError("{}: {}", inputs_text, error.message, hint=error.hint) from error
        with placed(inputs_text):
            result = _finished(by_sensor, place, context)
        for sensor_frames, recording in zip(by_sensor.values(), result.recordings, strict=True):
            refuse_inputs(recording.path, *names)
            places[sensor_frames.file.path] = recording.path
    _report(result, reporter)
    return result


def _refuse_options(
    formats: list[Format], place: Path, *, clock: Clock, duration_s: float | None
) -> None:
    """Refuse options that do not fit the inputs or each other."""
    if not formats:
        raise UsageError("no input given")
    if clock not in CLOCKS:
        raise UsageError("clock is {}, expected one of {}", repr(clock), ", ".join(CLOCKS))
    if place.suffix.lower() != ".parquet":
        raise OutputError("{}: a recording is written as .parquet", place, hint="name it so")
    live = [form for form in formats if form.live]
    if live and len(formats) > 1:
        raise UsageError("an address cannot be merged with other inputs", hint="record it alone")
    if duration_s is not None and not live:
        raise UsageError("a duration is for an address; files end by themselves")
    if duration_s is not None and not duration_s > 0:
        raise UsageError("the duration is {:g} s, expected more than 0", duration_s)


def _read(form: Format, source: str, context: ReaderContext) -> Generator[Frame]:
    """Read an input; errors of the system and of libraries become an InputError that names it."""
    try:
        yield from form.frames(source, context)
    except GisRadarError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError("{}: cannot be read: {}", source, reason) from error
    except Exception as error:
        raise InputError("{}: damaged: {}", source, first_line(error)) from error


def _report(result: Conversion, reporter: Reporter) -> None:
    """Log what each recording holds, and what was left out."""
    if len(result.recordings) > 1:
        reporter.log(
            Text("{} sensors, a recording each ({} takes one)", len(result.recordings), "--sensor")
        )
    for recording in result.recordings:
        reporter.log(
            Text(
                "{}: {:,} frames, {:,} detections, clock: {}",
                recording.sensor,
                recording.frames,
                recording.detections,
                recording.clock,
            )
        )
    if result.left_out:
        reporter.log(Text("left out or mended: {}", counts_text(result.left_out)))

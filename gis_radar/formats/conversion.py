"""From files and sockets of any known format to recordings."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Generator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

from gis_radar.errors import InputError, OutputError, UsageError
from gis_radar.formats import readers
from gis_radar.formats.frame_times import CLOCKS, Clock
from gis_radar.formats.frames import Format, Frame, Reading, counted
from gis_radar.formats.order import merged
from gis_radar.formats.tracks import Conversion, Tracks
from gis_radar.outputs import refuse_inputs, whole_files
from gis_radar.progress import QUIET, Reporter


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

    Frames are put in order of time, doubles and detections without a position are left out and
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
        Our column to the field's name, for clouds and tables; a leading minus turns the sign.
    time_unit : str
        Unit of times in tables: `s`, `ms`, `us` or `ns` since 1970.
    clock : str
        Whose times count: `auto` takes the sensor's where they are right, else the recorder's.
    duration_s : float, optional
        How long to listen to an address; without it until Ctrl-C.
    reporter : Reporter
        Told of progress and of what is odd.

    Raises
    ------
    UsageError
        If the options do not fit the inputs.
    InputError
        If an input is of no known format, damaged or without radar, or time goes back too far.
    OutputError
        If the recording cannot be written, or would replace an input.
    """
    sources = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    names, place = [str(source) for source in sources], Path(output)
    formats = [format_of(name) for name in names]
    _refuse_options(formats, place, clock=clock, duration_s=duration_s)
    refuse_inputs(place, *names)
    reading = Reading(
        columns=columns or {},
        time_unit=time_unit,
        sensor=sensor,
        duration_s=duration_s,
        reporter=reporter,
    )
    opened = [partial(_read, form, name) for form, name in zip(formats, names, strict=True)]
    with (
        whole_files(place) as (private, places),
        Tracks(private, place, clock, reading) as tracks,
    ):
        for frame in merged(opened, reading):
            tracks.put(frame)
        result = tracks.finish()
        for recording in result.recordings:
            refuse_inputs(recording.path, *names)
        places.update(zip(tracks.parts, result.outputs, strict=True))
    _tell(result, reporter)
    return result


def format_of(source: str) -> Format:
    """Return the format of an input.

    Raises
    ------
    InputError
        If it does not exist or is of no known format.
    """
    for form in known_formats():
        if form.knows(source):
            return form
    if "://" not in source and not Path(source).exists():
        raise InputError(f"{source}: no such file or folder")
    takes = "; ".join(f"{form.name}: {form.takes}" for form in known_formats())
    raise InputError(f"{source}: of no known radar format", hint=takes)


@cache
def known_formats() -> tuple[Format, ...]:
    """Return the formats, one of each module in `readers`."""
    found = sorted(info.name for info in pkgutil.iter_modules(readers.__path__))
    return tuple(importlib.import_module(f"{readers.__name__}.{name}").FORMAT for name in found)


def _refuse_options(
    formats: list[Format], place: Path, *, clock: Clock, duration_s: float | None
) -> None:
    if not formats:
        raise UsageError("no input given")
    if clock not in CLOCKS:
        raise UsageError(f"clock is {clock!r}, expected one of {', '.join(CLOCKS)}")
    if place.suffix.lower() != ".parquet":
        raise OutputError(f"{place}: a recording is written as .parquet", hint="name it so")
    live = [form for form in formats if form.live]
    if live and len(formats) > 1:
        raise UsageError("an address cannot be merged with other inputs", hint="record it alone")
    if duration_s is not None and not live:
        raise UsageError("a duration is for an address; files end by themselves")
    if duration_s is not None and not duration_s > 0:
        raise UsageError(f"the duration is {duration_s:g} s, expected more than 0")


def _read(form: Format, source: str, reading: Reading) -> Generator[Frame]:
    """Read an input; what the system refuses is said with the input's name."""
    try:
        yield from form.frames(source, reading)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{source}: cannot be read: {reason}") from error


def _tell(result: Conversion, reporter: Reporter) -> None:
    if len(result.recordings) > 1:
        reporter.log(f"{len(result.recordings)} sensors, a recording each (--sensor takes one)")
    for recording in result.recordings:
        reporter.log(
            f"{recording.sensor}: {recording.frames:,} frames, "
            f"{recording.detections:,} detections, clock: {recording.clock}"
        )
    if result.left_out:
        reporter.log(f"left out or mended: {counted(result.left_out)}")

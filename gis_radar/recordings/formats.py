"""Formats, one for each module in `readers`: find that of an input, and open recordings."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from gis_radar.base import InputError, Text, first_line
from gis_radar.recordings import readers
from gis_radar.recordings.frames import Format
from gis_radar.recordings.recording import UNREADABLE, Recording, open_table

_OWN = ".parquet"  # opened without importing or asking any reader


@cache
def known_formats() -> tuple[Format, ...]:
    """Return the formats in the order in which they are asked."""
    names = sorted(info.name for info in pkgutil.iter_modules(readers.__path__))
    found = (importlib.import_module(f"{readers.__name__}.{name}").FORMAT for name in names)
    return tuple(sorted(found, key=lambda form: form.rank))


def format_of(source: str) -> Format:
    """Return the format of an input.

    Raises
    ------
    InputError
        If it does not exist or is of no known format.
    """
    form = next((form for form in known_formats() if form.accepts(source)), None)
    if form is not None:
        return form
    if "://" not in source and not Path(source).exists():
        raise InputError("{}: no such file or folder", source)
    takes = "; ".join(f"{form.name}: {form.takes}" for form in known_formats())
    raise InputError("{}: of no known radar format", source, hint=takes)


def direct_endings() -> tuple[str, ...]:
    """Return the endings of files that need no conversion."""
    found = (ending for form in known_formats() if form.opens for ending in form.endings)
    return tuple(dict.fromkeys(found))


def is_recording(path: Path) -> bool:
    """Return whether a file can be opened without conversion; a missing one, by its ending."""
    return _opener(path) is not None


def _opener(path: Path) -> Callable[[Path], Recording] | None:
    if path.suffix.lower() == _OWN:
        return open_table
    if path.is_file():
        return next((form.opens for form in known_formats() if form.accepts(str(path))), None)
    return open_table if path.suffix.lower() in direct_endings() else None


def open_recording(path: str | Path) -> Recording:
    """Open a recording of any known format.

    Parameters
    ----------
    path : str or Path
        A Parquet file, or CSV with the same header.

    Raises
    ------
    InputError
        If the file does not exist, is of no known format, lacks columns, or has one twice.

    Examples
    --------
    >>> import gis_radar as gr
    >>> recording = gr.open_recording(gr.sample_folder() / "R1.parquet")
    >>> detections = next(recording.read())
    >>> recording.rows, detections.points.shape
    (167617, (65536, 3))
    """
    path = Path(path)
    opens = _opener(path)
    if opens is None:
        known = ", ".join(direct_endings())
        raise InputError(
            "{}: not a known recording format ({})",
            path,
            path.suffix or Text("no ending"),
            hint=Text("known endings: {}; gis-radar convert takes other formats", known),
        )
    if not path.is_file():
        raise InputError("{}: no such file", path)
    try:
        return opens(path)
    except UNREADABLE as error:
        raise InputError("{}: cannot be read: {}", path, first_line(error)) from error


def as_recording(source: str | Path | Recording) -> Recording:
    """Return a recording, opened if `source` is its path."""
    return source if isinstance(source, Recording) else open_recording(source)


def as_recordings(
    sources: str | Path | Recording | Sequence[str | Path | Recording],
) -> list[Recording]:
    """Return recordings, opened where they are paths; one alone is a list of one."""
    given = [sources] if isinstance(sources, str | Path | Recording) else sources
    return [as_recording(each) for each in given]

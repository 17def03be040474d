"""Folders of PCD files, one file a frame, the time in its name; or one such file.

pypcd4 is not used: it takes a text with too few points as whole, reads a header line of any length,
and allocates what a damaged header states.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

from gis_radar.base import InputError, Text
from gis_radar.recordings import settings
from gis_radar.recordings.columns import find_layout, values_of
from gis_radar.recordings.frames import (
    Column,
    DamagedError,
    Format,
    Frame,
    NothingHereError,
    ReaderContext,
)

# Digits of a time as one whole number: seconds, milli-, micro-, nanoseconds since 1970.
_SECONDS_BY_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}
_LONGEST_HEADER = 1 << 14  # bytes; usual are some hundred
_LONGEST_NUMBER = 32  # letters of a number in text and the gap after it
_MOST_COUNT = 65_536  # numbers of a field; descriptors of points have some hundred
_KINDS = {
    ("F", "2"): "f2", ("F", "4"): "f4", ("F", "8"): "f8",
    ("I", "1"): "i1", ("I", "2"): "i2", ("I", "4"): "i4", ("I", "8"): "i8",
    ("U", "1"): "u1", ("U", "2"): "u2", ("U", "4"): "u4", ("U", "8"): "u8",
}  # fmt: skip
_DATE = re.compile(
    r"(\d{4})-?(\d\d)-?(\d\d)[T_ -]?(\d\d)[-:_h]?(\d\d)[-:_m]?(\d\d)(?:[._,-](\d{1,9}))?Z?"
)


def _files(place: Path) -> list[Path]:
    paths = place.iterdir() if place.is_dir() else [place]
    return [path for path in paths if path.suffix.lower() == ".pcd"]


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    place = Path(source)
    sensor = place.resolve().name if place.is_dir() else place.resolve().parent.name
    if not context.wants(sensor):
        raise NothingHereError("{}: holds the sensor {}", source, sensor, hint="name it, or none")
    yield from read_folder(place, sensor, context)


def read_folder(place: Path, sensor: str, context: ReaderContext) -> Generator[Frame]:
    """Read the PCD files of a folder, or one, in order of the times in their names.

    Raises
    ------
    InputError
        If a name has no time, or a file no positions.
    NothingHereError
        If none of the files can be read.
    """
    timed = sorted((time_in_name(path), path) for path in _files(place))
    found = False
    for number, (time, path) in enumerate(timed):
        if number % 64 == 0:
            context.reporter.progress(Text("reading {}", place.name), number, len(timed))
        try:
            rows = read_pcd(path)
        except DamagedError as error:
            context.counts["damaged_frames"] += 1
            context.reporter.warn("{}: {}", path, error)
            continue
        layout = find_layout(rows.dtype.names or (), context.columns, kind=rows.dtype)
        if not layout.has_positions:
            raise InputError(
                "{}: no positions among the fields {}",
                path,
                ", ".join(rows.dtype.names or ()),
                hint=Text("name them: {} x=...,y=...,z=...", "--columns"),
            )
        found = True
        layout.explain(sensor, context)
        yield layout.frame(values_of(rows), sensor=sensor, sensor_time=time, stamp="file name")
    if not found:
        raise NothingHereError("{}: no PCD file that can be read", place, hint="see the warnings")


def time_in_name(path: Path) -> float:
    """Return the time in the name of a file, UNIX seconds.

    It may be seconds (`1708578204.202`), seconds and nanoseconds (`1708578204_202447652`), whole
    milli-, micro- or nanoseconds, or a date in UTC (`2024-02-22T05-03-24.202Z`), anywhere in it.

    Raises
    ------
    InputError
        If there is none.
    """
    stem = path.stem
    if found := re.search(r"(?<!\d)(\d{10})[._-](\d{1,9})(?!\d)", stem):
        seconds, rest = found.groups()
        # After an underscore come nanoseconds, whose leading zeros some writers leave out.
        text = rest if stem[found.end(1)] == "." else rest.zfill(9)
        return float(f"{seconds}.{text}")
    if found := re.search(r"(?<!\d)(\d{10}|\d{13}|\d{16}|\d{19})(?!\d)", stem):
        return int(found[1]) * _SECONDS_BY_DIGITS[len(found[1])]
    if found := _DATE.search(stem):
        *date, fraction = found.groups()
        try:
            moment = datetime(*map(int, date), tzinfo=UTC)  # type: ignore[arg-type, misc]
        except ValueError as error:
            raise InputError("{}: its name has no valid date: {}", path, error) from error
        return moment.timestamp() + float(f"0.{fraction or 0}")
    raise InputError(
        "{}: no time in the name of the file",
        path,
        hint="such as 1708578204.202.pcd or 2024-02-22T05-03-24.202Z.pcd (UTC)",
    )


class _Header(NamedTuple):
    dtype: np.dtype[Any]
    points: int
    data: str


def read_pcd(path: Path) -> Column:
    """Return the points of a PCD file (ascii, binary, binary_compressed) as a structured array.

    Raises
    ------
    DamagedError
        If it has no valid header, or points are missing.
    """
    with path.open("rb") as file:
        header = _header(file)
        need = header.points * header.dtype.itemsize
        # The most that a text, or packed data, of so many points can take: the rest is not read.
        body = file.read(need * (_LONGEST_NUMBER if header.data == "ascii" else 2) + 8)
    if header.data == "ascii":
        return _from_text(body, header)
    if header.data == "binary":
        if len(body) < need:
            raise DamagedError(
                Text("{:,} bytes for {:,} points ({:,})", len(body), header.points, need)
            )
        return np.frombuffer(body, dtype=header.dtype, count=header.points)
    if header.data == "binary_compressed":
        return _from_fields(body, header)
    raise DamagedError(Text("DATA {}: expected ascii, binary or binary_compressed", header.data))


def _header(file: Any) -> _Header:
    """Read the header: types of the fields, number of points, form of the data."""
    words: dict[str, list[str]] = {}
    while "DATA" not in words:
        line = file.readline(_LONGEST_HEADER)
        if not line or file.tell() > _LONGEST_HEADER:
            raise DamagedError(Text("no PCD header"))
        key, *rest = line.decode("latin-1").partition("#")[0].split() or [""]
        words[key.upper()] = rest
    try:
        names, counts = words["FIELDS"], words.get("COUNT", ["1"] * len(words["FIELDS"]))
        kinds = [_KINDS[each] for each in zip(words["TYPE"], words["SIZE"], strict=True)]
        # Gaps are fields named _, which may be several.
        unique = [f"_{i}" if name == "_" else name for i, name in enumerate(names)]
        fields = [
            (name, f"<{kind}", (int(count),)) if count != "1" else (name, f"<{kind}")
            for name, kind, count in zip(unique, kinds, counts, strict=True)
        ]
        size = words.get("POINTS") or [str(int(words["WIDTH"][0]) * int(words["HEIGHT"][0]))]
        points = int(size[0])
        dtype = np.dtype(fields)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DamagedError(Text("the PCD header makes no sense: {}", error)) from error
    if any(not 1 <= int(count) <= _MOST_COUNT for count in counts):
        raise DamagedError(
            Text("the PCD header claims fields of {} numbers", ", ".join(counts)[:60])
        )
    size_bytes = points * dtype.itemsize
    if not 0 <= points <= settings.MOST_ROWS_OF_FRAME or size_bytes > settings.MOST_FRAME_BYTES:
        raise DamagedError(
            Text("the PCD header claims {:,} points of {:,} bytes", points, dtype.itemsize)
        )
    return _Header(dtype=dtype, points=points, data=(words["DATA"] or [""])[0].lower())


def _from_text(body: bytes, header: _Header) -> Column:
    """Return points of numbers in text, as a structured array."""
    width = sum(math.prod(header.dtype[name].shape) for name in header.dtype.names or ())
    values = body.split()
    if len(values) < header.points * width:
        raise DamagedError(
            Text("{:,} values for {:,} points of {}", len(values), header.points, width)
        )
    try:
        table = np.array(values[: header.points * width], dtype=np.float64)
    except ValueError as error:
        raise DamagedError(Text("a value is no number: {}", error)) from error
    return unstructured_to_structured(table.reshape(header.points, width), header.dtype)


def _from_fields(body: bytes, header: _Header) -> Column:
    """Return points stored one field after the other, compressed."""
    need = header.points * header.dtype.itemsize
    if len(body) < 8:
        raise DamagedError(Text("the compressed points are missing"))
    packed, size = struct.unpack_from("<II", body)
    if size != need or len(body) < 8 + packed:
        raise DamagedError(Text("{:,} bytes for {:,} points ({:,})", size, header.points, need))
    plain = decompress(body[8 : 8 + packed], size)
    rows, begin = np.empty(header.points, dtype=header.dtype), 0
    for name in header.dtype.names or ():
        kind = header.dtype[name]
        end = begin + header.points * kind.itemsize
        rows[name] = np.frombuffer(plain[begin:end], dtype=kind)
        begin = end
    return rows


def decompress(packed: bytes, size: int) -> bytes:
    """Unpack LZF: literals, and copies of earlier bytes.

    Raises
    ------
    DamagedError
        If it is not `size` bytes.
    """
    plain, at = bytearray(), 0
    try:
        while at < len(packed) and len(plain) <= size:
            control, at = packed[at], at + 1
            if control < 32:
                plain += packed[at : at + control + 1]
                at += control + 1
                continue
            length, back = control >> 5, (control & 0x1F) << 8
            if length == 7:
                length, at = length + packed[at], at + 1
            start, at = len(plain) - back - packed[at] - 1, at + 1
            if start < 0:
                break
            copy = plain[start : start + length + 2]
            while len(copy) < length + 2:  # it overlaps the bytes that it makes: a repetition
                copy += copy[: length + 2 - len(copy)]
            plain += copy
    except IndexError:
        pass  # too short: refused below
    if len(plain) != size:
        raise DamagedError(Text("{:,} bytes are packed, expected {:,}", len(plain), size))
    return bytes(plain)


FORMAT = Format(
    name="PCD",
    takes="a folder of .pcd files with the time in their names, or one",
    accepts=lambda source: any(path.is_file() for path in _files(Path(source))),
    frames=_frames,
    endings=(".pcd",),
    rank=1,
)

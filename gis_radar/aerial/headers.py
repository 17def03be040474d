"""The header of a LAS or LAZ file, checked against the file's size before anything trusts it.

A reader that believes a damaged header asks for 1e12 points of memory, or walks through 2^31
records. Whatever the header promises must fit into the bytes that are there.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

from gis_radar.errors import InputError

_SMALLEST_HEADER = 227
_VLR_BYTES, _EVLR_BYTES = 54, 60
# A chunk of compressed points holds one of them in full, and by default this many in all.
_CHUNK_POINTS = 50_000
_LEAST_RECORD = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
_COMPRESSED = 0x80 | 0x40


class Header(NamedTuple):
    """What a LAS header says about the layout of its file.

    `size`, `points_at` and `evlrs_at` are in bytes from the file's begin; `record` is the length
    of a point.
    """

    version: tuple[int, int]
    size: int
    points_at: int
    vlrs: int
    point_format: int
    compressed: bool
    record: int
    points: int
    evlrs_at: int
    evlrs: int


def check_header(path: str | Path) -> None:
    """Refuse a file whose header promises what the file cannot hold.

    Raises
    ------
    InputError
        If the file is no LAS or LAZ file, is cut off, or holds no points.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file")
    size = Path(path).stat().st_size
    with Path(path).open("rb") as file:
        head = file.read(375)
    if size == 0:
        raise InputError(f"{path}: empty file")
    if head[:4] != b"LASF":
        raise InputError(f"{path}: not a LAS or LAZ file: it does not begin with LASF")
    if len(head) < _SMALLEST_HEADER:
        raise InputError(f"{path}: cut off: {size} bytes, less than a header")
    header = _parsed(head)
    fault = _fault(header, size) or _long_record(path, header, size)
    if fault:
        raise InputError(f"{path}: damaged or cut off: {fault}")
    if header.points == 0:
        raise InputError(f"{path}: scan without points")


def _parsed(head: bytes) -> Header:
    major, minor = head[24], head[25]
    size, points_at, vlrs, kind, record, points = struct.unpack_from("<HIIBHI", head, 94)
    evlrs_at = evlrs = 0
    if (major, minor) >= (1, 4) and len(head) >= 255:
        evlrs_at, evlrs, points = struct.unpack_from("<QIQ", head, 235)
    return Header(
        version=(major, minor), size=size, points_at=points_at, vlrs=vlrs,
        point_format=kind & ~_COMPRESSED, compressed=bool(kind & _COMPRESSED), record=record,
        points=points, evlrs_at=evlrs_at, evlrs=evlrs,
    )  # fmt: skip


def _fault(header: Header, size: int) -> str:
    """Say in a few words what cannot be, or nothing."""
    shortest = dict(enumerate(_LEAST_RECORD)).get(header.point_format)
    if header.version[0] != 1 or header.version[1] > 4:
        fault = f"LAS version {header.version[0]}.{header.version[1]} is not known"
    elif shortest is None:
        fault = f"point format {header.point_format} is not known"
    elif header.record < shortest:
        fault = f"points of {header.record} bytes are too short for format {header.point_format}"
    elif not _SMALLEST_HEADER <= header.size <= header.points_at:
        fault = f"points begin at byte {header.points_at}, inside the header"
    elif header.points_at > size:
        fault = f"points begin at byte {header.points_at} of {size}"
    elif header.vlrs * _VLR_BYTES > header.points_at - header.size:
        fault = f"its header claims {header.vlrs} records, which do not fit before the points"
    elif header.points > _most_points(header, size):
        fault = f"its header claims {header.points} points, the file has {size} bytes"
    elif header.evlrs and header.evlrs_at + header.evlrs * _EVLR_BYTES > size:
        fault = f"its header claims {header.evlrs} further records behind the end of the file"
    else:
        fault = ""
    return fault


def _most_points(header: Header, size: int) -> int:
    records = (size - header.points_at) // header.record
    return records * (_CHUNK_POINTS if header.compressed else 1)


def _long_record(path: str | Path, header: Header, size: int) -> str:
    """Say which record claims to be longer than its file, or nothing."""
    with Path(path).open("rb") as file:
        at = header.size
        for _ in range(header.vlrs):
            file.seek(at + 20)
            at += _VLR_BYTES + int.from_bytes(file.read(2), "little")
            if at > header.points_at:
                return "a record of its header reaches into the points"
        at = header.evlrs_at
        for _ in range(header.evlrs):
            file.seek(at + 20)
            length = file.read(8)
            at += _EVLR_BYTES + int.from_bytes(length, "little")
            if at > size:
                return "a record behind its points is longer than the file"
    return ""

"""Check the headers of scans (LAS, LAZ) before a library acts on what they claim.

laspy checks that the parts of a header agree with each other, but not with the size of the file: it
reads as many records as the header claims, up to 2^31. lazrs below it allocates what the
compression's record and chunk table claim, and aborts the process where memory is short.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import lazrs
import lazy_loader
import numpy as np

from gis_radar.base import GisRadarError, InputError, Text, first_line

laspy = lazy_loader.load("laspy")  # 0.2 s, and most commands read no scan

_VLR_BYTES, _EVLR_BYTES = 54, 60
_LASZIP = b"laszip encoded"
_LASZIP_RECORD = 22204
_LASZIP_BYTES, _ITEM_BYTES = 34, 6
# Sizes of the parts of a compressed point by type (laszip 3.4, "laszip.hpp"); bytes have any.
_ITEM_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_ITEMS_OF_ANY_SIZE = {0, 14}
# Number of layers of each part of a point, by the same types; extra bytes have one each.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_LAYERED = 3  # the method of compression of point formats 6 to 10
_VARIABLE_CHUNKS = 0xFFFFFFFF  # points in a chunk: stated for each chunk by the table
_MOST_CHUNK = 10_000_000  # points; laszip's own chunks have 50,000, COPC's under 100,000
_LEAST_STATED = 0.99  # share of the points of a plain file that its header must count
_SMALLEST_SCALE, _LARGEST_SCALE = 1e-12, 1e3
_FARTHEST_M = 1e8  # no projected coordinate on earth is larger
_ROUNDED_M = 1.0  # distance of points outside the header's extent that rounding explains
# A flipped bit moves all later compressed points by kilometres; extents out of date are near.
_FAR_M, _FAR_SHARE = 100.0, 0.1  # metres, and share of the extent


def read_header(path: Path) -> Any:
    """Read the header of a scan.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC.

    Returns
    -------
    laspy.LasHeader
        The header, of a file that is large enough for what it claims.

    Raises
    ------
    InputError
        If the file is missing, no scan, damaged or without points.
    """
    if not path.is_file():
        raise InputError("{}: no such file", path)
    size = path.stat().st_size
    if size == 0:
        raise InputError("{}: empty file", path)
    with scan_errors(path):
        with path.open("rb") as file:
            head = file.read(375).ljust(375, b"\0")
            if head[:4] != b"LASF":
                raise InputError("{}: not a LAS or LAZ file: it does not begin with LASF", path)
            fault = _header_fault(head, size) or (
                _compression_fault(file, head, size) if head[104] & 0x80 else ""
            )
        if not fault:
            with laspy.open(path) as reader:
                header = reader.header
            fault = _size_fault(header, size)
    if fault:
        raise InputError("{}: damaged or cut off: {}", path, fault)
    if header.point_count == 0:
        raise InputError("{}: scan without points", path)
    return header


def refuse_outside(record: Any, header: Any, path: Path) -> float:
    """Refuse points far outside the extent that the header states, which flipped bits cause.

    Parameters
    ----------
    record : laspy point record
        Some points.
    header : laspy.LasHeader
        Header of their file.
    path : Path
        The file, for the message.

    Returns
    -------
    float
        Largest distance of a point outside the extent, metres: programs crop, shift and merge
        without updating it. Zero for rounding, and where no extent is stated.

    Raises
    ------
    InputError
        If one lies outside by more than 100 m and a tenth of the extent.
    """
    most = 0.0
    for k, axis in enumerate("XYZ" if len(record) else ""):
        low, high = float(header.mins[k]), float(header.maxs[k])
        if not (np.isfinite([low, high]).all() and low < high):
            continue
        stored = np.asarray(record[axis])
        ends = np.array([int(stored.min()), int(stored.max())], np.float64)
        lowest, highest = np.sort(ends * header.scales[k] + header.offsets[k])
        off = float(max(low - lowest, highest - high))
        if off > max(_FAR_M, _FAR_SHARE * (high - low)):
            raise InputError(
                "{}: damaged: points lie {:.0f} m outside the extent of its header along {}",
                path,
                off,
                axis.lower(),
                hint="where only the extent is wrong, `pdal translate IN OUT` writes it anew",
            )
        most = max(most, off if off > _ROUNDED_M + abs(header.scales[k]) else 0.0)
    return most


@contextmanager
def scan_errors(path: str | Path) -> Iterator[None]:
    """Turn errors of libraries that read a scan into one that names it."""
    try:
        yield
    except GisRadarError:
        raise
    except Exception as error:
        reason = first_line(error)[:160]
        if isinstance(error, laspy.errors.PointFormatNotSupported):
            reason = Text("point format {} is not known", reason)
        raise InputError(
            "{}: not a readable LAS or LAZ file, damaged or cut off: {}", path, reason
        ) from error


def _header_fault(head: bytes, size: int) -> str:
    """Return what is impossible in a header's bytes (ASPRS LAS 1.4, table 3), or an empty text."""
    if head[24] != 1 or head[25] > 4:
        return Text("LAS version {}.{} is not known", head[24], head[25])
    begin, points_at, count = struct.unpack_from("<HII", head, 94)
    if points_at > size:
        return Text("points begin at byte {} of {}", points_at, size)
    if count * _VLR_BYTES > max(points_at - begin, 0):
        return Text(
            "its header claims {} records, which do not fit before byte {}", count, points_at
        )
    begin, count = struct.unpack_from("<QI", head, 235) if head[25] >= 4 else (0, 0)
    if count and begin + count * _EVLR_BYTES > size:
        return Text("its header claims {} further records behind the end of the file", count)
    return ""


def _compression_fault(file: BinaryIO, head: bytes, size: int) -> str:
    """Return what is impossible in the compression's record or chunks, or an empty text."""
    begin, points_at, count = struct.unpack_from("<HII", head, 94)
    file.seek(begin)
    records = file.read(points_at - begin)
    record, at = b"", 0
    for _ in range(count):
        user, number, length = struct.unpack_from("<2x16sHH", records, at)
        if number == _LASZIP_RECORD and user.rstrip(b"\0") == _LASZIP:
            record = records[at + _VLR_BYTES : at + _VLR_BYTES + length]
        at += _VLR_BYTES + length
    if fault := _record_fault(record, struct.unpack_from("<H", head, 105)[0]):
        return Text("its record of the compression {}", fault)
    return _chunk_table_fault(file, head, record, size)


def _chunk_table_fault(file: BinaryIO, head: bytes, record: bytes, size: int) -> str:
    """Return what is impossible in the table of chunks or in their heads, or an empty text."""
    (points_at,) = struct.unpack_from("<I", head, 96)
    chunk_points = struct.unpack_from("<I", record, 12)[0]
    points = struct.unpack_from("<I", head, 107)[0]
    if head[25] >= 4:
        points = struct.unpack_from("<Q", head, 247)[0] or points
    file.seek(points_at)
    (table_at,) = struct.unpack("<q", file.read(8))
    if table_at == -1:  # written as a stream: the place is at the end
        file.seek(size - 8)
        (table_at,) = struct.unpack("<q", file.read(8))
    if not points_at + 8 <= table_at <= size - 8:
        return Text("its table of chunks is at byte {} of {}", table_at, size)
    file.seek(table_at)
    _, chunks = struct.unpack("<II", file.read(8))
    most = points if chunk_points == _VARIABLE_CHUNKS else points // chunk_points + 2
    if chunks > min(most, size // struct.unpack_from("<H", head, 105)[0]):
        return Text("its table claims {} chunks for {} points in {} bytes", chunks, points, size)
    file.seek(points_at)
    table = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    if sum(length for _, length in table) > table_at - points_at - 8:
        return Text("its table claims chunks longer than the file")
    if chunk_points == _VARIABLE_CHUNKS and sum(held for held, _ in table) != points:
        return Text("its chunks do not hold its {} points", points)
    if struct.unpack_from("<H", record)[0] == _LAYERED:
        lengths = [length for _, length in table]
        return _layer_fault(file, points_at + 8, lengths, _items(record))
    return ""


def _layer_fault(
    file: BinaryIO, at: int, lengths: Sequence[int], items: Sequence[tuple[int, int]]
) -> str:
    """Return which chunk claims layers longer than itself, or an empty text."""
    first = sum(size for _, size in items)  # one point in full, the number of points, the layers
    layers = sum(size if kind in _ITEMS_OF_ANY_SIZE else _LAYERS[kind] for kind, size in items)
    form = struct.Struct(f"<{first + 4}x{layers}I")
    for number, length in enumerate(lengths):
        if length:
            file.seek(at)
            head = file.read(min(form.size, length))
            if len(head) < form.size or sum(form.unpack(head)) > length - form.size:
                return Text("chunk {} claims layers longer than itself", number)
        at += length
    return ""


def _record_fault(record: bytes, point_bytes: int) -> str:
    """Return what is impossible in laszip's record, or an empty text."""
    if len(record) < _LASZIP_BYTES:
        return "is missing or cut"
    compressor, chunk_points, count = (
        struct.unpack_from(form, record, at)[0] for form, at in (("<H", 0), ("<I", 12), ("<H", 32))
    )
    if compressor not in {2, 3}:
        return Text("names the method {}", compressor)
    if chunk_points == 0 or _MOST_CHUNK < chunk_points < _VARIABLE_CHUNKS:
        return Text("claims chunks of {} points", chunk_points)
    if len(record) < _LASZIP_BYTES + count * _ITEM_BYTES:
        return Text("claims {} parts of a point", count)
    items = _items(record)
    wrong = [kind for kind, size in items
             if kind not in _ITEMS_OF_ANY_SIZE and _ITEM_SIZES.get(kind) != size]  # fmt: skip
    if compressor == _LAYERED:
        wrong += [kind for kind, _ in items if kind not in {*_LAYERS, *_ITEMS_OF_ANY_SIZE}]
    if wrong or sum(size for _, size in items) != point_bytes:
        return Text("and its points of {} bytes do not fit each other", point_bytes)
    return ""


def _items(record: bytes) -> list[tuple[int, int]]:
    """Return type and size of each part of a compressed point."""
    (count,) = struct.unpack_from("<H", record, 32)
    places = range(_LASZIP_BYTES, _LASZIP_BYTES + count * _ITEM_BYTES, _ITEM_BYTES)
    return [struct.unpack_from("<HH", record, at) for at in places]


def _size_fault(header: Any, size: int) -> str:
    """Return what a header claims that its file cannot hold, although laspy accepts it; else ""."""
    # The first point of each chunk is stored in full: the file has room for so many chunks.
    chunk = _MOST_CHUNK if header.are_points_compressed else 1
    most = (size - header.offset_to_point_data) // header.point_format.size * chunk
    # Behind the points of a plain file lie further records, wave forms, or some bytes of others.
    is_last = not (header.number_of_evlrs or header.point_format.has_waveform_packet)
    least = _LEAST_STATED * most if is_last and not header.are_points_compressed else 0
    if not least <= header.point_count <= most:
        return Text("its header claims {} points, the file has {} bytes", header.point_count, size)
    scales, offsets = np.abs(header.scales), np.abs(header.offsets)
    if not ((scales > _SMALLEST_SCALE).all() and (scales <= _LARGEST_SCALE).all()):
        return Text("scales {}", header.scales)
    return "" if (offsets <= _FARTHEST_M).all() else Text("offsets {}", header.offsets)

"""Open airborne scans: LAS, LAZ and COPC files of any point format, with their headers checked.

A reader that believes a damaged header asks for 1e12 points of memory, or walks through 2^31
records. Whatever the header promises must fit into the bytes that are there.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import laspy
import numpy as np
from lazrs import LazrsError
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError as ProjError

from gis_radar.arrays import Booleans, Floats
from gis_radar.crs import Box, metric_crs, name_of
from gis_radar.errors import CrsError, InputError

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


Days: TypeAlias = tuple[date, date]
AT_ONCE = 1_000_000
# ASPRS classes that are road for certain: ground, key points of it, road surface, bridge deck.
ROAD_CLASSES = (2, 8, 11, 17)
# Classes that never are: vegetation, noise, water, wires and pylons, high noise.
NEVER_CLASSES = (3, 4, 5, 7, 9, 13, 14, 15, 16, 18)
# Any classification finds ground everywhere; fewer of it are strays in an unclassified scan.
LEAST_GROUND_SHARE = 0.01
_DAMAGED = (laspy.LaspyException, LazrsError, OSError, ValueError, OverflowError, RuntimeError)
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_WEEK_S = 604_800.0
_ADJUSTED_S = 1e9
_SMALLEST_SCALE = 1e-12


class Points(NamedTuple):
    """Some points of a scan: coordinates in its own system, class, GPS time where it has one.

    `read` and `ground` count the points they were chosen from, and those of a ground class.
    """

    x: Floats
    y: Floats
    z: Floats
    category: NDArray[np.uint8]
    gps_time: Floats | None
    read: int
    ground: int


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A file of an airborne scan.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC.
    crs : CRS
        Its projected, metric, horizontal coordinate system.
    vertical : str
        Name of the system of its heights; empty where the file does not say.
    declared : bool
        True where the user, not the file, said the coordinate system.
    points : int
        How many points it holds.
    bounds : (float, float, float, float)
        West, south, east, north as its header says; infinite where it says nothing credible.
    written : date, optional
        When the file was made.
    """

    path: Path
    crs: CRS
    vertical: str
    declared: bool
    points: int
    bounds: Box = field(repr=False)
    written: date | None = field(default=None, repr=False)

    def pieces(self, box: Box | None = None) -> Iterator[Points]:
        """Yield the points inside a box of the scan's own system, a bounded number at a time.

        Withheld points are left out.

        Raises
        ------
        InputError
            If the file is damaged or ends early.
        """
        seen = 0
        try:
            with laspy.open(self.path) as reader:
                for record in reader.chunk_iterator(AT_ONCE):
                    seen += len(record)
                    yield _inside(record, box)
        except _DAMAGED as error:
            raise InputError(_damaged(self.path, error)) from error
        if seen != self.points:
            raise InputError(f"{self.path}: cut off: {seen} of {self.points} points are there")


def open_scan(path: str | Path, *, crs: Any = None) -> Scan:
    """Open a scan and find out where it lies.

    Parameters
    ----------
    path : str or Path
        LAS, LAZ or COPC; read later, piece by piece.
    crs : CRS, str or int, optional
        The scan's coordinate system, for files that do not say or say it wrong.

    Raises
    ------
    InputError
        If the file is missing, no scan, damaged or empty; CrsError if neither it nor the caller
        says a projected, metric coordinate system.
    """
    path = Path(path)
    check_header(path)
    try:
        with laspy.open(path) as reader:
            header = reader.header
    except _DAMAGED as error:
        raise InputError(_damaged(path, error)) from error
    scales = np.abs(header.scales)
    if not (np.isfinite(header.offsets).all() and (scales > _SMALLEST_SCALE).all()):
        raise InputError(f"{path}: damaged: scales {header.scales}, offsets {header.offsets}")
    stated = crs if crs is not None else _stated(path, header)
    if stated is None:
        raise CrsError(f"{path}: has no coordinate system", hint="say which: --scan-crs EPSG:25832")
    return Scan(
        path=path,
        crs=metric_crs(stated, what="--scan-crs" if crs is not None else str(path)),
        vertical=_vertical(CRS.from_user_input(stated)),
        declared=crs is not None,
        points=int(header.point_count),
        bounds=_bounds(header),
        written=header.creation_date,
    )


def ground_share(scan: Scan) -> float:
    """Return the share of a scan's points that bear a class of ground or road."""
    return sum(piece.ground for piece in scan.pieces((0.0, 0.0, 0.0, 0.0))) / scan.points


def is_road_class(category: NDArray[np.uint8]) -> Booleans:
    """Tell which classes are road for certain."""
    return _ROAD[category]


def never_road(category: NDArray[np.uint8]) -> Booleans:
    """Tell which classes are no road, whatever the place."""
    return _NEVER[category]


def days_of(times: Sequence[float]) -> Days | None:
    """Return the days of the earliest and the latest GPS time, where these tell days.

    Seconds of a GPS week do not; times beyond a week are counted from 1980, less 1e9 s, also in
    files whose header says otherwise.
    """
    if not times or not _WEEK_S < min(times) <= max(times) < 2 * _ADJUSTED_S:
        return None
    first, last = (
        (_GPS_EPOCH + timedelta(seconds=_ADJUSTED_S + time)).date()
        for time in (min(times), max(times))
    )
    return first, last


def _table(classes: tuple[int, ...]) -> Booleans:
    return np.isin(np.arange(256), classes)


_ROAD, _NEVER = _table(ROAD_CLASSES), _table(NEVER_CLASSES)


def _inside(record: Any, box: Box | None) -> Points:
    x, y = (
        np.asarray(record[axis], np.float64) * scale + offset
        for axis, scale, offset in zip("XY", record.scales, record.offsets, strict=False)
    )
    category = np.asarray(record["classification"]).astype(np.uint8)
    ground = int(np.count_nonzero(is_road_class(category)))
    kept = np.asarray(record["withheld"]) == 0
    if box is not None:
        kept &= (x >= box[0]) & (y >= box[1]) & (x <= box[2]) & (y <= box[3])
    z = np.asarray(record["Z"][kept], np.float64) * record.scales[2] + record.offsets[2]
    timed = "gps_time" in record.point_format.dimension_names
    time = np.asarray(record["gps_time"][kept], np.float64) if timed else None
    return Points(x[kept], y[kept], z, category[kept], time, len(kept), ground)


def _stated(path: Path, header: Any) -> CRS | None:
    """Return the coordinate system that the file states, or None."""
    try:
        crs: CRS | None = header.parse_crs()
    except (ProjError, *_DAMAGED) as error:
        reason = str(error).splitlines()[0][:120]
        raise CrsError(
            f"{path}: its coordinate system cannot be read: {reason}",
            hint="say which: --scan-crs EPSG:25832",
        ) from error
    return crs


def _vertical(crs: CRS) -> str:
    """Return the name of the heights' system, or nothing where only the plane is defined."""
    if crs.is_bound and crs.source_crs is not None:
        return _vertical(crs.source_crs)
    if crs.is_compound:
        return next((name_of(part) if part.to_authority() else part.name
                     for part in crs.sub_crs_list if part.is_vertical), "")  # fmt: skip
    return f"ellipsoidal heights of {crs.name}" if len(crs.axis_info) == 3 else ""


def _bounds(header: Any) -> Box:
    (west, south), (east, north) = header.mins[:2], header.maxs[:2]
    credible = np.isfinite([west, south, east, north]).all() and west < east and south < north
    if not credible:
        return (-np.inf, -np.inf, np.inf, np.inf)
    return float(west), float(south), float(east), float(north)


def _damaged(path: Path, error: BaseException) -> str:
    reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
    return f"{path}: not a readable LAS or LAZ file, damaged or cut off: {reason}"

"""Read airborne scans (LAS, LAZ, COPC of any point format), and the points of a masked road."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import lazy_loader
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from gis_radar.base import (
    FILE_DATE,
    QUIET,
    Box,
    CrsError,
    Floats,
    InputError,
    Reporter,
    Text,
    first_line,
    inexact_change,
    metric_crs,
    name_of,
    reprojected_box,
    require_same,
    same_coordinates,
    transformer,
)
from gis_radar.scans.header import read_header, refuse_outside, scan_errors
from gis_radar.scans.settings import DEFAULTS, MaskSettings

laspy = lazy_loader.load("laspy")  # 0.2 s, and most commands read no scan

Days: TypeAlias = tuple[date, date]
BATCH_POINTS = 500_000  # points in a batch
# ASPRS LAS 1.4, table 17. Road for certain: ground, key points of it, road surface, bridge deck.
ROAD_CLASSES = (2, 8, 11, 17)
# Never a road: vegetation, noise, water, wires and pylons, high noise.
NEVER_CLASSES = (3, 4, 5, 7, 9, 13, 14, 15, 16, 18)
_ROAD_SURFACE = 11
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_CRS_HINT = Text("state it: {} EPSG:25832", "--scan-crs")
_WEEK_S = 604_800.0
_ADJUSTED_OFFSET_S = 1e9  # subtracted in adjusted standard GPS time (ASPRS LAS 1.4)


class Points(NamedTuple):
    """A batch of points of a scan: coordinates (m), ASPRS class, GPS time (s) if it has one.

    `read` is the number of points they were selected from, `ground` the number of ground among it.
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
        Name of its vertical system; empty where the file states none.
    points : int
        Number of points.
    bounds : (float, float, float, float)
        West, south, east, north by its header, metres; infinite where these are not credible.
    """

    path: Path
    crs: CRS
    vertical: str
    points: int
    bounds: Box = field(repr=False)

    def touches(self, box: Box, crs: CRS) -> bool:
        """Return whether the extent in the scan's header meets a box, which is in `crs`."""
        within = reprojected_box(box, crs, self.crs)
        west, south, east, north = self.bounds
        return west <= within[2] and within[0] <= east and south <= within[3] and within[1] <= north

    def batches(self, box: Box, crs: CRS, *, reporter: Reporter = QUIET) -> Iterator[Points]:
        """Yield the points in and around a box, in batches of bounded size.

        Points marked as withheld are left out. Heights are those of the file.

        Parameters
        ----------
        box : (float, float, float, float)
            West, south, east, north, metres.
        crs : CRS
            The system of the box, and of the points.
        reporter : Reporter
            Receives a warning where the extent of the file's header is too small.

        Raises
        ------
        InputError
            If the file is damaged or ends early.
        """
        within = reprojected_box(box, crs, self.crs)
        read, outside = 0, 0.0
        with scan_errors(self.path), laspy.open(self.path) as reader:
            for record in reader.chunk_iterator(BATCH_POINTS):
                outside = max(outside, refuse_outside(record, reader.header, self.path))
                read += len(record)
                batch = _points_inside(record, within)
                if not same_coordinates(self.crs, crs):
                    x, y = transformer(self.crs, crs).transform(batch.x, batch.y)
                    batch = batch._replace(x=x, y=y)
                yield batch
        if read != self.points:
            raise InputError("{}: cut off: {} of {} points are there", self.path, read, self.points)
        if outside > 0.0:
            reporter.warn(
                "{}: points lie up to {:.0f} m outside the extent of its header, which "
                "does not count",
                self.path,
                outside,
            )


def open_scan(path: str | Path, *, crs: Any = None) -> Scan:
    """Open a scan: read its coordinate system and extent from the header.

    Parameters
    ----------
    path : str or Path
        LAS, LAZ or COPC; read later, in batches.
    crs : CRS, str or int, optional
        The scan's coordinate system, for files without one or with a wrong one.

    Raises
    ------
    InputError
        If the file is missing, no scan, damaged or empty; CrsError if neither it nor the caller
        gives a projected, metric coordinate system.
    """
    path = Path(path)
    header = read_header(path)
    stated = crs if crs is not None else _stated_crs(path, header, hint=_CRS_HINT)
    if stated is None:
        raise CrsError("{}: has no coordinate system", path, hint=_CRS_HINT)
    plane = metric_crs(stated, what="--scan-crs" if crs is not None else str(path))
    _refuse_feet(CRS.from_user_input(stated), path)
    return Scan(
        path=path,
        crs=plane,
        vertical=_vertical(CRS.from_user_input(stated)),
        points=int(header.point_count),
        bounds=_bounds(header),
    )


def warn_inexact(scans: Sequence[Scan], crs: CRS, reporter: Reporter) -> None:
    """Warn where points of scans cannot be placed in `crs` to a metre: another datum, no grid."""
    named = {name_of(scan.crs): scan for scan in scans if np.isfinite(scan.bounds).all()}
    for scan in named.values():
        west, south, east, north = scan.bounds
        if remark := inexact_change(scan.crs, crs, (west + east) / 2.0, (south + north) / 2.0):
            reporter.warn("{}: {}", scan.path, remark)


def write_road(points: Floats, path: Path, *, crs: CRS, settings: MaskSettings = DEFAULTS) -> None:
    """Write the points of a road as LAZ 1.4 with its coordinate system, to the millimetre.

    Parameters
    ----------
    points : (n, 3) array
        Easting, northing, height, metres.
    path : Path
        The file.
    crs : CRS
        Coordinate system of the points.
    settings : MaskSettings
        Settings of the mask, which the header holds as JSON.
    """
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = FILE_DATE
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(points.min(axis=0))
    header.add_crs(crs)
    record = json.dumps(asdict(settings)).encode()
    header.vlrs.append(laspy.VLR("gis_radar", 1, "settings of the road mask", record))
    las = laspy.LasData(header)
    las.xyz = points
    las.classification = np.full(len(points), _ROAD_SURFACE, np.uint8)
    las.return_number = np.ones(len(points), np.uint8)
    las.number_of_returns = np.ones(len(points), np.uint8)
    las.write(path)


def read_road(path: str | Path, crs: Any) -> Floats:
    """Read the points of a road, as :func:`write_road` writes them.

    Parameters
    ----------
    path : str or Path
        LAS or LAZ.
    crs : CRS, str or int
        The map's coordinate system, which the scan must have.

    Returns
    -------
    (n, 3) array
        Easting, northing, height, metres.

    Raises
    ------
    InputError
        If the file is damaged or empty; CrsError if its CRS is missing or another.
    """
    frame = metric_crs(crs, what="crs")
    require_same(road_crs(path), frame, what=str(path), other_what="the map")
    with scan_errors(path):
        las = laspy.read(path)
        refuse_outside(las.points, las.header, Path(path))
        return np.asarray(las.xyz)


def road_crs(path: str | Path) -> CRS:
    """Return the coordinate system of a scan, from its header.

    Raises
    ------
    InputError
        If the file is damaged; CrsError if its CRS is missing or not metric.
    """
    return metric_crs(_stated_crs(Path(path), read_header(Path(path))), what=str(path))


def days_flown(times: Sequence[float]) -> Days | None:
    """Return the days of the earliest and the latest GPS time; None for seconds of a GPS week.

    Times beyond a week are taken for adjusted standard GPS time (seconds since 1980, less 1e9),
    also where the header's flag for it is not set.
    """
    if not times or not _WEEK_S < min(times) <= max(times) < 2 * _ADJUSTED_OFFSET_S:
        return None
    first, last = (
        (_GPS_EPOCH + timedelta(seconds=_ADJUSTED_OFFSET_S + time)).date()
        for time in (min(times), max(times))
    )
    return first, last


def box_with_margin(box: Box, margin_m: float) -> Box:
    """Return a box with a margin on each side, metres."""
    west, south, east, north = box
    return west - margin_m, south - margin_m, east + margin_m, north + margin_m


def _points_inside(record: Any, box: Box) -> Points:
    """Return the points of a record that lie in a box and are not withheld."""
    x, y = (
        np.asarray(record[axis], np.float64) * scale + offset
        for axis, scale, offset in zip("XY", record.scales, record.offsets, strict=False)
    )
    category = np.asarray(record["classification"]).astype(np.uint8)
    ground = int(np.count_nonzero(np.isin(category, ROAD_CLASSES)))
    kept = np.asarray(record["withheld"]) == 0
    kept &= (x >= box[0]) & (y >= box[1]) & (x <= box[2]) & (y <= box[3])
    z = np.asarray(record["Z"][kept], np.float64) * record.scales[2] + record.offsets[2]
    timed = "gps_time" in record.point_format.dimension_names
    time = np.asarray(record["gps_time"][kept], np.float64) if timed else None
    return Points(x[kept], y[kept], z, category[kept], time, len(kept), ground)


def _stated_crs(path: Path, header: Any, *, hint: str = "") -> CRS | None:
    """Return the coordinate system that the file states, or None."""
    try:
        crs: CRS | None = header.parse_crs()
    except Exception as error:
        reason = first_line(error)[:120]
        raise CrsError(
            "{}: its coordinate system cannot be read: {}", path, reason, hint=hint
        ) from error
    return crs


def _vertical(crs: CRS) -> str:
    """Return the name of the vertical system, empty where only the horizontal one is defined."""
    if crs.is_bound and crs.source_crs is not None:
        return _vertical(crs.source_crs)
    if crs.is_compound:
        return next((name_of(part) if part.to_authority() else part.name
                     for part in crs.sub_crs_list if part.is_vertical), "")  # fmt: skip
    return f"ellipsoidal heights of {crs.name}" if len(crs.axis_info) == 3 else ""


def _refuse_feet(crs: CRS, path: Path) -> None:
    """Refuse a coordinate system whose heights are in another unit than metres."""
    for axis in crs.axis_info:
        if axis.direction in {"up", "down"} and axis.unit_conversion_factor != 1.0:
            raise CrsError(
                "{}: its heights are in {}, metres are needed",
                path,
                axis.unit_name,
                hint="bring the scan into a system with heights in metres, e.g. with PDAL",
            )


def _bounds(header: Any) -> Box:
    (west, south), (east, north) = header.mins[:2], header.maxs[:2]
    credible = np.isfinite([west, south, east, north]).all() and west < east and south < north
    if not credible:
        return (-np.inf, -np.inf, np.inf, np.inf)
    return float(west), float(south), float(east), float(north)

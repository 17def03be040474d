"""The road as points: one a cell of half a metre, in a LAZ file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from lazrs import LazrsError
from pyproj import CRS

from gis_radar.arrays import Floats
from gis_radar.crs import metric_crs, require_same
from gis_radar.errors import InputError
from gis_radar.scans.scan import check_header

ROAD_SURFACE = 11  # ASPRS
_SCALE_M = 0.001


def write_road(points: Floats, path: Path, *, crs: CRS) -> None:
    """Write the points of a road as LAZ 1.4 with its coordinate system, to the millimetre.

    Parameters
    ----------
    points : (n, 3) array
        Easting, northing, height, metres.
    path : Path
        The file.
    crs : CRS
        Of the points.
    """
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(points.min(axis=0))
    header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = points
    las.classification = np.full(len(points), ROAD_SURFACE, np.uint8)
    las.return_number = np.ones(len(points), np.uint8)
    las.number_of_returns = np.ones(len(points), np.uint8)
    las.write(path)


def read_road(path: str | Path, crs: CRS) -> Floats:
    """Read the points of a road, as the mask of an airborne scan leaves them.

    Parameters
    ----------
    path : str or Path
        LAS or LAZ.
    crs : CRS
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
    scan = _opened(path, laspy.read)
    require_same(_crs_of(scan, path), crs, what=str(path), other_what="the map")
    if len(scan.points) == 0:
        raise InputError(f"{path}: scan without points")
    return np.asarray(scan.xyz)


def road_crs(path: str | Path) -> CRS:
    """Return the coordinate system that a scan says it is in.

    Raises
    ------
    InputError
        If the file is damaged; CrsError if its CRS is missing or not metric.
    """
    return _crs_of(_opened(path, _header), path)


def _header(path: str | Path) -> Any:
    with laspy.open(path) as file:
        return file


def _opened(path: str | Path, how: Callable[[str | Path], Any]) -> Any:
    check_header(path)
    try:
        return how(path)
    except (laspy.LaspyException, LazrsError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable LAS or LAZ file: {error}") from error


def _crs_of(scan: Any, path: str | Path) -> CRS:
    return metric_crs(scan.header.parse_crs(), what=str(path))

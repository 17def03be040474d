"""A GeoPackage of sensors: layers of points, views and uncertainties, with styles (`*.qml`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import geopandas as gpd
import shapely

from gis_radar.base import (
    UsageError,
    add_layer,
    atomic_write,
    checked,
    copy_saved_styles,
    require_same,
    style_layers,
)
from gis_radar.poses.pose import ANGLES, POSITION, Pose, View, ellipse

SENSORS, VIEWS, UNCERTAINTY = "sensors", "views", "uncertainty"
_COMPONENTS = (*POSITION, *ANGLES)
_EVIDENCE = ("fitness", "converged", "observable", "method", "time", "frames")


@checked
def write_sensors(poses: Sequence[Pose], path: str | Path) -> None:
    """Write sensors as the layers `sensors`, `views` and `uncertainty` of a GeoPackage.

    Parameters
    ----------
    poses : sequence of Pose
        At least one, all in one coordinate system. A pose without a view gets the default one.
    path : str or Path
        The GeoPackage; it appears whole or not at all. QGIS loads its styles by itself.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`, or there is no pose.
    CrsError
        If the poses are not all in one coordinate system.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: sensors are written as GeoPackage", path, hint="end it in .gpkg")
    if not poses:
        raise UsageError("there is no pose to write")
    for pose in poses[1:]:
        require_same(pose.crs, poses[0].crs, what=pose.sensor, other_what=poses[0].sensor)
    poses = sorted(poses, key=lambda pose: pose.sensor)  # equal files for any order of the input
    layers = {SENSORS: _points(poses), VIEWS: _views(poses), UNCERTAINTY: _ellipses(poses)}
    kinds = {SENSORS: "Point", VIEWS: "Polygon", UNCERTAINTY: "Polygon"}
    with atomic_write(path) as part:
        for name, table in layers.items():
            add_layer(table, part, name, geometry_type=kinds[name])
        styles = {name: read_style(name) for name in layers}
        style_layers(part, styles, name="sensor", about="where a sensor stands and looks")
        copy_saved_styles(part, earlier=path)


def read_style(layer: str) -> str:
    """Return the QGIS style of a layer of sensors as QML."""
    return (files(__package__) / f"{layer}.qml").read_text(encoding="utf-8")


def _points(poses: Sequence[Pose]) -> gpd.GeoDataFrame:
    points = shapely.points([(pose.easting, pose.northing) for pose in poses])
    return gpd.GeoDataFrame([_row(pose) for pose in poses], geometry=points, crs=poses[0].crs)


def _row(pose: Pose) -> dict[str, Any]:
    sigma = pose.parsed_evidence().sigma
    evidence = {name: pose.evidence.get(name) for name in _EVIDENCE}
    return {
        "sensor": pose.sensor,
        **{name: getattr(pose, name) for name in _COMPONENTS},
        **{f"sigma_{name}": sigma.get(name, math.nan) for name in _COMPONENTS},
        **{name: None if value is None else str(value) for name, value in evidence.items()},
        **vars(pose.view or View()),
    }


def _views(poses: Sequence[Pose]) -> gpd.GeoDataFrame:
    rows = [{"sensor": pose.sensor, **vars(pose.view or View())} for pose in poses]
    shapes = [pose.outline() for pose in poses]
    return gpd.GeoDataFrame(rows, geometry=shapes, crs=poses[0].crs)


def _ellipses(poses: Sequence[Pose]) -> gpd.GeoDataFrame:
    stated = [(pose, cov) for pose in poses if (cov := pose.plane_covariance()) is not None]
    rows = {
        "sensor": [pose.sensor for pose, _ in stated],
        "sigma_easting": [math.sqrt(cov[0, 0]) for _, cov in stated],
        "sigma_northing": [math.sqrt(cov[1, 1]) for _, cov in stated],
    }
    shapes = [ellipse(pose.position[:2], cov) for pose, cov in stated]
    return gpd.GeoDataFrame(rows, geometry=shapes, crs=poses[0].crs)

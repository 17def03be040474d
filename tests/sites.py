"""Small sites that tests make: tiles along straight lanes, recordings, poses."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyproj import CRS

from gis_radar.hdmap import polygons
from gis_radar.poses import Pose, View

UTM = CRS.from_epsg(25832)
EAST, NORTH = 678_000.0, 5_403_600.0
START = 1_700_000_000.0


def lane_quads(x, y, heading_deg, *, count=40, length_m=0.5, width_m=3.2):
    """Quads of a straight lane that begins in the middle of (x, y)."""
    heading = np.radians(heading_deg)
    along = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-along[1], along[0]]) * width_m / 2
    middle = np.array([x, y]) + np.arange(count + 1)[:, None] * length_m * along
    rights, lefts = middle - left, middle + left
    return np.stack([rights[:-1], rights[1:], lefts[1:], lefts[:-1]], axis=1)


def tiles_of(lanes, *, height_m=np.nan, crs=UTM):
    """Tiles of several lanes, each (n, 4, 2) quads; lanelets are numbered from 100."""
    counts = [len(lane) for lane in lanes]
    total = sum(counts)
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(total),
            "lanelet_id": np.repeat(np.arange(len(lanes)) + 100, counts),
            "index": np.concatenate([np.arange(count) for count in counts]),
            "s_m": np.concatenate([np.arange(count) * 0.5 for count in counts]),
            "length_m": np.full(total, 0.5),
            "width_m": np.full(total, 3.2),
            "height_m": np.repeat(np.broadcast_to(height_m, len(lanes)).astype(float), counts),
            "subtype": ["road"] * total,
        },
        geometry=polygons(np.concatenate(lanes)),
        crs=crs,
    )


def crossing(height_m=370.0):
    """Two lanes that cross at right angles, 20 m each, 10 m in front of the default pose."""
    return tiles_of(
        [
            lane_quads(EAST + 10.0, NORTH, 0.0),
            lane_quads(EAST + 20.0, NORTH - 10.0, 90.0),
        ],
        height_m=height_m,
    )


def pose(**changes):
    """A sensor 5 m over the road that looks east."""
    fields = {
        "sensor": "R1", "crs": UTM, "easting": EAST, "northing": NORTH, "height": 375.0,
        "yaw": 0.0, "pitch": 0.0, "roll": 0.0, "view": View(max_range_m=100.0, elevation_deg=90.0),
    }  # fmt: skip
    return Pose(**(fields | changes))


def table(time, points, range_rate=0.0, rcs=5.0, **further):
    """A recording as an Arrow table; a point of NaN is a frame without detections."""
    points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    empty = np.isnan(points[:, 0])
    columns = {"time": np.asarray(time, dtype=np.float64)}
    columns |= {axis: points[:, i] for i, axis in enumerate("xyz")}
    for name, value in (("range_rate", range_rate), ("rcs", rcs)):
        filled = np.broadcast_to(np.float32(value), len(points)).copy()
        filled[empty] = np.nan
        columns[name] = filled
    return pa.table(columns | further)


def recording(path: Path, time, points, **columns):
    """Write a recording and return its path."""
    pq.write_table(table(time, points, **columns), path)
    return path

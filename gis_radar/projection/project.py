"""Points of a recording, as a table or as a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import geopandas as gpd
import pyarrow as pa
import shapely

from gis_radar.errors import UsageError
from gis_radar.files import refuse_inputs, whole_file
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.projection.points import (
    GEOMETRY,
    PointStream,
    write_points_geopackage,
    write_points_geoparquet,
    write_points_las,
)
from gis_radar.recordings.recording import Recording, as_recording

WRITERS: dict[str, Callable[[PointStream, Path], None]] = {
    ".gpkg": write_points_geopackage,
    ".laz": write_points_las,
    ".las": write_points_las,
    ".parquet": write_points_geoparquet,
}


def project(
    recording: str | Path | Recording, pose: Pose | PoseTrack, *, reporter: Reporter = QUIET
) -> gpd.GeoDataFrame:
    """Return the detections of a recording as points in the map.

    Parameters
    ----------
    recording : str, Path or Recording
        What the sensor recorded.
    pose : Pose or PoseTrack
        Where it stood and looked.
    reporter : Reporter
        Receives progress, and which columns are renamed.

    Returns
    -------
    GeoDataFrame
        A row a detection: Point Z in the pose's CRS, the recording's columns, `sensor`, and
        `utc`, the time as a time stamp. A further column of the recording whose name is taken
        ends in `_recorded`.
    """
    batches = PointStream(as_recording(recording), as_track(pose), reporter)
    table = pa.Table.from_batches(batches, schema=batches.schema)
    frame = table.drop_columns([GEOMETRY]).to_pandas()
    points = shapely.from_wkb(table[GEOMETRY].to_numpy())
    return gpd.GeoDataFrame(frame, geometry=points, crs=batches.pose.crs)


def write_projection(
    recording: str | Path | Recording,
    pose: Pose | PoseTrack,
    path: str | Path,
    *,
    reporter: Reporter = QUIET,
) -> int:
    """Write the detections of a recording as points in the map, in bounded memory.

    Parameters
    ----------
    recording, pose, reporter
        As for :func:`project`.
    path : str or Path
        GeoPackage (layer `hits`), LAZ or LAS, or GeoParquet, by its ending. What a format
        cannot hold is left out with a warning.

    Returns
    -------
    int
        How many points were written.

    Raises
    ------
    UsageError
        If the ending names no known format.
    InputError
        If the recording is damaged.
    OutputError
        If the file cannot be written, or is the recording itself.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise UsageError(
            f"{path}: not a known format for points", hint=f"known endings: {', '.join(WRITERS)}"
        )
    source = as_recording(recording)
    refuse_inputs(path, source.path)
    points = PointStream(source, as_track(pose), reporter)
    with whole_file(path) as part:
        WRITERS[path.suffix.lower()](points, part)
    return points.rows

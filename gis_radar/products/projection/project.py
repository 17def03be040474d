"""Points of a recording in the map, as a table, or as GeoPackage, GeoParquet, LAS or LAZ."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import geopandas as gpd
import lazy_loader
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import shapely

from gis_radar.base import (
    FILE_DATE,
    QUIET,
    Floats,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    gps_seconds,
    name_of,
    refuse_inputs,
    require_true_scale,
    write_stream,
)
from gis_radar.poses import Pose, PoseTrack, as_track
from gis_radar.recordings import Detections, Recording, as_recording

laspy = lazy_loader.load("laspy")  # 0.2 s, and most files written are no scans


def project(
    recording: str | Path | Recording,
    pose: Pose | PoseTrack | str | Path,
    *,
    reporter: Reporter = QUIET,
) -> gpd.GeoDataFrame:
    """Return the detections of a recording as points in the map.

    Parameters
    ----------
    recording : str, Path or Recording
        The sensor's recording.
    pose : Pose, PoseTrack or its file
        Pose of the sensor.
    reporter : Reporter
        Receives progress and the names of renamed columns.

    Returns
    -------
    GeoDataFrame
        A row a detection: Point Z in the pose's CRS, the recording's columns, `sensor`, and
        `utc`, the time as a time stamp. A further column of the recording whose name is taken
        ends in `_recorded`.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> points = gr.project(sample / "R1.parquet", gr.read_pose(sample / "R1.json"))
    >>> len(points), points.crs.to_string()
    (167616, 'EPSG:25832')
    """
    batches = _PointStream(as_recording(recording), as_track(pose), reporter)
    table = pa.Table.from_batches(batches, schema=batches.schema)
    frame = table.drop_columns([_GEOMETRY]).to_pandas()
    points = shapely.from_wkb(table[_GEOMETRY].to_numpy())
    return gpd.GeoDataFrame(frame, geometry=points, crs=batches.pose.crs)


def write_projection(
    recording: str | Path | Recording,
    pose: Pose | PoseTrack | str | Path,
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
        cannot hold is left out with a warning. GeoParquet holds places to 4 mm, and is by far the
        smallest; QGIS and GDAL read its points from GDAL 3.9 on.

    Returns
    -------
    int
        Number of points written.

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
            "{}: not a known format for points",
            path,
            hint=Text("known endings: {}", ", ".join(WRITERS)),
        )
    source = as_recording(recording)
    refuse_inputs(path, source.path)
    points = _PointStream(source, as_track(pose), reporter)
    with atomic_write(path) as part:
        WRITERS[path.suffix.lower()](points, part)
    return points.rows


_SUFFIX = "_recorded"
_GEOMETRY = "geometry"
_OWN = pa.schema(
    [
        ("sensor", pa.string()),
        ("time", pa.float64()),
        ("utc", pa.timestamp("us", tz="UTC")),
        *((name, pa.float32()) for name in ("x", "y", "z", "range_rate", "rcs")),
    ]
)
# GeoPackages have columns of these names themselves, and do not distinguish upper and lower case.
_TAKEN = (*_OWN.names, _GEOMETRY, "geom", "fid")


def _distinct_names(names: Iterable[str], taken: Iterable[str]) -> dict[str, str]:
    """Map each name to one that differs from all others by more than case."""
    used = {name.lower() for name in taken}
    renamed: dict[str, str] = {}
    for name in names:
        new_name = name or "unnamed"
        while new_name.lower() in used:
            new_name += _SUFFIX
        used.add(new_name.lower())
        renamed[name] = new_name
    return renamed


def _renamed(names: dict[str, str]) -> list[str]:
    """Return a text for each name that changed."""
    return [f"{name!r} to {fresh!r}" for name, fresh in names.items() if name != fresh]


def _value_type(kind: pa.DataType) -> pa.DataType:
    """Return the type of a column's values, whatever their encoding (such as a dictionary)."""
    if pa.types.is_dictionary(kind):
        return _value_type(kind.value_type)
    if pa.types.is_null(kind):
        return pa.string()
    return kind


_STAGE = "projecting"


class _PointStream:
    """Stream of a recording's detections as points in the map, computed on reading; usable once.

    All batches are of `schema`, with the geometry as WKB. `pose` is the first one: it names the
    coordinate system and a place near the points. `rows` counts the points so far.
    """

    def __init__(self, recording: Recording, track: PoseTrack, reporter: Reporter) -> None:
        self._recording, self._track = recording, track
        self._batches = recording.read(further=True)
        self._first = next(self._batches)
        further = self._first.further.schema
        self.names = _distinct_names(further.names, _TAKEN)
        kept = [pa.field(self.names[field.name], _value_type(field.type)) for field in further]
        self.schema: pa.Schema = pa.schema([*_OWN, *kept, pa.field(_GEOMETRY, pa.binary())])
        self.pose: Pose = track.poses[0]
        for pose in track.poses:  # refuse degrees, millimetres, swapped axes
            whose = Text("pose of {}", pose.sensor)
            require_true_scale(pose.crs, pose.easting, pose.northing, what=whose)
        self.rows = 0
        self.reporter = reporter
        if not recording.measures_elevation():
            level = "measures no elevation: its detections are placed at the height of the sensor"
            reporter.warn("{}: {} {}", recording.path.name, track.sensor, level)
        if changed := _renamed(self.names):
            reporter.warn("{}: columns renamed: {}", recording.path.name, ", ".join(changed))

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        done = 0
        for rows in chain([self._first], self._batches):
            batch = self._batch(rows.take(rows.present))
            self.rows += len(batch)
            yield batch
            done += len(rows)
            self.reporter.progress(_STAGE, done, self._recording.rows)

    def _batch(self, detections: Detections) -> pa.RecordBatch:
        micros = np.rint(detections.time * 1e6).astype(np.int64)
        own_columns = [
            pa.array([self._track.sensor] * len(detections), pa.string()),
            pa.array(detections.time),
            pa.array(micros).cast(pa.timestamp("us", tz="UTC")),
            *(_floats(detections.points[:, axis]) for axis in range(3)),
            _floats(detections.range_rate),
            _floats(detections.rcs),
        ]
        further = [
            pc.cast(column, self.schema.field(self.names[name]).type)
            for name, column in zip(
                detections.further.schema.names, detections.further.columns, strict=True
            )
        ]
        points = shapely.points(self._in_map(detections))
        geometry = pa.array(shapely.to_wkb(points), pa.binary())
        return pa.RecordBatch.from_arrays([*own_columns, *further, geometry], schema=self.schema)

    def _in_map(self, detections: Detections) -> Floats:
        """Return the places of detections in the map."""
        places = np.empty_like(detections.points)
        pose_indices = self._track.at(detections.time)
        for pose_index in np.unique(pose_indices):
            in_force = pose_indices == pose_index
            places[in_force] = self._track.poses[pose_index].to_map(detections.points[in_force])
        return places


def _floats(values: np.ndarray) -> pa.Array:
    # A value too large for float32 becomes infinite, which readers of the file see.
    with np.errstate(over="ignore"):
        return pa.array(values.astype(np.float32))


_LAYER = "hits"
_PLACE_M = 1.0 / 128.0  # of places in GeoParquet: a radar resolves decimetres
# GDAL reads it from 3.9 on, GeoPandas from 1.0; as WKB, points take 1.3 to 1.4 times as much.
_POINT = pa.struct([pa.field(axis, pa.float64(), nullable=False) for axis in "xyz"])
_SPLIT = "BYTE_STREAM_SPLIT"
_LEVEL = 14  # of zstd: split bytes take a sixth less room than at level 9
_NUMERIC = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean)
_NOT_IN_GEOPACKAGE = (pa.types.is_duration, pa.types.is_interval, pa.types.is_decimal256)


def write_points_geopackage(points: _PointStream, path: Path) -> None:
    """Write the layer `hits` of a GeoPackage."""
    storable = [
        field.name
        for field in points.schema
        if not any(is_kind(field.type) for is_kind in _NOT_IN_GEOPACKAGE)
    ]
    if left := [name for name in points.schema.names if name not in storable]:
        lost = Text("{}: a GeoPackage cannot hold {}: left out", path.name, ", ".join(left))
        points.reporter.warn(lost)
    write_stream(
        (batch.select(storable) for batch in points),
        pa.schema([points.schema.field(name) for name in storable]),
        path,
        layer=_LAYER,
        geometry_name=_GEOMETRY,
        geometry_type="Point Z",
        crs=name_of(points.pose.crs),
    )


def write_points_geoparquet(points: _PointStream, path: Path) -> None:
    """Write a GeoParquet file: points in its native encoding, a column an axis."""
    crs = points.pose.crs.to_json_dict()
    column = {"encoding": "point", "geometry_types": ["Point Z"], "crs": crs}
    geo = {"version": "1.1.0", "primary_column": _GEOMETRY, "columns": {_GEOMETRY: column}}
    place = points.schema.get_field_index(_GEOMETRY)
    schema = points.schema.set(place, pa.field(_GEOMETRY, _POINT))
    split = [f"{_GEOMETRY}.{field.name}" for field in _POINT]
    split += [field.name for field in schema if pa.types.is_float32(field.type)]
    options: dict[str, Any] = {
        "compression": "zstd", "compression_level": _LEVEL, "write_page_checksum": True,
        "use_dictionary": [name for name in schema.names if name not in {*split, _GEOMETRY}],
        "column_encoding": dict.fromkeys(split, _SPLIT),
    }  # fmt: skip
    with pq.ParquetWriter(
        path, schema.with_metadata({"geo": json.dumps(geo)}), **options
    ) as writer:
        for batch in points:
            writer.write_batch(_in_columns(batch, schema))


def _in_columns(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return a batch with points as columns, on a grid whose last digits take no room."""
    points = shapely.from_wkb(batch[_GEOMETRY].to_numpy(zero_copy_only=False))
    places = shapely.get_coordinates(points, include_z=True)
    rounded = (np.rint(places / _PLACE_M) * _PLACE_M).T
    axes = pa.StructArray.from_arrays([pa.array(axis) for axis in rounded], fields=list(_POINT))
    place = schema.get_field_index(_GEOMETRY)
    columns = [*batch.columns[:place], axes, *batch.columns[place + 1 :]]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


_SCALE_M = 0.001  # resolution of LAS coordinates; a radar resolves decimetres
_POINT_FORMAT = 6  # the plain one of LAS 1.4, with GPS time
_TIME_OFFSET_S = 1_000_000_000  # adjusted standard GPS time
_LONGEST_NAME = 32  # bytes of an extra dimension in LAS
_MISSING = int(np.iinfo(np.int64).min)


@dataclass(frozen=True, kw_only=True)
class _Dimension:
    """A column of the points as an extra dimension; `_MISSING` stands for null in integers."""

    column: str
    name: str
    kind: type[np.generic]
    about: str = ""

    def params(self) -> Any:
        return laspy.ExtraBytesParams(self.name, self.kind, self.about)

    def values(self, batch: pa.RecordBatch) -> np.ndarray:
        column = batch[self.column]
        if self.kind is np.int64:
            column = pc.fill_null(pc.cast(column, pa.int64()), _MISSING)
        elif not pa.types.is_floating(column.type):
            column = pc.cast(column, pa.float64(), safe=False)  # 64-bit integers lose digits
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=self.kind)


_OURS = (
    _Dimension(column="time", name="time", kind=np.float64, about="UNIX seconds, UTC"),
    _Dimension(column="range_rate", name="range_rate", kind=np.float32, about="m/s, receding > 0"),
    _Dimension(column="rcs", name="rcs", kind=np.float32, about="dBm2"),
    _Dimension(column="x", name="sensor_x", kind=np.float32, about="m forward of the sensor"),
    _Dimension(column="y", name="sensor_y", kind=np.float32, about="m left of the sensor"),
    _Dimension(column="z", name="sensor_z", kind=np.float32, about="m up from the sensor"),
)


def write_points_las(points: _PointStream, path: Path) -> None:
    """Write LAS 1.4 or LAZ, by the ending of `path`; columns without numbers are left out."""
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    header.offsets = np.floor(points.pose.position)
    header.creation_date = FILE_DATE
    header.scales = np.full(3, _SCALE_M)
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(points.pose.crs)
    dimensions = _dimensions(points, path, list(header.point_format.dimension_names))
    header.add_extra_dims([dimension.params() for dimension in dimensions])
    with laspy.open(path, mode="w", header=header) as writer:
        for batch in points:
            writer.write_points(_scan_points(batch, header, dimensions))


def _dimensions(points: _PointStream, path: Path, standard: list[str]) -> list[_Dimension]:
    further = [f for f in points.schema if f.name not in {*_OWN.names, _GEOMETRY}]
    taken = [*standard, *_OWN.names, *(ours.name for ours in _OURS), "xyz"]
    names = _distinct_names([f.name for f in further if _fits_las(f)], taken)
    remarks = []
    if left := [field.name for field in further if field.name not in names]:
        remarks.append(Text("left out, no numbers or a long name: {}", ", ".join(left)))
    if changed := _renamed(names):
        remarks.append(Text("renamed: {}", ", ".join(changed)))
    if remarks:
        points.reporter.warn("{}: columns {}", path.name, Text("; ").join(remarks))
    kept = [_dimension(f, names[f.name]) for f in further if f.name in names]
    return [*_OURS, *kept]


def _fits_las(field: pa.Field) -> bool:
    longest = _LONGEST_NAME - len(_SUFFIX)
    return len(field.name.encode()) <= longest and any(each(field.type) for each in _NUMERIC)


def _dimension(field: pa.Field, name: str) -> _Dimension:
    kind, types = field.type, pa.types
    if types.is_boolean(kind) or (types.is_integer(kind) and not types.is_uint64(kind)):
        about = f"missing: {_MISSING}"
        return _Dimension(column=field.name, name=name, kind=np.int64, about=about)
    short = types.is_floating(kind) and kind.bit_width <= 32
    return _Dimension(column=field.name, name=name, kind=np.float32 if short else np.float64)


def _scan_points(batch: pa.RecordBatch, header: Any, dimensions: list[_Dimension]) -> Any:
    scan = laspy.ScaleAwarePointRecord.zeros(len(batch), header=header)
    places: Floats = shapely.get_coordinates(
        shapely.from_wkb(batch[_GEOMETRY].to_numpy(zero_copy_only=False)), include_z=True
    )
    scan.x, scan.y, scan.z = places.T
    for dimension in dimensions:
        scan[dimension.name] = dimension.values(batch)
    scan.gps_time = gps_seconds(scan["time"]) - _TIME_OFFSET_S
    scan.return_number[:] = scan.number_of_returns[:] = 1
    return scan


WRITERS: dict[str, Callable[[_PointStream, Path], None]] = {
    ".gpkg": write_points_geopackage,
    ".laz": write_points_las,
    ".las": write_points_las,
    ".parquet": write_points_geoparquet,
}

"""Points of a recording in the map, batch by batch, all of one schema."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import Pose
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections, Recording

SUFFIX = "_recorded"
GEOMETRY = "geometry"
OWN = pa.schema(
    [
        ("sensor", pa.string()),
        ("time", pa.float64()),
        ("utc", pa.timestamp("us", tz="UTC")),
        ("x", pa.float32()),
        ("y", pa.float32()),
        ("z", pa.float32()),
        ("range_rate", pa.float32()),
        ("rcs", pa.float32()),
    ]
)
# GeoPackages have columns of these names themselves, and know no upper and lower case.
TAKEN = (*OWN.names, GEOMETRY, "geom", "fid")


def distinct_names(
    names: Iterable[str], taken: Collection[str], *, longest: int | None = None
) -> dict[str, str]:
    """Give each name one that differs from all others by more than upper and lower case.

    Parameters
    ----------
    names : iterable of str
        Names to keep where possible.
    taken : collection of str
        Names that others have already.
    longest : int, optional
        The most bytes a name may have in UTF-8.

    Returns
    -------
    dict
        From each name to its new one, in the same order.
    """
    used = {name.lower() for name in taken}
    given: dict[str, str] = {}
    for name in names:
        endings = ("", SUFFIX, *(f"{SUFFIX}_{number}" for number in range(2, len(used) + 3)))
        fresh = next(
            fitting
            for ending in endings
            if (fitting := _fitting(name or "unnamed", ending, longest)).lower() not in used
        )
        used.add(fresh.lower())
        given[name] = fresh
    return given


def _fitting(name: str, ending: str, longest: int | None) -> str:
    if longest is None:
        return name + ending
    room = longest - len(ending.encode())
    return name.encode()[:room].decode(errors="ignore") + ending


def renamed(names: dict[str, str]) -> list[str]:
    """Return which names changed, one text a name."""
    return [f"{name!r} to {fresh!r}" for name, fresh in names.items() if name != fresh]


def points_schema(further: pa.Schema, names: dict[str, str]) -> pa.Schema:
    """Return the schema of all batches of points.

    Parameters
    ----------
    further : pyarrow.Schema
        The recording's further columns.
    names : dict
        What they are called here.
    """
    kept = [pa.field(names[field.name], _plain(field.type)) for field in further]
    return pa.schema([*OWN, *kept, pa.field(GEOMETRY, pa.binary())])


def _plain(kind: pa.DataType) -> pa.DataType:
    """Return the type of a column's values, without how they are stored."""
    if pa.types.is_dictionary(kind):
        return _plain(kind.value_type)
    if pa.types.is_null(kind):
        return pa.string()
    return kind


STAGE = "projecting"


class PointStream:
    """A recording's detections as points in the map, computed while they are read, once.

    Parameters
    ----------
    recording : Recording
        What the sensor recorded.
    track : PoseTrack
        Where it stood and looked.
    reporter : Reporter
        Receives progress, and which columns are renamed.

    Attributes
    ----------
    schema : pyarrow.Schema
        The columns of every batch, the geometry as WKB.
    pose : Pose
        The first pose: it names the coordinate system and a place near the points.
    rows : int
        How many points there were so far.
    reporter : Reporter
        Where remarks go.
    """

    def __init__(self, recording: Recording, track: PoseTrack, reporter: Reporter) -> None:
        self._recording, self._track = recording, track
        self._pieces = recording.read()
        self._first = next(self._pieces)
        self.names = distinct_names(self._first.further.schema.names, TAKEN)
        self.schema: pa.Schema = points_schema(self._first.further.schema, self.names)
        self.pose: Pose = track.poses[0]
        self.rows = 0
        self.reporter = reporter
        if changed := renamed(self.names):
            reporter.log(f"{recording.path.name}: columns renamed: {', '.join(changed)}", "warning")

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        done = 0
        piece: Detections | None = self._first
        while piece is not None:
            batch = self._batch(piece.take(piece.present))
            self.rows += len(batch)
            yield batch
            done += len(piece)
            self.reporter.progress(STAGE, done, self._recording.rows)
            piece = next(self._pieces, None)

    def _batch(self, detections: Detections) -> pa.RecordBatch:
        micros = np.rint(detections.time * 1e6).astype(np.int64)
        own = [
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
        geometry = pa.array(shapely.to_wkb(self._in_map(detections)), pa.binary())
        return pa.RecordBatch.from_arrays([*own, *further, geometry], schema=self.schema)

    def _in_map(self, detections: Detections) -> np.ndarray:
        places = np.empty_like(detections.points)
        held = self._track.at(detections.time)
        for pose_index in np.unique(held):
            now = held == pose_index
            places[now] = self._track.poses[pose_index].to_map(detections.points[now])
        return np.asarray(shapely.points(places))


def _floats(values: np.ndarray) -> pa.Array:
    # A value too large for float32 becomes infinite, which readers of the file see.
    with np.errstate(over="ignore"):
        return pa.array(values.astype(np.float32))

"""Points in the map, batch by batch, all of one schema."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from gis_radar.detections import Detections, Recording
from gis_radar.pose import Pose
from gis_radar.pose_files import PoseTrack
from gis_radar.progress import Reporter
from gis_radar.projection.columns import TAKEN, distinct_names, points_schema, renamed

STAGE = "projecting"


class Points:
    """A recording's detections as points in the map, computed while they are read, once.

    Parameters
    ----------
    recording : Recording
        What the sensor recorded.
    track : PoseTrack
        Where it stood and looked.
    reporter : Reporter
        Hears how far the work is, and which columns got other names.

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

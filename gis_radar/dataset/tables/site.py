"""The tables of a dataset that have one file: its recordings, poses and sights."""

import pyarrow as pa

from gis_radar.base import Text
from gis_radar.dataset.tables.table import POSE, SENSOR, TILE, TableColumn, TableSchema

_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int64()

RECORDINGS = TableSchema(
    name="recordings",
    means="a recording and the hours that were made with it",
    columns=(
        TableColumn("path", _TEXT, Text("the file")),
        TableColumn("digest", _TEXT, "SHA-256 of the file"),
        SENSOR, POSE,
        TableColumn("first_time", _NUMBER, "first frame, UNIX seconds, corrected"),
        TableColumn("last_time", _NUMBER, "last frame, UNIX seconds, corrected"),
        TableColumn("clock_offset", _NUMBER, "by which its clock is ahead, seconds"),
        TableColumn("clock_drift_ppm", _NUMBER, "by how much its clock runs fast, us/s"),
        TableColumn("clock_at", _NUMBER, "when the offset holds, UNIX seconds of its clock"),
        TableColumn("validity_s", _NUMBER, "how long its frames are valid, seconds"),
        TableColumn("rows", _COUNT, "rows of the file"),
        TableColumn("has_rates", pa.bool_(), "whether it has range rates"),
        TableColumn("has_elevation", pa.bool_(), "whether it measures elevation"),
        TableColumn("hours", pa.list_(pa.int64()), "hours since 1970 that were made with it"),
    ),
    order=("sensor", "first_time", "digest"),
    period="dataset",
)  # fmt: skip

POSES = TableSchema(
    name="poses",
    means="where a sensor stands and looks",
    columns=(
        POSE, SENSOR,
        TableColumn("easting", _NUMBER, "metres"),
        TableColumn("northing", _NUMBER, "metres"),
        TableColumn("height", _NUMBER, "metres"),
        TableColumn("yaw", _NUMBER, "degrees"),
        TableColumn("pitch", _NUMBER, "degrees"),
        TableColumn("roll", _NUMBER, "degrees"),
        TableColumn("track", _TEXT, "pose track that it is of, as in `recordings.pose`"),
        TableColumn("since", _NUMBER, "from when on it holds, UNIX seconds; null: always", True),
        TableColumn("sight", _TEXT, "pose in `sights` that has seen the same, and in `frames`"),
        TableColumn("road_m", _NUMBER, "height of the road near it, metres; null: unknown", True),
        TableColumn("document", _TEXT, "the pose as JSON"),
    ),
    order=("pose",),
    period="dataset",
)  # fmt: skip

SIGHTS = TableSchema(
    name="sights",
    means="a tile in sight of a pose",
    columns=(POSE, TILE),
    order=("pose", "tile_id"),
    period="dataset",
)

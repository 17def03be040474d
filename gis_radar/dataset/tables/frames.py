"""Frames: what each sensor delivered, the evidence of data quality."""

import pyarrow as pa

from gis_radar.dataset.tables.table import FIRST, SENSOR, TableColumn, TableSchema

_COUNT, _LARGE, _TEXT = pa.int32(), pa.int64(), pa.string()

FRAMES = TableSchema(
    name="frames",
    means="a frame of a sensor",
    columns=(
        SENSOR,
        TableColumn("time_us", _LARGE, "time since 1970, corrected, microseconds"),
        FIRST,
        TableColumn(
            "last_step", _LARGE, "last step in which it is valid, perhaps of the next hour"
        ),
        TableColumn("detections", _COUNT, "detections"),
        TableColumn("moving", _COUNT, "of them, moving ones"),
        TableColumn("pose", _TEXT, "pose in `sights` whose tiles were in sight"),
        TableColumn("wild", _COUNT, "detections too fast for any vehicle"),
        TableColumn("tiles_hit", _COUNT, "tiles that it hit"),
        TableColumn("tiles_seen", _COUNT, "tiles in sight of its pose"),
        TableColumn("checksum", _COUNT, "16 bits of a hash, equal where frames repeat"),
        TableColumn("shift_us", _LARGE, "what was added to its time, microseconds"),
        TableColumn("pose_in_force", _TEXT, "pose in `poses` by which it lies in the map"),
    ),
    order=("sensor", "time_us"),
    span=("first_step", "first_step"),
)

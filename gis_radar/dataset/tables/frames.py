"""Frames: what each sensor delivered, the evidence of data quality."""

import pyarrow as pa

from gis_radar.dataset.tables.table import FIRST, POSE, SENSOR, TableColumn, TableSchema

_COUNT, _LARGE = pa.int32(), pa.int64()

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
        POSE,
        TableColumn("wild", _COUNT, "detections too fast for any vehicle"),
        TableColumn("tiles_hit", _COUNT, "tiles that it hit"),
        TableColumn("tiles_seen", _COUNT, "tiles in sight of its pose"),
        TableColumn("checksum", _COUNT, "16 bits of a hash, equal where frames repeat"),
        TableColumn("shift_us", _LARGE, "what was added to its time, microseconds"),
    ),
    order=("sensor", "time_us"),
    span=("first_step", "first_step"),
)

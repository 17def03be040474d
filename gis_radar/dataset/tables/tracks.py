"""Tracks: states of vehicles, five a second."""

import pyarrow as pa

from gis_radar.dataset.tables.table import STEP, VEHICLE, TableColumn, TableSchema

TRACK_EVERY_STEPS = 4
"""Steps between two states: `step` is divisible by it but for a vehicle's first and last."""

_CM = pa.int32()

TRACKS = TableSchema(
    name="tracks",
    means="the state of a vehicle at a step's begin",
    columns=(
        VEHICLE, STEP,
        TableColumn("x_cm", _CM, "centre of the footprint, east of the dataset's origin"),
        TableColumn("y_cm", _CM, "north of it"),
        TableColumn("heading_cdeg", _CM, "0.01 deg counter-clockwise from grid east"),
        TableColumn("speed_cms", _CM, "cm/s"),
        TableColumn("lanelet_id", pa.int64(), "the lanelet it follows; null off the lanes", True),
        TableColumn("s_cm", _CM, "its front along the lanelet; null off the lanes", True),
        TableColumn("d_cm", _CM, "left of the lanelet's centre; null off the lanes", True),
        TableColumn("seen", pa.bool_(), "measured within 0.5 s, else inferred"),
    ),
    order=("vehicle", "step"),
    span=("step", "step"),
)  # fmt: skip

"""Passages: vehicles over the middles of lanelets."""

import pyarrow as pa

from gis_radar.dataset.tables.table import STEP, VEHICLE, TableColumn, TableSchema

PASSAGES = TableSchema(
    name="passages",
    means="a vehicle's front passes the middle of a lanelet",
    columns=(
        VEHICLE,
        TableColumn("lanelet_id", pa.int64(), "the lanelet"),
        STEP,
        TableColumn("speed_cms", pa.int32(), "estimated speed of the vehicle in that step, cm/s"),
        TableColumn("p_heavy", pa.float32(), "probability that it is a bus or a truck over 3.5 t"),
    ),
    order=("step", "vehicle", "lanelet_id"),
    span=("step", "step"),
)

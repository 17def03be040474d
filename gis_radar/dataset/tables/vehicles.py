"""Vehicles, and which of them go on over an hour's begin."""

import pyarrow as pa

from gis_radar.dataset.tables.table import FIRST, LAST, VEHICLE, TableColumn, TableSchema

_NUMBER = pa.float32()

VEHICLES = TableSchema(
    name="vehicles",
    means="a vehicle in an hour",
    columns=(
        VEHICLE, FIRST, LAST,
        TableColumn("length_m", _NUMBER, "length"),
        TableColumn("width_m", _NUMBER, "width"),
        TableColumn("length_sigma_m", _NUMBER, "standard error of the length"),
        TableColumn("p_exists", _NUMBER, "probability that it exists; null: not known", True),
        TableColumn("p_heavy", _NUMBER, "probability that it is a bus or a truck over 3.5 t"),
        TableColumn("lanelets", pa.list_(pa.int64()), "the lanelets it followed, in order"),
    ),
    order=("vehicle",),
    span=("first_step", "last_step"),
)  # fmt: skip

CONTINUED = TableSchema(
    name="continued",
    means="two numbers of one vehicle on either side of the hour's begin",
    columns=(
        TableColumn("vehicle", pa.int64(), "its number in the hour before"),
        TableColumn("next", pa.int64(), "its number in this hour"),
    ),
    order=("vehicle",),
)

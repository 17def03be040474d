"""Runs of steps in which tiles were observed, visible or occupied."""

import pyarrow as pa

from gis_radar.dataset.tables.table import FIRST, LAST, TILE, TableColumn, TableSchema

OBSERVED = TableSchema(
    name="observed",
    means="a run of steps in which a tile was observed",
    columns=(TILE, FIRST, LAST),
    order=("tile_id", "first_step"),
    span=("first_step", "last_step"),
    runs=True,
)
VISIBLE = TableSchema(
    name="visible",
    means="a run of steps in which a tile was visible, and `seen` the same",
    columns=(
        TILE, FIRST, LAST,
        TableColumn("seen", pa.bool_(), "not hidden by vehicles; else hidden for up to 10 s"),
    ),
    order=("tile_id", "first_step"),
    span=("first_step", "last_step"),
    runs=True,
)  # fmt: skip
OCCUPIED = TableSchema(
    name="occupied",
    means="a run of steps in which a tile was occupied, visible or not, and `seen` the same",
    columns=(
        TILE, FIRST, LAST,
        TableColumn("seen", pa.bool_(), "the vehicle was measured within 0.5 s"),
    ),
    order=("tile_id", "first_step"),
    span=("first_step", "last_step"),
    runs=True,
)  # fmt: skip

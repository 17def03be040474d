"""Tile counts: steps of a tile in a quarter of an hour."""

import pyarrow as pa

from gis_radar.dataset.tables.table import TILE, TableColumn, TableSchema

_STEPS = pa.int32()

TILE_COUNTS = TableSchema(
    name="tile_counts",
    means="a tile in a quarter of an hour of the UTC day",
    columns=(
        TILE,
        TableColumn("interval", _STEPS, "quarter of an hour of the UTC day, 0 to 95"),
        TableColumn("hit_steps", _STEPS, "steps both hit and observed", share_of="observed_steps"),
        TableColumn("observed_steps", _STEPS, "steps observed"),
        TableColumn(
            "occupied_steps", _STEPS, "steps both occupied and visible", share_of="visible_steps"
        ),
        TableColumn("visible_steps", _STEPS, "steps visible"),
        TableColumn(
            "hidden_steps", _STEPS, "steps observed and not visible", share_of="observed_steps"
        ),
        TableColumn("occupied_variance", pa.float32(), "of occupied_steps by the tracks, steps^2"),
        TableColumn(
            "inferred_steps",
            _STEPS,
            "steps visible while hidden by vehicles",
            share_of="visible_steps",
        ),
    ),
    order=("tile_id", "interval"),
    period="day",
)

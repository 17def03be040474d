"""Hits: a tile and a step in which some sensor detected something on it."""

from gis_radar.dataset.tables.table import STEP, TILE, TableSchema

HITS = TableSchema(
    name="hits",
    means="a tile that was hit in a step, all sensors together",
    columns=(TILE, STEP),
    order=("tile_id", "step"),
    span=("step", "step"),
)

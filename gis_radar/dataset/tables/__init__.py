"""Schema of a dataset; each module owns columns, types, units and order of one or a few tables."""

from gis_radar.dataset.tables.frames import FRAMES
from gis_radar.dataset.tables.hits import HITS
from gis_radar.dataset.tables.passages import PASSAGES
from gis_radar.dataset.tables.runs import OBSERVED, OCCUPIED, VISIBLE
from gis_radar.dataset.tables.site import POSES, RECORDINGS, SIGHTS
from gis_radar.dataset.tables.table import TableColumn, TableSchema
from gis_radar.dataset.tables.tile_counts import TILE_COUNTS
from gis_radar.dataset.tables.tracks import TRACK_EVERY_STEPS, TRACKS
from gis_radar.dataset.tables.traffic import LANE_MEASURES, TURNS
from gis_radar.dataset.tables.vehicles import CONTINUED, VEHICLES

SCHEMA = 1
"""Of the contract: readers refuse a newer one."""

HIT_TABLES = (FRAMES, HITS, OBSERVED)
VEHICLE_TABLES = (VISIBLE, OCCUPIED, TRACKS, VEHICLES, CONTINUED, PASSAGES)
"""Absent where there are no range rates or lanes, or only hits are asked for."""

HOUR_TABLES = (*HIT_TABLES, *VEHICLE_TABLES)
DAY_TABLES = (TILE_COUNTS, LANE_MEASURES, TURNS)
TABLES = {table.name: table for table in (*HOUR_TABLES, *DAY_TABLES, RECORDINGS, POSES, SIGHTS)}

__all__ = [
    "CONTINUED", "DAY_TABLES", "FRAMES", "HITS", "HIT_TABLES", "HOUR_TABLES", "LANE_MEASURES",
    "OBSERVED", "OCCUPIED", "PASSAGES", "POSES", "RECORDINGS", "SCHEMA", "SIGHTS", "TABLES",
    "TILE_COUNTS", "TRACKS", "TRACK_EVERY_STEPS", "TURNS", "VEHICLES", "VEHICLE_TABLES", "VISIBLE",
    "TableColumn", "TableSchema",
]  # fmt: skip

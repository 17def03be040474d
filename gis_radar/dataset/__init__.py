"""The dataset of a site: tables as Parquet by hour, written whole, read lazily."""

from gis_radar.dataset.dataset import Dataset, open_dataset
from gis_radar.dataset.day_tables import STEPS_PER_QUARTER
from gis_radar.dataset.lane_measures import LaneTraffic
from gis_radar.dataset.manifest import (
    Manifest,
    create_dataset,
    require_same_site,
)
from gis_radar.dataset.parts import (
    STEPS_PER_HOUR,
    Origin,
    clear_unfinished,
    hour_of_step,
    hour_text,
    part_path,
    write_whole,
)
from gis_radar.dataset.records import (
    HourRecord,
    HourWriter,
    read_hour,
    read_hours,
    record_path,
    write_record,
)
from gis_radar.dataset.tile_counts import RUN_ERRORS, update_counts

__all__ = [
    "RUN_ERRORS",
    "STEPS_PER_HOUR",
    "STEPS_PER_QUARTER",
    "Dataset",
    "HourRecord",
    "HourWriter",
    "LaneTraffic",
    "Manifest",
    "Origin",
    "clear_unfinished",
    "create_dataset",
    "hour_of_step",
    "hour_text",
    "open_dataset",
    "part_path",
    "read_hour",
    "read_hours",
    "record_path",
    "require_same_site",
    "update_counts",
    "write_record",
    "write_whole",
]  # fmt: skip

from .asked_time import day_numbers
from .csv_rows import csv_rows, stated_moment, text_in
from .dataset import Dataset, open_dataset
from .day_tables import STEPS_PER_QUARTER
from .footprints import FOOTPRINTS, SHOWN_S, footprint_style
from .hour_job import MeasureSettings
from .lane_matching import match_lanes, write_lane_matches
from .lane_measures import LaneTraffic
from .making import OpenHours, open_hours, update_days
from .manifest import (
    Manifest,
    create_dataset,
    require_same_settings,
    require_same_site,
    site_folder,
    site_folders,
)
from .measuring import manifest_of, measure
from .parts import (
    Origin,
    clear_unfinished,
    hour_begin,
    hour_of_step,
    hour_text,
    part_path,
    rename_whole,
    sync_folder,
    unfinished,
    write_whole,
)
from .profiles import NotMeasuredError, measured_span
from .reading import read_rows
from .records import (
    HourRecord,
    HourWriter,
    listed_hours,
    read_hour,
    read_hours,
    record_path,
    write_record,
)
from .registered import make_registered
from .rollups import RollUps
from .shifts import Shifts, chance_of_others, lanes_beside, shifts_of
from .source import NoVehiclesError
from .sql import SqlQueries
from .stated_lanes import stated_lanes
from .states import states_of
from .street_profile import UnknownStreetError
from .table_schema import TableSchema
from .tables import FRAMES, PASSAGES, POSES, RECORDINGS, TILE_COUNTS
from .tile_counts import HourSpans, count_spans, run_variance, update_counts
from .views import catalogue_of

__all__ = [
    "FOOTPRINTS",
    "FRAMES",
    "PASSAGES",
    "POSES",
    "RECORDINGS",
    "SHOWN_S",
    "STEPS_PER_QUARTER",
    "TILE_COUNTS",
    "Dataset",
    "HourRecord",
    "HourSpans",
    "HourWriter",
    "LaneTraffic",
    "Manifest",
    "MeasureSettings",
    "NoVehiclesError",
    "NotMeasuredError",
    "OpenHours",
    "Origin",
    "RollUps",
    "Shifts",
    "SqlQueries",
    "TableSchema",
    "UnknownStreetError",
    "catalogue_of",
    "chance_of_others",
    "clear_unfinished",
    "count_spans",
    "create_dataset",
    "csv_rows",
    "day_numbers",
    "footprint_style",
    "hour_begin",
    "hour_of_step",
    "hour_text",
    "lanes_beside",
    "listed_hours",
    "make_registered",
    "manifest_of",
    "match_lanes",
    "measure",
    "measured_span",
    "open_dataset",
    "open_hours",
    "part_path",
    "read_hour",
    "read_hours",
    "read_rows",
    "record_path",
    "rename_whole",
    "require_same_settings",
    "require_same_site",
    "run_variance",
    "shifts_of",
    "site_folder",
    "site_folders",
    "stated_lanes",
    "stated_moment",
    "states_of",
    "sync_folder",
    "text_in",
    "unfinished",
    "update_counts",
    "update_days",
    "write_lane_matches",
    "write_record",
    "write_whole",
]

from .dataset import Dataset, open_dataset
from .days.asked_time import Holidays, day_numbers
from .days.lane_measures import LaneTraffic
from .days.rollups import RollUps
from .days.tables import STEPS_PER_QUARTER
from .days.tile_counts import TileCounts, count_spans, run_variance
from .files.manifest import Manifest, create_dataset, require_same_settings, require_same_site
from .files.parts import (
    Origin,
    clear_unfinished,
    hour_begin,
    hour_of_step,
    hour_text,
    part_path,
    replacing,
    sync_folder,
    write_single_file,
)
from .files.records import (
    HourRecord,
    HourWriter,
    listed_hours,
    read_hour,
    read_hours,
    read_rows,
    record_path,
    write_record,
)
from .files.schema import TableSchema
from .files.sites import site_folder, site_folders, warn_of_copies
from .files.source import Moment, NoVehiclesError
from .files.tables import FRAMES, PASSAGES, POSES, RECORDINGS, TILE_COUNTS
from .hours.job import MeasureSettings
from .hours.making import OpenHours, open_hours, update_days
from .hours.registered import make_registered
from .lane_matching import match_lanes, write_lane_matches
from .measuring import manifest_of, measure
from .questions.profiles import NotMeasuredError, measured_span
from .questions.sql import SqlQueries
from .questions.street_profile import By, UnknownStreetError
from .questions.views import catalogue_of
from .traffic.reader import stated_lanes
from .traffic.shifts import Shifts, chance_of_others, lanes_beside, shifts_of
from .vehicles.footprints import FOOTPRINTS, SHOWN_S, footprint_style
from .vehicles.states import states_of

__all__ = [
    "FOOTPRINTS",
    "FRAMES",
    "PASSAGES",
    "POSES",
    "RECORDINGS",
    "SHOWN_S",
    "STEPS_PER_QUARTER",
    "TILE_COUNTS",
    "By",
    "Dataset",
    "Holidays",
    "HourRecord",
    "HourWriter",
    "LaneTraffic",
    "Manifest",
    "MeasureSettings",
    "Moment",
    "NoVehiclesError",
    "NotMeasuredError",
    "OpenHours",
    "Origin",
    "RollUps",
    "Shifts",
    "SqlQueries",
    "TableSchema",
    "TileCounts",
    "UnknownStreetError",
    "catalogue_of",
    "chance_of_others",
    "clear_unfinished",
    "count_spans",
    "create_dataset",
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
    "replacing",
    "require_same_settings",
    "require_same_site",
    "run_variance",
    "shifts_of",
    "site_folder",
    "site_folders",
    "stated_lanes",
    "states_of",
    "sync_folder",
    "update_days",
    "warn_of_copies",
    "write_lane_matches",
    "write_record",
    "write_single_file",
]

from .check import SiteCheck, check_site
from .execution import RunState
from .live_table import BrokerTable, Duration, LiveTable, PageTable, SensorThingsTable, TopicWord
from .plan import Stage, stages_of
from .recipes import mask_scans, measure_recordings, paths_named_by, split_map, write_sights_of
from .run import SiteRun, prepare_site, run_site
from .settings import MapTable, Sensor, Site, ViewTable, read_site, site_template
from .stages import STATE, convert_stage, heatmap_stage, measure_stage, refusals_of
from .toml_file import LARGEST_FILE, read_toml, toml_template
from .values import (
    File,
    Meaning,
    Name,
    Place,
    Recordings,
    Switch,
    TextValue,
    TomlTable,
    Unfit,
    Zone,
    key,
    within,
)
from .versions import software
from .worker import Pool, WorkerContext, process_pool

__all__ = [
    "LARGEST_FILE",
    "STATE",
    "BrokerTable",
    "Duration",
    "File",
    "LiveTable",
    "MapTable",
    "Meaning",
    "Name",
    "PageTable",
    "Place",
    "Pool",
    "Recordings",
    "RunState",
    "Sensor",
    "SensorThingsTable",
    "Site",
    "SiteCheck",
    "SiteRun",
    "Stage",
    "Switch",
    "TextValue",
    "TomlTable",
    "TopicWord",
    "Unfit",
    "ViewTable",
    "WorkerContext",
    "Zone",
    "check_site",
    "convert_stage",
    "heatmap_stage",
    "key",
    "mask_scans",
    "measure_recordings",
    "measure_stage",
    "paths_named_by",
    "prepare_site",
    "process_pool",
    "read_site",
    "read_toml",
    "refusals_of",
    "run_site",
    "site_template",
    "software",
    "split_map",
    "stages_of",
    "toml_template",
    "within",
    "write_sights_of",
]

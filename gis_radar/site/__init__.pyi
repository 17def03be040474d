from .check import SiteCheck, check_site
from .execution import RunState
from .live_table import BrokerTable, Duration, LiveTable, PageTable, SensorThingsTable, TopicWord
from .plan import Stage, stages_of
from .recipes import mask_scans, measure_recordings, see_tiles, split_map
from .run import SiteRun, run_site
from .settings import MapTable, Sensor, Site, ViewTable, read_site, site_template
from .toml_file import read_toml, toml_template
from .values import (
    CompassBearing,
    File,
    Meaning,
    Position,
    Recordings,
    Switch,
    TextValue,
    TomlTable,
    Unfit,
    key,
    within,
)
from .worker import Pool, process_pool

__all__ = [
    "BrokerTable",
    "CompassBearing",
    "Duration",
    "File",
    "LiveTable",
    "MapTable",
    "Meaning",
    "PageTable",
    "Pool",
    "Position",
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
    "check_site",
    "key",
    "mask_scans",
    "measure_recordings",
    "process_pool",
    "read_site",
    "read_toml",
    "run_site",
    "see_tiles",
    "site_template",
    "split_map",
    "stages_of",
    "toml_template",
    "within",
]

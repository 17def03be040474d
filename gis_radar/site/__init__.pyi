from .execution import RunState
from .live_table import PageTable, SensorThingsTable
from .plan import Stage, stages_of
from .settings import Sensor, Site
from .worker import Pool, process_pool

__all__ = [
    "PageTable",
    "Pool",
    "RunState",
    "Sensor",
    "SensorThingsTable",
    "Site",
    "Stage",
    "process_pool",
    "stages_of",
]

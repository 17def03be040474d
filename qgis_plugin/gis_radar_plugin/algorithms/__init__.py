"""The algorithms of the toolbox, one a file."""

from .convert import ConvertRecordings
from .footprints import ShowVehicles
from .heatmap import MakeHeatMap
from .localize import LocalizeRadar
from .mask import MaskRoad
from .occupancy import MeasureOccupancy
from .report import ExportReport
from .run_site import RunSite
from .sample import SampleSite
from .set_up import SetUpWorker
from .tiles import SplitLanelets
from .vehicles import FollowVehicles

ALGORITHMS = (
    SplitLanelets,
    MaskRoad,
    LocalizeRadar,
    ConvertRecordings,
    MeasureOccupancy,
    FollowVehicles,
    MakeHeatMap,
    ShowVehicles,
    RunSite,
    ExportReport,
    SetUpWorker,
    SampleSite,
)

__all__ = ["ALGORITHMS"]

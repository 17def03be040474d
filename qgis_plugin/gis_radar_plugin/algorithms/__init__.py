"""The algorithms of the toolbox, one a file, or a few that belong together."""

from .clocks import CompareClocks
from .convert import ConvertRecordings
from .detections import ShowDetections
from .footprints import ShowVehicles
from .heatmap import MakeHeatMap
from .localize import LocalizeRadar
from .mask import MaskRoad
from .occupancy import MeasureOccupancy
from .quality import CheckQuality
from .report import ExportReport
from .run_site import RunSite
from .sample import SampleSite
from .set_up import SetUpWorker
from .sight import FindSight
from .site_files import CheckSite, WriteProject, WriteReport
from .tiles import SplitLanelets
from .track import FollowPose
from .vehicles import FollowVehicles

ALGORITHMS = (
    SplitLanelets,
    MaskRoad,
    LocalizeRadar,
    FollowPose,
    FindSight,
    CheckSite,
    ConvertRecordings,
    CompareClocks,
    MeasureOccupancy,
    FollowVehicles,
    MakeHeatMap,
    ShowVehicles,
    ShowDetections,
    CheckQuality,
    RunSite,
    ExportReport,
    WriteReport,
    WriteProject,
    SetUpWorker,
    SampleSite,
)

__all__ = ["ALGORITHMS"]

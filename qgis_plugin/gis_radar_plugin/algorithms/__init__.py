"""The algorithms of the toolbox, one a file, or a few that belong together."""

from .clocks import CompareClocks
from .convert import ConvertRecordings
from .dataset import KeepDataset
from .detections import ShowDetections
from .footprints import ShowVehicles
from .heatmap import MakeHeatMap
from .localize import LocalizeRadar
from .mask import MaskRoad
from .measure import MeasureTraffic
from .quality import CheckQuality
from .report import ExportReport
from .run_site import RunSite
from .sample import SampleSite
from .set_up import SetUpWorker
from .sight import FindSight
from .site_files import CheckSite, WriteProject, WriteReport
from .tiles import SplitLanelets
from .track import FollowPose

ALGORITHMS = (
    SplitLanelets,
    MaskRoad,
    LocalizeRadar,
    FollowPose,
    FindSight,
    CheckSite,
    ConvertRecordings,
    CompareClocks,
    MeasureTraffic,
    MakeHeatMap,
    ShowVehicles,
    ShowDetections,
    CheckQuality,
    KeepDataset,
    RunSite,
    ExportReport,
    WriteReport,
    WriteProject,
    SetUpWorker,
    SampleSite,
)

__all__ = ["ALGORITHMS"]

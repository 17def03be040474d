"""The algorithms of the toolbox: each a table of parameters, and what comes after its command."""

from .heat_maps import MakeHeatMap, MapMonth
from .lanes import ComparePeriods, CountTraffic
from .report import ExportReport
from .results import WriteProject, WriteReport
from .set_up import SampleSite, SetUpWorker
from .site import FindSight, FollowPose, LocalizeRadar, MaskRoad, SplitLanelets
from .traffic import (
    CheckQuality,
    CompareClocks,
    ConvertRecordings,
    KeepDataset,
    MeasureTraffic,
    RunSite,
    ShowDetections,
    ShowVehicles,
)

ALGORITHMS = (
    SplitLanelets, MaskRoad, LocalizeRadar, FollowPose, FindSight, ConvertRecordings,
    CompareClocks, MeasureTraffic, MakeHeatMap, MapMonth, CountTraffic, ComparePeriods,
    ShowVehicles, ShowDetections, CheckQuality, KeepDataset, RunSite, ExportReport, WriteReport,
    WriteProject, SetUpWorker, SampleSite,
)  # fmt: skip

__all__ = ["ALGORITHMS"]

from .comparison.comparison import compare
from .comparison.result import Comparison
from .heatmap.by_lane import lane_totals, lanes_with_tiles
from .heatmap.heatmap import HeatMap, make_heatmap, read_heatmap
from .heatmap.intervals import MapLabels
from .heatmap.style import BREAKS, MAP_WORDS, NEVER_HIT, NOT_OBSERVED, colour_classes
from .postgis import Publication, publish
from .postgis_city import CityPublication, is_city, publish_city
from .projection.project import project, write_projection
from .qgis.project import write_qgis_project, write_site_project
from .qgis.project_file import was_edited
from .quality.quality import Quality, measure_quality, require_table_name
from .report.names import REPORT_FILES
from .report.report import Report, write_report
from .traffic import Traffic, make_traffic

__all__ = [
    "BREAKS",
    "MAP_WORDS",
    "NEVER_HIT",
    "NOT_OBSERVED",
    "REPORT_FILES",
    "CityPublication",
    "Comparison",
    "HeatMap",
    "MapLabels",
    "Publication",
    "Quality",
    "Report",
    "Traffic",
    "colour_classes",
    "compare",
    "is_city",
    "lane_totals",
    "lanes_with_tiles",
    "make_heatmap",
    "make_traffic",
    "measure_quality",
    "project",
    "publish",
    "publish_city",
    "read_heatmap",
    "require_table_name",
    "was_edited",
    "write_projection",
    "write_qgis_project",
    "write_report",
    "write_site_project",
]

from .comparison.comparison import compare
from .comparison.result import Comparison, change_rows
from .comparison.rows import NOT_TOLD, with_verdicts
from .heatmap.by_lane import lane_totals, lanes_with_tiles
from .heatmap.heatmap import HeatMap, joint_layer, make_heatmap, read_heatmap, write_joint_layer
from .heatmap.intervals import MapLabels
from .heatmap.style import BREAKS, MAP_WORDS, NEVER_HIT, NOT_OBSERVED, colour_classes
from .postgis import Publication, publish
from .postgis_city import CityPublication, is_city, publish_city
from .projection.project import project, write_projection
from .qgis.project import was_edited, write_qgis_project, write_site_project
from .quality.quality import Quality, measure_quality, require_table_name
from .report.chart import strip_of
from .report.content import Column, Fact, Strip, Table, text_rows
from .report.pages import render_page
from .report.report import Report, write_report
from .report.results import as_stated, lost_sensors, read_run
from .report.sources import made_by
from .report.traffic import LEAST_QUEUE_M, longest_queue_text
from .report_files import PAGE, REPORT_FILES
from .traffic import Traffic, make_traffic, service_levels
from .traffic_exchange import publisher_of

__all__ = [
    "BREAKS",
    "LEAST_QUEUE_M",
    "MAP_WORDS",
    "NEVER_HIT",
    "NOT_OBSERVED",
    "NOT_TOLD",
    "PAGE",
    "REPORT_FILES",
    "CityPublication",
    "Column",
    "Comparison",
    "Fact",
    "HeatMap",
    "MapLabels",
    "Publication",
    "Quality",
    "Report",
    "Strip",
    "Table",
    "Traffic",
    "as_stated",
    "change_rows",
    "colour_classes",
    "compare",
    "is_city",
    "joint_layer",
    "lane_totals",
    "lanes_with_tiles",
    "longest_queue_text",
    "lost_sensors",
    "made_by",
    "make_heatmap",
    "make_traffic",
    "measure_quality",
    "project",
    "publish",
    "publish_city",
    "publisher_of",
    "read_heatmap",
    "read_run",
    "render_page",
    "require_table_name",
    "service_levels",
    "strip_of",
    "text_rows",
    "was_edited",
    "with_verdicts",
    "write_joint_layer",
    "write_projection",
    "write_qgis_project",
    "write_report",
    "write_site_project",
]

"""The command line: it only translates between words and the library."""

from gis_radar.cli import poses as localize_command
from gis_radar.cli import recordings as convert_command
from gis_radar.cli import recordings as occupancy_command
from gis_radar.cli import sites as for_qgis
from gis_radar.cli import sites as report_command
from gis_radar.cli import sites as run_command
from gis_radar.cli.commands import main

__all__ = [
    "convert_command",
    "for_qgis",
    "localize_command",
    "main",
    "occupancy_command",
    "report_command",
    "run_command",
]

"""The command line: it only translates between words and the library."""

from gis_radar.cli import (
    convert_command,
    for_qgis,
    localize_command,
    occupancy_command,
    report_command,
    run_command,
)
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

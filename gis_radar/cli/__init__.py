"""The command line: it only translates between words and the library."""

from gis_radar.cli.main import main

__all__ = ["main"]

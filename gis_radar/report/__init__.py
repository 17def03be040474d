"""Reports for people without QGIS: one HTML file, one PDF, and the tables as CSV."""

from gis_radar.report.report import Report, write_report

__all__ = ["Report", "write_report"]

"""QGIS projects that open ready to present, written without QGIS."""

from gis_radar.qgis.project import write_qgis_project, write_site_project

__all__ = ["write_qgis_project", "write_site_project"]

"""Projection: a recording's detections in the map, as points for GIS and point cloud tools."""

from gis_radar.projection.project import project, write_projection

__all__ = ["project", "write_projection"]

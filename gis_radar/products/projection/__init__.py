"""Projection: the detections of a recording in the map, as points for GIS and point cloud tools."""

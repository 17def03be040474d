"""What single vehicles become for other programs: a layer for QGIS, trajectories."""

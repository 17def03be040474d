"""QGIS projects that open ready to present, written without QGIS."""

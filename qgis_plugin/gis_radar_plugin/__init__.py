"""gis_radar for QGIS: roadside radar to traffic maps, without a line of Python for the user."""

from __future__ import annotations

from typing import Any


def classFactory(iface: Any) -> Any:  # noqa: N802 - the name that QGIS calls
    """Return the plugin; `iface` is None where QGIS has no window."""
    from .plugin import GisRadarPlugin  # noqa: PLC0415 - QGIS reads the metadata without it

    return GisRadarPlugin(iface)

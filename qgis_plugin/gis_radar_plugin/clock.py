"""The clock on the map: the site's time of what the temporal controller shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsProject, QgsVectorLayer
from qgis.PyQt.QtCore import QTimeZone
from qgis.PyQt.QtWidgets import QLabel

from .report.pages import local_time, zone_name
from .timeline import as_utc

_LOOK = (
    "QLabel { background: rgba(255, 255, 255, 215); color: #111827; font-weight: bold;"
    " padding: 4px 8px; border: 1px solid #9ca3af; border-radius: 3px; }"
)
_MEASURED = ("hit_s", "visible_share")  # columns of heat maps, and of traffic


class Clock:
    """A label on the map canvas; data are UTC, people read local time.

    Parameters
    ----------
    canvas : QgsMapCanvas
        The map.
    """

    def __init__(self, canvas: Any) -> None:
        self._canvas = canvas
        self._label = QLabel(canvas)
        self._label.setStyleSheet(_LOOK)
        self._label.move(10, 10)
        self._label.hide()
        canvas.temporalRangeChanged.connect(self.show_time)
        canvas.layersChanged.connect(self.show_time)
        QgsProject.instance().layersRemoved.connect(self.show_time)

    def show_time(self, *_: Any) -> None:
        """Show the map's time by the site's clocks while a gis_radar layer with a time is shown."""
        text = self.text()
        self._label.setText(text)
        self._label.adjustSize()
        self._label.setVisible(bool(text))

    def text(self) -> str:
        """Return the text of the clock."""
        span = self._canvas.temporalRange()
        if not self._canvas.mapSettings().isTemporal() or span.begin().isNull():
            return ""
        project, _ = QgsProject.instance().readBoolEntry("TitleLabel", "/Enabled", False)
        ours = [layer for layer in self._canvas.layers() if _is_ours(layer)]
        if project or not ours:  # a project of a site's run has its own clock
            return ""
        named = zone_name(Path(ours[0].source().partition("|")[0]))
        zone = QTimeZone(named.encode()) if named else QTimeZone.utc()
        return local_time(as_utc(span.begin()), as_utc(span.end()), zone)

    def remove(self) -> None:
        """Take the label away."""
        self._canvas.temporalRangeChanged.disconnect(self.show_time)
        self._canvas.layersChanged.disconnect(self.show_time)
        QgsProject.instance().layersRemoved.disconnect(self.show_time)
        self._label.deleteLater()


def _is_ours(layer: Any) -> bool:
    return (
        isinstance(layer, QgsVectorLayer)
        and layer.temporalProperties().isActive()
        and any(layer.fields().lookupField(name) >= 0 for name in _MEASURED)
    )

"""Live look: reload layers whose file has changed; nothing but files is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import QgsMapLayer, QgsProject, QgsProviderRegistry, QgsVectorLayer
from qgis.PyQt.QtCore import QObject, QTimer

from .timeline import extent_of

EVERY_S = 5
_FILE_PROVIDERS = ("ogr", "gdal")
Stamp = tuple[int, int, int]


def stamp_of(path: Path) -> Stamp | None:
    """Return a stamp that changes when a file is written or replaced, None without a file."""
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_mtime_ns, state.st_size, state.st_ino


def file_of(layer: QgsMapLayer) -> Path | None:
    """Return the file that a layer shows, None for a service or a layer in memory."""
    if layer.providerType() not in _FILE_PROVIDERS:
        return None
    parts = QgsProviderRegistry.instance().decodeUri(layer.providerType(), layer.source())
    path = str(parts.get("path") or "")
    return Path(path) if path else None


class LiveLook(QObject):  # type: ignore[misc]
    """A timer that checks every few seconds which files have changed, and reloads their layers.

    Parameters
    ----------
    controller : QgsTemporalController or None
        Moves on to the newest interval if it showed the last one.
    parent : QObject, optional
        Owner of the timer.
    """

    def __init__(self, controller: Any = None, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._controller = controller
        self._stamps: dict[str, Stamp] = {}
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.look)

    def start(self, every_s: float = EVERY_S) -> None:
        """Start; what is on disk now counts as read."""
        self._stamps.clear()
        self.look()
        self._timer.start(int(every_s * 1000))

    def stop(self) -> None:
        """Stop."""
        self._timer.stop()

    def is_on(self) -> bool:
        """Return whether it is on."""
        return bool(self._timer.isActive())

    def look(self) -> list[str]:
        """Reload what has changed since the last check; return the layers' names.

        A layer that is being edited stays as it is.
        """
        fresh = []
        for layer in QgsProject.instance().mapLayers().values():
            path = file_of(layer)
            stamp = stamp_of(path) if path is not None else None
            if stamp is None:
                continue
            before = self._stamps.get(layer.id())
            if isinstance(layer, QgsVectorLayer) and layer.isEditable():
                continue
            self._stamps[layer.id()] = stamp
            if before != stamp and (before is not None or not layer.isValid()):
                self._read(layer)
                fresh.append(layer.name())
        return fresh

    def _read(self, layer: QgsMapLayer) -> None:
        if not layer.isValid():  # its file was not there when the project was opened
            layer.setDataSource(layer.source(), layer.name(), layer.providerType(), False)
            if not layer.isValid():
                return
        # Setting the source again opens the new file; a reload may go on with the replaced one.
        layer.dataProvider().reloadData()
        layer.reload()
        if isinstance(layer, QgsVectorLayer):
            layer.updateExtents()
            if layer.temporalProperties().isActive():
                self._follow(layer)
        layer.triggerRepaint()

    def _follow(self, layer: QgsVectorLayer) -> None:
        """Widen the controller's time to the layer's; stay at the newest if it was shown."""
        extent = extent_of(layer)
        if extent.begin().isNull():
            return
        QgsProject.instance().timeSettings().setTemporalRange(extent)
        if self._controller is None:
            return
        frame = self._controller.currentFrameNumber()
        at_end = frame >= self._controller.totalFrameCount() - 1
        self._controller.setTemporalExtents(extent)
        last = self._controller.totalFrameCount() - 1
        self._controller.setCurrentFrameNumber(last if at_end else min(frame, last))

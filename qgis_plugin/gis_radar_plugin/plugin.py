"""The plugin as QGIS loads it."""

from __future__ import annotations

import os
from typing import Any

from qgis.core import Qgis, QgsApplication, QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithms import ALGORITHMS
from .base import ICONS, chosen_python
from .opening import PROVIDER
from .runner import WorkerError
from .words import language, tr

MENU = "gis_radar"


class GisRadarPlugin:
    """The plugin: the provider, and in a QGIS with a window the clock and the live look.

    Parameters
    ----------
    iface : QgisInterface or None
        The window, where there is one.
    """

    def __init__(self, iface: Any) -> None:
        self._iface = iface
        self._provider: GisRadarProvider | None = None
        self._actions: list[Any] = []
        self._clock: Any = None
        self._live: Any = None
        self._message: Any = None
        self._wizard: Any = None

    def initProcessing(self) -> None:  # noqa: N802
        """Register the algorithms; all that `qgis_process` needs."""
        os.environ.setdefault("GIS_RADAR_LANGUAGE", language())  # of what the worker reports
        self._provider = GisRadarProvider()
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:  # noqa: N802
        """Register the algorithms in a QGIS with a window, and add the menu."""
        # Widgets are not imported where QGIS has no window.
        from .clock import Clock  # noqa: PLC0415
        from .live import LiveLook  # noqa: PLC0415

        self.initProcessing()
        canvas = self._iface.mapCanvas()
        self._clock = Clock(canvas)
        self._live = LiveLook(canvas.temporalController(), self._iface.mainWindow())
        self._iface.addToolBarIcon(self._action(tr("New site..."), "runsite", self.new_site))
        live = self._action(tr("Live look"), "live", self._switch_live)
        live.setCheckable(True)
        live.setToolTip(tr("Read layers anew when their files change"))
        self._iface.addToolBarIcon(live)
        self._action(tr("Set up the worker"), "setupworker", self._set_up)
        self._say_what_is_missing()

    def _action(self, text: str, icon: str, do: Any) -> Any:
        try:
            from qgis.PyQt.QtGui import QAction  # noqa: PLC0415 - where Qt 6 has it
        except ImportError:
            from qgis.PyQt.QtWidgets import QAction  # noqa: PLC0415 - where Qt 5 has it

        action = QAction(QIcon(str(ICONS / f"{icon}.svg")), text, self._iface.mainWindow())
        action.triggered.connect(do)
        self._iface.addPluginToMenu(MENU, action)
        self._actions.append(action)
        return action

    def _switch_live(self, on: bool) -> None:  # noqa: FBT001 - as Qt calls it
        if on:
            self._live.start()
        else:
            self._live.stop()

    def new_site(self, *_: Any) -> Any:
        """Open the site wizard, or bring the one that is open to the front."""
        from .wizard.wizard import SiteWizard  # noqa: PLC0415 - widgets

        if self._wizard is None:
            self._wizard = SiteWizard(self._iface)
            self._wizard.destroyed.connect(self._forget_wizard)
        self._wizard.show()
        self._wizard.raise_()
        return self._wizard

    def _forget_wizard(self, *_: Any) -> None:
        self._wizard = None

    def _set_up(self, *_: Any) -> None:
        import processing  # noqa: PLC0415 - a plugin of QGIS, there once it has started

        processing.execAlgorithmDialog(f"{PROVIDER}:setupworker")
        self._say_no_more()

    def _say_what_is_missing(self) -> None:
        try:
            chosen_python()
        except WorkerError:
            from qgis.PyQt.QtWidgets import QPushButton  # noqa: PLC0415 - as above

            text = tr("The plugin needs its worker, once.")
            message = self._iface.messageBar().createMessage("gis_radar", text)
            button = QPushButton(tr("Set up the worker"), message)
            button.clicked.connect(self._set_up)
            message.layout().addWidget(button)
            self._message = self._iface.messageBar().pushWidget(message, Qgis.MessageLevel.Info)
            self._message.destroyed.connect(self._forget_message)

    def _say_no_more(self) -> None:
        """Remove the message once there is a worker."""
        try:
            chosen_python()
        except WorkerError:
            return
        if self._message is not None:
            self._iface.messageBar().popWidget(self._message)

    def _forget_message(self, *_: Any) -> None:
        self._message = None

    def unload(self) -> None:
        """Leave QGIS as it was."""
        if self._wizard is not None:
            self._wizard.close()
        if self._live is not None:
            self._live.stop()
            self._live.deleteLater()
        if self._clock is not None:
            self._clock.remove()
        for action in self._actions:
            self._iface.removePluginMenu(MENU, action)
            self._iface.removeToolBarIcon(action)
        self._actions.clear()
        if self._provider is not None:
            QgsApplication.processingRegistry().removeProvider(self._provider)
            self._provider = None


class GisRadarProvider(QgsProcessingProvider):  # type: ignore[misc]
    """All algorithms of gis_radar."""

    def id(self) -> str:
        return PROVIDER

    def name(self) -> str:
        return "gis_radar"

    def longName(self) -> str:  # noqa: N802
        return "gis_radar: radar to traffic maps"

    def icon(self) -> QIcon:
        return QIcon(self.svgIconPath())

    def svgIconPath(self) -> str:  # noqa: N802
        return str(ICONS / "gis_radar.svg")

    def loadAlgorithms(self) -> None:  # noqa: N802
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())

    def supportedOutputVectorLayerExtensions(self) -> list[str]:  # noqa: N802
        return ["gpkg"]

    def defaultVectorFileExtension(self, _has_geometry: bool = True) -> str:  # noqa: N802, FBT001, FBT002
        return "gpkg"

    def supportsNonFileBasedOutput(self) -> bool:  # noqa: N802
        return False

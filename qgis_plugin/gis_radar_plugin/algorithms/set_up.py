"""Set up the worker, from inside QGIS."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputString,
    QgsProcessingParameterFile,
    QgsSettings,
)

from ..base import SET_UP, SETTING, Algorithm, one_sentence, profile_folder
from ..claims import claimed
from ..installer import SetUpListener, bundled_package, find_tools, set_up
from ..words import tr
from ..worker import plugin_version, python_in, same_series, worker_folder, worker_version

ANY_FILE = "* (*)"  # QGIS's own filter refuses names without a dot, as programs have


class SetUpWorker(Algorithm):
    """An algorithm that builds the Python environment of the worker."""

    NAME = "setupworker"
    TITLE = "Set up the worker"
    GROUP = SET_UP
    HELP = (
        "Builds the Python environment in which gis_radar works, in your QGIS profile: needed "
        "once, and again after an update of the plugin. It fetches some 250 MB, takes some "
        "minutes, and fills 1 GB on disk.\n"
        "Leave everything empty, as a rule. Nothing is installed into QGIS itself, and an earlier "
        "worker stays until the new one is complete."
    )
    KEYWORDS = ("install", "python", "environment", "update")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "READY", tr("Use this Python instead"), optional=True, fileFilter=ANY_FILE
            ),
            about="One that has gis_radar already; then nothing is fetched.",
        )
        self.add(
            QgsProcessingParameterFile(
                "PACKAGE", tr("Package of gis_radar"), extension="whl", optional=True
            ),
            about="Another wheel than the one that came with the plugin.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterFile(
                "PYTHON", tr("Python to build on"), optional=True, fileFilter=ANY_FILE
            ),
            about="3.11 or newer; without it one is looked for.", advanced=True,
        )  # fmt: skip
        self.addOutput(QgsProcessingOutputString("WORKER", tr("The worker's Python")))
        self.addOutput(QgsProcessingOutputString("VERSION", tr("Its version")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        ready = self.parameterAsFile(parameters, "READY", context)
        folder = worker_folder(profile_folder())
        with one_sentence():
            if ready:
                python, version = ready, worker_version(ready)
            else:
                package = self.parameterAsFile(parameters, "PACKAGE", context) or bundled_package()
                if not package:
                    raise QgsProcessingException(
                        tr("This plugin came without the package of gis_radar: choose its wheel.")
                    )
                tools = find_tools(self.parameterAsFile(parameters, "PYTHON", context))
                feedback.pushInfo(f"{package}\n{tools.uv or tools.python}")
                with claimed([str(folder)]):
                    version = set_up(folder, package, tools, _SetUpFeedback(feedback))
                python = str(python_in(folder))
        if not same_series(version, plugin_version()):
            text = tr("The worker is gis_radar {worker}, the plugin {plugin}:").format(
                worker=version, plugin=plugin_version()
            )
            raise QgsProcessingException(f"{text} {tr('choose a package of the same version.')}")
        QgsSettings().setValue(SETTING, ready)
        feedback.pushInfo(tr("The worker is ready: gis_radar {version}.").format(version=version))
        return {"WORKER": python, "VERSION": version}


class _SetUpFeedback(SetUpListener):
    """The set-up as a QGIS feedback shows it."""

    def __init__(self, feedback: QgsProcessingFeedback) -> None:
        self._feedback = feedback

    def stage(self, text: str, percent: float) -> None:
        if text:
            self._feedback.setProgressText(tr(text))
        self._feedback.setProgress(percent)

    def line(self, text: str) -> None:
        self._feedback.pushConsoleInfo(text)

    def cancelled(self) -> bool:
        return bool(self._feedback.isCanceled())

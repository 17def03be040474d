"""Set up the worker from inside QGIS, and copy a sample site to try everything on."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingException,
    QgsProcessingOutputString,
    QgsSettings,
)

from ..base import (
    SET_UP,
    SETTING,
    Algorithm,
    WorkerAlgorithm,
    WorkerFeedback,
    one_sentence,
    profile_folder,
)
from ..installer import bundled_package, find_tools, set_up
from ..parameters import File, Given, OutputFolder, Result
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
    PARAMETERS = (
        File(
            "READY", "Use this Python instead",
            "One that has gis_radar already; then nothing is fetched.", optional=True,
            kinds=ANY_FILE,
        ),
        File(
            "PACKAGE", "Package of gis_radar",
            "Another wheel than the one that came with the plugin.", optional=True, advanced=True,
            kinds="* (*.whl)",
        ),
        File(
            "PYTHON", "Python to build on", "3.11 or newer; without it one is looked for.",
            optional=True, advanced=True, kinds=ANY_FILE,
        ),
        Result("WORKER", "The worker's Python", kind=QgsProcessingOutputString),
        Result("VERSION", "Its version", kind=QgsProcessingOutputString),
    )  # fmt: skip

    def process(self, given: Given) -> dict[str, Any]:
        ready, feedback = given.text("READY"), given.feedback
        folder = worker_folder(profile_folder())
        with one_sentence():
            if ready:
                python, version = ready, worker_version(ready)
            else:
                package = given.text("PACKAGE") or bundled_package()
                if not package:
                    raise QgsProcessingException(
                        tr("This plugin came without the package of gis_radar: choose its wheel.")
                    )
                tools = find_tools(given.text("PYTHON"))
                feedback.pushInfo(f"{package}\n{tools.uv or tools.python}")
                version = set_up(folder, package, tools, WorkerFeedback(feedback))
                python = str(python_in(folder))
        if not same_series(version, plugin_version()):
            text = tr("The worker is gis_radar {worker}, the plugin {plugin}:").format(
                worker=version, plugin=plugin_version()
            )
            raise QgsProcessingException(f"{text} {tr('choose a package of the same version.')}")
        QgsSettings().setValue(SETTING, ready)
        feedback.pushInfo(tr("The worker is ready: gis_radar {version}.").format(version=version))
        return {"WORKER": python, "VERSION": version}


class SampleSite(WorkerAlgorithm):
    """An algorithm that copies the sample junction to a folder."""

    NAME = "samplesite"
    COMMAND = "sample"
    TITLE = "Get the sample site"
    GROUP = SET_UP
    HELP = (
        "Copies the files of a made-up junction to a folder, to try everything on: a Lanelet2 map, "
        "an airborne scan, recordings and poses of two radars."
    )
    KEYWORDS = ("example", "demo", "tutorial")
    PARAMETERS = (OutputFolder("OUTPUT", "Sample site"),)

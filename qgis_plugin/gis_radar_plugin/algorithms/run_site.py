"""Run a site file: the whole way for all sensors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import load
from ..parameters import add_number, given_words
from ..words import tr
from .heatmap import layers_of, load_heatmap


class RunSite(WorkerAlgorithm):
    """An algorithm that makes all results of a site file."""

    NAME = "runsite"
    TITLE = "Run a site file"
    GROUP = TRAFFIC
    HELP = (
        "Goes the whole way for all sensors of a site, as its site file (TOML) sets out: road, "
        "tiles, poses, dataset, heat map.\n"
        "The folder also holds a QGIS project that is ready to present."
    )
    KEYWORDS = ("batch", "nightly", "project")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "SITE", tr("Site file"), fileFilter=tr("Site files") + " (*.toml)"
            )
        )
        add_number(self, "JOBS", "Stages at once", "As cores and memory allow, without it.")
        self.add(
            QgsProcessingParameterBoolean("FRESH", tr("Do all again"), False),
            about="Also what an earlier run has done.", advanced=True,
        )  # fmt: skip
        self.add(QgsProcessingParameterBoolean("LOAD", tr("Load the layers"), True), advanced=True)
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", tr("Results")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        site = self.parameterAsFile(parameters, "SITE", context)
        more = given_words(self, parameters, context, ("JOBS", "FRESH"))
        self.work(["run", site, "-o", dest, *more], [dest], feedback)
        folder = Path(dest)
        if self.parameterAsBoolean(parameters, "LOAD", context):
            load_site(context, folder, title_of(folder) or Path(site).stem)
        projects = [str(path) for path in sorted(folder.glob("site*.qgz"))]
        for path in projects:
            feedback.pushInfo(tr("Project that is ready to present:") + f" {path}")
        self.made = [
            (tr("Open the report"), folder / "report.html"),
            *[(tr("Open the project"), Path(path)) for path in projects[-1:]],
            (tr("Show the folder"), folder),
        ]
        return {"OUTPUT": dest, **layers_of(folder / "heatmap")}


def title_of(folder: Path) -> str:
    """Return what the site of a run is called, empty where the run has no title."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        return str(record["site"]["title"])
    except (OSError, ValueError, TypeError, KeyError):
        return ""


def load_site(context: QgsProcessingContext, folder: Path, group: str) -> None:
    """Have QGIS load what a run left in its folder."""
    sensors = folder / "sensors.gpkg"
    if sensors.is_file():
        for order, (layer, name) in enumerate(
            (("uncertainty", tr("Uncertainty (95 %)")), ("views", tr("Views")),
             ("sensors", tr("Sensors"))), start=10,
        ):  # fmt: skip
            load(context, f"{sensors}|layername={layer}", name, group=group, order=order)
    footprints = folder / "footprints.gpkg"
    if footprints.is_file():
        source = f"{footprints}|layername=footprints"
        load(context, source, tr("Vehicles"), group=group, order=5)
    if (folder / "heatmap" / "heatmap.gpkg").is_file():
        # Vehicles move in shorter steps than the map.
        sets_time = not footprints.is_file()
        load_heatmap(context, folder / "heatmap", group, sets_time=sets_time)

"""What goes with a run's folder: the check of a site file, the report, a QGIS project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
)

from ..base import RESULTS, SITE, WorkerAlgorithm, option
from ..parameters import (
    add_csv_locale,
    add_file,
    add_language,
    add_text,
    add_timezone,
    given_words,
)
from ..words import tr

REPORT_OPTIONS = ("DATASET", "TITLE", "TIMEZONE", "LANGUAGE", "CSV_LOCALE")


class CheckSite(WorkerAlgorithm):
    """An algorithm that checks a site file before its run."""

    NAME = "checksite"
    TITLE = "Check a site file"
    GROUP = SITE
    HELP = (
        "Checks a site file before its run: whether map, scans, positions and recordings fit "
        "together. The log shows what each radar recorded, and what is odd."
    )
    KEYWORDS = ("site", "toml")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        kinds = tr("Site files") + " (*.toml)"
        self.add(QgsProcessingParameterFile("SITE", tr("Site file"), fileFilter=kinds))
        self.addOutput(QgsProcessingOutputNumber("WARNINGS", tr("Warnings")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        site = self.parameterAsFile(parameters, "SITE", context)
        answer = self.work(["check", site], [], feedback)
        return {"WARNINGS": answer.summary.get("warnings", 0)}


class WriteReport(WorkerAlgorithm):
    """An algorithm that writes the report of a run for people without QGIS."""

    NAME = "sitereport"
    TITLE = "Report for people without QGIS"
    GROUP = RESULTS
    HELP = (
        "Writes a report of a site's run or of a heat map: a page for the browser (HTML), the same "
        "as PDF, and tables (CSV)."
    )
    KEYWORDS = ("html", "pdf", "csv")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        folder = QgsProcessingParameterFile.Behavior.Folder
        self.add(
            QgsProcessingParameterFile("RESULTS", tr("Results"), folder),
            about="The folder of a site's run, or of a heat map.",
        )
        add_text(self, "TITLE", "Title", "The site's, without it.")
        add_timezone(
            self, "Whose clocks its times follow, such as Europe/Berlin; the site's without."
        )
        add_language(self)
        add_csv_locale(self)
        self.add(
            QgsProcessingParameterFile("DATASET", tr("Dataset"), folder, optional=True),
            about="What the heat map was made of, where it is not in the folder.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterFolderDestination(
                "OUTPUT", tr("Report"), optional=True, createByDefault=False
            ),
            about="A folder; without one the report goes into the folder of the results.",
        )
        self.addOutput(QgsProcessingOutputFile("PAGE", tr("Report")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        results = self.parameterAsFile(parameters, "RESULTS", context)
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        words = ["report", results, *option("-o", dest)]
        words += given_words(self, parameters, context, REPORT_OPTIONS)
        answer = self.work(words, [dest] if dest else [], feedback)
        page = next((path for path in answer.outputs if path.endswith(".html")), "")
        feedback.pushInfo(page)
        self.made = [
            (tr("Open the report"), Path(page)),
            (tr("Open the report as PDF"), Path(page).with_suffix(".pdf")),
            (tr("Show the folder"), Path(page).parent),
        ]
        return {"OUTPUT": dest or results, "PAGE": page}


class WriteProject(WorkerAlgorithm):
    """An algorithm that writes a project which shows a heat map ready to present."""

    NAME = "qgisproject"
    TITLE = "QGIS project of a heat map"
    GROUP = RESULTS
    HELP = (
        "Writes a QGIS project that shows a heat map ready to present: groups, styles, time and a "
        "print layout. A site's run makes one by itself.\n"
        "Its paths are relative: the folder with all of it can be moved."
    )
    KEYWORDS = ("qgz", "present", "layout")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        folder, packages = QgsProcessingParameterFile.Behavior.Folder, "GeoPackages (*.gpkg)"
        self.add(
            QgsProcessingParameterFile("HEATMAP", tr("Heat map"), folder),
            about="A folder from 'Heat map'.",
        )
        add_file(self, "SENSORS", "Sensors", packages, "From 'Localize a radar'.")
        add_file(self, "SIGHT", "Sight", packages, "From 'What sensors see'.")
        add_file(self, "LANES", "Lanes", packages, "The tiles, which hold the lanes, too.")
        add_file(
            self, "FOOTPRINTS", "Footprints", packages, "From 'Vehicles that move on the map'."
        )
        add_text(self, "TITLE", "Title")
        add_text(self, "SOURCE", "Source")
        add_timezone(self, "Of the times on its map, such as Europe/Berlin; UTC without.")
        add_language(self)
        kinds = tr("QGIS projects") + " (*.qgz)"
        self.add(QgsProcessingParameterFileDestination("OUTPUT", tr("QGIS project"), kinds))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        words = ["qgis", self.parameterAsFile(parameters, "HEATMAP", context), "-o", dest]
        words += given_words(
            self, parameters, context,
            ("SENSORS", "SIGHT", "LANES", "FOOTPRINTS", "TITLE", "SOURCE", "TIMEZONE", "LANGUAGE"),
        )  # fmt: skip
        self.work(words, [dest], feedback)
        self.made = [(tr("Open the project"), Path(dest))]
        return {"OUTPUT": dest}

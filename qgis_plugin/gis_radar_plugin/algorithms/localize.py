"""Localize a radar: the guess is a click on the map."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsCsException,
    QgsPointXY,
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingOutputHtml,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPoint,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
    QgsProcessingUtils,
)

from ..base import SITE, WorkerAlgorithm, option, readable
from ..loading import finish_output, load
from ..parameters import add_map, add_origin, add_road, add_scan_crs, bearing_word, scan_words
from ..words import tr

METHODS = ("lane", "icp")
WEB_MERCATOR = "EPSG:3857"


class LocalizeRadar(WorkerAlgorithm):
    """An algorithm that finds a sensor's pose from a recording and a click."""

    NAME = "localizeradar"
    TITLE = "Localize a radar"
    GROUP = SITE
    HELP = (
        "Finds where a radar stands and looks, from 100 s of traffic: click where it stands, "
        "within 15 m.\n"
        "The result is a pose file and a layer: an arrow where the radar looks, its view, and the "
        "ellipse in which it stands with 95 % probability. The figure shows the traces of the "
        "vehicles over lanes and scan: they must lie on the lanes.\n"
        "Where the scene fits two places, or holds too little traffic, the reason is given instead "
        "of an answer."
    )
    KEYWORDS = ("pose", "calibration", "georeference")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        recordings = tr("Recordings") + " (*.parquet *.csv)"
        self.add(QgsProcessingParameterFile("RECORDING", tr("Recording"), fileFilter=recordings))
        self.add(
            QgsProcessingParameterPoint("GUESS", tr("Where the radar stands")),
            about="Click it on the map (the button with three dots), within 15 m.",
        )
        add_map(self)
        add_road(self, about="From 'Mask road from airborne scan'.")
        self.add(
            QgsProcessingParameterMultipleLayers(
                "SCANS", tr("Airborne scans"), QgsProcessing.SourceType.TypeFile, optional=True
            ),
            about="Whole and not masked, to check the pose: what stands around the radar is "
            "compared with their trees and walls.",
        )
        self.add(
            QgsProcessingParameterString("COMPASS", tr("Compass bearing"), optional=True),
            about="Where the radar looks, if known: degrees clockwise from true north, or a word "
            "such as north-east. Without it the direction is searched.",
        )
        self.add(
            QgsProcessingParameterNumber(
                "HEADING", tr("Heading from grid east, deg"),
                QgsProcessingParameterNumber.Type.Double, None, optional=True,
            ),
            about="The same, anticlockwise from grid east; give one of the two.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterEnum(
                "METHOD", tr("Method"), [tr("lanes and Doppler"), tr("ICP of the paper")],
                defaultValue=0,
            ),
            advanced=True,
        )  # fmt: skip
        add_origin(self)
        add_scan_crs(self)
        poses, pictures = tr("Poses") + " (*.json)", tr("Pictures") + " (*.png)"
        self.add(QgsProcessingParameterFileDestination("POSE", tr("Pose"), poses))
        self.add(QgsProcessingParameterFileDestination("FIGURE", tr("Figure"), pictures))
        self.add(QgsProcessingParameterVectorDestination("OUTPUT", tr("Sensor")))
        self.addOutput(QgsProcessingOutputHtml("REPORT", tr("How it was found")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        pose = self.parameterAsFileOutput(parameters, "POSE", context)
        figure = self.parameterAsFileOutput(parameters, "FIGURE", context)
        dest = self.parameterAsOutputLayer(parameters, "OUTPUT", context)
        method = METHODS[self.parameterAsEnum(parameters, "METHOD", context)]
        words = [
            "localize", self.parameterAsFile(parameters, "RECORDING", context),
            "--map", self.parameterAsFile(parameters, "MAP", context),
            "--road", self.parameterAsFile(parameters, "ROAD", context),
            *self._guess(parameters, context), "--method", method,
            *option("--compass", self._compass(parameters, context)),
            *scan_words(self, parameters, context),
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
            "--figure", figure, "-o", pose,
        ]  # fmt: skip
        if parameters.get("HEADING") is not None:
            words += ["--heading", str(self.parameterAsDouble(parameters, "HEADING", context))]
        answer = self.work(words, [pose, figure], feedback)
        self.work(["sensors", pose, "-o", dest], [dest], feedback)
        if finish_output(context, dest):
            for layer, name in (("views", tr("View")), ("uncertainty", tr("Uncertainty (95 %)"))):
                load(context, f"{dest}|layername={layer}", name)
        report = write_report(figure, answer.summary)
        return {"POSE": pose, "FIGURE": figure, "OUTPUT": dest, "REPORT": report}

    def _compass(self, parameters: dict[str, Any], context: QgsProcessingContext) -> str:
        return bearing_word(self.parameterAsString(parameters, "COMPASS", context))

    def _guess(self, parameters: dict[str, Any], context: QgsProcessingContext) -> list[str]:
        """Return the click in a metric system that has a number; the worker takes it from there."""
        point = self.parameterAsPoint(parameters, "GUESS", context)
        crs = self.parameterAsPointCrs(parameters, "GUESS", context)
        if not crs.isValid():
            raise QgsProcessingException(
                tr("Where the radar stands: the point has no coordinate system.")
            )
        if crs.isGeographic() or not crs.authid().startswith("EPSG:"):
            point, crs = _in_metres(point, crs, context)
        return ["--guess", f"{point.x():.3f},{point.y():.3f}", "--guess-crs", crs.authid()]


def _in_metres(
    point: QgsPointXY, crs: QgsCoordinateReferenceSystem, context: QgsProcessingContext
) -> tuple[QgsPointXY, QgsCoordinateReferenceSystem]:
    metres = QgsCoordinateReferenceSystem(WEB_MERCATOR)
    try:
        moved = QgsCoordinateTransform(crs, metres, context.transformContext()).transform(point)
    except QgsCsException as error:
        text = tr("Where the radar stands: {point} is no place on earth.")
        raise QgsProcessingException(text.format(point=point.toString())) from error
    return moved, metres


def write_report(figure: str, summary: dict[str, Any]) -> str:
    """Write figure and numbers as a page for QGIS's results viewer; return where."""
    rows = "".join(
        f"<tr><td>{html.escape(tr(name.replace('_', ' ')))}</td>"
        f"<td>{html.escape(readable(value))}</td></tr>"
        for name, value in summary.items()
    )
    path = Path(QgsProcessingUtils.generateTempFilename("localization.html"))
    picture = Path(figure).as_uri()
    path.write_text(
        f'<html><meta charset="utf-8"><body><table>{rows}</table>'
        f'<img src="{picture}" width="900"></body></html>',
        encoding="utf-8",
    )
    return str(path)

"""Occupancy from recordings of several sensors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterCrs,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRange,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..inputs import TILE_FIELDS, TILES, layer_file
from ..words import tr
from .tiles import crs_words


class MeasureOccupancy(WorkerAlgorithm):
    """An algorithm that measures occupancy from recordings and poses of several sensors."""

    NAME = "occupancy"
    TITLE = "Occupancy from recordings"
    GROUP = TRAFFIC
    HELP = (
        "Finds which tile was hit in which step of 50 ms, by one or more radars; what several "
        "radars see at once counts once.\n"
        "Each recording belongs to a pose file: they are paired by name (R1.parquet and R1.json, "
        "or the sensor's name in the pose), and where no name fits by their order.\n"
        "The layer of tiles may be filtered or selected: then only these tiles count, and the heat "
        "map must be made with the same ones."
    )
    KEYWORDS = ("fusion", "sensors")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        files = QgsProcessing.SourceType.TypeFile
        self.add(
            QgsProcessingParameterMultipleLayers("RECORDINGS", tr("Recordings"), files),
            about="One a sensor (Parquet or CSV).",
        )
        self.add(
            QgsProcessingParameterMultipleLayers("POSES", tr("Poses"), files),
            about="As many pose files (JSON) or pose tracks (CSV) as recordings.",
        )
        self.add(
            QgsProcessingParameterFeatureSource(
                "TILES", tr("Tiles"), [QgsProcessing.SourceType.TypeVectorPolygon]
            ),
            about="From 'Split lanelets into tiles'.",
        )
        self.add(
            QgsProcessingParameterMultipleLayers(
                "SCANS", tr("Airborne scans"), files, optional=True
            ),
            about="LAS or LAZ, whole and not masked: what stands in them hides tiles, which then "
            "are not observed. Without them all that is within the view counts as seen.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterFile(
                "SIGHT", tr("Sight"), optional=True, fileFilter=tr("GeoPackages") + " (*.gpkg)"
            ),
            about="What sensors see, from gis-radar sight, in place of the scans.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterCrs("SCAN_CRS", tr("CRS of the scans"), optional=True),
            about="Only for scans without one.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterRange(
                "CLEARANCE", tr("Height over the road that counts, m"),
                QgsProcessingParameterNumber.Type.Double, optional=True,
            ),
            about="-0.5 to 4.5 keeps vehicles, without the tree crowns over the kerb. "
            "The tiles need heights for it.",
        )  # fmt: skip
        self.add(_number("MIN_SPEED", tr("Least speed, m/s")), advanced=True,
                 about="Least absolute range rate; without it what stands counts too.")  # fmt: skip
        self.add(_number("MIN_RCS", tr("Least radar cross section, dBm2")), advanced=True)
        self.add(_number("MAX_RANGE", tr("Range of poses without a view, m")), advanced=True)
        self.add(_number("AZIMUTH", tr("Azimuth of poses without a view, deg")), advanced=True)
        self.add(
            QgsProcessingParameterFolderDestination("OUTPUT", tr("Occupancy")),
            about="A folder; folders of any times and sensors go together into a heat map.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        recordings = self.files(parameters, "RECORDINGS", context)
        poses = paired(recordings, self.files(parameters, "POSES", context))
        for recording, pose in zip(recordings, poses):
            feedback.pushInfo(f"{Path(recording).name} - {Path(pose).name}")
        tiles, _ = layer_file(
            self, parameters, "TILES", context, layer_name=TILES, fields=TILE_FIELDS
        )
        words = ["occupancy", *recordings, "--tiles", tiles, "-o", dest]
        for pose in poses:
            words += ["--pose", pose]
        for scan in self.files(parameters, "SCANS", context):
            words += ["--scan", scan]
        words += option("--sight", self.parameterAsFile(parameters, "SIGHT", context))
        words += option(
            "--scan-crs", crs_words(self.parameterAsCrs(parameters, "SCAN_CRS", context))
        )
        words += option("--clearance", self._clearance(parameters, context))
        for flag, name in (
            ("--min-speed", "MIN_SPEED"), ("--min-rcs", "MIN_RCS"),
            ("--max-range", "MAX_RANGE"), ("--azimuth", "AZIMUTH"),
        ):  # fmt: skip
            if parameters.get(name) is not None:
                words += option(flag, self.parameterAsDouble(parameters, name, context))
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}

    def _clearance(self, parameters: dict[str, Any], context: QgsProcessingContext) -> str:
        if parameters.get("CLEARANCE") in (None, "", "None,None"):
            return ""
        low, high = self.parameterAsRange(parameters, "CLEARANCE", context)
        if not low < high:  # also where QGIS gives NaN for an empty box
            raise QgsProcessingException(
                tr("Height over the road: give both limits, the lower one first.")
            )
        return f"{low},{high}"


def _number(name: str, title: str) -> QgsProcessingParameterNumber:
    kind = QgsProcessingParameterNumber.Type.Double
    return QgsProcessingParameterNumber(name, title, kind, None, optional=True)


def paired(recordings: list[str], poses: list[str]) -> list[str]:
    """Return the pose of each recording: by name, or in order where no name fits.

    Raises
    ------
    QgsProcessingException
        If there are not as many poses as recordings, or only some of the names fit.
    """
    if len(recordings) != len(poses):
        text = tr("{recordings} recordings and {poses} poses: each recording needs its pose.")
        raise QgsProcessingException(text.format(recordings=len(recordings), poses=len(poses)))
    names = [_names(pose) for pose in poses]
    fitting = [
        [place for place, known in enumerate(names) if Path(recording).stem in known]
        for recording in recordings
    ]
    if not any(fitting):
        return poses
    chosen = [places[0] for places in fitting if len(places) == 1]
    if len(set(chosen)) != len(recordings):
        raise QgsProcessingException(
            tr("Only some recordings and poses fit by name: rename them as R1.parquet, R1.json.")
        )
    return [poses[place] for place in chosen]


def _names(pose: str) -> set[str]:
    """Return what the sensor of a pose file may be called."""
    names = {Path(pose).stem}
    if Path(pose).name == "pose.json":  # of a site's run: sensors/R1/pose.json
        names = {Path(pose).parent.name}
    try:
        record = json.loads(Path(pose).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return names  # the worker reports what is wrong with the file
    sensor = record.get("sensor") if isinstance(record, dict) else None
    return names | ({str(sensor)} if sensor else set())

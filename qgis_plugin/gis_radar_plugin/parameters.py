"""Parameters that several algorithms have, with their checks, and the words that they become."""

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
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterString,
)

from .base import Algorithm, option
from .inputs import TILE_FIELDS, TILES, layer_file
from .words import tr

CRS_HELP = "A projected system in metres; without one the UTM zone of the site is taken."
ORIGIN_HELP = (
    "Only for maps whose latitudes and longitudes are empty or false: easting and northing "
    "of the map's local (0, 0), with a comma between them."
)


def add_map(algorithm: Algorithm, *, about: str = "", optional: bool = False) -> None:
    """Add the Lanelet2 map."""
    kinds = tr("Lanelet2 maps") + " (*.osm *.xml)"
    algorithm.add(
        QgsProcessingParameterFile("MAP", tr("Lanelet2 map"), optional=optional, fileFilter=kinds),
        about=about,
    )


def add_road(algorithm: Algorithm, *, about: str, optional: bool = False) -> None:
    """Add the scanned road."""
    kinds = tr("Point clouds") + " (*.laz *.las)"
    algorithm.add(
        QgsProcessingParameterFile("ROAD", tr("Scanned road"), optional=optional, fileFilter=kinds),
        about=about,
    )


def add_crs(algorithm: Algorithm) -> None:
    """Add the system of what is made of a map."""
    crs = QgsProcessingParameterCrs("CRS", tr("Coordinate system"), optional=True)
    algorithm.add(crs, about=CRS_HELP, advanced=True)


def add_origin(algorithm: Algorithm) -> None:
    """Add the origin of a map without true latitudes and longitudes."""
    origin = QgsProcessingParameterString("ORIGIN", tr("Origin of the map"), optional=True)
    algorithm.add(origin, about=ORIGIN_HELP, advanced=True)


def add_tiles(algorithm: Algorithm, *, about: str) -> None:
    """Add the layer of tiles."""
    polygons = [QgsProcessing.SourceType.TypeVectorPolygon]
    algorithm.add(QgsProcessingParameterFeatureSource("TILES", tr("Tiles"), polygons), about=about)


def tile_file(
    algorithm: Algorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> str:
    """Return a GeoPackage of the chosen tiles."""
    return layer_file(
        algorithm, parameters, "TILES", context, layer_name=TILES, fields=TILE_FIELDS
    )[0]


def add_recordings(algorithm: Algorithm, *, about: str) -> None:
    """Add recordings, and the pose of each."""
    files = QgsProcessing.SourceType.TypeFile
    algorithm.add(
        QgsProcessingParameterMultipleLayers("RECORDINGS", tr("Recordings"), files), about=about
    )
    algorithm.add(
        QgsProcessingParameterMultipleLayers("POSES", tr("Poses"), files),
        about="As many pose files (JSON) or pose tracks (CSV) as recordings.",
    )


def add_hiding_scans(algorithm: Algorithm) -> None:
    """Add scans that tell what sensors see."""
    files = QgsProcessing.SourceType.TypeFile
    algorithm.add(
        QgsProcessingParameterMultipleLayers("SCANS", tr("Airborne scans"), files, optional=True),
        about="LAS or LAZ, whole and not masked: what stands in them hides tiles, which then "
        "are not observed. Without them all that is within the view counts as seen.",
    )


def add_scan_crs(algorithm: Algorithm) -> None:
    """Add the system of scans that do not state theirs."""
    crs = QgsProcessingParameterCrs("SCAN_CRS", tr("CRS of the scans"), optional=True)
    algorithm.add(crs, about="Only for scans without one.", advanced=True)


def crs_words(
    algorithm: Algorithm, parameters: dict[str, Any], name: str, context: QgsProcessingContext
) -> list[str]:
    """Return a coordinate system as an option of the worker, nothing where there is none."""
    crs = algorithm.parameterAsCrs(parameters, name, context)
    flag = "--" + name.lower().replace("_", "-")
    return option(flag, crs.authid() or crs.toWkt()) if crs.isValid() else []


def recording_words(
    algorithm: Algorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    feedback: QgsProcessingFeedback,
) -> list[str]:
    """Return recordings, their poses, tiles and scans as the worker reads them.

    Raises
    ------
    QgsProcessingException
        If poses do not fit the recordings, or the layer is not one of tiles.
    """
    recordings = algorithm.files(parameters, "RECORDINGS", context)
    poses = paired(recordings, algorithm.files(parameters, "POSES", context))
    for recording, pose in zip(recordings, poses):
        feedback.pushInfo(f"{Path(recording).name} - {Path(pose).name}")
    words = [*recordings, "--tiles", tile_file(algorithm, parameters, context)]
    for pose in poses:
        words += ["--pose", pose]
    for scan in algorithm.files(parameters, "SCANS", context):
        words += ["--scan", scan]
    return words + crs_words(algorithm, parameters, "SCAN_CRS", context)


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

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
    QgsProcessingParameterEnum,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from .base import Algorithm, option
from .inputs import TILE_FIELDS, TILES, layer_file
from .words import WINDS, speaks_german, tr

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


def add_dataset(algorithm: Algorithm) -> None:
    """Add the dataset of a site."""
    folder = QgsProcessingParameterFile.Behavior.Folder
    algorithm.add(
        QgsProcessingParameterFile("DATASET", tr("Dataset"), folder),
        about="A folder from 'Measure traffic', or 'dataset' of a site's run.",
    )


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


def add_text(algorithm: Algorithm, name: str, title: str, about: str = "") -> None:
    """Add an option that is a text."""
    text = QgsProcessingParameterString(name, tr(title), optional=True)
    algorithm.add(text, about=about, advanced=True)


def add_number(algorithm: Algorithm, name: str, title: str, about: str = "") -> None:
    """Add an option that is a number; empty where the command's own default holds."""
    kind = QgsProcessingParameterNumber.Type.Double
    number = QgsProcessingParameterNumber(name, tr(title), kind, None, optional=True)
    algorithm.add(number, about=about, advanced=True)


def add_file(algorithm: Algorithm, name: str, title: str, kinds: str, about: str = "") -> None:
    """Add an option that is a file; its kinds are as `Clocks (*.json)`."""
    words, _, ends = kinds.partition(" (")
    file = QgsProcessingParameterFile(
        name, tr(title), optional=True, fileFilter=f"{tr(words)} ({ends}"
    )
    algorithm.add(file, about=about, advanced=True)


def add_choice(
    algorithm: Algorithm, name: str, title: str, choices: tuple[str, ...], about: str = ""
) -> None:
    """Add an option that is one of some words; the first is the command's default."""
    choice = QgsProcessingParameterEnum(
        name, tr(title), list(choices), defaultValue=choices[0], usesStaticStrings=True
    )
    algorithm.add(choice, about=about, advanced=True)


def users_languages() -> tuple[str, str]:
    """Return the languages that there are, the user's first."""
    return ("de", "en") if speaks_german() else ("en", "de")


def add_language(algorithm: Algorithm) -> None:
    """Add the language of what people read; first is the user's."""
    add_choice(algorithm, "LANGUAGE", "Language", users_languages())


def add_views(algorithm: Algorithm) -> None:
    """Add what sensors see whose poses do not state it."""
    add_number(algorithm, "MAX_RANGE", "Range of poses without a view, m")
    add_number(algorithm, "AZIMUTH", "Azimuth of poses without a view, deg")
    add_number(algorithm, "ELEVATION", "Elevation of poses without a view, deg")


def add_sight(algorithm: Algorithm) -> None:
    """Add what sensors see, as a file in place of scans."""
    add_file(
        algorithm, "SIGHT", "Sight", "GeoPackages (*.gpkg)",
        "What sensors see, from 'What sensors see', in place of the scans.",
    )  # fmt: skip


def add_frame_times(algorithm: Algorithm) -> None:
    """Add cycles of slow sensors, and clocks that are off."""
    add_text(
        algorithm, "CYCLE", "Cycles of slow radars",
        "Only for radars under 10 Hz: R3=150ms, with a comma between more.",
    )  # fmt: skip
    add_text(
        algorithm, "CLOCKS", "Clocks",
        "Corrects clocks that are off: a file from 'Compare clocks', or the word auto.",
    )  # fmt: skip


def add_timezone(algorithm: Algorithm, about: str) -> None:
    """Add the time zone of what people read."""
    zone = QgsProcessingParameterString("TIMEZONE", tr("Time zone"), optional=True)
    algorithm.add(zone, about=about)


VIEWS = ("MAX_RANGE", "AZIMUTH", "ELEVATION")
FRAME_TIMES = ("CYCLE", "CLOCKS")


def given_words(
    algorithm: Algorithm,
    parameters: dict[str, Any],
    context: QgsProcessingContext,
    names: tuple[str, ...],
) -> list[str]:
    """Return options of the worker, each named as its parameter, of those that are given.

    A choice is given where it is not the command's own.
    """
    words: list[str] = []
    for name in names:
        flag = "--" + name.lower().replace("_", "-")
        definition = algorithm.parameterDefinition(name)
        kind = definition.type()
        if kind == "boolean":
            words += [flag] if algorithm.parameterAsBoolean(parameters, name, context) else []
        elif kind == "number":
            if parameters.get(name) not in (None, ""):
                number = algorithm.parameterAsDouble(parameters, name, context)
                words += option(flag, f"{number:.12g}")
        elif kind == "enum":
            chosen = algorithm.parameterAsEnumString(parameters, name, context)
            is_own = chosen == definition.defaultValue() and name not in ("LANGUAGE", "CSV_LOCALE")
            words += [] if is_own else [flag, chosen]
        else:
            words += option(flag, algorithm.parameterAsString(parameters, name, context).strip())
    return words


def scan_words(
    algorithm: Algorithm, parameters: dict[str, Any], context: QgsProcessingContext
) -> list[str]:
    """Return whole scans, and their system, as the worker reads them."""
    words: list[str] = []
    for scan in algorithm.files(parameters, "SCANS", context):
        words += ["--scan", scan]
    return words + crs_words(algorithm, parameters, "SCAN_CRS", context)


def bearing_word(text: str) -> str:
    """Return a bearing as the worker reads it: a number, or an English word of `WINDS`."""
    plain = text.strip().casefold().replace("-", "").replace(" ", "")
    for wind in WINDS:
        if plain in (tr(wind).casefold().replace("-", ""), wind.replace("-", "")):
            return wind
    return text.strip().replace(",", ".")


def add_csv_locale(algorithm: Algorithm) -> None:
    """Add in which country's form numbers in tables are."""
    add_choice(
        algorithm, "CSV_LOCALE", "Numbers in tables as in", users_languages(),
        "de: semicolons and decimal commas, as Excel in Germany opens them.",
    )  # fmt: skip


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
    """Return recordings, their poses and tiles as the worker reads them.

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
    return words


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

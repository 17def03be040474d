"""Parameters of several algorithms; `dataclasses.replace` gives one of them another help text."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from qgis.core import QgsProcessingException

from ..parameters import Crs, File, Files, Folder, Given, Language, Layer, Switch, Text
from ..words import tr


@dataclass(frozen=True)
class Poses(Files):
    """Poses, one a file of `RECORDINGS` where those are given."""

    def words(self, given: Given) -> list[str]:
        """Return them in the order of the recordings.

        Raises
        ------
        QgsProcessingException
            If they do not fit the recordings.
        """
        recordings, poses = given.files("RECORDINGS"), given.files(self.name)
        if recordings:
            poses = paired(recordings, poses)
        for recording, pose in zip(recordings, poses):
            given.feedback.pushInfo(f"{Path(recording).name} - {Path(pose).name}")
        return self._option(*poses)


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
    names = [_names_of_pose(pose) for pose in poses]
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


def _names_of_pose(pose: str) -> set[str]:
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


RECORDING = File("RECORDING", "Recording", flag="", kinds="Recordings (*.parquet *.csv)")
RECORDINGS = Files("RECORDINGS", "Recordings", flag="")
POSE = File("POSE", "Pose", kinds="Poses (*.json *.csv)")
POSES = Poses(
    "POSES", "Poses", "As many pose files (JSON) or pose tracks (CSV) as recordings.", "--pose"
)
MAP = File("MAP", "Lanelet2 map", kinds="Lanelet2 maps (*.osm *.xml)")
ROAD = File(
    "ROAD", "Scanned road", "From 'Mask road from airborne scan'.",
    kinds="Point clouds (*.laz *.las)",
)  # fmt: skip
CRS = Crs(
    "CRS", "Coordinate system",
    "A projected system in metres; without one the UTM zone of the site is taken.",
)  # fmt: skip
SCAN_CRS = Crs("SCAN_CRS", "CRS of the scans", "Only for scans without one.")
ORIGIN = Text(
    "ORIGIN", "Origin of the map",
    "Only for maps whose latitudes and longitudes are empty or false: easting and northing "
    "of the map's local (0, 0), with a comma between them.",
)  # fmt: skip
TILES = Layer(
    "TILES", "Tiles", "From 'Split lanelets into tiles', all of them.", layer="tiles",
    fields=(
        "tile_id", "lanelet_id", "index", "s_m", "length_m", "width_m", "height_m", "subtype",
    ),
)  # fmt: skip
DATASET = Folder(
    "DATASET", "Dataset", "A folder from 'Measure traffic', or 'dataset' of a site's run.", ""
)
SCANS = Files(
    "SCANS", "Airborne scans",
    "LAS or LAZ, whole and not masked: what stands in them hides tiles, which then "
    "are not observed. Without them all that is within the view counts as seen.",
    "--scan", optional=True,
)  # fmt: skip
INTERVAL = Text(
    "INTERVAL", "Interval", "Length of the intervals: 1min, 5min, 15min, 1h, 24h.",
    advanced=False, default="15min",
)  # fmt: skip
BEGIN = Text("BEGIN", "Begin", "Only from this time on, in the time zone: 2025-06-12 07:30.")
END = Text("END", "End", "Only before this time.")
LOAD = Switch(
    "LOAD", "Load the layers", "Switch it off in a model that continues with the files.", None,
    default=True,
)  # fmt: skip
TIMEZONE = Text("TIMEZONE", "Time zone", advanced=False)
MAP_TITLE = Text("TITLE", "Title")
SOURCE = Text("SOURCE", "Source")
LANGUAGE = Language("LANGUAGE", "Language")
CSV_LOCALE = Language(
    "CSV_LOCALE", "Numbers in tables as in",
    "de: semicolons and decimal commas, as Excel in Germany opens them.",
)  # fmt: skip

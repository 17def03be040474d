"""Scenes of INFRA-3DRC and of data sets in its layout: PCD folders of radars, one calibration."""

from __future__ import annotations

import heapq
import json
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import Floats, InputError, Text
from gis_radar.recordings.frames import Format, Frame, NothingHereError, ReaderContext
from gis_radar.recordings.readers.pcd import read_folder

CALIBRATION = "calibration.json"
# The published chain from a radar to the ground goes over the lidar.
LIDAR, GROUND = "lidar_01", "ground"
LACKING = "crs, easting, northing and yaw"


def _radars(place: Path) -> list[Path]:
    """Return the folders of clouds `radar_NN/radar_NN__data` of a scene."""
    # Archives of single scenes hold the scene's folder in one of the same name.
    for scene in (place, place / place.resolve().name):
        found = sorted(scene.glob("radar_*/radar_*__data"))
        if found and (scene / CALIBRATION).is_file():
            return [folder for folder in found if folder.name == f"{folder.parent.name}__data"]
    return []


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    folders = _radars(Path(source))
    wanted = [folder for folder in folders if context.wants(folder.parent.name)]
    if not wanted:
        names = ", ".join(folder.parent.name for folder in folders)
        raise NothingHereError("{}: holds the sensors {}", source, names, hint="name one, or none")
    for folder in wanted:
        context.remark(explain_calibration(folder.parents[1] / CALIBRATION, folder.parent.name))
    read = [read_folder(folder, folder.parent.name, context) for folder in wanted]
    yield from heapq.merge(*read, key=lambda frame: frame.arrival)


def explain_calibration(path: Path, radar: str) -> str:
    """Return what a calibration states of a radar's pose, and what it lacks for one.

    Parameters
    ----------
    path : Path
        `calibration.json`: a list `calibration` of entries with the name `A_to_B` as `calibration`
        and as `T` the 3 x 4 matrix [R t] that takes points from the frame of A to that of B.
    radar : str
        The radar's name in it, such as `radar_01`.

    Raises
    ------
    InputError
        If the file is not such a calibration.
    """
    try:
        entries = json.loads(path.read_text(encoding="utf-8-sig"))["calibration"]
        given = {entry["calibration"]: entry["T"] for entry in entries if "T" in entry}
        steps = [f"{radar}_to_{LIDAR}", f"{LIDAR}_to_{GROUND}"]
        missing = [step for step in steps if step not in given]
        if missing:
            return Text("{}: lacks {}", path.name, " and ".join(missing))
        to_lidar, to_ground = (_transform(given[step]) for step in steps)
    except OSError as error:
        raise InputError("{}: cannot be read: {}", path, error.strerror or error) from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            "{}: not a calibration: {} {}", path, type(error).__name__, error
        ) from error
    T_ground_radar = to_ground @ to_lidar  # noqa: N806 - frames name a transform
    rotation = T_ground_radar[:3, :3]
    pitch = np.degrees(np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0])))
    roll = np.degrees(np.arctan2(rotation[2, 1], rotation[2, 2]))
    # The data set's own errata: the ground's offset is published with the wrong sign.
    height = T_ground_radar[2, 3] - 2.0 * min(to_ground[2, 3], 0.0)
    tilt = Text("pitch {:.2f} deg, roll {:.2f} deg", round(pitch, 2) + 0.0, round(roll, 2) + 0.0)
    return Text(
        "{}: {} is {:.2f} m over the ground, {}; for a pose it lacks {}: gis-radar "
        "localize finds them",
        path.name,
        radar,
        height,
        tilt,
        LACKING,
    )


def _transform(rows: Any) -> Floats:
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
        raise ValueError(
            Text("a transform is {}, expected 3x4 numbers", "x".join(map(str, matrix.shape)))
        )
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


FORMAT = Format(
    name="scene",
    takes="a folder with radar_01/radar_01__data/*.pcd and calibration.json, as INFRA-3DRC's",
    accepts=lambda source: bool(_radars(Path(source))),
    frames=_frames,
)

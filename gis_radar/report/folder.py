"""What a folder of results holds: its heat map, and what else tells how that came about."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.crs import name_of, same_plane
from gis_radar.errors import InputError
from gis_radar.occupancy import Occupancy, merge_occupancies, read_occupancy
from gis_radar.pose import Pose, pose_from_dict
from gis_radar.pose_files import read_track
from gis_radar.report.traffic import PACKAGE, Traffic, read_traffic

MANIFEST = "manifest.json"
RUN = "run.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The results that a report tells of.

    Parameters
    ----------
    folder : Path
        Where they are.
    traffic : Traffic
        The heat map.
    occupancy : Occupancy or None
        What it was made of; None where it is not there.
    poses : sequence of Pose
        The last pose of each sensor that the heat map shows, by name, where it is in the map's
        coordinate system.
    figures : mapping
        Picture of how a sensor's pose was found, by its name.
    run : mapping
        What `gis-radar run` noted; empty where the steps were made one by one.
    missing : sequence of str
        What is not there, in sentences.
    """

    folder: Path
    traffic: Traffic
    occupancy: Occupancy | None
    poses: Sequence[Pose]
    figures: Mapping[str, Path]
    run: Mapping[str, Any]
    missing: Sequence[str]

    @property
    def sensors(self) -> list[str]:
        """The sensors that the heat map shows, as far as known."""
        known = self.occupancy.sensors if self.occupancy else [each.sensor for each in self.poses]
        return list(known)

    @property
    def site(self) -> Mapping[str, Any]:
        """The site file's content, empty where there was none."""
        return dict(self.run.get("site") or {})

    @property
    def stages(self) -> list[dict[str, Any]]:
        """How the stages of the run ended."""
        return list(self.run.get("stages") or [])


def read_results(folder: Path, occupancies: Sequence[Path] = ()) -> Results:
    """Look for the results of `gis-radar run`, or of the steps one by one.

    Parameters
    ----------
    folder : Path
        Holds `heatmap.gpkg`, or a folder with it: `heatmap/`, or the only one that has one.
    occupancies : sequence of Path
        Folders of occupancies that lie elsewhere; without them `occupancy/` or all in it.

    Raises
    ------
    InputError
        If there is no heat map, or several, or something is damaged.
    """
    run = _run(folder)
    traffic = read_traffic(_heat_map(folder))
    given = list(occupancies) or _occupancies(folder)
    parts = [read_occupancy(each) for each in given]
    missing = []
    fitting = [part for part in parts if part.fingerprint == traffic.fingerprint]
    if len(fitting) < len(parts):
        if occupancies:
            other = next(
                place
                for place, part in zip(given, parts, strict=True)
                if part.fingerprint != traffic.fingerprint
            )
            raise InputError(
                f"{traffic.folder}: was not made with the tiles of the occupancy {other}",
                hint="name the folders that the heat map was made of",
            )
        missing.append("An occupancy in the folder belongs to other tiles and is left out.")
    occupancy = merge_occupancies(fitting) if fitting else None
    figures = {
        path.parent.name: path for path in sorted((folder / "sensors").glob("*/localization.png"))
    }
    if occupancy is None:
        missing.append(
            "The occupancy that the heat map was made of is not in the folder: what the sensors "
            "delivered, their poses and the filters cannot be told (option --occupancy)."
        )
    if not run:
        missing.append("The folder is not that of a run: settings are told only as far as known.")
    poses = _poses(folder, occupancy)
    missing += [
        f"The pose of sensor {pose.sensor} is in {name_of(pose.crs)[:24]}, the map in "
        f"{name_of(traffic.crs)[:24]}: it is left out."
        for pose in poses
        if not same_plane(pose.crs, traffic.crs)
    ]
    return Results(
        folder=folder,
        traffic=traffic,
        occupancy=occupancy,
        poses=[pose for pose in poses if same_plane(pose.crs, traffic.crs)],
        figures=figures,
        run=run,
        missing=missing,
    )


def _heat_map(folder: Path) -> Path:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", hint="name the folder of gis-radar run")
    for place in (folder, folder / "heatmap"):
        if (place / PACKAGE).is_file():
            return place
    found = sorted(path.parent for path in folder.glob(f"*/{PACKAGE}"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: holds several heat maps: {names}", hint="name one of them")
    if not found:
        raise InputError(
            f"{folder}: holds no heat map", hint="make one with: gis-radar run, gis-radar heatmap"
        )
    return found[0]


def _occupancies(folder: Path) -> list[Path]:
    whole = folder / "occupancy"
    places = [whole] if (whole / MANIFEST).is_file() else sorted(whole.glob("*/"))
    return [place for place in places if (place / MANIFEST).is_file()]


def _poses(folder: Path, occupancy: Occupancy | None) -> list[Pose]:
    """Return the pose that each sensor had last, as the occupancy tells, or the files beside."""
    found: dict[str, Pose] = {}
    if occupancy is not None:
        for source in occupancy.sources:
            for record in source.get("poses", []):
                pose = pose_from_dict(record, what=f"pose of {source['sensor']}")
                before = found.get(pose.sensor)
                if before is None or _since(before) <= _since(pose):
                    found[pose.sensor] = pose
    elif (folder / "sensors").is_dir():
        for path in sorted((folder / "sensors").glob("*/pose.json")):
            found[path.parent.name] = read_track(path).poses[-1]
    return [found[name] for name in sorted(found)]


def _since(pose: Pose) -> str:
    return str(pose.evidence.get("time") or "")


def _run(folder: Path) -> dict[str, Any]:
    path = folder / RUN
    if not path.is_file():
        return {}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}", hint="run the site again") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: damaged: it is no table of settings", hint="run the site again")
    return document

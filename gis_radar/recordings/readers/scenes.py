"""Scenes of INFRA-3DRC and of data sets in its layout: a folder of PCD files for each radar."""

from __future__ import annotations

import heapq
from collections.abc import Generator
from pathlib import Path

from gis_radar.recordings.frames import Format, Frame, NothingHereError, ReaderContext
from gis_radar.recordings.readers.pcd import read_folder


def _radars(place: Path) -> list[Path]:
    """Return the folders of clouds of a scene: `radar_NN/radar_NN__data`."""
    # Archives of single scenes hold the scene in a folder within one of the same name.
    for scene in (place, place / place.resolve().name):
        if found := sorted(scene.glob("radar_*/radar_*__data")):
            return [folder for folder in found if folder.name == f"{folder.parent.name}__data"]
    return []


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    folders = _radars(Path(source))
    wanted = [folder for folder in folders if context.wants(folder.parent.name)]
    if not wanted:
        names = ", ".join(folder.parent.name for folder in folders)
        raise NothingHereError("{}: holds the sensors {}", source, names, hint="name one, or none")
    read = [read_folder(folder, folder.parent.name, context) for folder in wanted]
    yield from heapq.merge(*read, key=lambda frame: frame.arrival)


FORMAT = Format(
    name="scene",
    takes="a folder with radar_01/radar_01__data/*.pcd, as INFRA-3DRC's",
    accepts=lambda source: bool(_radars(Path(source))),
    frames=_frames,
)

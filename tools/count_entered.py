"""Count the files and functions of gis_radar that a detection passes on the sample site.

    python tools/count_entered.py

From a recording to a dataset of hits alone and of all, to a heat map, and to a pose. The figures
are a length of the way through the code: they should not grow without a reason. Compiled functions,
comprehensions and code that runs at import are not counted.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import gis_radar as gr

PACKAGE = str(Path(gr.__file__).parent)


def entered(work: Callable[[], Any]) -> tuple[Any, set[tuple[str, str, int]]]:
    """Return what a call returns, and file, name and line of each function that it entered."""
    found: set[tuple[str, str, int]] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE) and "<" not in code.co_name:
            found.add((code.co_filename, code.co_name, code.co_firstlineno))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        result = work()
    finally:
        sys.setprofile(None)
    return result, found


def main(folder: Path) -> None:
    """Count for all ways."""
    sample = gr.sample_folder()
    recording, pose = sample / "R1.parquet", gr.read_pose(sample / "R1.json")
    roads = gr.read_map(sample / "junction.osm")
    tiles = gr.make_tiles(roads)
    area = gr.read_roads(sample / "junction.osm")
    gr.mask_road([sample / "scan.laz"], area, engine="laspy").write(folder / "road.laz")
    road = gr.read_road(folder / "road.laz", roads.crs)
    place = (pose.easting, pose.northing)
    made = [recording], [pose], tiles
    dataset, counted = entered(lambda: gr.measure(*made, None, folder / "hits", hits_only=True))
    show("measure, hits only", counted)
    show("measure", entered(lambda: gr.measure(*made, sample / "junction.osm", folder / "site"))[1])
    show("make_heatmap", entered(lambda: gr.make_heatmap(dataset))[1])
    show("localize", entered(lambda: gr.localize(recording, roads, road, guess=place))[1])


def show(name: str, found: set[tuple[str, str, int]]) -> None:
    """Print a row."""
    print(f"{name}: {len({file for file, _, _ in found})} files, {len(found)} functions")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(Path(folder))

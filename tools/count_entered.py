"""Count the files and functions of gis_radar that a detection passes on the sample site.

    python tools/count_entered.py

From a recording to a dataset of hits alone and of all, to a heat map, and to a pose; of a dataset,
also the job of an hour alone, where the detections pass: what is around it looks at the inputs and
checks the poses. The figures are a length of the way through the code: they should not grow without
a reason. Compiled functions, comprehensions and code that runs at import are not counted.
"""

from __future__ import annotations

import inspect
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import gis_radar as gr
from gis_radar.scans import read_roads

PACKAGE = str(Path(gr.__file__).parent)


def entered(work: Callable[[], Any], within: str = "") -> tuple[Any, set[tuple[str, str, int]]]:
    """Return what a call returns, and file, name and line of each function that it entered.

    With `within`, the name of a function: only while that runs.
    """
    found: set[tuple[str, str, int]] = set()
    runs = [not within]

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        is_function = code.co_flags & inspect.CO_OPTIMIZED and "<" not in code.co_name
        if not (is_function and code.co_filename.startswith(PACKAGE)):
            return
        if code.co_name == within and event in {"call", "return"}:
            runs.append(event == "call")
        if event == "call" and runs[-1]:
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
    area = read_roads(sample / "junction.osm")
    gr.mask_road([sample / "scan.laz"], area, engine="laspy").write(folder / "road.laz")
    road = gr.read_road(folder / "road.laz", roads.crs)
    place = (pose.easting, pose.northing)
    made = [recording], [pose], tiles
    for name, lanes in (("hits", None), ("all", sample / "junction.osm")):
        for part, within in (("", ""), (", the hour's job", "make_hour")):
            output = folder / f"{name}{part}"
            dataset, counted = entered(
                lambda: gr.measure(*made, lanes, output, hits_only=not lanes),  # noqa: B023
                within,
            )
            show(f"measure {name}{part}", counted)
    show("make_heatmap", entered(lambda: gr.make_heatmap(dataset))[1])
    show("localize", entered(lambda: gr.localize(recording, roads, road, guess=place))[1])


def show(name: str, found: set[tuple[str, str, int]]) -> None:
    """Print a row."""
    print(f"{name}: {len({file for file, _, _ in found})} files, {len(found)} functions")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(Path(folder))

"""Roadside 4D radar to lane-level traffic maps.

The way from files to maps, in the order in which data flow::

    roads = read_map("junction.osm")
    tiles = make_tiles(roads)
    dataset = measure(["R1.parquet"], [read_pose("R1.json")], tiles, "junction.osm", "dataset")
    make_heatmap(dataset, interval="20s").write("heatmap")

What the package offers is listed in `__init__.pyi` and loaded when it is first used: the command
line answers at once.
"""

from types import FunctionType
from typing import Any

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Load a name; a function that is called from here checks the kinds of its arguments."""
    found = _load(name)
    if isinstance(found, FunctionType):
        from gis_radar.base import checked  # noqa: PLC0415 - answers at once

        globals()[name] = found = checked(found, __name__)
    return found

"""Roadside 4D radar to lane-level traffic maps.

The way from files to maps, in the order in which data flow::

    roads = read_map("junction.osm")
    tiles = make_tiles(roads)
    occupancy = measure_occupancy(["R1.parquet"], [read_pose("R1.json")], tiles, "occupancy")
    make_heatmap(occupancy, tiles, interval="20s").write("heatmap")

What the package offers is listed in `__init__.pyi` and loaded when it is first used: the command
line answers at once.
"""

from typing import Any

import lazy_loader

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _public(name)
    except AttributeError:
        from gis_radar.earlier import earlier  # noqa: PLC0415 - rarely asked for

        try:
            return earlier(name)
        except AttributeError:
            pass
        raise

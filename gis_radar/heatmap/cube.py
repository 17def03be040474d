"""A heat map as a labelled cube: occupancy over tiles and time for xarray."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from gis_radar.arrays import Integers
from gis_radar.clock import STEP_US
from gis_radar.crs import name_of
from gis_radar.errors import InputError, UsageError
from gis_radar.extras import NOTEBOOKS
from gis_radar.heatmap.tally import DEFINITIONS, Tally

if TYPE_CHECKING:
    import xarray

MOST_MIB = 1024.0
_BYTES = 3 * 4 + 4  # of a tile and interval: three numbers, and the count they come from
_UNITS = {"occupied_s": "s", "observed_s": "s", "occupancy": "1"}
_OF_TILES = {
    "lanelet_id": ("lanelet of the tile", ""),
    "s_m": ("start of the tile along its lanelet", "m"),
}


def require_xarray() -> Any:
    """Return the module xarray.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import xarray  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError("a Dataset needs xarray, which is missing", hint=NOTEBOOKS) from error
    return xarray


def require_room(tiles: int, intervals: int, most_mib: float) -> None:
    """Refuse a cube that would take more memory than it may, before it is made.

    Raises
    ------
    UsageError
        If it would.
    """
    mib = tiles * intervals * _BYTES / 2**20
    if mib > most_mib:
        raise UsageError(
            f"{tiles} tiles in {intervals} intervals take {mib:.0f} MiB, over {most_mib:g} MiB",
            hint="take a longer interval, fewer tiles (tile_ids), a part of the time (within), "
            "or raise most_mib",
        )


def dataset(tally: Tally, *, most_mib: float = MOST_MIB) -> xarray.Dataset:
    """Return a heat map as a Dataset over (tile, time).

    `occupied_s`, `observed_s` and `occupancy` are float32; where a tile was not observed,
    `observed_s` is 0 and the others are NaN. Coordinates of a tile: `tile_id` (an index, so that
    `sel(tile_id=7)` works), `lanelet_id`, `s_m`, `easting`, `northing` (of its centre, m); of a
    time: `time` and `begin`, `end` (exclusive), datetime64 in UTC.

    Parameters
    ----------
    tally : Tally
        What to show.
    most_mib : float
        The memory that it may take, MiB.

    Raises
    ------
    UsageError
        If it would take more.
    InputError
        If xarray is not installed.
    """
    xr = require_xarray()
    require_room(len(tally.tiles), len(tally.timeline), most_mib)
    about = {name: {"long_name": DEFINITIONS[name], "units": unit} for name, unit in _UNITS.items()}
    values = {
        name: (("tile", "time"), value, about[name]) for name, value in _values(tally).items()
    }
    attributes = {
        "title": "Occupancy of lane tiles",
        "crs": name_of(tally.crs),
        "fingerprint": tally.fingerprint,
        "sensors": ", ".join(tally.sensors),
    }
    cube: xarray.Dataset = xr.Dataset(values, coords=_coordinates(tally), attrs=attributes)
    return cube.set_xindex("tile_id")


def _values(tally: Tally) -> dict[str, Any]:
    """Return the three numbers of all tiles and intervals, float32."""
    shape = (len(tally.tiles), len(tally.timeline))
    values = {name: np.full(shape, np.nan, np.float32) for name in _UNITS}
    for column in range(shape[1]):
        for name, value in tally.shares(column)._asdict().items():
            values[name][:, column] = value
    return values


def _coordinates(tally: Tally) -> dict[str, Any]:
    tiles = tally.tiles
    middle = shapely.get_coordinates(shapely.centroid(tiles.geometry.array))
    begin, end = _utc(tally.timeline.begin), _utc(tally.timeline.end)
    return {
        "tile_id": ("tile", tiles["tile_id"].to_numpy(np.int64)),
        **{
            name: ("tile", tiles[name].to_numpy(), {"long_name": text} | _unit(unit))
            for name, (text, unit) in _OF_TILES.items()
        },
        **{
            name: ("tile", middle[:, axis], {"long_name": name} | _unit("m"))
            for axis, name in enumerate(("easting", "northing"))
        },
        "time": ("time", begin, {"long_name": "begin of the interval, UTC"}),
        "begin": ("time", begin, {"long_name": "begin of the interval, UTC"}),
        "end": ("time", end, {"long_name": "end of the interval, exclusive, UTC"}),
    }


def _unit(unit: str) -> dict[str, str]:
    return {"units": unit} if unit else {}


def _utc(step: Integers) -> Any:
    return (step * (STEP_US // 1000)).astype("datetime64[ms]").astype("datetime64[ns]")

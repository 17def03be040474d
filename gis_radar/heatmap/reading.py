"""Heat maps read back from their folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError

from gis_radar.arrays import Floats, Integers
from gis_radar.errors import InputError
from gis_radar.heatmap.heatmap import HeatMap
from gis_radar.heatmap.intervals import Timeline
from gis_radar.heatmap.layers import BEGIN, END, LONG, WIDE
from gis_radar.steps import STEPS_PER_SECOND, seconds_from_iso, step_of
from gis_radar.tiles.tiles import COLUMNS, fingerprint

FILE = "heatmap.gpkg"
_MAKE_ONE = "make one with: gis-radar heatmap"


def read_heatmap(path: str | Path) -> HeatMap:
    """Read a heat map back, with all that it counted.

    Parameters
    ----------
    path : str or Path
        Its folder, or the GeoPackage in it.

    Returns
    -------
    HeatMap
        Equal in all figures to the one that was written.

    Raises
    ------
    InputError
        If there is none, it is damaged, or its tiles were changed since.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    if not path.is_file():
        raise InputError(f"{path}: there is no heat map", hint=_MAKE_ONE)
    try:
        tiles = pyogrio.read_dataframe(path, layer=WIDE)
        said = pyogrio.read_info(path, layer=WIDE)["layer_metadata"] or {}
        long = pyogrio.read_dataframe(
            path, layer=LONG, read_geometry=False, use_arrow=True,
            columns=["tile_id", BEGIN, END, "occupied_s", "observed_s"],
        )  # fmt: skip
    except (DataSourceError, DataLayerError, OSError) as error:
        raise InputError(f"{path}: not a heat map: {error}", hint=_MAKE_ONE) from error
    whole = _checked(tiles, said, path)
    count = len(tiles)
    expected = np.tile(tiles["tile_id"].to_numpy(), max(1, len(long) // max(1, count)))
    if not np.array_equal(expected, long["tile_id"]):
        raise InputError(f"{path}: {LONG} is damaged: not one row a tile and interval")
    timeline = Timeline(begin=_step(long[BEGIN].iloc[::count]), end=_step(long[END].iloc[::count]))
    alone = len(timeline) == 1 and np.array_equal(timeline.begin, whole.begin)
    occupied, observed = (
        _steps(long[name].to_numpy(np.float64).reshape(-1, count))
        for name in ("occupied_s", "observed_s")
    )
    seen = np.flatnonzero(observed.any(axis=0))
    group, runs = _grouped(observed[:, seen])
    return HeatMap(
        tiles=tiles[[*COLUMNS, "geometry"]],
        fingerprint=said["fingerprint"],
        sensors=tuple(json.loads(said["sensors"])),
        whole=whole,
        timeline=whole if alone and np.array_equal(timeline.end, whole.end) else timeline,
        seen=seen,
        group=group,
        occupied=occupied[:, seen].astype(np.uint32),
        observed=runs,
    )


def _checked(tiles: gpd.GeoDataFrame, said: dict[str, Any], path: Path) -> Timeline:
    """Return the whole time; refuse a table that is not what was written."""
    missing = [name for name in (*COLUMNS, "occupancy") if name not in tiles]
    missing += [name for name in ("fingerprint", "sensors", "begin", "end") if name not in said]
    if missing:
        raise InputError(f"{path}: does not say {', '.join(missing)}", hint="make it again")
    if fingerprint(tiles) != said["fingerprint"]:
        raise InputError(f"{path}: its tiles were changed since it was made", hint="make it again")
    begin, end = (
        step_of(np.array([seconds_from_iso(said[name], what=f"{path}: {name}")]))
        for name in ("begin", "end")
    )
    return Timeline(begin=begin, end=end)


def _step(times: Any) -> Integers:
    return step_of(times.to_numpy("datetime64[us]").astype(np.int64) / 1e6)


def _steps(seconds: Floats) -> Integers:
    return np.rint(np.nan_to_num(seconds) * STEPS_PER_SECOND).astype(np.int64)


def _grouped(observed: Integers) -> tuple[Integers, Integers]:
    """Return for each tile its group, and the steps of each group: equal columns are one."""
    numbers: dict[bytes, int] = {}
    columns = np.ascontiguousarray(observed.T)
    group = np.array(
        [numbers.setdefault(column.tobytes(), len(numbers)) for column in columns], np.int64
    )
    _, first = np.unique(group, return_index=True)
    return group, observed[:, first]

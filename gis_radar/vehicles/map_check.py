"""The map beside its tiles: what a manifest holds of it, and whether it is the tiles' map."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.crs import name_of
from gis_radar.errors import InputError
from gis_radar.lanelets import LaneletMap
from gis_radar.tiles.tiles import quads

SAME_PLACE_M = 0.01  # how far bounds of one map may be apart, by rounding


def describe_map(
    path: str | Path,
    roads: LaneletMap,
    tiles: gpd.GeoDataFrame,
    *,
    origin: Sequence[float] | None = None,
) -> dict[str, Any]:
    """Return what the manifest holds of a map; refuse one that the tiles were not made from.

    The tiles of each lanelet begin and end where its bounds do.

    Parameters
    ----------
    path : str or Path
        The map's file.
    roads : LaneletMap
        What was read of it, in the tiles' CRS.
    tiles : GeoDataFrame
        All tiles.
    origin : (easting, northing), optional
        The map-frame position of the map's local (0, 0), where one was given.

    Returns
    -------
    dict
        `digest`, `crs`, `origin`.

    Raises
    ------
    InputError
        If a lanelet of the tiles is not in the map, or elsewhere.
    """
    corners, lanelet = quads(tiles), tiles["lanelet_id"].to_numpy(np.int64)
    order = np.lexsort((tiles["index"].to_numpy(np.int64), lanelet))
    ids, first = np.unique(lanelet[order], return_index=True)
    last = np.append(first[1:], len(order)) - 1
    known = roads.lanelets.set_index("lanelet_id")
    hint = "give the map that the tiles were made from, with the same CRS and origin"
    missing = ids[~np.isin(ids, known.index.to_numpy())]
    if len(missing):
        raise InputError(f"{path}: lacks lanelet {missing[0]} of the tiles", hint=hint)
    known = known.loc[ids]
    for side, begin, end in (("right", 0, 1), ("left", 3, 2)):
        bound = known[side].to_numpy()
        for point, rows, corner in ((0, first, begin), (-1, last, end)):
            place = shapely.get_coordinates(shapely.get_point(bound, point))
            apart = np.hypot(*(place - corners[order[rows], corner]).T)
            far = int(apart.argmax())
            if not apart[far] <= SAME_PLACE_M:
                raise InputError(
                    f"{path}: lanelet {ids[far]} lies {apart[far]:.2f} m from its tiles", hint=hint
                )
    digest = hashlib.blake2b(Path(path).read_bytes(), digest_size=16).hexdigest()
    place_of_zero = None if origin is None else [float(each) for each in origin]
    return {"digest": digest, "crs": name_of(roads.crs), "origin": place_of_zero}

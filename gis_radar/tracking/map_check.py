"""Check that a map is the one of the tiles, and describe it for a manifest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import QUIET, InputError, Reporter, Text, UsageError, name_of
from gis_radar.hdmap import LaneletMap, map_digest, quads, read_map

_HINT = Text("give the map that the tiles were made from, with the same CRS and origin")
_SAME_PLACE_M = 0.01  # largest distance, by rounding, of the same bounds


def map_of_tiles(
    path: str | Path, tiles: gpd.GeoDataFrame, reporter: Reporter = QUIET
) -> tuple[LaneletMap, dict[str, Any]]:
    """Read the map from which tiles were made, at their place, and describe it for a manifest.

    Latitudes and longitudes may be empty or false: CRS and the place of the map's local (0, 0) are
    taken from the tiles.

    Raises
    ------
    InputError
        If it is another map.
    """
    try:
        roads = read_map(path, crs=tiles.crs, reporter=reporter)
        return roads, describe_map(path, roads, tiles)
    except InputError as error:
        try:
            local = read_map(path, crs=tiles.crs, origin=(0.0, 0.0))
        except (InputError, UsageError):
            raise error from None
    origin = _origin(local, tiles)
    if origin is None:
        raise InputError("{}: has none of the lanelets of the tiles", path, hint=_HINT)
    roads = read_map(path, crs=tiles.crs, origin=origin, reporter=reporter)
    return roads, describe_map(path, roads, tiles, origin=origin)


def _origin(local: LaneletMap, tiles: gpd.GeoDataFrame) -> tuple[float, float] | None:
    """Return the place (easting, northing) of a map's local (0, 0), by the tiles of a lanelet."""
    first = tiles[tiles["index"] == 0]
    starts = dict(zip(first["lanelet_id"].tolist(), quads(first)[:, 0].tolist(), strict=True))
    for ref, bound in zip(local.lanelets["lanelet_id"], local.lanelets["right"], strict=True):
        if int(ref) in starts:
            shift = np.array(starts[int(ref)]) - np.array(bound.coords[0][:2])
            return round(float(shift[0]), 3), round(float(shift[1]), 3)
    return None


def describe_map(
    path: str | Path,
    roads: LaneletMap,
    tiles: gpd.GeoDataFrame,
    *,
    origin: Sequence[float] | None = None,
) -> dict[str, Any]:
    """Return a manifest's entries for a map; refuse a map that is not the tiles'.

    In the tiles' map, the tiles of each lanelet begin and end where its bounds do.

    Parameters
    ----------
    path : str or Path
        The map's file.
    roads : LaneletMap
        The map, in the tiles' CRS.
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
    missing = ids[~np.isin(ids, known.index.to_numpy())]
    if len(missing):
        raise InputError("{}: lacks lanelet {} of the tiles", path, missing[0], hint=_HINT)
    known = known.loc[ids]
    for side, begin, end in (("right", 0, 1), ("left", 3, 2)):
        bound = known[side].to_numpy()
        for point, rows, corner in ((0, first, begin), (-1, last, end)):
            place = shapely.get_coordinates(shapely.get_point(bound, point))
            apart = np.hypot(*(place - corners[order[rows], corner]).T)
            far = int(apart.argmax())
            if not apart[far] <= _SAME_PLACE_M:
                raise InputError(
                    "{}: lanelet {} lies {:.2f} m from its tiles",
                    path,
                    ids[far],
                    apart[far],
                    hint=_HINT,
                )
    place_of_zero = None if origin is None else [float(each) for each in origin]
    return {"digest": map_digest(path), "crs": name_of(roads.crs), "origin": place_of_zero}

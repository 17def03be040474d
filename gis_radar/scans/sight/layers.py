"""Open scans as the source of sight, and write sight as a GeoPackage that QGIS styles by itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    QUIET,
    Reporter,
    UsageError,
    add_layer,
    atomic_write,
    checked,
    copy_saved_styles,
    paths_of,
    style_layers,
)
from gis_radar.hdmap import fingerprint
from gis_radar.scans.sight.sight import HIDERS, OUT_OF_VIEW, STATES, Sight, SightScan
from gis_radar.scans.sight.tiles import SightTiles

SIGHT_LAYER = "sight"


@checked
def write_sights(
    sights: Sequence[Sight],
    tiles: gpd.GeoDataFrame,
    path: str | Path,
) -> None:
    """Write what sensors see, a row for each pose and tile in its view; QGIS loads the style.

    Layer `sight`: `sensor`, `pose` (its number in the layer's metadata), `tile_id`, `state` (`in
    sight` or `hidden`), `hidden_by`, `hidden_at_m` (distance from the sensor in the plane, metres),
    `covered` (whether the scan decides it). The metadata hold the fingerprint of the tiles, the
    poses and the digests of the scans.

    Parameters
    ----------
    sights : sequence of Sight
        From :func:`find_sight`.
    tiles : GeoDataFrame
        The tiles that the sights are of.
    path : str or Path
        The GeoPackage; it appears whole or not at all.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: sight is written as GeoPackage", path, hint="end the name in .gpkg")
    metadata = {
        "fingerprint": fingerprint(tiles),
        "poses": json.dumps([sight.pose.as_dict() for sight in sights]),
        "scans": json.dumps([sight.scan for sight in sights]),
    }
    rows = [_rows(number, sight) for number, sight in enumerate(sights)]
    table = pd.concat(rows, ignore_index=True)
    shapes = tiles.geometry.to_numpy()[table["place"].to_numpy(np.int64)]
    layer = gpd.GeoDataFrame(table.drop(columns="place"), geometry=shapes, crs=tiles.crs)
    style = (files(__package__) / "sight.qml").read_text(encoding="utf-8")
    with atomic_write(path) as part:
        add_layer(layer, part, SIGHT_LAYER, geometry_type="Polygon", layer_metadata=metadata)
        style_layers(
            part, {SIGHT_LAYER: style}, name="sight", about="what a sensor sees of the tiles"
        )
        copy_saved_styles(part, earlier=path)


def _rows(number: int, sight: Sight) -> pd.DataFrame:
    """Return the rows of a pose in the layer: its tiles in view, with state and obstacle."""
    place = np.flatnonzero(sight.state != OUT_OF_VIEW)
    return pd.DataFrame(
        {
            "place": place,
            "sensor": sight.pose.sensor,
            "pose": number,
            "tile_id": sight.tile_id[place],
            "state": np.array(STATES)[sight.state[place]],
            "hidden_by": np.array(HIDERS)[sight.hider[place]],
            "hidden_at_m": sight.hidden_at_m[place],
            "covered": ~sight.uncovered[place],
        }
    )


def open_sight(
    tiles: SightTiles,
    *,
    scans: str | Path | Sequence[str | Path] = (),
    scan_crs: Any = None,
    cache: str | Path | None = None,
    reporter: Reporter = QUIET,
) -> SightScan | None:
    """Open scans as the source of sight.

    Parameters
    ----------
    tiles : SightTiles
        The tiles.
    scans : path or sequence of paths
        Airborne scans, whole and not masked.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    cache : str or Path, optional
        A folder for the sights of poses by these scans, so that each is computed once.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    SightScan or None
        For :func:`find_sight`; None means that sight is the view alone.
    """
    if not scans:
        return None
    folder = None if cache is None else Path(cache)
    return SightScan(paths_of(scans), tiles, scan_crs=scan_crs, cache=folder, reporter=reporter)

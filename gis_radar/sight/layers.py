"""Write what sensors see as the layer `sight` of a GeoPackage; `sight.qml` styles it."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from importlib.resources import files
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio

from gis_radar.errors import UsageError
from gis_radar.files import whole_file
from gis_radar.geopackage import GPKG_VERSION, add_styles
from gis_radar.sight.sight import HIDERS, OUT_OF_VIEW, STATES, Sight
from gis_radar.tiles.tiles import fingerprint

SIGHT_LAYER = "sight"


def write_sights(sights: Sequence[Sight], tiles: gpd.GeoDataFrame, path: str | Path) -> None:
    """Write what sensors see, a row a sensor and tile in its view; QGIS loads the style by itself.

    Columns: `sensor`, `tile_id`, `state` (`in sight` or `hidden`), `hidden_by`, `hidden_at_m`
    (distance from the sensor in the plane, metres), `covered` (whether the scan decides it). The
    layer's metadata hold the fingerprint of the tiles, the poses and the digest of the scan.

    Parameters
    ----------
    sights : sequence of Sight
        From :func:`find_sight`.
    tiles : GeoDataFrame
        The tiles that they were found for.
    path : str or Path
        The GeoPackage; it appears whole or not at all.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError(f"{path}: sight is written as GeoPackage", hint="end the name in .gpkg")
    about = {
        "fingerprint": fingerprint(tiles),
        "poses": json.dumps([sight.pose.as_dict() for sight in sights]),
        "scan": json.dumps({sight.pose.sensor: sight.scan for sight in sights}),
    }
    rows = pd.concat([_rows(sight) for sight in sights])
    table = gpd.GeoDataFrame(
        rows.drop(columns="place"),
        geometry=tiles.geometry.to_numpy()[rows["place"].to_numpy()],
        crs=tiles.crs,
    )
    with whole_file(path) as part:
        pyogrio.write_dataframe(
            table, part, layer=SIGHT_LAYER, driver="GPKG", geometry_type="Polygon",
            dataset_options={"VERSION": GPKG_VERSION}, layer_metadata=about,
        )  # fmt: skip
        style = (files(__package__) / "sight.qml").read_text(encoding="utf-8")
        with closing(sqlite3.connect(part)) as database, database:
            styles = {SIGHT_LAYER: (style, "")}
            add_styles(database, styles, name="sight", about="what a sensor sees of the tiles")


def _rows(sight: Sight) -> pd.DataFrame:
    place = np.flatnonzero(sight.state != OUT_OF_VIEW)
    return pd.DataFrame(
        {
            "place": place,
            "sensor": sight.pose.sensor,
            "tile_id": sight.tile_id[place],
            "state": np.array(STATES)[sight.state[place]],
            "hidden_by": np.array(HIDERS)[sight.hider[place]],
            "hidden_at_m": sight.hidden_at_m[place],
            "covered": ~sight.uncovered[place],
        }
    )

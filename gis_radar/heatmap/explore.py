"""A heat map to move about in: the tiles over a street map, in a browser or notebook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gis_radar.errors import NOTEBOOKS, InputError
from gis_radar.heatmap import style
from gis_radar.heatmap.counting import Tally
from gis_radar.heatmap.picture import time_span

CLASS = "share of the time"
SHOWN = ("tile_id", "lanelet_id", "s_m", "occupied_s", "observed_s", "occupancy")


def explore(tally: Tally, interval: int | None, options: Mapping[str, Any]) -> Any:
    """Return the observed tiles as a folium map, in the classes and colours of all heat maps.

    Parameters
    ----------
    tally : Tally
        What to show.
    interval : int or None
        Which interval; None for the whole time.
    options : mapping
        For :meth:`geopandas.GeoDataFrame.explore`; they win.

    Raises
    ------
    InputError
        If folium is not installed.
    """
    tiles = tally.tiles.assign(**tally.shares(interval)._asdict()).dropna(subset="occupancy")
    tiles = tiles.sort_values("occupancy", kind="stable")  # the busiest on top
    levels = style.colour_classes()
    place = np.searchsorted([level.upper for level in levels], tiles["occupancy"])
    labels = [level.label for level in levels]
    # what a browser reads has no 64-bit integers
    tiles = tiles.assign(lanelet_id=tiles["lanelet_id"].astype(str))
    tiles[CLASS] = np.array(labels, object)[place]
    chosen: dict[str, Any] = {
        "column": CLASS,
        "categorical": True,
        "categories": labels,
        "cmap": [level.colour for level in levels],
        "style_kwds": {"weight": 0.3, "fillOpacity": 0.9},
        "tooltip": [CLASS],
        "popup": list(SHOWN),
        "tiles": "CartoDB positron",
        "max_zoom": 21,
        "legend_kwds": {"caption": time_span(tally, interval)},
    }
    try:
        return tiles[[*SHOWN, CLASS, "geometry"]].round(4).explore(**chosen | dict(options))
    except ImportError as error:
        raise InputError(
            f"explore needs folium and mapclassify: {error.name or 'one'} is missing",
            hint=NOTEBOOKS,
        ) from error

"""Names and free speeds of lanes that a site states, in place of those of its map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import InputError
from gis_radar.measures import LaneNetwork


def stated_lanes(
    layer: gpd.GeoDataFrame, lanes: Sequence[Mapping[str, Any]], speed_kmh: float | None,
    source: Path,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the layer `lanes` with the column `name`, and the free speeds stated.

    Parameters
    ----------
    layer : GeoDataFrame
        The layer of the dataset.
    lanes, speed_kmh
        As for :meth:`gis_radar.Dataset.with_lanes`.
    source : Path
        Dataset or site file, for the message.

    Raises
    ------
    InputError
        If a lane is none of the layer's.
    """
    stated = {int(each["id"]): each for each in lanes}
    if unknown := sorted(set(stated) - set(layer["lane"].tolist())):
        raise InputError(
            "{}: has no lane {}", source, unknown[0], hint="the column lane of traffic.csv has them"
        )
    names, speeds = (
        layer["lane"].map({number: each.get(name) for number, each in stated.items()})
        for name in ("name", "speed_kmh")
    )
    limit = pd.Series(layer.get("speed_limit_kmh", np.nan), layer.index).astype(np.float64)
    free = speeds.astype(np.float64).fillna(limit)
    free = free if speed_kmh is None else free.fillna(speed_kmh)
    return layer.assign(name=names.astype(object), speed_limit_kmh=free)


def delays(table: pd.DataFrame, layer: gpd.GeoDataFrame, network: LaneNetwork) -> pd.Series:
    """Return delays against the free speeds of a layer, which may differ from those when measured.

    Parameters
    ----------
    table : DataFrame
        Table with `lane` and `travel_time_s`.
    layer : GeoDataFrame
        The layer `lanes`.
    network : LaneNetwork
        Its lengths.

    Returns
    -------
    Series
        Seconds; NaN where travel time or free speed is unknown.
    """
    limit = layer.get("speed_limit_kmh", pd.Series(np.nan, layer.index)).astype(np.float64)
    free_s = pd.Series(network.length_m, network.lane) / (limit.set_axis(layer["lane"]) / 3.6)
    delay: pd.Series = table["travel_time_s"] - table["lane"].map(free_s)
    return delay.clip(lower=0.0)

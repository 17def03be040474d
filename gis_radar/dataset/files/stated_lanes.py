"""What a site states of its lanes, `lanes.json` of a dataset: names, streets, free speeds.

They come before those of the map wherever lanes are read. No hour follows from them, so that they
may change at any time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio

from gis_radar.base import InputError, Text, json_text, opened_package, read_json, require_kind
from gis_radar.dataset.files import STATED_LANES
from gis_radar.dataset.files.parts import replacing
from gis_radar.hdmap import LANES_LAYER

_HINT = Text("remove it, and name the lanes again")

# What a site states of a lane: the column of the layer, and the type.
_STATED = {
    "id": ("lane", "int"), "name": ("name", "str | None"),
    "speed_kmh": ("speed_limit_kmh", "float | None"), "street": ("street", "str | None"),
    "street_part": ("street_part", "str | None"),
}  # fmt: skip
_STREETS = ["lane", "street", "street_part"]


def stated_lanes(
    layer: gpd.GeoDataFrame, lanes: Sequence[Mapping[str, Any]], speed_kmh: float | None,
    source: Path,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the layer `lanes` with what is stated; a column `name` holds names of their own.

    Parameters
    ----------
    layer : GeoDataFrame
        The layer of the dataset.
    lanes, speed_kmh
        As for :meth:`gis_radar.Dataset.with_lanes`.
    source : Path
        Dataset or file, for the message.

    Raises
    ------
    InputError
        If a lane is none of the layer's, something else is stated of it, or a speed is not above 0.
    """
    for each in lanes:
        if other := sorted(set(each) - set(_STATED)):
            raise InputError(
                "{}: a lane has {}, expected {}", source, repr(other[0]), ", ".join(_STATED)
            )
        for key, (_, kind) in _STATED.items():
            require_kind(Text("{}: {}", source, key), each.get(key), kind, InputError)
    require_kind(Text("{}: {}", source, "speed_kmh"), speed_kmh, "float | None", InputError)
    for speed in (speed_kmh, *(each.get("speed_kmh") for each in lanes)):
        if speed is not None and not speed > 0.0:
            raise InputError("{}: speed_kmh is {}, expected more than 0", source, speed)
    stated = {int(each["id"]): each for each in lanes}
    if unknown := sorted(set(stated) - set(layer["lane"].tolist())):
        raise InputError(
            "{}: has no lane {}", source, unknown[0], hint="the column lane of traffic.csv has them"
        )
    for key, (column, _) in _STATED.items():
        given = {number: each[key] for number, each in stated.items() if each.get(key) is not None}
        if given:
            before = layer.get(column, [None] * len(layer))
            pairs = zip(layer["lane"].tolist(), before, strict=True)
            layer = layer.assign(**{column: [given.get(lane, value) for lane, value in pairs]})
    if speed_kmh is not None:
        limit = pd.Series(layer.get("speed_limit_kmh", np.nan), layer.index).astype(np.float64)
        layer = layer.assign(speed_limit_kmh=limit.fillna(speed_kmh))
    return layer


def with_stated(layer: gpd.GeoDataFrame, folder: Path) -> gpd.GeoDataFrame:
    """Return the layer `lanes` of a dataset with what its site states.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    path = folder / STATED_LANES
    if not path.is_file():
        return layer
    document = read_json(path, what="names of lanes", hint=_HINT)
    try:
        lanes, speed_kmh = list(map(dict, document["lanes"])), document.get("speed_kmh")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError("{}: damaged: {}", path, f"{error!r:.200}", hint=_HINT) from error
    return stated_lanes(layer, lanes, speed_kmh, path)


def streets_of(
    lanes: str | Path | pd.DataFrame, layer: gpd.GeoDataFrame
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the streets, as they are stated, that lanes or a file of tiles have beyond a layer."""
    named: pd.DataFrame
    if isinstance(lanes, pd.DataFrame):
        named = lanes
    else:
        with opened_package(Path(lanes), what="a GeoPackage of tiles") as place:
            if LANES_LAYER not in pyogrio.list_layers(place)[:, 0]:
                return []
            named = pyogrio.read_dataframe(place, layer=LANES_LAYER, read_geometry=False)
    before, after = (
        pd.DataFrame(each).reindex(columns=_STREETS).astype(object).fillna("").to_numpy().tolist()
        for each in (layer, named)
    )
    known = {*map(tuple, before)}
    return [
        {"id": lane, "street": street, "street_part": part or None}
        for lane, street, part in after if street and (lane, street, part) not in known
    ]  # fmt: skip


def write_stated(folder: Path, lanes: Sequence[Mapping[str, Any]], speed_kmh: float | None) -> None:
    """Write what a site states of its lanes, unless that is stated already."""
    path = folder / STATED_LANES
    document = {"lanes": sorted(lanes, key=lambda each: each["id"]), "speed_kmh": speed_kmh}
    content = (json_text(document, indent=1, default=np.generic.item) + "\n").encode()
    before = path.read_bytes() if path.is_file() else b""
    if content != before and (lanes or speed_kmh is not None or before):
        with replacing(path) as fresh:
            fresh.write_bytes(content)

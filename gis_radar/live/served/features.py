"""Serve the live map as OGC API - Features: core, OpenAPI 3.0 and GeoJSON, for reading only.

The standard is OGC 17-069r4, Part 1: Core. QGIS opens the address as *WFS / OGC API - Features*.
Layers are in longitude and latitude.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from gis_radar.base import STEP_S, STEPS_PER_SECOND, InputError, iso_from_step, seconds_from_iso
from gis_radar.live.health import ALARMS
from gis_radar.live.hours.quarters import TRAFFIC_FIELDS
from gis_radar.live.now.now_filter import VehiclesNow
from gis_radar.live.now.vehicles_now import layer_of
from gis_radar.live.served.snapshot import ShownMap, Snapshot, geometries

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
_CONFORMANCE = [
    f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{part}"
    for part in ("core", "oas30", "geojson")
]
JSON, _GEOJSON = "application/json", "application/geo+json"
_OPENAPI = "application/vnd.oai.openapi+json;version=3.0"
_IDS = ("lanelet_id", "lane")  # text in JSON: they reach 9e18, exact numbers of readers only 9e15
_LIMIT, _MOST = 1_000, 20_000  # features of a page by default, and at most
_COLLECTIONS = {  # title and description; the method of _Layers with this name returns the layer
    "tiles": ("Tiles", "Slices of 0.5 m of a lane that were observed in the last 15 minutes"),
    "vehicles": ("Vehicles", "Those of now: speed in m/s"),
    "lanes": ("Lanes", "Hit share of the last 15 minutes, traffic of the last measured quarter"),
    "intervals": (
        "Lanes by 15 minutes", "Hits and traffic of each lane in intervals of 15 minutes",
    ),
    "sensors": ("Sensors", "Where they stand, and their state"),
}  # fmt: skip


def feature_routes(live: ShownMap) -> list[Route]:
    """Return the routes of the service, below `/ogc`."""
    service = _Service(live)
    at = {
        "/ogc": service.landing,
        "/ogc/": service.landing,
        "/ogc/api": service.api,
        "/ogc/conformance": service.conformance,
        "/ogc/collections": service.collections,
        "/ogc/collections/{name}": service.collection,
        "/ogc/collections/{name}/items": service.items,
        "/ogc/collections/{name}/items/{number:int}": service.item,
    }
    return [Route(path, endpoint) for path, endpoint in at.items()]


def refusal(
    request: Request, code: int, text: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Return an HTTP error: as JSON below `/ogc`, as the standard asks, else as plain text."""
    if not f"{request.url.path}/".startswith("/ogc/"):
        return PlainTextResponse(f"{text}\n", code, headers)
    return JSONResponse({"code": str(code), "description": text}, code, headers)


class _Service:
    """Responses of the service's addresses."""

    def __init__(self, live: ShownMap) -> None:
        self._title, self._layers = live.place.title, _Layers(live)
        self._bounds = live.place.in_degrees(live.place.lanes).total_bounds.tolist()

    def landing(self, request: Request) -> Response:
        at = _root(request)
        content = {
            "title": self._title,
            "description": "Which tiles of the roads are hit, now and lately",
            "links": [
                _link(at, "self", JSON, "this page"),
                _link(f"{at}/api", "service-desc", _OPENAPI, "the API"),
                _link(f"{at}/conformance", "conformance", JSON, "conformance"),
                _link(f"{at}/collections", "data", JSON, "the layers"),
            ],
        }
        return JSONResponse(content)

    def conformance(self, _: Request) -> Response:
        return JSONResponse({"conformsTo": _CONFORMANCE})

    def api(self, request: Request) -> Response:
        return JSONResponse(_openapi(_root(request), self._title), media_type=_OPENAPI)

    def collections(self, request: Request) -> Response:
        at = _root(request)
        found = [self._described(name, at) for name in _COLLECTIONS]
        links = [_link(f"{at}/collections", "self", JSON, "the layers")]
        return JSONResponse({"collections": found, "links": links})

    def collection(self, request: Request) -> Response:
        return JSONResponse(self._described(_chosen(request), _root(request)))

    def _described(self, name: str, at: str) -> dict[str, Any]:
        title, description = _COLLECTIONS[name]
        here = f"{at}/collections/{name}"
        links = [_link(f"{here}/items", "items", _GEOJSON, title),
                 _link(here, "self", JSON, "this layer")]  # fmt: skip
        extent = {"spatial": {"bbox": [self._bounds], "crs": CRS84}}
        return {
            "id": name, "title": title, "description": description, "extent": extent,
            "itemType": "feature", "crs": [CRS84], "links": links,
        }  # fmt: skip

    def items(self, request: Request) -> Response:
        layer = _filtered(self._layer(request), request.query_params)
        limit = min(_whole_number(request.query_params, "limit", _LIMIT, least=1), _MOST)
        offset = _whole_number(request.query_params, "offset", 0, least=0)
        shown = layer.iloc[offset : offset + limit]
        links = [_link(str(request.url), "self", _GEOJSON, "these features")]
        if offset + limit < len(layer):
            after = request.url.include_query_params(offset=offset + limit, limit=limit)
            here = f"{_root(request)}/collections/{_chosen(request)}/items"
            links.append(_link(f"{here}?{after.query}", "next", _GEOJSON, "the next ones"))
        content = {
            "type": "FeatureCollection",
            "features": _features(shown),
            "numberMatched": len(layer),
            "numberReturned": len(shown),
            "links": links,
        }
        return JSONResponse(content, media_type=_GEOJSON)

    def item(self, request: Request) -> Response:
        layer, number = self._layer(request), request.path_params["number"]
        if number not in layer.index:
            raise HTTPException(404, f"{_chosen(request)} has no feature {number}")
        at = f"{_root(request)}/collections/{_chosen(request)}"
        links = [
            _link(f"{at}/items/{number}", "self", _GEOJSON, "this feature"),
            _link(at, "collection", JSON, "its layer"),
        ]
        feature = _features(layer.loc[[number]])[0] | {"links": links}
        return JSONResponse(feature, media_type=_GEOJSON)

    def _layer(self, request: Request) -> gpd.GeoDataFrame:
        layer: gpd.GeoDataFrame = getattr(self._layers, _chosen(request))()
        ids = [name for name in _IDS if name in layer]
        return layer.assign(**{name: layer[name].astype(str) for name in ids})


def _chosen(request: Request) -> str:
    """Return the name of the requested collection."""
    name: str = request.path_params["name"]
    if name not in _COLLECTIONS:
        raise HTTPException(404, f"there is no collection {name[:40]!r}")
    return name


class _Layers:
    """Layers of the present map, in longitude and latitude."""

    def __init__(self, live: ShownMap) -> None:
        self._live, self._place = live, live.place
        tiles, lanes = (
            live.place.in_degrees(each) for each in (live.place.tiles, live.place.lanes)
        )
        kept = [name for name in ("tile_id", "lanelet_id", "lane", "index", "s_m") if name in tiles]
        self._tiles = tiles[[*kept, tiles.geometry.name]]
        names = dict(zip(live.place.lane_numbers, live.place.lane_names(), strict=True))
        lanes = lanes.drop(columns="lanelets", errors="ignore").reset_index(drop=True)
        self._lanes = lanes.assign(name=lanes["lane"].map(names))
        self._shapes = dict(zip(lanes["lane"], lanes.geometry, strict=True))

    def tiles(self) -> gpd.GeoDataFrame:
        now = self._live.snapshot()
        return self._tiles.assign(**_measures(now))[now.observed > 0]

    def lanes(self) -> gpd.GeoDataFrame:
        now = self._live.snapshot()
        known = pd.Series(now.by_lane(self._place), index=self._place.lane_numbers)
        table = self._lanes.assign(hits_15min=known.reindex(self._lanes["lane"]).to_numpy())
        if now.quarter is None:
            return table
        found = now.quarter.lanes.set_index("lane").reindex(table["lane"])
        return table.assign(**{f"{name}_15min": found[name].to_numpy() for name in TRAFFIC_FIELDS})

    def vehicles(self) -> gpd.GeoDataFrame:
        now = self._live.snapshot().vehicles or VehiclesNow.none()
        layer = self._place.in_degrees(layer_of(now, self._place.tiles.crs))
        time = "" if np.isnan(now.time) else iso_from_step(int(now.time * STEPS_PER_SECOND))
        return layer.assign(time=time)

    def sensors(self) -> gpd.GeoDataFrame:
        states = [each for each in self._live.snapshot().sensors if each.pose is not None]
        points = [self._place.degrees_of(each.pose) for each in states if each.pose is not None]
        rows = {
            "sensor": [each.name for each in states],
            "online": [each.online for each in states],
            "problem": ["; ".join(f"{ALARMS[kind]}: {text}" for kind, text in each.alarms.items())
                        for each in states],
            "lag_s": [each.lag_s for each in states],
        }  # fmt: skip
        return gpd.GeoDataFrame(
            rows,
            geometry=[shapely.Point(place) for place in points],
        )

    def intervals(self) -> gpd.GeoDataFrame:
        table = self._live.lane_intervals().reset_index(drop=True)
        share = table["hit_s"] / table["observed_s"].where(table["observed_s"] > 0)
        shapes = [self._shapes.get(lane) for lane in table["lane"]]
        return gpd.GeoDataFrame(table.assign(hit_share=share), geometry=shapes)


def _measures(now: Snapshot) -> dict[str, Any]:
    """Return the columns of tiles that change with time."""
    hit = np.zeros(len(now.observed), bool)
    hit[now.now] = True
    measures = {
        "observed_now": now.observed_now,
        "hit_now": hit,
        "hit_share_15min": now.hit_share(),
        "observed_15min_s": now.observed * STEP_S,
    }
    if now.quarter is not None:
        measures["occupancy_15min"] = now.quarter.occupancy()
        measures["visible_15min_s"] = now.quarter.visible * STEP_S
    return measures | {"time": iso_from_step(now.step)}


def _filtered(layer: gpd.GeoDataFrame, query: Mapping[str, str]) -> gpd.GeoDataFrame:
    """Return the features that match a request's properties, box and time."""
    columns = layer.columns.drop(layer.geometry.name)
    for key in sorted(query.keys() - {"bbox", "limit", "offset", "datetime", "f", "token"}):
        if key not in columns:
            raise HTTPException(400, f"{key[:40]} is no parameter of this layer")
        layer = layer[layer[key].map(_text) == query[key]]
    if "bbox" in query:
        layer = layer[layer.intersects(_box(query["bbox"]))]
    if "datetime" in query and "begin" in columns:
        layer = layer[_overlaps_time(layer, query["datetime"])]
    return layer


def _box(text: str) -> shapely.Polygon:
    """Return the polygon of `west,south,east,north`, or of six numbers with heights."""
    try:
        parts = [float(part) for part in text.split(",")]
    except ValueError:
        parts = []
    if len(parts) == 6:  # with heights
        parts = [*parts[:2], *parts[3:5]]
    if len(parts) != 4 or not np.isfinite(parts).all():
        raise HTTPException(400, "bbox: expected west,south,east,north in degrees")
    west, south, east, north = parts
    return shapely.box(west, south, east, north)


def _whole_number(query: Mapping[str, str], name: str, default: int, *, least: int) -> int:
    text = query.get(name, str(default))
    if not (text.isascii() and text.isdigit() and least <= int(text[:9])):
        raise HTTPException(400, f"{name}: expected a whole number from {least}")
    return int(text[:9])


def _overlaps_time(layer: gpd.GeoDataFrame, text: str) -> pd.Series:
    """Return which features overlap a time, or a span `begin/end` whose ends may be `..`."""
    begin, _, end = text.partition("/")
    end = end if "/" in text else begin
    try:
        low, high = (
            None if each in {"", ".."} else seconds_from_iso(each, what="datetime")
            for each in (begin, end)
        )
    except InputError as error:
        raise HTTPException(400, str(error)) from error
    first, last = (pd.to_datetime(layer[name], utc=True) for name in ("begin", "end"))
    found = pd.Series(data=True, index=layer.index)
    if low is not None:
        found &= last > pd.Timestamp(low, unit="s", tz="UTC")
    if high is not None:
        found &= first <= pd.Timestamp(high, unit="s", tz="UTC")
    return found


def _features(layer: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """Return features of GeoJSON, with the row's number as `id` and unknown values as null."""
    shapes = geometries(layer.geometry.to_numpy())
    table = layer.drop(columns=layer.geometry.name)
    rows = table.astype(object).where(table.notna(), None).to_dict("records")
    return [
        {
            "type": "Feature",
            "id": int(number),
            "geometry": shape,
            "properties": {key: _plain(value) for key, value in row.items()},
        }
        for number, shape, row in zip(layer.index, shapes, rows, strict=True)
    ]


def _plain(value: Any) -> Any:
    """Return a value as a type of JSON."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, datetime):
        return value.isoformat().replace("+00:00", "Z")
    return round(value, 4) if isinstance(value, float) else value


def _text(value: Any) -> str:
    """Return a value as in a URL's query: true, 0.25, a text without quotes."""
    plain = _plain(value)
    return plain if isinstance(plain, str) else json.dumps(plain)


def _root(request: Request) -> str:
    return str(request.base_url).rstrip("/") + "/ogc"


def _link(href: str, rel: str, kind: str, title: str) -> dict[str, str]:
    return {"href": href, "rel": rel, "type": kind, "title": title}


def _openapi(at: str, title: str) -> dict[str, Any]:
    """Return the OpenAPI document that clients need: paths, and the limits of pages."""

    def parameter(name: str, kind: str, **limits: int) -> dict[str, Any]:
        return {"name": name, "in": "query", "schema": {"type": kind, **limits}}

    path = {"in": "path", "required": True}
    named = path | {"name": "name", "schema": {"type": "string"}}
    numbered = path | {"name": "number", "schema": {"type": "integer"}}
    box = {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6}
    query = [
        parameter("limit", "integer", minimum=1, maximum=_MOST, default=_LIMIT),
        parameter("offset", "integer", minimum=0),
        parameter("datetime", "string"),
        {"name": "bbox", "in": "query", "style": "form", "explode": False, "schema": box},
    ]
    paths = {
        "/": [], "/conformance": [], "/collections": [], "/collections/{name}": [named],
        "/collections/{name}/items": [named, *query],
        "/collections/{name}/items/{number}": [named, numbered],
    }  # fmt: skip
    answers = {"200": {"description": "the answer"}, "400": {"description": "not understood"},
               "404": {"description": "not there"}}  # fmt: skip
    gets = {name: {"get": {"parameters": parameters, "responses": answers}}
            for name, parameters in paths.items()}  # fmt: skip
    return {
        "openapi": "3.0.3", "info": {"title": title, "version": "1"}, "servers": [{"url": at}],
        "paths": gets,
    }  # fmt: skip

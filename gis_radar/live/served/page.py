"""Serve the page of the live map: one page, its data, and a stream of what changes."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
from jinja2 import Environment, StrictUndefined
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import (
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gis_radar.base import LANGUAGES, InputError, class_label, in_language, step_begin, tr
from gis_radar.live.health import ALARMS, METRICS_TYPE
from gis_radar.live.served.features import feature_routes, refusal
from gis_radar.live.served.snapshot import (
    DEGREES,
    FusedMap,
    Place,
    ShownMap,
    ShownSensor,
    Snapshot,
    geometries,
    place_of,
)
from gis_radar.live.web_server import WebServer
from gis_radar.live.wire.settings import LiveSite, read_secret
from gis_radar.products import BREAKS, MAP_WORDS, NEVER_HIT, NOT_OBSERVED, colour_classes
from gis_radar.site import PageTable

_LOGGER = logging.getLogger(__name__)
_EVENTS_PER_S = 3.0  # as a person can follow; a step is 50 ms
_MOST_QUEUED = 8  # most events that a slow reader may lag behind; then the whole map is sent again
MOST_READERS = 200  # p99 of 50 readers at 4 Hz is 10 ms; a city's page needs a proxy
_COOKIE = "gis_radar"
_WEB = Path(__file__).parents[1] / "web"
_TEMPLATE = Environment(
    autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
).from_string((_WEB / "page.html").read_text(encoding="utf-8"))
# Parts of German words before which a phone may break them: browsers do not know all syllables.
_SYLLABLE_BREAKS = re.compile(r"(?<=\w)(?=grad|anteil|streifen|fahrten|stau|zyklen)")
# Colour of a tile that is hit now: no colour of the ramp is blue, nor one as light as this for the
# red-green blind, to whom the ramp's purple is a deep blue.
HIT_COLOUR = "#0090e0"
# Nor is green in the ramp; vehicles have a white rim, heavy ones are longer.
VEHICLE_COLOUR = "#12805c"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: "
    "blob:; connect-src 'self'; worker-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def make_app(live: ShownMap, token: str = "") -> Starlette:
    """Return the read-only application of the page and its services.

    Parameters
    ----------
    live : ShownMap
        The map that is shown.
    token : str
        Token that readers must show; empty for none.
    """
    changes = Changes(live)
    answers = _Responses(live)

    @asynccontextmanager
    async def running(_: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(changes.run())
        try:
            yield
        finally:
            task.cancel()

    middleware = [
        Middleware(_Guard, token=token),
        Middleware(GZipMiddleware, minimum_size=2_000),
    ]
    routes = [
        Route("/", answers.page),
        Route("/site.json", answers.site),
        Route("/state.json", answers.state),
        Route("/events", changes),
        Route("/metrics", answers.metrics),
        *feature_routes(live),
        Mount("/web", StaticFiles(directory=_WEB)),
    ]
    return Starlette(
        routes=routes,
        middleware=middleware,
        exception_handlers={HTTPException: _refused},
        lifespan=running,
    )


def _refused(request: Request, error: Exception) -> Response:
    """Return an HTTP error of a route, or of none."""
    if not isinstance(error, HTTPException):
        raise error
    return refusal(request, error.status_code, error.detail, error.headers)


class _Responses:
    """Responses of the page's addresses."""

    def __init__(self, live: ShownMap) -> None:
        self._live = live
        self._sites: dict[str, bytes] = {}  # cache of tiles and lanes as JSON, by language

    def page(self, request: Request) -> Response:
        followed = self._live.snapshot().vehicles is not None
        return HTMLResponse(_page(self._live.place, _language(request), followed=followed))

    def site(self, request: Request) -> Response:
        language = _language(request)
        if language not in self._sites:
            self._sites[language] = _site_json(self._live.place, language)
        return Response(self._sites[language], media_type="application/json")

    def state(self, _: Request) -> Response:
        return JSONResponse(whole_event(self._live.place, self._live.snapshot()))

    def metrics(self, _: Request) -> Response:
        return PlainTextResponse(self._live.metrics(), media_type=METRICS_TYPE)


class _Guard:
    """Guard that requires the token in header, cookie or address, and adds response headers."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(Request(scope)) if scope["type"] == "http" else None
        await (refusal or self._app)(scope, receive, send_with_headers)

    def _refusal(self, request: Request) -> Response | None:
        if request.method not in {"GET", "HEAD"}:
            return refusal(request, 405, "for reading only")
        if not self._token:
            return None
        given = request.query_params.get("token", "")
        if self._is_token(given) and request.url.path == "/":
            asked = request.url.remove_query_params("token").query
            answer = RedirectResponse(f"/?{asked}" if asked else "/", 303)
            answer.set_cookie(_COOKIE, given, httponly=True, samesite="strict")
            return answer
        bearer = request.headers.get("authorization", "").removeprefix("Bearer ")
        shown = (given, bearer, request.cookies.get(_COOKIE, ""))
        if any(self._is_token(each) for each in shown):
            return None
        return refusal(request, 401, "a token is needed", {"WWW-Authenticate": "Bearer"})

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())


class Changes:
    """Server-sent events with the map's changes; each is made once for all readers.

    Parameters
    ----------
    live : ShownMap
        The map that is shown.
    """

    def __init__(self, live: ShownMap) -> None:
        self._live = live
        self._shown: dict[str, Any] = {}  # the state that readers have, if there are any
        self._readers: set[asyncio.Queue[str | None]] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Respond with the whole map, then with its changes."""
        if len(self._readers) >= MOST_READERS:
            refusal = PlainTextResponse("too many readers\n", 503, {"Retry-After": "30"})
            await refusal(scope, receive, send)
            return
        if not self._readers:
            self._shown = whole_event(self._live.place, self._live.snapshot())
        queue: asyncio.Queue[str | None] = asyncio.Queue(_MOST_QUEUED)
        queue.put_nowait("retry: 2000\n\n" + _event("map", self._shown))
        self._readers.add(queue)
        try:
            answer = StreamingResponse(_texts(queue), media_type="text/event-stream")
            await answer(scope, receive, send)
        finally:
            self._readers.discard(queue)

    async def run(self) -> None:
        """Send changes of the map `_EVENTS_PER_S` times a second while there are readers."""
        while True:
            await asyncio.sleep(1.0 / _EVENTS_PER_S)
            if self._readers:
                try:
                    self._send(self._live.snapshot())
                except Exception:  # readers wait for the next event, and see the map's age
                    _LOGGER.exception("the page's map could not be made")

    def _send(self, snapshot: Snapshot) -> None:
        whole = whole_event(self._live.place, snapshot)
        text = _event("map", difference(self._shown, whole))
        self._shown = whole
        for queue in list(self._readers):
            try:
                queue.put_nowait(text)
            except asyncio.QueueFull:  # a slow reader's stream ends, and the reader reconnects
                self._readers.discard(queue)
                while not queue.empty():
                    queue.get_nowait()
                queue.put_nowait(None)


async def _texts(queue: asyncio.Queue[str | None]) -> AsyncIterator[str]:
    """Yield texts from a queue until there is None."""
    while (text := await queue.get()) is not None:
        yield text


def whole_event(place: Place, snapshot: Snapshot) -> dict[str, Any]:
    """Return the whole map for the page: hit tiles, classes by tile, lanes, sensors."""
    begin = step_begin(snapshot.step)
    share = snapshot.by_lane(place)
    return {
        "whole": True,
        "tiles": place.fingerprint,
        "step": snapshot.step,
        "clock": f"{begin.astimezone(place.zone):%H:%M:%S}",
        "hit": snapshot.now.tolist(),
        "unobserved": np.flatnonzero(~snapshot.observed_now).tolist(),
        "classes": dict(enumerate(snapshot.classes().tolist())),
        "lanes": {i: _permille(each) for i, each in enumerate(share.tolist())},
        "sensors": {each.name: _sensor(place, each) for each in snapshot.sensors},
        "vehicles": _vehicles(place, snapshot),
        "occupancy": dict(enumerate(snapshot.occupancy_classes().tolist())),
        "traffic": _traffic(snapshot),
    }


def difference(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the changes of the map since an earlier state."""
    changed: dict[str, Any] = {name: after[name] for name in ("step", "clock", "vehicles")}
    for name in ("hit", "unobserved"):
        old, new = set(before[name]), set(after[name])
        changed[name] = {"on": sorted(new - old), "off": sorted(old - new)}
    for name in ("classes", "lanes", "sensors", "occupancy", "traffic"):
        old = before[name]
        changed[name] = {k: v for k, v in after[name].items() if old.get(k, ...) != v}
    return changed


def _vehicles(place: Place, snapshot: Snapshot) -> list[list[float]] | None:
    """Return each vehicle's number, rear, front (deg), width (m), speed (m/s), heavy (0 or 1)."""
    now = snapshot.vehicles
    if now is None:
        return None
    heavy = now.heavy.astype(float)
    rest = np.column_stack([now.width_m, now.speed.round(1), heavy])
    rows = np.column_stack([now.vehicle, place.ends_in_degrees(now), rest])
    return [[int(each[0]), *each[1:]] for each in rows.tolist()]


def _traffic(snapshot: Snapshot) -> dict[int, list[float | None]]:
    """Return occupancy in permille, volume, vehicles counted, km/h and queue in m of each lane."""
    if snapshot.quarter is None:
        return {}
    table = snapshot.quarter.lanes
    whole = table[["volume", "counted", "speed_kmh", "queue_max_m"]].round().to_numpy(float)
    return {
        i: [_permille(share), *(None if np.isnan(each) else int(each) for each in row)]
        for i, (share, row) in enumerate(zip(table["occupancy"].tolist(), whole, strict=True))
    }


def _permille(share: float) -> int | None:
    """Return a share in permille, at least 1 for a share above 0."""
    return None if np.isnan(share) else max(round(1000 * share), int(share > 0.0))


def _sensor(place: Place, state: ShownSensor) -> dict[str, Any]:
    """Return the state of a sensor as the page shows it."""
    where, view = None, None
    if state.pose is not None:
        where = [round(each, DEGREES) for each in place.degrees_of(state.pose)]
        view = place.view_of(state.pose)
    lag = None if np.isnan(state.lag_s) else round(state.lag_s, 2)
    return {
        "online": state.online,
        "alarms": {kind: in_each_language(text) for kind, text in state.alarms.items()},
        "at": where, "view": view,
        "lag_s": lag, "frames_per_s": round(state.frames_per_s, 1), "lost": state.lost,
    }  # fmt: skip


@lru_cache(256)
def in_each_language(text: str) -> dict[str, str]:
    """Return the details of an alarm by language, as one stream serves all readers."""
    texts = {}
    for language in LANGUAGES:
        with in_language(language):
            texts[language] = tr(text)
    return texts


def _event(name: str, content: dict[str, Any]) -> str:
    return f"event: {name}\ndata: {_json(content)}\n\n"


def _language(request: Request) -> str:
    wanted = request.headers.get("accept-language", "").lower().split(",")
    asked = [request.query_params.get("lang", ""), *(each.strip()[:2] for each in wanted)]
    return next((each for each in asked if each in LANGUAGES), LANGUAGES[0])


def _page(place: Place, language: str, *, followed: bool) -> str:
    """Return the page as HTML in a language."""
    with in_language(language):
        words = {"online": tr("online"), "offline": tr("offline"), "late": tr("no connection"),
                 "hit": tr("{n} tiles are hit now"),
                 "vehicles": tr("{n} vehicles now, {heavy} of them heavy"), "no_map": tr(
                     "This browser cannot draw the map (it lacks WebGL); the tables below go on."),
                 "no_library": tr(
                     "The map is not drawn: its program, MapLibre, could not be loaded. "
                     "The tables below go on."),
                 "alarms": {kind: tr(text) for kind, text in ALARMS.items()}}  # fmt: skip
        colours = {"classes": [each.colour for each in colour_classes()],
                   "unobserved": NOT_OBSERVED, "free": NEVER_HIT,
                   "hit": HIT_COLOUR, "vehicle": VEHICLE_COLOUR,
                   "breaks": [round(1000 * each) for each in BREAKS[:-1]]}  # fmt: skip
        return _TEMPLATE.render(
            place=place, followed=followed, legends=_legends(language, followed=followed),
            language=language, tr=tr, words=words, colours=colours, languages=LANGUAGES,
            seamed=lambda text: _SYLLABLE_BREAKS.sub("\u00ad", text),
        )  # fmt: skip


def _legends(language: str, *, followed: bool) -> dict[str, dict[str, Any]]:
    """Return title, note and classes (colour, label) of each measure of the page."""
    hits = _colours_in_words("hit_share", language)
    legends = {
        "lately": {
            "title": tr("Share of the observed time"),
            "note": tr("in which a tile is hit, last 15 minutes"),
            "classes": hits,
        },
        "now": {
            "title": tr("Now"),
            "note": tr("which tiles are hit; zoomed out: lanes, last 15 minutes"),
            "classes": [(HIT_COLOUR, tr("hit now")), (NEVER_HIT, tr("not hit now")), hits[-1]],
        },
        "occupancy": {
            "title": tr("Occupancy"),
            "note": tr(
                "share of time with a vehicle while a tile was visible, last measured quarter "
                "of an hour"
            ),
            "classes": _colours_in_words("occupancy", language),
        },
    }
    return {name: each for name, each in legends.items() if followed or name != "occupancy"}


def _colours_in_words(measure: str, language: str) -> list[tuple[str, str]]:
    """Return colour and label of a measure's classes, highest first, missing values last."""
    classes = [(each.colour, class_label(each.label, language)) for each in colour_classes(measure)]
    return [*reversed(classes), (NOT_OBSERVED, tr(MAP_WORDS[measure].unknown))]


def _site_json(place: Place, language: str) -> bytes:
    """Return tiles and lanes, which do not change, as JSON in longitude and latitude."""
    lanes = place.lanes.set_index("lane").reindex(place.lane_numbers)
    tiles = place.in_degrees(place.tiles).geometry
    west, south, east, north = tiles.total_bounds.round(DEGREES).tolist()
    with in_language(language):
        named = [  # ids reach 9e18, exact numbers of a browser only 9e15
            {"number": str(number), "name": name}
            for number, name in zip(place.lane_numbers, place.lane_names(), strict=True)
        ]
    content = {
        "fingerprint": place.fingerprint,
        "bounds": [[west, south], [east, north]],
        "tiles": _collection(tiles.to_numpy()),
        "lanes": named,
        "lines": _collection(place.in_degrees(lanes).geometry.to_numpy()),
    }
    return _json(content).encode()


def _collection(shapes: Any) -> dict[str, Any]:
    features = [
        {"type": "Feature", "id": i, "properties": {}, "geometry": shape}
        for i, shape in enumerate(geometries(shapes))
    ]
    return {"type": "FeatureCollection", "features": features}


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, separators=(",", ":"), allow_nan=False)


def read_token(path: Path) -> str:
    """Read the token that readers of a page must show.

    Raises
    ------
    InputError
        If the file cannot be read, or holds none.
    """
    token = read_secret(path)
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            "{}: holds no token", path, hint="a token is one word of visible ASCII characters"
        )
    return token


def page_server(
    fusion: FusedMap, site: LiveSite, table: PageTable, tiles: gpd.GeoDataFrame
) -> WebServer:
    """Return the web server of a site's live page, which serves once it is opened.

    Parameters
    ----------
    fusion : FusedMap
        The map of now, sensors, vehicles.
    site : LiveSite
        The site's file.
    table : PageTable
        Address of the page and access to it.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.

    Raises
    ------
    InputError
        If the map cannot be read, or the file with the token cannot or is empty.
    OutputError
        If the address is taken.
    """
    token = "" if table.token_file is None else read_token(table.token_file)
    app = make_app(ShownMap(fusion, place_of(site, tiles)), token)
    return WebServer(app, table.address, table.names)

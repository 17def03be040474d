"""Push of lane measures to a server that speaks the OGC SensorThings API 1.1 (OGC 18-088).

A lane is a Thing with its line as Location and a Datastream a measure, by quarter of an hour: its
hit share and, with vehicles, its traffic. Nothing finer than a lane leaves the site.
"""

from __future__ import annotations

import base64
import http.client
import json
import math
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby, islice
from typing import Any, NamedTuple
from urllib.parse import quote, urljoin, urlsplit

from gis_radar.base import STEP_S, GisRadarError, iso_from_step, street_label
from gis_radar.live.served.snapshot import Place, geometries
from gis_radar.live.wire.settings import LOOPBACK, read_secret
from gis_radar.site import SensorThingsTable

_TIMEOUT_S = 30.0
_OBSERVATIONS_AT_ONCE = 500  # observations in a request
_COMPARED_INTERVALS = 100  # intervals of a lane that are requested from a server: one page of FROST
_MEASUREMENT = "http://www.opengis.net/def/observationType/OGC-OM/2.0/OM_Measurement"
_QUDT = "https://qudt.org/vocab/unit"


@dataclass(frozen=True, kw_only=True)
class Measure:
    """What a Datastream of a lane holds.

    Parameters
    ----------
    name, about : str
        Name and description of its ObservedProperty.
    unit : tuple of str
        Name and symbol of its unit, and the name in the _QUDT vocabulary.
    parameter : str
        Name of the parameter beside each result.
    scale : float
        By which the column of the same name is multiplied.
    """

    name: str
    about: str
    unit: tuple[str, str, str]
    parameter: str
    scale: float = 1.0


_PERCENT = ("percent", "%", "PERCENT")
MEASURES = {
    "hits": Measure(
        name="hit share", unit=_PERCENT, parameter="observed_s", scale=100.0,
        about="Share of the observed time in which a radar hit something on a tile of the lane, "
        "the mean of its tiles. It is below the share in which vehicles occupy them.",
    ),
    "occupancy": Measure(
        name="occupancy", unit=_PERCENT, parameter="visible_share", scale=100.0,
        about="Share of the visible time with a vehicle on a tile of the lane, the mean of its "
        "tiles.",
    ),
    "volume": Measure(
        name="volume", unit=("vehicles", "veh", "NUM"), parameter="volume_se",
        about="Vehicles that cross the stop line of the lane, else its middle, in the interval; "
        "estimated for all of it, with the standard error volume_se.",
    ),
    "speed_kmh": Measure(
        name="speed", unit=("kilometre per hour", "km/h", "KiloM-PER-HR"),
        parameter="visible_share", about="Space-mean speed of the vehicles on the lane.",
    ),
    "queue_max_m": Measure(
        name="maximum back of queue", unit=("metre", "m", "M"), parameter="visible_share",
        about="Farthest back of the queue from the stop line in the interval; where the map "
        "draws none before a junction, from the end of the lane.",
    ),
}  # fmt: skip
"""By the last word of the Datastream's name; all but `hits` are columns of traffic."""
_COMPONENTS = ["phenomenonTime", "resultTime", "result", "parameters"]
_NOT_STORED = "error"  # entry in place of the link of an observation that was not stored


class LaneMeasure(NamedTuple):
    """Measure of a lane over an interval.

    Parameters
    ----------
    lane : int
        Number of the lane.
    measure : str
        Key of :data:`MEASURES`.
    begin, end : int
        Begin and exclusive end of the interval, steps.
    result, parameter : float
        In its unit, and the parameter beside it.
    """

    lane: int
    measure: str
    begin: int
    end: int
    result: float
    parameter: float

    @property
    def stream(self) -> tuple[int, str]:
        """Lane and measure."""
        return self.lane, self.measure


class ServerError(GisRadarError):
    """Error of a server that cannot be reached, or refuses a request."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """Refusal of redirects: the log-in would go to any host, and a POST would become a GET."""

    def redirect_request(self, *_: Any) -> None:
        """Return nothing, so that the answer is an error."""


def opener_of(url: str) -> urllib.request.OpenerDirector:
    """Return an opener for an address that may hold a secret, or is sent one.

    It follows no redirect, and takes no proxy of the environment to this machine.
    """
    handlers: list[urllib.request.BaseHandler] = [_NoRedirect()]
    if url.startswith("https"):
        handlers.append(urllib.request.HTTPSHandler(context=ssl.create_default_context()))
    if urlsplit(url).hostname in LOOPBACK:
        handlers.append(urllib.request.ProxyHandler({}))
    return urllib.request.build_opener(*handlers)


@dataclass(frozen=True, kw_only=True)
class Service:
    """A SensorThings service.

    Parameters
    ----------
    root : str
        Its address with the version, without a slash at the end.
    headers : mapping
        Headers of each request.
    """

    root: str
    headers: Mapping[str, str]

    @classmethod
    def of(cls, table: SensorThingsTable) -> Service:
        """Return the service of the table in a site's file.

        Raises
        ------
        InputError
            If the file with the token or password cannot be read.
        """
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        if table.password_file is not None:
            both = f"{table.user or ''}:{read_secret(table.password_file)}"
            headers["Authorization"] = f"Basic {base64.b64encode(both.encode()).decode()}"
        elif table.token_file is not None:
            headers["Authorization"] = f"Bearer {read_secret(table.token_file)}"
        return cls(root=table.address.rstrip("/"), headers=headers)

    def get(self, path: str) -> Any:
        """Return the JSON at a path below the root."""
        return self._ask(path, None)

    def post(self, path: str, record: Any) -> Any:
        """Post JSON; return the JSON of the response, or None."""
        return self._ask(path, json.dumps(record).encode())

    def _ask(self, path: str, body: bytes | None) -> Any:
        """Return the JSON of a response: to a POST with a body, else to a GET."""
        request = urllib.request.Request(  # noqa: S310 - http and https alone, checked
            f"{self.root}/{path}", data=body, headers=dict(self.headers)
        )
        try:
            with opener_of(self.root).open(request, timeout=_TIMEOUT_S) as answer:
                text = answer.read()
        except urllib.error.HTTPError as error:
            error.close()
            raise self._refusal(path.partition("?")[0], error) from error
        except (OSError, ValueError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", error)
            raise ServerError("{}: cannot be reached: {}", self.root, reason) from error
        try:
            return json.loads(text) if text.strip() else None
        except (ValueError, RecursionError) as error:
            raise ServerError(
                "{}: answers no JSON to {}", self.root, path.partition("?")[0]
            ) from error

    def _refusal(self, path: str, error: urllib.error.HTTPError) -> ServerError:
        location = error.headers.get("Location") if 300 <= error.code < 400 else None
        if location is None:
            return ServerError("{}: answers {} to {}", self.root, error.code, path)
        place = urljoin(f"{self.root}/{path}", location).partition("?")[0].removesuffix(f"/{path}")
        return ServerError("{}: has moved; the address to use is {}", self.root, place)

    def unexpected(self, path: str) -> ServerError:
        """Return the error of a response that is against the standard."""
        return ServerError(
            "{}: its answer to {} is none of SensorThings", self.root, path.partition("?")[0]
        )

    def rows(self, path: str) -> tuple[list[dict[str, Any]], bool]:
        """Return the first page of entities at a path, and whether there are more."""
        found = self.get(path)
        rows = found.get("value") if isinstance(found, dict) else None
        if not isinstance(rows, list) or not all(isinstance(each, dict) for each in rows):
            raise self.unexpected(path)
        return rows, "@iot.nextLink" in found

    def find(self, entities: str, name: str) -> Any:
        """Return the id of the entity with a name; None where there is none."""
        asked = quote(f"name eq '{name.replace(chr(39), 2 * chr(39))}'")
        rows, _ = self.rows(f"{entities}?$filter={asked}&$top=1&$select=@iot.id")
        if not rows:
            return None
        if not isinstance(found := rows[0].get("@iot.id"), int | str):
            # taken as missing, the entity would be made at each push
            raise self.unexpected(entities)
        return found


class LaneServer:
    """Lanes of a site on a server; missing entities are made.

    Parameters
    ----------
    service : Service
        The server.
    place : Place
        Lanes and title of the site.
    site : str
        The site's name in topics, the prefix of all names.
    """

    def __init__(self, service: Service, place: Place, site: str) -> None:
        self._service, self._place, self._site = service, place, site
        self._streams: dict[tuple[int, str], Any] = {}
        lanes = place.lanes.set_index("lane")
        shapes = geometries(place.in_degrees(place.lanes).geometry.to_numpy())
        self._shapes = dict(zip(lanes.index.tolist(), shapes, strict=True))
        self._names = dict(zip(place.lane_numbers, place.lane_names(), strict=True))
        streets = map(street_label, lanes["street"], lanes["street_part"])
        self._streets = dict(zip(lanes.index.tolist(), streets, strict=True))

    def push(self, measures: Sequence[LaneMeasure], *, again: bool = False) -> int:
        """Push measures; return the number that the server did not store.

        Parameters
        ----------
        measures : sequence of LaneMeasure
            In order of lane, measure and time.
        again : bool
            Whether some may have arrived before, so that the server's are compared first.

        Raises
        ------
        ServerError
            If the server cannot be reached or refuses; none or some of them arrived.
        """
        refused = 0
        rows = self._not_stored(measures) if again else iter(measures)
        while part := list(islice(rows, _OBSERVATIONS_AT_ONCE)):
            refused += self._create(part)
        return refused

    def _not_stored(self, measures: Sequence[LaneMeasure]) -> Iterator[LaneMeasure]:
        """Yield the measures whose interval the server does not have in their Datastream."""
        for stream, group in groupby(measures, lambda each: each.stream):
            begins, since = self._stored_begins(*stream)
            yield from (each for each in group if each.begin >= since and each.begin not in begins)

    def _stored_begins(self, lane: int, measure: str) -> tuple[set[int], float]:
        """Return begins (steps) of the intervals on the server, and since when all count."""
        path = f"Datastreams({_key(self._stream(lane, measure))})/Observations"
        asked = f"$orderby=phenomenonTime%20desc&$top={_COMPARED_INTERVALS}&$select=phenomenonTime"
        rows, more = self._service.rows(f"{path}?{asked}")
        texts = (str(each.get("phenomenonTime", "")).partition("/")[0] for each in rows)
        begins = {step for text in texts if (step := _step_of(text)) is not None}
        is_complete = not begins or not (more or len(rows) >= _COMPARED_INTERVALS)
        return begins, -math.inf if is_complete else min(begins)

    def _create(self, measures: Sequence[LaneMeasure]) -> int:
        """Post measures in one request; return how many the server did not store."""
        arrays = []
        for stream, group in groupby(measures, lambda each: each.stream):
            values = [_values(each) for each in group]
            arrays.append({
                "Datastream": {"@iot.id": self._stream(*stream)}, "components": _COMPONENTS,
                "dataArray@iot.count": len(values), "dataArray": values,
            })  # fmt: skip
        links = self._service.post("CreateObservations", arrays)
        if not isinstance(links, list | None):
            raise self._service.unexpected("CreateObservations")
        return sum(str(link).startswith(_NOT_STORED) for link in links or [])

    def _stream(self, lane: int, measure: str) -> Any:
        """Return the id of a lane's Datastream."""
        if (lane, measure) not in self._streams:
            name = f"{self._thing_name(lane)}/{measure}"
            found = self._entity("Datastreams", name, lambda: self._datastream(lane, measure, name))
            self._streams[lane, measure] = found
        return self._streams[lane, measure]

    def _thing_name(self, lane: int) -> str:
        return f"{self._site}/lane/{lane}"

    def _datastream(self, lane: int, measure: str, name: str) -> dict[str, Any]:
        """Return the Datastream of a lane's measure, with the ids of the entities that it names."""
        about = MEASURES[measure]
        unit, symbol, word = about.unit
        observed = {  # a city's server may have a "speed" of its own
            "name": f"gis_radar {about.name}", "description": about.about,
            "definition": f"urn:gis_radar:{about.name.replace(' ', '_')}",
        }  # fmt: skip
        radars = {
            "name": f"{self._site}/radars", "description": f"Radars of {self._place.title}",
            "encodingType": "text/html", "metadata": "Roadside radars; lanes, by gis_radar.",
        }  # fmt: skip
        ids = {
            "Thing": self._entity("Things", self._thing_name(lane), lambda: self._thing(lane)),
            "Sensor": self._entity("Sensors", radars["name"], lambda: radars),
            "ObservedProperty": self._entity(
                "ObservedProperties", observed["name"], lambda: observed
            ),
        }
        return {
            "name": name, "description": f"{about.name.capitalize()} of lane {lane}",
            "observationType": _MEASUREMENT,
            "unitOfMeasurement": {"name": unit, "symbol": symbol, "definition": f"{_QUDT}/{word}"},
            **{entity: {"@iot.id": found} for entity, found in ids.items()},
        }  # fmt: skip

    def _thing(self, lane: int) -> dict[str, Any]:
        """Return the Thing of a lane, with its line as Location."""
        about, name = f"{self._names[lane]}, {self._place.title}", self._thing_name(lane)
        location = {"name": name, "description": about, "encodingType": "application/geo+json",
                    "location": self._shapes[lane]}  # fmt: skip
        return {
            "name": name, "description": about,
            "properties": {
                "site": self._site, "lane": str(lane), "street": self._streets.get(lane) or None,
            },
            "Locations": [location],
        }  # fmt: skip

    def _entity(self, entities: str, name: str, record: Callable[[], dict[str, Any]]) -> Any:
        """Return the id of the entity with a name, which is made if it is missing."""
        found = self._service.find(entities, name)
        if found is None:
            self._service.post(entities, record())
            found = self._service.find(entities, name)
        if found is None:
            raise ServerError("{}: does not keep what is made there", self._service.root)
        return found


def _values(each: LaneMeasure) -> list[Any]:
    begin, end = iso_from_step(each.begin), iso_from_step(each.end)
    beside = {MEASURES[each.measure].parameter: each.parameter}
    return [f"{begin}/{end}", end, each.result, beside]


def _key(found: Any) -> str:
    """Return an id as in the path of a URL."""
    if isinstance(found, int):
        return str(found)
    text = str(found).replace("'", "''")
    return quote(f"'{text}'")


def _step_of(text: str) -> int | None:
    """Return the step at a time stated by a server; None where it states none."""
    try:
        return round(datetime.fromisoformat(text).timestamp() / STEP_S)
    except (ValueError, OverflowError):
        return None

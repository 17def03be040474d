"""The table of a site's live system, and that of the broker, which its sensors have too."""

from __future__ import annotations

from ipaddress import ip_address
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, PlainValidator, model_validator

from gis_radar.base import Text, duration_s, interval_steps
from gis_radar.site.values import (
    File,
    Meaning,
    Place,
    Switch,
    Texts,
    TextValue,
    TomlTable,
    Unfit,
    key,
    parsed,
    within,
)

_NOT_IN_TOPICS = frozenset("+#/$")


def _duration(value: Any) -> float:
    if not isinstance(value, str):
        raise Unfit
    return parsed(duration_s, value)


def _interval(text: str) -> str:
    parsed(interval_steps, text)
    return text


def _topic_word(text: str) -> str:
    if _NOT_IN_TOPICS & {*text} or not text.isascii() or " " in text:
        raise Unfit(Text("a word without + # / $ and blanks, as it stands in topics"))
    return text


def _host_and_port(text: str) -> str:
    """Return a text of the form HOST:PORT; refuse any other."""
    try:
        parts = urlsplit(f"//{text}")
        fits = bool(parts.hostname) and parts.port is not None and parts.netloc == text
        fits = fits and parts.username is None and text.rpartition(":")[2].isdigit()
    except ValueError:
        fits = False
    if not fits:
        raise Unfit
    return text


def _service_address(text: str) -> str:
    parts = urlsplit(text)
    if parts.scheme not in {"http", "https"} or not parts.hostname or parts.query or parts.username:
        raise Unfit
    return text


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Duration = Annotated[float, Meaning(Text('a duration such as "200ms"')), PlainValidator(_duration)]
TopicWord = Annotated[TextValue, Meaning(Text("a word")), AfterValidator(_topic_word)]
Interval = Annotated[
    TextValue, Meaning(Text('a length such as "15min"')), AfterValidator(_interval)
]
ServiceAddress = Annotated[
    TextValue, Meaning(Text("an http or https address without user and query")),
    AfterValidator(_service_address),
]  # fmt: skip
HostPort = Annotated[
    TextValue, Meaning(Text('HOST:PORT such as "127.0.0.1:9464"')), AfterValidator(_host_and_port)
]


class BrokerTable(TomlTable):
    """The broker that sensors and fusion speak through."""

    address: TextValue = key('"mqtts://broker.example:8883"')
    """Where it is: `mqtt://` or, encrypted, `mqtts://`."""
    user: TextValue | None = key('"R1"', None, "the sensor's name, or fusion")
    """As whom to log in."""
    password_file: Place | None = key('"R1.password"', None, "no log-in")
    """A file with nothing but the password."""
    authority: File | None = key('"ca.crt"', None, "those of the system")
    """Certificate of the authority that signed the broker's."""


class PageTable(TomlTable):
    """The page of the live map and its services, all for reading only."""

    address: HostPort = key('"127.0.0.1:8080"')
    """Where it is served. Other machines reach only what is no loopback address."""
    token_file: File | None = key('"page.token"', None, "none")
    """A file with nothing but a token that readers must show: once as `/?token=...`."""
    behind_proxy: Switch = key("true", default=False)
    """Whether a reverse proxy in front asks for a login."""
    names: Texts = key('["traffic.example"]', (), "all, with an address that is no loopback")
    """Names by which browsers may ask for it."""

    @model_validator(mode="after")
    def _asks_who_reads(self) -> Self:
        """Refuse a page that other machines reach without token or login."""
        host = urlsplit(f"//{self.address}").hostname or ""
        if not (_is_loopback(host) or self.token_file or self.behind_proxy):
            raise Unfit(
                message=Text("the page would be open to everyone who reaches {}", host),
                hint=Text("set token_file, or behind_proxy where a reverse proxy asks for a login"),
            )
        return self


class SensorThingsTable(TomlTable):
    """The push of lane measures to a server that speaks SensorThings 1.1."""

    address: ServiceAddress = key('"https://frost.example/FROST-Server/v1.1"')
    """The service's root, with its version."""
    user: TextValue | None = key('"junction"', None, "none")
    """As whom to log in, with a password."""
    password_file: File | None = key('"sensorthings.password"', None, "none")
    """A file with nothing but the password."""
    token_file: File | None = key('"sensorthings.token"', None, "none")
    """A file with nothing but a token, instead of user and password."""

    @model_validator(mode="after")
    def _hides_its_log_in(self) -> Self:
        """Refuse to send a password or token over http to another machine."""
        parts = urlsplit(self.address)
        log_in = self.password_file is not None or self.token_file is not None
        if log_in and parts.scheme == "http" and not _is_loopback(parts.hostname or ""):
            raise Unfit(
                message=Text("a password or token would go over http for all to read"),
                hint=Text("name an https:// address"),
            )
        return self


class LiveTable(TomlTable):
    """The live system: `gis-radar live`."""

    site: TopicWord = key('"junction"')
    """The site's name in the topics: `v1/SITE/SENSOR/detections`."""
    tiles: File = key('"tiles.gpkg"')
    """The tiles, from `gis-radar tiles`: the same file that the sensors have."""
    folder: TextValue = key('"live"', "live", '"live"')
    """Where its files go: dataset, recordings, what is on its way there."""
    lateness: Duration = key('"200ms"', 0.2, '"200ms"')
    """How long a 50 ms window stays open after its end for frames on their way."""
    interval: Interval = key('"15min"', "15min", '"15min"')
    """Over which the cumulative map counts, from each full hour on."""
    every: Duration = key('"10s"', 10.0, '"10s"')
    """How often the files for QGIS are replaced."""
    vehicles: Switch = key("false", default=True)
    """Whether vehicles are followed; without, the dataset holds hits."""
    oldest: Duration = key('"72h"', 259_200.0, '"72h"')
    """How old a frame may be that comes after an outage; older ones are left out."""
    keep: Duration = key('"168h"', 604_800.0, '"168h"')
    """How long recordings are kept."""
    gigabytes: Annotated[float, Meaning(Text("gigabytes, over 0")), within(1e-3, 1e6)] = key(100.0)
    """How much room recordings may take; then the oldest are removed sooner."""
    broker: BrokerTable
    """The broker."""
    page: PageTable | None = None
    """The page of the live map."""
    sensorthings: SensorThingsTable | None = None
    """The push of lane measures."""

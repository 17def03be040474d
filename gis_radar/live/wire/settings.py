"""Files of the live system: SENSOR.toml of a sensor, and [live] of SITE.toml."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self
from urllib.parse import urlsplit

from pydantic import Field, model_validator

from gis_radar.base import InputError, Text, UsageError
from gis_radar.live.wire.broker import FUSION, BrokerAddress
from gis_radar.measures import Filters
from gis_radar.site import (
    BrokerTable,
    Duration,
    File,
    LiveTable,
    MapTable,
    Meaning,
    Recordings,
    Sensor,
    Site,
    Switch,
    TextValue,
    TomlFile,
    TomlTable,
    TopicWord,
    Unfit,
    ViewTable,
    key,
    read_toml,
    toml_template,
    within,
)

LOOPBACK = ("localhost", "127.0.0.1", "::1")


class SourceTable(TomlTable):
    """Where the frames come from."""

    address: TextValue | None = key('"udp://224.0.2.2:42102"', None, "none")
    """The radar's, or a capture (pcap)."""
    sensor: TextValue | None = key('"10.13.1.113"', None, "the only one")
    """Which sensor, where the network has several."""
    recording: File | None = key('"R1.parquet"', None, "none")
    """A recording that is replayed instead."""
    speed: Annotated[float, Meaning("0 or more"), within(0.0)] = key(1.0)
    """Of the replay: 1 as recorded, 0 as fast as can be."""
    loop: Duration | None = key('"100s"', None, "once")
    """It comes again each so often, at the times of now; replays of one period keep step."""

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        if (self.address is None) == (self.recording is None):
            both = "both address and recording are" if self.address else "neither is"
            raise Unfit(message=Text("{} given", both), hint="give one of address and recording")
        return self


class BufferTable(TomlTable):
    """The disk buffer: frames wait in it until fusion has stored them."""

    file: TextValue | None = key('"R1.buffer"', None, "SENSOR.buffer, beside this file")
    """Where it is."""
    megabytes: Annotated[float, Meaning("megabytes, 1 or more"), within(1.0, 1e7)] = key(800.0)
    """How large it may become: 800 hold a day of a radar at 20 Hz."""


class EdgeFile(TomlFile):
    """A sensor's file, as it states it; made by :func:`read_edge_file`."""

    sensor: TopicWord = key('"R1"')
    """Its name, as in SITE.toml."""
    site: TopicWord = key('"junction"')
    """The site's name in the topics, as in SITE.toml."""
    tiles: File = key('"tiles.gpkg"')
    """The tiles, the same file that fusion has."""
    pose: File = key('"R1.json"')
    """Its pose, from `gis-radar localize`."""
    follow: Switch = key("false", True, "true, where map and road are given")
    """Whether the pose is followed every 5 s."""
    road: File | None = key('"road.laz"', None, "none")
    """The scanned road, from `gis-radar mask`, to follow the pose by."""
    frames_a_message: Annotated[int, Meaning("1 to 100"), Field(strict=True, ge=1, le=100)] = key(
        "5", 1, "1"
    )
    """Frames that wait for each other: fewer messages, and a later map."""
    source: SourceTable
    """Where the frames come from."""
    broker: BrokerTable
    """The broker."""
    map: MapTable | None = None
    """The lanes, to follow the pose by."""
    view: ViewTable | None = None
    """What it sees, where its pose does not state it."""
    buffer: BufferTable = BufferTable()
    """The disk buffer."""

    @property
    def buffer_path(self) -> Path:
        """Where its buffer is."""
        return self._path.parent / (self.buffer.file or f"{self.sensor}.buffer")

    def address(self) -> BrokerAddress:
        """Return the address of the broker with this sensor's log-in."""
        return broker_address(self.broker, user=self.sensor)


class LiveSensor(Sensor):
    """A radar of a live site: its recordings and its pose come over the network."""

    recordings: Recordings = key('["R1_*.parquet"]', (), "none")
    """What it recorded; not needed here."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        return self


class LiveSite(Site):
    """The tables of a site's file that `gis-radar live` uses; made by :func:`read_live_site`."""

    live: LiveTable
    """The live system."""
    sensor: Annotated[tuple[LiveSensor, ...], Field(min_length=1)]
    """The radars, a table each."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names = [each.name for each in self.sensor]
        for place, name in enumerate(names):
            at = ("sensor", place, "name")
            if name in names[:place]:
                raise Unfit(message=Text("two sensors are called {}", repr(name)), at=at)
            if name == FUSION:
                raise Unfit(
                    message=Text("{} is no sensor: fusion itself logs in as it", repr(name)), at=at
                )
        return self

    @property
    def folder(self) -> Path:
        """Where the files of the live system go."""
        return self._path.parent / self.live.folder

    def address(self) -> BrokerAddress:
        """Return the address of the broker with fusion's log-in."""
        return broker_address(self.live.broker, user=FUSION)

    def filters(self) -> Filters:
        """Return which detections count."""
        table = self.measure
        return Filters(
            min_speed=table.min_speed, min_rcs=table.min_rcs, clearance=table.clearance,
            elevation_error_deg=table.elevation_error,
        )  # fmt: skip

    def cycles(self) -> dict[str, float]:
        """Return the time from frame to frame of sensors that state it, seconds."""
        return {each.name: each.cycle for each in self.sensor if each.cycle is not None}


def broker_address(table: BrokerTable, *, user: str) -> BrokerAddress:
    """Return the address of a broker with the log-in; `user` is the name where none is stated.

    Raises
    ------
    UsageError
        If the address is none.
    InputError
        If the file with the password cannot be read.
    """
    password = ""
    if table.password_file is not None:
        password = read_secret(
            table.password_file, hint="the files written for the broker hold one for each"
        )
    name = (table.user or user) if password else ""
    return BrokerAddress.of(table.address, user=name, password=password, authority=table.authority)


def webhook_address(url: str) -> str:
    """Return the address of a webhook.

    Raises
    ------
    UsageError
        If it is neither https nor http on this machine; its text may be a secret, and is not shown.
    """
    try:
        parts = urlsplit(url)
        safe = parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in LOOPBACK)
        fits = bool(safe and parts.hostname and parts.port != 0 and "@" not in parts.netloc)
    except ValueError:
        fits = False
    if not (fits and url.isascii() and url.isprintable() and " " not in url):
        raise UsageError(
            "the address of the webhook is none",
            hint="such as https://alerts.example/hook, or http:// to this machine, without a user",
        )
    return url


def read_secret(path: Path, *, hint: str = "") -> str:
    """Read a file with nothing but a password or token.

    Parameters
    ----------
    path : Path
        The file.
    hint : str
        What to do if there is none.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8").strip()
    except FileNotFoundError as error:
        raise InputError("{}: no such file", path, hint=hint) from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("{}: cannot be read: {}", path, error) from error


_HINT = Text("begin with: gis-radar edge --template > SENSOR.toml")
_SITE_HINT = Text("begin with: gis-radar run --template > SITE.toml, and fill in [live]")
_HEAD = """\
# A sensor of gis_radar's live system. Lines without # must be filled in.
# Paths are relative to the folder of this file. Positions are metres of the map frame.
# Then: gis-radar edge SENSOR.toml
"""


def read_edge_file(path: str | Path) -> EdgeFile:
    """Read a sensor's file.

    Raises
    ------
    InputError
        If it does not fit; the message names the line, the key and what was expected.
    """
    return read_toml(Path(path), EdgeFile, of_site=False, hint=_HINT)


def read_live_site(path: str | Path) -> LiveSite:
    """Read a site's file for the live system.

    Raises
    ------
    InputError
        If it does not fit; the message names the line, the key and what was expected.
    """
    return read_toml(Path(path), LiveSite, of_site=True, hint=_SITE_HINT)


def edge_template() -> str:
    """Return a commented file of a sensor to fill in."""
    return toml_template(EdgeFile, _HEAD, given=[("source", "address")])

"""The draft of a site, and its text as a site file; needs no QGIS.

gis_radar itself checks the site file, in the worker: nothing is checked here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .site_file import Table, heading_in, kept, toml

VIEW_KEYS = ("azimuth_deg", "elevation_deg", "min_range_m", "max_range_m")
VEHICLES_M = (-0.5, 4.5)  # heights over the road of what drives, without tree crowns over the kerb


@dataclass
class SensorDraft:
    """A radar in the draft.

    Parameters
    ----------
    name : str
        Of the radar and its folders.
    recordings : list of str
        What it recorded.
    easting, northing : float
        Where it stands within 15 m, in the map's system; NaN before it is placed.
    heading : float or None
        Yaw in degrees from grid east, anticlockwise; None where it is searched.
    pose : str
        A file with its pose, in place of the guess.
    view : dict
        What it sees, as entered; empty where it is taken from the recordings.
    measured : dict
        What its recordings show, as the check found.
    cycle : str
        Time from frame to frame, of a radar under 10 Hz: `150ms`.
    """

    name: str
    recordings: list[str] = field(default_factory=list)
    easting: float = math.nan
    northing: float = math.nan
    heading: float | None = None
    pose: str = ""
    view: dict[str, float] = field(default_factory=dict)
    measured: dict[str, float] = field(default_factory=dict)
    cycle: str = ""
    read: Table = field(default_factory=dict)  # its table in a site file that was opened
    before: Table = field(default_factory=dict)  # what this draft said when it was opened

    @property
    def is_placed(self) -> bool:
        """Whether its position is known."""
        return bool(self.pose) or not math.isnan(self.easting + self.northing)

    @property
    def seen(self) -> dict[str, float]:
        """Its view: as entered, else as measured."""
        known = self.view or self.measured
        return {key: known[key] for key in VIEW_KEYS if key in known}


@dataclass
class SiteDraft:
    """The draft of a site; the fields are keys of the site file."""

    title: str = ""
    timezone: str = ""
    language: str = "en"
    map_file: str = ""
    crs: str = ""
    origin: str = ""
    map_source: str = ""
    scans: list[str] = field(default_factory=list)
    scan_crs: str = ""
    scan_source: str = ""
    attribution: str = ""
    vehicles_only: bool = True
    follow: bool = True
    footprints: bool = False
    intervals: list[str] = field(default_factory=list)
    clocks: str = ""
    sensors: list[SensorDraft] = field(default_factory=list)

    read: Table = field(default_factory=dict)  # of a site file that was opened
    before: Table = field(default_factory=dict)  # what this draft said when it was opened
    opened: str = ""  # its text
    folder: str = ""  # where it lies, and where its other keys name files from

    def text(self, folder: Path) -> str:
        """Return the text of the site file; paths below its folder are relative to it."""
        now = self.tables(folder)
        if self.read and now == self.before and self._same_sensors(folder):
            return self.opened
        tables = kept(self.read, self.before, now)
        return toml({
            **tables, "sensor": [_kept_sensor(each, folder) for each in self.sensors],
        })  # fmt: skip

    def tables(self, folder: Path) -> Table:
        """Return the values of the draft without its sensors: single values, then tables."""
        tables: dict[str, Table] = {
            "map": {
                "file": _path(self.map_file, folder), "crs": self.crs,
                "origin": [float(part) for part in self.origin.split(",") if part.strip()],
                "source": self.map_source,
            },
            "scan": {
                "files": [_path(each, folder) for each in self.scans], "crs": self.scan_crs,
                "source": self.scan_source,
            },
            "measure": {
                "clearance": list(VEHICLES_M) if self.vehicles_only and self.scans else [],
                "clocks": _path(self.clocks, folder) if self.clocks else "",
            },
            "vehicles": {
                "follow": self.follow, "footprints": (self.footprints and self.follow) or "",
            },
            "heatmap": {"intervals": self.intervals},
        }  # fmt: skip
        return _filled({
            "title": self.title, "timezone": self.timezone, "language": self.language,
            "csv_locale": self.language if self.language == "de" else "",
            "attribution": [self.attribution] if self.attribution else [],
            **{name: _filled(table) for name, table in tables.items()},
        })  # fmt: skip

    def _same_sensors(self, folder: Path) -> bool:
        same = [each.read for each in self.sensors] == self.read.get("sensor", [])
        return same and all(_sensor(each, folder) == each.before for each in self.sensors)


def _kept_sensor(sensor: SensorDraft, folder: Path) -> Table:
    """Return a sensor's table; a bearing that was read goes where the draft says otherwise."""
    now = _sensor(sensor, folder)
    table = kept(sensor.read, sensor.before, now)
    guess, height = table.get("guess", []), sensor.read.get("guess", [])[2:]
    if len(guess) == 2 and height:
        table["guess"] = [*guess, *height]
    if "pose" in now or now.get("heading") != sensor.before.get("heading"):
        table.pop("compass", None)
    return table


def _sensor(sensor: SensorDraft, folder: Path) -> Table:
    placed = not sensor.pose and sensor.is_placed
    seen = sensor.view if sensor.pose and _states_view(Path(sensor.pose)) else sensor.seen
    table = _filled({
        "name": sensor.name,
        "recordings": [_path(each, folder) for each in sensor.recordings],
        "pose": _path(sensor.pose, folder) if sensor.pose else "",
        "guess": [round(sensor.easting, 2), round(sensor.northing, 2)] if placed else [],
        "cycle": sensor.cycle,
    })  # fmt: skip
    if placed and sensor.heading is not None:
        table["heading"] = round(sensor.heading, 1)
    if seen:
        table["view"] = {key: float(value) for key, value in seen.items()}
    return table


def open_draft(read: Table, text: str, folder: Path) -> SiteDraft:
    """Return the draft of a site file that was read.

    Raises
    ------
    TypeError, ValueError, IndexError
        If it is none: map and sensors are not what they should be.
    """

    def table(name: str) -> Table:
        found = read.get(name, {})
        if not isinstance(found, dict):
            raise TypeError(name)
        return found

    found, scan, counted = table("map"), table("scan"), table("measure")
    follow, heat = table("vehicles"), table("heatmap")
    clocks = str(counted.get("clocks", ""))
    draft = SiteDraft(
        title=str(read.get("title", "")), timezone=str(read.get("timezone", "UTC")),
        language=str(read.get("language", "en")),
        map_file=_whole(found.get("file", ""), folder), crs=str(found.get("crs", "")),
        origin=", ".join(map(str, _list(found.get("origin")))),
        map_source=str(found.get("source", "")),
        scans=[_whole(each, folder) for each in _list(scan.get("files"))],
        scan_crs=str(scan.get("crs", "")), scan_source=str(scan.get("source", "")),
        attribution="; ".join(map(str, _list(read.get("attribution")))),
        vehicles_only=_list(counted.get("clearance")) == list(VEHICLES_M),
        clocks=_whole(clocks, folder) if clocks.endswith(".json") else "",
        follow=bool(follow.get("follow", True)), footprints=bool(follow.get("footprints", False)),
        intervals=list(map(str, _list(heat.get("intervals")))),
        sensors=[_open_sensor(each, folder) for each in _list(read.get("sensor"))],
        read=read, opened=text, folder=str(folder),
    )  # fmt: skip
    draft.before = draft.tables(folder)
    return draft


def _open_sensor(read: Table, folder: Path) -> SensorDraft:
    if not isinstance(read, dict):
        raise TypeError("sensor")
    guess, view = _list(read.get("guess")), read.get("view", {})
    sensor = SensorDraft(
        name=str(read.get("name", "")),
        recordings=[_whole(each, folder) for each in _list(read.get("recordings"))],
        easting=float(guess[0]) if guess else math.nan,
        northing=float(guess[1]) if guess[1:] else math.nan,
        heading=heading_in(read),
        pose=_whole(read.get("pose", ""), folder),
        view={key: float(view[key]) for key in VIEW_KEYS if key in view},
        cycle=str(read.get("cycle", "")),
        read=read,
    )
    sensor.before = _sensor(sensor, folder)
    return sensor


def _list(value: object) -> list[Any]:
    return list(value) if isinstance(value, list) else [] if value is None else [value]


def _whole(path: object, folder: Path) -> str:
    """Return the absolute path of a file that a site file names."""
    return str(folder / str(path)) if path else ""


def _states_view(pose: Path) -> bool:
    """Return whether a pose file has a view, which then takes precedence over a measured one."""
    try:
        text = pose.read_text(encoding="utf-8", errors="replace")
    except OSError:  # the check says so
        return False
    return any(key in text for key in VIEW_KEYS)


def _filled(values: Mapping[str, Any]) -> Table:
    """Return a table without what is empty."""
    return {key: value for key, value in values.items() if value not in ("", [], {})}


def _path(path: str, folder: Path) -> str:
    """Return a file as a site file in a folder names it, with forward slashes."""
    whole = str(Path(path).absolute())
    try:
        inside = os.path.relpath(whole, folder.absolute())
    except ValueError:  # on another drive
        inside = os.pardir
    return Path(whole if inside.startswith(os.pardir) else inside).as_posix()


def next_name(sensors: list[SensorDraft]) -> str:
    """Return a name that no sensor has: R1, R2, ..."""
    taken = {each.name.casefold() for each in sensors}
    number = 1
    while f"r{number}" in taken:
        number += 1
    return f"R{number}"


def keep_earlier(path: Path, text: str) -> Path | None:
    """Move a site file with other contents out of the way; return its new place."""
    if not path.is_file() or path.read_bytes() == text.encode():
        return None
    number = 1
    while (kept := path.with_name(f"{path.stem}_{number}{path.suffix}")).exists():
        number += 1
    path.rename(kept)
    return kept

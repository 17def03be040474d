"""A site as it is filled in, and its text as a site file; needs no QGIS.

What a site file may hold is checked by gis_radar itself, in the worker: nothing is checked here.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

VIEW_KEYS = ("azimuth_deg", "elevation_deg", "min_range_m", "max_range_m")
VEHICLES_M = (-0.5, 4.5)  # heights over the road of what drives, without tree crowns over the kerb


@dataclass
class SensorDraft:
    """A radar as it is filled in.

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
        From frame to frame, of a slow one: `150ms`.
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

    @property
    def is_placed(self) -> bool:
        """Whether it is known where it stands."""
        return bool(self.pose) or not math.isnan(self.easting + self.northing)

    @property
    def seen(self) -> dict[str, float]:
        """Its view: as entered, else as measured."""
        known = self.view or self.measured
        return {key: known[key] for key in VIEW_KEYS if key in known}


@dataclass
class SiteDraft:
    """A site as it is filled in; the fields are keys of the site file."""

    title: str = ""
    time_zone: str = ""
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

    def text(self, folder: Path) -> str:
        """Return the site file; what lies in its folder is named from there."""
        return "\n".join(self._lines(folder)).strip() + "\n"

    def _lines(self, folder: Path) -> Iterator[str]:
        yield from _keys({
            "title": self.title, "time_zone": self.time_zone, "language": self.language,
            "csv_locale": self.language if self.language == "de" else "",
            "attribution": [self.attribution] if self.attribution else [],
        })  # fmt: skip
        yield from ("", "[map]")
        yield from _keys({
            "file": _path(self.map_file, folder), "crs": self.crs,
            "origin": [float(part) for part in self.origin.split(",") if part.strip()],
            "source": self.map_source,
        })  # fmt: skip
        if self.scans:
            yield from ("", "[scan]")
            yield from _keys({
                "files": [_path(each, folder) for each in self.scans], "crs": self.scan_crs,
                "source": self.scan_source,
            })  # fmt: skip
        yield from ("", "[occupancy]")
        yield from _keys({
            "clearance": list(VEHICLES_M) if self.vehicles_only and self.scans else [],
            "clocks": _path(self.clocks, folder) if self.clocks else "",
        })  # fmt: skip
        yield from ("", "[vehicles]", *_keys({"follow": self.follow}))
        yield from _keys({"footprints": self.footprints and self.follow})
        yield from ("", "[heatmap]", *_keys({"intervals": self.intervals}))
        for sensor in self.sensors:
            yield from ("", "[[sensor]]", *_sensor(sensor, folder))


def _sensor(sensor: SensorDraft, folder: Path) -> Iterator[str]:
    placed = not sensor.pose and sensor.is_placed
    yield from _keys({
        "name": sensor.name,
        "recordings": [_path(each, folder) for each in sensor.recordings],
        "pose": _path(sensor.pose, folder) if sensor.pose else "",
        "guess": [round(sensor.easting, 2), round(sensor.northing, 2)] if placed else [],
        "cycle": sensor.cycle,
    })  # fmt: skip
    if placed and sensor.heading is not None:
        yield f"heading = {round(sensor.heading, 1)}"
    seen = sensor.view if sensor.pose and _states_view(Path(sensor.pose)) else sensor.seen
    if seen:
        inside = ", ".join(f"{key} = {float(value)}" for key, value in seen.items())
        yield f"view = {{ {inside} }}"


def _states_view(pose: Path) -> bool:
    """Return whether a file of a pose has a view: it counts then, and a measured one does not."""
    try:
        text = pose.read_text(encoding="utf-8", errors="replace")
    except OSError:  # the check says so
        return False
    return any(key in text for key in VIEW_KEYS)


def _keys(values: Mapping[str, object]) -> Iterator[str]:
    """Yield keys with their values as TOML, without those that are empty."""
    for key, value in values.items():
        if value not in ("", []):
            yield f"{key} = {json.dumps(value, ensure_ascii=False)}"  # TOML's own form, too


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
    """Move a site file that says something else out of the way; return where it is now."""
    if not path.is_file() or path.read_bytes() == text.encode():
        return None
    number = 1
    while (kept := path.with_name(f"{path.stem}_{number}{path.suffix}")).exists():
        number += 1
    path.rename(kept)
    return kept

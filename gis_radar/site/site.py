"""The site file: maps, scans, sensors and settings of one site, in TOML."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.errors import InputError
from gis_radar.site.kinds import (
    CRS_NAME,
    FILE,
    FILES,
    INTERVALS,
    POINT,
    SPAN,
    TEXT,
    TEXTS,
    ZONE,
    Unfit,
    choice,
    number,
)
from gis_radar.site.place import Place, lines_of
from gis_radar.site.schema import key, optional_table, read_table, table, tables
from gis_radar.site.sensor import Sensor


@dataclass(frozen=True, kw_only=True)
class MapPart:
    """The lanes of the site."""

    file: Path = key(FILE, "Lanelet2 map.", example='"junction.osm"')
    crs: str | None = key(
        CRS_NAME, "Map frame of the site, in which all results lie.",
        example='"EPSG:25832"', default=None, shown="the site's UTM zone",
    )  # fmt: skip
    origin: tuple[float, float] | None = key(
        POINT, "Map-frame position of the map's local (0, 0), if lat and lon are empty or false.",
        example="[690400.0, 5336200.0]", default=None, shown="none",
    )  # fmt: skip
    subtypes: tuple[str, ...] | None = key(
        TEXTS, "Lanelets to tile, by subtype.", example='["road", "highway"]',
        default=None, shown="those for vehicles",
    )  # fmt: skip
    source: str | None = key(
        TEXT, "Where the map is from, and its licence.",
        example='"City of Example, CC BY 4.0"', default=None, shown="none",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ScanPart:
    """The road as seen from the air: airborne scans, or a road masked before."""

    files: tuple[Path, ...] = key(
        FILES, "LAS, LAZ or COPC files; those that do not touch the site are skipped.",
        example='["scan_*.laz"]', default=(), shown="none",
    )  # fmt: skip
    road: Path | None = key(
        FILE, "A road from `gis-radar mask`, instead of `files`.",
        example='"road.laz"', default=None, shown="none",
    )  # fmt: skip
    crs: str | None = key(
        CRS_NAME, "CRS of scans that do not say theirs.",
        example='"EPSG:25832"', default=None, shown="as the scans say",
    )  # fmt: skip
    engine: str = key(
        choice("auto", "pdal", "laspy"), "Who reads the scans; auto takes PDAL where there is one.",
        example='"auto"', default="auto",
    )  # fmt: skip
    source: str | None = key(
        TEXT, "Where the scans are from, and their licence.",
        example='"State survey, dl-de/by-2-0"', default=None, shown="none",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if bool(self.files) == (self.road is not None):
            both = "both files and road are" if self.files else "neither files nor road is"
            raise Unfit(f"{both} given", hint="give the scans' files, or a road masked before")


@dataclass(frozen=True, kw_only=True)
class TilesPart:
    """The unit of all statistics."""

    length: float = key(
        number("metres, 0.05 to 100", 0.05, 100.0), "Length of a tile along its lanelet, m.",
        example="0.5", default=0.5,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class OccupancyPart:
    """Which detections count, without a filter all; and whose times are corrected."""

    clearance: tuple[float, float] | None = key(
        SPAN, "Heights over the road that count, m.",
        example="[-0.5, 4.5]", default=None, shown="all",
    )  # fmt: skip
    min_speed: float | None = key(
        number("m/s, 0 or more", 0.0), "Least absolute range rate, m/s; a queue stands still.",
        example="0.5", default=None, shown="all",
    )  # fmt: skip
    min_rcs: float | None = key(
        number("dBm2"), "Least radar cross section, dBm2.",
        example="-10.0", default=None, shown="all",
    )  # fmt: skip
    elevation_error: float = key(
        number("degrees, 0 to 45", 0.0, 44.999),
        "Elevation error of the radars, deg (1 sigma): widens the clearance with range.",
        example="0.5", default=0.5,
    )  # fmt: skip
    clocks: Path | None = key(
        FILE, "How far sensors' clocks are ahead, from `gis-radar clocks`: times are corrected.",
        example='"clocks.json"', default=None, shown="none",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class HeatmapPart:
    """The heat maps."""

    intervals: tuple[str, ...] = key(
        INTERVALS, "A heat map for each: the first in `heatmap/`, others in `heatmap_1h/`, ...",
        example='["15min", "1h"]', default=(), shown="the whole time only",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Site:
    """A site, as its file says it; made by :func:`read_site`."""

    title: str = key(TEXT, "What the site is called.", example='"Example junction"')
    time_zone: str = key(
        ZONE, "Zone of the times in the summary; files keep UTC.",
        example='"Europe/Berlin"', default="UTC",
    )  # fmt: skip
    attribution: tuple[str, ...] = key(
        TEXTS, "Whom to name beside the results.",
        example='["Recordings: City of Example"]', default=(), shown="nobody",
    )  # fmt: skip
    map: MapPart = table(MapPart, "The lanes.", required=True)
    scan: ScanPart | None = optional_table(
        ScanPart, "The road from the air; needed where a pose is to be found."
    )
    tiles: TilesPart = table(TilesPart, "The unit of all statistics.")
    occupancy: OccupancyPart = table(OccupancyPart, "Which detections count.")
    heatmap: HeatmapPart = table(HeatmapPart, "The heat maps.")
    sensor: tuple[Sensor, ...] = tables(Sensor, "The radars, a table each.")
    path: Path = Path("SITE.toml")

    def __post_init__(self) -> None:
        names: dict[str, str] = {}
        for place, name in enumerate(each.name for each in self.sensor):
            if (twin := names.get(name.casefold())) is not None:
                same = f"{name!r}" if name == twin else f"{twin!r} and {name!r}"
                raise Unfit(
                    f"two sensors are called {same}",
                    hint="folders carry their names",
                    at=("sensor", place, "name"),
                )
            names[name.casefold()] = name
        lost = [each.name for each in self.sensor if each.guess is not None]
        if lost and self.scan is None:
            raise Unfit(
                f"the pose of {', '.join(lost)} is to be found, which needs a scan",
                hint="add a table [scan] with files, or give poses",
            )

    def __repr__(self) -> str:
        names = ", ".join(each.name for each in self.sensor)
        return f"Site({self.title or self.path}: {names})"

    @property
    def inputs(self) -> tuple[Path, ...]:
        """All files that a run reads."""
        scan = self.scan
        scanned = (*scan.files, *([scan.road] if scan.road else [])) if scan else ()
        of_sensors = [
            path
            for each in self.sensor
            for path in (*each.recordings, *([each.pose] if each.pose else []))
        ]
        clocks = [self.occupancy.clocks] if self.occupancy.clocks else []
        return (self.map.file, *scanned, *clocks, *of_sensors)


def read_site(path: str | Path) -> Site:
    """Read a site file, and check all that can be checked without opening the data.

    Parameters
    ----------
    path : str or Path
        A TOML file, described in `docs/site-file.md`; the paths in it are relative to its folder.

    Returns
    -------
    Site

    Raises
    ------
    InputError
        If it is no TOML, a key is unknown or missing, a value does not fit, or a file that it names
        does not exist. The message names the line, the key and what was expected.

    Examples
    --------
    >>> import gis_radar as gr
    >>> site = gr.read_site(gr.sample_folder() / "SITE.toml")
    >>> site.title, [sensor.name for sensor in site.sensor]
    ('Sample junction', ['R1', 'R2'])
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise InputError(f"{path}: cannot be read: {reason}", hint=_HINT) from error
    try:
        raw: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not TOML: {error}", hint=_HINT) from error
    place = Place(path=path, lines=lines_of(text))
    site = read_table(Site, raw, place)
    object.__setattr__(site, "path", path)
    return site


_HINT = "begin with: gis-radar run --template > SITE.toml"

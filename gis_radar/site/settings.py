"""The site file: maps, scans, sensors and settings of one site, in TOML.

Each key is declared once, as a field of a Pydantic model: its type checks the value, and its
docstring is the text of template and reference.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from gis_radar import recordings
from gis_radar.base import Text
from gis_radar.site.live_table import LiveTable
from gis_radar.site.toml_file import TomlFile, read_toml, toml_template
from gis_radar.site.values import (  # fmt: skip
    CompassBearing,
    Crs,
    Cycle,
    File,
    Files,
    Intervals,
    Meaning,
    Name,
    Pairs,
    Point,
    Position,
    Recordings,
    Span,
    Switch,
    Texts,
    TextValue,
    TomlTable,
    Unfit,
    Zone,
    key,
    within,
)

SpeedKmh = Annotated[float, Meaning("km/h, 1 to 300"), within(1.0, 300.0)]

_HINT = Text(
    "begin with: gis-radar run --template > SITE.toml, for a city --city-template > CITY.toml"
)


class MapTable(TomlTable):
    """The lanes of the site."""

    file: File = key('"junction.osm"')
    """Lanelet2 map."""
    crs: Crs | None = key('"EPSG:25832"', None, "the site's UTM zone")
    """Map frame of the site, in which all results lie."""
    origin: Point | None = key("[690400.0, 5336200.0]", None, "none")
    """Map-frame position of the map's local (0, 0), if lat and lon are empty or false."""
    subtypes: Texts | None = key('["road", "highway"]', None, "those for vehicles")
    """Lanelets to tile, by subtype."""
    streets: File | None = key('"streets.gpkg"', None, "none")
    """Lines of streets with names, for lanes that the map names none of."""
    street_field: TextValue | None = key('"strassenname"', None, "the first usual one")
    """Their column of names."""
    source: TextValue | None = key('"City of Example, CC BY 4.0"', None, "none")
    """Where the map is from, and its licence."""
    speed_kmh: SpeedKmh | None = key("50", None, "none")
    """Free speed of lanes of which the map states none, km/h: delays count against it."""


class LaneTable(TomlTable):
    """A lane's own name and free speed, in place of those that follow from the map."""

    id: Annotated[int, Meaning("a whole number")] = key("553")
    """Its number, as in the column `lane` of traffic.csv."""
    name: TextValue | None = key('"Ringstraße to the centre, left"', None, "by the map")
    """What people call it."""
    speed_kmh: SpeedKmh | None = key("50", None, "by the map")
    """Its speed without other traffic, against which delays count, km/h."""


class ScanTable(TomlTable):
    """The road as seen from the air: airborne scans, or a road masked before."""

    files: Files = key('["scan_*.laz"]', (), "none")
    """LAS, LAZ or COPC files; those that do not touch the site are skipped."""
    road: File | None = key('"road.laz"', None, "none")
    """A road from `gis-radar mask`, instead of `files`."""
    crs: Crs | None = key('"EPSG:25832"', None, "as the scans state")
    """CRS of scans that do not state theirs."""
    engine: Literal["auto", "pdal", "laspy"] = key('"auto"', "auto")
    """Who reads the scans; auto takes PDAL where there is one."""
    source: TextValue | None = key('"State survey, dl-de/by-2-0"', None, "none")
    """Where the scans are from, and their licence."""

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        """Refuse a table with both `files` and `road`, or with neither."""
        if bool(self.files) == (self.road is not None):
            both = "both files and road are" if self.files else "neither files nor road is"
            raise Unfit(
                message=Text("{} given", both),
                hint=Text("give the scans' files, or a road masked before"),
            )
        return self


class TilesTable(TomlTable):
    """The unit of all statistics."""

    length: Annotated[float, Meaning(Text("metres, 0.05 to 100")), within(0.05, 100.0)] = key(0.5)
    """Length of a tile along its lanelet, m."""


class MeasureTable(TomlTable):
    """Which detections count, without a filter all; and whose times are corrected."""

    clearance: Span | None = key("[-0.5, 4.5]", None, "all")
    """Heights over the road that count, m."""
    min_speed: Annotated[float, Meaning(Text("m/s, 0 or more")), within(0.0)] | None = key(
        "0.5", None, "all"
    )
    """Least absolute range rate, m/s; a queue stands still."""
    min_rcs: Annotated[float, Meaning("dBm2"), within()] | None = key("-10.0", None, "all")
    """Least radar cross section, dBm2."""
    elevation_error: Annotated[float, Meaning(Text("degrees, 0 to 45")), within(0.0, 44.999)] = key(
        0.5
    )
    """Elevation error of the radars, deg (1 sigma): widens the clearance with range."""
    clocks: File | None = key('"clocks.json"', None, "none")
    """How far sensors' clocks are ahead, from `gis-radar clocks`: times are corrected."""


class VehiclesTable(TomlTable):
    """The vehicles, whose occupancy the heat maps show."""

    follow: Switch = key("false", True, "true")
    """Whether vehicles are followed; without, the heat maps show hits."""
    footprints: Switch = key("true", False, "false")
    """Whether the QGIS project plays single vehicles, of a file that is not to be published."""


class HeatmapTable(TomlTable):
    """The heat maps."""

    intervals: Intervals = key('["15min", "1h"]', (), "the whole time only")
    """A heat map for each: the first in `heatmap/`, others in `heatmap_1h/`, ..."""


class ViewTable(TomlTable):
    """What a sensor sees: full opening angles about its x axis, and a range."""

    azimuth_deg: Annotated[float, Meaning(Text("degrees, 0 to 360")), within(1e-3, 360.0)] = key(
        120.0
    )
    """Full azimuth."""
    elevation_deg: Annotated[float, Meaning(Text("degrees, 0 to 180")), within(1e-3, 180.0)] = key(
        30.0
    )
    """Full elevation."""
    min_range_m: Annotated[float, Meaning(Text("metres, 0 or more")), within(0.0, 1e5)] = key(1.0)
    """Least slant range."""
    max_range_m: Annotated[float, Meaning(Text("metres, over 0")), within(1e-3, 1e5)] = key(300.0)
    """Greatest slant range."""

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        """Refuse a least range that is not below the greatest."""
        if not self.min_range_m < self.max_range_m:
            raise Unfit(
                message=Text(
                    "min_range_m is {:g} and max_range_m {:g}, expected ascending",
                    self.min_range_m,
                    self.max_range_m,
                )
            )
        return self


class ConvertTable(TomlTable):
    """How recordings in other formats are read: as `gis-radar convert` takes it."""

    sensor: TextValue | None = key('"10.13.1.113"', None, "the only one")
    """Which sensor, where the files have several."""
    columns: Pairs | None = key('{ x = "X", range_rate = "-doppler" }', None, "known by name")
    """Our columns and the fields of a table or cloud; a minus turns the sign."""
    time_unit: Literal["s", "ms", "us", "ns"] = key('"ms"', "s")
    """Of the times in a table, since 1970."""
    clock: Literal["auto", "sensor", "recorder"] = key('"auto"', "auto")
    """Whose times count; auto takes the sensor's where they are right."""


class Sensor(TomlTable):
    """A radar: what it recorded, and its pose or a rough guess of it."""

    name: Name = key('"R1"')
    """Its name, also that of its folders."""
    recordings: Recordings = key('["R1_*.parquet"]')
    """What it recorded, in one piece or many; other formats are converted."""
    guess: Position | None = key("[690356.0, 5336183.0]", None, "none")
    """Where it stands, within 15 m, in the map frame: its pose is found."""
    heading: Annotated[float, Meaning("degrees"), within()] | None = key("20.0", None, "searched")
    """Yaw within 25 deg: from grid east, anticlockwise."""
    compass: CompassBearing | None = key('"north-east"', None, "searched")
    """The same as a bearing, clockwise from true north."""
    method: Literal["lane", "icp"] = key('"lane"', "lane")
    """How the pose is found: lanes and Doppler, or the paper's ICP."""
    tied: Switch = key("false", True, "true")
    """Whether vehicles that other sensors see, too, tie its pose to theirs."""
    pose: File | None = key('"R2.json"', None, "none")
    """Its pose (JSON) or pose track (CSV), instead of a guess."""
    accept: Switch = key("true", False, "false")
    """Whether it counts although its pose and recordings do not fit each other or the map."""
    cycle: Cycle | None = key('"150ms"', None, "a frame is valid for 100 ms")
    """Of a sensor under 10 Hz, the time from frame to frame: a frame is valid for 1.5 of it."""
    view: ViewTable | None = None
    """What it sees, where its pose does not state it; without it 120 by 30 deg, 1 to 300 m."""
    convert: ConvertTable | None = None
    """How recordings are converted; with it, those that need no conversion are, too."""

    @cached_property
    def foreign(self) -> tuple[Path, ...]:
        """The recordings that must be converted."""
        is_recording = recordings.is_recording
        return tuple(each for each in self.recordings if self.convert or not is_recording(each))

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.guess is None and self.pose is None:
            raise Unfit(
                message=Text("has neither guess nor pose"),
                hint=Text("guess = [E, N] within 15 m, in the map frame, or pose = a pose file"),
            )
        for one, other, hint in (
            ("guess", "pose", "a pose needs no guess: keep one of them"),
            ("heading", "compass", "keep one of them"),
            ("pose", "heading", "a heading helps a guess only"),
            ("pose", "compass", "a heading helps a guess only"),
        ):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise Unfit(message=Text("has both {} and {}", one, other), hint=hint)
        return self


class Site(TomlFile):
    """A site, as its file states it; made by :func:`read_site`."""

    title: TextValue = key('"Example junction"')
    """What the site is called."""
    timezone: Zone = key('"Europe/Berlin"', "UTC")
    """Zone of the times in pictures, report and summary, for all sensors; data files keep UTC."""
    language: Literal["en", "de"] = key('"de"', "en")
    """Language of report, pictures and QGIS project: en or de."""
    csv_locale: Literal["en", "de"] = key('"de"', "en")
    """Numbers in the report's tables: de as Excel in Germany opens them, 0,5 and semicolons."""
    attribution: Texts = key('["Recordings: City of Example"]', (), "nobody")
    """Whom to name beside the results."""
    map: MapTable
    """The lanes."""
    lane: tuple[LaneTable, ...] = ()
    """Names and free speeds of single lanes, a table each."""
    scan: ScanTable | None = None
    """The road from the air; needed where a pose is to be found."""
    tiles: TilesTable = TilesTable()
    """The unit of all statistics."""
    measure: MeasureTable = MeasureTable()
    """Which detections count."""
    vehicles: VehiclesTable = VehiclesTable()
    """The vehicles, whose occupancy the heat maps show."""
    heatmap: HeatmapTable = HeatmapTable()
    """The heat maps."""
    live: LiveTable | None = None
    """The live system, for `gis-radar live`; a run leaves it alone."""
    sensor: Annotated[tuple[Sensor, ...], Field(min_length=1)]
    """The radars, a table each."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names: dict[str, str] = {}
        for place, name in enumerate(each.name for each in self.sensor):
            if (same_name := names.get(name.casefold())) is not None:
                same = (
                    f"{name!r}"
                    if name == same_name
                    else Text("{} and {}", repr(same_name), repr(name))
                )
                raise Unfit(
                    message=Text("two sensors are called {}", same),
                    hint=Text("folders carry their names"),
                    at=("sensor", place, "name"),
                )
            names[name.casefold()] = name
        self._require_own_recordings()
        numbers = [each.id for each in self.lane]
        for place, number in enumerate(numbers):
            if number in numbers[:place]:
                raise Unfit(
                    message=Text("lane {} has two tables", number), at=("lane", place, "id")
                )
        unplaced = [each.name for each in self.sensor if each.guess is not None]
        if unplaced and self.scan is None:
            raise Unfit(
                message=Text(
                    "the pose of {} is to be found, which needs a scan", ", ".join(unplaced)
                ),
                hint="add a table [scan] with files, or give poses",
            )
        return self

    def _require_own_recordings(self) -> None:
        """Refuse a file that two sensors name, unless it is converted: it may hold several."""
        owner: dict[Path, str] = {}
        for place, sensor in enumerate(self.sensor):
            for path in (each for each in sensor.recordings if each not in sensor.foreign):
                if (other := owner.setdefault(path, sensor.name)) != sensor.name:
                    raise Unfit(
                        message=Text("{} is a recording of {}, too", path.name, other),
                        hint=Text("each sensor has recordings of its own"),
                        at=("sensor", place, "recordings"),
                    )

    def __repr__(self) -> str:
        names = ", ".join(each.name for each in self.sensor)
        return f"Site({self.title or self.path}: {names})"

    __str__ = __repr__

    @property
    def credits(self) -> list[str]:
        """The sources of map and scan and whom to name, each once."""
        named = (self.map.source, self.scan.source if self.scan else None, *self.attribution)
        return list(dict.fromkeys(str(each) for each in named if each))

    @property
    def labels(self) -> dict[str, Any]:
        """Labels of its heat maps, as :class:`gis_radar.MapLabels` takes them."""
        return {"title": self.title, "timezone": self.timezone, "language": self.language,
                "sources": self.credits}  # fmt: skip

    @property
    def of_lanes(self) -> dict[str, Any]:
        """Names and free speeds of lanes, as :meth:`gis_radar.Dataset.with_lanes` takes them."""
        return {"lanes": [each.model_dump() for each in self.lane], "speed_kmh": self.map.speed_kmh}

    @property
    def inputs(self) -> tuple[Path, ...]:
        """All files that a run reads."""
        scanned = (*self.scan.files, self.scan.road) if self.scan else ()
        of_sensors = [path for each in self.sensor for path in (*each.recordings, each.pose)]
        named = (self.map.file, *scanned, self.measure.clocks, *of_sensors)
        return tuple(path for path in named if path is not None)


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
    ('Sample junction (simulated)', ['R1', 'R2'])
    """
    return read_toml(Path(path), Site, of_site=True, hint=_HINT)


# The template of a site file and the reference of its keys, from the fields of the models.

_HEAD = """\
# A site of gis_radar. Lines without # must be filled in; the others show what else there is.
# Paths are relative to the folder of this file. Positions are metres of the map frame.
# Then: gis-radar run SITE.toml -o results
"""
_NOT_COMMENTED = {("scan", "files"), ("sensor", "guess")}  # one of several keys that will do


def site_template() -> str:
    """Return a commented site file to fill in."""
    return toml_template(Site, _HEAD, given=_NOT_COMMENTED)

"""What a folder of results holds, and how and from what it was made."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gis_radar.crs import name_of, same_plane
from gis_radar.errors import InputError
from gis_radar.occupancy import Occupancy, merge_occupancies, read_occupancy
from gis_radar.poses.files import read_track
from gis_radar.poses.pose import Pose, pose_from_dict
from gis_radar.report.content import Column, Table
from gis_radar.report.lanes import PACKAGE, Traffic, read_traffic
from gis_radar.report.words import THIN, count, listed, number

MANIFEST = "manifest.json"
RUN = "run.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The results that a report tells of.

    Parameters
    ----------
    folder : Path
        Where they are.
    traffic : Traffic
        The heat map.
    occupancy : Occupancy or None
        What it was made of; None where it is not there.
    poses : sequence of Pose
        The last pose of each sensor that the heat map shows, by name, where it is in the map's
        coordinate system.
    figures : mapping
        Picture of how a sensor's pose was found, by its name.
    run : mapping
        What `gis-radar run` noted; empty where the steps were made one by one.
    missing : sequence of str
        What is not there, in sentences.
    """

    folder: Path
    traffic: Traffic
    occupancy: Occupancy | None
    poses: Sequence[Pose]
    figures: Mapping[str, Path]
    run: Mapping[str, Any]
    missing: Sequence[str]

    @property
    def sensors(self) -> list[str]:
        """The sensors that the heat map shows, as far as known."""
        known = self.occupancy.sensors if self.occupancy else [each.sensor for each in self.poses]
        return list(known)

    @property
    def site(self) -> Mapping[str, Any]:
        """The site file's content, empty where there was none."""
        return dict(self.run.get("site") or {})

    @property
    def stages(self) -> list[dict[str, Any]]:
        """How the stages of the run ended."""
        return list(self.run.get("stages") or [])


def read_results(folder: Path, occupancies: Sequence[Path] = ()) -> Results:
    """Look for the results of `gis-radar run`, or of the steps one by one.

    Parameters
    ----------
    folder : Path
        Holds `heatmap.gpkg`, or a folder with it: `heatmap/`, or the only one that has one.
    occupancies : sequence of Path
        Folders of occupancies that lie elsewhere; without them `occupancy/` or all in it.

    Raises
    ------
    InputError
        If there is no heat map, or several, or something is damaged.
    """
    run = _run(folder)
    traffic = read_traffic(_heat_map(folder))
    given = list(occupancies) or _occupancies(folder)
    parts = [read_occupancy(each) for each in given]
    missing = []
    fitting = [part for part in parts if part.fingerprint == traffic.fingerprint]
    if len(fitting) < len(parts):
        if occupancies:
            other = next(
                place
                for place, part in zip(given, parts, strict=True)
                if part.fingerprint != traffic.fingerprint
            )
            raise InputError(
                f"{traffic.folder}: was not made with the tiles of the occupancy {other}",
                hint="name the folders that the heat map was made of",
            )
        missing.append("An occupancy in the folder belongs to other tiles and is left out.")
    occupancy = merge_occupancies(fitting) if fitting else None
    figures = {
        path.parent.name: path for path in sorted((folder / "sensors").glob("*/localization.png"))
    }
    if occupancy is None:
        missing.append(
            "The occupancy that the heat map was made of is not in the folder: what the sensors "
            "delivered, their poses and the filters cannot be told (option --occupancy)."
        )
    if not run:
        missing.append("The folder is not that of a run: settings are told only as far as known.")
    poses = _poses(folder, occupancy)
    missing += [
        f"The pose of sensor {pose.sensor} is in {name_of(pose.crs)[:24]}, the map in "
        f"{name_of(traffic.crs)[:24]}: it is left out."
        for pose in poses
        if not same_plane(pose.crs, traffic.crs)
    ]
    return Results(
        folder=folder,
        traffic=traffic,
        occupancy=occupancy,
        poses=[pose for pose in poses if same_plane(pose.crs, traffic.crs)],
        figures=figures,
        run=run,
        missing=missing,
    )


def _heat_map(folder: Path) -> Path:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", hint="name the folder of gis-radar run")
    for place in (folder, folder / "heatmap"):
        if (place / PACKAGE).is_file():
            return place
    found = sorted(path.parent for path in folder.glob(f"*/{PACKAGE}"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: holds several heat maps: {names}", hint="name one of them")
    if not found:
        raise InputError(
            f"{folder}: holds no heat map", hint="make one with: gis-radar run, gis-radar heatmap"
        )
    return found[0]


def _occupancies(folder: Path) -> list[Path]:
    whole = folder / "occupancy"
    places = [whole] if (whole / MANIFEST).is_file() else sorted(whole.glob("*/"))
    return [place for place in places if (place / MANIFEST).is_file()]


def _poses(folder: Path, occupancy: Occupancy | None) -> list[Pose]:
    """Return the pose that each sensor had last, as the occupancy tells, or the files beside."""
    found: dict[str, Pose] = {}
    if occupancy is not None:
        for source in occupancy.sources:
            for record in source.get("poses", []):
                pose = pose_from_dict(record, what=f"pose of {source['sensor']}")
                before = found.get(pose.sensor)
                if before is None or _since(before) <= _since(pose):
                    found[pose.sensor] = pose
    elif (folder / "sensors").is_dir():
        for path in sorted((folder / "sensors").glob("*/pose.json")):
            found[path.parent.name] = read_track(path).poses[-1]
    return [found[name] for name in sorted(found)]


def _since(pose: Pose) -> str:
    return str(pose.evidence.get("time") or "")


def _run(folder: Path) -> dict[str, Any]:
    path = folder / RUN
    if not path.is_file():
        return {}
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged: {error}", hint="run the site again") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: damaged: it is no table of settings", hint="run the site again")
    return document


COLUMNS = (
    Column(title="What", is_number=False, width=1.0),
    Column(title="Setting", is_number=False, width=2.6),
)
NOT_KNOWN = "not known here"

DEFINITIONS = (
    (
        "Tile",
        (
            "A slice of a lane, half a metre long unless set otherwise and as wide as the lane. "
            "All figures are counted by tile."
        ),
    ),
    (
        "Lane",
        (
            "A chain of lanelets of the map, each the only successor of the last and following "
            "nothing else. It ends where ways part or join. Numbers follow the map, so they stay "
            "the same from report to report of one map."
        ),
    ),
    ("Step", "A window of 50 milliseconds of absolute time, the same for every sensor."),
    (
        "Occupied",
        (
            "A tile is occupied in a step when at least one radar detection that counts falls in "
            "it. More detections, or a second sensor, change nothing."
        ),
    ),
    (
        "Observed",
        (
            "A tile is observed in a step when a sensor whose view holds it delivered a "
            "measurement. What houses or other vehicles hide still counts as observed."
        ),
    ),
    (
        "Occupancy",
        (
            "Occupied steps divided by observed steps: the share of the observed time in which "
            "radar hit the tile. For a lane it is the sum over its tiles. Tiles that were never "
            "observed have no occupancy; they are hatched, and are not the same as 0 %."
        ),
    ),
    (
        "What occupancy is not",
        (
            "It is not the share of time in which a vehicle stands on the tile: a radar hits a "
            "vehicle in few places at once, so the true share is several times higher. It is no "
            "count of vehicles, no speed and no length of a queue. Compare one place over time, "
            "or places that the sensors see equally well."
        ),
    ),
    (
        "Busiest spot",
        (
            "The tile of a lane with the highest occupancy, and how far from the lane's begin it "
            "lies."
        ),
    ),
    (
        "Over 20 %",
        (
            "The length of those tiles of a lane whose occupancy is 20 % or more: where radar "
            "hits are frequent, as they are where vehicles stand."
        ),
    ),
    (
        "Busiest interval",
        (
            "The interval with the highest occupancy of a lane, among those in which at least "
            "half as much of it was observed as in the best observed one."
        ),
    ),
    (
        "±, sigma",
        (
            "One standard deviation: the true value lies within it in about two cases of three, "
            "and within twice as much in about 95 of 100."
        ),
    ),
    (
        "Second look",
        (
            "A check of a found position against an airborne laser scan: it confirms, doubts, or "
            "has nothing to compare."
        ),
    ),
    (
        "Verdict",
        (
            "Each hour of a sensor is tested for missing, doubled and frozen measurements, for "
            "tiles that are always or never hit, for hits without motion, and for impossible "
            "speeds. Good means that no test found fault."
        ),
    ),
)


def settings_of(results: Results, interval_s: float) -> Table:
    """Return the settings in effect, as far as the folder tells them."""
    rows = [
        ["Coordinates", f"{results.traffic.crs.name}, {name_of(results.traffic.crs)[:24]}"],
        ["Intervals", _interval(results, interval_s)],
        ["Tiles", _tiles(results)],
        *([name, text] for name, text in _filters(results)),
        ["Fingerprint of the tiles", results.traffic.fingerprint or NOT_KNOWN],
        ["Software", _software(results)],
    ]
    return Table(caption="Settings", columns=COLUMNS, rows=rows)


def sources_of(results: Results) -> Table:
    """Return the data that the heat map was made of."""
    columns = (COLUMNS[0], Column(title="Data", is_number=False, width=2.6))
    rows = [
        [name, text]
        for name, part in (("Map", results.site.get("map")), ("Scan", results.site.get("scan")))
        if part and (text := _file(part))
    ]
    rows += [
        [
            f"Recording of {source.get('sensor')}",
            f"{source.get('recording')}, {count(int(source.get('rows') or 0), 'detection')}",
        ]
        for source in (results.occupancy.sources if results.occupancy else ())
    ]
    rows += [["Attribution", str(text)] for text in results.site.get("attribution") or []]
    if not rows:
        rows = [["Heat map", f"{results.traffic.folder.name}; what it was made of is {NOT_KNOWN}"]]
    return Table(caption="Data sources", columns=columns, rows=rows)


def credits_of(results: Results) -> list[str]:
    """Return whose data they are, each once, for the map itself."""
    parts = [results.site.get("map"), results.site.get("scan")]
    told = [str(part["source"]) for part in parts if part and part.get("source")]
    return list(dict.fromkeys([*told, *map(str, results.site.get("attribution") or [])]))


def made_by() -> str:
    """Return the software that makes the report."""
    return f"gis_radar {version('gis_radar')}"


def _file(part: Mapping[str, Any]) -> str:
    files = part.get("files") or [part.get("road")] if "files" in part else [part.get("file")]
    named = listed([str(each) for each in files if each])
    return f"{named} ({part['source']})" if part.get("source") else named


def _interval(results: Results, interval_s: float) -> str:
    if len(results.traffic.intervals) < 2:
        return "none: the whole time only"
    text = f"{number(interval_s)} s"
    for unit, length_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if interval_s % length_s == 0:
            text = f"{number(interval_s / length_s)} {unit}"
            break
    return f"{count(len(results.traffic.intervals), 'interval')} of {text}"


def _tiles(results: Results) -> str:
    tiles = results.traffic.tiles
    length = float(tiles["length_m"].median())
    return f"{count(len(tiles), 'tile')}, most {number(length, 2)} m long"


def _filters(results: Results) -> Iterator[tuple[str, str]]:
    """Yield what was kept of the detections, a line a filter, by sensor where they differ."""
    if results.occupancy is None:
        yield "Detections that count", NOT_KNOWN
        return
    by_text: dict[str, list[str]] = {}
    for source in results.occupancy.sources:
        text = _in_words(source.get("filters") or {})
        by_text.setdefault(text, []).append(str(source.get("sensor")))
    for text, sensors in by_text.items():
        whose = "" if len(by_text) == 1 else f" ({listed(sorted(set(sensors)))})"
        yield f"Detections that count{whose}", text
    for source in results.occupancy.sources:
        if "cycle_s" in source:
            cycle = f"{number(1000 * float(source['cycle_s']))} ms: a frame covers that long"
            yield f"Cycle of {source['sensor']}", cycle
        if "clock" in source:
            told = json.dumps(source["clock"], sort_keys=True)
            yield f"Clock of {source['sensor']} corrected", told.strip("{}").replace('"', "")


def _in_words(filters: Mapping[str, Any]) -> str:
    words = []
    if filters.get("clearance"):
        low, high = (number(float(each), 1) for each in filters["clearance"])
        error = number(float(filters.get("elevation_error_deg") or 0.0), 1)
        words.append(f"{low} to {high} m over the road (elevation error {error}°)")
    if filters.get("min_speed") is not None:
        words.append(f"faster than {number(float(filters['min_speed']), 1)}{THIN}m/s")
    if filters.get("min_rcs") is not None:
        words.append(f"cross section over {number(float(filters['min_rcs']), 1)}{THIN}dBm²")
    return "; ".join(words) or "all, standing and moving"


def _software(results: Results) -> str:
    known = results.run.get("software") or {}
    if known.get("gis_radar"):
        return f"gis_radar {known['gis_radar']} (code {known.get('code', NOT_KNOWN)})"
    return f"report by {made_by()}"

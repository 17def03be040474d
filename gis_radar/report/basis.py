"""How and from what a heat map was made, and what the words of its report mean."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any

from gis_radar.crs import name_of
from gis_radar.report.content import Column, Table
from gis_radar.report.folder import Results
from gis_radar.report.words import THIN, count, listed, number

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
            cycle = f"{number(1000 * float(source['cycle_s']))} ms: a frame speaks for that long"
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

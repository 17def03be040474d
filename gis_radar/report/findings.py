"""Put what was found into words and tables: the facts, the lanes, the sensors, the settings."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gis_radar.crs import name_of
from gis_radar.heatmap.picture import png
from gis_radar.poses.pose import ANGLES, POSITION, Pose, View
from gis_radar.quality import Quality
from gis_radar.quality.quality import GOOD
from gis_radar.report.content import Column, Content, Figure, MapSeries, Table
from gis_radar.report.lanes import LaneSums
from gis_radar.report.maps import flat_picture
from gis_radar.report.results import Results
from gis_radar.report.words import (
    NOTHING,
    THIN,
    Clock,
    count,
    direction,
    figure_text,
    listed,
    percent,
    plus_minus,
    write_csv,
)

FIGURE_PIXELS, FINE_FIGURES = 1600, 6  # width of a picture; more than that many are coarser
COARSE_PIXELS, MOST_FIGURES = 1000, 20
MOST_LANES, MOST_HOURS = 150, 168  # rows of tables as read; the CSV files hold all
NOT_KNOWN = "not known here"
HOW_FOUND = {"lane": "found from traffic on the lanes", "icp": "found by ICP"}
INTRO = (
    "The map shows in which share of the observed time radar hit each half metre of lane. "
    "Compare one place over time; the figures count neither vehicles nor queues"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """The findings that page, paper and tables are made of.

    Parameters
    ----------
    results : Results
        What the folder holds.
    title : str
        Of the report.
    clock : Clock
        Writes its times.
    quality : Quality or None
        What sensors delivered; None where that is not known.
    lanes : LaneSums
        Sums of each lane, by interval.
    table : DataFrame
        The lanes over the whole time, from :func:`gis_radar.report.lanes.lane_table`.
    """

    results: Results
    title: str
    clock: Clock
    quality: Quality | None
    lanes: LaneSums
    table: pd.DataFrame


class Totals(NamedTuple):
    """Totals of the whole time; the busiest lane is None where none was hit."""

    lanes: int
    lanes_observed: int
    length_m: float
    length_observed_m: float
    tiles_observed: int
    tiles_hit: int
    busiest_lane: int | None
    busiest_occupancy: float | None


def content_of(found: Findings, maps: MapSeries, plan: Figure) -> Content:
    """Put the findings into words.

    Parameters
    ----------
    found : Findings
        The findings.
    maps : MapSeries
        The map.
    plan : Figure
        Where the lanes are.
    """
    results, clock = found.results, found.clock
    begin, end = results.heat.whole.span()
    figures = _figures(results)
    return Content(
        title=found.title,
        subtitle=clock.whole(begin, end),
        zone=clock.name,
        until=end,
        intro=INTRO,
        facts=_facts(found),
        remarks=_remarks(results, found.quality),
        map=maps,
        lane_figure=plan,
        lanes=_lanes(found.table, clock, intervals=bool(maps.frames)),
        sensors=_sensors(results, figures=len(figures)),
        sensor_figures=figures,
        quality=_quality(found.quality, clock),
        settings=_settings(results),
        sources=_sources(results),
        definitions=tuple(_definitions().items()),
        made_by=_made_by(),
    )


def _definitions() -> dict[str, str]:
    text = files("gis_radar.report").joinpath("definitions.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def totals_of(found: Findings) -> Totals:
    """Count the totals of the whole time."""
    heat, table = found.results.heat, found.table
    shares = heat.shares()
    seen = shares.observed_s > 0
    length_m = heat.tiles["length_m"].to_numpy(np.float64)
    hit = not table.empty and table["occupancy"].iloc[0] > 0  # the busiest stands first
    return Totals(
        lanes=len(table),
        lanes_observed=int(table["occupancy"].notna().sum()),
        length_m=float(length_m.sum()),
        length_observed_m=float(length_m[seen].sum()),
        tiles_observed=int(seen.sum()),
        tiles_hit=int(np.count_nonzero(shares.occupied_s[seen])),
        busiest_lane=int(table["lane"].iloc[0]) if hit else None,
        busiest_occupancy=float(table["occupancy"].iloc[0]) if hit else None,
    )


def _facts(found: Findings) -> list[tuple[str, str]]:
    """Return the figures at the top."""
    total, sensors = totals_of(found), found.results.sensors
    busiest = "none was hit"
    if total.busiest_occupancy is not None:
        busiest = f"No. {total.busiest_lane}: {percent(total.busiest_occupancy)}"
    return [
        ("Sensors", str(len(sensors)) if sensors else "not known here"),
        ("Lanes observed", f"{total.lanes_observed} of {total.lanes}"),
        (
            "Lane length observed",
            f"{figure_text(total.length_observed_m)} of {figure_text(total.length_m)}{THIN}m",
        ),
        ("Tiles hit", f"{figure_text(total.tiles_hit)} of {figure_text(total.tiles_observed)}"),
        ("Busiest lane", busiest),
    ]


def _remarks(results: Results, quality: Quality | None) -> list[str]:
    """Return what to know before reading on."""
    remarks = [f"No result for sensor {name}: {why}" for name, why in results.lost.items()]
    if quality is not None:
        remarks += [f"Sensor {line}" for line in quality.warnings()]
    return [*remarks, *results.warnings, *results.missing]


def _figures(results: Results) -> list[Figure]:
    """Return the pictures of how poses were found, of the sensors that are shown."""
    found: list[Figure] = []
    poses = [pose for pose in results.poses if pose.sensor in results.figures]
    width = FIGURE_PIXELS if len(poses) <= FINE_FIGURES else COARSE_PIXELS
    for pose in poses[:MOST_FIGURES]:
        image = flat_picture(results.figures[pose.sensor], width)
        if image is None:
            continue
        found.append(
            Figure(
                png=png(image),
                width=image.width,
                height=image.height,
                caption=f"Sensor {pose.sensor}: {how_found(pose)}.",
                alt=(
                    f"How the pose of {pose.sensor} was found: traces of vehicles on the map's "
                    f"lanes; {how_found(pose)}."
                ),
            )
        )
    return found


def _lanes(table: pd.DataFrame, clock: Clock, *, intervals: bool) -> Table:
    """Return the observed lanes as they are read, from what `lane_table` returns."""
    columns = [
        Column(title="Lane", width=0.8),
        Column(title="Leads to", is_number=False, width=1.4),
        Column(title="Length", unit="m", width=0.9),
        Column(title="Observed", unit="of its length", width=1.5),
        Column(title="Occupancy", unit="of observed time", width=1.5),
        Column(title="Busiest spot", unit="occupancy, at m", width=1.6),
        Column(title="Over 20 %", unit="m of its length", width=1.3),
    ]
    if intervals:
        columns.append(Column(title="Busiest interval", is_number=False, width=2.4))
        columns.append(Column(title="Occupancy", unit="then", width=1.4))
    seen = table[table["occupancy"].notna()]
    shown = seen.head(MOST_LANES)
    rows = [_lane_row(row, clock, intervals=intervals) for _, row in shown.iterrows()]
    note = "Where lanes cross, their tiles overlap, and a vehicle there counts on each."
    unseen = len(table) - len(seen)
    if len(seen) > len(shown):
        note = f"The busiest {len(shown)} of {count(len(seen), 'observed lane')}. {note}"
    if unseen:
        were = "was" if unseen == 1 else "were"
        note = f"{count(unseen, 'lane')} of the map {were} not observed. {note}"
    if len(table) > len(shown):
        note = f"{note} All lanes are in lanes.csv."
    return Table(caption="Lanes, busiest first", columns=columns, rows=rows, note=note)


def _lane_row(row: pd.Series, clock: Clock, *, intervals: bool) -> list[str]:
    cells = [
        str(row["lane"]),
        direction(row["east_m"], row["north_m"]),
        figure_text(row["length_m"]),
        percent(row["observed_m"] / row["length_m"], 0),
        percent(row["occupancy"]),
        f"{percent(row['busiest_spot'], 0)}, {figure_text(row['busiest_spot_m'])}",
        figure_text(row["busy_m"], 1),
    ]
    if not intervals:
        return cells
    if pd.isna(row["busiest_begin"]):
        return [*cells, NOTHING, NOTHING]
    span = clock.span(row["busiest_begin"].to_pydatetime(), row["busiest_end"].to_pydatetime())
    return [*cells, span, percent(row["busiest_occupancy"])]


def _sensors(results: Results, *, figures: int) -> Table:
    """Return where sensors stand, how well that is known, and how it was found.

    Parameters
    ----------
    results : Results
        Whose sensors.
    figures : int
        How many pictures follow; the note says where there are more.
    """
    columns = [
        Column(title="Sensor", is_number=False, width=1.1),
        Column(title="Easting", unit="m", width=1.9),
        Column(title="Northing", unit="m", width=2.1),
        Column(title="Height", unit="m", width=1.6),
        Column(title="Looks to", unit="from grid north", width=2.0),
        Column(title="Pitch, roll", unit="degrees", width=1.8),
        Column(title="Sees", unit="range, width", width=1.1),
        Column(title="How its pose was found", is_number=False, width=2.6),
    ]
    rows = [_sensor_row(pose) for pose in results.poses]
    rows += [
        [name, *[NOTHING] * 6, f"no result: {reason}"] for name, reason in results.lost.items()
    ]
    note = (
        "± is one standard deviation. Bearings count clockwise; pitch over 0 looks down. "
        "Width is the opening angle."
    )
    if figures < len(results.figures):
        note += f" Pictures follow of {figures}; there are {len(results.figures)} in sensors/."
    if not rows:
        note = "No pose is known here."
    return Table(caption="Sensors, and where they stand", columns=columns, rows=rows, note=note)


def _sensor_row(pose: Pose) -> list[str]:
    sigma = _sigma(pose)

    def with_sigma(name: str, digits: int, value: float | None = None, unit: str = "") -> str:
        shown = figure_text(getattr(pose, name) if value is None else value, digits) + unit
        known = sigma.get(name)
        return shown if known is None else f"{shown} {plus_minus(known, 2, unit)}"

    view = pose.view or View()
    ahead = pose.R_map_sensor[:2, 0]
    bearing = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
    return [
        pose.sensor,
        with_sigma("easting", 2),
        with_sigma("northing", 2),
        with_sigma("height", 2),
        f"{direction(*ahead)}, {with_sigma('yaw', 1, bearing, '°')}",
        f"{with_sigma('pitch', 1)}, {with_sigma('roll', 1)}",
        f"{figure_text(view.max_range_m)} m, {figure_text(view.azimuth_deg)}°",
        how_found(pose),
    ]


def how_found(pose: Pose) -> str:
    """Say how a pose was found, and on what evidence."""
    evidence = pose.evidence
    words = [HOW_FOUND.get(str(evidence.get("method")), "given, not found by gis_radar")]
    fitness = evidence.get("fitness")
    if isinstance(fitness, int | float) and not isinstance(fitness, bool):
        words.append(f"{percent(float(fitness), 0)} of the traces fit")
    if evidence.get("observable") is False:
        words.append("the scene does not fix all of it")
    look = evidence.get("second_look")
    if isinstance(look, dict) and look.get("verdict"):
        words.append(f"second look {look['verdict']}")
    return "; ".join(words)


def _quality(quality: Quality | None, clock: Clock) -> Table:
    """Return what sensors delivered by hour, those with a fault first where there are many."""
    columns = [
        Column(title="Sensor", is_number=False, width=1.1),
        Column(title="Hour from", is_number=False, width=1.8),
        Column(title="Frames", unit="received", width=1.1),
        Column(title="Frames", unit="expected", width=1.1),
        Column(title="Detections", unit="a frame", width=1.2),
        Column(title="Moving", unit="of them", width=1.0),
        Column(title="Clock", unit="corrected by s", width=1.3),
        Column(title="Pose age", unit="h", width=1.0),
        Column(title="Verdict", is_number=False, width=2.4),
    ]
    caption = "Measurements by sensor and hour"
    if quality is None:
        return Table(
            caption=caption, columns=columns, rows=(), note="What sensors delivered is not known."
        )
    table = quality.table
    lines = [f"{sensor}: {text}." for sensor, text in _hours_in_words(table).items()]
    if len(table) > MOST_HOURS:
        faulty = table["verdict"].ne(GOOD).sort_values(ascending=False, kind="stable").index
        table = table.loc[faulty].head(MOST_HOURS)
        lines.append(
            f"Here {MOST_HOURS} of {figure_text(len(quality.table))} rows, those with a fault "
            "first; all are in quality.csv."
        )
    rows = [_hour_row(row, clock) for _, row in table.iterrows()]
    return Table(caption=caption, columns=columns, rows=rows, note=" ".join(lines))


def _hours_in_words(table: pd.DataFrame) -> dict[str, str]:
    """Say by sensor in how many hours it was well."""
    words = {}
    for sensor, rows in table.groupby("sensor"):
        good = int(rows["verdict"].eq(GOOD).sum())
        hours = count(len(rows), "hour")
        words[str(sensor)] = (
            f"good in all of {hours}"
            if good == len(rows)
            else (f"good in {figure_text(good)} of {hours}")
        )
    return words


def _hour_row(row: pd.Series, clock: Clock) -> list[str]:
    return [
        str(row["sensor"]),
        clock.stamp(row["begin"].to_pydatetime()),
        figure_text(row["frames"]),
        figure_text(row["frames_expected"]),
        figure_text(row["detections_per_frame"], 1),
        percent(row["moving_share"], 0),
        figure_text(row["clock_offset_s"], 3),
        figure_text(row["pose_age_h"], 1) if row["pose_age_h"] >= 0 else NOTHING,
        str(row["verdict"]),
    ]


def _sigma(pose: Pose) -> dict[str, float]:
    """Return the standard deviations of a pose that are known."""
    sigma = pose.evidence.get("sigma")
    return {
        name: float(value)
        for name, value in (sigma if isinstance(sigma, dict) else {}).items()
        if isinstance(value, int | float) and math.isfinite(value)
    }


def _settings(results: Results) -> Table:
    """Return the settings in effect, as far as the folder holds them."""
    rows = [
        ["Coordinates", f"{results.heat.crs.name}, {name_of(results.heat.crs)[:24]}"],
        ["Intervals", _interval(results)],
        ["Tiles", _tiles(results)],
        *([name, text] for name, text in _filters(results)),
        ["Fingerprint of the tiles", results.heat.fingerprint],
        ["Software", _software(results)],
    ]
    return Table(caption="Settings", columns=_named("Setting"), rows=rows)


def _sources(results: Results) -> Table:
    """Return the data that the heat map was made of."""
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
        rows = [["Heat map", f"{results.name}; what it was made of is {NOT_KNOWN}"]]
    return Table(caption="Data sources", columns=_named("Data"), rows=rows)


def _named(title: str) -> tuple[Column, Column]:
    return (
        Column(title="What", is_number=False, width=1.0),
        Column(title=title, is_number=False, width=2.6),
    )


def _made_by() -> str:
    """Return the software that makes the report."""
    return f"gis_radar {version('gis_radar')}"


def _file(part: Mapping[str, Any]) -> str:
    files = part.get("files") or [part.get("road")] if "files" in part else [part.get("file")]
    named = listed([str(each) for each in files if each])
    return f"{named} ({part['source']})" if part.get("source") else named


def _interval(results: Results) -> str:
    timeline = results.heat.timeline
    if len(timeline) < 2:
        return "none: the whole time only"
    begin, end = timeline.span()
    interval_s = (end - begin).total_seconds()
    text = f"{figure_text(interval_s)} s"
    for unit, length_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if interval_s % length_s == 0:
            text = f"{figure_text(interval_s / length_s)} {unit}"
            break
    return f"{count(len(timeline), 'interval')} of {text}"


def _tiles(results: Results) -> str:
    tiles = results.heat.tiles
    length = float(tiles["length_m"].median())
    return f"{count(len(tiles), 'tile')}, most {figure_text(length, 2)} m long"


def _filters(results: Results) -> Iterator[tuple[str, str]]:
    """Yield what was kept of the detections, a line a filter, by sensor where they differ."""
    if results.occupancy is None:
        yield "Detections that count", NOT_KNOWN
        return
    by_text: dict[str, list[str]] = {}
    for source in results.occupancy.sources:
        text = _filters_in_words(source.get("filters") or {})
        by_text.setdefault(text, []).append(str(source.get("sensor")))
    for text, sensors in by_text.items():
        whose = "" if len(by_text) == 1 else f" ({listed(sorted(set(sensors)))})"
        yield f"Detections that count{whose}", text
    for source in results.occupancy.sources:
        if "cycle_s" in source:
            cycle = f"{figure_text(1000 * float(source['cycle_s']))} ms: a frame covers that long"
            yield f"Cycle of {source['sensor']}", cycle
        if "clock" in source:
            clock = json.dumps(source["clock"], sort_keys=True)
            yield f"Clock of {source['sensor']} corrected", clock.strip("{}").replace('"', "")


def _filters_in_words(filters: Mapping[str, Any]) -> str:
    words = []
    if filters.get("clearance"):
        low, high = (figure_text(float(each), 1) for each in filters["clearance"])
        error = figure_text(float(filters.get("elevation_error_deg") or 0.0), 1)
        words.append(f"{low} to {high} m over the road (elevation error {error}°)")
    if filters.get("min_speed") is not None:
        words.append(f"faster than {figure_text(float(filters['min_speed']), 1)}{THIN}m/s")
    if filters.get("min_rcs") is not None:
        words.append(f"cross section over {figure_text(float(filters['min_rcs']), 1)}{THIN}dBm²")
    return "; ".join(words) or "all, standing and moving"


def _software(results: Results) -> str:
    known = results.run.get("software") or {}
    if known.get("gis_radar"):
        return f"gis_radar {known['gis_radar']} (code {known.get('code', NOT_KNOWN)})"
    return f"report by {_made_by()}"


def write_sensor_table(path: Path, results: Results) -> None:
    """Write the poses with their standard deviations, and who has none."""
    names = (*POSITION, *ANGLES)
    header = (
        "sensor", "crs", *names, *(f"sigma_{name}" for name in names),
        "azimuth_deg", "elevation_deg", "min_range_m", "max_range_m", "how_found",
    )  # fmt: skip
    rows: list[Sequence[Any]] = []
    for pose in results.poses:
        sigma = _sigma(pose)
        view = pose.view or View()
        rows.append(
            (
                pose.sensor,
                pose.as_dict()["crs"],
                *(round(getattr(pose, name), 4) for name in names),
                *(round(sigma[name], 4) if name in sigma else "" for name in names),
                *(view.azimuth_deg, view.elevation_deg, view.min_range_m, view.max_range_m),
                how_found(pose),
            )
        )
    blank = [""] * (len(header) - 2)
    rows += [(name, *blank, f"no result: {why}") for name, why in results.lost.items()]
    write_csv(path, header, rows)

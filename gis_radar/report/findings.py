"""Put findings into words and tables: the facts, the lanes, the sensors, the quality by hour."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gis_radar.heatmap.picture import png
from gis_radar.poses.pose import ANGLES, POSITION, Pose, View
from gis_radar.quality import Quality
from gis_radar.quality.quality import GOOD
from gis_radar.report.content import Column, Content, Figure, MapSeries, Table
from gis_radar.report.lanes import LaneSums
from gis_radar.report.maps import flat_picture
from gis_radar.report.results import NOT_KNOWN, Results, made_by, settings_of, sources_of
from gis_radar.report.words import (
    NOTHING,
    THIN,
    Clock,
    count,
    direction,
    figure_text,
    percent,
    plus_minus,
    write_csv,
)

FIGURE_PIXELS, FINE_FIGURES = 1600, 6  # width of a picture; more than that many are coarser
COARSE_PIXELS, MOST_FIGURES = 1000, 20
MOST_LANES, MOST_HOURS = 150, 168  # rows of tables as read; the CSV files hold all
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
        For its times.
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
        settings=settings_of(results),
        sources=sources_of(results),
        definitions=tuple(_definitions().items()),
        made_by=made_by(),
    )


def _definitions() -> dict[str, str]:
    text = files("gis_radar.report").joinpath("definitions.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def totals_of(found: Findings) -> dict[str, Any]:
    """Count the totals of the whole time; the busiest lane is None where none was hit."""
    heat, table = found.results.heat, found.table
    shares = heat.shares()
    seen = shares.observed_s > 0
    length_m = heat.tiles["length_m"].to_numpy(np.float64)
    hit = not table.empty and table["occupancy"].iloc[0] > 0  # the busiest stands first
    return {
        "lanes": len(table),
        "lanes_observed": int(table["occupancy"].notna().sum()),
        "lane_length_m": round(float(length_m.sum()), 2),
        "lane_length_observed_m": round(float(length_m[seen].sum()), 2),
        "tiles_observed": int(seen.sum()),
        "tiles_hit": int(np.count_nonzero(shares.occupied_s[seen])),
        "busiest_lane": int(table["lane"].iloc[0]) if hit else None,
        "busiest_lane_occupancy": round(float(table["occupancy"].iloc[0]), 6) if hit else None,
    }


def _facts(found: Findings) -> list[tuple[str, str]]:
    """Return the figures at the top."""
    total, sensors = totals_of(found), found.results.sensors
    shown = {name: figure_text(value) for name, value in total.items() if value is not None}
    busiest = "none was hit"
    if total["busiest_lane"] is not None:
        busiest = f"No. {total['busiest_lane']}: {percent(total['busiest_lane_occupancy'])}"
    return [
        ("Sensors", str(len(sensors)) if sensors else NOT_KNOWN),
        ("Lanes observed", f"{total['lanes_observed']} of {total['lanes']}"),
        (
            "Lane length observed",
            f"{shown['lane_length_observed_m']} of {shown['lane_length_m']}{THIN}m",
        ),
        ("Tiles hit", f"{shown['tiles_hit']} of {shown['tiles_observed']}"),
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
    """Return how a pose was found, and on what evidence, in words."""
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
    """Return by sensor in how many hours no test found fault, in words."""
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

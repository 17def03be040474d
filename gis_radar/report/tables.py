"""The tables of a report: lanes, sensors, and what sensors delivered."""

from __future__ import annotations

import math

import pandas as pd

from gis_radar.poses.pose import Pose, View
from gis_radar.quality import Quality
from gis_radar.quality.quality import GOOD
from gis_radar.report.content import Column, Table
from gis_radar.report.folder import Results
from gis_radar.report.words import NOTHING, Clock, count, direction, number, percent, plus_minus

MOST_LANES, MOST_HOURS = 150, 168
HOW_FOUND = {"lane": "found from traffic on the lanes", "icp": "found by ICP"}


def lanes_as_read(table: pd.DataFrame, clock: Clock, *, intervals: bool) -> Table:
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
    rows = [_lane(row, clock, intervals=intervals) for _, row in shown.iterrows()]
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


def _lane(row: pd.Series, clock: Clock, *, intervals: bool) -> list[str]:
    cells = [
        str(row["lane"]),
        direction(row["east_m"], row["north_m"]),
        number(row["length_m"]),
        percent(row["observed_m"] / row["length_m"], 0),
        percent(row["occupancy"]),
        f"{percent(row['busiest_spot'], 0)}, {number(row['busiest_spot_m'])}",
        number(row["busy_m"], 1),
    ]
    if not intervals:
        return cells
    if pd.isna(row["busiest_begin"]):
        return [*cells, NOTHING, NOTHING]
    span = clock.span(row["busiest_begin"].to_pydatetime(), row["busiest_end"].to_pydatetime())
    return [*cells, span, percent(row["busiest_occupancy"])]


def sensors_as_read(results: Results, *, figures: int) -> Table:
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
    rows = [_sensor(pose) for pose in results.poses]
    rows += [
        [name, *[NOTHING] * 6, f"no result: {reason}"] for name, reason in lost_of(results).items()
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


def _sensor(pose: Pose) -> list[str]:
    known = pose.evidence.get("sigma")
    sigma = {
        name: float(value)
        for name, value in (known if isinstance(known, dict) else {}).items()
        if isinstance(value, int | float)
    }

    def with_sigma(name: str, digits: int, value: float | None = None, unit: str = "") -> str:
        shown = number(getattr(pose, name) if value is None else value, digits) + unit
        told = sigma.get(name, math.nan)
        return f"{shown} {plus_minus(told, 2, unit)}" if math.isfinite(told) else shown

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
        f"{number(view.max_range_m)} m, {number(view.azimuth_deg)}°",
        how_found(pose),
    ]


def how_found(pose: Pose) -> str:
    """Say how a pose was found, and what speaks for it."""
    told = pose.evidence
    words = [HOW_FOUND.get(str(told.get("method")), "given, not found by gis_radar")]
    fitness = told.get("fitness")
    if isinstance(fitness, int | float) and not isinstance(fitness, bool):
        words.append(f"{percent(float(fitness), 0)} of the traces fit")
    if told.get("observable") is False:
        words.append("the scene does not fix all of it")
    look = told.get("second_look")
    if isinstance(look, dict) and look.get("verdict"):
        words.append(f"second look {look['verdict']}")
    return "; ".join(words)


def lost_of(results: Results) -> dict[str, str]:
    """Return the sensors of the site that the heat map does not show, and why."""
    shown = results.run.get("sensors_in_heat_maps") or []
    lost = {
        str(each["name"]): "see summary.md"
        for each in results.site.get("sensor") or []
        if shown and each["name"] not in shown
    }
    for stage in results.stages:
        for name in lost:
            if stage.get("error") and str(stage["name"]).endswith(f" {name}"):
                lost[name] = str(stage["error"])
                break
    return lost


def quality_as_read(quality: Quality | None, clock: Clock) -> Table:
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
    lines = [f"{sensor}: {text}." for sensor, text in _in_words(table).items()]
    if len(table) > MOST_HOURS:
        faulty = table["verdict"].ne(GOOD).sort_values(ascending=False, kind="stable").index
        table = table.loc[faulty].head(MOST_HOURS)
        lines.append(
            f"Here {MOST_HOURS} of {number(len(quality.table))} rows, those with a fault first; "
            "all are in quality.csv."
        )
    rows = [_hour(row, clock) for _, row in table.iterrows()]
    return Table(caption=caption, columns=columns, rows=rows, note=" ".join(lines))


def _in_words(table: pd.DataFrame) -> dict[str, str]:
    """Say by sensor in how many hours it was well."""
    words = {}
    for sensor, rows in table.groupby("sensor"):
        good = int(rows["verdict"].eq(GOOD).sum())
        hours = count(len(rows), "hour")
        words[str(sensor)] = (
            f"good in all of {hours}"
            if good == len(rows)
            else (f"good in {number(good)} of {hours}")
        )
    return words


def _hour(row: pd.Series, clock: Clock) -> list[str]:
    return [
        str(row["sensor"]),
        clock.stamp(row["begin"].to_pydatetime()),
        number(row["frames"]),
        number(row["frames_expected"]),
        number(row["detections_per_frame"], 1),
        percent(row["moving_share"], 0),
        number(row["clock_offset_s"], 3),
        number(row["pose_age_h"], 1) if row["pose_age_h"] >= 0 else NOTHING,
        str(row["verdict"]),
    ]


def warnings_of(results: Results) -> list[str]:
    """Return what the stages of the run warned of, each warning once, after the stages that did."""
    by_text: dict[str, list[str]] = {}
    for stage in results.stages:
        for text in dict.fromkeys(stage.get("warnings") or []):
            by_text.setdefault(text, []).append(str(stage["name"]))
    return [f"{', '.join(names)}: {text}" for text, names in by_text.items()]

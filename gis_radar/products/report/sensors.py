"""Tables of a report's sensors: poses, what each delivered by hour, and whether all fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base import (
    NO_FIGURE,
    STEP_S,
    STEPS_PER_SECOND,
    THIN_SPACE,
    Clock,
    direction,
    figure_text,
    localised,
    percent,
    plural,
    plus_minus,
    seconds_text,
    tr,
)
from gis_radar.calibration import FITS, WRONG, Finding
from gis_radar.poses import Pose, View
from gis_radar.products import report_files as names
from gis_radar.products.quality.quality import GOOD
from gis_radar.products.report.basis import ReportData, recorded_runs
from gis_radar.products.report.content import Column, Table, how_found, text_columns, text_rows
from gis_radar.products.report.results import Results

_MOST_HOURS = 168  # rows of the table as read; the CSV file holds all
_NOT_CHECKED = "not checked"


def sensor_table(results: Results, zone: ZoneInfo) -> Table:
    """Return the table of the sensors' poses, with their errors and how they were found.

    Parameters
    ----------
    results : Results
        The results.
    zone : ZoneInfo
        Time zone of the report.
    """
    columns = _sensor_columns()
    rows = text_rows(results.poses, columns)
    rows += [
        [name, *[NO_FIGURE] * 6, tr("no result: {why}", why=tr(localised(reason, zone)))]
        for name, reason in results.lost.items()
    ]
    note = tr(
        "± is one standard deviation. Bearings count clockwise from grid north; pitch over 0 "
        "looks down. Width is the opening angle."
    )
    if results.figures:
        note += " " + tr("Pictures of how they were found: sensors/NAME/localization.png.")
    if not rows:
        note = tr("No pose is known here.")
    return Table(
        name="sensors", caption=tr("Sensors, and where they stand"), columns=columns, rows=rows,
        note=note,
    )  # fmt: skip


def _sensor_columns() -> list[Column]:
    """Return the columns of the table of sensors."""

    def angles(pose: Pose) -> str:
        both = [_with_sigma(pose, name, 1).replace(" ", THIN_SPACE) for name in ("pitch", "roll")]
        return ", ".join(both)

    def sees(pose: Pose) -> str:
        view = pose.view or View()
        return f"{figure_text(view.max_range_m)} m, {figure_text(view.azimuth_deg)}°"

    return [
        Column(tr("Sensor"), "", lambda pose: str(pose.sensor), False),
        Column(tr("Easting"), "m", lambda pose: _with_sigma(pose, "easting", 2)),
        Column(tr("Northing"), "m", lambda pose: _with_sigma(pose, "northing", 2)),
        Column(tr("Height"), "m", lambda pose: _with_sigma(pose, "height", 2)),
        Column(tr("Looks to"), tr("from grid north"), _looks_to),
        Column(tr("Pitch, roll"), tr("degrees"), angles),
        Column(tr("Sees"), tr("range, width"), sees),
        Column(tr("How its pose was found"), "", lambda pose: how_found(pose.evidence), False),
    ]


def _with_sigma(
    pose: Pose, name: str, digits: int, value: float | None = None, unit: str = ""
) -> str:
    """Return a number of a pose, or another value for it, with its standard deviation."""
    shown = figure_text(getattr(pose, name) if value is None else value, digits) + unit
    known = pose.parsed_evidence().sigma.get(name)
    return shown if known is None else f"{shown} {plus_minus(known, 2, unit)}"


def _looks_to(pose: Pose) -> str:
    ahead = pose.R_map_sensor[:2, 0]
    bearing = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
    return f"{direction(*ahead)}, {_with_sigma(pose, 'yaw', 1, bearing, '°')}"


def quality_table(data: ReportData) -> Table:
    """Return what sensors delivered by hour, those with a fault first where there are many."""
    columns, quality = _hour_columns(data), data.quality
    note, rows = tr("What sensors delivered is not known."), []
    if quality is not None:
        table = quality.table.assign(recorded_s=_recorded_in(quality.table, data.results))
        note = ""
        if len(table) > _MOST_HOURS:
            order = table["verdict"].ne(GOOD).sort_values(ascending=False, kind="stable").index
            table = table.loc[order].head(_MOST_HOURS)
            text = "Here {part} of {all} rows, those with a fault first."
            note = tr(text, part=_MOST_HOURS, all=figure_text(len(quality.table)))
        rows = text_rows((row for _, row in table.iterrows()), columns)
    return Table(
        name="quality",
        caption=tr("Measurements by sensor and hour ({zone})", zone=data.clock.name),
        columns=columns, rows=rows, note=note,
        files=[(names.QUALITY, tr("all sensors and hours"))] if quality is not None else [],
    )  # fmt: skip


def _recorded_in(table: pd.DataFrame, results: Results) -> list[float]:
    """Return for each sensor and hour the seconds in which its frames are valid."""
    runs = recorded_runs(results)
    edges = [
        (begin.timestamp() * STEPS_PER_SECOND, end.timestamp() * STEPS_PER_SECOND)
        for begin, end in zip(table["begin"], table["end"], strict=True)
    ]
    return [
        float(np.diff(runs[str(sensor)].before(np.array(edge, np.int64)))[0]) * STEP_S
        for sensor, edge in zip(table["sensor"], edges, strict=True)
    ]


def _hour_columns(data: ReportData) -> list[Column]:
    """Return the columns of the table of hours of sensors."""
    clock, quality = data.clock, data.quality

    def number(name: str, digits: int = 0) -> Callable[[pd.Series], str]:
        return lambda row: figure_text(row[name], digits)

    def age(row: pd.Series) -> str:
        return figure_text(row["pose_age_h"], 1) if row["pose_age_h"] >= 0 else NO_FIGURE

    def begin(row: pd.Series) -> str:
        return clock.stamp(row["begin"].to_pydatetime())

    def verdict(row: pd.Series) -> str:
        return tr(quality.verdict(row["verdict"])) if quality else NO_FIGURE

    return [
        Column(tr("Sensor"), "", lambda row: str(row["sensor"]), False),
        Column(tr("Hour from"), "", begin, False),
        Column(tr("Time recorded"), "", lambda row: seconds_text(row["recorded_s"])),
        Column(tr("Frames"), tr("received"), number("frames")),
        Column(tr("Frames"), tr("expected"), number("frames_expected")),
        Column(tr("Detections"), tr("a frame"), number("detections_per_frame", 1)),
        Column(tr("Moving"), tr("of them"), lambda row: percent(row["moving_share"], 0)),
        Column(tr("Clock"), tr("corrected by s"), number("clock_offset_s", 3)),
        Column(tr("Pose age"), "h", age),
        Column(tr("Verdict"), "", verdict, False),
    ]


def trust_table(results: Results, clock: Clock) -> Table:
    """Return what the check found of each sensor, and what to do about it.

    Parameters
    ----------
    results : Results
        The results.
    clock : Clock
        Clock of the site, for times in the evidence.

    Returns
    -------
    Table
        Table of the sensors whose recordings are in the heat map, and of those left out.
    """
    findings = results.findings
    names = sorted({*results.sensors, *results.lost, *findings})
    rows = [_trust_cells(name, findings.get(name), results, clock) for name in names]
    columns = text_columns(tr("Sensor"), tr("Verdict"), tr("Evidence"), tr("What to do"))
    return Table(
        name="trust",
        caption=tr("Whether pose, recordings and map of each sensor fit together"),
        columns=columns,
        rows=rows,
        note=" ".join(_trust_notes(results, findings)),
    )


def _trust_cells(name: str, finding: Finding | None, results: Results, clock: Clock) -> list[str]:
    if finding is None:
        reason = results.lost.get(name, "")
        return [name, tr(_NOT_CHECKED), tr(reason) if reason else NO_FIGURE, NO_FIGURE]
    verdict = tr(finding.shown_verdict)
    if finding.refused:
        text = "{verdict}, left out" if name in results.lost else "{verdict}, accepted anyway"
        text = "{verdict}, used in part" if name in results.in_part else text
        verdict = tr(text, verdict=verdict)
    return [
        name,
        verdict,
        tr(localised(finding.reason, clock.zone)),
        tr(finding.advice) or NO_FIGURE,
    ]


def _trust_notes(results: Results, findings: dict[str, Finding]) -> list[str]:
    """Return in sentences how many sensors fit, and what the verdicts mean."""
    used = results.dataset.manifest.findings  # of sensors in part: of the recordings in the map
    shown = [(used if n in results.in_part else findings).get(n) for n in results.sensors]
    fit = sum(each is not None and not each.doubt for each in shown)
    wrong = sum(each is not None and each.verdict == WRONG for each in shown)
    notes = [
        plural(fit, "{n} sensor of this map fits.", "{n} sensors of this map fit.")
        if fit < len(shown) or not shown or results.lost
        else tr("All sensors of this map fit.")
    ]
    if wrong:
        notes.append(
            tr("Where one does not fit, do not use this map: vehicles may be on wrong lanes.")
        )
    if any(each is not None and each.verdict != FITS and not each.refused for each in shown):
        notes.append(
            tr("Too little traffic to tell: an error would not have shown; the map may be right.")
        )
    return notes

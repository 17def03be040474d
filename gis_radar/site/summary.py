"""The summary of a run in Markdown: key facts of the report, and the pose of each sensor."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib.resources import files
from typing import Any

from jinja2 import Environment

from gis_radar.base import (
    NO_FIGURE,
    GisRadarError,
    InputError,
    NoAnswerError,
    Text,
    direction,
    figure_text,
    listed,
    speaking,
    tr,
    warnings_once,
    whole_span,
    zone_of,
)
from gis_radar.site import stages as work
from gis_radar.site.messages import error_in_site_words
from gis_radar.site.plan import Outcome
from gis_radar.site.settings import Site
from gis_radar.site.versions import software


def sensors_in(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the sensors that the heat maps are made of."""
    return [
        name
        for each in outcomes
        if each.has_result and each.stage.work is work.measure_stage
        for name in each.figures["sensors"]
    ]


def refused_sensors(outcomes: Sequence[Outcome], timezone: str) -> dict[str, GisRadarError]:
    """Return the error of each sensor whose recordings are not in the dataset."""
    measured = (each.figures for each in outcomes if each.stage.work is work.measure_stage)
    return {
        name: error_in_site_words(
            (NoAnswerError if name in each.get("implausible", ()) else InputError)(
                why, hint=each.get("hints", {}).get(name, "")
            ),
            timezone,
        )
        for each in measured
        for name, why in each.get("refused", {}).items()
    }


def doubts_of(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return, by sensor, the doubt of the check of poses and recordings."""
    measured = (each.figures for each in outcomes if each.stage.work is work.measure_stage)
    return {name: line for each in measured for name, line in each.get("doubts", {}).items()}


def sensors_of(outcomes: Sequence[Outcome], site: Site) -> dict[str, dict[str, Any]]:
    """Return pose and `state` of each sensor; the state is `ok`, or the reason against it."""
    found: dict[str, dict[str, Any]] = {sensor.name: {} for sensor in site.sensor}
    for each in outcomes:
        if not each.stage.sensor:
            continue
        facts = found[each.stage.sensor]
        if each.error is not None:
            reason = each.error.message.removeprefix(f"{each.stage.sensor}: ")
            facts.setdefault("state", reason)
        elif each.stage.work in {work.localize_stage, work.pose_stage, work.tied_pose_stage}:
            # figures of the localization come first; the pose in use replaces them
            found[each.stage.sensor] = {**facts, **each.figures}
    for name, error in refused_sensors(outcomes, site.timezone).items():
        found[name]["state"] = Text(error.message).removeprefix(f"{name}: ")
    for name, doubt in doubts_of(outcomes).items():
        found[name]["state"] = Text(doubt).removeprefix(f"{name}: ")
    return {name: {"state": "ok"} | facts for name, facts in found.items()}


def _together(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line for each sensor that was adjusted together with others, or could not be."""
    solved = (e.figures for e in outcomes if e.has_result and e.stage.work is work.together_stage)
    return [f"{name}: {tr(line)}" for each in solved for name, line in each.items()]


def warnings_of(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the warnings of all stages, each once."""
    return warnings_once({each.stage.name: list(each.warnings) for each in outcomes})


_NUMBERS = "|".join(rf"(?<=^{digits})[.)](?=\s|$)" for digits in (r"\d", r"\d\d", r"\d\d\d"))
_MARKS = re.compile(  # characters that are markup in Markdown; no underscore within a word
    r"[\\`*\[\]<>|~]|(?<![^\W_])_|_(?![^\W_])|&(?=#?\w+;)|^[#+=-]|" + _NUMBERS
)


def markdown_escaped(value: object) -> object:
    """Return a text with markup and HTML escaped, so that Markdown shows it unchanged.

    Parameters
    ----------
    value : object
        A text to escape, or any other value, which stays as it is.

    Returns
    -------
    object
        A text of one line, or the value.
    """
    if not isinstance(value, str):
        return value
    return _MARKS.sub(_escaped, " ".join(value.split()))


def _escaped(found: re.Match[str]) -> str:
    text = found.group()
    return {"<": "&lt;", ">": "&gt;", "&": "&amp;"}.get(text, f"\\{text}")


def summary_page(site: Site, outcomes: Sequence[Outcome]) -> str:
    """Return the summary of a run, in the language of its report.

    Parameters
    ----------
    site : Site
        The site, with title, time zone and language.
    outcomes : sequence of Outcome
        Outcomes of the run's stages.

    Returns
    -------
    str
        Markdown.
    """
    by_work = {each.stage.work: each.figures for each in outcomes if each.has_result}
    heat, report = by_work.get(work.heatmap_stage, {}), by_work.get(work.report_stage, {})
    text = files("gis_radar.site").joinpath("summary.md.jinja").read_text(encoding="utf-8")
    plain = Environment(  # noqa: S701 - Markdown, escaped by `finalize`
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, finalize=markdown_escaped
    )
    template = plain.from_string(text)
    with speaking(site.language):
        remarks = report.get("remarks") or [tr(each) for each in warnings_of(outcomes)]
        shown: str = template.render(
            tr=tr, title=site.title, span=_span(site, heat), shown=listed(sensors_in(outcomes)),
            facts=report.get("facts") or {}, remarks=remarks, version=software()["gis_radar"],
            tables=[
                (tr("What this rests on"), report.get("basis")),
                (tr("Lanes by occupancy"), report.get("lanes_named")),
                (tr("Sensors"), _pose_rows(outcomes, site)),
            ],
            lists={
                tr("Poses found together"): _together(outcomes),
                tr("Data sources"): site.credits,
            },
        )  # fmt: skip
    return shown


def _span(site: Site, heat: Mapping[str, Any]) -> str:
    """Return the time of the heat maps as local times, with their zone."""
    if not {"begin", "end"} <= set(heat):
        return ""
    begin, end = (datetime.fromisoformat(heat[name]) for name in ("begin", "end"))
    return whole_span(begin, end, zone_of(site.timezone))


def _pose_rows(outcomes: Sequence[Outcome], site: Site) -> list[list[str]]:
    """Return the table of poses: its head, and a row a sensor; bearings count as in the report."""
    rows = [[
        tr("Sensor"), f"{tr('Easting')}, m", f"{tr('Northing')}, m", f"{tr('Height')}, m",
        f"{tr('Looks to')}, {tr('from grid north')}", tr("Pitch, roll"),
        tr("Scan check"), tr("State"),
    ]]  # fmt: skip
    for name, facts in sensors_of(outcomes, site).items():
        state = tr("good") if facts["state"] == "ok" else tr(str(facts["state"]))
        if "yaw" not in facts:
            rows.append([name, *[NO_FIGURE] * 6, state])
            continue
        yaw = math.radians(facts["yaw"])
        place = [figure_text(facts[each], 2) for each in ("easting", "northing", "height")]
        bearing = f"{figure_text((90.0 - facts['yaw']) % 360.0, 1)}°"
        angles = ", ".join(f"{figure_text(facts[each], 1)}°" for each in ("pitch", "roll"))
        looks = f"{direction(math.cos(yaw), math.sin(yaw))}, {bearing}"
        look = tr(str(facts.get("scan_check") or NO_FIGURE))
        rows.append([name, *place, looks, angles, look, state])
    return rows

"""What became of the sensors of a run: their state, doubts and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gis_radar.base import GisRadarError, InputError, NoAnswerError, Text, warnings_once
from gis_radar.site import stages as work
from gis_radar.site.messages import error_in_site_words
from gis_radar.site.plan import Outcome
from gis_radar.site.settings import Site


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


def warnings_of(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the warnings of all stages, each once."""
    return warnings_once({each.stage.name: list(each.warnings) for each in outcomes})

"""The record of a run beside its results: `run.json` for programs, `summary.md` to read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from gis_radar.files import whole_file
from gis_radar.site import stages
from gis_radar.site.plan import Outcome
from gis_radar.site.settings import Site, TomlTable
from gis_radar.site.state import RunState, software
from gis_radar.steps import zone_of

_POSE = ("easting", "northing", "height", "yaw", "pitch", "roll")


def write_summary(site: Site, root: Path, outcomes: Sequence[Outcome], state: RunState) -> None:
    """Write `run.json`, and `summary.md` of a run that has ended.

    They hold neither time nor duration: a run that was resumed writes the same as one that was
    not.

    Parameters
    ----------
    site : Site
        The site.
    root : Path
        The folder of the run.
    outcomes : sequence of Outcome
        How each stage ended; empty where the run only begins.
    state : RunState
        Holds the hashes of the inputs.
    """
    base = site.path.parent.resolve()
    document = {
        "finished": bool(outcomes),
        "site": _plain(site, base),
        "sensors_in_heat_maps": sensors_in(outcomes),
        "inputs": {_relative(p, base): state.hash_of(p) for p in (site.path, *site.inputs)},
        "software": software(),
        "stages": [_stage(each, base, root) for each in outcomes],
    }
    with whole_file(root / "run.json") as part:
        text = json.dumps(document, indent=1, ensure_ascii=False)
        part.write_text(text + "\n", encoding="utf-8")
    summary = root / "summary.md"
    if not outcomes:
        summary.unlink(missing_ok=True)
        return
    with whole_file(summary) as part:
        part.write_text("\n".join(_summary(site, outcomes)) + "\n", encoding="utf-8")


def sensors_in(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the sensors that the heat maps are made of."""
    return sorted(each.stage.sensor for each in _made_by(stages.occupancy_stage, outcomes))


def _made_by(work: Callable[..., Any], outcomes: Sequence[Outcome]) -> list[Outcome]:
    return [each for each in outcomes if each.stage.work is work and each.has_result]


def run_figures(outcomes: Sequence[Outcome], site: Site) -> dict[str, Any]:
    """Return the figures of a run that are worth a look."""
    by_work = {each.stage.work: each for each in reversed(outcomes) if each.has_result}
    heat, tiles = by_work.get(stages.heatmap_stage), by_work.get(stages.tiles_stage)
    kept = sum(each.state == "kept" for each in outcomes)
    return {
        "site": site.title,
        "sensors": {name: _facts(facts) for name, facts in sensors_of(outcomes, site).items()},
        "heat_maps_show": sensors_in(outcomes) if heat else [],
        **({"tiles": tiles.figures["tiles"]} if tiles else {}),
        **({} if heat is None else _heat(heat.figures)),
        "warnings": len(_warnings(outcomes)),
        "stages": len(outcomes),
        "stages_done_before": kept,
    }


def _heat(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in figures.items() if name not in {"sensors", "tiles"}}


def sensors_of(outcomes: Sequence[Outcome], site: Site) -> dict[str, dict[str, Any]]:
    """Return the pose of each sensor, or why there is none."""
    found: dict[str, dict[str, Any]] = {sensor.name: {} for sensor in site.sensor}
    for each in outcomes:
        if not each.stage.sensor:
            continue
        facts = found[each.stage.sensor]
        if each.error is not None:
            reason = each.error.message.removeprefix(f"{each.stage.sensor}: ")
            facts.setdefault("state", reason)
        elif each.stage.work in {stages.localize_stage, stages.pose_stage}:
            # how a pose was found comes first, and counts
            found[each.stage.sensor] = {**each.figures, **facts}
    return {name: {"state": "ok"} | facts for name, facts in found.items()}


def _facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    names = (*_POSE, "fitness", "second_look", "state")
    return {name: facts[name] for name in names if name in facts}


def _warnings(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the warnings of the stages, each once, after the names of its stages."""
    by_text: dict[str, list[str]] = {}
    for each in outcomes:
        for text in each.warnings:
            by_text.setdefault(text, []).append(each.stage.name)
    return [f"{', '.join(names)}: {text}" for text, names in by_text.items()]


def _stage(outcome: Outcome, base: Path, root: Path) -> dict[str, Any]:
    stage, error = outcome.stage, outcome.error
    return {
        "name": stage.name,
        "state": "done" if outcome.has_result else outcome.state,
        "inputs": [_relative(path, root, base) for path in stage.reads],
        "outputs": [_relative(path, root) for path in stage.outputs if outcome.has_result],
        "options": dict(stage.options),
        "figures": dict(outcome.figures),
        "warnings": list(outcome.warnings),
        **({"error": error.message, "hint": error.hint} if error else {}),
    }


def _plain(value: Any, base: Path) -> Any:
    """Return a site as what JSON can hold, its paths relative to its file where they can be."""
    if isinstance(value, TomlTable):
        return {name: _plain(each, base) for name, each in value}
    if isinstance(value, Path):
        return _relative(value, base)
    if isinstance(value, Mapping):
        return dict(value)
    return [_plain(each, base) for each in value] if isinstance(value, tuple) else value


def _relative(path: Path, *bases: Path) -> str:
    whole = path.resolve()
    for base in bases:
        if whole.is_relative_to(base.resolve()):
            return whole.relative_to(base.resolve()).as_posix()
    return str(whole)


def _summary(site: Site, outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield the lines of the summary."""
    yield from (f"# {site.title}", "")
    heat = _made_by(stages.heatmap_stage, outcomes)
    if heat:
        begin, end = (_local(heat[0].figures[name], site) for name in ("begin", "end"))
        yield from (f"From {begin} to {end} ({site.time_zone}).", "")
        yield from (f"The heat maps show {', '.join(sensors_in(outcomes))}.", "")
    else:
        yield from ("There is no heat map: no sensor has a result.", "")
    columns = ("sensor", *_POSE, "fitness", "second look", "state")
    yield from ("## Sensors", "", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|")
    for name, facts in sensors_of(outcomes, site).items():
        numbers = [str(facts.get(each, "")) for each in (*_POSE, "fitness", "second_look")]
        yield f"| {name} | {' | '.join(numbers)} | {facts['state']} |"
    yield from ("", "Positions in metres of the map frame, angles in degrees.", "")
    yield from _listed("Warnings", _warnings(outcomes))
    sources = (("map", site.map.source), ("scan", site.scan.source if site.scan else None))
    named = [f"{what}: {source}" for what, source in sources if source]
    yield from _listed("Sources", [*named, *site.attribution])
    made_by = software()
    yield f"Made by gis_radar {made_by['gis_radar']}; all settings are in `run.json`."


def _listed(title: str, lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield from (f"## {title}", "", *(f"- {line}" for line in lines), "")


def _local(text: str, site: Site) -> str:
    moment = datetime.fromisoformat(text).astimezone(zone_of(site.time_zone))
    return moment.isoformat(sep=" ", timespec="seconds")

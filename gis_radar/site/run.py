"""A run of a site: the whole way from its raw data to heat maps, taken up where one ended.

Its record stands beside the results: `run.json` for programs, `summary.md` to read.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment

from gis_radar.errors import GisRadarError, InputError, NoAnswerError, UsageError
from gis_radar.files import (
    atomic_write,
    only_writer,
    output_errors,
    refuse_foreign,
    refuse_inputs,
)
from gis_radar.json_documents import json_text
from gis_radar.notebooks import card
from gis_radar.processes import workers_here
from gis_radar.progress import QUIET, Reporter, warnings_once
from gis_radar.site import stages as work
from gis_radar.site.execution import Execution, RunState, discard
from gis_radar.site.messages import error_in_site_words
from gis_radar.site.plan import OWNED, Outcome, Stage, stages_of
from gis_radar.site.settings import Site, read_site
from gis_radar.site.software import software
from gis_radar.site.stages import STATE
from gis_radar.site.worker import process_pool
from gis_radar.steps import Clock, zone_of
from gis_radar.texts import Text, with_texts
from gis_radar.words import NOTHING, direction, figure_text, listed, speaking, tr

_POSE = ("easting", "northing", "height", "yaw", "pitch", "roll")


@dataclass(frozen=True, kw_only=True)
class SiteRun:
    """Results of a run of a site.

    Parameters
    ----------
    site : Site
        The site.
    folder : Path
        Where the results are.
    outcomes : sequence of Outcome
        How each stage ended.
    """

    site: Site
    folder: Path
    outcomes: Sequence[Outcome]

    @property
    def outputs(self) -> list[Path]:
        """What is there now, as paths below `folder`."""
        root = self.folder.resolve()
        made = [p for each in self.outcomes for p in each.made]
        made = [p.resolve().relative_to(root) for p in made]
        made = [self.folder / p for p in made if STATE not in p.parts]
        return [*made, self.folder / "run.json", self.folder / "summary.md"]

    @property
    def missing(self) -> dict[str, GisRadarError]:
        """The sensors without a result, and why."""
        return _refused(self.outcomes, self.site.timezone) | {
            each.stage.sensor: each.error
            for each in reversed(self.outcomes)
            if each.stage.sensor and each.error is not None
        }

    @property
    def failure(self) -> GisRadarError | None:
        """What a program should know if not every sensor has a result; else None.

        An :class:`InputError` where data were bad, a :class:`NoAnswerError` where no trustworthy
        answer was found.
        """
        missing = self.missing
        if not missing:
            return None
        made_of = [each.name for each in self.site.sensor if each.name not in missing]
        bad = [name for name, error in missing.items() if not isinstance(error, NoAnswerError)]
        first = (bad or list(missing))[0]
        rest = Text("there is no heat map")
        if made_of:
            rest = Text("the heat maps show {} only", ", ".join(made_of))
        kind = InputError if bad else NoAnswerError
        lost = ", ".join(sorted(missing))
        told = {name: _named(name, error) for name, error in missing.items()}
        parts = [kind("no result for {}; {}", lost, rest), *told.values()]
        return kind(
            "no result for {}; {}; {}", lost, rest, told[first].message, hint=told[first].hint,
            parts=parts if len(told) > 1 else (),
        )  # fmt: skip

    def figures(self) -> Mapping[str, Any]:
        """Return figures worth a look, by name."""
        by_work = {e.stage.work: e.figures for e in reversed(self.outcomes) if e.has_result}
        unsure = _doubts(self.outcomes)
        heat, tiles = by_work.get(work.heatmap_stage), by_work.get(work.tiles_stage)
        names = (*_POSE, "fitness", "scan_check", "state")
        sensors = _sensors_of(self.outcomes, self.site).items()
        return {
            "site": self.site.title,
            "sensors": {k: {n: facts[n] for n in names if n in facts} for k, facts in sensors},
            "heat_maps_show": _sensors_in(self.outcomes) if heat else [],
            **({"tiles": tiles["tiles"]} if tiles else {}),
            **{k: value for k, value in (heat or {}).items() if k not in {"sensors", "tiles"}},
            **{
                k: value
                for k, value in (by_work.get(work.measure_stage) or {}).items()
                if k in {"vehicles", "heavy", "passages"}
            },
            **({"not_known_to_fit": [*unsure.values()]} if unsure else {}),
            "warnings": len(_warnings(self.outcomes)),
            "stages": len(self.outcomes),
            "stages_done_before": sum(each.state == "kept" for each in self.outcomes),
        }

    def __repr__(self) -> str:
        lost = [f"; no result for {name}: {why.message}" for name, why in self.missing.items()]
        return f"SiteRun({self.site!r}, {len(self.outcomes)} stages, {self.folder}{''.join(lost)})"

    def _repr_html_(self) -> str:
        return card(f"Run of {self.site.title or self.site.path}", self.figures())


def run_site(
    path: str | Path,
    folder: str | Path,
    *,
    jobs: int | None = None,
    fresh: bool = False,
    reporter: Reporter = QUIET,
) -> SiteRun:
    """Run all stages for all sensors of a site: road, poses, tiles, dataset, heat maps.

    Stages that an earlier run into the same folder has done are not done again, unless what they
    read, their settings or the software changed. A sensor without a trustworthy answer, or with bad
    data, does not stop the others.

    Parameters
    ----------
    path : str or Path
        The site file, see :func:`read_site`.
    folder : str or Path
        Where the results go.
    jobs : int, optional
        How many stages at once; by default as many as the machine has cores and memory for.
    fresh : bool
        Do all again, whatever is there.
    reporter : Reporter
        Shows how far the work is.

    Returns
    -------
    SiteRun
        Its `failure` is set where a sensor has no result.

    Raises
    ------
    InputError
        If the site file, a scan or the map is bad.
    OutputError
        If the folder cannot be written, holds other files, or another run works in it.
    UsageError
        If `jobs` is less than 1.
    """
    if jobs is not None and jobs < 1:
        raise UsageError("jobs is {}, expected 1 or more", jobs)
    site, root = read_site(path), Path(folder).absolute()
    refuse_inputs(root, site.path, *site.inputs)
    state = _prepared(root)
    with ExitStack() as stack:
        stack.enter_context(only_writer(Path(folder), lock=state / "lock", reporter=reporter))
        scratch = _cleared(root, state)
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        kept = RunState(state / "state.json", root)
        if fresh:
            kept.outdate()
        _hash_inputs(site, kept, reporter)
        _write_record(site, root, (), kept, finished=False)
        pool = stack.enter_context(process_pool(jobs or workers_here(), scratch, site.language))
        try:
            execution = Execution(
                stages=stages_of(site, root), state=kept, pool=pool, reporter=reporter,
                timezone=site.timezone, folder=site.path.absolute().parent,
            )  # fmt: skip
            forget_stages_gone(kept, execution.stages, reporter)
            _write_record(site, root, execution.run(-1), kept, finished=False)
            outcomes = execution.run()
        except KeyboardInterrupt:
            reporter.log("stopped; what is done stays done: the same call goes on from there")
            raise
        kept.save()
        _write_record(site, root, outcomes, kept, finished=True)
    return SiteRun(site=site, folder=Path(folder), outcomes=outcomes)


def _prepared(root: Path) -> Path:
    """Make the folders of a run; refuse a folder that holds something else."""
    state = root / STATE
    with output_errors(root):
        if root.is_dir() and not state.is_dir():
            refuse_foreign(root, OWNED)
        state.mkdir(parents=True, exist_ok=True)
        (state / ".gitignore").write_text("*\n", encoding="utf-8")
    return state


def _cleared(root: Path, state: Path) -> Path:
    """Remove what a killed run left half-made; return an empty folder for temporary files."""
    halves = [each for pattern in (".*.part", ".*.before") for each in root.rglob(pattern)]
    for leftover in (*halves, state / "stages"):  # the latter of version 0.1
        shutil.rmtree(leftover, ignore_errors=True)
    (state / "contents.json").unlink(missing_ok=True)
    scratch = state / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    return scratch


def forget_stages_gone(state: RunState, stages: Sequence[Stage], reporter: Reporter) -> None:
    """Forget stages that are no more, and remove their results.

    Parameters
    ----------
    state : RunState
        What earlier runs made.
    stages : sequence of Stage
        Those that there are; what they make stays.
    reporter : Reporter
        Receives a line for each stage that had results.
    """
    names = {stage.name for stage in stages}
    made = {path for stage in stages for path in stage.outputs}
    for name in sorted(state.records.keys() - names):
        outputs = [path for path in state.forget(name) if path not in made]
        discard(outputs)
        if outputs:
            reporter.log(Text("{}: no longer part of the site, its results were removed", name))


def _hash_inputs(site: Site, state: RunState, reporter: Reporter) -> None:
    """Hash what the run reads; what was read before and has not changed takes no time."""
    files = list(dict.fromkeys(site.inputs))
    total, done = sum(path.stat().st_size for path in files), 0

    def count(size: int) -> None:
        nonlocal done
        done += size
        reporter.progress("looking at the inputs", done, total)

    for path in files:
        state.hash_of(path, count)
    reporter.progress("looking at the inputs", total, total)


# The record of a run beside its results.


def _write_record(
    site: Site, root: Path, outcomes: Sequence[Outcome], state: RunState, *, finished: bool
) -> None:
    """Write `run.json`, and `summary.md` of a run that is finished.

    They hold neither time nor duration: a run that was resumed writes the same as one that was
    not. The report reads the record of the stages before it.
    """
    base = site.path.parent.resolve()
    document = {
        "finished": finished,
        "site": site.model_dump(),
        "sensors_in_heat_maps": _sensors_in(outcomes),
        "inputs": {_relative(p, base): state.hash_of(p) for p in (site.path, *site.inputs)},
        "software": software(),
        "stages": [_stage(each, base, root) for each in outcomes],
    }
    with atomic_write(root / "run.json") as part:
        text = json_text(with_texts(document), indent=1, default=lambda path: _relative(path, base))
        part.write_text(text + "\n", encoding="utf-8")
    summary = root / "summary.md"
    if not finished:
        summary.unlink(missing_ok=True)
        return
    with atomic_write(summary) as part:
        part.write_text(summary_page(site, outcomes), encoding="utf-8")


def _sensors_in(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the sensors that the heat maps are made of."""
    return [
        name
        for each in outcomes
        if each.has_result and each.stage.work is work.measure_stage
        for name in each.figures["sensors"]
    ]


def _refused(outcomes: Sequence[Outcome], timezone: str) -> dict[str, GisRadarError]:
    """Return the sensors whose recordings are not in the dataset, and why."""
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


def _named(name: str, error: GisRadarError) -> GisRadarError:
    """Return why a sensor has no result, with its name."""
    if name in error.message.partition(":")[0].split():  # it names the sensor itself
        return error
    return type(error)("{}: {}", name, error.message, hint=error.hint)


def _doubts(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return by sensor what the check of poses and recordings doubts."""
    measured = (each.figures for each in outcomes if each.stage.work is work.measure_stage)
    return {name: line for each in measured for name, line in each.get("doubts", {}).items()}


def _sensors_of(outcomes: Sequence[Outcome], site: Site) -> dict[str, dict[str, Any]]:
    """Return the pose of each sensor, or why there is none."""
    found: dict[str, dict[str, Any]] = {sensor.name: {} for sensor in site.sensor}
    for each in outcomes:
        if not each.stage.sensor:
            continue
        facts = found[each.stage.sensor]
        if each.error is not None:
            reason = each.error.message.removeprefix(f"{each.stage.sensor}: ")
            facts.setdefault("state", reason)
        elif each.stage.work in {work.localize_stage, work.pose_stage, work.tied_pose_stage}:
            # how a pose was found comes first; the pose in use counts
            found[each.stage.sensor] = {**facts, **each.figures}
    for name, error in _refused(outcomes, site.timezone).items():
        found[name]["state"] = Text(error.message).removeprefix(f"{name}: ")
    for name, doubt in _doubts(outcomes).items():
        found[name]["state"] = Text(doubt).removeprefix(f"{name}: ")
    return {name: {"state": "ok"} | facts for name, facts in found.items()}


def _together(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what sensors gained by each other, or why they are not tied."""
    solved = (e.figures for e in outcomes if e.has_result and e.stage.work is work.together_stage)
    return [f"{name}: {tr(line)}" for each in solved for name, line in each.items()]


def _warnings(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the warnings of all stages, each once."""
    return warnings_once({each.stage.name: list(each.warnings) for each in outcomes})


def _stage(outcome: Outcome, base: Path, root: Path) -> dict[str, Any]:
    stage, error = outcome.stage, outcome.error
    return {
        "name": stage.name,
        "state": "done" if outcome.has_result else outcome.state,
        "inputs": [_relative(path, root, base) for path in stage.reads],
        "outputs": [_relative(path, root) for path in outcome.made],
        "options": dict(stage.options),
        "figures": dict(outcome.figures),
        "warnings": list(outcome.warnings),
        **({"error": error.message, "hint": error.hint} if error else {}),
    }


def _relative(path: Path, *bases: Path) -> str:
    whole = path.resolve()
    for base in bases:
        if whole.is_relative_to(base.resolve()):
            return whole.relative_to(base.resolve()).as_posix()
    return str(whole)


_NUMBERS = "|".join(rf"(?<=^{digits})[.)](?=\s|$)" for digits in (r"\d", r"\d\d", r"\d\d\d"))
_MARKS = re.compile(  # what Markdown takes for markup; no underscore within a word
    r"[\\`*\[\]<>|~]|(?<![^\W_])_|_(?![^\W_])|&(?=#?\w+;)|^[#+=-]|" + _NUMBERS
)


def markdown_escaped(value: object) -> object:
    """Return a text as Markdown prints it: names and titles are no markup and no HTML.

    Parameters
    ----------
    value : object
        Escaped where it is a text; anything else stays as it is.

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
    """Return the summary of a run, to read: what the report says first, in its language.

    Parameters
    ----------
    site : Site
        With title, time zone and language.
    outcomes : sequence of Outcome
        Of the run's stages.

    Returns
    -------
    str
        Markdown.
    """
    by_work = {each.stage.work: each.figures for each in outcomes if each.has_result}
    heat, told = by_work.get(work.heatmap_stage, {}), by_work.get(work.report_stage, {})
    text = files("gis_radar.site").joinpath("summary.md.jinja").read_text(encoding="utf-8")
    plain = Environment(  # noqa: S701 - Markdown, escaped by `finalize`
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, finalize=markdown_escaped
    )
    template = plain.from_string(text)
    with speaking(site.language):
        heard = told.get("remarks") or [tr(each) for each in _warnings(outcomes)]
        shown: str = template.render(
            tr=tr, title=site.title, span=_span(site, heat), shown=listed(_sensors_in(outcomes)),
            facts=told.get("facts") or {}, heard=heard, version=software()["gis_radar"],
            tables=[
                (tr("What this rests on"), told.get("basis")),
                (tr("Lanes by occupancy"), told.get("lanes_named")),
                (tr("Sensors"), _pose_rows(outcomes, site)),
            ],
            lists={
                tr("Poses found together"): _together(outcomes),
                tr("Data sources"): site.credits,
            },
        )  # fmt: skip
    return shown


def _span(site: Site, heat: Mapping[str, Any]) -> str:
    """Return the time of the heat maps by the site's clock, with its zone."""
    if not {"begin", "end"} <= set(heat):
        return ""
    begin, end = (datetime.fromisoformat(heat[name]) for name in ("begin", "end"))
    clock = Clock(zone=zone_of(site.timezone), first=begin, last=end)
    return clock.whole_in_zone(begin, end)


def _pose_rows(outcomes: Sequence[Outcome], site: Site) -> list[list[str]]:
    """Return the poses as a table is read: its head, and a row a sensor; bearings as the report."""
    rows = [[
        tr("Sensor"), f"{tr('Easting')}, m", f"{tr('Northing')}, m", f"{tr('Height')}, m",
        f"{tr('Looks to')}, {tr('from grid north')}", tr("Pitch, roll"),
        tr("Scan check"), tr("State"),
    ]]  # fmt: skip
    for name, facts in _sensors_of(outcomes, site).items():
        state = tr("good") if facts["state"] == "ok" else tr(str(facts["state"]))
        if "yaw" not in facts:
            rows.append([name, *[NOTHING] * 6, state])
            continue
        yaw = math.radians(facts["yaw"])
        place = [figure_text(facts[each], 2) for each in ("easting", "northing", "height")]
        bearing = f"{figure_text((90.0 - facts['yaw']) % 360.0, 1)}°"
        angles = ", ".join(f"{figure_text(facts[each], 1)}°" for each in ("pitch", "roll"))
        looks = f"{direction(math.cos(yaw), math.sin(yaw))}, {bearing}"
        look = tr(str(facts.get("scan_check") or NOTHING))
        rows.append([name, *place, looks, angles, look, state])
    return rows

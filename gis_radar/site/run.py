"""Run a site from its raw data to heat maps; a run continues where an earlier one ended.

Its record is written beside the results, as `run.json`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    card,
    clear_leftovers,
    only_writer,
    output_errors,
    refuse_foreign,
    refuse_inputs,
    warnings_once,
    with_texts,
    workers_here,
    write_json,
)
from gis_radar.site import stages as work
from gis_radar.site.execution import Execution, RunState, discard
from gis_radar.site.plan import OWNED_BY_RUN, Outcome, Stage, stages_of
from gis_radar.site.settings import Site, read_site
from gis_radar.site.stages import STATE
from gis_radar.site.versions import software
from gis_radar.site.worker import process_pool, thread_pool

_POSE = ("easting", "northing", "height", "yaw", "pitch", "roll")


@dataclass(frozen=True, kw_only=True)
class SiteRun:
    """Results of a run of a site.

    Parameters
    ----------
    site : Site
        The site.
    folder : Path
        Folder of the results.
    outcomes : sequence of Outcome
        Outcome of each stage.
    """

    site: Site
    folder: Path
    outcomes: Sequence[Outcome]

    @property
    def outputs(self) -> list[Path]:
        """Results that exist now, as paths below `folder`."""
        root = self.folder.resolve()
        made = [p for each in self.outcomes for p in each.made]
        made = [p.resolve().relative_to(root) for p in made]
        made = [self.folder / p for p in made if STATE not in p.parts]
        return [*made, self.folder / "run.json"]

    @property
    def missing(self) -> dict[str, GisRadarError]:
        """The error of each sensor without a result, or with one of a part of its recordings."""
        return refused_sensors(self.outcomes, self.site.timezone) | {
            each.stage.sensor: each.error
            for each in reversed(self.outcomes)
            if each.stage.sensor and each.error is not None
        }

    @property
    def failure(self) -> GisRadarError | None:
        """Error about the sensors that are missing, in whole or in part; None if there are none.

        It is an :class:`InputError` if any data are bad, else a :class:`NoAnswerError`: there is no
        trustworthy answer.
        """
        missing = self.missing
        if not missing:
            return None
        shown = sensors_in(self.outcomes)
        in_part = sorted(missing.keys() & {*shown})
        lost, others = sorted(missing.keys() - {*shown}), [n for n in shown if n not in missing]
        bad = [name for name, error in missing.items() if not isinstance(error, NoAnswerError)]
        first = (bad or list(missing))[0]
        said = [Text("no result for {}", ", ".join(lost))] if lost else []
        if in_part:
            said.append(Text("of {} only a part is in the heat maps", ", ".join(in_part)))
        elif others:
            said.append(Text("the heat maps show {} only", ", ".join(others)))
        else:
            said.append(Text("there is no heat map"))
        kind = InputError if bad else NoAnswerError
        named = {name: _with_sensor_name(name, error) for name, error in missing.items()}
        whole = Text("; ").join(said)
        return kind(
            "{}; {}", whole, named[first].message, hint=named[first].hint,
            parts=[kind("{}", whole), *named.values()] if len(named) > 1 else (),
        )  # fmt: skip

    def figures(self) -> Mapping[str, Any]:
        """Return key figures by name."""
        by_work = {e.stage.work: e.figures for e in reversed(self.outcomes) if e.has_result}
        doubts = doubts_of(self.outcomes)
        heat, tiles = by_work.get(work.heatmap_stage), by_work.get(work.tiles_stage)
        names = (*_POSE, "fitness", "scan_check", "state")
        sensors = sensors_of(self.outcomes, self.site).items()
        return {
            "site": self.site.title,
            "sensors": {k: {n: facts[n] for n in names if n in facts} for k, facts in sensors},
            "heat_maps_show": sensors_in(self.outcomes) if heat else [],
            **({"tiles": tiles["tiles"]} if tiles else {}),
            **{k: value for k, value in (heat or {}).items() if k not in {"sensors", "tiles"}},
            **{
                k: value
                for k, value in (by_work.get(work.measure_stage) or {}).items()
                if k in {"vehicles", "heavy", "passages"}
            },
            **({"not_known_to_fit": [*doubts.values()]} if doubts else {}),
            "warnings": len(warnings_once({e.stage.name: list(e.warnings) for e in self.outcomes})),
            "stages": len(self.outcomes),
            "stages_done_before": sum(each.state == "kept" for each in self.outcomes),
        }

    def __repr__(self) -> str:
        shown = sensors_in(self.outcomes)
        lacking = "".join(
            f"; {'only a part of' if name in shown else 'no result for'} {name}: {why.message}"
            for name, why in self.missing.items()
        )
        return f"SiteRun({self.site!r}, {len(self.outcomes)} stages, {self.folder}{lacking})"

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

    Stages done by an earlier run into the same folder are not done again, unless their inputs,
    their settings or the software have changed. A sensor without a trustworthy answer, or with bad
    data, does not stop the others.

    Parameters
    ----------
    path : str or Path
        The site file, see :func:`read_site`.
    folder : str or Path
        Folder for the results.
    jobs : int, optional
        Number of stages at once; by default as many as the machine has cores and memory for.
    fresh : bool
        Do all stages again, also those that are done.
    reporter : Reporter
        Receives progress and remarks.

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
    with ExitStack() as stack:
        state, scratch = stack.enter_context(opened_run(Path(folder), reporter))
        if fresh:
            state.invalidate()
        _hash_inputs(site, state, reporter)
        _write_record(site, root, (), state, finished=False)
        pool = stack.enter_context(process_pool(jobs or workers_here(), scratch, site.language))
        try:
            execution = Execution(
                stages=stages_of(site, root), state=state, pool=pool, reporter=reporter,
                timezone=site.timezone, folder=site.path.absolute().parent,
            )  # fmt: skip
            drop_removed_stages(state, execution.stages, reporter)
            _write_record(site, root, execution.run(-1), state, finished=False)
            outcomes = execution.run()
        except KeyboardInterrupt:
            reporter.log("stopped; what is done stays done: the same call goes on from there")
            raise
        state.save()
        _write_record(site, root, outcomes, state, finished=True)
    return SiteRun(site=site, folder=Path(folder), outcomes=outcomes)


def do_stages(
    stages: Iterable[Stage], site: Site, folder: Path, state: RunState, *, reporter: Reporter
) -> list[Outcome]:
    """Do stages in this process, those that are missing or out of date; return all outcomes.

    Parameters
    ----------
    stages : iterable of Stage
        The stages.
    site : Site
        The site.
    folder : Path
        Folder for the results, as of :func:`run_site`.
    state : RunState
        State of earlier runs into it, from :func:`opened_run`.
    reporter : Reporter
        Receives progress.

    Raises
    ------
    GisRadarError
        As :func:`run_site`.
    """
    with thread_pool() as pool:
        outcomes = Execution(
            stages=list(stages), state=state, pool=pool,
            reporter=reporter, timezone=site.timezone, folder=site.path.absolute().parent,
        ).run()  # fmt: skip
    state.save()
    _write_record(site, folder.absolute(), outcomes, state, finished=False)
    return outcomes


def prepare_site(
    site: Site, folder: Path, state: RunState, *, reporter: Reporter = QUIET
) -> list[Outcome]:
    """Do the stages before measuring: road, poses, tiles; as :func:`do_stages`."""
    stages = stages_of(site, folder.absolute())
    before = takewhile(lambda stage: stage.work != work.measure_stage, stages)
    return do_stages(before, site, folder, state, reporter=reporter)


@contextmanager
def opened_run(folder: Path, reporter: Reporter) -> Iterator[tuple[RunState, Path]]:
    """Yield the state of earlier runs into a folder, and an empty folder for temporary files.

    Parameters
    ----------
    folder : Path
        Folder for the results; it is locked in the block. One that holds something else is refused;
        unfinished files of a killed run are removed.
    reporter : Reporter
        Receives a remark where another run is waited for.

    Raises
    ------
    OutputError
        As :func:`run_site`.
    """
    root = folder.absolute()
    state = root / STATE
    with output_errors(root):
        if root.is_dir() and not state.is_dir():
            refuse_foreign(root, OWNED_BY_RUN)
        state.mkdir(parents=True, exist_ok=True)
        (state / ".gitignore").write_text("*\n", encoding="utf-8")
    scratch = state / "scratch"
    with only_writer(folder, lock=state / "lock", reporter=reporter):
        clear_leftovers(root)
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        try:
            yield RunState(state / "state.json", root), scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def drop_removed_stages(state: RunState, stages: Sequence[Stage], reporter: Reporter) -> None:
    """Drop the records of stages that the site no longer has, and remove their results.

    Parameters
    ----------
    state : RunState
        State of earlier runs.
    stages : sequence of Stage
        Stages of the site; their outputs stay.
    reporter : Reporter
        Receives a line for each stage that had results.
    """
    names = {stage.name for stage in stages}
    made = {path for stage in stages for path in stage.outputs}
    for name in sorted(state.records.keys() - names):
        outputs = [path for path in state.drop(name) if path not in made]
        discard(outputs)
        if outputs:
            reporter.log(Text("{}: no longer part of the site, its results were removed", name))


def _hash_inputs(site: Site, state: RunState, reporter: Reporter) -> None:
    """Hash the inputs of a run, with progress; known hashes of unchanged files take no time."""
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
    """Write `run.json`.

    It holds neither times nor durations, so that a resumed run writes the same as any other. The
    report reads the record of the stages before it.
    """
    base = site.path.parent.resolve()
    document = {
        "finished": finished,
        "site": site.model_dump(),
        "sensors_in_heat_maps": sensors_in(outcomes),
        "inputs": {_relative(p, base): state.hash_of(p) for p in (site.path, *site.inputs)},
        "software": software(),
        "stages": [_stage_record(each, base, root) for each in outcomes],
    }
    write_json(root / "run.json", with_texts(document), default=lambda path: _relative(path, base))


def _with_sensor_name(name: str, error: GisRadarError) -> GisRadarError:
    """Return the error of a sensor without a result, with the sensor's name."""
    if error.message.names(name):
        return error
    return type(error)("{}: {}", name, error.message, hint=error.hint)


def _stage_record(outcome: Outcome, base: Path, root: Path) -> dict[str, Any]:
    """Return the entry of a stage in `run.json`."""
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
    absolute = path.resolve()
    for base in bases:
        if absolute.is_relative_to(base.resolve()):
            return absolute.relative_to(base.resolve()).as_posix()
    return str(absolute)


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
        name: error for each in measured for name, error in work.refusals_of(each, timezone).items()
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
            facts.setdefault("state", each.error.message.without(each.stage.sensor))
        elif each.stage.work in {work.localize_stage, work.pose_stage, work.tied_pose_stage}:
            # figures of the localization come first; the pose in use replaces them
            found[each.stage.sensor] = {**facts, **each.figures}
    for name, error in refused_sensors(outcomes, site.timezone).items():
        found[name]["state"] = error.message.without(name)
    for name, doubt in doubts_of(outcomes).items():
        found[name]["state"] = Text(doubt).without(name)
    return {name: {"state": "ok"} | facts for name, facts in found.items()}

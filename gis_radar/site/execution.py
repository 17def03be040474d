"""The execution of stages: in order of need, several at once, none that is done already."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gis_radar.errors import GisRadarError, NoAnswerError, OutputError
from gis_radar.progress import Reporter
from gis_radar.qgis.project import was_edited
from gis_radar.site.contents import Contents, Stamp, stamp_of
from gis_radar.site.records import KINDS, Record, Records, key_of
from gis_radar.site.software import software
from gis_radar.site.stage import Outcome, Stage, State
from gis_radar.site.workers import Event, Workers

ALL = "all stages"


@dataclass(kw_only=True)
class _Begun:
    """A stage that is being done."""

    key: str
    stamps: dict[Path, Stamp]
    since: float
    phases: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(kw_only=True)
class Execution:
    """The stages of a run on their way.

    Parameters
    ----------
    stages : sequence of Stage
        Each after those that it needs.
    root : Path
        The folder of the run.
    records : Records
        Of earlier runs; this one adds its own.
    contents : Contents
        What the files hold.
    workers : Workers
        Who does the work.
    reporter : Reporter
        Hears how it goes: a bar for each stage, and one for all.
    """

    stages: Sequence[Stage]
    root: Path
    records: Records
    contents: Contents
    workers: Workers
    reporter: Reporter
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _begun: dict[str, _Begun] = field(default_factory=dict)
    _said: set[str] = field(default_factory=set)

    def run(self, before: Sequence[Outcome] = ()) -> list[Outcome]:
        """Do all stages but those that have ended `before`; return how each ended, in their order.

        Raises
        ------
        GisRadarError
            What went wrong with a stage that all depends on, or with writing.
        """
        self.outcomes.update({each.stage.name: each for each in before})
        self.reporter.progress(ALL, len(self.outcomes), len(self.stages))
        try:
            self._go_on()
            for stage, event in self.workers.events():
                if event["event"] in {"done", "error", "crash", "gone"}:
                    self._settle(self._ended(stage, event))
                    self._go_on()
                else:
                    self._relay(stage, event)
        finally:
            self.workers.stop()
        return [self.outcomes[stage.name] for stage in self.stages]

    def _go_on(self) -> None:
        """Settle what needs no work, and start what can start."""
        moved = True
        while moved:
            moved = False
            for stage in self.stages:
                if stage.name in self.outcomes or stage.name in self._begun:
                    continue
                if not self._is_ready(stage):
                    continue
                outcome = self._without_work(stage)
                if outcome is not None:
                    self._settle(outcome)
                    moved = True
                elif self.workers.free:
                    self._start(stage)
        # While the first stage is at work, the others get up.
        waiting = len(self.stages) - len(self.outcomes)
        if self.workers.busy:
            self.workers.warm_up(waiting)

    def _is_ready(self, stage: Stage) -> bool:
        return all(
            other.name in self.outcomes
            for other in self.stages
            if set(other.outputs) & set(stage.reads)
        )

    def _without_work(self, stage: Stage) -> Outcome | None:
        """Return the outcome of a stage that cannot be done, or need not be done again."""
        lacking = self._lacking(stage)
        if lacking is not None:
            return Outcome(stage=stage, state="skipped", error=lacking)
        key = key_of(stage, software(), self.contents, self.root)
        record = self.records.standing(stage, key, self.contents)
        return None if record is None else record.outcome(stage)

    def _lacking(self, stage: Stage) -> GisRadarError | None:
        """Return why a stage cannot be done: what happened to a stage that it needs."""
        made = {path: each for each in self.outcomes.values() for path in each.stage.outputs}
        for paths in stage.inputs.values():
            for path in paths:
                if path in made and not made[path].has_result:
                    return made[path].error
        for paths in stage.parts.values():
            if not any(made[path].has_result for path in paths):
                return made[paths[0]].error
        return None

    def _start(self, stage: Stage) -> None:
        stamps = {path: stamp_of(path) for path in stage.reads if path.is_file()}
        key = key_of(stage, software(), self.contents, self.root)
        self._begun[stage.name] = _Begun(key=key, stamps=stamps, since=time.monotonic())
        self.workers.start(stage)
        self.reporter.progress(stage.name, 0, 100)

    def _relay(self, stage: Stage, event: Event) -> None:
        """Pass on what a worker says."""
        begun = self._begun[stage.name]
        if event["event"] == "log":
            if event["level"] == "warning":
                begun.warnings.append(event["message"])
            if event["message"] not in self._said:  # each stage that reads the map tells of it
                self._said.add(event["message"])
                self.reporter.log(f"{stage.name}: {event['message']}", event["level"])
            return
        if event["phase"] not in begun.phases:
            begun.phases.append(event["phase"])
        share = event["done"] / event["total"] if event["total"] else 0.0
        past = begun.phases.index(event["phase"]) + min(share, 1.0)
        self.reporter.progress(stage.name, min(int(100 * past / stage.phases), 99), 100)

    def _ended(self, stage: Stage, event: Event) -> Outcome:
        """Return how a stage ended, and keep a record of what need not be done again."""
        begun = self._begun.pop(stage.name)
        if event["event"] == "crash":
            raise RuntimeError(f"{stage.name}: fault in gis_radar\n{event['trace']}")
        error = None if event["event"] == "done" else _error(stage, event)
        outcome = Outcome(
            stage=stage,
            state=_state(error),
            figures=event.get("figures", {}),
            warnings=tuple(begun.warnings),
            error=error,
            seconds=round(time.monotonic() - begun.since, 2),
        )
        if outcome.state in {"done", "refused"} and self._unchanged(stage, begun):
            self._keep(outcome, begun.key)
        return outcome

    def _unchanged(self, stage: Stage, begun: _Begun) -> bool:
        """Tell whether the inputs are still those that the key speaks of."""
        for path, stamp in begun.stamps.items():
            if not path.exists() or stamp_of(path) != stamp:
                self.reporter.log(
                    f"{stage.name}: {path} has changed meanwhile: run again", "warning"
                )
                return False
        return True

    def _keep(self, outcome: Outcome, key: str) -> None:
        stage, error = outcome.stage, outcome.error
        record = Record(
            name=stage.name,
            key=key,
            outputs={} if error else self.records.held(stage, self.contents),
            figures=outcome.figures,
            warnings=outcome.warnings,
            refusal={"message": error.message, "hint": error.hint} if error else None,
            seconds=outcome.seconds,
        )
        self.records.write(record)
        self.contents.save()

    def _settle(self, outcome: Outcome) -> None:
        stage = outcome.stage
        self.outcomes[stage.name] = outcome
        if not outcome.has_result:
            # What an earlier run left would look like an answer of this one.
            discard(stage.outputs)
        if outcome.error is not None and outcome.state != "skipped":
            if not stage.sensor:
                raise outcome.error
            self.reporter.log(f"{stage.name}: {outcome.error.message}", "warning")
        if outcome.state != "skipped":
            self.reporter.progress(stage.name, 100, 100)
        self.reporter.progress(ALL, len(self.outcomes), len(self.stages))


def discard(paths: Sequence[Path]) -> None:
    """Remove results that hold no longer, files or folders, and folders that are left empty.

    A QGIS project that somebody has edited is not ours any more and stays.
    """
    for path in paths:
        if path.suffix == ".qgz" and was_edited(path):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        if path.parent.is_dir() and not any(path.parent.iterdir()):
            path.parent.rmdir()


def _state(error: GisRadarError | None) -> State:
    if error is None:
        return "done"
    return "refused" if isinstance(error, NoAnswerError) else "failed"


def _error(stage: Stage, event: dict[str, Any]) -> GisRadarError:
    if event["event"] == "gone":
        code = event["code"]
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise GisRadarError(
            f"{stage.name}: its process ended with {how}",
            hint="if memory ran out, use fewer at once: --jobs 1",
        )
    error = KINDS[event["kind"]](event["message"], hint=event["hint"])
    if isinstance(error, OutputError):
        raise error  # no other stage could write either
    return error

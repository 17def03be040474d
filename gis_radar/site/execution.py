"""The execution of stages: in order of need, several at once, none that is done already."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from pathlib import Path

from gis_radar.errors import GisRadarError, NoAnswerError, OutputError
from gis_radar.progress import Reporter
from gis_radar.qgis.project import was_edited
from gis_radar.site.plan import Ending, Outcome, Stage
from gis_radar.site.state import RunState, Stamp, stamp_of
from gis_radar.site.worker import Answer, Event, Pool, carry_out

ALL = "all stages"
_POLL_S = 0.1  # how late a bar may move


@dataclass(kw_only=True)
class _Begun:
    """A stage that is being done."""

    stage: Stage
    key: str
    stamps: dict[Path, Stamp]
    since: float
    phases: list[str] = field(default_factory=list)


@dataclass(kw_only=True)
class Execution:
    """The execution of the stages of a run.

    Parameters
    ----------
    stages : sequence of Stage
        What is to be done; the order follows from what each reads and makes.
    state : RunState
        Of earlier runs; this one adds its own.
    pool : Pool
        Where the work is done.
    reporter : Reporter
        Shows progress: a bar for each stage, and one for all.
    """

    stages: Sequence[Stage]
    state: RunState
    pool: Pool
    reporter: Reporter
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _begun: dict[Future[Answer], _Begun] = field(default_factory=dict)
    _logged: set[str] = field(default_factory=set)

    def run(self, before: Sequence[Outcome] = ()) -> list[Outcome]:
        """Do all stages but those that have ended `before`; return their outcomes in order.

        Raises
        ------
        GisRadarError
            What went wrong with a stage that all depends on, with writing, or with a worker.
        """
        self.outcomes.update({each.stage.name: each for each in before})
        self.reporter.progress(ALL, len(self.outcomes), len(self.stages))
        order = self._order()
        try:
            while order.is_active():
                ready = set(order.get_ready())
                begun = [self._begin(stage) for stage in self.stages if stage.name in ready]
                for outcome in [each for each in begun if each] or self._ended():
                    self._settle(outcome)
                    order.done(outcome.stage.name)
        except BrokenExecutor as error:
            raise self._crash() from error
        return [self.outcomes[stage.name] for stage in self.stages]

    def _order(self) -> TopologicalSorter[str]:
        """Return the order of the stages that have not ended."""
        left = [stage for stage in self.stages if stage.name not in self.outcomes]
        order = TopologicalSorter(
            {
                stage.name: [other.name for other in left if set(other.outputs) & set(stage.reads)]
                for stage in left
            }
        )
        order.prepare()
        return order

    def _begin(self, stage: Stage) -> Outcome | None:
        """Begin a stage, or return its outcome if it cannot be done or need not be done again."""
        lacking = self._lacking(stage)
        if lacking is not None:
            return Outcome(stage=stage, state="skipped", error=lacking)
        key = self.state.key_of(stage)
        if (kept := self.state.kept(stage, key)) is not None:
            return kept
        begun = _Begun(
            stage=stage,
            key=key,
            stamps={path: stamp_of(path) for path in stage.reads if path.is_file()},
            since=time.monotonic(),
        )
        future = self.pool.executor.submit(
            carry_out, stage.name, stage.work, stage.arguments, stage.outputs, self.pool.send
        )
        self._begun[future] = begun
        self.reporter.progress(stage.name, 0, 100)
        return None

    def _lacking(self, stage: Stage) -> GisRadarError | None:
        """Return why a stage cannot be done: the error of a stage that it needs."""
        made = {path: each for each in self.outcomes.values() for path in each.stage.outputs}
        for path in stage.needs:
            if path in made and not made[path].has_result:
                return made[path].error
        for paths in stage.parts.values():
            if not any(made[path].has_result for path in paths):
                return made[paths[0]].error
        return None

    def _ended(self) -> Iterator[Outcome]:
        """Wait for a moment, pass events on, and yield the outcomes of stages that have ended."""
        done, _ = wait(self._begun, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        while not self.pool.events.empty():
            self._relay(self.pool.events.get())
        for future in done:
            answer = future.result()
            yield self._outcome(self._begun.pop(future), answer)

    def _crash(self) -> GisRadarError:
        """Return the error of a worker that ended in the midst of its work."""
        names = ", ".join(each.stage.name for each in self._begun.values())
        return GisRadarError(
            f"{names}: a worker process ended{self.pool.why_broken()}",
            hint="if memory ran out, use fewer at once: --jobs 1",
        )

    def _relay(self, event: Event) -> None:
        """Pass on progress and remarks of a stage."""
        begun = next((b for b in self._begun.values() if b.stage.name == event["stage"]), None)
        if "message" in event:
            if event["message"] not in self._logged:  # each stage that reads the map repeats it
                self._logged.add(event["message"])
                self.reporter.log(f"{event['stage']}: {event['message']}", event["level"])
        elif begun is not None:
            if event["phase"] not in begun.phases:
                begun.phases.append(event["phase"])
            share = event["done"] / event["total"] if event["total"] else 0.0
            past = begun.phases.index(event["phase"]) + min(share, 1.0)
            percent = min(int(100 * past / begun.stage.phases), 99)
            self.reporter.progress(begun.stage.name, percent, 100)

    def _outcome(self, begun: _Begun, answer: Answer) -> Outcome:
        """Return how a stage ended, and record what need not be done again."""
        stage, error = begun.stage, answer.error
        if answer.fault:
            raise RuntimeError(f"{stage.name}: fault in gis_radar\n{answer.fault}")
        if isinstance(error, OutputError):
            raise error  # no other stage could write either
        failed: Ending = "refused" if isinstance(error, NoAnswerError) else "failed"
        outcome = Outcome(
            stage=stage,
            state=failed if error else "done",
            figures=answer.figures,
            warnings=tuple(answer.warnings),
            error=error,
            seconds=round(time.monotonic() - begun.since, 2),
        )
        if outcome.state != "failed" and self._unchanged(begun):
            self.state.keep(outcome, begun.key)
        return outcome

    def _unchanged(self, begun: _Begun) -> bool:
        """Return whether the inputs are still those of the key."""
        for path, stamp in begun.stamps.items():
            if not path.exists() or stamp_of(path) != stamp:
                self.reporter.log(
                    f"{begun.stage.name}: {path} has changed meanwhile: run again", "warning"
                )
                return False
        return True

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

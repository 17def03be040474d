"""Execute the stages of a run: in their order, several at once, and none that is done already."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from gis_radar import base, products
from gis_radar.base import (
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    Reporter,
    Text,
    atomic_write,
    restored,
    with_texts,
)
from gis_radar.dataset import STATED_LANES
from gis_radar.site.messages import error_in_site_words, in_site_words
from gis_radar.site.plan import Ending, Outcome, Stage
from gis_radar.site.versions import software
from gis_radar.site.worker import Event, Pool, carry_out

ALL = Text("all stages")
HASH_LENGTH = 32  # characters of the hash of a file

_POLL_S = 0.1  # longest delay of a bar
_CHUNK = 1 << 20  # bytes
_SETTLED_S = 2.0  # resolution of file times: a younger file may change without a new time
# Of files that are no part of a folder: those of viewers, and the names of a dataset's lanes, which
# have a stage of their own.
_NOT_HASHED = ("-wal", "-shm", "-journal", ".aux.xml", ".qmd", STATED_LANES)

Stamp = tuple[int, int, int, int]


@dataclass(kw_only=True)
class _RunningStage:
    """A stage that has been submitted to the pool."""

    stage: Stage
    key: str
    since: float
    at_work: bool = False
    percent: int = 0
    phases: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(kw_only=True)
class Execution:
    """The execution of the stages of a run.

    Parameters
    ----------
    stages : list of Stage
        The stages; their order follows from the files that each reads and makes.
    state : RunState
        Records of earlier runs, to which this one adds its own.
    pool : Pool
        The workers.
    reporter : Reporter
        Receives progress: of each stage, and of all.
    timezone : str
        Time zone of the site, for times in messages.
    folder : Path, optional
        Folder of the site: messages name its files relative to it.
    """

    stages: list[Stage]
    state: RunState
    pool: Pool
    reporter: Reporter
    timezone: str = "UTC"
    folder: Path | None = None
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    _running: dict[Future[Mapping[str, Any]], _RunningStage] = field(default_factory=dict)
    _logged: set[str] = field(default_factory=set)

    def run(self, last: int | None = None) -> list[Outcome]:
        """Do the stages that have not ended; return the outcomes in order.

        Parameters
        ----------
        last : int, optional
            Index of the first stage that is left out; by default all are done.

        Raises
        ------
        GisRadarError
            If a stage that all others depend on fails, a result cannot be written, or a worker
            ends.
        """
        stages = self.stages[:last]
        self.reporter.progress(ALL, len(self.outcomes), len(self.stages))
        order = self._order(stages)
        try:
            while order.is_active():
                ready = set(order.get_ready())
                begun = [self._begin(stage) for stage in stages if stage.name in ready]
                for outcome in [each for each in begun if each] or self._wait_for_outcomes():
                    self._take_outcome(outcome)
                    order.done(outcome.stage.name)
        except BrokenExecutor as error:
            raise self._worker_error() from error
        return [self.outcomes[stage.name] for stage in stages]

    def _order(self, stages: Sequence[Stage]) -> TopologicalSorter[str]:
        """Return the order of the stages that have not ended."""
        left = [stage for stage in stages if stage.name not in self.outcomes]
        makers = {path: stage.name for stage in left for path in stage.outputs}
        order = TopologicalSorter(
            {stage.name: [makers[p] for p in stage.reads if p in makers] for stage in left}
        )
        order.prepare()
        return order

    def _begin(self, stage: Stage) -> Outcome | None:
        """Begin a stage, or return its outcome if it cannot be done or need not be done again."""
        missing = self._missing_input_error(stage)
        if missing is not None:
            return Outcome(stage=stage, state="skipped", error=missing)
        if (unchanged := self.state.recorded_outcome(stage)) is not None:
            return unchanged
        key = self.state.key_of(stage)
        future = self.pool.executor.submit(
            carry_out, stage.name, stage.work, stage.arguments, stage.outputs, self.pool.send
        )
        self._running[future] = _RunningStage(stage=stage, key=key, since=time.monotonic())
        self.reporter.progress(stage.name, 0, 100)
        return None

    def _missing_input_error(self, stage: Stage) -> GisRadarError | None:
        """Return the error of a stage that this one needs, or None if it can be done."""
        made = {path: each for each in self.outcomes.values() for path in each.stage.outputs}
        for path in stage.needs:
            if path in made and not made[path].has_result:
                return made[path].error
        for paths in stage.choices:
            ended = [made[path] for path in paths if path in made]
            if ended and not any(each.has_result for each in ended):
                return ended[0].error
        return None

    def _wait_for_outcomes(self) -> Iterator[Outcome]:
        """Wait up to `_POLL_S`, pass events on, and yield outcomes of stages that have ended."""
        done, _ = wait(self._running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        self._relay_events()
        for future in done:
            yield self._outcome(future)

    def _worker_error(self) -> GisRadarError:
        """Return the error for a worker that ended during its work."""
        self._relay_events()
        at_work = [each for each in self._running.values() if each.at_work]
        return GisRadarError(
            "{}: a worker process ended",
            Text(", ").join(each.stage.name for each in at_work or self._running.values()),
            hint="if memory ran out, use fewer at once: --jobs 1",
        )

    def _relay_events(self) -> None:
        """Pass on the events that workers have sent."""
        begun = {each.stage.name: each for each in self._running.values()}
        while not self.pool.events.empty():
            event = self.pool.events.get()
            if (stage := begun.get(event["stage"])) is not None:
                self._relay(event, stage)

    def _relay(self, event: Event, begun: _RunningStage) -> None:
        """Pass on progress or a remark of a stage."""
        if "worker" in event:
            begun.at_work = True
        elif "message" in event:
            message = in_site_words(event["message"], self.timezone, self.folder)
            if event["level"] == "warning":
                begun.warnings.append(message)
            if message not in self._logged:  # each stage that reads the map sends the same
                self._logged.add(message)
                self.reporter.log(Text("{}: {}", event["stage"], message), event["level"])
        else:
            if event["phase"] not in begun.phases:
                begun.phases.append(event["phase"])
            share = event["done"] / event["total"] if event["total"] else 0.0
            past = begun.phases.index(event["phase"]) + min(share, 1.0)
            begun.percent = max(begun.percent, min(int(100 * past / begun.stage.phases), 99))
            self.reporter.progress(begun.stage.name, begun.percent, 100)

    def _outcome(self, future: Future[Mapping[str, Any]]) -> Outcome:
        """Return how a stage ended; record it if it need not be done again."""
        begun = self._running[future]
        figures: Mapping[str, Any] = {}
        state: Ending = "done"
        error: GisRadarError | None = None
        try:
            figures = future.result()
        except OutputError:
            raise  # no other stage could write either
        except GisRadarError as caught:
            error = error_in_site_words(caught, self.timezone, self.folder)
            state = "refused" if isinstance(caught, NoAnswerError) else "failed"
        del self._running[future]
        outcome = Outcome(
            stage=begun.stage,
            state=state,
            figures=figures,
            warnings=tuple(begun.warnings),
            error=error,
            seconds=round(time.monotonic() - begun.since, 2),
        )
        if state != "failed" and self.state.key_of(begun.stage) == begun.key:
            self.state.record(outcome)
        elif state != "failed":
            self.reporter.warn("{}: an input has changed meanwhile: run again", begun.stage.name)
        return outcome

    def _take_outcome(self, outcome: Outcome) -> None:
        """Keep an outcome, and report it; raise its error if all other stages depend on it."""
        stage = outcome.stage
        self.outcomes[stage.name] = outcome
        if not outcome.has_result:
            # Results of an earlier run would look like those of this one.
            discard(stage.outputs)
        if outcome.error is not None and outcome.state != "skipped":
            if not stage.sensor:
                raise outcome.error
            if outcome.error.message not in self._logged:  # two sensors may have the same error
                reason = outcome.error.message.without(stage.sensor)
                self.reporter.warn("{}: {}", stage.name, reason)
            self._logged.add(outcome.error.message)
        if outcome.state != "skipped":
            self.reporter.progress(stage.name, 100, 100)
        self.reporter.progress(ALL, len(self.outcomes), len(self.stages))


def discard(paths: Sequence[Path]) -> None:
    """Remove results that are out of date, files or folders, and folders that are left empty.

    A QGIS project that somebody has edited stays.
    """
    for path in paths:
        if path.suffix == ".qgz" and path.exists() and products.was_edited(path):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        if path.parent.is_dir() and not any(path.parent.iterdir()):
            path.parent.rmdir()


# The state of earlier runs: hashes of files, and records of stages.


# The argument whose file is hashed without these layers: stages only count by its tiles, so names
# of streets may change later.
_TILES_ARGUMENT, _LAYERS_NOT_HASHED = "tile_file", ("lanes", "stop_lines", "problems")


class _Record(BaseModel):
    """A stage that ended, with a result or with a refusal."""

    key: str  # hash of all that its result depends on
    outputs: dict[str, str | None]  # hash of each output; empty for a refusal
    figures: dict[str, Any]
    warnings: tuple[str, ...]
    refusal: tuple[str, str] | None  # message and hint, if there was no trustworthy answer
    parts: tuple[tuple[str, str], ...] = ()  # message and hint of each part of the refusal
    texts: dict[str, Any] = {}  # templates of figures, warnings, refusal and parts
    seconds: float


class _StateFile(BaseModel):
    """Content of the state file: hashes by file, records by stage."""

    model_config = ConfigDict(ser_json_inf_nan="constants")
    files: dict[str, tuple[Stamp, str]] = {}
    packages: dict[str, tuple[str, str]] = {}  # hashes of a GeoPackage's bytes and of its tables
    stages: dict[str, _Record] = {}


class RunState:
    """Hashes of files, valid while size and times stay, and records of the stages of earlier runs.

    Parameters
    ----------
    path : Path
        The state file (JSON); without a readable one, all is done again.
    root : Path
        The folder of the run. Names are relative to it, so it may be moved.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self._path, self._root = path, root
        try:
            state_file = _StateFile.model_validate_json(path.read_bytes())
        except (OSError, ValidationError):
            state_file = _StateFile()
        self._state_file, self._hashes = state_file, state_file.files
        self.records, self._packages = state_file.stages, state_file.packages

    def save(self) -> None:
        """Write the file, whole or not at all."""
        with atomic_write(self._path) as part:
            part.write_text(self._state_file.model_dump_json(), encoding="utf-8")

    def hash_of(self, path: Path, progress: Callable[[int], None] = lambda _: None) -> str | None:
        """Return the hash of a file or a folder; None where it is not there.

        It is the head of the SHA-256 of a file, :data:`HASH_LENGTH` characters.

        Parameters
        ----------
        path : Path
            A file, or a folder, whose files count but for `_NOT_HASHED`.
        progress : callable
            Called with the number of bytes of each chunk that was read.
        """
        if path.is_dir():
            files = (each for each in path.rglob("*") if each.is_file())
            parts = [
                (each.relative_to(path).as_posix(), each)
                for each in files
                if not each.name.endswith(_NOT_HASHED)
            ]
            return _digest([(name, self.hash_of(part, progress)) for name, part in sorted(parts)])
        try:
            stamp = stamp_of(path)
        except OSError:
            return None
        name = str(path.resolve())
        cached = self._hashes.get(name)
        if cached is not None and cached[0] == stamp:
            return cached[1]
        digest = _hash(path, progress)
        if path.suffix.lower() == ".gpkg":
            digest = self._hash_of_tables(path, name, digest)
        if time.time() - stamp[1] / 1e9 > _SETTLED_S:
            self._hashes[name] = (stamp, digest)
        else:
            self._hashes.pop(name, None)
        return digest

    def _hash_of_tables(
        self, path: Path, name: str, of_bytes: str, exclude: Sequence[str] = ()
    ) -> str:
        """Return the hash of a GeoPackage's tables; it takes 15 times as long as that of bytes."""
        if name not in self._packages or self._packages[name][0] != of_bytes:
            self._packages[name] = (of_bytes, base.content_digest(path, exclude) or of_bytes)
        return self._packages[name][1]

    def _hash_for(self, stage: Stage, path: Path) -> str | None:
        """Return the hash of the part of a file that a stage reads."""
        found = self.hash_of(path)
        if found is None or stage.inputs.get(_TILES_ARGUMENT) != path:
            return found
        return self._hash_of_tables(path, f"{path.resolve()}: tiles", found, _LAYERS_NOT_HASHED)

    def key_of(self, stage: Stage) -> str:
        """Return the hash of all that a stage's result depends on; missing inputs are left out."""
        return _digest(
            {
                "work": stage.work.__name__,
                "options": dict(stage.options),
                "software": software(),
                "inputs": [
                    (self._relative_name(p), digest)
                    for p in stage.reads
                    if (digest := self._hash_for(stage, p))
                ],
                "outputs": [self._relative_name(path) for path in stage.outputs],
            }
        )

    def recorded_outcome(self, stage: Stage) -> Outcome | None:
        """Return the recorded outcome of a stage; None if it must be done again."""
        record = self.records.get(stage.name)
        if record is None:
            return None
        if record.key != self.key_of(stage.reading_first(record.figures.get("asked"))):
            return None
        if record.refusal is None and record.outputs != self._output_hashes(stage):
            return None
        names = {"figures", "warnings", "refusal", "parts", "texts"}
        recorded = restored(record.model_dump(include=names))
        error = None
        if recorded["refusal"] is not None:
            message, hint = recorded["refusal"]
            parts = [NoAnswerError(text, hint=advice) for text, advice in recorded["parts"]]
            error = NoAnswerError(message, hint=hint, parts=parts)
        return Outcome(
            stage=stage,
            state="refused" if error else "kept",
            figures=recorded["figures"],
            warnings=recorded["warnings"],
            error=error,
            seconds=record.seconds,
        )

    def record(self, outcome: Outcome) -> None:
        """Record a stage that has ended with a result or a refusal."""
        stage, error = outcome.stage, outcome.error
        document = {
            "figures": dict(outcome.figures),
            "warnings": tuple(outcome.warnings),
            "refusal": (error.message, error.hint) if error else None,
            "parts": [(each.message, each.hint) for each in (error.parts if error else ())],
        }
        self.records[stage.name] = _Record(
            key=self.key_of(stage.reading_first(outcome.figures.get("asked"))),
            outputs={} if error else self._output_hashes(stage),
            seconds=outcome.seconds,
            **with_texts(document),
        )
        self.save()

    def invalidate(self) -> None:
        """Invalidate all records, so that everything is done again."""
        for record in self.records.values():
            record.key = ""

    def drop(self, name: str) -> list[Path]:
        """Drop a record; return its outputs in the folder of the run."""
        paths = [self._root / each for each in self.records.pop(name).outputs]
        return [path for path in paths if path.resolve().is_relative_to(self._root.resolve())]

    def _output_hashes(self, stage: Stage) -> dict[str, str | None]:
        """Return the hash of each output of a stage, by its name."""
        return {self._relative_name(path): self.hash_of(path) for path in stage.outputs}

    def _relative_name(self, path: Path) -> str:
        """Return a path relative to the folder of the run; of a file elsewhere its bare name."""
        inside = path.is_relative_to(self._root)
        return path.relative_to(self._root).as_posix() if inside else path.name


def stamp_of(path: Path) -> Stamp:
    """Return size, times and inode of a file; while these stay, its bytes are taken to stay."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _hash(path: Path, progress: Callable[[int], None]) -> str:
    """Return the hash of a file's bytes."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
                progress(len(chunk))
    except OSError as error:
        raise InputError("{}: cannot be read: {}", path, error.strerror or error) from error
    return digest.hexdigest()[:HASH_LENGTH]


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

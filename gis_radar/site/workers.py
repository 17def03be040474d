"""The workers of a run: started when there is work, gone when the run ends."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, cast

from gis_radar.site.stage import Stage

_PATIENCE_S = 0.7  # from the wish to end to the end of all patience
_MEMORY_EACH = 1 << 30
_LOOK_S = 0.2

WORKS = "gis_radar.site.work"

Event = dict[str, Any]


class Workers:
    """Processes that do stages.

    Parameters
    ----------
    most : int
        How many there may be.
    scratch : Path
        Where their temporary files go.
    works : str
        The module whose `WORKS` they do.
    """

    def __init__(self, most: int, scratch: Path, works: str = WORKS) -> None:
        self._most, self._words = most, (str(scratch), works)
        self._events: queue.SimpleQueue[tuple[_Worker, Event]] = queue.SimpleQueue()
        self._all: list[_Worker] = []

    @property
    def free(self) -> bool:
        """Whether another stage could begin now."""
        return sum(worker.stage is not None for worker in self._all) < self._most

    @property
    def busy(self) -> bool:
        """Whether any stage is being done."""
        return any(worker.stage is not None for worker in self._all)

    def warm_up(self, count: int) -> None:
        """Start workers before there is work for them, as starting takes seconds."""
        while len(self._all) < min(count, self._most):
            self._all.append(_Worker(self._words, self._events))

    def start(self, stage: Stage) -> None:
        """Let a worker do a stage; there must be a free one."""
        self.warm_up(sum(worker.stage is not None for worker in self._all) + 1)
        idle = next(worker for worker in self._all if worker.stage is None)
        idle.start(stage)

    def events(self) -> Iterator[tuple[Stage, Event]]:
        """Yield what workers say about their stages, while any works.

        The last event of a stage is `done`, `error`, `crash` or `gone`.
        """
        while self.busy:
            try:
                # In short waits, as only between them an interruption is noticed everywhere.
                worker, event = self._events.get(timeout=_LOOK_S)
            except queue.Empty:
                continue
            stage = worker.stage
            if event["event"] == "gone":
                self._all.remove(worker)
                event["code"] = worker.kill()
            if event["event"] in {"done", "error", "crash", "gone"}:
                worker.stage = None
            if stage is not None:
                yield stage, event

    def stop(self) -> None:
        """End all workers: first they may clear up, then they and what they started must go."""
        for worker in self._all:
            worker.process.terminate()
        end = time.monotonic() + _PATIENCE_S
        for worker in self._all:
            with suppress(subprocess.TimeoutExpired):
                worker.process.wait(timeout=max(end - time.monotonic(), 0.01))
            worker.kill()
        self._all = []


class _Worker:
    """A process, and the stage it is at."""

    def __init__(
        self, words: tuple[str, str], events: queue.SimpleQueue[tuple[_Worker, Event]]
    ) -> None:
        self.stage: Stage | None = None
        self.process = subprocess.Popen(  # noqa: S603 - this very Python
            [sys.executable, "-P", "-m", "gis_radar.site.worker", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            # It finds what we found, however our path came about.
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            # A Ctrl-C in the terminal is ours to handle, and PDAL goes with its worker.
            start_new_session=True,
        )
        self._tasks = cast("IO[str]", self.process.stdin)
        self._lines = cast("IO[str]", self.process.stdout)
        self._reader = threading.Thread(target=self._read, args=(events,), daemon=True)
        self._reader.start()

    def start(self, stage: Stage) -> None:
        """Send it a stage."""
        self.stage = stage
        lists = {
            **stage.inputs,
            **{
                name: [path for path in paths if path.exists()]
                for name, paths in stage.parts.items()
            },
        }
        task = {
            "work": stage.work,
            "inputs": {name: [str(path) for path in paths] for name, paths in lists.items()},
            "options": dict(stage.options),
            "outputs": [str(path) for path in stage.outputs],
        }
        with suppress(BrokenPipeError):  # its reader tells when it is gone
            self._tasks.write(json.dumps(task) + "\n")
            self._tasks.flush()

    def _read(self, events: queue.SimpleQueue[tuple[_Worker, Event]]) -> None:
        with suppress(ValueError):  # the last words of a killed worker may be cut
            for text in self._lines:
                events.put((self, json.loads(text)))
        events.put((self, {"event": "gone"}))

    def kill(self) -> int:
        """End it and all that it started; return its exit code, negative for a signal."""
        if hasattr(os, "killpg"):
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
        else:
            self.process.kill()
        self.process.wait()
        with suppress(BrokenPipeError):
            self._tasks.close()
        self._reader.join()
        self._lines.close()
        return self.process.returncode


def workers_here() -> int:
    """Return how many workers this machine has cores and memory for."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    memory = _free_memory()
    return cores if memory is None else max(1, min(cores, memory // _MEMORY_EACH))


def _free_memory() -> int | None:
    """Return the bytes that new processes may use; None where the system does not say."""
    group = Path("/sys/fs/cgroup")
    found = []
    with suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        named = dict(line.split(":", 1) for line in lines)
        found.append(int(named["MemAvailable"].split()[0]) * 1024)
    with suppress(OSError, ValueError):
        most = int((group / "memory.max").read_text(encoding="ascii"))
        found.append(most - int((group / "memory.current").read_text(encoding="ascii")))
    return min(found, default=None)

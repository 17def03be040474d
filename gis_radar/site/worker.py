"""Carry out stages in worker processes, and send their progress to the run."""

from __future__ import annotations

import os
import queue
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from types import FrameType
from typing import Any

from gis_radar.base import (
    GisRadarError,
    Level,
    Reporter,
    WorkerPool,
    go_offline,
    set_language,
    system_error,
    watch_parent,
)

_REPORT_S = 0.05  # least time between reports: faster bars are not seen, and cost both ends
_TERMINATED = 128 + signal.SIGTERM  # exit code of a worker that SIGTERM ended

Event = dict[str, Any]
Send = Callable[[Event], None]


class _Sender(Reporter):
    """A receiver that sends progress and remarks of a stage to the run."""

    def __init__(self, stage: str, send: Send) -> None:
        self._stage, self._send = stage, send
        self._last: tuple[str, float] = ("", 0.0)

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Send the progress of a phase of the stage; its first and last value always."""
        now = time.monotonic()
        phase, before = self._last
        if phase != stage or done == total or now - before > _REPORT_S:
            self._last = (stage, now)
            self._send({"stage": self._stage, "phase": stage, "done": done, "total": total})

    def log(self, message: str, level: Level = "info") -> None:
        """Send a remark."""
        self._send({"stage": self._stage, "message": message, "level": level})


def carry_out(
    name: str,
    work: Callable[..., Mapping[str, Any]],
    arguments: Mapping[str, Any],
    outputs: Sequence[Path],
    send: Send,
) -> Mapping[str, Any]:
    """Carry out a stage; return its figures.

    Parameters
    ----------
    name : str
        Name of the stage, for its events.
    work : callable
        A function of a module, so that any executor can send it.
    arguments : mapping
        Its arguments except `outputs` and `reporter`.
    outputs : sequence of Path
        Files and folders that it makes; the folders around them are made here.
    send : callable
        Takes the events to the run, each with its `stage`: the process that begins it (`worker`),
        progress (`phase`, `done`, `total`) and remarks (`message`, `level`).

    Raises
    ------
    GisRadarError
        If there is no result; an OutputError if the operating system refuses something.
    RuntimeError
        For a fault in gis_radar, with its traceback: its class may not pass to another process.
    """
    send({"stage": name, "worker": os.getpid()})
    try:
        for output in outputs:
            output.parent.mkdir(parents=True, exist_ok=True)
        return work(outputs=list(outputs), reporter=_Sender(name, send), **arguments)
    except GisRadarError:
        raise
    except OSError as error:
        raise system_error(error) from error
    except SystemExit:  # raised by _end; unfinished files have been removed
        os._exit(_TERMINATED)
    except Exception as error:
        raise RuntimeError(f"{name}: fault in gis_radar\n{traceback.format_exc()}") from error


@dataclass(frozen=True, kw_only=True)
class Pool:
    """An executor of stages, with a queue of their events for the run.

    Parameters
    ----------
    executor : Executor
        Any executor that can call a function of a module.
    send : callable
        Puts an event into `events`; it is sent to the workers with their tasks.
    events : queue
        Events of all stages, read by the run.
    """

    executor: Executor
    send: Send
    events: SimpleQueue[Event] | queue.SimpleQueue[Event]


@contextmanager
def process_pool(jobs: int, scratch: Path, language: str = "en") -> Iterator[Pool]:
    """Provide worker processes; at the end of the block they and all they started are ended.

    Parameters
    ----------
    jobs : int
        Greatest number of workers.
    scratch : Path
        Folder for their temporary files.
    language : str
        Language of the pictures that they draw.
    """
    context = WorkerContext()
    events: SimpleQueue[Event] = context.SimpleQueue()
    executor = WorkerPool(
        jobs, context=context, initializer=_prepare_worker,
        given=(events, str(scratch), language),
    )  # fmt: skip
    try:
        yield Pool(executor=executor, send=_send, events=events)
    finally:
        executor.stop()
        events.close()


@contextmanager
def thread_pool() -> Iterator[Pool]:
    """Provide a thread of this process, which does one stage after the other."""
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    with ThreadPoolExecutor(1) as executor:
        yield Pool(executor=executor, send=events.put, events=events)


class _Worker(SpawnProcess):
    """A process that does not run the caller's script again, and ignores Ctrl-C."""

    def start(self) -> None:
        """Start the process with `__main__` hidden, and with interruptions blocked in it."""
        main: dict[str, Any] = vars(sys.modules["__main__"])
        shown = {"__spec__": main.get("__spec__"), "__file__": main.pop("__file__", None)}
        main["__spec__"] = None
        if sys.platform != "win32":
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            main.update({name: value for name, value in shown.items() if value is not None})
            if sys.platform != "win32":
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


class WorkerContext(SpawnContext):
    """A context of multiprocessing whose processes do not run the caller's script again."""

    Process = _Worker


_events: SimpleQueue[Event] | None = None  # of this worker


def _prepare_worker(events: SimpleQueue[Event], scratch: str, language: str) -> None:
    """Prepare a worker: it ends with the run, and libraries' output goes to standard error."""
    global _events  # noqa: PLW0603 - an initializer has no other way
    watch_parent()
    go_offline()
    signal.signal(signal.SIGTERM, _raise_exit)
    os.dup2(2, 1)
    tempfile.tempdir = scratch
    set_language(language)
    _events = events


def _send(event: Event) -> None:
    """Send an event to the run, from a worker of :func:`process_pool`."""
    if _events is not None:
        _events.put(event)


def _raise_exit(_signal: int, _frame: FrameType | None) -> None:
    """End the worker; on the way, `SystemExit` has unfinished files removed."""
    raise SystemExit(_TERMINATED)

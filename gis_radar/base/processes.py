"""Child processes that do not outlive their parent, and the parent watchdog of a child.

A process that is killed cannot stop what it started. So a worker leads a process group, which is
stopped as a whole, and watches its parent: it ends itself and its group when the parent is gone.
"""

from __future__ import annotations

import _thread
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import IO

from gis_radar.base.errors import GisRadarError

WATCHDOG_VARIABLE = "GIS_RADAR_PARENT_WATCHDOG"
"""The environment variable that starts the watchdog of a command; its only value is `stdin`."""

_STOPPING = (signal.SIGINT, signal.SIGTERM)
_POLL_S = 0.2  # between two reports of a child that runs
_REAP_POLL_S = 0.001  # between two checks whether another thread has reaped a child
_KILL_WAIT_S = 5.0  # for the end of a killed child: only a disk that does not answer takes longer
_NICENESS_TRIES = 100  # 0.1 s apart: as many workers may begin at once
_STOP_WAIT_S = 0.7  # for a stopped worker to remove its files; it does not end its work

OFFLINE = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",  # of every file system over curl, S3 and the like too
    "GDAL_HTTP_PROXY": "none://none",  # of all other requests: GDAL refuses it before any socket
    "no_proxy": "",
    "NO_PROXY": "",
}
"""Environment variables that keep GDAL, in this process and those it starts, off the network.

A data file can name an address; no command of ours needs one.
"""

_WORKER_BYTES = 1 << 30  # memory of one worker: what localizing a sensor takes, rounded up


def free_address_space() -> int | None:
    """Return how many bytes of address space this process may still take; None without a limit."""
    try:
        import resource  # noqa: PLC0415 - not on Windows

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        pages = int(Path("/proc/self/statm").read_bytes().split()[0])
    except (ImportError, OSError, ValueError, IndexError):
        return None
    return None if limit == resource.RLIM_INFINITY else limit - pages * resource.getpagesize()


def go_offline() -> None:
    """Keep GDAL off the network, in this process and all that it starts (:data:`OFFLINE`)."""
    os.environ.update(OFFLINE)


def run_child(
    command: Sequence[str],
    *,
    stdin: IO[bytes],
    stderr: IO[bytes],
    environment: Mapping[str, str],
    waiting: Callable[[float], object],
) -> int:
    """Run a program to its end; an interruption kills it.

    It stays in the process group of its parent, so that a signal to the group kills it too.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments.
    stdin, stderr : file
        Its standard input, and a file for its messages; its standard output is dropped.
    environment : mapping of str to str
        The environment it is started in.
    waiting : callable
        Called five times a second with the seconds so far.

    Returns
    -------
    int
        Its exit code; negative for a signal.

    Raises
    ------
    GisRadarError
        If it does not start.
    """
    try:
        child = subprocess.Popen(  # noqa: S603 - the caller has found the program
            command, stdin=stdin, stdout=subprocess.DEVNULL, stderr=stderr, env=dict(environment)
        )
    except OSError as error:
        raise GisRadarError("{}: does not start: {}", command[0], error.strerror) from error
    start = time.monotonic()
    try:
        while True:
            try:
                return child.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                waiting(time.monotonic() - start)
    finally:
        child.kill()  # does nothing where it has ended
        # an interrupt within the wait may have left a lock taken, on which this one hangs for ever
        with suppress(subprocess.TimeoutExpired):
            child.wait(_KILL_WAIT_S)


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets; the second one interrupts as always."""
    stop = threading.Event()

    def note(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    # the only thread that signals reach
    on_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, note) for number in _STOPPING} if on_main else {}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def watch_input() -> None:
    """Interrupt this process, as Ctrl+C would, when its standard input is closed.

    Only where the environment asks for it. A program that starts gis-radar as a worker keeps the
    worker's standard input open; closing it, on purpose or by dying, works on every system and
    needs nobody alive to send a signal.
    """
    if os.environ.get(WATCHDOG_VARIABLE) == "stdin":
        # A worker started in the background would ignore the interruption.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _start_watchdog(_wait_for_end_of_input, interrupt_main_thread)


def watch_parent() -> None:
    """End this worker of a process pool, and what it started, when the pool's process is gone.

    For the initializer of a pool: makes the worker the leader of a process group, which leaves
    interruptions from the terminal to the parent (see :func:`stop_workers`). It keeps its niceness.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("only a process of multiprocessing has a parent to watch")
    if sys.platform != "win32" and os.getpgrp() != os.getpid():
        os.setsid()
        _set_session_niceness()
    _start_watchdog(parent.join, _kill_own_group)


def _set_session_niceness() -> None:
    """Give a new session the niceness of its process: Linux shares cores among sessions first."""
    niceness = os.nice(0)
    with suppress(OSError):
        for _ in range(_NICENESS_TRIES if niceness else 0):
            with suppress(BlockingIOError):  # Linux takes ten a second from all processes together
                Path("/proc/self/autogroup").write_text(str(niceness), encoding="ascii")
                return
            time.sleep(0.1)


def stop_workers(workers: Iterable[BaseProcess]) -> None:
    """Stop workers that called :func:`watch_parent`, and all that they started.

    Parameters
    ----------
    workers : iterable of multiprocessing.process.BaseProcess
        Workers of a pool. They get SIGTERM, and are killed with their groups soon after.
    """
    workers = list(workers)
    for worker in workers:
        worker.terminate()
    end = time.monotonic() + _STOP_WAIT_S
    for worker in workers:
        worker.join(max(end - time.monotonic(), 0.01))
        if sys.platform != "win32" and worker.pid is not None:
            with suppress(ProcessLookupError):
                os.killpg(worker.pid, signal.SIGKILL)  # no group: ended before it led one
        worker.kill()
        worker.join()
        end_reaped = time.monotonic() + _KILL_WAIT_S
        while worker.exitcode is None and time.monotonic() < end_reaped:
            time.sleep(_REAP_POLL_S)  # the pool's own thread reaps it: join returned before it did


def workers_here() -> int:
    """Return how many workers this machine has cores and memory for."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    memory = free_memory()
    return cores if memory is None else max(1, min(cores, memory // _WORKER_BYTES))


def free_memory() -> int | None:
    """Return the memory that new processes may use.

    Returns
    -------
    int or None
        Bytes free on the machine or in its control group, whichever is less; None if unknown.
    """
    cgroup = Path("/sys/fs/cgroup")
    limits = []
    with suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        by_name = dict(line.split(":", 1) for line in lines)
        limits.append(int(by_name["MemAvailable"].split()[0]) * 1024)
    with suppress(OSError, ValueError):
        most = int((cgroup / "memory.max").read_text(encoding="ascii"))
        limits.append(most - int((cgroup / "memory.current").read_text(encoding="ascii")))
    return min(limits, default=None)


def _start_watchdog(wait: Callable[[], object], end: Callable[[], object]) -> None:
    def watch() -> None:
        wait()
        end()

    threading.Thread(target=watch, daemon=True, name="parent watchdog").start()


def _wait_for_end_of_input() -> None:
    """Wait on descriptor 0 itself; a reader of :mod:`io` would hold a lock at exit."""
    with suppress(OSError):  # a closed descriptor is the end, too
        while os.read(0, 1024):
            pass


def interrupt_main_thread() -> None:
    """Interrupt the main thread; where the system has signals, during a system call too."""
    if sys.platform == "win32":
        _thread.interrupt_main()
    elif (main := threading.main_thread().ident) is not None:
        signal.pthread_kill(main, signal.SIGINT)


def _kill_own_group() -> None:
    if sys.platform != "win32":
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)

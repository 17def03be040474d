"""Run gis_radar in another Python and read what it writes; needs no QGIS.

The worker writes JSON lines to standard output. It is cancelled by closing its standard input,
which also happens when QGIS dies; what does not stop within a grace time is killed with all that
it started. This is a runner of its own because QGIS's Python has no gis_radar to import one from.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess  # nosec B404
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from .words import tr

GRACE_S = 3.0
NO_WINDOW: int = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # on Windows a program opens one
_POLL_S = 0.1
_LAST_LINES_S = 1.0
_LAST_LINES = 20
# Variables that QGIS sets for itself, and that make another Python load wrong libraries.
_FOREIGN = (
    "PYTHONHOME", "PYTHONPATH", "PYTHONEXECUTABLE", "PYTHONSTARTUP", "PYTHONUSERBASE",
    "PROJ_DATA", "PROJ_LIB", "GDAL_DATA", "GDAL_DRIVER_PATH", "GDAL_FILENAME_IS_UTF8",
    "LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES",
    "QT_PLUGIN_PATH", "QGIS_PREFIX_PATH", "VIRTUAL_ENV",
)  # fmt: skip

Event = dict[str, Any]


class WorkerError(Exception):
    """What went wrong, in one sentence for the user.

    Parameters
    ----------
    text : str
        A text of the plugin, which is translated; the worker's own is so already.
    **values
        Values for the placeholders of the text.

    Attributes
    ----------
    summary : dict
        Figures that the worker reported before the error.
    """

    def __init__(self, text: str, **values: Any) -> None:
        super().__init__(tr(text).format(**values) if values else tr(text))
        self.summary: dict[str, Any] = {}


class NoWorkerError(WorkerError):
    """There is no worker yet."""


class CancelledError(Exception):
    """The user stopped the work."""


@dataclass(frozen=True)
class Answer:
    """What the worker did.

    `outputs` are the files and folders it wrote, `summary` its figures by name, `local` these with
    times by the clocks of the site, where they differ.
    """

    outputs: list[str]
    summary: dict[str, Any] = field(default_factory=dict)
    local: dict[str, Any] = field(default_factory=dict)


class Listener:
    """A receiver of what a worker reports; this one ignores it."""

    def progress(self, stage: str, done: float, total: float | None) -> None:
        """Take how far a stage is."""

    def log(self, message: str, level: str) -> None:
        """Take a remark; the level is `info` or `warning`."""

    def cancelled(self) -> bool:
        """Return whether to stop."""
        return False


def clean_environment(around: Mapping[str, str]) -> dict[str, str]:
    """Return the environment for the worker: without what is meant for QGIS's own libraries."""
    kept = {name: value for name, value in around.items() if name not in _FOREIGN}
    return kept | {
        "GIS_RADAR_PARENT_WATCHDOG": "stdin",
        "PYTHONUTF8": "1",
        "PYTHONIOENCODING": "utf-8",
    }


def run_worker(
    python: str, words: Sequence[str], listener: Listener, *, grace_s: float = GRACE_S
) -> Answer:
    """Run one command of gis_radar.

    Parameters
    ----------
    python : str
        The worker's Python.
    words : sequence of str
        The command and its options.
    listener : Listener
        Takes progress and remarks, and is asked whether to stop.
    grace_s : float
        How long a cancelled worker may take to end.

    Raises
    ------
    CancelledError
        If the listener wanted to stop.
    WorkerError
        If the worker reports why it failed, does not start, or dies.
    """
    command = [python, "-P", "-m", "gis_radar", *words, "--json"]
    end: list[Event] = []

    def on_line(line: str) -> None:
        event = _event(line)
        kind = event.get("event")
        if kind == "progress":
            total = event.get("total")
            listener.progress(str(event.get("stage", "")), event.get("done") or 0, total)
        elif kind == "log":
            listener.log(str(event.get("message", "")), str(event.get("level", "info")))
        elif kind in ("result", "error"):
            end.append(event)

    code, last_errors = run_command(command, on_line, listener.cancelled, grace_s=grace_s)
    if end and end[-1]["event"] == "error":
        error = WorkerError(_sentence(end[-1]))
        error.summary = dict(end[0].get("summary", {}))
        raise error
    if code != 0 or not end:
        raise WorkerError(_unexpected_end(code, last_errors))
    figures = (dict(end[-1].get(name, {})) for name in ("summary", "local"))
    return Answer(list(end[-1].get("outputs", [])), *figures)


def run_command(
    command: Sequence[str],
    on_line: Callable[[str], None],
    cancelled: Callable[[], bool],
    *,
    grace_s: float = GRACE_S,
    merged: bool = False,
) -> tuple[int, list[str]]:
    """Run a program and hand on each line that it prints.

    Parameters
    ----------
    command : sequence of str
        The program and its words.
    on_line : callable
        Gets each line of its standard output, in the caller's thread.
    cancelled : callable
        Asked about ten times a second whether to stop.
    grace_s : float
        How long a cancelled program may take to end.
    merged : bool
        Whether its standard error is read, too.

    Returns
    -------
    code : int
        Its exit code; below 0 the signal that ended it.
    last_errors : list of str
        The last lines of its standard error.

    Raises
    ------
    CancelledError
        If `cancelled` returned true; the program has ended then.
    WorkerError
        If the program does not start.
    """
    process = _start(command, subprocess.STDOUT if merged else subprocess.PIPE)
    lines: queue.Queue[str | None] = queue.Queue()
    last_errors: deque[str | None] = deque(maxlen=_LAST_LINES)
    readers = [
        threading.Thread(target=_read, args=(stream, put), daemon=True)
        for stream, put in ((process.stdout, lines.put), (process.stderr, last_errors.append))
        if stream is not None
    ]
    for reader in readers:
        reader.start()
    try:
        _read_lines(process, lines, on_line, cancelled)
    except BaseException:
        _stop(process, grace_s)
        raise
    code = process.wait()
    readers[-1].join(timeout=_LAST_LINES_S)
    if process.stdin is not None:
        process.stdin.close()
    return code, [line.strip() for line in last_errors if line and line.strip()]


def _start(command: Sequence[str], errors: int) -> subprocess.Popen[str]:
    group: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        group = {"creationflags": NO_WINDOW}
    try:
        return subprocess.Popen(  # noqa: S603  # nosec B603
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            encoding="utf-8",
            errors="replace",
            env=clean_environment(os.environ),
            cwd=tempfile.gettempdir(),
            **group,
        )
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise WorkerError(
            "{program} does not start: {reason}.", program=command[0], reason=reason
        ) from error


def _read(stream: IO[str], put: Callable[[str | None], None]) -> None:
    """Hand on the lines of a stream, then None; whoever reads it closes it."""
    with stream:
        for line in stream:
            put(line)
    put(None)


def _read_lines(
    process: subprocess.Popen[str],
    lines: queue.Queue[str | None],
    on_line: Callable[[str], None],
    cancelled: Callable[[], bool],
) -> None:
    """Hand on lines until there are no more; ask now and then whether to stop."""
    asked = 0.0
    while True:
        # Lines may come without a pause, so the question does not wait for one.
        if time.monotonic() - asked > _POLL_S:
            asked = time.monotonic()
            if cancelled():
                raise CancelledError
        # After its end its last lines may still be on their way, or never end: what the program
        # has started may hold its output open.
        ended = process.poll() is not None
        try:
            line = lines.get(timeout=_LAST_LINES_S if ended else _POLL_S)
        except queue.Empty:
            if ended:
                return
            continue
        if line is None:
            return
        on_line(line)


def _stop(process: subprocess.Popen[str], grace_s: float) -> None:
    """Ask the program to end; kill it and its children if it stays."""
    try:
        if process.stdin is not None:
            process.stdin.close()
    except OSError:
        process.terminate()
    try:
        process.wait(timeout=grace_s)
    except subprocess.TimeoutExpired:
        _kill(process)
        process.wait()


def _kill(process: subprocess.Popen[str]) -> None:
    if sys.platform == "win32":
        words = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
        subprocess.run(  # noqa: S603  # nosec B603
            words, capture_output=True, check=False, creationflags=NO_WINDOW
        )
        process.kill()
        return
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        process.kill()


def _event(line: str) -> Event:
    """Return a line as an event; a line that is no event becomes a remark."""
    try:
        event = json.loads(line)
    except ValueError:
        event = None
    if not isinstance(event, dict):
        return {"event": "log", "level": "info", "message": line.strip()} if line.strip() else {}
    return event


def _sentence(error: Event) -> str:
    """Return the worker's error as one sentence, with what to do about it."""
    message = " ".join(str(error.get("message") or tr("the worker failed")).split())
    hint = " ".join(str(error.get("hint") or "").split())
    return f"{message} ({hint})" if hint else message


def _unexpected_end(code: int, last_errors: Sequence[str]) -> str:
    """Describe how a worker ended that reported nothing itself."""
    if code < 0:
        how = tr("it was ended by {signal}").format(signal=_signal_name(-code))
    elif code == 0:
        how = tr("it ended without a result")
    else:
        how = tr("it ended with code {code}").format(code=code)
    reason = f": {last_errors[-1]}" if last_errors else ""
    return tr("The worker stopped unexpectedly, {how}").format(how=how) + reason


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"

"""A worker: a process that does stages one after another and tells how it goes.

It reads tasks and writes events, a JSON object a line. It ends when its standard input does: with
the run that started it, however that ends.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import signal
import sys
import tempfile
import threading
import traceback
from pathlib import Path
from types import FrameType
from typing import IO, Any

from gis_radar.errors import GisRadarError, OutputError
from gis_radar.progress import Level, Reporter


class Voice(Reporter):
    """Tells the run how a stage goes."""

    def __init__(self, line: IO[str]) -> None:
        self._line = line

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Say how far a part of the stage is."""
        self.say(event="progress", phase=stage, done=done, total=total)

    def log(self, message: str, level: Level = "info") -> None:
        """Say a remark."""
        self.say(event="log", level=level, message=message)

    def say(self, **event: Any) -> None:
        """Write an event."""
        self._line.write(json.dumps(event) + "\n")
        self._line.flush()


def main() -> None:
    """Do what standard input asks for, until it ends."""
    signal.signal(signal.SIGTERM, _interrupt)
    tempfile.tempdir = sys.argv[1]
    voice = Voice(_private_output())
    tasks: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()
    try:
        works = importlib.import_module(sys.argv[2]).WORKS  # takes seconds; meanwhile tasks wait
        while True:
            _do(works, tasks.get(), voice)
    except (KeyboardInterrupt, BrokenPipeError):
        os._exit(1)


def _private_output() -> IO[str]:
    """Return standard output, which from now on is no place for what libraries print."""
    line = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return line


def _listen(tasks: queue.SimpleQueue[dict[str, Any]]) -> None:
    for line in sys.stdin:
        tasks.put(json.loads(line))
    # Nobody waits for the work any more; what it started goes with it.
    if hasattr(os, "killpg"):
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)


def _do(works: dict[str, Any], task: dict[str, Any], voice: Voice) -> None:
    inputs = {name: [Path(path) for path in paths] for name, paths in task["inputs"].items()}
    outputs = [Path(path) for path in task["outputs"]]
    try:
        for output in outputs:
            output.parent.mkdir(parents=True, exist_ok=True)
        figures = works[task["work"]](outputs=outputs, reporter=voice, **inputs, **task["options"])
        voice.say(event="done", figures=figures)
    except GisRadarError as error:
        _fail(voice, error)
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(voice, OutputError(f"{where}{error.strerror or error}"))
    except Exception:  # noqa: BLE001 - told to the run, which raises it
        voice.say(event="crash", trace=traceback.format_exc())


def _fail(voice: Voice, error: GisRadarError) -> None:
    kind = type(error)
    named = next(each.__name__ for each in kind.__mro__ if each.__module__ == "gis_radar.errors")
    voice.say(event="error", kind=named, message=error.message, hint=error.hint)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()

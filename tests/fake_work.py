"""Work of fake stages: it joins texts, and misbehaves on purpose."""

import os
import signal
import sys
import time
from pathlib import Path

from gis_radar.base import InputError, NoAnswerError, OutputError, atomic_write


def join(*, outputs, reporter, text="", wait_s=0.0, **inputs):
    """Write the texts of all inputs and one's own into each output."""
    reporter.log(f"joining {text}")
    _note(outputs[0], text)
    reporter.progress("joining", 0, 2)
    read = [path.read_text() for paths in inputs.values() for path in paths]
    for output in outputs:
        with atomic_write(output) as part:
            part.write_text("".join(read) + text)
            time.sleep(wait_s)
    reporter.progress("joining", 2, 2)
    return {"text": text, "share": 0.1}


def _note(output, text):
    """Leave a trace of each call, and of the process that did it."""
    root = next(folder for folder in output.parents if (folder / ".gis-radar").is_dir())
    with (root / "calls").open("a") as calls:
        calls.write(f"{text}\n")
    with (root / "workers").open("a") as workers:
        workers.write(f"{os.getpid()}\n")


def warn(*, reporter, **more):
    reporter.log("beware", "warning")
    return join(reporter=reporter, **more)


def refuse(*, outputs, reporter, text="", **_inputs):
    _note(outputs[0], text)
    parts = [NoAnswerError("{} does not fit", name, hint=f"look at {name}") for name in "ab"]
    raise NoAnswerError("nothing fits", hint="look again", parts=parts)


def refuse_sensor(*, text, **_inputs):
    raise NoAnswerError("{}: nothing fits", text)


def fail(*, outputs, reporter, text="", **_inputs):
    _note(outputs[0], text)
    raise InputError("bad data")


def name_its_input(*, first, **_inputs):
    raise InputError(f"{first[0]}: bad data")


def cannot_write(*, outputs, reporter, **_inputs):
    raise OutputError("disk full")


def break_down(*, outputs, reporter, **_inputs):
    raise ZeroDivisionError


def die(*, outputs, reporter, wait_s=0.0, **_inputs):
    time.sleep(wait_s)
    os.kill(os.getpid(), signal.SIGKILL)


def chatter(*, outputs, reporter, **inputs):
    sys.stdout.write("a library that prints to standard output\n")
    os.write(1, b"even from below Python\n")
    return join(outputs=outputs, reporter=reporter, **inputs)


def touch_input(*, outputs, reporter, first, **_more):
    """Change an input while it is read."""
    Path(first[0]).write_text("changed meanwhile")
    return join(outputs=outputs, reporter=reporter, text="T", first=first)


def end_once(marker):
    """End the process of the worker, the first time."""
    if not Path(marker).exists():
        Path(marker).touch()
        end_always()
    return "done"


def end_always():
    os.kill(os.getpid(), signal.SIGKILL)

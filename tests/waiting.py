"""Waiting for what happens: a limit is for what hangs."""

import time
from pathlib import Path

LONGEST_S = 300.0  # whatever is waited for comes sooner, also on a machine that is busy


def wait_for(what, message="it did not happen"):
    end = time.monotonic() + LONGEST_S
    while not what():
        assert time.monotonic() < end, message
        time.sleep(0.02)


def is_gone(pid):
    """Tell whether a process has ended, even if nobody has asked for its exit code."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True

"""Run commands one by one, each in a process of its own with limits; a line in, a line out.

A process is forked from one that has loaded all libraries and done nothing with them, so that a
case takes a fraction of a second and threads of another case are in nobody's way.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import pkgutil
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path

import gis_radar

# What is frozen of DuckDB is called a leak when the process ends; commands load it themselves.
OF_DUCKDB = ("queries", "statement", "views")
LATE = {"gis_radar.__main__", *(f"gis_radar.dataset.questions.{each}" for each in OF_DUCKDB)}


def main() -> None:
    """Read cases from standard input; write what came of each to standard output."""
    for module in pkgutil.walk_packages(gis_radar.__path__, "gis_radar."):
        if module.name not in LATE:
            importlib.import_module(module.name)
    used = "laspy", "matplotlib.pyplot", "numba", "rasterio", "scipy.ndimage", "scipy.spatial"
    for name in used:
        importlib.import_module(name)
    from gis_radar.base import go_offline
    from gis_radar.cli import group
    from gis_radar.cli.console import run_group

    go_offline()
    importlib.import_module("numba").njit(lambda x: x)(1)  # what it knows of types, 0.1 s
    gc.collect()
    gc.freeze()  # else each child looks at all that was loaded, 0.3 s
    for line in sys.stdin:
        case = json.loads(line)
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            _limit(case)
            sys.argv = ["gis-radar", *case["words"]]
            run_group(group)
        status, late = _waited(child, start + case["seconds"], case["processor_s"])
        answer = {
            "code": os.waitstatus_to_exitcode(status),
            "seconds": round(time.monotonic() - start, 2),
            "late": late,
        }
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _limit(case: dict[str, object]) -> None:
    """Set limits, and send what is printed to files."""
    os.setsid()
    sys.dont_write_bytecode = True  # a compiled module cut off by a limit would stay for all
    for descriptor, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(Path(str(case[name])), os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if case.get("temporary"):
        os.environ["TMPDIR"] = tempfile.tempdir = str(case["temporary"])
    limits = {resource.RLIMIT_AS: "bytes", resource.RLIMIT_FSIZE: "file_bytes",
              resource.RLIMIT_NOFILE: "files"}  # fmt: skip
    if case.get("more_bytes") is not None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        case["bytes"] = pages * resource.getpagesize() + int(str(case["more_bytes"]))
    for limit, name in limits.items():
        if case.get(name) is not None:
            resource.setrlimit(limit, (int(str(case[name])),) * 2)


def _waited(child: int, end: float, processor_s: float) -> tuple[int, bool]:
    """Wait for a process, and kill it with all it started at the end of its time.

    What a process may take is the processor's time: beside other work the clock's is that of all.
    """
    late = False
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status, late
        if time.monotonic() > end or _used_s(child) > processor_s:
            late = True
            os.kill(child, signal.SIGKILL)
            with contextlib.suppress(ProcessLookupError):  # just forked, it has no group yet
                os.killpg(child, signal.SIGKILL)
        time.sleep(0.005)


def _used_s(child: int) -> float:
    """Return the processor's seconds that a process and those it has waited for used."""
    words = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

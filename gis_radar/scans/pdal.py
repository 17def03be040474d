"""PDAL, found on this machine and run: its Python binding or its program.

Both run in a process of their own. PDAL cannot be stopped from Python otherwise, and its libraries
(GDAL, PROJ) would meet those of other packages in ours.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from gis_radar.errors import GisRadarError, InputError, OutputError
from gis_radar.processes import OFFLINE, run_child
from gis_radar.progress import QUIET, Reporter

OLDEST = (2, 2, 0)
"""The oldest PDAL that has all stages of our pipelines."""

INSTALL_HINT = (
    "PDAL comes by `conda env create -f environment.yml`, by `conda install -c conda-forge pdal "
    "python-pdal`, by `apt-get install pdal` on systems with that package, or in a checkout on "
    "Debian 12 by `make pdal`"
)
"""How to come by PDAL, in one line."""

PRIVATE = Path(__file__).parents[2] / ".pdal" / "bin" / "pdal"
"""Where a checkout's set-up puts PDAL."""

VARIABLE = "GIS_RADAR_PDAL"
"""The environment variable that names a program to use before any other."""

# What other installations leave in the environment and a self-contained program stumbles over.
_FOREIGN = {
    "GDAL_DATA", "GDAL_DRIVER_PATH", "LD_LIBRARY_PATH", "PDAL_DRIVER_PATH", "PROJ_DATA", "PROJ_LIB",
    "PYTHONHOME", "PYTHONPATH",
}  # fmt: skip
_BINDING = (sys.executable, "-P", "-c")
_ASK_BINDING = "import pdal; print('pdal', pdal.info.version)"
_RUN_BINDING = """
import sys
import pdal
try:
    pipeline = pdal.Pipeline(sys.stdin.read())
    pipeline.execute()
except RuntimeError as error:
    sys.exit(f"PDAL: {error}")
sys.stderr.write(pipeline.log)
"""
# PDAL goes on and ends well after these, but points are not where they should be.
_LOSES_POINTS = re.compile(r"GDAL failure.*(coordinate operation|[Rr]eproject|[Tt]ransform)")
_START_S = 60.0


@dataclass(frozen=True, kw_only=True)
class PdalRunner:
    """A PDAL on this machine.

    Parameters
    ----------
    kind : str
        What it is: ``pdal program`` or ``pdal binding``.
    place : str
        Where it was found, as remarks name it.
    ask, command : tuple of str
        What is started for its version, and what reads a pipeline from standard input.
    environment : mapping of str to str
        The environment it is started in.
    version : tuple of int
        Major, minor, patch of the library; empty where it was not started yet.
    """

    kind: str
    place: str
    ask: tuple[str, ...]
    command: tuple[str, ...]
    environment: Mapping[str, str] = field(repr=False)
    version: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """What it is, with its version: ``pdal program 2.2.0``."""
        return f"{self.kind} {'.'.join(map(str, self.version))}"

    def run(self, pipeline: Mapping[str, Any], *, reporter: Reporter = QUIET) -> None:
        """Run a pipeline to its end.

        Parameters
        ----------
        pipeline : mapping
            PDAL's document, ``{"pipeline": [stage, ...]}``, whose last stage is a writer. What
            the writer has begun stays when the run fails: let it write into a private folder
            (:mod:`gis_radar.files`).
        reporter : Reporter
            Where the seconds so far go, and PDAL's warnings.

        Raises
        ------
        InputError
            If PDAL refuses the pipeline or what it reads, with PDAL's message, or could not
            reproject points, which PDAL itself passes over.
        OutputError
            If PDAL cannot write.
        GisRadarError
            If PDAL cannot be started or is killed.
        """
        with tempfile.TemporaryFile() as document, tempfile.TemporaryFile() as messages:
            document.write(json.dumps(pipeline).encode())
            document.seek(0)
            code = run_child(
                self.command, stdin=document, stderr=messages,
                environment={**self.environment, **OFFLINE},
                waiting=lambda seconds: reporter.progress("running PDAL", int(seconds), None),
            )  # fmt: skip
            messages.seek(0)
            text = messages.read().decode(errors="replace")
        if code < 0:
            raise GisRadarError(
                f"{self.name} was ended by {_signal_name(-code)}",
                hint="if memory ran out, give it smaller tiles",
            )
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if code > 0 or any(_LOSES_POINTS.search(line) for line in lines):
            raise _error(lines, code, pipeline)
        for line in lines:
            reporter.log(f"PDAL: {_strip(line)}", "warning")


def find_pdal(*, reporter: Reporter = QUIET) -> PdalRunner | None:
    """Find a PDAL that works.

    In this order: the Python binding of the running Python, the program that the environment
    variable ``GIS_RADAR_PDAL`` names, ``pdal`` on the PATH, the one of the checkout's set-up. What
    does not start, or is older than 2.2, is passed over with a remark.

    Parameters
    ----------
    reporter : Reporter
        Where it goes what was passed over, and why.

    Returns
    -------
    PdalRunner or None
        None where there is none; :data:`INSTALL_HINT` is how to get one.
    """
    for candidate in candidates():
        answer = _ask(candidate.ask, tuple(sorted(candidate.environment.items())))
        if isinstance(answer, str):
            reporter.log(f"{candidate.place} is passed over: {answer}", "warning")
            continue
        return replace(candidate, version=answer)
    return None


def candidates() -> Iterator[PdalRunner]:
    """Yield what is there, in the order of preference, without starting it."""
    if _binding_is_installed():
        yield PdalRunner(
            kind="pdal binding", place="the Python package pdal", ask=(*_BINDING, _ASK_BINDING),
            command=(*_BINDING, _RUN_BINDING), environment=dict(os.environ),
        )  # fmt: skip
    if named := os.environ.get(VARIABLE):
        yield _program(named, f"{VARIABLE}={named}", os.environ)
    if found := shutil.which("pdal"):
        yield _program(found, found, os.environ)
    if PRIVATE.is_file():
        clean = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
        yield _program(str(PRIVATE), str(PRIVATE), clean)


def _binding_is_installed() -> bool:
    """Return whether there is a package `pdal`; a folder that happens to have the name is none."""
    try:
        spec = importlib.util.find_spec("pdal")
    except (ImportError, ValueError):
        return False
    return spec is not None and spec.origin is not None


def _program(path: str, place: str, environment: Mapping[str, str]) -> PdalRunner:
    return PdalRunner(
        kind="pdal program", place=place, ask=(path, "--version"),
        command=(path, "pipeline", "--stdin"), environment=dict(environment),
    )  # fmt: skip


@cache
def _ask(command: Sequence[str], environment: Iterable[tuple[str, str]]) -> str | tuple[int, ...]:
    """Start a PDAL for its version; return that, or why it is of no use."""
    try:
        done = subprocess.run(  # noqa: S603 - asks what `candidates` found
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_START_S,
            env=dict(environment), check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"it does not answer within {_START_S:.0f} s"
    except OSError as error:
        return f"it does not start: {error.strerror or error}"
    if done.returncode != 0:
        text = done.stderr.decode(errors="replace").strip().splitlines()
        return ": ".join(["it does not start", *text[-1:]])
    found = re.search(rb"\bpdal (\d+)\.(\d+)(?:\.(\d+))?", done.stdout)
    if found is None:
        return "it does not print a version of PDAL"
    version = tuple(int(part or 0) for part in found.groups())
    if version < OLDEST:
        return f"it is PDAL {'.'.join(map(str, version))}, needed is 2.2 or newer"
    return version


def _strip(line: str) -> str:
    """Remove from a line of PDAL's log what is of no use to a user."""
    return re.sub(r"^(\(.*? \w+\)|PDAL:) *(STDIN: )?(GDAL failure \(\d+\) )?", "", line)


def _error(lines: list[str], code: int, pipeline: Mapping[str, Any]) -> GisRadarError:
    """Return the error of the most informative line."""
    final = [line for line in lines if line.startswith("PDAL: ")]
    lost = [line for line in lines if _LOSES_POINTS.search(line)]
    chosen = (final or lost or lines or [f"it ended with exit code {code}"])[0]
    message = f"PDAL: {_strip(chosen)}"
    if message.startswith("PDAL: writers."):
        return OutputError(message)
    files = [name for stage in pipeline.get("pipeline", []) if (name := _reads(stage))]
    if message.startswith("PDAL: readers.") and len(files) == 1:
        message = f"{files[0]}: {message}"
    cut = re.search(r"reading point \d+ of \d+ total", message)
    return InputError(message, hint="the file is cut or damaged" if cut else "")


def _reads(stage: object) -> object:
    """Return the file that a stage reads; a bare file name is a reader too."""
    if isinstance(stage, Mapping) and str(stage.get("type", "readers.")).startswith("readers."):
        return stage.get("filename")
    return stage if isinstance(stage, str) else None


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"

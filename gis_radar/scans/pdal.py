"""Find PDAL's program on this machine, and run it as a process that can be stopped."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gis_radar.base import (
    OFFLINE,
    QUIET,
    GisRadarError,
    InputError,
    OutputError,
    Reporter,
    Text,
    run_child,
)

_OLDEST = (2, 2, 0)
"""The oldest PDAL that has all stages of our pipelines."""

INSTALL_HINT = Text(
    "PDAL comes by `conda env create -f environment.yml`, by `conda install -c "
    "conda-forge pdal`, with QGIS on Windows, or by `apt-get install pdal` on systems "
    "with that package"
)
"""Advice on installing PDAL, in one line."""

VARIABLE = "GIS_RADAR_PDAL"
"""The environment variable that names a program to use in place of the one on the PATH."""

# Messages after which PDAL goes on and ends without an error, but with points in the wrong place.
_LOSES_POINTS = re.compile(r"GDAL failure.*(coordinate operation|[Rr]eproject|[Tt]ransform)")
_START_S = 60.0


@dataclass(frozen=True, kw_only=True)
class PdalRunner:
    """A PDAL on this machine.

    Parameters
    ----------
    path : str
        Path of the program.
    version : tuple of int
        Major, minor, patch.
    """

    path: str
    version: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name with version, such as ``PDAL 2.9.3``."""
        return f"PDAL {'.'.join(map(str, self.version))}"

    def run(self, pipeline: Mapping[str, Any], *, reporter: Reporter = QUIET) -> None:
        """Run a pipeline to its end.

        Parameters
        ----------
        pipeline : mapping
            PDAL's document, ``{"pipeline": [stage, ...]}``, whose last stage is a writer. A failed
            run leaves an unfinished file: let the writer use a private folder
            (:mod:`gis_radar.base.files`).
        reporter : Reporter
            Receives the seconds so far, and PDAL's warnings.

        Raises
        ------
        InputError
            If PDAL refuses the pipeline or a file, with PDAL's message, or could not reproject
            points, which PDAL itself only logs.
        OutputError
            If PDAL cannot write.
        GisRadarError
            If PDAL cannot be started or is killed.
        """
        with tempfile.TemporaryFile() as document, tempfile.TemporaryFile() as messages:
            document.write(json.dumps(pipeline).encode())
            document.seek(0)
            code = run_child(
                (self.path, "pipeline", "--stdin"), stdin=document, stderr=messages,
                environment={**os.environ, **OFFLINE},
                waiting=lambda seconds: reporter.progress("running PDAL", int(seconds), None),
            )  # fmt: skip
            messages.seek(0)
            text = messages.read().decode(errors="replace")
        if code < 0:
            raise GisRadarError(
                "{} was ended by {}",
                self.name,
                signal.Signals(-code).name,
                hint="if memory ran out, give it smaller tiles",
            )
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if code > 0 or any(_LOSES_POINTS.search(line) for line in lines):
            raise _pdal_error(lines, code, pipeline)
        for line in lines:
            reporter.warn("PDAL: {}", _without_prefix(line))


def find_pdal(*, reporter: Reporter = QUIET) -> PdalRunner | None:
    """Find the PDAL that the variable names, else the one of conda's environment or on the PATH.

    Parameters
    ----------
    reporter : Reporter
        Receives the reason why a PDAL is passed over: it does not start, or is too old.

    Returns
    -------
    PdalRunner or None
        None where there is none; :data:`INSTALL_HINT` is advice on installing one.
    """
    named = os.environ.get(VARIABLE)
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    if (path := named or shutil.which("pdal", path=folders)) is None:
        return None
    answer = _version_of(path)
    if isinstance(answer, str):
        place = f"{VARIABLE}={path}" if named else path
        reporter.warn("{} is passed over: {}", place, answer)
        return None
    return PdalRunner(path=path, version=answer)


@cache
def _version_of(path: str) -> str | tuple[int, ...]:
    """Return the version of a PDAL, or the reason why it cannot be used."""
    try:
        done = subprocess.run(  # noqa: S603 - the program that the user has or names
            [path, "--version"], stdin=subprocess.DEVNULL, capture_output=True, timeout=_START_S,
            check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Text("it does not answer within {:.0f} s", _START_S)
    except OSError as error:
        return Text("it does not start: {}", error.strerror or error)
    if done.returncode != 0:
        text = done.stderr.decode(errors="replace").strip().splitlines()
        return ": ".join(["it does not start", *text[-1:]])
    found = re.search(rb"\bpdal (\d+)\.(\d+)(?:\.(\d+))?", done.stdout)
    if found is None:
        return Text("it does not print a version of PDAL")
    version = tuple(int(part or 0) for part in found.groups())
    if version < _OLDEST:
        return Text("it is PDAL {}, needed is 2.2 or newer", ".".join(map(str, version)))
    return version


def _without_prefix(line: str) -> str:
    """Return a line of PDAL's log without its technical prefix."""
    return re.sub(r"^(\(.*? \w+\)|PDAL:) *(STDIN: )?(GDAL failure \(\d+\) )?", "", line)


def _pdal_error(lines: list[str], code: int, pipeline: Mapping[str, Any]) -> GisRadarError:
    """Return an error with the most informative line of PDAL's log."""
    final = [line for line in lines if line.startswith("PDAL: ")]
    lost = [line for line in lines if _LOSES_POINTS.search(line)]
    chosen = (final or lost or lines or [f"it ended with exit code {code}"])[0]
    message = Text("PDAL: {}", _without_prefix(chosen))
    if message.startswith("PDAL: writers."):
        return OutputError(message)
    files = [name for stage in pipeline.get("pipeline", []) if (name := _input_of(stage))]
    if message.startswith("PDAL: readers.") and len(files) == 1:
        message = Text("{}: {}", files[0], message)
    cut = re.search(r"reading point \d+ of \d+ total", message)
    return InputError(message, hint="the file is cut or damaged" if cut else "")


def _input_of(stage: object) -> object:
    """Return the file that a stage reads, or None; a stage that is a bare name is a reader."""
    if isinstance(stage, Mapping) and str(stage.get("type", "readers.")).startswith("readers."):
        return stage.get("filename")
    return stage if isinstance(stage, str) else None

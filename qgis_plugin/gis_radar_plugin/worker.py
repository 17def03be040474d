"""Find the Python that does the work, and check whether it is fit for it; needs no QGIS."""

from __future__ import annotations

import configparser
import os
import subprocess  # nosec B404
import sys
from functools import lru_cache
from pathlib import Path

from .runner import NO_WINDOW, NoWorkerError, WorkerError, clean_environment
from .words import tr

VARIABLE = "GIS_RADAR_PYTHON"
_PROBE = (
    "import sys\n"
    "if sys.version_info < (3, 11): sys.exit('old ' + sys.version.split()[0])\n"
    "from importlib.metadata import version, PackageNotFoundError\n"
    "try: print(version('gis-radar'))\n"
    "except PackageNotFoundError: sys.exit('none')\n"
)
_PROBE_S = 30
_GONE = "The worker's Python {python} is not there"


class NoPackageError(WorkerError):
    """A Python has no gis_radar."""


def worker_folder(profile: Path) -> Path:
    """Return where 'Set up the worker' puts its environment."""
    return profile / "gis_radar" / "worker"


def python_in(folder: Path) -> Path:
    """Return the Python of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def find_python(setting: str, profile: Path) -> str:
    """Return the worker's Python: the setting's, the environment's, or the profile's.

    Raises
    ------
    WorkerError
        If there is none.
    """
    for named in (setting, os.environ.get(VARIABLE, "")):
        if named:
            if not Path(named).is_file():
                raise WorkerError(_GONE, python=named)
            return named
    made = python_in(worker_folder(profile))
    if not made.is_file():
        raise NoWorkerError(
            "gis_radar needs its worker: run 'Set up the worker' in the toolbox "
            "(group gis_radar, Set-up) once."
        )
    return str(made)


def plugin_version() -> str:
    """Return the version in the metadata, or an empty text in a checkout, which has none."""
    metadata = configparser.ConfigParser(interpolation=None)
    metadata.read(Path(__file__).with_name("metadata.txt"), encoding="utf-8")
    return metadata.get("general", "version", fallback="")


def worker_version(python: str) -> str:
    """Return the version of gis_radar that a Python has.

    Raises
    ------
    WorkerError
        If it has none, is too old, or does not start.
    """
    try:
        changed = Path(python).stat().st_mtime
    except OSError as error:
        raise WorkerError(_GONE, python=python) from error
    return _asked(python, changed)


@lru_cache(maxsize=8)
def _asked(python: str, _changed: float) -> str:
    try:
        done = subprocess.run(  # noqa: S603  # nosec B603
            [python, "-c", _PROBE],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_PROBE_S,
            env=clean_environment(os.environ),
            creationflags=NO_WINDOW,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        why = getattr(error, "strerror", None) or tr("no answer")
        raise WorkerError(
            "The worker's Python {python} does not start: {reason}", python=python, reason=why
        ) from error
    ended = tr("it ended with code {code}").format(code=done.returncode)
    reason = done.stderr.strip().splitlines()[-1:] or [ended]
    if done.returncode == 0:
        return done.stdout.strip()
    if reason[0] == "none":
        raise NoPackageError("{python} has no gis_radar", python=python)
    if reason[0].startswith("old "):
        raise WorkerError(
            "{python} is Python {version}, needed is 3.11 or newer",
            python=python, version=reason[0][4:],
        )  # fmt: skip
    raise WorkerError(
        "The worker's Python {python} does not run: {reason}", python=python, reason=reason[0]
    )


def forget_versions() -> None:
    """Forget the versions found: the worker was set up anew."""
    _asked.cache_clear()


def same_series(worker: str, plugin: str) -> bool:
    """Return whether worker and plugin are of the same minor version x.y, so that they fit."""
    return not plugin or worker.split(".")[:2] == plugin.split(".")[:2]

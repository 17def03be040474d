"""Build the worker: a Python environment of its own with gis_radar; needs no QGIS."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from .runner import Listener, WorkerError, run_command
from .words import tr
from .worker import NoPackageError, forget_versions, python_in, worker_version

BUNDLED = Path(__file__).parent / "worker"
_NAMES = ("python3.13", "python3.12", "python3.11", "python3", "python")
GRACE_S = 0.3  # pip and venv do not react to a closed standard input: they are killed
_PACKAGES = 45  # about as many as gis_radar requires; only the progress bar uses it


@dataclass(frozen=True)
class Tools:
    """The programs that make the environment.

    Parameters
    ----------
    python : str
        A Python that is new enough, or empty where uv must fetch one.
    uv : str
        The program uv, or empty.
    """

    python: str
    uv: str


def bundled_package() -> str:
    """Return the wheel that came with the plugin, or an empty text."""
    wheels = sorted(BUNDLED.glob("gis_radar-*.whl"))
    return str(wheels[-1]) if wheels else ""


def find_tools(python: str = "") -> Tools:
    """Find a Python that is new enough, and uv.

    Parameters
    ----------
    python : str
        The Python to take; without it those of QGIS and of the system are tried.

    Raises
    ------
    WorkerError
        If there is neither a fitting Python nor uv.
    """
    uv = shutil.which("uv") or ""
    if python:
        if not _is_new_enough(python):
            raise WorkerError("{python} is no Python 3.11 or newer (choose another)", python=python)
        return Tools(python, uv)
    found = next((name for name in _candidates() if _is_new_enough(name)), "")
    if not found and not uv:
        raise WorkerError(
            "There is no Python 3.11 or newer on this computer "
            "(install one from python.org, or uv, and run this again)"
        )
    return Tools(found, uv)


def _candidates() -> Iterator[str]:
    """Yield Pythons: QGIS's own first; on Windows sys.executable is QGIS itself."""
    program = "python.exe" if sys.platform == "win32" else "bin/python3"
    for folder in (sys.base_exec_prefix, sys.exec_prefix):
        yield str(Path(folder) / program)
    if "python" in Path(sys.executable).name.lower():
        yield sys.executable
    for name in _NAMES:
        if found := shutil.which(name):
            yield found


def _is_new_enough(python: str) -> bool:
    try:
        worker_version(python)
    except NoPackageError:
        return True
    except WorkerError:
        return False
    return True


def set_up(
    folder: Path,
    package: str,
    tools: Tools,
    listener: Listener,
    *,
    options: Sequence[str] = (),
) -> str:
    """Build the environment and put it in place of an earlier one.

    Parameters
    ----------
    folder : Path
        Folder of the environment; it appears whole or not at all.
    package : str
        The wheel of gis_radar.
    tools : Tools
        The programs that make it.
    listener : Listener
        Receives the stage and the progress of the whole, percent, and is asked whether to stop.
    options : sequence of str
        Further words for pip or uv, such as where packages come from.

    Returns
    -------
    str
        The version of gis_radar that it has.

    Raises
    ------
    WorkerError
        If a step fails, in one sentence with the last line of the tool.
    CancelledError
        If the listener wanted to stop.
    """
    part = folder.with_name(f"{folder.name}.part")
    _remove(part)

    def stage(text: str, percent: float) -> None:
        listener.progress(text, percent, 100.0)

    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        stage("Making an environment", 2)
        _make_environment(part, tools, listener)
        stage("Fetching gis_radar and what it needs", 8)
        _install(part, package, tools, listener, options)
        stage("Trying it out", 94)
        version = worker_version(str(python_in(part)))
        _run([str(python_in(part)), "-P", "-m", "gis_radar", "--version"], listener)
        _put_in_place(part, folder)
    except OSError as error:
        reason = error.strerror or str(error)
        why = f"{tr('cannot be written')}: {reason}"
        raise WorkerError("{folder}: {why}", folder=folder, why=why) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        forget_versions()
    stage("Done", 100)
    return version


def _make_environment(part: Path, tools: Tools, listener: Listener) -> None:
    if tools.uv:
        wanted = tools.python or ">=3.11"
        _run([tools.uv, "venv", "--quiet", "--python", wanted, str(part)], listener)
        return
    try:
        _run([tools.python, "-m", "venv", str(part)], listener)
    except WorkerError as error:
        raise WorkerError(
            "{error} (on Debian and Ubuntu the package python3-venv may be missing)", error=error
        ) from error


def _install(
    part: Path, package: str, tools: Tools, listener: Listener, options: Sequence[str]
) -> None:
    python = str(python_in(part))
    words = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input",
             "--progress-bar", "off"]  # fmt: skip
    if tools.uv:
        words = [tools.uv, "pip", "install", "--python", python, "--no-progress"]
    pins = BUNDLED / "constraints.txt"
    if pins.is_file():
        words += ["--constraint", str(pins)]
    _run([*words, "--only-binary", ":all:", *options, package], listener, counted=True)


def _run(command: Sequence[str], listener: Listener, *, counted: bool = False) -> None:
    """Run a step; count the packages that it names, so that the bar moves."""
    last: list[str] = []
    seen = 0

    def on_line(line: str) -> None:
        nonlocal seen
        text = line.strip()
        if not text:
            return
        last.append(text)
        listener.log(text, "info")
        if counted and text.startswith(("Collecting", "Downloading", "Processing", "Prepared")):
            seen += 1
            percent = 8 + min(84.0, 84.0 * seen / (2 * _PACKAGES))
            listener.progress("Fetching gis_radar and what it needs", percent, 100.0)

    code, _ = run_command(command, on_line, listener.cancelled, grace_s=GRACE_S, merged=True)
    if code != 0:
        raise WorkerError("{reason}", reason=_why(command[0], last, code))


def _why(program: str, lines: Sequence[str], code: int) -> str:
    """Choose the line that says most about a failed step."""
    named = [line for line in lines if line.lower().startswith(("error", "fatal"))]
    chosen = (named or list(lines) or [tr("it ended with code {code}").format(code=code)])[-1]
    return f"{Path(program).name}: {chosen}"


def _put_in_place(part: Path, folder: Path) -> None:
    """Put the new environment in place of the earlier one, which stays where that fails."""
    before = folder.with_name(f"{folder.name}.before")
    _remove(before)
    if folder.exists():
        folder.rename(before)
    try:
        part.rename(folder)
    except OSError:
        if before.exists():
            before.rename(folder)
        raise
    shutil.rmtree(before, ignore_errors=True)


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)

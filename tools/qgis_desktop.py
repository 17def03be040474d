"""Run the desktop of QGIS on a virtual screen, step by step, for pictures and for a test.

Needs QGIS with Xvfb, openbox and ImageMagick (tools/get_browser_and_qgis.sh).
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

WAIT_S = 350  # for a program, at most
# Begin of a script: runs its steps one after the other, each after so many seconds.
_SCRIPT = """
import os, subprocess, traceback
from qgis.PyQt.QtCore import Qt, QTimer
from qgis.PyQt.QtWidgets import QDockWidget
from qgis.utils import iface, plugins
steps = []

def shot(name, widget=None):
    window = "root" if widget is None else str(int(widget.winId()))
    subprocess.run(["import", "-window", window, os.path.join(SHOTS, name)], check=True)

def say(*words):
    print("SAID", *words, flush=True)

def docks():
    return {dock.objectName(): dock for dock in iface.mainWindow().findChildren(QDockWidget)}

def after(seconds):
    def keep(step):
        steps.append((seconds, step))
        return step
    return keep

def go():
    if not steps:
        os._exit(0)
    seconds, step = steps.pop(0)
    def do():
        try:
            step()
        except Exception:
            traceback.print_exc()
            os._exit(1)
        go()
    QTimer.singleShot(int(seconds * 1000), do)
"""
_START = "\niface.initializationCompleted.connect(go)\n"


def desktop_script(body: str, **names: str) -> str:
    """Return a program for QGIS's `--code`.

    Parameters
    ----------
    body : str
        Functions under `@after(seconds)`, which are its steps; `shot(name)` takes a picture,
        `say(...)` writes a line that begins with SAID, `docks()` are the panels by name.
    **names : str
        Texts that the body knows by these names; SHOTS is the folder of the pictures.
    """
    known = "".join(f"{name} = {text!r}\n" for name, text in names.items())
    return f"{known}{_SCRIPT}{body}{_START}"


@contextmanager
def virtual_screen(
    width: int, height: int, environment: Mapping[str, str]
) -> Iterator[dict[str, str]]:
    """Yield the environment variables of programs on a virtual screen with a window manager.

    QGIS's desktop crashes on Qt's platform `offscreen`.
    """
    number = 90 + os.getpid() % 900
    screen = Path(f"/tmp/.X11-unix/X{number}")  # noqa: S108 - where X puts it  # nosec B108
    inside = {**environment, "DISPLAY": f":{number}", "QT_QPA_PLATFORM": "xcb"}
    size = f"{width}x{height}x24"
    commands = (["Xvfb", inside["DISPLAY"], "-screen", "0", size, "-nolisten", "tcp"], ["openbox"])
    started: list[subprocess.Popen[bytes]] = []
    try:
        for command in commands:
            started.append(
                subprocess.Popen(
                    command, env=inside, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
                )
            )
            _wait_for(screen, started[0])
            time.sleep(1.0)
        yield inside
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=WAIT_S)


def _wait_for(screen: Path, server: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + WAIT_S
    while not screen.exists() and server.poll() is None and time.monotonic() < end:
        time.sleep(0.05)


def run_desktop(
    script: str, place: Path, profiles: Path, environment: Mapping[str, str], *words: str
) -> subprocess.CompletedProcess[str]:
    """Start QGIS on a screen with a script, wait for its end, and return its output.

    Parameters
    ----------
    script : str
        From :func:`desktop_script`.
    place : Path
        Folder for the script's file.
    profiles : Path
        QGIS's profiles.
    environment : mapping
        From :func:`virtual_screen`.
    *words : str
        Further options.
    """
    startup = place / "startup.py"
    startup.write_text(script, encoding="utf-8")
    return subprocess.run(
        ["qgis", "--nologo", "--noversioncheck", "--profiles-path", str(profiles), *words,
         "--code", str(startup)],
        capture_output=True, text=True, timeout=WAIT_S, check=False, env=dict(environment),
    )  # fmt: skip

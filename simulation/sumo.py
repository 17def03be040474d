"""Programs of the traffic simulator Eclipse SUMO, which is no dependency of the package."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Sequence
from pathlib import Path

INSTALL_HINT = "Eclipse SUMO is needed to simulate traffic: pip install eclipse-sumo"


def sumo_home() -> Path:
    """Return the folder of the installed SUMO.

    Raises
    ------
    ModuleNotFoundError
        When SUMO is not installed; the message has the line that installs it.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(INSTALL_HINT, name="sumo")
    return Path(spec.origin).parent


def run(program: str, arguments: Sequence[str]) -> None:
    """Run one of SUMO's programs (``sumo``, ``netconvert``, ``netgenerate``) to its end.

    Raises
    ------
    RuntimeError
        When the program fails; the message ends with its output.
    """
    command = [str(sumo_home() / "bin" / program), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode != 0:
        output = (done.stderr or done.stdout).strip()
        raise RuntimeError(f"{program} failed with exit code {done.returncode}: {output[-2000:]}")

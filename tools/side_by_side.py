"""Run commands at the same time: the first one in sight, the others told when they have ended.

    python tools/side_by_side.py 'pytest -n 2' mypy 'sh tools/test_qgis.sh'

Checks that wait for windows and programs leave a core idle, which others can use. The exit code is
that of the first command that failed.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import IO

GRACE_S = 10.0


def run(commands: Sequence[str]) -> int:
    """Run commands side by side; return the first exit code that is not 0, in their order."""
    shown, *beside = commands
    with tempfile.TemporaryDirectory() as place:
        heard = [open(f"{place}/{i}", "w+b") for i in range(len(beside))]  # noqa: PTH123, SIM115
        started = [
            subprocess.Popen(shlex.split(command), stdout=said, stderr=subprocess.STDOUT)
            for command, said in zip(beside, heard, strict=True)
        ]
        try:
            codes = [subprocess.run(shlex.split(shown), check=False).returncode]
            for command, process, said in zip(beside, started, heard, strict=True):
                codes.append(process.wait())
                _tell(command, said)
        finally:
            _end(started)
            for said in heard:
                said.close()
    return next((code for code in codes if code != 0), 0)


def _tell(command: str, said: IO[bytes]) -> None:
    """Write what a command has said, under its name."""
    said.seek(0)
    sys.stdout.write(f"\n$ {command}\n")
    sys.stdout.flush()
    sys.stdout.buffer.write(said.read())
    sys.stdout.flush()


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End what still runs when all is broken off; they have had the same Ctrl-C."""
    until = time.monotonic() + GRACE_S
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()


if __name__ == "__main__":
    try:
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 130
    sys.exit(abs(code))

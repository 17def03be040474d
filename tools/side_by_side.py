"""Run commands at the same time; print the first one's output at once, the others' at their end.

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

GRACE_S = 10.0  # for all commands together to end after Ctrl-C


def run(commands: Sequence[str]) -> int:
    """Run commands side by side; return the first exit code that is not 0, in their order."""
    first, *others = commands
    with tempfile.TemporaryDirectory() as place:
        output_files = [open(f"{place}/{i}", "w+b") for i in range(len(others))]  # noqa: PTH123, SIM115
        started = [
            subprocess.Popen(shlex.split(command), stdout=output_file, stderr=subprocess.STDOUT)
            for command, output_file in zip(others, output_files, strict=True)
        ]
        try:
            codes = [subprocess.run(shlex.split(first), check=False).returncode]
            for command, process, output_file in zip(others, started, output_files, strict=True):
                codes.append(process.wait())
                _print_output(command, output_file)
        finally:
            _end(started)
            for output_file in output_files:
                output_file.close()
    return next((code for code in codes if code != 0), 0)


def _print_output(command: str, output_file: IO[bytes]) -> None:
    """Print the output of a command below the command."""
    output_file.seek(0)
    sys.stdout.write(f"\n$ {command}\n")
    sys.stdout.flush()
    sys.stdout.buffer.write(output_file.read())
    sys.stdout.flush()


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Wait for processes, which had the same Ctrl-C, for `GRACE_S` in all; then end the rest."""
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

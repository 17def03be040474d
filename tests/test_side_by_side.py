"""Checks side by side: all are run, all are heard, and a failure of any is one of the whole."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "side_by_side.py"


def beside(*programs):
    commands = [f"{sys.executable} -c '{program}'" for program in programs]
    return subprocess.run(
        [sys.executable, TOOL, *commands], capture_output=True, text=True, check=False
    )


def test_what_runs_beside_is_told_afterwards():
    done = beside('print("one")', 'print("two")', 'import sys; print("three", file=sys.stderr)')
    assert done.returncode == 0
    said = [line for line in done.stdout.splitlines() if line and not line.startswith("$ ")]
    assert said == ["one", "two", "three"]
    names = [line for line in done.stdout.splitlines() if line.startswith("$ ")]
    assert [name.count("two") + 2 * name.count("three") for name in names] == [1, 2]


def test_they_run_at_the_same_time(tmp_path):
    """Each waits for the file of the other."""
    program = (
        "import pathlib, time\n"
        'pathlib.Path("{}").touch()\n'
        'while not pathlib.Path("{}").exists(): time.sleep(0.01)'
    )
    a, b = tmp_path / "a", tmp_path / "b"
    assert beside(program.format(a, b), program.format(b, a)).returncode == 0


@pytest.mark.parametrize(("codes", "whole"), [((0, 3, 0), 3), ((4, 0, 0), 4), ((0, 0, 5), 5)])
def test_a_failure_of_one_is_that_of_all(codes, whole):
    done = beside(*(f"print({code} * 11); raise SystemExit({code})" for code in codes))
    assert done.returncode == whole
    assert [line for line in done.stdout.splitlines() if line.isdigit()] == [
        str(11 * code) for code in codes
    ]

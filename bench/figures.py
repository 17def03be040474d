"""Figures of all benches with their targets, Markdown tables, and processes that are measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
OUT = ROOT / "out" / "bench"
TARGET = "(target)"  # name of the peer where a figure is set beside a target
# Differences from run to run, as shares of a figure: of time and memory on a shared machine; of
# measured shares and errors; of what hardly differs.
TIME_CHANCE, SHARE_CHANCE, EXACT_CHANCE = 0.25, 0.05, 0.02
ONE_CORE = dict.fromkeys(
    ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
# A small program that starts the command: the peak of a child begins with its parent's memory.
STARTER = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu_s = used.ru_utime + used.ru_stime
print("\\n" + json.dumps({"code": code, "cpu_s": cpu_s, "peak_mib": used.ru_maxrss / 1024.0}))
"""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure of a benchmark.

    Parameters
    ----------
    what : str
        Its name: what is measured.
    ours : float
        The figure.
    unit : str
        Its unit.
    peer, peer_name : float or None, str
        A peer's figure of the same run, or a target, and its name (`TARGET` for a target).
    more_is_better : bool
        Whether a higher figure is a better one.
    chance, least : float
        By how much it may differ from run to run: as a share of it, and at least.
    size : str
        Size of the work; part of the printed name only.
    """

    what: str
    ours: float
    unit: str = ""
    peer: float | None = None
    peer_name: str = ""
    more_is_better: bool = False
    chance: float = SHARE_CHANCE
    least: float = 0.0
    size: str = ""

    @property
    def ratio(self) -> float | None:
        """Our figure over the peer's."""
        return None if not self.peer else self.ours / self.peer

    @property
    def name(self) -> str:
        """Name with the size of the work, as it is printed."""
        return f"{self.what}, {self.size}" if self.size else self.what

    @property
    def misses(self) -> bool:
        """Whether the figure has a target and misses it."""
        if self.peer is None or self.peer_name != TARGET:
            return False
        return self.ours < self.peer if self.more_is_better else self.ours > self.peer

    def change(self, accepted: float) -> float:
        """Return by how much beyond chance the figure is worse than before; negative: better."""
        more = accepted - self.ours if self.more_is_better else self.ours - accepted
        beyond = max(abs(more) - max(self.chance * abs(accepted), self.least), 0.0)
        return beyond if more > 0.0 else -beyond


def short(value: float, unit: str = "") -> str:
    """Return a figure with its unit as text."""
    return f"{value:.3g} {unit}".strip() if abs(value) < 1000.0 else f"{value:,.0f} {unit}".strip()


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def report(bench: str, figures: Iterable[Figure]) -> None:
    """Print each figure and keep it in `OUT`; exit with code 1 where one misses its target."""
    missed = []
    for each in figures:
        print(f"{each.name}: {short(each.ours, each.unit)}{_beside(each)}", flush=True)
        keep(bench, [each])
        if each.misses:
            missed.append(f"{each.what}: {short(each.ours, each.unit)}{_beside(each)}")
    if missed:
        sys.exit("outside the targets: " + "; ".join(missed))


def _beside(figure: Figure) -> str:
    if figure.peer is None:
        return ""
    return f", beside {short(figure.peer, figure.unit)} {figure.peer_name}"


def keep(bench: str, figures: Iterable[Figure]) -> None:
    """Add figures to those kept of a bench, in place of earlier ones of the same names."""
    path = OUT / f"{bench}.json"
    kept = {each.what: each for each in read(path)} | {each.what: each for each in figures}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(each) for each in kept.values()], indent=1) + "\n")


def read(path: Path) -> list[Figure]:
    """Return the figures of a file."""
    return [Figure(**each) for each in json.loads(path.read_text())] if path.exists() else []


def spent_s(work: Callable[[], object]) -> float:
    """Return the CPU time, all threads, that a call takes."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


@dataclass(frozen=True, kw_only=True)
class ProcessResult:
    """Result of a process.

    Parameters
    ----------
    code : int
        Its exit code.
    lines : list of dict
        The JSON objects that it printed, a line each.
    cpu_s, peak_mib : float
        CPU time, and the most memory held.
    """

    code: int
    lines: list[dict[str, Any]]
    cpu_s: float
    peak_mib: float


def run_alone(*words: object, check: bool = True) -> ProcessResult:
    """Run Python as a process of its own with single-threaded libraries.

    Parameters
    ----------
    words : object
        Arguments of Python: a script, ``-m`` and a module, or ``-c`` and code.
    check : bool
        Whether a failure ends the bench; else what the process writes to stderr is dropped.
    """
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", STARTER, *command], check=True, cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=None if check else subprocess.DEVNULL,
        stdin=subprocess.DEVNULL, env={**os.environ, **ONE_CORE, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    *lines, used = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if check and used["code"]:
        sys.exit(f"{words[0]} ... ended with code {used['code']}")
    return ProcessResult(lines=lines, **used)

"""Fuzz all targets in turn, each for its share of the processor's time; the same again goes on.

``FUZZ_SECONDS=7200 make fuzz`` for two hours; ``FUZZ_ONLY=osm,pcap`` for some of the targets.
Corpus, findings and sums are kept in ``out/fuzz``. The exit code is 1 where something was found.
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import time
from pathlib import Path

from fuzz.targets import TARGETS, build_inputs

FOLDER = Path("out/fuzz")
TURN_S = 60  # of the processor for a target; the one with the fewest so far comes next
LONGEST_S = 7200  # of the clock, where a target hangs and does nothing
COUNTS = re.compile(r"^#\d+\s.*cov: (\d+) ft: (\d+) corp: (\d+)/", re.MULTILINE)
RAN = re.compile(r"^ran (\d+)$", re.MULTILINE)


def main() -> None:
    """Fuzz, print a table, and tell by the exit code whether anything was found."""
    seconds = int(os.environ.get("FUZZ_SECONDS", "3600"))
    only = os.environ.get("FUZZ_ONLY", "")
    names = only.split(",") if only else list(TARGETS)
    if not (FOLDER / "inputs").is_dir():
        (FOLDER / "inputs").mkdir(parents=True)
        build_inputs(FOLDER / "inputs")
    before, begin = set(findings()), time.monotonic()
    turn = max(min(TURN_S, seconds // len(names)), 1)
    turns = 0
    while time.monotonic() - begin < seconds or turns < len(names):
        sums = _sums()
        run_one(min(names, key=lambda name: sums.get(name, {}).get("seconds", 0)), turn)
        turns += 1
    new = sorted(set(findings()) - before)
    lines = [table(names), *(f"found: {path}" for path in new)]
    sys.stdout.write("\n".join(lines) + "\n")
    sys.exit(1 if new else 0)


def run_one(name: str, seconds: int) -> None:
    """Fuzz a target for a while in a process of its own, and add up what it did."""
    words = [sys.executable, "-m", "fuzz.one", name, str(FOLDER), str(seconds)]
    environment = os.environ | {"PYTHONHASHSEED": "0"}
    process = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE,
                               stdout=subprocess.DEVNULL, text=True, errors="replace")  # fmt: skip
    used = _processor_s()
    try:
        _, said = process.communicate(timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        process.kill()
        _, said = process.communicate()
    place = FOLDER / "said" / f"{name.replace(' ', '-')}.txt"
    place.parent.mkdir(exist_ok=True)
    place.write_text(said[-20_000:])
    counts = COUNTS.findall(said) or [("0", "0", "0")]
    if process.returncode and not re.search(r"Test unit written to", said):
        found = FOLDER / "found" / name.replace(" ", "-")
        found.mkdir(parents=True, exist_ok=True)
        (found / f"ended{process.returncode:+}").write_text(said[-20_000:])
    runs = sum(map(int, RAN.findall(said)))
    edges, features, corpus = map(int, counts[-1])
    sums = _sums()
    mine = sums.setdefault(name, {"seconds": 0, "processor_s": 0.0, "runs": 0})
    mine["seconds"] += seconds
    mine["processor_s"] = round(mine["processor_s"] + _processor_s() - used, 1)
    mine["runs"] += runs
    mine |= {"edges": edges, "features": features, "corpus": corpus}
    (FOLDER / "sums.json").write_text(json.dumps(sums, indent=1))


def _processor_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _sums() -> dict[str, dict[str, float]]:
    path = FOLDER / "sums.json"
    return json.loads(path.read_text()) if path.exists() else {}


def findings() -> list[Path]:
    """Return the files of what was found, without their texts."""
    return [path for path in FOLDER.glob("found/*/*") if path.suffix != ".txt"]


def table(names: list[str]) -> str:
    """Return what was done so far in all runs, a line a target."""
    sums = _sums()
    head = ("target", "seconds", "processor s", "runs", "edges", "corpus", "found")
    rows = [head]
    for name in names:
        mine = sums.get(name, {})
        folder = name.replace(" ", "-")
        found = sum(path.parent.name == folder for path in findings())
        keys = ("seconds", "processor_s", "runs", "edges", "corpus")
        rows.append((name, *(f"{mine.get(key, 0):,.0f}" for key in keys), str(found)))
    wide = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join(
        "  ".join(cell.rjust(width) if k else cell.ljust(width)
                  for k, (cell, width) in enumerate(zip(row, wide, strict=True)))
        for row in rows
    )  # fmt: skip


if __name__ == "__main__":
    main()

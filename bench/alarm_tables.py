"""The figures of the alarm as Markdown, from the JSON of both its benches alone.

Example: ``python bench/alarm_tables.py --page docs/limits.md`` puts them between the page's marks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pages
from figures import ROOT

Report = Mapping[str, Any]
MOVES = {
    "0.3": "0.3 m, any direction",
    "yaw": "yaw by 0.5 degrees",
    "tilt": "pitch or roll by 0.5 degrees",
}
TRAFFIC = {"ordinary": "2600 vehicles an hour", "light": "650 vehicles an hour"}
WITNESSES = {
    "whole": "both, as `track` asks them",
    "still": "still returns alone",
    "vehicles": "traffic alone",
}


def main() -> None:
    """Read both files, write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    out = ROOT / "out"
    parser.add_argument("--alarm", type=Path, default=out / "bench-alarm.json")
    parser.add_argument("--knocks", type=Path, default=out / "bench-alarm-knocks.json")
    parser.add_argument("--page", type=Path, help="whose marked part is replaced")
    arguments = parser.parse_args()
    alarm, knocks = (json.loads(p.read_text()) for p in (arguments.alarm, arguments.knocks))
    text = "\n\n".join([noticed(alarm), days(alarm), false_alarms(alarm), blows(knocks)])
    print(text)
    out.mkdir(exist_ok=True)
    (out / "bench-alarm.md").write_text(text + "\n")
    if arguments.page is not None:
        pages.put(arguments.page, {"alarm": text})


def noticed(report: Report) -> str:
    """Return how often a move was noticed within ten minutes, by which change detector."""
    rows = []
    for traffic, about in TRAFFIC.items():
        made = [
            v for k, v in report.items() if k.startswith(f"{traffic},") and k.endswith("noticed")
        ]
        for move, size in MOVES.items():
            there = [each[move] for each in made if move in each]
            trials = sum(each["trials"] for each in there)
            seen = [sum(each[who]["noticed"] for each in there) for who in WITNESSES]
            rows.append([f"{size}; {about}", *(f"{count} of {trials}" for count in seen)])
    return table(["move within ten minutes", *WITNESSES.values()], rows)


def days(report: Report) -> str:
    """Return how often a move was noticed on drawn days, by kind of day and number of targets."""
    rests = [v for k, v in report.items() if k.endswith(", rest")]
    kinds: dict[str, list[Report]] = {}
    for rest in rests:
        whole = rest["targets"]
        for name, figures in rest.items():
            if name.endswith(" targets"):
                day, count = name.removesuffix(" targets").split(", ")
                many = "all (about 60)" if int(count) == whole else count
                kinds.setdefault(f"{many}, {_WANDER[day]}", []).append(figures)
    rows = []
    for name, made in kinds.items():
        cells = [
            f"{sum(m[move]['noticed'] for m in made if move in m)} of "
            f"{sum(m[move]['trials'] for m in made if move in m)}"
            for move in MOVES
        ]
        rows.append([name, *cells])
    return table(["targets of a radar", *MOVES.values()], rows)


BLOWS = {"traffic": "traffic alone", "both": "with still returns"}
_WANDER = {"steady": "wandering over seconds", "changing": "wandering for hours"}


def false_alarms(report: Report) -> str:
    """Return the false alarms of changing days by the tail of half-hourly maxima."""
    rows = []
    for who, about in WITNESSES.items():
        f = report[f"false, all, {who}"]
        rows.append(
            [about, f"{f['hours']:.0f}", str(f["alarms"]), f"{f['largest']:.2f}", monthly(f)]
        )
    heads = ["false alarms", "hours", "alarms", "largest score of the gate", "a month (95 %)"]
    sees = np.mean([v["day"]["sees"] for k, v in report.items() if k.endswith(", rest")])
    said = f"In {sees:.0%} of the minutes of these days the still returns decided alone."
    return f"{table(heads, rows)}\n\n{said}"


def blows(report: Report) -> str:
    """Return what the test of the newest 20 and 60 s reports of a sensor at rest."""
    rows = []
    for who, about in BLOWS.items():
        made = [v for k, v in report.items() if k.endswith(f", {who}")]
        if not made:
            continue
        hours, moved = sum(m["hours"] for m in made), sum(m["moved"] for m in made)
        quiet = np.average([m["unmoved"] for m in made], weights=[m["hours"] for m in made])
        rate = monthly(report.get("traffic, all", {})) if who == "traffic" else "-"
        rows.append([about, f"{hours:.1f}", f"{quiet:.0%}", str(moved), rate])
    heads = ["test for a blow", "hours at rest", "of these not asked", "reports", "a month (95 %)"]
    return table(heads, rows)


def monthly(figures: Report) -> str:
    """Return a rate with its interval."""
    if "monthly_95" not in figures:
        return "-"
    low, high = figures["monthly_95"]
    return f"{_rate(figures['monthly'])} ({_rate(low)} to {_rate(high)})"


def _rate(value: float) -> str:
    return "under 0.01" if value < 0.01 else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


if __name__ == "__main__":
    main()

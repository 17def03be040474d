"""Figures of all benchmarks in one table, beside those of peers; and which became worse.

Each benchmark leaves its figures in `out/bench`; here they are compared with those of
`bench/accepted.json`. Exit code 1 where one of these is worse by more than it varies from run to
run, or was not measured.

Example: ``python bench/summary.py``; with ``--accept`` the figures become the accepted ones, with
``--into docs/speed.md`` those of speed and memory go between that page's marks *speed*.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import figures
import pages
from figures import TARGET, TIME_CHANCE, Figure, short

ACCEPTED = figures.ROOT / "bench" / "accepted.json"
MARK = "speed"


def main() -> None:
    """Print the table of all figures, and name those that became worse."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=figures.OUT)
    parser.add_argument("--accepted", type=Path, default=ACCEPTED)
    parser.add_argument("--accept", action="store_true", help="take the figures as accepted")
    parser.add_argument("--into", type=Path, metavar="MD", help="page that gets the table")
    arguments = parser.parse_args()
    found = [each for path in sorted(arguments.out.glob("*.json")) for each in figures.read(path)]
    if not found:
        sys.exit(f"{arguments.out}: no benchmark left its figures here: `make bench` runs all")
    accepted = json.loads(arguments.accepted.read_text()) if arguments.accepted.exists() else {}
    print(table(found, accepted))
    if arguments.into is not None:
        pages.put(arguments.into, {MARK: speed(found)})
    if arguments.accept:
        known = accepted | {each.what: round(each.ours, 6) for each in found}
        arguments.accepted.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
    elif lines := worse(found, accepted):
        sys.exit("\n".join(lines))


def table(found: Sequence[Figure], accepted: Mapping[str, float]) -> str:
    """Return the figures as Markdown, beside peers and the accepted ones."""
    return figures.table(
        ["what", "ours", "beside", "ratio", "accepted", "change"],
        (
            [
                each.name, short(each.ours, each.unit),
                "" if each.peer is None else f"{short(each.peer, each.unit)} {each.peer_name}",
                "" if each.ratio is None else f"{each.ratio:.2f}",
                *_since(each, accepted),
            ]
            for each in found
        ),
    )  # fmt: skip


def _since(figure: Figure, accepted: Mapping[str, float]) -> tuple[str, str]:
    """Return the accepted figure, and whether this one is worse or better."""
    if figure.what not in accepted:
        return "", ""
    before = accepted[figure.what]
    more = figure.change(before)
    return short(before, figure.unit), "worse" if more > 0.0 else "better" if more < 0.0 else ""


def speed(found: Sequence[Figure]) -> str:
    """Return the figures of time and memory as a Markdown table."""
    rows = []
    for each in (figure for figure in found if figure.chance == TIME_CHANCE):
        beside = ""
        if each.peer is not None and each.peer_name == TARGET:
            beside = f"{short(each.peer, each.unit)} {TARGET}"
        elif each.ratio is not None:
            beside = f"{each.ratio:.3g} x {each.peer_name}"
        rows.append([each.name, short(each.ours, each.unit), beside])
    return figures.table(["work", "figure", "beside"], rows)


def worse(found: Sequence[Figure], accepted: Mapping[str, float]) -> list[str]:
    """Return a line for each accepted figure that became worse or was not measured."""
    measured = {each.what for each in found}
    return [f"{what}: not measured" for what in accepted if what not in measured] + [
        f"{each.what}: {short(each.ours, each.unit)}, accepted is "
        f"{short(accepted[each.what], each.unit)}"
        for each in found
        if each.what in accepted and each.change(accepted[each.what]) > 0.0
    ]


if __name__ == "__main__":
    main()

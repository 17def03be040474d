"""Put the accuracy in plain words before the tables of docs/accuracy.md, from these: no options."""

from __future__ import annotations

import re
import statistics
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "bench"))
import pages

ROOT = Path(__file__).parents[1]
PAGE, NAME = ROOT / "docs" / "accuracy.md", "plain accuracy"
FOUND = "`vehicles`, found poses"
# Names of traffic, with the largest true occupancy (percent) of each.
TRAFFIC = (("light traffic", 5.0), ("busy roads", 12.0), ("queues", 100.0))


def plain_table(text: str) -> str:
    """Return the table in plain words from the text of the page."""
    return "\n".join(["| what | how good |", "|---|---|", *_poses(text), *_occupancy(text)])


def _rows(text: str, mark: str) -> list[dict[str, str]]:
    """Return the rows of the first table after a mark, by the titles of their columns."""
    lines = text.split(f"<!-- {mark} -->")[1].strip().splitlines()
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    body = [cells for cells in table[2 : [*lines, ""].index("")] if len(cells) == len(table[0])]
    return [dict(zip(table[0], cells, strict=True)) for cells in body]


def _poses(text: str) -> list[str]:
    ours = [row for row in _rows(text, "accuracy") if row["site"].startswith("ours")]
    far = [float(row["2D mean, median"].split(",")[0]) for row in ours]
    turned = [float(row["yaw"].split()[0]) for row in ours]
    right = [int(re.findall(r"\d+", row["right"])[0]) for row in ours]
    wrong = [int(n) for row in ours for n in re.findall(r"(\d+)% wrong", row["right"])]
    others = "the others are refused or said to be unsure, "
    others += f"at most {max(wrong)} % are wrong" if wrong else "none is wrong"
    rows = {
        "place of a radar, found from 100 s of traffic": (
            f"{min(far):.2f} to {max(far):.2f} m off, on average by site"
        ),
        "where it looks": f"{min(turned):.2f} to {max(turned):.2f} degrees off",
        "how often a place is found": f"{min(right)} to {max(right)} % of the tries; {others}",
    }
    return [f"| {what} | {text} |" for what, text in rows.items()]


def _occupancy(text: str) -> list[str]:
    rows = _rows(text, "vehicles")
    lines, least = [], 0.0
    for words, most in TRAFFIC:
        errors = [
            float(row[FOUND].split("/")[2]) for row in rows
            if least <= float(row["true mean"].rstrip("%")) < most
        ]  # fmt: skip
        span = f"{least:g} to {most:g} %" if least else f"under {most:g} %"
        span = f"over {least:g} %" if most == TRAFFIC[-1][1] else span
        where = f"where one is there {span} of the time"
        lines.append(
            f"| share of time with a vehicle, {words} ({where}) | mostly "
            f"{statistics.median(errors):.1f} percentage points off "
            f"({min(errors):.1f} to {max(errors):.1f}, {len(errors)} scenes) |"
        )
        least = most
    return lines


def main() -> None:
    """Write the table into the page."""
    pages.put(PAGE, {NAME: plain_table(PAGE.read_text(encoding="utf-8"))})


if __name__ == "__main__":
    main()

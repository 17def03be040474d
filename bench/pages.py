"""Put texts into pages, each between the marks ``<!-- NAME -->`` and ``<!-- end of NAME -->``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path


def put(page: Path, texts: Mapping[str, str]) -> None:
    """Put texts between the marks of their names; exit where a mark is missing, twice or late."""
    lines = page.read_text(encoding="utf-8").split("\n")
    for name, text in texts.items():
        begin, end = _between(lines, name, page)
        lines[begin + 1 : end] = text.split("\n")
    page.write_text("\n".join(lines), encoding="utf-8")


def _marks(name: str) -> tuple[str, str]:
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def _between(lines: list[str], name: str, page: Path) -> tuple[int, int]:
    """Return the lines of both marks."""
    for mark in _marks(name):
        if (count := lines.count(mark)) != 1:
            sys.exit(f"{page}: has the line {mark} {count} times, not once")
    begin, end = (lines.index(mark) for mark in _marks(name))
    if begin > end:
        sys.exit(f"{page}: has {_marks(name)[1]} before {_marks(name)[0]}")
    return begin, end


def picture_options(description: str | None) -> argparse.Namespace:
    """Return the options of a script that draws the demo beside its truth: demo, picture, into."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("demo", type=Path, help="results of gis-radar demo")
    parser.add_argument("picture", type=Path, metavar="PNG")
    parser.add_argument("--into", type=Path, metavar="MD", help="put the figures into this page")
    return parser.parse_args()

"""Put texts into pages, each between the marks ``<!-- NAME -->`` and ``<!-- end of NAME -->``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path


def put(page: Path, texts: Mapping[str, str]) -> None:
    """Put texts between the marks of their names; exit where one has not both once and in order."""
    lines = _lines(page)
    for name, text in texts.items():
        begin, end = _between(lines, name, page)
        lines[begin + 1 : end] = text.split("\n")
    page.write_text("\n".join(lines), encoding="utf-8")


def marked(page: Path, names: Iterable[str]) -> list[str]:
    """Return those of the names of which a page has a mark; exit where it has none."""
    lines, names = set(_lines(page)), list(names)
    there = [name for name in names if lines & set(_marks(name))]
    if not there:
        sys.exit(f"{page}: has no line {' nor '.join(_marks(name)[0] for name in names)}")
    return there


def _marks(name: str) -> tuple[str, str]:
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def _lines(page: Path) -> list[str]:
    return page.read_text(encoding="utf-8").split("\n")


def _between(lines: list[str], name: str, page: Path) -> tuple[int, int]:
    """Return the lines of both marks."""
    for mark in _marks(name):
        if (count := lines.count(mark)) != 1:
            sys.exit(f"{page}: has the line {mark} {count} times, not once")
    begin, end = (lines.index(mark) for mark in _marks(name))
    if begin > end:
        sys.exit(f"{page}: has {_marks(name)[1]} before {_marks(name)[0]}")
    return begin, end

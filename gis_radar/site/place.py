"""Places in a site file: which key, in which line, for messages that can be acted upon."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from gis_radar.errors import InputError

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\]#]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*[\"']?([A-Za-z0-9_.-]+)[\"']?\s*=")

Step = str | int


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place in a site file.

    Parameters
    ----------
    path : Path
        The file.
    lines : dict
        The line of each table and key, as from :func:`lines_of`.
    steps : tuple of str or int
        The way to it: names of tables and keys, numbers of tables of one name.
    called : str
        What a message calls the table around it.
    """

    path: Path
    lines: dict[tuple[Step, ...], int]
    steps: tuple[Step, ...] = ()
    called: str = ""

    def at(self, *steps: Step, called: str = "") -> Place:
        """Return a place below this one."""
        return replace(self, steps=(*self.steps, *steps), called=called or self.called)

    def error(self, message: str, *, hint: str = "") -> InputError:
        """Return an error that begins with the file, the line where it is known, and the table."""
        steps = self.steps
        while steps and steps not in self.lines:
            steps = steps[:-1]
        line = f", line {self.lines[steps]}" if steps else ""
        where = f"{self.called}: " if self.called else ""
        return InputError(f"{self.path}{line}: {where}{message}", hint=hint)


def lines_of(text: str) -> dict[tuple[Step, ...], int]:
    """Return the line, from 1, of each table and key of a TOML text.

    Found by the look of a line, for messages only: inside a text of several lines it may err.
    """
    lines: dict[tuple[Step, ...], int] = {}
    counts: dict[str, int] = {}
    table: tuple[Step, ...] = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header[2], counts, repeated=header[1] == "[[")
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            steps = (*table, *key[1].split("."))
            for length in range(len(table) + 1, len(steps) + 1):
                lines.setdefault(steps[:length], number)
    return lines


def _table(name: str, counts: dict[str, int], *, repeated: bool) -> tuple[Step, ...]:
    """Return the way to a table; below a repeated one, to its latest."""
    if repeated:
        counts[name] = counts.get(name, -1) + 1
    steps: list[Step] = []
    words = [word.strip().strip("\"'") for word in name.split(".")]
    for depth, word in enumerate(words, start=1):
        steps.append(word)
        latest = counts.get(".".join(words[:depth]))
        if latest is not None:
            steps.append(latest)
    return tuple(steps)

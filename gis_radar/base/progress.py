"""Receivers of progress and remarks: the command line has its own, for bars or JSON lines."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gis_radar.base.texts import Text

Level = Literal["info", "warning"]

_MOST_NAMES = 2  # stages that are named before a warning
MOST_ERROR_CHARACTERS = 500
_BLANKS = "\u00a0\u202f"  # no-break spaces: in numbers and before units
_LOGGER = logging.getLogger("gis_radar")


class Reporter:
    """Receiver of progress and remarks; this one passes remarks to :mod:`logging`."""

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Report how far a stage is.

        Parameters
        ----------
        stage : str
            What is being done, in a few words; the same text for one bar.
        done, total : int
            Units of work; `total` is None where it is not known beforehand.
        """

    def log(self, message: str, level: Level = "info") -> None:
        """Report one line to the user."""
        _LOGGER.log(logging.WARNING if level == "warning" else logging.INFO, one_line(message))

    def warn(self, template: str, /, *values: Any) -> None:
        """Report one line that the user should not miss, with values for its holes."""
        self.log(Text(template, *values), "warning")


class Silent(Reporter):
    """A receiver that drops remarks, for work whose only purpose is a picture."""

    def log(self, message: str, level: Level = "info") -> None:
        """Drop a remark."""


QUIET = Reporter()
SILENT = Silent()


@dataclass(kw_only=True)
class WarningList(Reporter):
    """A receiver that keeps each warning once, drops other remarks and hands progress on.

    Parameters
    ----------
    warnings : list of str
        The warnings.
    shown : Reporter
        Receives progress.
    """

    warnings: list[str] = field(default_factory=list)
    shown: Reporter = QUIET

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Hand on progress."""
        self.shown.progress(stage, done, total)

    def log(self, message: str, level: Level = "info") -> None:
        """Keep a warning."""
        if level == "warning" and message not in self.warnings:
            self.warnings.append(message)


def one_line(text: str, most: int = 2_000) -> str:
    """Return a text as one printable line of at most `most` characters, its middle left out.

    Text from a file or another program may be long, or hold line ends and control characters.
    """
    if len(text) > most:
        text = f"{text[: most - 150]} ... {text[-100:]}"
    line = re.sub(r"[ \t\n\v\f\r]+", " ", text).strip()
    line = "".join(each if each.isprintable() or each in _BLANKS else ascii(each)[1:-1]
                   for each in line)  # fmt: skip
    return text if line == text else line  # so that a Text keeps its template


def warnings_once(by_stage: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the warnings of stages, each once, after the names of the stages that gave it.

    A warning of more than `_MOST_NAMES` stages is about a file that all read: none is named.
    """
    stages: dict[str, list[str]] = {}
    for name, warnings in by_stage.items():
        for text in dict.fromkeys(warnings):
            stages.setdefault(text, []).append(name)
    return [
        text if len(names) > _MOST_NAMES else Text("{}: {}", Text(", ").join(names), text)
        for text, names in stages.items()
    ]

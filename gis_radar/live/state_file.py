"""State files: what a program of the live system remembers when it is started again."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from gis_radar.base import QUIET, GisRadarError, Reporter, read_json, write_json

Content = TypeVar("Content")


class StateFile:
    """File (JSON) of what a program remembers; the program goes on without it.

    Parameters
    ----------
    path : Path
        The file.
    indent : int, optional
        Blanks by which each level is indented; None writes all in one line.
    reporter : Reporter
        Receives a line where the file is damaged or cannot be written.
    """

    def __init__(self, path: Path, *, indent: int | None = 1, reporter: Reporter = QUIET) -> None:
        self._path, self._indent, self._reporter = path, indent, reporter
        self._logged = ""

    def read(self, default: Any, check: Callable[[Any], Content]) -> Content:
        """Return the content; put a damaged file aside.

        Parameters
        ----------
        default : object
            What the file is taken to hold where there is none, or a damaged one.
        check : callable
            Turns what the file holds into the content; any error of types, names or values means
            that the file is damaged.
        """
        if not self._path.exists():
            return check(default)
        try:
            return check(read_json(self._path, what="a state"))
        except (GisRadarError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
            aside = self._path.with_name(f"{self._path.name}.{secrets.token_hex(4)}")
            with suppress(OSError):  # if it cannot be renamed, the next state replaces it
                self._path.rename(aside)
            self._reporter.warn("{}: it is damaged, and put aside as {}", self._path, aside.name)
            return check(default)

    def write(self, document: Any) -> None:
        """Replace the content; log once why it cannot be written."""
        try:
            write_json(self._path, document, indent=self._indent)
        except GisRadarError as error:
            if error.message != self._logged:
                self._logged = error.message
                self._reporter.warn(error.message)
        else:
            self._logged = ""

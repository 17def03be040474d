"""What can go wrong, named: each error is one clear line and knows its exit code."""

from __future__ import annotations

from typing import ClassVar


class GisRadarError(Exception):
    """Base of every error that gis_radar raises on purpose.

    Parameters
    ----------
    message : str
        One line: what is wrong, and in which file or value.
    hint : str, optional
        One line: what to do about it.
    """

    exit_code: ClassVar[int] = 3

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class UsageError(GisRadarError):
    """The call itself makes no sense: options that do not fit each other."""

    exit_code = 2


class InputError(GisRadarError):
    """A file or a table cannot be what it should be."""


class CrsError(InputError):
    """A coordinate system is missing, geographic, or not the one of the other inputs."""


class OutputError(GisRadarError):
    """A result cannot be written where it should go."""


class NoAnswerError(GisRadarError):
    """The inputs are sound, but no trustworthy answer follows from them."""

    exit_code = 4


LOCALIZE = "pip install gis_radar[localize]"
NOTEBOOKS = "pip install gis_radar[notebooks]"

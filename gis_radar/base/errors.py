"""Errors: a class for each kind, with its exit code; a message is one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from gis_radar.base.texts import Text


class GisRadarError(Exception):
    """Base of every error that gis_radar raises on purpose.

    Parameters
    ----------
    template : str
        What is wrong, and in which file or value, with a hole `{}` for each value. Line ends in
        values become blanks.
    *values
        For the holes of the template.
    hint : str, optional
        One line: what to do about it.
    parts : sequence of GisRadarError
        For an error about several things: one for each of them, with its own hint.

    Attributes
    ----------
    about : str
        The file, place or sensor that it is about, whatever becomes of the message later: the
        first value of a template that begins with a hole and a colon; else empty.

    Examples
    --------
    >>> GisRadarError("{}: row {} has no time", "R1.csv", 3).message
    'R1.csv: row 3 has no time'
    """

    exit_code: ClassVar[int] = 3

    def __init__(
        self, template: str, /, *values: Any, hint: str = "", parts: Sequence[GisRadarError] = ()
    ) -> None:
        message = Text(template, *values)
        if len(message.splitlines()) > 1:
            flat = map(_one_line, message.values)
            message = Text(message.template, *flat) if message.values else Text(_one_line(message))
        super().__init__(message)
        self.message = message
        self.about = message.about
        self.parts = tuple(parts)
        self._hint = ""
        self.hint = hint

    @property
    def hint(self) -> str:
        """Advice to the user, or empty; tracebacks and notebooks show it below the message."""
        return self._hint

    @hint.setter
    def hint(self, hint: str) -> None:
        others = getattr(self, "__notes__", [])[bool(self._hint) :]
        self._hint = hint
        self.__notes__ = [hint, *others] if hint else others


def _one_line(value: Any) -> Any:
    lines = value.splitlines() if isinstance(value, str) else ()
    return " ".join(value.split()) if len(lines) > 1 else value


class UsageError(GisRadarError):
    """Wrong usage: options that do not fit each other."""

    exit_code = 2


class InputError(GisRadarError):
    """A bad input: a file or a table that is not what it should be."""


class CrsError(InputError):
    """A coordinate system that is missing, geographic, or not that of the other inputs."""


class OutputError(GisRadarError):
    """A place where a result cannot be written."""


class NoAnswerError(GisRadarError):
    """Sound inputs from which no trustworthy answer follows."""

    exit_code = 4


@contextmanager
def placed(where: str) -> Iterator[None]:
    """Put a place before the message of an `InputError` that the block raises.

    Parameters
    ----------
    where : str
        A file, or a place in one; not repeated where the error is about it.
    """
    try:
        yield
    except InputError as error:
        if error.about == where:
            raise
        raise type(error)("{}: {}", where, error.message, hint=error.hint) from error


def system_error(error: OSError) -> OutputError:
    """Return an error of the operating system as one of ours, with its file where it has one."""
    where = f"{error.filename}: " if error.filename else ""
    return OutputError("{}{}", where, error.strerror or error)


def first_line(error: Exception) -> str:
    """Return the first line of an error of a library, or its kind where it has no text."""
    return str(error).partition("\n")[0] or type(error).__name__


INSTALL_LOCALIZE = Text("pip install gis_radar[localize]")
INSTALL_TRAJECTORIES = Text("pip install gis_radar[trajectories]")

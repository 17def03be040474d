"""The frame around each command: its door, its errors, its exit code."""

from __future__ import annotations

import functools
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

import click

from gis_radar.cli.console import Door, HumanDoor, JsonDoor, Result
from gis_radar.cli.leash import wear_leash
from gis_radar.errors import GisRadarError, OutputError, UsageError

INTERRUPTED = 130

Verb = Callable[..., Result]


def command(group: click.Group, *, example: str) -> Callable[[Verb], Verb]:
    """Make a function that reports and returns a result into a command of `group`.

    Parameters
    ----------
    group : click.Group
        Where the command belongs.
    example : str
        A call that works, shown at the end of its help.
    """

    def register(verb: Verb) -> Verb:
        @functools.wraps(verb)
        def run(*, json_lines: bool, **options: Any) -> None:
            with _door(json_lines=json_lines) as door:
                try:
                    result = verb(reporter=door.reporter, **options)
                except BrokenPipeError as error:
                    # click takes every broken pipe for standard output's, and says nothing.
                    if not _is_heard():
                        raise
                    raise OutputError(f"a program that was started ended early: {error}") from error
            door.result(result)
            if result.failure is not None:
                raise result.failure

        flagged = click.option(
            "--json", "json_lines", is_flag=True, help="Print one JSON object a line."
        )(run)
        group.command(epilog=f"Example: {example}")(flagged)
        return verb

    return register


def _door(*, json_lines: bool) -> Door:
    return JsonDoor() if json_lines else HumanDoor()


def open_door(group: click.Group) -> NoReturn:
    """Run the command line and leave with the exit code that says how it went."""
    signal.signal(signal.SIGTERM, _interrupt)
    wear_leash()
    door = _door(json_lines="--json" in sys.argv)
    try:
        group(standalone_mode=False)
    except click.exceptions.Exit as leave:
        sys.exit(leave.exit_code)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        hint = f"try {context.command_path} --help" if context else ""
        _fail(door, UsageError(error.format_message(), hint=hint))
    except GisRadarError as error:
        _fail(door, error)
    except (KeyboardInterrupt, click.Abort):
        _fail(door, GisRadarError("interrupted; nothing was left half-written"), INTERRUPTED)
    except OSError as error:
        if not _is_heard():
            _leave_unheard()
        where = f"{error.filename}: " if error.filename else ""
        _fail(door, OutputError(f"{where}{error.strerror or error}"))
    sys.exit(0)


def _fail(door: Door, error: GisRadarError, code: int | None = None) -> NoReturn:
    try:
        door.error(error)
    except BrokenPipeError:
        _leave_unheard()
    sys.exit(error.exit_code if code is None else code)


def _is_heard() -> bool:
    """Tell whether standard output is still open; it may be another pipe that broke."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return False
    return True


def _leave_unheard() -> NoReturn:
    """Leave when nobody listens any more; Python's own flush at exit would complain."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(INTERRUPTED)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt

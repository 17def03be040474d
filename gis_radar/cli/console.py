"""Run a command: bars and tables for people, JSON lines for programs, errors and exit codes."""

from __future__ import annotations

import functools
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from types import FrameType, TracebackType
from typing import Any, NoReturn, Self

import click
import rich.console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text as Cell

from gis_radar import base
from gis_radar.base import (
    MOST_ERROR_CHARACTERS,
    GisRadarError,
    Level,
    OutputError,
    Reporter,
    Text,
    UsageError,
    first_line,
    free_address_space,
    in_language,
    interrupt_main_thread,
    json_text,
    one_line,
    refuse_inputs,
    system_error,
    tr,
    users_language,
    watch_input,
)
from gis_radar.cli.result_tables import (
    as_lines,
    as_title,
    is_table,
    print_wide,
    table_of_answer,
    table_of_entries,
    table_of_rows,
)
from gis_radar.cli.usage import text_of_click

# Shown with --json only: constants in effect, findings that `remarks` has as sentences, and errors
# that follow.
_FOR_PROGRAMS = {"settings", "found", "failed"}
_SILENT_S = 30.0  # between lines of progress in a log
_MOST_BARS = 8  # with more than that, full bars are hidden


@dataclass(frozen=True, kw_only=True)
class Result:
    """Outputs and summary of a command.

    Parameters
    ----------
    outputs : list of Path
        The files and folders it wrote.
    summary : mapping
        Figures worth a look, by name; a mapping of mappings is a table.
    failure : GisRadarError, optional
        Error about missing parts, reported after the result.
    advice : str
        Advice on the next step; for people only.
    timezone : str
        IANA zone of the times that people read in the summary; JSON keeps UTC.
    rows : sequence of mappings, optional
        Rows of a query's answer, with unchanged values: a table for people, objects in JSON.
    """

    outputs: list[Path]
    summary: Mapping[str, Any] = field(default_factory=dict)
    failure: GisRadarError | None = None
    advice: str = ""
    timezone: str = "UTC"
    rows: Sequence[Mapping[str, Any]] | None = None


class Console(Reporter):
    """Destination of a command's progress, result and errors, in the user's language."""

    language: str

    def translated(self, text: str) -> str:
        """Return a text in the user's language."""
        with in_language(self.language):
            return tr(text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def result(self, result: Result) -> None:
        """Write what was done."""
        raise NotImplementedError

    def error(self, error: GisRadarError) -> None:
        """Write what went wrong."""
        raise NotImplementedError


class JsonConsole(Console):
    """Console of JSON objects, one a line on standard output; English unless set otherwise."""

    def __init__(self) -> None:
        self.language = users_language(chosen_only=True)

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Write the progress of a stage."""
        self._write(event="progress", stage=self.translated(stage), done=done, total=total)

    def log(self, message: str, level: Level = "info") -> None:
        """Write a remark."""
        text = one_line(self.translated(message))
        self._write(event="log", level=level, message=text)

    def result(self, result: Result) -> None:
        """Write what was done."""
        outputs = [str(path) for path in result.outputs]
        rows = {} if result.rows is None else {"rows": result.rows}
        with in_language(self.language):
            summary, local = _translated(result.summary), _translated(_by_local_clocks(result))
        shown = {} if local == summary else {"local": local}  # for people, as on the terminal
        self._write(event="result", outputs=outputs, summary={**summary, **rows}, **shown)

    def error(self, error: GisRadarError) -> None:
        """Write what went wrong; the code is the exit code."""
        message = one_line(self.translated(error.message), MOST_ERROR_CHARACTERS)
        hint = one_line(self.translated(error.hint))
        parts = [
            {name: one_line(self.translated(getattr(part, name))) for name in ("message", "hint")}
            for part in error.parts
        ]
        further = {"parts": parts} if parts else {}
        self._write(event="error", code=error.exit_code, message=message, hint=hint, **further)

    @staticmethod
    def _write(**record: Any) -> None:
        # Names of files need not be UTF-8: bytes that are not are escaped.
        text = json_text(record).encode("utf-8", "backslashreplace").decode("utf-8")
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def _translated(value: Any) -> Any:
    """Return a value with its finished texts translated; names, keys and plain words stay."""
    if isinstance(value, Text):
        return tr(value)
    if isinstance(value, Mapping):
        return {name: _translated(each) for name, each in value.items()}
    return [_translated(each) for each in value] if isinstance(value, list | tuple) else value


class TerminalConsole(Console):
    """Console of bars and remarks on standard error, and of the result on standard output."""

    def __init__(self) -> None:
        self.language = users_language()
        self._rich = rich.console.Console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(),
            console=self._rich,
            transient=True,
            disable=not self._rich.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._shares: dict[str, str] = {}  # of stages that moved since the last line, without bars
        self._printed_at = monotonic()

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Move the stage's bar; without a terminal print a line now and then."""
        if not self._rich.is_terminal:
            self._print_shares(stage, done, total)
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(self.translated(stage), total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)
        if done == total and len(self._tasks) > _MOST_BARS:
            self._bars.update(self._tasks[stage], visible=False)

    def _print_shares(self, stage: str, done: int, total: int | None) -> None:
        """Print how far each moving stage is, if nothing was printed for `_SILENT_S`."""
        self._shares.pop(stage, None)
        if done != total:
            self._shares[stage] = f" {100 * done // total} %" if total else ""
        if self._shares and monotonic() - self._printed_at >= _SILENT_S:
            self._printed_at = monotonic()
            shares = [f"{self.translated(name)}{each}" for name, each in self._shares.items()]
            self._shares.clear()  # a stage that failed or has no end would stay for ever
            text = one_line(", ".join(shares))
            self._rich.print(text, markup=False, highlight=False, soft_wrap=True)

    def log(self, message: str, level: Level = "info") -> None:
        """Print a remark."""
        self._printed_at = monotonic()
        prefix = f"{self.translated('warning')}: " if level == "warning" else ""
        text = one_line(self.translated(message))
        self._rich.print(f"{prefix}{text}", markup=False, highlight=False, soft_wrap=True)

    def result(self, result: Result) -> None:
        """Print the figures as a table, then the outputs."""
        with in_language(self.language):
            self._print(result)

    def _print(self, result: Result) -> None:
        """Print figures line by line, each table, a query's rows, the outputs, and advice."""
        out = rich.console.Console()
        table = Table(show_header=False, box=None, pad_edge=False)
        tables = []
        for name, value in _by_local_clocks(result).items():
            if name in _FOR_PROGRAMS:
                continue
            if isinstance(value, list) and value and isinstance(value[0], list):
                tables.append((name, value))
            elif is_table(value):
                print_wide(table_of_entries(name, value), out.width)
            else:
                table.add_row(as_title(name), Cell(as_lines(name, value)))
        out.print(table)
        for name, rows in tables:
            out.print(table_of_rows(name, rows))
        if result.rows:
            print_wide(table_of_answer(result.rows), out.width)
        for path in result.outputs:
            out.print(tr("wrote {path}", path=path), markup=False, highlight=False, soft_wrap=True)
        if result.advice:
            out.print(tr(result.advice), markup=False, highlight=False, soft_wrap=True)

    def error(self, error: GisRadarError) -> None:
        """Print the error as one line with its hint, or a line for each of its parts."""
        for part in error.parts:
            self.error(part)
        if error.parts:
            return
        hint = f" ({one_line(self.translated(error.hint))})" if error.hint else ""
        message = one_line(self.translated(error.message), MOST_ERROR_CHARACTERS)
        text = f"gis-radar: {message}{hint}"
        self._rich.print(text, markup=False, highlight=False, soft_wrap=True)


def _by_local_clocks(result: Result) -> dict[str, Any]:
    """Return the summary with local times in place of UTC, and the name of their zone."""
    summary = dict(result.summary)
    if result.timezone == "UTC":
        return summary
    zone = base.zone_of(result.timezone)

    def local(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: local(each) for name, each in value.items()}
        if isinstance(value, list | tuple):
            return [local(each) for each in value]
        return base.localised(value, zone) if isinstance(value, str) else value

    shown = {name: local(value) for name, value in summary.items()}
    return {**shown, "timezone": result.timezone} if shown != summary else summary


_TRACEBACK = "GIS_RADAR_TRACEBACK"
"""The environment variable that shows the traceback of an unforeseen error."""
UNFORESEEN = "unforeseen"
NO_MEMORY = Text("there is not enough memory")
_LEAST_FREE_BYTES = 64 << 20  # with 100 MiB commands work or end with an error; with 30 GDAL aborts
# In errors of the loader, of threads and of LLVM, which raise no MemoryError.
_NO_MEMORY_TEXTS = (
    "failed to map segment", "can't start new thread", "Cannot allocate memory", "libllvmlite.so",
)  # fmt: skip
_REPEAT_S = 0.1  # until the callback that dropped an interruption is over
INTERRUPTED = 130
_OUTPUTS = ("output", "figure", "broker_files")  # of options: the other files are inputs
_INTERRUPTION = "interrupted; nothing was left half-written"

Verb = Callable[..., Result]


class _InterruptedError(GisRadarError):
    exit_code = INTERRUPTED


def command(*, example: str, refuses: bool = True) -> Callable[[Verb], click.Command]:
    """Return a decorator that makes a command of a function that returns a `Result`.

    Parameters
    ----------
    example : str
        A call that works, shown at the end of its help.
    refuses : bool
        Whether outputs that would take the place of an input are refused here; if not, results may
        go into a folder of inputs.
    """

    def register(verb: Verb) -> click.Command:
        @functools.wraps(verb)
        def run(*, json_lines: bool, **options: Any) -> None:
            _require_memory()
            with _console(json_lines=json_lines) as console:
                try:
                    if refuses:
                        _refuse_inputs(options)
                    result = verb(reporter=console, **options)
                except BrokenPipeError as error:
                    # click takes every broken pipe for standard output's, and stays silent.
                    if not _output_is_open():
                        raise
                    raise OutputError(
                        "a program that was started ended early: {}", error
                    ) from error
            console.result(result)
            if result.failure is not None:
                raise result.failure

        flagged = click.option(
            "--json", "json_lines", is_flag=True, help="Print one JSON object a line."
        )(run)
        return click.command(epilog=f"Example: {example}")(flagged)

    return register


def _refuse_inputs(options: Mapping[str, Any]) -> None:
    """Refuse outputs in place of another file or folder that is named, or of a dataset's file."""
    inputs = [
        path
        for name, value in options.items() if name not in _OUTPUTS
        for path in (value if isinstance(value, tuple) else (value,)) if isinstance(path, Path)
    ]  # fmt: skip
    dataset = options.get("folder")
    for output in filter(None, map(options.get, _OUTPUTS)):
        of_dataset = dataset and output.is_file() and dataset.resolve() in output.resolve().parents
        refuse_inputs(output, *inputs, *([output] if of_dataset else []))


def _require_memory() -> None:
    """Refuse to begin where memory is so short that libraries crash or hang without an error."""
    free = free_address_space()
    if free is not None and free < _LEAST_FREE_BYTES:
        raise OutputError(NO_MEMORY, hint="raise the limit of the address space (ulimit -v)")


def _console(*, json_lines: bool) -> Console:
    return JsonConsole() if json_lines else TerminalConsole()


def run_group(group: click.Group) -> NoReturn:
    """Run a command of the group and exit with its exit code."""
    signal.signal(signal.SIGTERM, _interrupt)
    sys.unraisablehook, sys.excepthook = _interrupt_again, _print_dropped
    watch_input()
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files need not be UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")
    console = _console(json_lines="--json" in sys.argv)
    try:
        group(standalone_mode=False)
    except click.exceptions.Exit as leave:
        sys.exit(leave.exit_code)
    except click.ClickException as error:
        if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):
            click.echo(error.format_message(), err=True)  # the help of a bare `gis-radar`
            sys.exit(error.exit_code)
        context = getattr(error, "ctx", None)
        hint = Text("try {} --help", context.command_path) if context else ""
        _fail(console, UsageError(text_of_click(error.format_message(), error.message), hint=hint))
    except GisRadarError as error:
        _fail(console, error)
    except (KeyboardInterrupt, click.Abort):
        _end_interrupted(console)
    except SystemError as error:
        if not _is_interruption(error):
            raise
        _end_interrupted(console)
    except Exception as error:  # noqa: BLE001 - a person shall see one line of any error
        _fail(console, _error_of(error))
    sys.exit(0)


def _is_interruption(error: BaseException | None) -> bool:
    """Return whether an interruption led to an error: compiled code raises several of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _error_of(error: Exception) -> GisRadarError:
    """Return the error to show for one of the system, or for an unforeseen one."""
    if isinstance(error, OSError) and not any(text in str(error) for text in _NO_MEMORY_TEXTS):
        if not _output_is_open():
            _exit_without_output()
        return system_error(error)
    if isinstance(error, MemoryError) or any(text in str(error) for text in _NO_MEMORY_TEXTS):
        return OutputError(NO_MEMORY, hint="take smaller parts")
    if os.environ.get(_TRACEBACK):
        raise error
    place, line = "unknown", 0
    for frame, number in traceback.walk_tb(error.__traceback__):
        if frame.f_globals.get("__name__", "").startswith("gis_radar"):
            place, line = frame.f_globals["__name__"], number
    hint = Text("an input may be damaged; please report it, with what {}=1 prints", _TRACEBACK)
    text = Text(
        "{} {} in {}, line {}: {}",
        UNFORESEEN,
        type(error).__name__,
        place,
        line,
        first_line(error)[:200],
    )
    return GisRadarError(text, hint=hint)


def _fail(console: Console, error: GisRadarError) -> NoReturn:
    """Write an error, and exit with its code; say so where memory ran out."""
    cause = error.__cause__
    while cause is not None:
        if isinstance(cause, MemoryError):  # a reader may have taken it for a damaged file
            error.hint = Text("{}, or the file claims too much", NO_MEMORY)
        cause = cause.__cause__
    try:
        console.error(error)
    except BrokenPipeError:
        _exit_without_output()
    except MemoryError:
        os.write(sys.stderr.fileno(), f"gis-radar: {NO_MEMORY}\n".encode())
    sys.exit(error.exit_code)


def _end_interrupted(console: Console) -> NoReturn:
    """Exit after an interruption; another one meanwhile would end Python with another exit code."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    _fail(console, _InterruptedError(_INTERRUPTION))


def _output_is_open() -> bool:
    """Return whether standard output is still open: a broken pipe may be another one."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return False
    return True


def _exit_without_output() -> NoReturn:
    """Exit after standard output was closed; Python's own flush at exit would raise."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(INTERRUPTED)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _print_dropped(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print an error that compiled code drops; of an interruption there is one line, later."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


def _interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Interrupt again where Python dropped an interruption, as in callbacks of its imports."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    again = threading.Timer(_REPEAT_S, interrupt_main_thread)
    again.daemon = True
    again.start()

"""CSV tables: read those that people write, and write them for spreadsheets."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from numbers import Number
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base.errors import InputError, UsageError, first_line
from gis_radar.base.steps import moment_in
from gis_radar.base.texts import Text

_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4}) +(\d{1,2})(:.*)")
"""What Excel in Germany makes of times: 12.06.2025 07:30."""
_EMPTY = re.compile(r"\A(?:sep=.|[\s;,\"])*\n")
"""Rows without values above a header, and Excel's statement of the separator."""


def csv_rows(path: str | Path, wrong: Text) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the header of a table, and the rows that are not empty with their line numbers.

    Both commas and semicolons separate, both UTF-8 and Windows-1252 are read: Excel in Germany
    writes the latter.

    Parameters
    ----------
    path : str or Path
        The file.
    wrong : Text
        Message for a file that is no table, such as `not a table of signals`.

    Raises
    ------
    InputError
        If it cannot be read, two columns have one name, or a row has more values than the header.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError("{}: cannot be read: {}", path, error.strerror or error) from error
    try:
        text = _decoded(content)
        lines, text = text.count("\n"), _EMPTY.sub("", text)
        skipped = lines - text.count("\n")
        separator = ";" if ";" in text.partition("\n")[0] else ","  # as Excel writes it in Germany
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        rows = [(skipped + reader.line_num, row) for row in reader]
    except (ValueError, csv.Error) as error:
        raise InputError("{}: {}: {}", path, wrong, first_line(error)) from error
    if twice := [name for name in header if name and header.count(name) > 1]:
        raise InputError("{}: has two columns {}", path, repr(twice[0]))
    for number, row in rows:
        if any(map(str.strip, row.pop(None, []))):
            hint = "numbers are without a separator of thousands, texts with commas in quotes"
            raise InputError(
                "{}: has more values than the header", f"{path}, line {number}", hint=hint
            )
    # without rows of separators alone, which Excel leaves below a table
    return header, [(n, row) for n, row in rows if any(text_in(row, name) for name in row)]


def _decoded(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")  # Excel's CSV, unless UTF-8 is asked for


def text_in(row: Mapping[Any, Any], name: str) -> str:
    """Return a value of a row without spaces around it; empty where there is none."""
    value = row.get(name)
    return value.strip() if isinstance(value, str) else ""


def stated_moment(text: str, zone: ZoneInfo, what: str) -> Any:
    """Return a time in UTC; one without an offset is local time of a zone.

    Parameters
    ----------
    text : str
        As :func:`moment_in` takes it, or as Excel in Germany writes it.
    zone : ZoneInfo
        Zone of a time without an offset.
    what : str
        Name of the time, for the message.

    Raises
    ------
    InputError
        If it is no time.
    """
    if german := _GERMAN.fullmatch(text):
        day, month, year, hour, rest = german.groups()
        text = f"{year}-{month:0>2}-{day:0>2} {hour:0>2}{rest}"
    try:
        return moment_in(text, zone, what=what)
    except UsageError as error:
        raise InputError("{}", error.message, hint=error.hint) from error


# First characters of formulas in spreadsheets (OWASP), in ASCII and in full width.
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def safe(cell: Any) -> Any:
    """Return a cell that is safe to write: numbers stay, text never begins a formula."""
    if cell is None or cell is pd.NaT:
        return ""
    if isinstance(cell, Number | np.bool_):
        return "" if isinstance(cell, float | np.floating) and np.isnan(cell) else cell
    text = str(cell)
    return f"'{text}" if text.lstrip(" ").startswith(FORMULA) else text


_CSV_LOCALES = ("en", "de")
_csv_locale: ContextVar[str] = ContextVar("csv_locale", default="en")


@contextmanager
def csv_for(locale: str) -> Iterator[None]:
    """Make :func:`write_csv` use the separators of `en` or `de` within the block.

    Raises
    ------
    UsageError
        If there is no such locale.
    """
    if locale not in _CSV_LOCALES:
        expected = ", ".join(_CSV_LOCALES)
        raise UsageError("csv_locale is {}, expected one of {}", repr(locale), expected)
    token = _csv_locale.set(locale)
    try:
        yield
    finally:
        _csv_locale.reset(token)


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV in UTF-8, with commas and points; what is missing is empty.

    Within `csv_for("de")` it has semicolons, decimal commas, WAHR and FALSCH, and a byte order
    mark, by which Excel recognises UTF-8.
    """
    german = _csv_locale.get() == "de"
    rows = table.astype(object).where(table.notna(), None).itertuples(index=False, name=None)
    with path.open("w", encoding="utf-8-sig" if german else "utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\r\n", delimiter=";" if german else ",")
        writer.writerow([safe(name) for name in table.columns])
        writer.writerows([_localised(safe(cell), german=german) for cell in row] for row in rows)


def _localised(cell: Any, *, german: bool) -> Any:
    if not german:
        return cell
    if isinstance(cell, bool | np.bool_):
        return "WAHR" if cell else "FALSCH"
    return str(cell).replace(".", ",") if isinstance(cell, float | np.floating) else cell

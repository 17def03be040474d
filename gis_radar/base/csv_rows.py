"""Read rows of CSV tables that people write, by hand or by a spreadsheet."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from gis_radar.base.errors import InputError, UsageError, first_line
from gis_radar.base.steps import moment_in
from gis_radar.base.texts import Text

_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4}) +(\d{1,2})(:.*)")
"""What Excel in Germany makes of times: 12.06.2025 07:30."""
_EMPTY = re.compile(r"\A(?:sep=.|[\s;,\"])*\n")
"""Rows without values above a header, and Excel's statement of the separator."""


def csv_rows(path: str | Path, wrong: Text) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the header of a table, and the rows that are not empty with their line numbers.

    Commas, semicolons or tabs separate; UTF-8, UTF-16 and Windows-1252 are read: Excel writes all
    of them.

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
        first = text.partition("\n")[0]
        separator = next((each for each in ";\t" if each in first), ",")
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
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return content.decode("utf-16")
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

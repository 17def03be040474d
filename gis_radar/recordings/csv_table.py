"""CSV tables: their header, and their rows batch by batch."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pa_csv

from gis_radar.base import InputError, first_line
from gis_radar.recordings import settings

BYTES_AT_ONCE = 1 << 20  # about 15,000 rows; the longest header
_NO_NUMBER = ["", "nan", "NaN", "NA"]
_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars"}
_LONG_VALUE = re.compile(r"'([^']{24})[^']{8,}'", re.DOTALL)  # in messages cut to its begin


@dataclass(frozen=True, kw_only=True)
class CsvTable:
    """A CSV file of which only the header has been read.

    Parameters
    ----------
    path : Path
        The file.
    names : tuple of str
        Its columns, without the spaces around them.
    header_lines : int
        Lines from the top of the file to the end of the header.
    numbers : tuple of str
        The columns that hold numbers; types of the others are inferred.
    """

    path: Path
    names: tuple[str, ...]
    header_lines: int
    numbers: tuple[str, ...]

    def batches(self, columns: Sequence[str] | None = None) -> Iterator[pa.RecordBatch]:
        """Read the rows from the first one on.

        Parameters
        ----------
        columns : sequence of str, optional
            Columns to read; by default all.

        Raises
        ------
        InputError
            If a row has more or fewer values than the header, or a text in a column of numbers.
        """
        reading = pa_csv.ReadOptions(
            block_size=BYTES_AT_ONCE,
            use_threads=False,
            column_names=self.names,
            skip_rows=self.header_lines,
        )
        converting = pa_csv.ConvertOptions(
            column_types=dict.fromkeys(self.numbers, pa.float64()),
            null_values=_NO_NUMBER,
            include_columns=columns,
        )
        try:
            with pa_csv.open_csv(
                self.path, read_options=reading, convert_options=converting
            ) as reader:
                yield from reader
        except pa.ArrowInvalid as error:
            # Arrow counts rows from the top of the file.
            place = re.compile(r"Row #(\d+)")
            reason = place.sub(lambda n: f"row {int(n[1]) - self.header_lines}", first_line(error))
            reason = _LONG_VALUE.sub(r"'\1...'", reason)
            raise InputError("{}: damaged: {}", self.path, reason) from error


def open_csv_table(path: Path, *, numbers: tuple[str, ...]) -> CsvTable:
    """Read the header of a CSV file.

    Parameters
    ----------
    path : Path
        Values separated by commas, UTF-8.
    numbers : tuple of str
        The columns that hold numbers.

    Raises
    ------
    InputError
        If the file is empty or not UTF-8, or its values are separated by something else.
    """
    with path.open("rb") as file:
        top = file.read(BYTES_AT_ONCE).removeprefix(codecs.BOM_UTF8)
    lines = top.splitlines()
    filled = next((i for i, line in enumerate(lines) if line.strip()), None)
    if filled is None:
        raise InputError("{}: cannot be read: empty file", path)
    try:
        header = lines[filled].decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            "{}: cannot be read: the header is not UTF-8 text",
            path,
            hint="save the table as CSV in UTF-8",
        ) from error
    _refuse_delimiters(header, numbers, path)
    try:
        names = tuple(name.strip() for name in next(csv.reader([header], skipinitialspace=True)))
    except csv.Error as error:  # a field of over 128 KiB
        raise InputError("{}: damaged: {}", path, first_line(error)) from error
    refuse_many_columns(len(names), path)
    return CsvTable(path=path, names=names, header_lines=filled + 1, numbers=numbers)


def refuse_many_columns(count: int, path: Path) -> None:
    """Refuse a table of more columns than any radar fills: each costs time for every batch."""
    if count > (most := settings.MOST_COLUMNS):
        raise InputError(
            "{}: has {:,} columns, at most {:,} are read",
            path,
            count,
            most,
            hint="keep the radar's own",
        )


def _refuse_delimiters(header: str, expected: tuple[str, ...], path: Path) -> None:
    """Refuse a header whose expected names another sign than a comma separates."""
    for delimiter, word in _DELIMITERS.items():
        found = {name.strip(' "') for name in header.split(delimiter)}
        if len(found.intersection(expected)) > 1:
            raise InputError(
                "{}: the columns are separated by {}, expected commas",
                path,
                word,
                hint="save the table with commas between values and points in numbers",
            )

"""Results as people read them on a terminal: tables, lists and numbers."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text as Cell

from gis_radar.base import Text, decimal, json_text, one_line, tr

_LEAST_TABLE_WIDTH, _WIDEST = 160, 100_000  # characters
_LONGEST_UNBROKEN = 25  # characters of a value that stands on one line: a time, a number


def is_table(value: Any) -> bool:
    """Return whether a value is a table: a mapping of mappings, not an empty one."""
    rows = value.values() if isinstance(value, Mapping) else ()
    return bool(rows) and all(isinstance(row, Mapping) for row in rows)


def as_lines(name: str, value: Any) -> str:
    """Return a value as text, with a line for each sentence; a lane's number stays plain digits."""
    if name.endswith("lane") and value is not None:
        return str(value)
    if isinstance(value, Mapping):
        if not value:
            return tr("none")
        if any(isinstance(each, Mapping | list) for each in value.values()):
            return json_text(value)
        return "\n".join(f"{k}: {_cell(v)}" for k, v in value.items())
    if isinstance(value, list) and any(" " in str(each) for each in value):
        return "\n".join(map(_readable, value))
    return _readable(value)


def as_title(name: str) -> str:
    """Return the name of a figure as people read it."""
    error, sigma, of = name.rpartition("sigma_")
    return f"{sigma[:-1]} {as_title(of)}" if sigma and not error else tr(name.replace("_", " "))


def table_of_rows(name: str, rows: list[list[Any]]) -> Table:
    """Return a table of rows, the first of which is the head; long cells wrap."""
    head, *rest = rows
    table = Table(box=None, pad_edge=False, title=as_title(name), title_justify="left")
    for title in head:
        table.add_column(Cell(_cell(title)), overflow="fold")  # nothing is cut
    for row in rest:
        table.add_row(*(Cell(_cell(each)) for each in row))
    return table


def table_of_answer(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the rows of a query's answer as a table; whole numbers stay plain digits."""
    table = Table(box=None, pad_edge=False)
    cells = [[_answer(each) for each in row.values()] for row in rows]
    for k, name in enumerate(rows[0] if rows else ()):
        longest = max(len(each) for each in (name, *(row[k] for row in cells)))
        table.add_column(Cell(name), overflow="fold", min_width=min(longest, _LONGEST_UNBROKEN))
    for row in cells:
        table.add_row(*map(Cell, row))
    return table


def print_wide(table: Table, width: int) -> None:
    """Print a table, wider than the terminal if need be: a number that is cut is a wrong one."""
    least = Console(width=_WIDEST).measure(table).minimum
    Console(width=max(width, _LEAST_TABLE_WIDTH, least)).print(table)


def _answer(value: Any) -> str:
    """Return a value of an answer as text, empty where there is none."""
    text = _number(value) if isinstance(value, float) else str(value)
    return "" if value is None else one_line(text, sys.maxsize)


def _number(value: float) -> str:
    """Return a number with six digits, one from 1000 on (a coordinate) with three decimals."""
    return f"{value:.3f}" if 1e3 <= abs(value) < 1e12 else f"{value:.6g}"


def table_of_entries(name: str, rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table with a row for each entry, and a column for each name that any has."""
    fullest_first = sorted(rows.values(), key=len, reverse=True)
    columns = list(dict.fromkeys(column for row in fullest_first for column in row))
    table = Table(box=None, pad_edge=False)
    for title in (name, *columns):
        table.add_column(Cell(as_title(title)), justify="left" if title == name else "right")
    for key, row in rows.items():
        cells = [row.get(column, "") for column in columns]
        texts = [_entry(c) if isinstance(c, float) else _cell(c) for c in cells]
        table.add_row(Cell(key), *map(Cell, texts))
    return table


def _entry(value: float) -> str:
    """Return a number with three decimals; whole ones from 10 on have none: 190,000 misleads."""
    return decimal(f"{value:.0f}" if abs(value) >= 10.0 and value.is_integer() else f"{value:.3f}")


def _cell(value: Any) -> str:
    """Return a value of a table as text; a single word is a state, and is translated."""
    return tr(value) if isinstance(value, str) else _readable(value)


def _readable(value: Any) -> str:
    """Return a value as text: numbers with four digits, truth as yes or no, lists with commas."""
    if value is None:
        return tr("not known")
    if isinstance(value, float):
        return decimal(f"{value:.4g}" if abs(value) < 1000 else f"{value:,.2f}")
    if isinstance(value, list | tuple):
        return ", ".join(_readable(item) for item in value)
    if isinstance(value, bool):
        return tr("yes") if value else tr("no")
    if isinstance(value, int):
        return decimal(f"{value:,}")
    return tr(value) if isinstance(value, Text) or " " in str(value) else str(value)

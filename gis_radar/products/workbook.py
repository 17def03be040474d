"""Workbooks of tables for spreadsheets (xlsx), to be read on the screen and on paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from textwrap import wrap
from typing import Any

import pandas as pd

from gis_radar.base import FILE_DATE

SHEET_ROWS = 2**20 - 1  # most rows of a sheet below its titles
_NARROW, _WIDE = 11, 64  # least and greatest width of a column, characters
_A4, _PAGE_WIDTH = 9, 180  # paper of Excel; characters that a landscape page shows legibly
_HEADS = 2  # columns that name a row
_BOLD = 1.2  # width of a bold letter
_LINE_PT = 16  # height of a line of the titles, which wrap
_OPTIONS = {
    "strings_to_formulas": False, "strings_to_urls": False,
    "default_format_properties": {"valign": "top"},  # a line of figures beside a name of two
}  # fmt: skip


def write_workbook(sheets: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Write tables as sheets of a workbook; equal tables give equal bytes.

    Text is text, also where it begins like a formula; the titles stay in view. Numbers are shown
    with the digits that mean something, and kept whole. Printed, each page names its rows.

    Parameters
    ----------
    sheets : mapping
        Tables by the title of their sheet, their columns named by titles; times without zones, as
        spreadsheets know none.
    path : Path
        The file.
    """
    # its temporary files lie beside it: a full disk there is named as that of any output
    with pd.ExcelWriter(
        path, engine="xlsxwriter", datetime_format="yyyy-mm-dd hh:mm:ss",
        engine_kwargs={"options": _OPTIONS | {"tmpdir": str(path.parent)}},
    ) as writer:  # fmt: skip
        book = writer.book
        book.set_properties({"created": datetime.combine(FILE_DATE, datetime.min.time())})
        whole, shares, numbers = (
            book.add_format(form) for form in ({}, {"num_format": "0.000"}, {"num_format": "0.0"})
        )
        # without the indent texts touch a number on their left
        texts = book.add_format({"text_wrap": True, "align": "left", "indent": 1})
        titles = _title_formats(book)
        for name, table in sheets.items():
            table.to_excel(writer, sheet_name=name, index=False, header=False, startrow=1)
            sheet = writer.sheets[name]
            sheet.freeze_panes(1, 0)
            widths = [_column_width(str(each), values) for each, values in table.items()]
            for column, (width, each) in enumerate(zip(widths, table, strict=True)):
                is_text = not _is_on_the_right(table[each])
                shown = texts if is_text else whole
                if pd.api.types.is_float_dtype(table[each]):
                    shown = shares if str(each).endswith("[0-1]") else numbers
                sheet.write(0, column, each, titles[is_text])
                sheet.set_column(column, column, width, shown)
            for row, height in _heights(table, widths).items():
                sheet.set_row(row, height)
            _set_up_print(sheet, len(table), widths)


def _title_formats(book: Any) -> dict[bool, Any]:
    """Return how titles are written, by whether they are those of texts."""
    title = {"bold": True, "text_wrap": True, "bottom": 1}
    return {
        True: book.add_format(title | {"align": "left", "indent": 1}),
        False: book.add_format(title | {"align": "right"}),
    }


def _is_on_the_right(values: pd.Series) -> bool:
    """Return whether spreadsheets put a column's values on the right: numbers and times."""
    of_numbers = pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_bool_dtype(values)
    return of_numbers or pd.api.types.is_datetime64_any_dtype(values)


def _heights(table: pd.DataFrame, widths: Sequence[int]) -> dict[int, int]:
    """Return the heights of the titles' row, 0, and of rows with cells of several lines."""
    lines = {0: max(map(_lines, table, widths))}
    for width, (_, values) in zip(widths, table.items(), strict=True):
        if width == _WIDE:
            for row, cell in enumerate(values, 1):
                if len(str(cell)) > width / _BOLD:  # the only ones that wrap
                    lines[row] = max(_lines(cell, width), lines.get(row, 1))
    return {row: _LINE_PT * count for row, count in lines.items()}


def _lines(cell: object, width: int) -> int:
    """Return the number of lines of a cell's text in a column, as if it were bold."""
    return len(wrap(str(cell), int(width / _BOLD)))


def _set_up_print(sheet: Any, rows: int, widths: Sequence[int]) -> None:
    """Set up a sheet's print: landscape, with titles and names on each page; and its filter."""
    sheet.set_landscape()
    sheet.set_paper(_A4)
    sheet.repeat_rows(0)
    heads = sum(widths[:_HEADS])
    sheet.fit_to_pages(max(math.ceil((sum(widths) - heads) / (_PAGE_WIDTH - heads)), 1), 0)
    if len(widths) > _HEADS:
        sheet.repeat_columns(0, _HEADS - 1)
        sheet.autofilter(0, 0, rows, len(widths) - 1)


def _column_width(title: str, values: pd.Series) -> int:
    """Return the width of a column, characters: of its longest value, and word of the title."""
    if pd.api.types.is_float_dtype(values):
        values = values.round(1)
    longest = max((len(str(value)) for value in values.dropna()), default=0)
    word = max(map(len, title.split()))
    return min(max(longest + 1, int(_BOLD * word) + 1, _NARROW), _WIDE)

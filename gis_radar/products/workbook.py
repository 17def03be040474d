"""A workbook (xlsx) for people: titles that wrap, columns as wide as what they hold."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from textwrap import wrap

import pandas as pd

from gis_radar.base import FILE_DATE

SHEET_ROWS = 2**20 - 1  # most rows of a sheet below its titles
_NARROW, _WIDE = 14, 64  # least and greatest width of a column, characters
_BOLD = 1.2  # width of a bold letter
_LINE_PT = 16  # height of a line of the titles, which wrap
_AS_TEXT = {"strings_to_formulas": False, "strings_to_urls": False}


def write_workbook(sheets: Mapping[str, pd.DataFrame], path: Path) -> None:
    """Write tables as sheets of a workbook; equal tables give equal bytes.

    Text is text, also where it begins like a formula; the titles stay in view.

    Parameters
    ----------
    sheets : mapping
        Tables by the title of their sheet, their columns named by titles; times without zones, as
        spreadsheets know none.
    path : Path
        The file.
    """
    with pd.ExcelWriter(
        path, engine="xlsxwriter", datetime_format="yyyy-mm-dd hh:mm:ss",
        engine_kwargs={"options": _AS_TEXT},
    ) as writer:  # fmt: skip
        book = writer.book
        book.set_properties({"created": datetime.combine(FILE_DATE, datetime.min.time())})
        title = book.add_format({"bold": True, "text_wrap": True, "valign": "top", "bottom": 1})
        for name, table in sheets.items():
            table.to_excel(writer, sheet_name=name, index=False, header=False, startrow=1)
            sheet = writer.sheets[name]
            sheet.write_row(0, 0, list(table), title)
            sheet.freeze_panes(1, 0)
            lines = 1
            for column, each in enumerate(table):
                longest = max((len(str(value)) for value in table[each].dropna()), default=0)
                word = max(map(len, str(each).split()))
                width = min(max(longest + 1, int(_BOLD * word) + 1, _NARROW), _WIDE)
                sheet.set_column(column, column, width)
                lines = max(lines, len(wrap(str(each), int(width / _BOLD))))
            sheet.set_row(0, _LINE_PT * lines)

"""Write CSV for spreadsheets: with a country's separators, and no cell that is a formula."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from numbers import Number
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gis_radar.base.errors import UsageError

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

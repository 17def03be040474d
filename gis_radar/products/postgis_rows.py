"""Rows of tables in the formats that PostgreSQL copies from."""

from __future__ import annotations

import io
from datetime import UTC

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv


def csv_rows_of(table: pd.DataFrame) -> bytes:
    """Return a table as CSV without a header."""
    text = io.BytesIO()
    without_titles = pyarrow.csv.WriteOptions(include_header=False)
    pyarrow.csv.write_csv(pa.Table.from_pandas(table, preserve_index=False), text, without_titles)
    return text.getvalue()


def binary_rows_of(table: pd.DataFrame) -> bytes:
    """Return numbers and times without nulls in PostgreSQL's binary format of rows."""
    columns = []
    for name in table:
        values = table[name]
        if isinstance(values.dtype, pd.DatetimeTZDtype):
            since = values.dt.tz_convert(UTC) - pd.Timestamp("2000-01-01", tz=UTC)
            values = since // pd.Timedelta(microseconds=1)
        wide = np.dtype("f8") if values.dtype.kind == "f" else np.dtype(str(values.dtype))
        columns.append(values.to_numpy(wide.newbyteorder(">")))
    kinds = [(f"{place}{what}", kind) for place, column in enumerate(columns)
             for what, kind in (("size", ">i4"), ("value", column.dtype))]  # fmt: skip
    rows = np.empty(len(table), [("fields", ">i2"), *kinds])
    rows["fields"] = len(columns)
    for place, column in enumerate(columns):
        rows[f"{place}size"], rows[f"{place}value"] = column.dtype.itemsize, column
    return b"PGCOPY\n\xff\r\n\0" + bytes(8) + rows.tobytes() + b"\xff\xff"

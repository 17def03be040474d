"""Schema of a table: its columns in order, their meaning, and the rules of its rows."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import InputError

_INT, _TEXT = pa.int64(), pa.string()


@dataclass(frozen=True)
class TableColumn:
    """A column of a table.

    Parameters
    ----------
    name : str
        Name in the files.
    type : pyarrow.DataType
        Arrow's type.
    means : str
        Meaning of its values, with the unit where the name has none.
    nullable : bool
        Whether values may be missing.
    """

    name: str
    type: pa.DataType
    means: str
    nullable: bool = False


TILE = TableColumn("tile_id", _INT, "the tile, as in the layer `tiles`")
STEP = TableColumn("step", _INT, "step of 50 ms since 1970, UTC")
FIRST = TableColumn("first_step", _INT, "first step")
LAST = TableColumn("last_step", _INT, "last step, inclusive")
VEHICLE = TableColumn("vehicle", _INT, "hour since 1970 x 1,000,000 + a number from 0")
SENSOR = TableColumn("sensor", _TEXT, "name of the sensor")
POSE = TableColumn("pose", _TEXT, "name of the pose, as in `poses`")


@dataclass(frozen=True, kw_only=True)
class TableSchema:
    """Schema of a table.

    Parameters
    ----------
    name : str
        Name of its folder, or of its file where the dataset has only one.
    means : str
        Meaning of a row.
    columns : tuple of TableColumn
        The columns, in order.
    order : tuple of str
        Columns by which the rows ascend strictly.
    span : tuple of str
        The columns of a row's first and last step, which lie in the hour of the part; empty where
        rows have no steps.
    runs : bool
        Whether rows are disjoint runs of steps of a tile, which may be cut.
    period : {"hour", "day", "month", "dataset"}
        Period of one file; months are those of the site's clocks.
    """

    name: str
    means: str
    columns: tuple[TableColumn, ...]
    order: tuple[str, ...]
    span: tuple[str, str] | None = None
    runs: bool = False
    period: Literal["hour", "day", "month", "dataset"] = "hour"

    @property
    def names(self) -> list[str]:
        """Names of the columns, in order."""
        return [column.name for column in self.columns]

    @property
    def schema(self) -> pa.Schema:
        """Arrow's schema of the columns."""
        return pa.schema([pa.field(c.name, c.type, nullable=c.nullable) for c in self.columns])

    def to_arrow(self, values: Mapping[str, Any] | pd.DataFrame | pa.Table) -> pa.Table:
        """Convert rows to an Arrow table of exactly these columns, and check them.

        Parameters
        ----------
        values : mapping, DataFrame or Arrow table
            Arrays by column: of NumPy (masked where values are missing), pandas or Arrow. Further
            columns are dropped.

        Raises
        ------
        InputError
            If a column is missing, of another type, or empty where it must not be, or the rows are
            not in order.
        """
        known = values.column_names if isinstance(values, pa.Table) else values
        if missing := [name for name in self.names if name not in known]:
            raise InputError("{}: lacks the column {}", self.name, missing[0])
        columns = [self._column(column, values[column.name]) for column in self.columns]
        if len({len(each) for each in columns}) > 1:
            raise InputError("{}: columns differ in length", self.name)
        table = pa.Table.from_arrays(columns, schema=self.schema)
        self.check_rows(table)
        return table

    def empty(self) -> pa.Table:
        """Return the table without rows."""
        return self.schema.empty_table()

    def _column(self, column: TableColumn, values: Any) -> pa.ChunkedArray | pa.Array:
        what = f"{self.name}: {column.name}"
        try:
            if not isinstance(values, pa.Array | pa.ChunkedArray):
                values = pa.array(values, from_pandas=True)  # a type given here would truncate
            number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
            # Arrow would convert texts to numbers.
            converted = None if number and _is_text(values.type) else values.cast(column.type)
        except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
            raise InputError("{} holds something else than {}", what, column.type) from error
        if converted is None:
            raise InputError("{} holds something else than {}", what, column.type)
        if converted.null_count and not column.nullable:
            row = int(np.argmax(converted.is_null().to_numpy(zero_copy_only=False)))
            raise InputError("{} is empty in row {}", what, row)
        return converted

    def check_rows(self, table: pa.Table) -> None:
        """Refuse rows that do not ascend, and runs that overlap or end before they begin.

        Raises
        ------
        InputError
            If there are such rows.
        """
        if not _ascends([table[name] for name in self.order]):
            raise InputError("{}: rows do not ascend by {}", self.name, ", ".join(self.order))
        if self.runs:
            tile, first, last = (table[c].to_numpy() for c in (TILE.name, FIRST.name, LAST.name))
            overlap = (tile[1:] == tile[:-1]) & (first[1:] <= last[:-1])
            if np.any(first > last) or np.any(overlap):
                raise InputError("{}: runs of a tile overlap, or end before they begin", self.name)


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _ascends(columns: list[pa.ChunkedArray]) -> bool:
    """Return whether rows ascend strictly by columns without missing values."""
    ascends: Any = False
    for column in reversed(columns):
        before, after = column.slice(0, max(len(column) - 1, 0)), column.slice(1)
        ascends = pc.or_(pc.greater(after, before), pc.and_(pc.equal(after, before), ascends))
    return bool(pc.all(ascends, min_count=0).as_py())


def column_digest(column: pa.ChunkedArray) -> str:
    """Return the digest of the values of a column, however a file stores them."""
    digest = hashlib.blake2b(column.is_valid().to_numpy().tobytes(), digest_size=16)
    values = column.drop_null()
    if pa.types.is_list(column.type):
        digest.update(pc.list_value_length(values).to_numpy().tobytes())
        values = pc.list_flatten(values)
    if pa.types.is_string(values.type):
        digest.update(pc.binary_length(values).to_numpy().tobytes())
        for chunk in filter(len, values.chunks):  # a year's recordings as Python text take seconds
            _, offsets, text = chunk.buffers()
            place = np.frombuffer(offsets, np.int32)[chunk.offset : chunk.offset + len(chunk) + 1]
            digest.update(memoryview(text or b"")[place[0] : place[-1]])
    else:
        digest.update(values.to_numpy().tobytes())
    return digest.hexdigest()

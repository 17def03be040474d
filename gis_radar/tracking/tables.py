"""Tables of vehicles in memory: their columns, checked in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import Booleans, InputError

BLOCK_STEPS = 18_000
"""Steps of a block of runs: a quarter of an hour of absolute time, as most heat maps count."""

_ROWS_IN_GROUP = 1 << 17
_FINE = 3  # decimals of metres, degrees and m/s: a hundredth of their errors


@dataclass(frozen=True, kw_only=True)
class TableKind:
    """Kind of a table in memory: its columns, and those by which its rows ascend.

    Parameters
    ----------
    name : str
        Name of the file, without its suffix.
    columns : dict
        The Arrow type of each column, in order.
    order : tuple of str
        Columns by which rows ascend strictly; empty where the writer keeps another order.
    optional : tuple of str
        Columns that may be empty.
    """

    name: str
    columns: dict[str, pa.DataType]
    order: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()

    @property
    def file(self) -> str:
        """Name of the file."""
        return f"{self.name}.parquet"

    @property
    def schema(self) -> pa.Schema:
        """Arrow's schema of the columns."""
        fields = self.columns.items()
        return pa.schema([pa.field(n, kind, nullable=n in self.optional) for n, kind in fields])

    def empty(self) -> pd.DataFrame:
        """Return the table without rows."""
        return self.typed(pd.DataFrame({name: [] for name in self.columns}))

    def typed(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return a table with exactly these columns and types; refuse rows that do not ascend.

        Parameters
        ----------
        table : DataFrame
            Further columns are dropped; numbers are rounded to what the files resolve.

        Raises
        ------
        InputError
            If a column is missing, of another type, or empty where it must not be, or the rows do
            not ascend.
        """
        if missing := [name for name in self.columns if name not in table]:
            raise InputError("{}: lacks the column {}", self.name, missing[0])
        found = pd.DataFrame(
            {name: self._column(name, table[name]) for name in self.columns},
            index=pd.RangeIndex(len(table)),
        )
        if self.order and not _ascends(found, self.order):
            raise InputError("{}: rows do not ascend by {}", self.name, ", ".join(self.order))
        return found

    def _column(self, name: str, values: pd.Series) -> Any:
        kind, what = self.columns[name], f"{self.name}: {name}"
        if pa.types.is_list(kind):
            lists = [np.asarray(each) for each in values]
            if any(each.ndim != 1 or (each.size and each.dtype.kind not in "iu") for each in lists):
                raise InputError("{} holds something else than {}", what, kind)
            return pd.Series([each.astype(np.int64) for each in lists], dtype=object)
        empty = values.isna().to_numpy()
        if empty.any() and name not in self.optional:
            raise InputError("{} is empty in row {}", what, int(empty.argmax()))
        try:
            if pa.types.is_floating(kind):
                return values.to_numpy(np.float64, na_value=np.nan).round(_FINE)
            if pa.types.is_string(kind):
                return values.astype(str).array
            if name in self.optional:
                return values.astype("Int64").array
            whole = values.to_numpy().astype(kind.to_pandas_dtype())
        except (TypeError, ValueError) as error:
            raise InputError("{} holds something else than {}", what, kind) from error
        if not np.array_equal(whole, values.to_numpy()):
            raise InputError("{} holds something else than {}", what, kind)
        return whole

    def to_arrow(self, table: pd.DataFrame) -> pa.Table:
        """Convert a typed table to Arrow."""
        return pa.Table.from_pandas(table, self.schema, preserve_index=False)


def _ascends(table: pd.DataFrame, order: tuple[str, ...]) -> bool:
    """Return whether rows ascend strictly by integer columns."""
    later: Booleans = np.zeros(max(len(table) - 1, 0), np.bool_)
    for name in reversed(order):
        gap = np.diff(table[name].to_numpy(np.int64))
        later = (gap > 0) | ((gap == 0) & later)
    return bool(later.all())


_ID, _STEP, _METRES, _FLAG = pa.int64(), pa.int64(), pa.float64(), pa.bool_()
_RUN = {"tile_id": _ID, "first_step": _STEP, "last_step": _STEP}
TRACKS = TableKind(
    name="tracks",
    columns={
        "vehicle": _ID, "step": _STEP, "easting": _METRES, "northing": _METRES,
        "heading": _METRES, "speed": _METRES, "lanelet_id": _ID, "s_m": _METRES, "d_m": _METRES,
        "seen": _FLAG,
    },
    order=("step", "vehicle"),
    optional=("lanelet_id", "s_m", "d_m"),
)  # fmt: skip
VEHICLES = TableKind(
    name="vehicles",
    columns={
        "vehicle": _ID, "first_step": _STEP, "last_step": _STEP, "length_m": _METRES,
        "width_m": _METRES, "length_sigma_m": _METRES, "p_exists": _METRES,
        "p_heavy": _METRES,
        "lanelets": pa.list_(pa.int64()),
    },
    order=("vehicle",),
    optional=("p_exists",),
)  # fmt: skip
PASSAGES = TableKind(
    name="passages",
    columns={"vehicle": _ID, "lanelet_id": _ID, "step": _STEP, "speed": _METRES, "heavy": _FLAG},
    order=("step", "vehicle", "lanelet_id"),
)
OCCUPIED = TableKind(name="occupied", columns=_RUN | {"seen": _FLAG})
VISIBLE = TableKind(name="visible", columns=_RUN | {"seen": _FLAG})

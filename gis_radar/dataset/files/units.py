"""Convert the integers of the files to metres, degrees, m/s and UTC timestamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import STEP_US


@dataclass(frozen=True)
class Timestamp:
    """Conversion of a column to times.

    Parameters
    ----------
    name : str
        Name of the converted column.
    unit_us : int
        Unit of the column, microseconds.
    offset_us : int
        Microseconds that are added.
    """

    name: str
    unit_us: int
    offset_us: int = 0

    def of(self, values: Any, _: tuple[int, int]) -> pd.DatetimeIndex:
        """Return the times of values."""
        time_us = np.rint(values * self.unit_us).astype(np.int64) + self.offset_us
        return pd.DatetimeIndex(time_us.astype("datetime64[us]"), tz="UTC")

    def sql(self, column: str, _: tuple[int, int]) -> str:
        """Return the SQL expression of the times of a column."""
        return f"make_timestamptz(({column} * {self.unit_us})::BIGINT + {self.offset_us})"


@dataclass(frozen=True)
class Hundredths:
    """Conversion of a column of hundredths to metres, degrees or m/s.

    Parameters
    ----------
    name : str
        Name of the converted column.
    axis : int, optional
        Index of the coordinate of the dataset's origin that is added.
    """

    name: str
    axis: int | None = None

    def of(self, values: Any, origin: tuple[int, int]) -> Any:
        """Return values in metres, degrees or m/s."""
        return values / 100.0 + (0 if self.axis is None else origin[self.axis])

    def sql(self, column: str, origin: tuple[int, int]) -> str:
        """Return the SQL expression of a column in metres, degrees or m/s."""
        return f"{column} / 100.0::DOUBLE + {0 if self.axis is None else origin[self.axis]}"


UNITS: dict[str, Timestamp | Hundredths] = {
    "step": Timestamp("time", STEP_US),
    "first_step": Timestamp("begin", STEP_US),
    "last_step": Timestamp("end", STEP_US, STEP_US),
    "time_us": Timestamp("time", 1),
    "first_time": Timestamp("begin", 1_000_000),
    "last_time": Timestamp("end", 1_000_000),
    "x_cm": Hundredths("easting", 0),
    "y_cm": Hundredths("northing", 1),
    "s_cm": Hundredths("s_m"),
    "d_cm": Hundredths("d_m"),
    "heading_cdeg": Hundredths("heading"),
    "speed_cms": Hundredths("speed"),
}
"""Conversion of columns of the files, by their names."""


def convert_units(table: pa.Table, origin: tuple[int, int]) -> pd.DataFrame:
    """Convert a table to metres, degrees, m/s and UTC timestamps.

    Parameters
    ----------
    table : pyarrow.Table
        Rows as in the files.
    origin : (int, int)
        Easting and northing from which tracks count, metres.
    """
    nullable_types = {pa.int64(): pd.Int64Dtype(), pa.int32(): pd.Int32Dtype()}
    columns: dict[str, Any] = {}
    for name in table.column_names:
        values = table[name]
        if name in UNITS:
            columns[UNITS[name].name] = UNITS[name].of(values.to_numpy(), origin)
        else:
            nullable = table.schema.field(name).nullable
            columns[name] = values.to_pandas(types_mapper=nullable_types.get if nullable else None)
    return pd.DataFrame(columns)

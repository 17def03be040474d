"""Tables of vehicles in memory: their columns and types."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

_FINE = 3  # decimals of metres, degrees and m/s: a hundredth of their errors


@dataclass(frozen=True, kw_only=True)
class TableKind:
    """Kind of a table in memory.

    Parameters
    ----------
    columns : dict
        The type of each column, in order.
    order : tuple of str
        Columns by which rows ascend, where the writer keeps no other order.
    """

    columns: dict[str, str]
    order: tuple[str, ...] = ()

    def empty(self) -> pd.DataFrame:
        """Return the table without rows."""
        return pd.DataFrame(columns=[*self.columns]).astype(self.columns)

    def typed(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return these columns with their types, numbers rounded to what the files resolve."""
        found = table[[*self.columns]].reset_index(drop=True)
        return found.astype(self.columns).round(_FINE)


TRACKS_KIND = TableKind(
    columns={
        "vehicle": "int64", "step": "int64", "easting": "float64", "northing": "float64",
        "heading": "float64", "speed": "float64", "lanelet_id": "Int64", "s_m": "float64",
        "d_m": "float64", "seen": "bool",
    },
)  # fmt: skip
VEHICLES_KIND = TableKind(
    columns={
        "vehicle": "int64", "first_step": "int64", "last_step": "int64", "length_m": "float64",
        "width_m": "float64", "length_sigma_m": "float64", "p_exists": "float64",
        "p_heavy": "float64", "lanelets": "object",
    },
)  # fmt: skip
PASSAGES_KIND = TableKind(
    columns={
        "vehicle": "int64", "lanelet_id": "int64", "step": "int64", "speed": "float64",
        "heavy": "bool",
    },
    order=("step", "vehicle", "lanelet_id"),
)  # fmt: skip

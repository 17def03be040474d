"""The tables of a folder of vehicles: their columns, checked in one place, and their files.

`tracks`: a row for every step from a vehicle's first to its last, the state at the step's begin, by
step and vehicle. `vehicles`: a row a vehicle. `passages`: a row a passage. `covered` and `visible`:
runs of steps of a tile, cut at whole blocks of time and ordered by block, tile and step, so that
they are written and read a block at a time and do not depend on the pieces they came in.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Booleans
from gis_radar.errors import InputError
from gis_radar.occupancy.hits import CHECKED, damaged_as_input_error

BLOCK_STEPS = 18_000
"""Steps of a block of runs: a quarter of an hour of absolute time, as most heat maps count."""

_ROWS_IN_GROUP = 1 << 17
_FINE = 3  # decimals of metres, degrees and m/s in the files: a hundredth of their errors


@dataclass(frozen=True, kw_only=True)
class TableKind:
    """A kind of table: its columns in order, and by which of them its rows ascend.

    Parameters
    ----------
    name : str
        Of the file, without its ending.
    columns : dict
        The Arrow type of each column, in order.
    order : tuple of str
        By which rows ascend strictly; none where the writer keeps an order of its own.
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
        """Columns as Arrow knows them."""
        fields = self.columns.items()
        return pa.schema([pa.field(n, kind, nullable=n in self.optional) for n, kind in fields])

    def empty(self) -> pd.DataFrame:
        """Return the table without rows."""
        return self.typed(pd.DataFrame({name: [] for name in self.columns}))

    def typed(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return a table with exactly these columns and types; refuse what is not in order.

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
            raise InputError(f"{self.name}: lacks the column {missing[0]}")
        found = pd.DataFrame(
            {name: self._column(name, table[name]) for name in self.columns},
            index=pd.RangeIndex(len(table)),
        )
        if self.order and not _ascends(found, self.order):
            raise InputError(f"{self.name}: rows do not ascend by {', '.join(self.order)}")
        return found

    def _column(self, name: str, values: pd.Series) -> Any:
        kind, what = self.columns[name], f"{self.name}: {name}"
        if pa.types.is_list(kind):
            lists = [np.asarray(each) for each in values]
            if any(each.ndim != 1 or (each.size and each.dtype.kind not in "iu") for each in lists):
                raise InputError(f"{what} holds something else than {kind}")
            return pd.Series([each.astype(np.int64) for each in lists], dtype=object)
        empty = values.isna().to_numpy()
        if empty.any() and name not in self.optional:
            raise InputError(f"{what} is empty in row {int(empty.argmax())}")
        try:
            if pa.types.is_floating(kind):
                return values.to_numpy(np.float64, na_value=np.nan).round(_FINE)
            if pa.types.is_string(kind):
                return values.astype(str).array
            if name in self.optional:
                return values.astype("Int64").array
            whole = values.to_numpy().astype(kind.to_pandas_dtype())
        except (TypeError, ValueError) as error:
            raise InputError(f"{what} holds something else than {kind}") from error
        if not np.array_equal(whole, values.to_numpy()):
            raise InputError(f"{what} holds something else than {kind}")
        return whole

    def to_arrow(self, table: pd.DataFrame) -> pa.Table:
        """Return a typed table as Arrow knows it."""
        return pa.Table.from_pandas(table, self.schema, preserve_index=False)


def _ascends(table: pd.DataFrame, order: tuple[str, ...]) -> bool:
    """Tell whether rows ascend strictly by some whole-numbered columns."""
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
        "width_m": _METRES, "length_sigma_m": _METRES, "p_heavy": _METRES,
        "lanelets": pa.list_(pa.int64()), "continues": _FLAG,
    },
    order=("vehicle",),
)  # fmt: skip
PASSAGES = TableKind(
    name="passages",
    columns={"vehicle": _ID, "lanelet_id": _ID, "step": _STEP, "speed": _METRES, "heavy": _FLAG},
    order=("step", "vehicle", "lanelet_id"),
)
COVERED = TableKind(name="covered", columns=_RUN | {"seen": _FLAG})
VISIBLE = TableKind(name="visible", columns=_RUN | {"seen": _FLAG})
FRAMES = TableKind(
    name="frames",
    columns={"sensor": pa.string(), "view": pa.string(), "first_step": _STEP, "last_step": _STEP},
)


class TableWriter:
    """A table of a kind that is written as rows come.

    Parameters
    ----------
    kind : TableKind
        Its columns.
    path : Path
        The file.
    fingerprint : str
        Of the tiles, for the file's metadata.
    by_piece : bool
        Whether each piece becomes a row group of its own; without it, row groups have a size of
        their own, and the file does not depend on the pieces.
    """

    def __init__(
        self, kind: TableKind, path: Path, fingerprint: str, *, by_piece: bool = False
    ) -> None:
        self._kind, self._by_piece = kind, by_piece
        self._waiting = kind.schema.empty_table()
        integers = [name for name, each in kind.columns.items() if pa.types.is_integer(each)]
        self._writer = pq.ParquetWriter(
            path,
            kind.schema.with_metadata({"fingerprint": fingerprint}),
            compression="zstd",
            use_dictionary=False,
            column_encoding=dict.fromkeys(integers, "DELTA_BINARY_PACKED"),
            write_page_checksum=True,
        )

    def __enter__(self) -> Self:
        return self

    def add(self, table: pd.DataFrame) -> None:
        """Add the rows of a typed table, which follow those so far."""
        rows = self._kind.to_arrow(table)
        if self._by_piece:
            if len(rows):
                self._writer.write_table(rows, row_group_size=len(rows))
            return
        self._waiting = pa.concat_tables([self._waiting, rows])
        while len(self._waiting) >= _ROWS_IN_GROUP:
            group = self._waiting.slice(0, _ROWS_IN_GROUP)
            self._writer.write_table(group, row_group_size=_ROWS_IN_GROUP)
            self._waiting = self._waiting.slice(_ROWS_IN_GROUP)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and len(self._waiting):
            self._writer.write_table(self._waiting.combine_chunks())
        self._writer.close()


def check_file(kind: TableKind, path: Path, fingerprint: str) -> None:
    """Refuse a file that is missing, lacks columns, or was made from other tiles.

    Raises
    ------
    InputError
        If it is.
    """
    if not path.is_file():
        raise InputError(
            f"{path.parent}: not a folder of vehicles: lacks {path.name}",
            hint="a folder that gis-radar vehicles wrote is needed",
        )
    with damaged_as_input_error(path):
        schema = pq.read_schema(path)
    if missing := [name for name in kind.columns if name not in schema.names]:
        raise InputError(f"{path}: lacks the column {missing[0]}")
    other = (schema.metadata or {}).get(b"fingerprint", b"").decode(errors="replace")
    if other != fingerprint:
        raise InputError(f"{path}: was made from tiles {other}, its folder from {fingerprint}")


def read_pieces(
    kind: TableKind, path: Path, span: tuple[int, int] | None = None
) -> Iterator[pd.DataFrame]:
    """Read a file row group by row group.

    Parameters
    ----------
    kind : TableKind
        Its columns.
    path : Path
        The file.
    span : (int, int), optional
        Only row groups that hold values of the first column of its order from the first to the
        last; without it, all.

    Raises
    ------
    InputError
        If it is damaged, or its content is not of the kind.
    """
    with damaged_as_input_error(path), pq.ParquetFile(path, **CHECKED) as file:
        for group in range(file.num_row_groups):
            if span is not None and not _holds(file, group, kind, span):
                continue
            rows = file.read_row_group(group, columns=list(kind.columns), use_threads=False)
            try:
                typed = kind.typed(rows.to_pandas(types_mapper={pa.int64(): pd.Int64Dtype()}.get))
            except InputError as error:
                raise InputError(f"{path}: {error.message}") from error
            yield typed


def _holds(file: Any, group: int, kind: TableKind, span: tuple[int, int]) -> bool:
    column = file.schema_arrow.names.index(kind.order[0])
    known = file.metadata.row_group(group).column(column).statistics
    if known is None or not known.has_min_max or not isinstance(known.max, int):
        return True
    return bool(known.max >= span[0] and known.min <= span[1])


def read_whole(kind: TableKind, path: Path) -> pd.DataFrame:
    """Read a file whole.

    Raises
    ------
    InputError
        If it is damaged.
    """
    pieces = list(read_pieces(kind, path))
    return kind.typed(pd.concat(pieces, ignore_index=True)) if pieces else kind.empty()

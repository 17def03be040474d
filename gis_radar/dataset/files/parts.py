"""Parts: the Parquet files of a dataset, complete or absent, and checked when they are opened."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.base import (
    ROWS_IN_GROUP,
    STEPS_PER_HOUR,
    STEPS_PER_SECOND,
    InputError,
    Text,
    atomic_writes,
    column_statistics,
    first_line,
    output_errors,
)
from gis_radar.dataset.files.schema import TableSchema, column_digest
from gis_radar.dataset.files.tables import SCHEMA

HOURS_PER_DAY = 24
MEASURE_AGAIN = Text("remove its hour's file in hours/ and measure again; the hour is made anew")
_DIGESTS = b"digests"  # entry of the metadata: digests of the columns
Values: TypeAlias = Mapping[str, Any] | pd.DataFrame | pa.Table
"""Arrays by column."""
Keys: TypeAlias = Mapping[int, list[str | int]]
"""By hour, or first hour of a date, since 1970: digests and numbers that its rows follow from."""


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Origin of a part, which its metadata state.

    Parameters
    ----------
    fingerprint : str
        Fingerprint of the tiles.
    method : int
        Method of the hour job.
    inputs : str
        Digest of the inputs.
    """

    fingerprint: str
    method: int
    inputs: str

    def metadata(self, table: TableSchema, hour: int) -> dict[str, str]:
        """Return the metadata of the part of a table in an hour since 1970."""
        return {
            **common_metadata(table, self.fingerprint),
            "hour": hour_text(hour),
            "method": str(self.method),
            "inputs": self.inputs,
        }


class PartDigest(NamedTuple):
    """Digest and size of a part.

    Parameters
    ----------
    rows, size : int
        Number of rows, and size of the file in bytes.
    sha256 : str
        SHA-256 of the file.
    """

    rows: int
    size: int
    sha256: str


def hour_of_step(step: int) -> int:
    """Return the hour since 1970 of a step."""
    return step // STEPS_PER_HOUR


def days_of(hours: Iterable[int]) -> list[int]:
    """Return the first hours, since 1970, of the UTC dates of some hours, ascending."""
    return sorted({hour // HOURS_PER_DAY * HOURS_PER_DAY for hour in hours})


def hour_begin(hour: int) -> datetime:
    """Return the begin (UTC) of an hour since 1970."""
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(hours=hour)


def hour_text(hour: int) -> str:
    """Return the begin of an hour as text, such as `2026-11-20T09:00Z`."""
    return f"{hour_begin(hour):%Y-%m-%dT%H:%MZ}"


def date_of(hour: int) -> date:
    """Return the UTC date of an hour since 1970."""
    return hour_begin(hour).date()


def part_path(folder: Path, table: TableSchema, hour: int = 0) -> Path:
    """Return the path of the part of a table that holds an hour since 1970."""
    if table.period == "dataset":
        return folder / f"{table.name}.parquet"
    name = "day" if table.period == "day" else f"{hour_begin(hour):%H}"
    return folder / table.name / f"date={date_of(hour)}" / f"{name}.parquet"


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the temporary name of a file to write; after the block it is flushed and moved.

    Parameters
    ----------
    path : Path
        Its place; a folder that is missing is made.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_writes(path, flushed=True) as (private, places):
        fresh = private / "part"  # readers take each name that ends in .parquet
        places[fresh] = path
        yield fresh


class PartWriter:
    """Writer of a part in batches; equal rows give equal bytes, however they are divided.

    Parameters
    ----------
    table : TableSchema
        Its columns.
    path : Path
        The file.
    metadata : dict
        From :meth:`Origin.metadata`.
    """

    def __init__(self, table: TableSchema, path: Path, metadata: dict[str, str]) -> None:
        self._table, self._path = table, path
        self._waiting = [table.empty()]
        self._rows = self._written = 0
        self._last = table.empty()
        self._writer = pq.ParquetWriter(path, table.schema, **_encoding(table))
        self._writer.add_key_value_metadata(metadata)

    def add(self, values: Values) -> None:
        """Add rows that follow those so far.

        Raises
        ------
        InputError
            If they are not what the table holds, or do not follow.
        """
        rows = self._table.to_arrow(values)
        if not len(rows):
            return
        self._table.check_rows(pa.concat_tables([self._last, rows.slice(0, 1)]))
        self._last = rows.slice(len(rows) - 1)
        self._waiting.append(rows)
        self._rows += len(rows)
        whole = (self._rows - self._written) // ROWS_IN_GROUP * ROWS_IN_GROUP
        if whole:
            self._write(whole)

    def close(self) -> PartDigest:
        """Write the remaining rows, and return the part's digest."""
        if self._rows > self._written:
            self._write(self._rows - self._written)
        self._writer.close()
        size, sha256 = self._path.stat().st_size, digest_of(self._path)
        return PartDigest(rows=self._rows, size=size, sha256=sha256)

    def _write(self, rows: int) -> None:
        waiting = pa.concat_tables(self._waiting)
        self._writer.write_table(waiting.slice(0, rows), row_group_size=ROWS_IN_GROUP)
        self._waiting = [waiting.slice(rows)]
        self._written += rows


def _encoding(table: TableSchema) -> dict[str, Any]:
    """Return the Parquet options of a table: small, and plain enough for every reader."""
    encoding, dictionary = {}, []
    for column in table.columns:
        if pa.types.is_string(column.type):
            dictionary.append(column.name)
        elif pa.types.is_list(column.type):
            encoding[f"{column.name}.list.element"] = "DELTA_BINARY_PACKED"
        elif pa.types.is_floating(column.type):
            encoding[column.name] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_integer(column.type):
            encoding[column.name] = "DELTA_BINARY_PACKED"
    return {
        "compression": "zstd", "use_dictionary": dictionary or False, "column_encoding": encoding,
        "write_page_checksum": True, "store_schema": False,
    }  # fmt: skip


def write_part(
    table: TableSchema, fresh: Path, batches: Values | Iterable[Values], metadata: dict[str, str]
) -> PartDigest:
    """Write a part.

    Parameters
    ----------
    table : TableSchema
        Its columns.
    fresh : Path
        Temporary name of the part, as of :func:`replacing`.
    batches : mapping, or iterable of mappings
        Its rows, whole or in batches, in order.
    metadata : dict
        From :meth:`Origin.metadata`.
    """
    writer = PartWriter(table, fresh, metadata)
    whole = isinstance(batches, Mapping | pa.Table | pd.DataFrame)
    for values in [batches] if whole else batches:
        writer.add(values)
    return writer.close()


@dataclass(frozen=True, kw_only=True)
class TableFile:
    """A file of a table that is no part of an hour.

    Parameters
    ----------
    table : TableSchema
        Its columns.
    path : Path
        The file.
    metadata : dict
        Entries that its metadata must have.
    keyed : str
        Entry of the metadata with the keys of the hours or dates that it was made from.
    """

    table: TableSchema
    path: Path
    metadata: dict[str, str]
    keyed: str = ""

    def opened(self) -> AbstractContextManager[pq.ParquetFile]:
        """Open it, and check it; errors are those of :func:`opened_part`."""
        return opened_part(self.table, self.path, self.metadata)

    def read(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Read columns, by default all; errors are those of :func:`opened_part`."""
        wanted = list(columns or self.table.names)
        with self.opened() as file:
            rows = file.read(columns=wanted)
            stated = json.loads((file.metadata.metadata or {}).get(_DIGESTS, b"{}"))
        for name in rows.column_names:
            if stated.get(name, digest := column_digest(rows[name])) != digest:
                raise InputError(
                    "{}: column {} was changed after it was written",
                    self.path,
                    name,
                    hint=_remedy(self.table),
                )
        if self.table.period == "dataset":  # no run adds missing columns
            for each in self.table.columns:
                if each.name in {*wanted} - {*rows.column_names}:
                    rows = rows.append_column(each.name, pa.nulls(len(rows), each.type))
        return rows

    def check_pages(self) -> None:
        """Compare the checksums of all pages, for readers that do not.

        Raises
        ------
        InputError
            If a bit was flipped.
        """
        with self.opened() as file:
            for group in range(file.num_row_groups):
                file.read_row_group(group, use_threads=False)

    def keys(self) -> Keys:
        """Read the keys, by hours or dates since 1970; none if it is damaged."""
        with suppress(InputError, ValueError, KeyError), self.opened() as file:
            return self._keys_in(file)
        return {}

    def is_made_of(self, keys: Keys) -> bool:
        """Return whether it has all columns and was made from exactly these keys."""
        with suppress(InputError, ValueError, KeyError), self.opened() as file:
            has_all = {*self.table.names} <= {*file.schema_arrow.names}
            return has_all and self._keys_in(file) == keys
        return False

    def _keys_in(self, file: pq.ParquetFile) -> Keys:
        known = json.loads(file.metadata.metadata[self.keyed.encode()])
        return {int(number): key for number, key in known.items()}

    def write(self, rows: Values, keys: Keys | None = None) -> None:
        """Replace the file by rows; state the digests of columns, and the keys of the rows."""
        rows = self.table.to_arrow(rows)
        digests = {name: column_digest(rows[name]) for name in rows.column_names}
        stated = {_DIGESTS.decode(): json.dumps(digests)}
        if keys is not None:
            stated[self.keyed] = json.dumps(dict(sorted(keys.items())))
        with replacing(self.path) as fresh:
            write_part(self.table, fresh, rows, self.metadata | stated)


def single_file(table: TableSchema, folder: Path, fingerprint: str) -> TableFile:
    """Return the file of a table that is one file in the dataset."""
    metadata = common_metadata(table, fingerprint)
    return TableFile(table=table, path=part_path(folder, table), metadata=metadata)


def write_single_file(table: TableSchema, folder: Path, values: Values, fingerprint: str) -> None:
    """Write a table that is one file in the dataset, replacing the present one."""
    single_file(table, folder, fingerprint).write(values)


def common_metadata(table: TableSchema, fingerprint: str) -> dict[str, str]:
    """Return the metadata that all files of a table of a dataset have."""
    return {"table": table.name, "schema": str(SCHEMA), "fingerprint": fingerprint}


@contextmanager
def opened_part(
    table: TableSchema, path: Path, metadata: dict[str, str], digest: PartDigest | None = None
) -> Iterator[pq.ParquetFile]:
    """Open a part after checking its footer.

    Parameters
    ----------
    table : TableSchema
        Its columns.
    path : Path
        The file.
    metadata : dict
        Expected entries of its metadata; other entries are not checked.
    digest : PartDigest, optional
        Expected digest, from the hour's record.

    Yields
    ------
    pyarrow.parquet.ParquetFile
        The file; its pages are checked when they are read.

    Raises
    ------
    InputError
        If it is missing, truncated, damaged, of another table, hour or run, or lacks a column.
    """
    hint = _remedy(table)
    if not path.is_file():
        hint = Text("measure again; the hour is made anew") if table.period == "hour" else hint
        raise InputError("{}: is missing", path, hint=hint)
    if digest is not None and (size := path.stat().st_size) != digest.size:
        raise InputError("{}: has {} bytes, not {}", path, size, digest.size, hint=hint)
    with (
        _damage_as_input_error(path, hint),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        _check_metadata(path, file, metadata, hint)
        _check_columns(table, path, file)
        if metadata.get("hour") and table.span is not None:
            _check_span(table, path, file, metadata["hour"])
        yield file


@contextmanager
def _damage_as_input_error(path: Path, hint: str) -> Iterator[None]:
    """Convert errors of reading a Parquet file to an InputError that names the file."""
    try:
        yield
    except InputError:
        raise
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise InputError("{}: damaged: {}", path, first_line(error), hint=hint) from error


def _remedy(table: TableSchema) -> str:
    """Return what to do about a damaged file of a table."""
    hint = MEASURE_AGAIN
    if table.period == "day":
        hint = Text("remove it: the next run counts that day again")
    if table.period == "month":
        hint = Text("remove it: the next run sums that month again")
    if table.period == "dataset":
        hint = Text("bring it back, or measure into a new folder")
    return hint


def _check_metadata(path: Path, file: pq.ParquetFile, expected: dict[str, str], hint: str) -> None:
    found = file.metadata.metadata or {}
    for name, wanted in expected.items():
        got = found.get(name.encode(), b"").decode(errors="replace")
        if got != wanted:
            raise InputError(
                "{}: is of {} {}, not {}", path, name, repr(got), repr(wanted), hint=hint
            )


def _check_columns(table: TableSchema, path: Path, file: pq.ParquetFile) -> None:
    schema, hint = file.schema_arrow, _remedy(table)
    for column in table.columns:
        if column.name not in schema.names:
            if table.period != "hour" and column.nullable:
                continue  # a column added since the file was made: its values are null
            raise InputError("{}: lacks the column {}", path, column.name, hint=hint)
        if (got := schema.field(column.name).type) != column.type:
            raise InputError(
                "{}: column {} is {}, not {}", path, column.name, got, column.type, hint=hint
            )
        if column.nullable or pa.types.is_nested(column.type):
            continue
        place = schema.names.index(column.name)
        groups = range(file.num_row_groups)
        known = (column_statistics(file.metadata, group, place) for group in groups)
        if any(each is not None and each.null_count for each in known):
            raise InputError("{}: damaged: a value of {} is missing", path, column.name, hint=hint)


def _check_span(table: TableSchema, path: Path, file: pq.ParquetFile, hour: str) -> None:
    """Refuse steps of another hour, by the statistics of the row groups."""
    assert table.span is not None  # noqa: S101 - the caller has checked
    begin = int(datetime.fromisoformat(hour).timestamp()) * STEPS_PER_SECOND
    for name in set(table.span):
        place = file.schema_arrow.names.index(name)
        for group in range(file.num_row_groups):
            known = column_statistics(file.metadata, group, place)
            if (
                known is None
                or not known.has_min_max
                or not begin <= known.min <= known.max < begin + STEPS_PER_HOUR
            ):
                raise InputError("{}: {} lies outside its hour", path, name, hint=MEASURE_AGAIN)

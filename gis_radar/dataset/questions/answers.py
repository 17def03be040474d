"""SQL queries of a dataset; the types of their answers, their rows as text, and their files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from gis_radar.base import FORMULA, QUIET, Reporter, UsageError, atomic_write, checked_methods
from gis_radar.dataset.files.source import DatasetFiles

# Columns of map ids, which reach 9e18; JSON readers hold integers up to 9e15 exactly, so that all
# ids are text.
_MAP_IDS = frozenset({"lanelet_id", "lanelets", "lane", "from_lane", "to_lane", "stop_line"})

_FORMULA = f"^( *[{''.join(map(re.escape, FORMULA))}])"


def plain_schema(schema: pa.Schema) -> pa.Schema:
    """Return a schema with times in UTC and 64-bit numbers in place of DuckDB's wider ones."""
    for place, each in enumerate(schema):
        kind = each.type
        if pa.types.is_timestamp(kind) and kind.tz:
            kind = pa.timestamp("us", "UTC")
        elif pa.types.is_decimal(kind):
            kind = pa.float64() if kind.scale else pa.int64()
        schema = schema.set(place, each.with_type(kind))
    return schema


def plain(table: pa.Table) -> pa.Table:
    """Return an answer with times in UTC and 64-bit numbers.

    Raises
    ------
    UsageError
        If a number needs more than 64 bits.
    """
    try:
        return table.cast(plain_schema(table.schema))
    except pa.ArrowInvalid as error:
        raise UsageError(
            "a number of the answer has over 64 bits", hint="cast it, as in sum(step)::DOUBLE"
        ) from error


def csv_texts(table: pa.Table) -> pa.Table:
    """Return an answer with times as ISO 8601 text and lists as joined text, for CSV.

    Text never begins a formula.
    """
    words = [
        pc.binary_join(column.combine_chunks().cast(pa.list_(pa.string())), " ")
        if pa.types.is_list(column.type)
        else _times_as_text(column)
        for column in table.columns
    ]
    safe = [
        pc.replace_substring_regex(each, _FORMULA, r"'\1")
        if pa.types.is_string(each.type)
        else each
        for each in words
    ]
    return pa.table(safe, names=table.column_names)


def json_texts(table: pa.Table) -> pa.Table:
    """Return an answer with times as ISO 8601 text, no finer than needed, and the map's ids."""
    columns = [
        _ids_as_text(column) if name in _MAP_IDS else _short_times(column)
        for name, column in zip(table.column_names, table.columns, strict=True)
    ]
    return pa.table(columns, names=table.column_names)


def _ids_as_text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return ids as text; a column of such a name that holds no integers stays as it is."""
    kind = column.type
    if pa.types.is_list(kind) and pa.types.is_integer(kind.value_type):
        return column.cast(pa.list_(pa.string()))
    return column.cast(pa.string()) if pa.types.is_integer(kind) else _short_times(column)


def _times_as_text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return times and dates as ISO 8601 text, and nested types as JSON text."""
    kind = column.type
    if pa.types.is_timestamp(kind) and kind.tz:
        return pc.strftime(column, format="%Y-%m-%dT%H:%M:%SZ")
    if pa.types.is_date(kind) or pa.types.is_time(kind) or pa.types.is_timestamp(kind):
        return column.cast(pa.string())
    others = (pa.types.is_struct, pa.types.is_map, pa.types.is_binary, pa.types.is_interval)
    if any(is_one(kind) for is_one in (*others, pa.types.is_duration)):
        values = (
            each if each is None else json.dumps(each, default=str) for each in column.to_pylist()
        )
        return pa.chunked_array([pa.array(values, pa.string())])
    return column


def _short_times(column: pa.ChunkedArray) -> pa.ChunkedArray:
    if (whole := _times_as_text(column)) is column:
        return column
    whole = pc.replace_substring_regex(whole, r"\.0+Z$", "Z")
    return pc.replace_substring_regex(whole, r"(\.\d*[1-9])0+Z$", r"\1Z")


def first_rows(batches: Iterable[pa.RecordBatch], most: int) -> tuple[list[dict[str, Any]], int]:
    """Return the first rows of an answer as values for JSON, and the number of all its rows.

    Parameters
    ----------
    batches : iterable of pyarrow.RecordBatch
        From :func:`gis_radar.dataset.questions.queries.run_query`.
    most : int
        Most rows to return.
    """
    rows: list[dict[str, Any]] = []
    total = 0
    for batch in batches:
        total += batch.num_rows
        part = pa.Table.from_batches([batch]).slice(0, most - len(rows))
        rows += json_texts(plain(part)).to_pylist()
    return rows, total


def write_answer(schema: pa.Schema, batches: Iterable[pa.RecordBatch], path: Path) -> int:
    """Write an answer batch by batch, whole or not at all; memory holds one batch.

    Parameters
    ----------
    schema, batches : pyarrow.Schema, iterable of pyarrow.RecordBatch
        From :func:`gis_radar.dataset.questions.queries.run_query`.
    path : Path
        The file; its name ends in `.csv` or `.parquet`.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    UsageError
        If the name ends otherwise.
    OutputError
        If it cannot be written.
    """
    kinds: dict[str, Callable[[Path, pa.Schema], AbstractContextManager[Any]]] = {
        ".csv": pyarrow.csv.CSVWriter,
        ".parquet": pq.ParquetWriter,
    }
    if path.suffix.lower() not in kinds:
        raise UsageError("{}: an answer is written as .csv or .parquet", path)
    as_read = csv_texts if path.suffix.lower() == ".csv" else plain
    rows = 0
    try:
        written = as_read(plain(schema.empty_table())).schema
        with atomic_write(path) as part, kinds[path.suffix.lower()](part, written) as writer:
            for batch in batches:
                writer.write_table(as_read(plain(pa.Table.from_batches([batch]))))
                rows += batch.num_rows
    except pa.ArrowNotImplementedError as error:
        raise UsageError(
            "{}: cannot hold a column of the answer: {}", path, error, hint="cast it to VARCHAR"
        ) from error
    return rows


_TIMEOUT_S, _MEMORY = 60.0, "2GB"  # default limits of a query


@checked_methods
class SqlQueries:
    """Methods that answer SQL queries over one dataset or several."""

    def queried_sites(self) -> tuple[Path, Mapping[str, DatasetFiles]]:
        """Return the folder, and the datasets that are asked, each with the name of its site."""
        raise NotImplementedError

    def query(
        self, sql: str, *, timeout_s: float = _TIMEOUT_S, memory: str = _MEMORY,
        reporter: Reporter = QUIET,
    ) -> pd.DataFrame:  # fmt: skip
        """Run an SQL query (DuckDB): one SELECT over the tables of all complete hours.

        Columns are those of the files, and those that the other methods return. In the query, times
        are by the clocks of the site (`hour(begin)`); times of the result are UTC.

        Parameters
        ----------
        sql : str
            The query.
        timeout_s : float
            Time limit, seconds.
        memory : str
            Memory limit, such as `2GB`.
        reporter : Reporter
            Receives a warning where parts of a table were deleted, and are left out.

        Raises
        ------
        UsageError
            If it is no such query, takes too long, or needs too much memory.
        """
        with _answer(*self.queried_sites(), sql, timeout_s, memory, reporter) as (schema, batches):
            rows: pd.DataFrame = plain(pa.Table.from_batches(batches, schema)).to_pandas()
        return rows

    def write_answer(
        self,
        sql: str,
        path: str | Path,
        *,
        timeout_s: float = _TIMEOUT_S,
        memory: str = _MEMORY,
        reporter: Reporter = QUIET,
    ) -> int:
        """Write the answer of :meth:`query` as `.csv` or `.parquet`, and return its row count.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        with _answer(*self.queried_sites(), sql, timeout_s, memory, reporter) as answer:
            return write_answer(*answer, Path(path))

    def first_rows(
        self, sql: str, most: int, *, timeout_s: float = _TIMEOUT_S, memory: str = _MEMORY,
        reporter: Reporter = QUIET,
    ) -> tuple[list[dict[str, Any]], int]:  # fmt: skip
        """Return the first rows of the answer of :meth:`query`, and the number of all its rows.

        Values are types of JSON, times are text.
        """
        with _answer(*self.queried_sites(), sql, timeout_s, memory, reporter) as (_, batches):
            return first_rows(batches, most)


def _answer(
    folder: Path, sites: Mapping[str, DatasetFiles], sql: str, timeout_s: float, memory: str,
    reporter: Reporter,
) -> AbstractContextManager[tuple[pa.Schema, Iterator[pa.RecordBatch]]]:  # fmt: skip
    from gis_radar.dataset.questions.queries import run_query  # noqa: PLC0415 - DuckDB, 0.2 s

    return run_query(folder, sites, sql, timeout_s=timeout_s, memory=memory, reporter=reporter)

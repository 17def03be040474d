"""Read Parquet tables batch by batch, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from gis_radar.base import InputError, column_statistics
from gis_radar.recordings import settings

ROWS_AT_ONCE = 65_536  # 3 MB of a recording's columns as float64
BYTES_AT_ONCE = 1 << 20  # read buffer of a column
_TEXTS = (
    pa.types.is_string, pa.types.is_large_string, pa.types.is_binary, pa.types.is_large_binary,
)  # fmt: skip


def parquet_batches(
    path: Path, columns: Sequence[str] | None = None, *, first_group: int = 0
) -> Iterator[pa.RecordBatch]:
    """Read a Parquet file in batches of bounded size, its checksums verified.

    Parameters
    ----------
    path : Path
        The file.
    columns : sequence of str, optional
        Columns to read; by default all.
    first_group : int
        The row group to begin with.

    Raises
    ------
    InputError
        If a column holds texts or lists that are too long to be beside a detection.
    """
    # Texts are read as dictionaries, in which a repeated text is once: its length is checked there,
    # before it is copied to each row.
    texts = _texts(path)
    # A small buffer keeps a file of one huge row group from being read at once.
    with pq.ParquetFile(
        path,
        buffer_size=BYTES_AT_ONCE,
        pre_buffer=False,
        page_checksum_verification=True,
        read_dictionary=list(texts),
    ) as file:
        _refuse_huge_columns(file.metadata, path, columns)
        groups = list(range(first_group, file.num_row_groups))
        for batch in file.iter_batches(
            ROWS_AT_ONCE, row_groups=groups, use_threads=False, columns=columns
        ):
            yield _decoded(batch, texts, path)


def first_group_of(path: Path, column: str, least: float) -> tuple[int, int]:
    """Return the first row group that may hold values from `least` on, and the rows before it.

    Parameters
    ----------
    path : Path
        The file.
    column : str
        A column whose values ascend.
    least : float
        The value.
    """
    metadata, rows = pq.read_metadata(path), 0
    place = _place_of(metadata, column)
    for number in range(metadata.num_row_groups):
        stated = column_statistics(metadata, number, place)
        if stated is None or not stated.has_min_max or stated.max >= least:
            return number, rows
        rows += metadata.row_group(number).num_rows
    return metadata.num_row_groups, rows


def spans_of_groups(path: Path, column: str) -> list[tuple[float, float]] | None:
    """Return the least and the greatest value of a column in each row group that has rows.

    None where the file does not state them as numbers.
    """
    metadata, spans = pq.read_metadata(path), []
    place = _place_of(metadata, column)
    for number in range(metadata.num_row_groups):
        stated = column_statistics(metadata, number, place)
        if metadata.row_group(number).num_rows == 0:
            continue
        if stated is None or not stated.has_min_max or not isinstance(stated.min, float):
            return None
        spans.append((stated.min, stated.max))
    return spans or None


def _place_of(metadata: pq.FileMetaData, column: str) -> int:
    places = range(metadata.num_columns)
    return next(k for k in places if metadata.schema.column(k).path == column)


def _texts(path: Path) -> dict[str, pa.DataType]:
    return {
        field.name: field.type
        for field in pq.read_schema(path)
        if any(is_kind(field.type) for is_kind in _TEXTS)
    }


def _refuse_huge_columns(
    metadata: pq.FileMetaData, path: Path, columns: Sequence[str] | None
) -> None:
    """Refuse a row group whose texts or lists would fill the memory; numbers come in pages."""
    most = settings.MOST_TEXT_BYTES
    for place in range(metadata.num_columns):
        column = metadata.schema.column(place)
        is_list = column.max_repetition_level > 0
        name = column.path.partition(".")[0]
        is_unbounded = is_list or column.physical_type == "BYTE_ARRAY"
        if not is_unbounded or (columns is not None and name not in columns):
            continue
        for number in range(metadata.num_row_groups):
            chunk = metadata.row_group(number).column(place)
            size = max(chunk.total_uncompressed_size, 8 * chunk.num_values * is_list)
            if size > most:
                raise InputError(
                    "{}: column {} holds {:,.0f} MiB in one row group, at most {:,.0f} are read",
                    path,
                    name,
                    size / 2**20,
                    most / 2**20,
                    hint="leave the column out, or write smaller row groups",
                )


def _decoded(batch: pa.RecordBatch, texts: dict[str, pa.DataType], path: Path) -> pa.RecordBatch:
    """Return a batch with texts in place of dictionaries; refuse a text that is too long."""
    most = settings.LONGEST_TEXT
    for place, field in enumerate(batch.schema):
        if field.name not in texts or not pa.types.is_dictionary(field.type):
            continue
        column = batch.column(place)
        longest = pc.max(pc.binary_length(column.dictionary)).as_py() or 0
        if longest > most:
            raise InputError(
                "{}: column {} holds a text of {:,} bytes, at most {:,} are read",
                path,
                field.name,
                longest,
                most,
                hint="leave the column out",
            )
        plain = pc.cast(column.dictionary_decode(), texts[field.name])
        batch = batch.set_column(place, pa.field(field.name, plain.type), plain)
    return batch

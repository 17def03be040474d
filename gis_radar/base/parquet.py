"""Parquet files: size of row groups, and what they state of their columns."""

from __future__ import annotations

import pyarrow.parquet as pq

ROWS_IN_GROUP = 131_072  # most rows of a row group (the contract): 4 MB of a recording in memory


def column_statistics(metadata: pq.FileMetaData, group: int, place: int) -> pq.Statistics | None:
    """Return the statistics of a column in a row group; None where they are not known.

    Where a damaged file gives the column another type there, Arrow would abort the process.
    """
    chunk = metadata.row_group(group).column(place)
    same_type = chunk.physical_type == metadata.schema.column(place).physical_type
    return chunk.statistics if same_type else None

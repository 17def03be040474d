"""SQL queries of a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from gis_radar.base import QUIET, Reporter
from gis_radar.dataset.files.source import DatasetFiles

_TIMEOUT_S, _MEMORY = 60.0, "2GB"  # default limits of a query


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
        from gis_radar.dataset.questions.answers import plain  # noqa: PLC0415 - as below

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
        from gis_radar.dataset.questions.answers import write_answer  # noqa: PLC0415 - as below

        with _answer(*self.queried_sites(), sql, timeout_s, memory, reporter) as answer:
            return write_answer(*answer, Path(path))

    def first_rows(
        self, sql: str, most: int, *, timeout_s: float = _TIMEOUT_S, memory: str = _MEMORY,
        reporter: Reporter = QUIET,
    ) -> tuple[list[dict[str, Any]], int]:  # fmt: skip
        """Return the first rows of the answer of :meth:`query`, and the number of all its rows.

        Values are types of JSON, times are text.
        """
        from gis_radar.dataset.questions.answers import first_rows  # noqa: PLC0415 - as below

        with _answer(*self.queried_sites(), sql, timeout_s, memory, reporter) as (_, batches):
            return first_rows(batches, most)


def _answer(
    folder: Path, sites: Mapping[str, DatasetFiles], sql: str, timeout_s: float, memory: str,
    reporter: Reporter,
) -> AbstractContextManager[tuple[pa.Schema, Iterator[pa.RecordBatch]]]:  # fmt: skip
    from gis_radar.dataset.questions.queries import run_query  # noqa: PLC0415 - DuckDB, 0.2 s

    return run_query(folder, sites, sql, timeout_s=timeout_s, memory=memory, reporter=reporter)

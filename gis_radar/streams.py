"""Streams of Arrow batches into a layer of a vector file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyogrio


def write_stream(
    batches: Iterable[pa.RecordBatch], schema: pa.Schema, path: Path, **options: Any
) -> None:
    """Write batches as they come; what stops them is raised as it is.

    Parameters
    ----------
    batches : iterable of pyarrow.RecordBatch
        All of `schema`, the geometry as WKB.
    schema : pyarrow.Schema
        The columns.
    path : Path
        The file.
    **options
        As for :func:`pyogrio.write_arrow`.
    """
    stopped: list[BaseException] = []
    reader = pa.RecordBatchReader.from_batches(schema, _remembering(batches, stopped))
    try:
        pyogrio.write_arrow(reader, path, **options)
    except Exception:
        if not stopped:
            raise
    if stopped:
        raise stopped[0]


def _remembering(
    batches: Iterable[pa.RecordBatch], stopped: list[BaseException]
) -> Iterator[pa.RecordBatch]:
    """Pass batches on, and keep what stops them: Arrow's stream would hide a Ctrl-C."""
    try:
        yield from batches
    except (Exception, KeyboardInterrupt) as error:
        stopped.append(error)
        raise

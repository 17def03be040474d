"""Read a table of a dataset over a span of steps, an hour at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset.files.records import HourRecord
from gis_radar.dataset.files.schema import FIRST, LAST, TableSchema

Span = tuple[int, int]
"""First and last step, inclusive."""


def read_rows(
    folder: Path,
    table: TableSchema,
    records: Mapping[int, HourRecord],
    span: Span | None = None,
    columns: Sequence[str] | None = None,
) -> Iterator[pa.Table]:
    """Read the rows of a table hour by hour; memory holds one hour.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    table : TableSchema
        A table of hours.
    records : mapping
        Records of complete hours, ascending.
    span : (int, int), optional
        First and last step of the rows. Runs of tiles are cut to it.
    columns : sequence of str, optional
        Names of the columns; by default all.

    Yields
    ------
    pyarrow.Table
        The rows of an hour, in the table's order.

    Raises
    ------
    InputError
        If a part is not the one of its record, or a page of it is damaged.
    """
    wanted = list(columns or table.names)
    for hour, record in records.items():
        begin = hour * STEPS_PER_HOUR
        inside = span is None or (span[0] <= begin and begin + STEPS_PER_HOUR - 1 <= span[1])
        if span is not None and (span[1] < begin or begin + STEPS_PER_HOUR <= span[0]):
            continue
        needed = wanted if inside else list(dict.fromkeys([*wanted, *(table.span or ())]))
        rows = record.read(folder, table, needed)
        if not inside and span is not None and table.span is not None:
            rows = _within(table, rows, span)
        yield rows.select(wanted)


def _within(table: TableSchema, rows: pa.Table, span: Span) -> pa.Table:
    """Return the rows with steps in a span, runs of tiles cut to it."""
    assert table.span is not None  # noqa: S101 - the caller has looked
    first, last = table.span
    kept = rows.filter(
        pc.and_(pc.less_equal(rows[first], span[1]), pc.greater_equal(rows[last], span[0]))
    )
    if not table.runs:
        return kept
    for name, bound, cut in ((FIRST.name, span[0], np.maximum), (LAST.name, span[1], np.minimum)):
        values = pa.array(cut(kept[name].to_numpy(), bound))
        kept = kept.set_column(kept.schema.get_field_index(name), kept.field(name), values)
    return kept

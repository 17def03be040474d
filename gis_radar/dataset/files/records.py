"""Records of hours: the parts of an hour appear together, and its record is written last."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from gis_radar.base import (
    STEPS_PER_HOUR,
    InputError,
    atomic_writes,
    output_errors,
    read_json,
    sync_folder,
    writing_errors,
)
from gis_radar.dataset.files.parts import (
    MEASURE_AGAIN,
    Origin,
    PartDigest,
    Values,
    date_of,
    digest_of,
    hour_begin,
    hour_text,
    opened_part,
    part_path,
    replacing,
    write_part,
)
from gis_radar.dataset.files.schema import FIRST, LAST, TableSchema
from gis_radar.dataset.files.tables import HOUR_TABLES, SCHEMA, TABLES

HOURS = "hours"
_RECORD = re.compile(r"([01][0-9]|2[0-3])\.json")
_LAST_HOUR = 70_000_000  # of the year 9955: names of dates have years of four digits


@dataclass(frozen=True, kw_only=True)
class HourRecord:
    """Record of an hour: its parts with their digests.

    Parameters
    ----------
    hour : int
        The hour since 1970.
    origin : Origin
        Origin of its parts.
    parts : dict
        Digest of each part, by table. Tables of vehicles may be absent.
    dropped : tuple of str
        Tables whose parts were deleted to save room after `keep`.
    """

    hour: int
    origin: Origin
    parts: Mapping[str, PartDigest]
    dropped: tuple[str, ...] = ()

    def has(self, table: TableSchema) -> bool:
        """Return whether the hour has the part of a table, which was not deleted."""
        return table.name in self.parts and table.name not in self.dropped

    @contextmanager
    def opened(self, folder: Path, table: TableSchema) -> Iterator[pq.ParquetFile]:
        """Open the part of a table, checked against this record.

        Raises
        ------
        InputError
            If the hour has no such part, or it is not the one of this record.
        """
        path = part_path(folder, table, self.hour)
        if table.name in self.dropped:
            raise InputError(
                "{}: was deleted after the time to keep exact tables",
                path,
                hint="ask for a later time; of that one tile_counts, traffic and passages are left",
            )
        if table.name not in self.parts:
            raise InputError(
                "{}: the hour {} has no {}",
                folder,
                hour_text(self.hour),
                table.name,
                hint="it was measured without vehicles: for hits only, or without range rates",
            )
        metadata = self.origin.metadata(table, self.hour)
        with opened_part(table, path, metadata, self.parts[table.name]) as file:
            yield file

    def read(
        self, folder: Path, table: TableSchema, columns: Sequence[str] | None = None
    ) -> pa.Table:
        """Read the part of a table; errors are those of :meth:`opened`."""
        with self.opened(folder, table) as file:  # hours are read in parallel
            return file.read(columns=list(columns or table.names), use_threads=False)

    def check_bytes(self, folder: Path, table: TableSchema) -> None:
        """Compare the bytes of a part with this record, so that every flipped bit is found.

        Raises
        ------
        InputError
            If they differ, or as :meth:`opened`.
        """
        path = part_path(folder, table, self.hour)
        with self.opened(folder, table):
            if digest_of(path) != self.parts[table.name].sha256:
                raise InputError("{}: its bytes have changed", path, hint=MEASURE_AGAIN)


def record_path(folder: Path, hour: int) -> Path:
    """Return the path of the record of an hour."""
    return folder / HOURS / str(date_of(hour)) / f"{hour_begin(hour):%H}.json"


def read_hours(
    folder: Path, first: int | None = None, last: int | None = None
) -> dict[int, HourRecord]:
    """Read the records of complete hours, by hour since 1970, ascending.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    first, last : int, optional
        Only hours from `first` to `last`, inclusive.

    Raises
    ------
    InputError
        If one is damaged or of a newer schema.
    """
    found = (_read_record(path, hour) for hour, path in _record_paths(folder, first, last))
    return {record.hour: record for record in found if record is not None}


def _record_paths(
    folder: Path, first: int | None = None, last: int | None = None, step: int = 1
) -> Iterator[tuple[int, Path]]:
    """Yield the hours from `first` to `last` that have a record, with its path.

    `step` is 1, or -1 for the last one first.
    """
    low, high = 0 if first is None else first, _LAST_HOUR if last is None else last
    begin, end = (str(date_of(min(hour, _LAST_HOUR))) for hour in (low, high))
    dates = sorted(name for name in _names(folder / HOURS) if begin <= name <= end)
    for date in dates[::step]:
        yield from (
            each for each in _records_of_date(folder, date)[::step] if low <= each[0] <= high
        )


def _records_of_date(folder: Path, date: str) -> list[tuple[int, Path]]:
    """Return the hours since 1970 of a date that have a record, ascending, with its path."""
    try:
        first = int(datetime.fromisoformat(f"{date}T00:00Z").timestamp()) // 3600
    except ValueError:
        return []
    place = folder / HOURS / date
    names = sorted(name for name in _names(place) if _RECORD.fullmatch(name))
    return [(first + int(name[:2]), place / name) for name in names]


def _names(folder: Path) -> list[str]:
    """Return the names in a folder; none where there is no such folder."""
    with suppress(FileNotFoundError, NotADirectoryError):
        return [each.name for each in os.scandir(folder)]
    return []


def hour_bounds(
    folder: Path, first: int | None = None, last: int | None = None
) -> tuple[int, int] | None:
    """Return the first and the last complete hour, by the names of records; None without any.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    first, last : int, optional
        Only hours from `first` to `last`, inclusive.
    """
    lowest, highest = (next(_record_paths(folder, first, last, way), None) for way in (1, -1))
    return None if lowest is None or highest is None else (lowest[0], highest[0])


def listed_hours(folder: Path) -> list[int]:
    """List the hours since 1970 that have a record, ascending, without reading the records."""
    return [hour for hour, _ in _record_paths(folder)]


def read_hour(folder: Path, hour: int) -> HourRecord | None:
    """Read the record of an hour; None where it is not complete."""
    return _read_record(record_path(folder, hour), hour)


def _read_record(path: Path, hour: int) -> HourRecord | None:
    try:
        document = read_json(path, what="the record of an hour", hint=MEASURE_AGAIN)
    except InputError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
            return None
        raise
    try:
        if document["schema"] > SCHEMA:
            raise InputError(
                "{}: has schema {}, newer than {}",
                path,
                document["schema"],
                SCHEMA,
                hint="update gis_radar",
            )
        record = HourRecord(
            hour=int(datetime.fromisoformat(document["hour"]).timestamp()) // 3600,
            origin=_origin(document),
            parts={name: PartDigest(**part) for name, part in document["parts"].items()},
            dropped=tuple(document["dropped"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError("{}: damaged: {}", path, f"{error!r:.200}", hint=MEASURE_AGAIN) from error
    if record.hour != hour:
        raise InputError(
            "{}: is the record of {}", path, hour_text(record.hour), hint=MEASURE_AGAIN
        )
    return record


def _origin(document: dict[str, Any]) -> Origin:
    """Return the origin in a record; an entry of another type is damage."""
    found = {name: document[name] for name in Origin.__annotations__}
    for name, value in found.items():
        if not isinstance(value, int if name == "method" else str):
            raise TypeError(name)
    return Origin(**found)


def write_record(folder: Path, record: HourRecord) -> None:
    """Write the record of an hour whose parts are all there."""
    with replacing(record_path(folder, record.hour)) as fresh:
        fresh.write_text(_record_text(record), encoding="utf-8")


def _record_text(record: HourRecord) -> str:
    parts = {name: record.parts[name]._asdict() for name in TABLES if name in record.parts}
    document = {
        "schema": SCHEMA, "hour": hour_text(record.hour), **asdict(record.origin),
        "dropped": list(record.dropped), "parts": parts,
    }  # fmt: skip
    return json.dumps(document, indent=1) + "\n"


def remove_record(folder: Path, hour: int) -> None:
    """Remove the record of an hour, before any of its parts changes."""
    path = record_path(folder, hour)
    with output_errors(path), suppress(FileNotFoundError):
        path.unlink()
        sync_folder(path.parent)


@dataclass(kw_only=True)
class HourWriter:
    """Writer of the parts of an hour, which appear together when the block ends without error.

    Until then the earlier parts stay, with their record. A reader that finds a record finds its
    parts, whenever the run is killed.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    hour : int
        The hour since 1970.
    origin : Origin
        Origin of the parts.
    """

    folder: Path
    hour: int
    origin: Origin
    _parts: dict[str, PartDigest] = field(default_factory=dict)
    _moves: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        path = record_path(self.folder, self.hour)
        with output_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        writes = atomic_writes(path, flushed=True)
        self._private, self._places = self._moves.enter_context(writes)
        self._moves.push(self._finish)
        return self

    def write(self, table: TableSchema, batches: Values | Iterable[Values]) -> None:
        """Write the part of a table.

        Parameters
        ----------
        table : TableSchema
            One of the tables of an hour.
        batches : mapping, or iterable of mappings
            Its rows, whole or in batches: arrays by column, in order.

        Raises
        ------
        InputError
            If they do not have the table's columns, types and order.
        OutputError
            If it cannot be written.
        """
        metadata = self.origin.metadata(table, self.hour)
        path, fresh = part_path(self.folder, table, self.hour), self._private / table.name
        with output_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with writing_errors(path):
            self._parts[table.name] = write_part(table, fresh, batches, metadata)
        self._places[fresh] = path

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        """Remove the earlier record and the tables that the hour no longer has; add the record."""
        if kind is not None:
            return
        record = HourRecord(hour=self.hour, origin=self.origin, parts=self._parts)
        path = record_path(self.folder, self.hour)
        (self._private / path.name).write_text(_record_text(record), encoding="utf-8")
        self._places[self._private / path.name] = path
        remove_record(self.folder, self.hour)
        for table in HOUR_TABLES:
            if table.name not in self._parts:
                part_path(self.folder, table, self.hour).unlink(missing_ok=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._moves.__exit__(kind, error, trace)


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
            rows = _cut_to_span(table, rows, span)
        yield rows.select(wanted)


def _cut_to_span(table: TableSchema, rows: pa.Table, span: Span) -> pa.Table:
    """Return the rows with steps in a span, runs of tiles cut to it."""
    assert table.span is not None  # noqa: S101 - the caller has checked
    first, last = table.span
    inside = rows.filter(
        pc.and_(pc.less_equal(rows[first], span[1]), pc.greater_equal(rows[last], span[0]))
    )
    if not table.runs:
        return inside
    for name, bound, cut in ((FIRST.name, span[0], np.maximum), (LAST.name, span[1], np.minimum)):
        values = pa.array(cut(inside[name].to_numpy(), bound))
        inside = inside.set_column(inside.schema.get_field_index(name), inside.field(name), values)
    return inside

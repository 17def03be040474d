"""Edits: what bytes of a fuzzer change in a sound file, so that it stays a file of its kind.

Bytes at random rarely get past the frame of a Parquet file or a database. Here they are a program:
each step takes a few of them and changes one value, row or column.
"""

from __future__ import annotations

import copy
import json
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from faults.damage import VALUES, leaves

Edit = Callable[[bytes, bytes, Path], None]
MOST_STEPS = 12
NUMBERS = (
    0, 1, -1, 2, 7, 255, 65_535, 1 << 31, -(1 << 31), 1 << 53, (1 << 63) - 1, -(1 << 63),
    0.5, -0.0, 1e-300, 1e300, 1e30, -1e9, 90.0, 361.0, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
TEXTS = (
    "", " ", "0", "-1", "1e400", "nan", "inf", "9" * 400, "0x10", "1_000", "520 ft", "٣", "é\u0301",
    "true", "null", "[]", "{}", "a\nb", "a\0b", "\ud800", "../..", "/", "EPSG:4326", "EPSG:32632",
    "2026-02-30T25:61:00Z", "1969-12-31T23:59:59Z", "9999-12-31T23:59:59Z", "<", "&amp;", '"', ",",
    ";", "%", "x" * 3000,
)  # fmt: skip
TYPES = (
    pa.string(), pa.int8(), pa.int64(), pa.uint64(), pa.float32(), pa.float64(), pa.bool_(),
    pa.binary(), pa.timestamp("ns"), pa.timestamp("s"), pa.decimal128(38, 3), pa.date32(),
    pa.dictionary(pa.int32(), pa.string()), pa.list_(pa.int64()), pa.null(),
)  # fmt: skip
OF_GDAL = ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY")  # triggers call them
TOKEN = re.compile(rb"\w+(?:[.:+-]\w+)*|[^\w\s]|\s+")


class Program:
    """Bytes that are taken one after the other; zeros follow the last."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def __bool__(self) -> bool:
        return self.at < len(self.data) and self.at < MOST_STEPS * 8

    def below(self, count: int) -> int:
        """Take a number from 0 to `count` - 1."""
        size = 1 if count <= 256 else 2 if count <= 65_536 else 4
        taken = int.from_bytes(self.data[self.at : self.at + size])
        self.at += size
        return taken % count

    def one(self, values: Any) -> Any:
        """Take one of some values."""
        return values[self.below(len(values))]

    def value(self) -> Any:
        """Take nothing, a number, a text or bytes."""
        kind = self.below(4)
        if kind < 2:
            return self.one(NUMBERS) if kind else None
        text = self.one(TEXTS)
        return text if kind == 2 else text.encode("utf-8", "surrogatepass")


def replaced(data: bytes, _: bytes, path: Path) -> None:
    """Write the bytes themselves."""
    path.write_bytes(data)


def head(size: int) -> Edit:
    """Return an edit that puts bytes in the place of the first `size` of a file."""

    def put(data: bytes, sound: bytes, path: Path) -> None:
        path.write_bytes(data[:size] + sound[len(data[:size]) :])

    return put


def text(data: bytes, sound: bytes, path: Path) -> None:
    """Change words, numbers and signs of a text."""
    program, tokens = Program(data), TOKEN.findall(sound)
    while program and tokens:
        at, what = program.below(len(tokens)), program.below(6)
        if what == 0:
            tokens[at] = program.one(TEXTS).encode("utf-8", "surrogatepass")
        elif what == 1:
            tokens[at] = str(program.one(NUMBERS)).encode()
        elif what == 2:
            del tokens[at]
        elif what == 3:
            tokens[at] = tokens[program.below(len(tokens))]
        elif what == 4:
            tokens[at:at] = tokens[program.below(len(tokens)) :][: program.below(64)]
        else:
            del tokens[at : at + program.below(64)]
    path.write_bytes(b"".join(tokens))


def document(data: bytes, sound: bytes, path: Path) -> None:
    """Change values of a JSON document."""
    program, content = Program(data), json.loads(sound)
    while program:
        ways = list(leaves(content))
        if not ways:
            break
        *parents, last = program.one(ways)
        place = content
        for key in parents:
            place = place[key]
        what = program.below(4)
        if what == 0 and isinstance(place, dict):
            del place[last]
        elif what == 1 and isinstance(place, dict):
            place[program.one(TEXTS)] = place.pop(last)
        else:
            kind = program.one((VALUES, NUMBERS, TEXTS))
            place[last] = copy.deepcopy(program.one(kind))
    path.write_text(json.dumps(content), encoding="utf-8")


def record(data: bytes, sound: bytes, path: Path) -> None:
    """Change values of the JSON document at the end of a message; its envelope stays."""
    at = sound.index(b"{")
    document(data, sound[at:], path)
    path.write_bytes(sound[:at] + path.read_bytes())


def table(data: bytes, sound: bytes, path: Path) -> None:
    """Change values, rows and columns of a Parquet file."""
    program, content = Program(data), pq.read_table(BytesIO(sound))
    metadata, groups = content.schema.metadata, None
    while program and content.num_columns:
        try:
            content = _step(content, program)
        except (pa.ArrowException, ValueError, TypeError, LookupError):
            continue  # Arrow does not do that with every type
        if not program.below(8):
            groups = 1 + program.below(5)
            metadata = program.one((metadata, None, {b"fingerprint": b"\xff"}))
    pq.write_table(content.replace_schema_metadata(metadata), path, row_group_size=groups)


def _step(content: Any, program: Program) -> Any:
    """Do one step on a table."""
    what, number = program.below(9), program.below(content.num_columns)
    name, column, rows = content.schema.names[number], content.column(number), content.num_rows
    if what < 4 and rows:
        return content.set_column(number, name, _with_value(column, program))
    if what == 4:
        return content.set_column(number, name, _cast(column, program.one(TYPES)))
    if what == 5:
        title = program.one((None, *TEXTS))
        if title is None:
            return content.drop_columns([name])
        return content.append_column(title.encode("utf-8", "replace").decode(), column)
    if what == 6 and rows:
        order = [program.below(rows) for _ in range(1 + program.below(8))]
        return content.take(pa.array(order, pa.int64()))
    first = content.slice(0, program.below(rows + 1))
    return first if what == 7 else pa.concat_tables([content, first])


def _with_value(column: Any, program: Program) -> Any:
    """Return a column with another value in some rows, of its own type where that holds it."""
    values = column.to_pylist()
    at, value = program.below(len(values)), program.value()
    for k in range(1 + program.below(3)):
        values[(at + k) % len(values)] = value
    try:
        return pa.array(values, column.type)
    except (pa.ArrowException, ValueError, TypeError, OverflowError):
        return column


def _cast(column: Any, kind: Any) -> Any:
    try:
        return column.cast(kind, safe=False)
    except (pa.ArrowException, ValueError, TypeError):
        return pa.nulls(len(column), kind)


def database(data: bytes, sound: bytes, path: Path) -> None:
    """Change values, rows and tables of an SQLite database, a GeoPackage or a bag."""
    path.write_bytes(sound)
    program = Program(data)
    with closing(sqlite3.connect(path, isolation_level=None)) as base:
        base.execute("PRAGMA journal_mode = OFF")
        base.execute("PRAGMA synchronous = OFF")
        for name in OF_GDAL:
            base.create_function(name, 1, lambda _: 0)
        while program:
            try:
                _change(base, program)
            except (sqlite3.Error, OverflowError, UnicodeEncodeError):
                continue


def _change(base: sqlite3.Connection, program: Program) -> None:
    """Do one step on a database; SQLite refuses some."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
    name = program.one([row[0] for row in base.execute(query)] or ["none"])
    columns = [row[1] for row in base.execute(f'PRAGMA table_info("{name}")')] or ["none"]
    column, what, row = program.one(columns), program.below(9), 1 + program.below(8)
    of_row = f'UPDATE "{name}" SET "{column}" = ? WHERE rowid = ?'  # noqa: S608 - of the file itself
    if what < 4:
        base.execute(of_row, (program.value(), row))
    elif what < 6:
        old = base.execute(f'SELECT "{column}" FROM "{name}" WHERE rowid = ?', (row,)).fetchone()  # noqa: S608
        kept = old[0] if old and isinstance(old[0], bytes) else b""
        blob = bytearray(kept or b"GP\0\1")
        for _ in range(1 + program.below(4)):
            at = program.below(len(blob))
            blob[at : at + 1] = bytes([program.below(256)])
        base.execute(of_row, (bytes(blob), row))
    elif what == 6:
        base.execute(f'UPDATE "{name}" SET "{column}" = ?', (program.value(),))  # noqa: S608
    elif what == 7:
        base.execute(f'DELETE FROM "{name}" WHERE rowid >= ?', (row,))  # noqa: S608
    else:
        other = f'ALTER TABLE "{name}" RENAME COLUMN "{column}" TO other'
        base.execute(program.one((f'DROP TABLE "{name}"', other)))


def detections(data: bytes, sound: bytes, path: Path) -> None:
    """Change numbers of a datagram where its fields are: heads, first detections, tail."""
    program, content = Program(data), bytearray(sound)
    places = [*range(300), *range(len(content) - 40, len(content))]
    nan, infinite = np.array([np.nan, np.inf], ">f4")
    while program:
        at = program.one(places)
        byte = bytes([program.below(256)])
        value = program.one((bytes(4), b"\xff" * 4, nan.tobytes(), infinite.tobytes(), byte))
        content[at : at + len(value)] = value
    path.write_bytes(content)

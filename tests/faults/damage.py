"""Faults: what can be wrong with a file, a line a fault; each changes the bytes of one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Bytes = bytes
Fault = Callable[[Bytes, np.random.Generator], Bytes]
TEXTS = (".json", ".csv", ".toml", ".geojson", ".osm", ".yaml")


def _cut(share: float) -> Fault:
    return lambda data, _: data[: int(len(data) * share)]


def _flip(data: Bytes, chance: np.random.Generator) -> Bytes:
    changed = bytearray(data)
    changed[int(chance.integers(len(data)))] ^= 1 << int(chance.integers(8))
    return bytes(changed)


def _flip_early(data: Bytes, chance: np.random.Generator) -> Bytes:
    """Flip a bit where headers are."""
    return _flip(data[:512], chance) + data[512:]


def _filled(byte: int, length: int) -> Fault:
    def fill(data: Bytes, chance: np.random.Generator) -> Bytes:
        at = int(chance.integers(max(len(data) - length, 1)))
        return data[:at] + bytes([byte]) * min(length, len(data) - at) + data[at + length :]

    return fill


def _number(text: str) -> Fault:
    """Put something else in the place of one number of a text."""

    def put(data: Bytes, chance: np.random.Generator) -> Bytes:
        found = list(re.finditer(rb"-?\d+(\.\d+)?", data))
        one = found[int(chance.integers(len(found)))]
        return data[: one.start()] + text.encode() + data[one.end() :]

    return put


BYTES: dict[str, Fault] = {
    "empty": lambda *_: b"",
    "one byte": lambda data, _: data[:1],
    "cut at a tenth": _cut(0.1),
    "cut at the half": _cut(0.5),
    "cut at the end": _cut(0.99),
    "last byte gone": lambda data, _: data[:-1],
    **{f"bit {k}": _flip for k in range(6)},
    **{f"bit of the header {k}": _flip_early for k in range(6)},
    "zeros": _filled(0, 64),
    "ones": _filled(255, 64),
    "long zeros": _filled(0, 4096),
    "garbage behind": lambda data, chance: data + chance.bytes(500),
    "garbage": lambda _, chance: chance.bytes(3000),
    "text": lambda *_: b"hello\nworld\n",
    "twice": lambda data, _: data + data,
    "virtual": lambda *_: b"<OGRVRTDataSource><OGRVRTLayer name='tiles'/></OGRVRTDataSource>",
    "another database": lambda *_: b"SQLite format 3\0" + bytes(4080),
    "parquet ends": lambda *_: b"PAR1" + bytes(40) + b"PAR1",
    "zip": lambda *_: b"PK\x03\x04" + bytes(200),
    "gzip": lambda *_: b"\x1f\x8b\x08" + bytes(200),
}
TEXT: dict[str, Fault] = {
    "other encoding": lambda data, _: data.decode().encode("utf-16"),
    "not UTF-8": lambda data, _: data.replace(b"R", b"\xff\xfe", 1),
    "byte order mark": lambda data, _: b"\xef\xbb\xbf" + data,
    "line ends of Windows": lambda data, _: data.replace(b"\n", b"\r\n"),
    "zero bytes": lambda data, _: data[: len(data) // 2] + b"\0\0" + data[len(data) // 2 :],
    "a huge number": _number("1e400"),
    "a number of 5000 digits": _number("9" * 5000),
    "not a number": _number("nan"),
    "a negative number": _number("-7"),
    "a number with a unit": _number("520 ft"),
    "a hostile text": _number('"<script>[% 1 %]&#10;"'),
    "a cell of 200 kB": _number("x" * 200_000),
    "a tag that does not end": lambda data, _: data.replace(b"<", b"<a b='" + b"x" * 3_000_000, 1),
    "a table a thousand times": lambda data, _: data + b"\n[[sensor]]\n" * 1000,
    "a line of 1 MB": lambda data, _: data + b"x" * 1_000_000 + b"\n",
    "a column of 50,000": lambda data, _: data.replace(b"\n", b",1" * 50_000 + b"\n", 1),
    "header alone": lambda data, _: data.partition(b"\n")[0] + b"\n",
    "deep": lambda *_: b"[" * 100_000 + b"]" * 100_000,
    "deep tables": lambda *_: b"a = " + b"{ a = " * 5000 + b"1" + b" }" * 5000,
}


def leaves(document: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the ways to all values of a JSON document."""
    if isinstance(document, dict | list) and document:
        pairs = document.items() if isinstance(document, dict) else enumerate(document)
        for key, value in pairs:
            yield (*way, key)
            yield from leaves(value, (*way, key))


def _replaced(value: Any) -> Fault:
    def replace(data: Bytes, chance: np.random.Generator) -> Bytes:
        document = json.loads(data)
        ways = list(leaves(document))
        *parents, last = ways[int(chance.integers(len(ways)))]
        place = document
        for key in parents:
            place = place[key]
        place[last] = value
        return json.dumps(document).encode()

    return replace


VALUES = (None, "text", "", -1, 0, 10**30, 1.5, True, [], {}, [None], {"a": [1]}, "x\ny", "\ud800")
JSON: dict[str, Fault] = {
    f"{value!r} as a value, {k}": _replaced(value) for value in VALUES for k in range(3)
}


def faults_of(path: str) -> dict[str, Fault]:
    """Return the faults that a file of this name can have."""
    fitting = dict(BYTES)
    if path.endswith(TEXTS):
        fitting |= TEXT
    if path.endswith(("json",)):
        fitting |= JSON
    return fitting

"""Read an existing site file into a draft, and write it with all keys that the draft lacks.

Needs no QGIS; the worker's Python reads TOML, which that of QGIS may not.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..runner import WorkerError, run_command
from ..words import WINDS, tr

Table = dict[str, Any]
_TO_JSON = (
    "import json, sys, tomllib\n"
    "try: print(json.dumps(tomllib.loads(open(sys.argv[1], encoding='utf-8-sig').read())))\n"
    "except (OSError, ValueError, TypeError) as error: sys.exit(str(error) or 'not readable')\n"
)


def read_toml(python: str, path: Path) -> Table:
    """Return what a site file holds.

    Raises
    ------
    WorkerError
        If it cannot be read, in one sentence.
    """
    lines: list[str] = []
    command = [python, "-P", "-X", "utf8", "-c", _TO_JSON, str(path)]
    code, errors = run_command(command, lines.append, lambda: False)
    if code != 0 or not lines:
        reason = errors[-1] if errors else tr("it ended with code {code}").format(code=code)
        raise WorkerError("{path}: {reason}", path=path, reason=reason)
    found: Table = json.loads(lines[-1])
    return found


def kept(read: Mapping[str, Any], before: Mapping[str, Any], now: Mapping[str, Any]) -> Table:
    """Return a table to write: changed values as they are now, all others as they were read.

    Parameters
    ----------
    read : mapping
        As the file has it.
    before, now : mapping
        Values of the draft: as read, and now.
    """
    table: Table = {}
    for key in dict.fromkeys([*read, *now]):
        if isinstance(read.get(key), dict):
            inner = kept(read[key], before.get(key, {}), now.get(key, {}))
            table |= {key: inner} if inner else {}
        elif now.get(key) != before.get(key):
            if key in now:
                table[key] = now[key]
        elif key in read:
            table[key] = read[key]
    return table


def toml(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML: values first, then a table each, then those of lists."""
    return "\n".join(_lines(tables)).strip() + "\n"


def _lines(tables: Mapping[str, Any]) -> Iterator[str]:
    below = {key: value for key, value in tables.items() if _is_table(value)}
    yield from _values({key: value for key, value in tables.items() if key not in below})
    lists = {key: value for key, value in below.items() if isinstance(value, list)}
    for key, table in below.items():
        if key not in lists and table:
            yield from ("", f"[{_key(key)}]", *_values(table))
    for key, items in lists.items():
        for item in items:
            yield from ("", f"[[{_key(key)}]]", *_values(item))


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) or (
        isinstance(value, list) and bool(value) and all(isinstance(each, dict) for each in value)
    )


def _values(table: Mapping[str, Any]) -> Iterator[str]:
    for key, value in table.items():
        yield f"{_key(key)} = {_value(value)}"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        inside = ", ".join(f"{_key(key)} = {_value(each)}" for key, each in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float) and not abs(value) < float("inf"):
        return str(value)  # inf and nan are words of TOML, too
    return json.dumps(value, ensure_ascii=False)


def _key(key: str) -> str:
    plain = key.isascii() and key.replace("_", "").replace("-", "").isalnum()
    return key if plain else json.dumps(key, ensure_ascii=False)


def heading_in(sensor: Mapping[str, Any]) -> float | None:
    """Return the yaw that a sensor's table states; of a compass bearing that of grid north."""
    if isinstance(sensor.get("heading"), (int, float)):
        return float(sensor["heading"])
    bearing = sensor.get("compass")
    if bearing in WINDS:
        bearing = 45.0 * WINDS.index(bearing)
    if not isinstance(bearing, (int, float)):
        return None
    return (90.0 - bearing + 180.0) % 360.0 - 180.0

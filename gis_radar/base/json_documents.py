"""Read JSON whole or refuse it; write JSON that any program can read."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gis_radar.base.errors import InputError, first_line
from gis_radar.base.files import atomic_write, output_errors


def parsed_json(text: str) -> Any:
    """Return what a JSON text holds.

    Parameters
    ----------
    text : str
        The text.

    Raises
    ------
    ValueError
        If it is no JSON, has a key twice, or escapes half of a surrogate pair, which no UTF-8 file
        can hold.
    RecursionError
        If it is nested too deeply.
    """
    found = json.loads(text, object_pairs_hook=_with_keys_once)
    if "\\ud" in text.lower():
        json.dumps(found, ensure_ascii=False).encode()
    return found


def _with_keys_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in found if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:50]!r} is there twice")
    return found


def read_json(path: str | Path, *, what: str, hint: str = "") -> Any:
    """Read a file of JSON.

    Parameters
    ----------
    path : str or Path
        The file, in UTF-8.
    what : str
        Expected content, for the message: `a pose`.
    hint : str
        How to get one, for the message.

    Raises
    ------
    InputError
        If it cannot be read, or is no JSON that Python can hold.
    """
    try:
        return parsed_json(Path(path).read_bytes().decode("utf-8-sig"))
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError("{}: cannot be read: {}", path, reason, hint=hint) from error
    except UnicodeDecodeError as error:
        raise InputError("{}: not {}: not UTF-8 text", path, what, hint=hint) from error
    except (ValueError, RecursionError) as error:
        raise InputError(
            "{}: not {}: not JSON: {}", path, what, first_line(error), hint=hint
        ) from error


def json_text(
    document: Any, *, indent: int | None = None, default: Callable[[Any], Any] | None = None
) -> str:
    """Return a document as JSON for other programs: infinite numbers and NaN become null.

    Parameters
    ----------
    document : object
        Made of what JSON can hold, and of numbers that it cannot.
    indent : int, optional
        Blanks by which each level is indented; by default all is one line.
    default : callable, optional
        Turns other objects into what JSON can hold; without it they are refused.
    """
    options: dict[str, Any] = {"indent": indent, "default": default}
    return json.dumps(_finite(document), ensure_ascii=False, allow_nan=False, **options)


def write_json(
    path: Path, document: Any, *, indent: int | None = 1,
    default: Callable[[Any], Any] | None = None,
) -> None:  # fmt: skip
    """Write a document as :func:`json_text`, whole or not at all; parameters are those.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    with atomic_write(path) as part, output_errors(path):
        text = json_text(document, indent=indent, default=default)
        part.write_text(text + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

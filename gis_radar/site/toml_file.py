"""TOML files described by models: reading with the lines of errors, template, and reference."""

from __future__ import annotations

import difflib
import textwrap
import tomllib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import PrivateAttr, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from gis_radar.base import InputError, Text, first_line
from gis_radar.site.values import Steps, TomlTable, Unfit, is_repeated, lines_of, table_of, value_of

LARGEST_FILE = 1 << 22  # bytes; names of ten thousand recordings take half of it
_MOST_SENSORS = 200  # of a site: more than any town has at its junctions
_WIDTH = 96  # characters of a line of the template
_OPTIONAL = ("live", "lane", "map")  # tables that a template comments out where not required


class TomlFile(TomlTable):
    """The tables of a whole file."""

    _path: Path = PrivateAttr(Path("SITE.toml"))

    @property
    def path(self) -> Path:
        """The file it was read from."""
        return self._path


Root = TypeVar("Root", bound=TomlFile)


def read_toml(path: Path, root: type[Root], *, of_site: bool, hint: str) -> Root:
    """Read a file and check it against its model.

    Parameters
    ----------
    path : Path
        The file; the paths in it are relative to its folder.
    root : type
        The model of the whole file.
    of_site : bool
        Whether it is a site file, for messages.
    hint : str
        How to get such a file, for messages.

    Raises
    ------
    InputError
        If it is no TOML, a key is unknown or missing, a value does not fit, or a file that it names
        does not exist. The message names the line, the key and what was expected.
    """
    try:
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise InputError("{}: {:,} MiB is no site file", path, size >> 20, hint=hint)
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or Text("not UTF-8 text")
        raise InputError("{}: cannot be read: {}", path, reason, hint=hint) from error
    try:
        raw: dict[str, Any] = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # numbers of 5,000 digits, deep tables
        raise InputError("{}: not TOML: {}", path, first_line(error), hint=hint) from error
    sensors = raw.get("sensor")
    if isinstance(sensors, list) and len(sensors) > _MOST_SENSORS:
        raise InputError(
            "{}: has {:,} sensors, at most {} make a site",
            path,
            len(sensors),
            _MOST_SENSORS,
            hint="make several sites",
        )
    lines = lines_of(text)
    try:
        found = root.model_validate(raw, context={"folder": path.parent})
    except ValidationError as error:
        raise _first_error(path, lines, raw, error, root, of_site=of_site) from None
    found._path = path  # noqa: SLF001 - not a key of the file
    return found


# Errors as one line with file, line and key.


def _first_error(
    path: Path, lines: Mapping[Steps, int], raw: Any, error: ValidationError,
    root: type[TomlTable], *, of_site: bool,
) -> InputError:  # fmt: skip
    """Return the first error by line; an unknown key comes first, as it may cause others."""
    errors = error.errors(include_url=False)
    # A list whose only item is wrong is also reported as too short: only the inner error counts.
    inner = [
        each for each in errors
        if not any(
            other["loc"][: len(each["loc"])] == each["loc"] and len(other["loc"]) > len(each["loc"])
            for other in errors
        )
    ]  # fmt: skip
    found = [_error_parts(each, raw, root, of_site=of_site) for each in inner]

    def line_of(steps: Steps) -> int:
        return next((lines[steps[:n]] for n in range(len(steps), 0, -1) if steps[:n] in lines), 0)

    steps, _, message, hint = min(found, key=lambda each: (each[1], line_of(each[0])))
    line = f":{number}" if (number := line_of(steps)) else ""
    where = "".join(f"[{each}]" if isinstance(each, int) else f".{each}" for each in steps)
    place = where[1:] or (Text("the site file") if of_site else Text("the file"))
    return InputError("{}{}: {}: {}", path, line, place, message, hint=hint)


def _error_parts(
    error: ErrorDetails, raw: Any, root: type[TomlTable], *, of_site: bool
) -> tuple[Steps, bool, str, str]:
    """Return the place of an error, whether its key is known, its message, and its hint."""
    table, field, steps = _locate(error["loc"], root)
    if error["type"] == "extra_forbidden":
        name, known = str(steps[-1]), list(table.model_fields)
        near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.6)
        hint = Text("did you mean {}?", near[0]) if near else Text("known are {}", ", ".join(known))
        unknown = Text("is no key of a site file") if of_site else Text("is no key of this file")
        return steps, False, unknown, hint
    if error["type"] == "missing":
        example = field.examples[0] if field and field.examples else None
        hint = Text("e.g. {} = {}", steps[-1], example) if example else Text("")
        return steps[:-1], True, Text("lacks {}", steps[-1]), hint
    unfit = error.get("ctx", {}).get("error")
    if not isinstance(unfit, Unfit):
        unfit = Unfit()
    if unfit.message:
        return unfit.at or steps, True, unfit.message, unfit.hint
    value = raw
    for step in steps:
        value = value[step]
    expected = unfit.expected or (value_of(field) if field else Text("a table"))
    return steps, True, Text("is {}, expected {}", _value_text(value), expected), unfit.hint


def _value_text(value: Any) -> str:
    if isinstance(value, dict):
        return Text("a table")
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _locate(loc: Steps, root: type[TomlTable]) -> tuple[type[TomlTable], FieldInfo | None, Steps]:
    """Return the innermost table and key of a place, and the steps to that key."""
    table: type[TomlTable] = root
    field: FieldInfo | None = None
    for depth, step in enumerate(loc):
        inner = root if field is None else table_of(field)
        if inner is None:  # inside a value
            return table, field, loc[:depth]
        if isinstance(step, str):
            table, field = inner, inner.model_fields.get(step)
    return table, field, loc


# The template of a file and the reference of its keys, from the fields of the models.


def toml_template(
    root: type[TomlTable], head: str, *, given: Collection[tuple[str, str]] = ()
) -> str:
    """Return a commented file to fill in.

    Parameters
    ----------
    root : type
        The model of the whole file.
    head : str
        First lines of the file.
    given : collection of (str, str)
        Tables and keys that are not commented out although not required: one of several keys that
        suffice.
    """
    return "\n".join([head, *_template(root, "", given)]).rstrip() + "\n"


def _template(
    table: type[TomlTable], path: str, given: Collection[tuple[str, str]], *, comment: str = ""
) -> Iterator[str]:
    """Yield the lines of a table: first its keys, then the tables below it."""
    keys, subtables = keys_and_subtables(table, path)
    for name, field in keys.items():
        needed = field.is_required() or (path, name) in given
        text = f"{field.description} ({value_of(field)}; {default_of(field)})"
        yield from textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
        yield f"{comment if needed else '# '}{name} = {(field.examples or [''])[0]}"
    yield ""
    for inner_path, field, inner in subtables:
        optional = inner_path in _OPTIONAL and not field.is_required()
        inner_comment = "# " if optional else comment
        header_comment = "# " if inner_path.startswith("sensor.") else inner_comment
        yield f"{header_comment}{header_of(inner_path, field)}  # {field.description}"
        yield from _template(inner, inner_path, given, comment=inner_comment)


def keys_and_subtables(
    table: type[TomlTable], path: str
) -> tuple[dict[str, FieldInfo], list[tuple[str, FieldInfo, type[TomlTable]]]]:
    """Return the keys of a table, and the tables below it with their paths."""
    inner = {name: table_of(field) for name, field in table.model_fields.items()}
    keys = {name: field for name, field in table.model_fields.items() if inner[name] is None}
    subtables = [
        (f"{path}.{name}".lstrip("."), table.model_fields[name], each)
        for name, each in inner.items()
        if each is not None
    ]
    return keys, subtables


def header_of(path: str, field: FieldInfo) -> str:
    """Return the header of a table, `[name]` or `[[name]]`."""
    return f"[[{path}]]" if is_repeated(field) else f"[{path}]"


def default_of(field: FieldInfo) -> str:
    """Return `required`, or the default of a key as TOML writes it."""
    if field.is_required():
        return "required"
    extra = field.json_schema_extra
    shown = extra.get("shown") if isinstance(extra, dict) else None
    if shown is None:  # as TOML writes it
        shown = str(field.default).lower() if isinstance(field.default, bool) else field.default
    return f"default {shown}"

"""Types of values and tables in a site file, with their descriptions and checks."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, ValidationInfo
from pydantic.fields import FieldInfo

from gis_radar.base import (
    CYCLE_HINT,
    LONGEST_CYCLE_S,
    SHORTEST_CYCLE_S,
    GisRadarError,
    Text,
    bearing_of,
    duration_s,
    first_line,
    interval_steps,
    is_folder_name,
    looks_like_degrees,
    metric_crs,
    zone_of,
)

_WILDCARDS = frozenset("*?[")

Steps = tuple[str | int, ...]
Value = TypeVar("Value")


class Unfit(ValueError):  # noqa: N818 - becomes an error where file and line are known
    """An error about a value: the expected kind of value, or a whole message of its own."""

    def __init__(
        self, expected: str = "", *, message: str = "", hint: str = "", at: Steps = ()
    ) -> None:
        super().__init__(expected or message)
        self.expected, self.message, self.hint, self.at = expected, message, hint, at


@dataclass(frozen=True)
class Meaning:
    """Description of the values of a type, in a few words."""

    text: str


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise Unfit
    return value


def _name(value: Any) -> str:
    """Return a text that folders and topics can have as a name; refuse any other."""
    text = _text(value)
    if not is_folder_name(text):
        raise Unfit(
            Text(
                "a name that a folder can have: up to 200 bytes, "
                'without / \\ : * ? " < > | + # and no leading dot'
            )
        )
    return text


def _position(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Return a position in metres; refuse one that looks like degrees."""
    if looks_like_degrees(*numbers[:2]):
        raise Unfit(
            Text("metres of the map, not degrees"),
            hint=Text("easting and northing in the CRS of the map, e.g. [690356.0, 5336183.0]"),
        )
    return numbers


def _ascending(numbers: tuple[float, float]) -> tuple[float, float]:
    if not numbers[0] < numbers[1]:
        raise Unfit
    return numbers


def parsed(parse: Callable[[str], Value], text: str) -> Value:
    """Return what a parser makes of a text; its message becomes the hint of the error."""
    try:
        return parse(text)
    except GisRadarError as error:
        raise Unfit(hint=error.message) from error


def _crs(text: str) -> str:
    try:
        metric_crs(text, what="crs")
    except GisRadarError as error:
        raise Unfit(message=error.message, hint=error.hint) from error
    return text


def _zone(text: str) -> str:
    parsed(zone_of, text)
    return text


def _intervals(texts: tuple[str, ...]) -> tuple[str, ...]:
    found = tuple(each.strip().lower() for each in texts)
    if len({parsed(interval_steps, each) for each in found}) < len(found):
        raise Unfit(Text("lengths that differ from each other"))
    return found


def _cycle(value: Any) -> float:
    """Return the seconds of a cycle; refuse one of no radar."""
    text = _text(value)
    if text == "auto":
        raise Unfit(hint=CYCLE_HINT)
    cycle_s = parsed(duration_s, text)
    if not SHORTEST_CYCLE_S <= cycle_s <= LONGEST_CYCLE_S:
        raise Unfit(Text("{:g} to {:g} s", SHORTEST_CYCLE_S, LONGEST_CYCLE_S))
    return cycle_s


def _folder(info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("folder", ""))


def _place(value: Any, info: ValidationInfo) -> Path:
    return _folder(info) / _expanded(_text(value))


def _file(value: Any, info: ValidationInfo, *, folders: bool = False) -> Path:
    """Return the path of a file that exists, from the site file's folder."""
    path = _place(value, info)
    is_folder = os.path.isdir(path)  # noqa: PTH112 - pathlib raises where a name is too long
    if not os.path.isfile(path) and not (folders and is_folder):  # noqa: PTH113
        reason = "is a folder" if is_folder else "no such file"
        raise Unfit(
            message=Text("{}: {}", path, reason),
            hint="paths are relative to the folder of the site file",
        )
    return path


def _files(value: Any, info: ValidationInfo, *, folders: bool = False) -> tuple[Path, ...]:
    """Return the files of names and patterns, each once; those of a pattern are sorted by name."""
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not patterns:
        raise Unfit
    found: dict[Path, None] = {}
    for pattern in map(_text, patterns):
        if _WILDCARDS & {*pattern}:
            found |= dict.fromkeys(_matches(pattern, _folder(info), folders=folders))
        else:
            found[_file(pattern, info, folders=folders)] = None
    return tuple(found)


def _expanded(text: str) -> Path:
    """Return a path with `~` replaced by the user's home; unchanged for an unknown user."""
    return Path(os.path.expanduser(text))  # noqa: PTH111 - pathlib raises


def _matches(pattern: str, folder: Path, *, folders: bool) -> list[Path]:
    """Return the files that match a pattern, sorted by name; refuse one without any."""
    expanded = _expanded(pattern)
    root = Path(expanded.anchor) if expanded.is_absolute() else folder
    try:
        found = root.glob(str(expanded.relative_to(expanded.anchor)))
        matches = sorted(path for path in found if folders or path.is_file())
    except (ValueError, OSError) as error:
        raise Unfit(hint=first_line(error)) from error
    if not matches:
        raise Unfit(
            message=Text("no file matches {}", repr(str(root.resolve() / pattern))),
            hint=Text("patterns are relative to the folder of the site file"),
        )
    return matches


def within(low: float = -math.inf, high: float = math.inf) -> Any:
    """Return a constraint for numbers from `low` to `high`."""
    return Field(strict=True, ge=low, le=high, allow_inf_nan=False)


TextValue = Annotated[str, Meaning("text"), PlainValidator(_text)]
Texts = Annotated[tuple[TextValue, ...], Meaning(Text("a list of texts")), Field(min_length=1)]
Name = Annotated[str, Meaning(Text("a name")), PlainValidator(_name)]
Switch = Annotated[bool, Meaning(Text("true or false")), Field(strict=True)]
Number = Annotated[float, within()]
Point = Annotated[tuple[Number, Number], Meaning(Text("[E, N], metres"))]
Position = Annotated[
    tuple[Number, ...],
    Meaning(Text("[E, N] or [E, N, H], metres")),
    Field(min_length=2, max_length=3),
    AfterValidator(_position),
]
Span = Annotated[
    tuple[Number, Number],
    Meaning(Text("[LOW, HIGH], metres, ascending")),
    AfterValidator(_ascending),
]
Crs = Annotated[
    TextValue, Meaning(Text("a projected, metric CRS such as EPSG:25832")), AfterValidator(_crs)
]
CompassBearing = Annotated[
    float, Meaning(Text("degrees or a word such as north-east")), PlainValidator(bearing_of)
]
Intervals = Annotated[
    tuple[TextValue, ...],
    Meaning(Text('a list of lengths such as ["15min", "1h"]')),
    Field(min_length=1),
    AfterValidator(_intervals),
]
Cycle = Annotated[float, Meaning(Text('a duration such as "150ms"')), PlainValidator(_cycle)]
Zone = Annotated[
    TextValue, Meaning(Text("an IANA time zone such as Europe/Berlin")), AfterValidator(_zone)
]
File = Annotated[Path, Meaning(Text("the name of a file")), PlainValidator(_file)]
# The name of a file that may not exist yet.
Place = Annotated[Path, Meaning(Text("the name of a file")), PlainValidator(_place)]
Files = Annotated[
    tuple[Path, ...],
    Meaning(Text('the name of a file, or a list of names and patterns such as ["R1_*.parquet"]')),
    PlainValidator(_files),
]
Recordings = Annotated[
    tuple[Path, ...],
    Meaning(Text('a name, or a list of names and patterns such as ["R1_*.parquet"]')),
    PlainValidator(lambda value, info: _files(value, info, folders=True)),
]
Pairs = Annotated[
    dict[str, TextValue], Meaning(Text('a table such as { x = "X" }')), Field(min_length=1)
]


# Tables of the file, their keys, and the lines of these.


def key(example: str | float, default: Any = ..., shown: str | None = None) -> Any:
    """Declare a field of a table as a key of the site file; the field's docstring describes it.

    Parameters
    ----------
    example : str
        A value as TOML, for the template; a number is the default as well.
    default : object
        Value if the key is missing; a key without a default is required.
    shown : str, optional
        The default in words; by default the value itself.
    """
    default = example if isinstance(example, float) else default
    return Field(default, examples=[str(example)], json_schema_extra={"shown": shown})


class TomlTable(BaseModel):
    """A table of the site file, immutable; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


def table_of(field: FieldInfo) -> type[TomlTable] | None:
    """Return the table that is the value of a key; None for any other value."""
    kinds = _kinds(field.annotation)
    return next(
        (each for each in kinds if isinstance(each, type) and issubclass(each, TomlTable)), None
    )


def is_repeated(field: FieldInfo) -> bool:
    """Return whether a table may be repeated: `[[name]]`."""
    return get_origin(field.annotation) is tuple


def value_of(field: FieldInfo) -> str:
    """Return the description of a key's value, in a few words."""
    inner = table_of(field)
    if inner is not None:
        return Text("one or more tables: [[sensor]]") if is_repeated(field) else Text("a table")
    kinds = _kinds(field.annotation)
    inside = [note for each in kinds for note in getattr(each, "__metadata__", ())]
    # the outermost comes last
    meanings = [each.text for each in (*inside, *field.metadata) if isinstance(each, Meaning)]
    return meanings[-1] if meanings else Text("one of {}", ", ".join(get_args(field.annotation)))


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """Return the types of a union or a tuple, else the type itself."""
    inside = get_origin(annotation) in {Union, UnionType, tuple}
    return get_args(annotation) if inside else (annotation,)


_HEADER = re.compile(r"\s*(\[\[?)\s*([^\]#]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*[\"']?([A-Za-z0-9_.-]+)[\"']?\s*=")


def lines_of(text: str) -> dict[Steps, int]:
    """Return the line, from 1, of each table and key of a TOML text.

    They are found by patterns, for messages only; within a text of several lines they may be wrong.
    """
    lines: dict[Steps, int] = {}
    counts: dict[str, int] = {}
    table: Steps = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _steps_to(header[2], counts, repeated=header[1] == "[[")
            lines.setdefault(table, number)
        elif found := _KEY.match(line):
            steps = (*table, *found[1].split("."))
            for length in range(len(table) + 1, len(steps) + 1):
                lines.setdefault(steps[:length], number)
    return lines


def _steps_to(name: str, counts: dict[str, int], *, repeated: bool) -> Steps:
    """Return the steps to a table; below a repeated table, to its latest one."""
    if repeated:
        counts[name] = counts.get(name, -1) + 1
    steps: list[str | int] = []
    words = [word.strip().strip("\"'") for word in name.split(".")]
    for depth, word in enumerate(words, start=1):
        steps.append(word)
        latest = counts.get(".".join(words[:depth]))
        if latest is not None:
            steps.append(latest)
    return tuple(steps)

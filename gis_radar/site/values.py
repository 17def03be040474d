"""Types of values in a site file: what each looks like, and how it is checked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, PlainValidator, ValidationInfo

from gis_radar.crs import bearing_of, looks_like_degrees, metric_crs
from gis_radar.errors import GisRadarError
from gis_radar.occupancy.frame_steps import AUTO, LONGEST_CYCLE_S, SHORTEST_CYCLE_S
from gis_radar.steps import duration_s, interval_steps, zone_of

_WILD = frozenset("*?[")
_NOT_IN_NAMES = frozenset('/\\:*?"<>|')

Steps = tuple[str | int, ...]


class Unfit(ValueError):  # noqa: N818 - becomes an error where file and line are known
    """A value that does not fit: what was expected, or a whole message of its own."""

    def __init__(
        self, expected: str = "", *, message: str = "", hint: str = "", at: Steps = ()
    ) -> None:
        super().__init__(expected or message)
        self.expected, self.message, self.hint, self.at = expected, message, hint, at


@dataclass(frozen=True)
class Meaning:
    """What a value of a type is, in a few words."""

    text: str


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise Unfit
    return value


def _name(value: Any) -> str:
    text = _text(value)
    if text.startswith(".") or text != text.strip() or text[-1] == "." or _NOT_IN_NAMES & {*text}:
        raise Unfit('a name that a folder can have: without / \\ : * ? " < > | and no leading dot')
    return text


def _numbers(*counts: int) -> PlainValidator:
    def check(value: Any) -> tuple[float, ...]:
        fits = isinstance(value, list) and len(value) in counts
        if not fits or not all(
            type(each) in {int, float} and math.isfinite(each) for each in value
        ):
            raise Unfit
        return tuple(map(float, value))

    return PlainValidator(check)


def _position(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if looks_like_degrees(*numbers[:2]):
        raise Unfit(
            "metres of the map, not degrees",
            hint="easting and northing in the CRS of the map, e.g. [690356.0, 5336183.0]",
        )
    return numbers


def _ascending(numbers: tuple[float, float]) -> tuple[float, float]:
    if not numbers[0] < numbers[1]:
        raise Unfit
    return numbers


def _parsed(parse: Callable[[str], object], text: str) -> None:
    """Check a text by its parser, whose message becomes the hint."""
    try:
        parse(text)
    except GisRadarError as error:
        raise Unfit(hint=error.message) from error


def _crs(value: Any) -> str:
    text = _text(value)
    try:
        metric_crs(text, what="crs")
    except GisRadarError as error:
        raise Unfit(message=error.message, hint=error.hint) from error
    return text


def _zone(value: Any) -> str:
    text = _text(value)
    _parsed(zone_of, text)
    return text


def _intervals(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise Unfit
    found = tuple(_text(each).strip().lower() for each in value)
    for each in found:
        _parsed(interval_steps, each)
    if len({interval_steps(each) for each in found}) < len(found):
        raise Unfit("lengths that differ from each other")
    return found


def _cycle(value: Any) -> float | str:
    text = _text(value)
    if text == AUTO:
        return text
    _parsed(duration_s, text)
    if not SHORTEST_CYCLE_S <= duration_s(text) <= LONGEST_CYCLE_S:
        raise Unfit(f"{SHORTEST_CYCLE_S:g} to {LONGEST_CYCLE_S:g} s")
    return duration_s(text)


def _pairs(value: Any) -> dict[str, str]:
    if not isinstance(value, dict) or not value:
        raise Unfit
    return {name: _text(each) for name, each in value.items()}


def _folder(info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("folder", ""))


def _file(value: Any, info: ValidationInfo, *, folders: bool = False) -> Path:
    path = _folder(info) / Path(_text(value)).expanduser()
    if not path.is_file() and not (folders and path.is_dir()):
        reason = "is a folder" if path.is_dir() else "no such file"
        raise Unfit(
            message=f"{path}: {reason}", hint="paths are relative to the folder of the site file"
        )
    return path


def _files(value: Any, info: ValidationInfo, *, folders: bool = False) -> tuple[Path, ...]:
    """Return the files of names and patterns, each once, those of a pattern by name."""
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not patterns:
        raise Unfit
    found: dict[Path, None] = {}
    for pattern in map(_text, patterns):
        wild = _WILD & {*pattern}
        matches = _matches(pattern, _folder(info), folders=folders) if wild else [
            _file(pattern, info, folders=folders)
        ]  # fmt: skip
        found.update(dict.fromkeys(matches))
    return tuple(found)


def _matches(pattern: str, folder: Path, *, folders: bool) -> list[Path]:
    whole = Path(pattern).expanduser()
    root = Path(whole.anchor) if whole.is_absolute() else folder
    try:
        found = root.glob(str(whole.relative_to(whole.anchor)))
        matches = sorted(path for path in found if folders or path.is_file())
    except ValueError as error:
        raise Unfit(hint=str(error)) from error
    if not matches:
        raise Unfit(
            message=f"no file matches {str(root.resolve() / pattern)!r}",
            hint="patterns are relative to the folder of the site file",
        )
    return matches


def _recordings(value: Any, info: ValidationInfo) -> tuple[Path, ...]:
    return _files(value, info, folders=True)


def within(low: float = -math.inf, high: float = math.inf) -> Any:
    """Return the constraint of numbers from `low` to `high`."""
    return Field(strict=True, ge=low, le=high, allow_inf_nan=False)


Text = Annotated[str, Meaning("text"), PlainValidator(_text)]
Texts = Annotated[tuple[Text, ...], Meaning("a list of texts"), Field(min_length=1)]
Name = Annotated[str, Meaning("a name"), PlainValidator(_name)]
Point = Annotated[tuple[float, float], Meaning("[E, N], metres"), _numbers(2)]
Position = Annotated[
    tuple[float, ...], Meaning("[E, N] or [E, N, H], metres"), _numbers(2, 3),
    AfterValidator(_position),
]  # fmt: skip
Span = Annotated[
    tuple[float, float], Meaning("[LOW, HIGH], metres, ascending"), _numbers(2),
    AfterValidator(_ascending),
]  # fmt: skip
Crs = Annotated[str, Meaning("a projected, metric CRS such as EPSG:25832"), PlainValidator(_crs)]
CompassBearing = Annotated[
    float, Meaning("degrees or a word such as north-east"), PlainValidator(bearing_of)
]
Intervals = Annotated[
    tuple[str, ...],
    Meaning('a list of lengths such as ["15min", "1h"]'),
    PlainValidator(_intervals),
]
Cycle = Annotated[
    float | Literal["auto"], Meaning('a duration such as "57ms", or "auto"'), PlainValidator(_cycle)
]
Zone = Annotated[
    str, Meaning("an IANA time zone such as Europe/Berlin"), PlainValidator(_zone)
]  # fmt: skip
File = Annotated[Path, Meaning("the name of a file"), PlainValidator(_file)]
Files = Annotated[
    tuple[Path, ...],
    Meaning('the name of a file, or a list of names and patterns such as ["R1_*.parquet"]'),
    PlainValidator(_files),
]
Recordings = Annotated[
    tuple[Path, ...],
    Meaning('a name, or a list of names and patterns such as ["R1_*.parquet"]'),
    PlainValidator(_recordings),
]
Pairs = Annotated[dict[str, str], Meaning('a table such as { x = "X" }'), PlainValidator(_pairs)]

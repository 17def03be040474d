"""Kinds of values in a site file: what each looks like, and how it is read and checked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar.crs import bearing_of, looks_like_degrees, metric_crs
from gis_radar.errors import GisRadarError
from gis_radar.occupancy.cycles import AUTO, LONGEST_CYCLE_S, SHORTEST_CYCLE_S
from gis_radar.site.place import Place
from gis_radar.steps import duration_s, interval_steps, zone_of

Check = Callable[[Any, Place, str], Any]
_WILD = frozenset("*?[")
_NOT_IN_NAMES = frozenset('/\\:*?"<>|')


@dataclass(frozen=True)
class Kind:
    """A kind of value.

    Parameters
    ----------
    says : str
        What a value of it is, in a few words; for messages and for the reference.
    check : callable
        Takes a value, its place and its key; returns what the program works with, or raises the
        error of the place.
    """

    says: str
    check: Check

    def read(self, value: Any, place: Place, name: str) -> Any:
        """Return what a value of the file means.

        Raises
        ------
        InputError
            If it is not of this kind.
        """
        try:
            return self.check(value, place, name)
        except Unfit as unfit:
            wanted = unfit.wanted or self.says
            raise place.error(
                f"{name} is {_shown(value)}, expected {wanted}", hint=unfit.hint
            ) from None


class Unfit(Exception):  # noqa: N818 - becomes an error where the place is known
    """A value is not of its kind."""

    def __init__(self, wanted: str = "", *, hint: str = "", at: tuple[str | int, ...] = ()) -> None:
        super().__init__(wanted)
        self.wanted, self.hint, self.at = wanted, hint, at


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return "a table"
    return "true" if value is True else "false" if value is False else repr(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _text(value: Any, _place: Place, _name: str) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise Unfit
    return value


def _texts(value: Any, place: Place, name: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise Unfit
    return tuple(_text(each, place, name) for each in value)


def _sensor_name(value: Any, place: Place, name: str) -> str:
    text: str = _text(value, place, name)
    if text.startswith(".") or text != text.strip() or text[-1] == "." or _NOT_IN_NAMES & {*text}:
        raise Unfit('a name that a folder can have: without / \\ : * ? " < > | and no leading dot')
    return text


def _number(value: Any, _place: Place, _name: str, *, low: float, high: float) -> float:
    if not _is_number(value) or not low <= value <= high:
        raise Unfit
    return float(value)


def _numbers(value: Any, _place: Place, _name: str, *, counts: tuple[int, ...]) -> Any:
    fits = isinstance(value, list) and len(value) in counts and all(map(_is_number, value))
    if not fits:
        raise Unfit
    return tuple(map(float, value))


def _position(value: Any, place: Place, name: str) -> tuple[float, ...]:
    numbers: tuple[float, ...] = _numbers(value, place, name, counts=(2, 3))
    if looks_like_degrees(*numbers[:2]):
        raise Unfit(
            "metres of the map, not degrees",
            hint="easting and northing in the CRS of the map, e.g. [690356.0, 5336183.0]",
        )
    return numbers


def _span(value: Any, place: Place, name: str) -> tuple[float, float]:
    low, high = _numbers(value, place, name, counts=(2,))
    if not low < high:
        raise Unfit
    return low, high


def _choice(value: Any, _place: Place, _name: str, *, words: tuple[str, ...]) -> str:
    if value not in words:
        raise Unfit
    return str(value)


def _crs(value: Any, place: Place, name: str) -> str:
    text: str = _text(value, place, name)
    try:
        metric_crs(text, what=name)
    except GisRadarError as error:
        raise place.error(error.message, hint=error.hint) from error
    return text


def _bearing(value: Any, _place: Place, _name: str) -> float:
    try:
        return bearing_of(value)
    except ValueError:
        raise Unfit from None


def _interval(value: Any, place: Place, name: str) -> str:
    text: str = _text(value, place, name)
    try:
        interval_steps(text)
    except GisRadarError as error:
        raise Unfit(hint=error.message) from error
    return text.strip().lower()


def _cycle(value: Any, place: Place, name: str) -> float | str:
    text: str = _text(value, place, name)
    if text == AUTO:
        return text
    try:
        cycle_s = duration_s(text)
    except GisRadarError as error:
        raise Unfit(hint=error.message) from error
    if not SHORTEST_CYCLE_S <= cycle_s <= LONGEST_CYCLE_S:
        raise Unfit(f"{SHORTEST_CYCLE_S:g} to {LONGEST_CYCLE_S:g} s")
    return cycle_s


def _intervals(value: Any, place: Place, name: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise Unfit
    found = tuple(_interval(each, place, name) for each in value)
    lengths = [interval_steps(text) for text in found]
    if len(set(lengths)) < len(lengths):
        raise Unfit("lengths that differ from each other")
    return found


def _zone(value: Any, place: Place, name: str) -> str:
    text: str = _text(value, place, name)
    try:
        zone_of(text)
    except GisRadarError:
        raise Unfit from None
    return text


def _file(value: Any, place: Place, name: str) -> Path:
    path = place.path.parent / Path(_text(value, place, name)).expanduser()
    if not path.is_file():
        reason = "is a folder" if path.is_dir() else "no such file"
        raise place.error(
            f"{name}: {path}: {reason}", hint="paths are relative to the folder of the site file"
        )
    return path


def _pairs(value: Any, place: Place, name: str) -> dict[str, str]:
    if not isinstance(value, dict) or not value:
        raise Unfit
    return {key: _text(each, place, f"{name}.{key}") for key, each in value.items()}


def _file_or_folder(value: Any, place: Place, name: str) -> Path:
    path = place.path.parent / Path(_text(value, place, name)).expanduser()
    return path if path.is_dir() else _file(value, place, name)


def _files(value: Any, place: Place, name: str, *, folders: bool = False) -> tuple[Path, ...]:
    """Return the files of names and patterns, each once, those of a pattern by name."""
    one = _file_or_folder if folders else _file
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not patterns:
        raise Unfit
    found: dict[Path, None] = {}
    for pattern in patterns:
        text = _text(pattern, place, name)
        wild = _WILD & {*text}
        matches = _matches(text, place, name, folders) if wild else [one(text, place, name)]
        found.update(dict.fromkeys(matches))
    return tuple(found)


def _matches(pattern: str, place: Place, name: str, folders: bool) -> list[Path]:  # noqa: FBT001
    whole = Path(pattern).expanduser()
    root = Path(whole.anchor) if whole.is_absolute() else place.path.parent
    try:
        found = root.glob(str(whole.relative_to(whole.anchor)))
        matches = sorted(path for path in found if folders or path.is_file())
    except ValueError as error:
        raise Unfit(hint=str(error)) from error
    if not matches:
        raise place.error(
            f"{name}: no file matches {str(root.resolve() / pattern)!r}",
            hint="patterns are relative to the folder of the site file",
        )
    return matches


TEXT = Kind("text", _text)
TEXTS = Kind("a list of texts", _texts)
SENSOR_NAME = Kind("a name", _sensor_name)
POINT = Kind("[E, N], metres", partial(_numbers, counts=(2,)))
POSITION = Kind("[E, N] or [E, N, H], metres", _position)
SPAN = Kind("[LOW, HIGH], metres, ascending", _span)
CRS_NAME = Kind("a projected, metric CRS such as EPSG:25832", _crs)
BEARING = Kind("degrees or a word such as north-east", _bearing)
INTERVALS = Kind('a list of lengths such as ["15min", "1h"]', _intervals)
CYCLE = Kind('a duration such as "57ms", or "auto"', _cycle)
ZONE = Kind("an IANA time zone such as Europe/Berlin", _zone)
FILE = Kind("the name of a file", _file)
PAIRS = Kind('a table such as { x = "X" }', _pairs)
RECORDINGS = Kind(
    'a name, or a list of names and patterns such as ["R1_*.parquet"]',
    partial(_files, folders=True),
)
FILES = Kind('the name of a file, or a list of names and patterns such as ["R1_*.parquet"]', _files)


def number(says: str, low: float = -math.inf, high: float = math.inf) -> Kind:
    """Return the kind of numbers from `low` to `high`; `says` names the unit."""
    return Kind(says, partial(_number, low=low, high=high))


def choice(*words: str) -> Kind:
    """Return the kind of one of these words."""
    return Kind(f"one of {', '.join(words)}", partial(_choice, words=words))

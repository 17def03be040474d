"""Refuse arguments of a wrong kind where they are given: by the annotations of what takes them."""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields
from functools import cache, update_wrapper
from numbers import Integral, Real
from types import FunctionType, NoneType
from typing import Any, ParamSpec, TypeVar

import numpy as np

from gis_radar.base.arrays import Floats
from gis_radar.base.errors import GisRadarError, InputError, UsageError
from gis_radar.base.texts import Text

Params = ParamSpec("Params")
Result = TypeVar("Result")
Class = TypeVar("Class", bound=type)

# Words of messages for the types of annotations; a type that is not listed is not checked.
_WORDS = {
    "str": Text("a text"),
    "Path": Text("a path"),
    "float": Text("a number"),
    "int": Text("a whole number"),
    "bool": "True, False",
    "None": "None",
    "Mapping": "dict",
    "Floats": "array",
    "GeoDataFrame": "GeoDataFrame",
    "Pose": Text("a pose (read_pose)"),
    "PoseTrack": Text("a pose track (read_track)"),
    "View": "View",
    "Filters": "Filters",
    "MapLabels": "MapLabels",
    "MaskSettings": "MaskSettings",
    "LaneletMap": Text("a map (read_map)"),
    "Roads": "Roads",
    "Recording": Text("a recording (open_recording)"),
    "Dataset": Text("a dataset (open_dataset)"),
    "City": Text("a city (open_city)"),
    "SightTiles": "SightTiles",
}
_TYPES: dict[str, Any] = {
    "str": str, "Path": str | os.PathLike, "int": Integral, "Floats": np.ndarray,
    "None": NoneType, "Mapping": Mapping,
}  # fmt: skip
_LISTS = {"Sequence", "Collection", "tuple"}
_MOST_SHOWN = 60  # characters of a value in a message


def checked(
    function: Callable[Params, Result], public: str | None = None
) -> Callable[Params, Result]:
    """Return a function that refuses arguments which its annotations do not take.

    Parameters
    ----------
    function : callable
        Its annotations are texts (`from __future__ import annotations`).
    public : str, optional
        The package that offers it under its name; other processes find it there. By default its
        module.
    """
    signature = inspect.signature(function)

    def call(*args: Params.args, **options: Params.kwargs) -> Result:
        try:
            given = signature.bind(*args, **options).arguments
        except TypeError:  # too few or too many: Python itself states which
            return function(*args, **options)
        for name, value in given.items():
            parameter = signature.parameters[name]
            if parameter.annotation is not parameter.empty and value is not parameter.default:
                require_kind(f"{function.__name__}: {name}", value, parameter.annotation)
        return function(*args, **options)

    update_wrapper(call, function)
    call.__module__ = public or function.__module__
    return call


def checked_methods(of: Class) -> Class:
    """Let the public methods of a class refuse arguments as :func:`checked` does."""
    for name, method in list(vars(of).items()):
        if isinstance(method, FunctionType) and not name.startswith("_"):
            setattr(of, name, checked(method))
    return of


def require_kinds(record: Any, error: type[GisRadarError] = InputError, *, what: str = "") -> None:
    """Refuse fields of a dataclass that are not as annotated; `what` names it, or its class.

    Raises
    ------
    GisRadarError
        Of the class given; it states what was given and what is wanted.
    """
    for field_ in fields(record):
        value = getattr(record, field_.name)
        if value is not field_.default:
            field = Text("{}: {}", what or type(record).__name__, field_.name)
            require_kind(field, value, str(field_.type), error)


def require_kind(
    what: str, value: Any, annotation: str, error: type[GisRadarError] = UsageError
) -> None:
    """Refuse a value that an annotation does not take.

    Raises
    ------
    GisRadarError
        Of the class given; it states what was given and what is wanted.
    """
    kinds = _kinds(annotation)
    if any(_is_of(value, *kind) for kind in kinds):
        return
    raise error("{} is {}, expected {}", what, _shown(value), _in_words(kinds))


def as_points(points: Any) -> Floats:
    """Return points as an (n, 3) float64 array.

    Raises
    ------
    UsageError
        If they are none.
    """
    try:
        found = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.ndim != 2 or found.shape[1] != 3:
        raise UsageError("points are {}, expected an array of n rows: x, y, z", _shown(points))
    return found


@cache
def _kinds(annotation: str) -> tuple[tuple[str, str], ...]:
    """Return the alternatives of an annotation: the name of a type, and what its brackets hold."""
    found = re.findall(r"([\w.]+)(?:\[((?:[^\[\]]|\[[^\]]*\])*)\])?", annotation)
    names = [(name.rpartition(".")[2], inner) for name, inner in found if name != "..."]
    return tuple(each for each in names if each != ("str", "") or ("Path", "") not in names)


def _is_of(value: Any, name: str, inner: str) -> bool:
    """Return whether a value is of the type `name`, a list with elements of the types `inner`."""
    if name in _LISTS:
        kinds = _kinds(inner)
        if not _is_list(value) or (
            name == "tuple" and "..." not in inner and len(value) != len(kinds)
        ):
            return False
        return all(any(_is_of(each, *kind) for kind in kinds) for each in value)
    is_bool = type(value).__name__ in {"bool", "bool_"}  # Python's and NumPy's
    if name in {"bool", "float", "int"} and is_bool:
        return name == "bool"
    if name == "float":
        return isinstance(value, Real) and math.isfinite(value)
    if name in _TYPES:
        return isinstance(value, _TYPES[name])
    return name not in _WORDS or any(each.__name__ == name for each in type(value).__mro__)


def _is_list(value: Any) -> bool:
    # a table is a list of the names of its columns; an iterator can be looked at once only
    no_list = isinstance(value, str | bytes | Mapping | Iterator) or hasattr(value, "columns")
    return isinstance(value, Iterable) and not no_list


def _in_words(kinds: Iterable[tuple[str, str]]) -> Text:
    words = (
        Text("a list ({})", _in_words(_kinds(inner))) if name in _LISTS else _WORDS.get(name, name)
        for name, inner in kinds
    )
    return Text(" or ").join(dict.fromkeys(words))


def _shown(value: Any) -> str:
    """Return a value as it was given, or its type where that is no short line."""
    shown = repr(value)
    if len(shown) <= _MOST_SHOWN and len(shown.splitlines()) <= 1:
        return shown
    return f"{type(value).__module__.partition('.')[0]}.{type(value).__name__}"

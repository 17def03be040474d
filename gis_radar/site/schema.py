"""The schema of a site file: dataclasses whose fields say what a key is, and their reader."""

from __future__ import annotations

import difflib
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import partial
from typing import Any, TypeVar

from gis_radar.errors import GisRadarError
from gis_radar.site.kinds import Kind, Unfit
from gis_radar.site.place import Place

Table = TypeVar("Table")


def key(
    kind: Kind, meaning: str, *, example: str, default: Any = MISSING, shown: str | None = None
) -> Any:
    """Declare a field of a table as a key of the site file.

    Parameters
    ----------
    kind : Kind
        What values it takes.
    meaning : str
        What it is, in a line; units too.
    example : str
        A value as TOML, for the template.
    default : object
        What holds without it; a key without a default is required.
    shown : str, optional
        The default in words; by default the value itself.
    """
    metadata = {"kind": kind, "meaning": meaning, "example": example, "shown": shown}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class TableKind(Kind):
    """The kind of a table, or of a list of tables.

    Parameters
    ----------
    table : type
        The dataclass of its keys.
    repeated : bool
        Whether there may be several: `[[name]]`.
    """

    table: Any = None
    repeated: bool = False


def table(kind: Any, meaning: str, *, required: bool = False) -> Any:
    """Declare a field as a table of the site file; without it, its defaults hold."""
    return field(
        **({} if required else {"default_factory": kind}),
        metadata={"kind": TableKind("a table", partial(_table, kind), kind), "meaning": meaning},
    )


def optional_table(kind: Any, meaning: str) -> Any:
    """Declare a field as a table that may be missing: None then."""
    return field(
        default=None,
        metadata={"kind": TableKind("a table", partial(_table, kind), kind), "meaning": meaning},
    )


def tables(kind: Any, meaning: str) -> Any:
    """Declare a field as a list of tables, at least one."""
    check = partial(_tables, kind)
    return field(metadata={"kind": TableKind("[[...]]", check, kind, True), "meaning": meaning})


def keys_of(kind: Any) -> dict[str, Field[Any]]:
    """Return the keys of a table in the order in which they are declared."""
    return {each.name: each for each in fields(kind) if "kind" in each.metadata}


def is_required(each: Field[Any]) -> bool:
    """Tell whether a key has no default."""
    return each.default is MISSING and each.default_factory is MISSING


def read_table(kind: type[Table], raw: dict[str, Any], place: Place) -> Table:
    """Read a table of a site file.

    Raises
    ------
    InputError
        If a key is unknown, missing, or its value is not of its kind.
    """
    known = keys_of(kind)
    for name in raw:
        if name not in known:
            raise _unknown(name, known, place)
    values = {}
    for name, each in known.items():
        if name in raw:
            values[name] = each.metadata["kind"].read(raw[name], place.at(name), name)
        elif is_required(each):
            example = each.metadata.get("example")
            hint = f"e.g. {name} = {example}" if example else each.metadata["meaning"]
            raise place.error(f"lacks {name}", hint=hint)
    try:
        return kind(**values)
    except Unfit as unfit:
        raise place.at(*unfit.at).error(unfit.wanted, hint=unfit.hint) from None
    except GisRadarError as error:
        raise place.error(error.message, hint=error.hint) from error


def _unknown(name: str, known: dict[str, Field[Any]], place: Place) -> GisRadarError:
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.6)
    where = "" if place.steps else "the site file: "
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    return place.at(name).error(f"{where}{name!r} is no key of it", hint=hint)


def _table(kind: Any, value: Any, place: Place, name: str) -> Any:
    if not isinstance(value, dict):
        raise Unfit(f"a table: [{name}]")
    called = f"{place.called}: [{name}]" if place.called else f"[{name}]"
    return read_table(kind, value, place.at(called=called))


def _tables(kind: Any, value: Any, place: Place, name: str) -> tuple[Any, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
        raise Unfit(f"one or more tables: [[{name}]]")
    found = []
    for number, each in enumerate(value):
        given = each.get("name")
        called = f"{name} {given}" if isinstance(given, str) else f"{name} number {number + 1}"
        found.append(read_table(kind, each, place.at(number, called=called)))
    return tuple(found)

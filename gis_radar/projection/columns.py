"""Columns of the points: ours, then the recording's further ones under names that do not clash."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import pyarrow as pa

SUFFIX = "_recorded"
GEOMETRY = "geometry"
OWN = pa.schema(
    [
        ("sensor", pa.string()),
        ("time", pa.float64()),
        ("utc", pa.timestamp("us", tz="UTC")),
        ("x", pa.float32()),
        ("y", pa.float32()),
        ("z", pa.float32()),
        ("range_rate", pa.float32()),
        ("rcs", pa.float32()),
    ]
)
# GeoPackages have columns of these names themselves, and know no upper and lower case.
TAKEN = (*OWN.names, GEOMETRY, "geom", "fid")


def distinct_names(
    names: Iterable[str], taken: Collection[str], *, longest: int | None = None
) -> dict[str, str]:
    """Give each name one that differs from all others by more than upper and lower case.

    Parameters
    ----------
    names : iterable of str
        Names to keep where possible.
    taken : collection of str
        Names that others have already.
    longest : int, optional
        The most bytes a name may have in UTF-8.

    Returns
    -------
    dict
        From each name to its new one, in the same order.
    """
    used = {name.lower() for name in taken}
    given: dict[str, str] = {}
    for name in names:
        endings = ("", SUFFIX, *(f"{SUFFIX}_{number}" for number in range(2, len(used) + 3)))
        fresh = next(
            fitting
            for ending in endings
            if (fitting := _fitting(name or "unnamed", ending, longest)).lower() not in used
        )
        used.add(fresh.lower())
        given[name] = fresh
    return given


def _fitting(name: str, ending: str, longest: int | None) -> str:
    if longest is None:
        return name + ending
    room = longest - len(ending.encode())
    return name.encode()[:room].decode(errors="ignore") + ending


def renamed(names: dict[str, str]) -> list[str]:
    """Say which names changed, one text a name."""
    return [f"{name!r} to {fresh!r}" for name, fresh in names.items() if name != fresh]


def points_schema(further: pa.Schema, names: dict[str, str]) -> pa.Schema:
    """Return the schema of all batches of points.

    Parameters
    ----------
    further : pyarrow.Schema
        The recording's further columns.
    names : dict
        What they are called here.
    """
    kept = [pa.field(names[field.name], _plain(field.type)) for field in further]
    return pa.schema([*OWN, *kept, pa.field(GEOMETRY, pa.binary())])


def _plain(kind: pa.DataType) -> pa.DataType:
    """Return the type of a column's values, without how they are stored."""
    if pa.types.is_dictionary(kind):
        return _plain(kind.value_type)
    if pa.types.is_null(kind):
        return pa.string()
    return kind

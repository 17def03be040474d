"""Streets: names of lanes from a layer of the city's."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.arrays import Floats
from gis_radar.errors import CrsError, InputError
from gis_radar.lanelets.tagging import STREET
from gis_radar.progress import Reporter
from gis_radar.vector_files import read_vector

NAME_FIELDS = (
    "name", "street", "street_name", "road_name", "strassenname", "straßenname", "str_name",
    "strname", "strasse", "straße", "bezeichnung", "nom_voie", "naam", "straatnaam",
)  # fmt: skip
NEAR_M = 20.0  # from the middle of a street to its outermost lane: six lanes and a tram
PARALLEL_RAD = math.radians(30.0)
SAMPLE_M = 5.0  # of lanes, to ask which street is there
APART_M = 250.0  # between pieces of a street, beyond which one name is of two streets


def name_streets(
    lanes: gpd.GeoDataFrame,
    streets: gpd.GeoDataFrame | str | Path | None,
    field: str | None,
    reporter: Reporter,
) -> gpd.GeoDataFrame:
    """Return lanes with the names of streets where the map has none.

    A lane takes the name of the street that is nearest and parallel along most of it.

    Parameters
    ----------
    lanes : GeoDataFrame
        With `street`, lines as geometry, metres.
    streets : GeoDataFrame, str or Path, optional
        Lines of streets.
    field : str, optional
        Their column of names.
    reporter : Reporter
        Receives what a user should know.

    Raises
    ------
    InputError
        If the streets cannot be read, or have no column of that name.
    CrsError
        If they state no coordinate system.
    """
    if streets is None:
        return lanes
    what = str(streets) if isinstance(streets, str | Path) else "streets"
    table = _read(streets, what)
    name = _field_of(table, field, what)
    if name is None:
        usual = ", ".join(NAME_FIELDS[:4])
        reporter.log(
            f"{what}: no column of names ({usual}, ...); lanes stay without names of streets",
            "warning",
        )
        return lanes
    named = {STREET: table[name].to_numpy()}
    known = gpd.GeoDataFrame(named, geometry=table.geometry.array).explode(ignore_index=True)
    texts = known[STREET].map(lambda value: str(value).strip() if isinstance(value, str) else "")
    known = known.assign(**{STREET: texts})
    known = known[(known[STREET] != "") & (known.geometry.geom_type == "LineString")]
    known = _moved(known, lanes.crs, what)
    names = [_name_along(line, known) for line in lanes.geometry]
    found = [tag or name for tag, name in zip(lanes[STREET], names, strict=True)]
    _warn(lanes.assign(**{STREET: found}), known, what, reporter)
    return lanes.assign(**{STREET: found})


def _read(streets: gpd.GeoDataFrame | str | Path, what: str) -> gpd.GeoDataFrame:
    """Return the layer of streets; refuse what is none, or states no coordinate system."""
    table: Any = streets
    if isinstance(streets, str | Path):
        table = read_vector(streets, what="layer of streets", columns=None)
    kinds = set(table.geom_type.dropna()) if isinstance(table, gpd.GeoDataFrame) else set()
    if not kinds & {"LineString", "MultiLineString"}:
        has = ", ".join(sorted(kinds)) or "no geometry"
        raise InputError(f"{what}: streets are lines, the layer has {has}")
    if table.crs is None:
        raise CrsError(
            f"{what}: states no coordinate system", hint="save the layer with its CRS in QGIS"
        )
    return table


def _field_of(table: gpd.GeoDataFrame, field: str | None, what: str) -> str | None:
    """Return the column of names: the one that is asked for, else the first of the usual ones."""
    texts = [str(name) for name in table.columns if name != table.geometry.name]
    if field is not None and field not in texts:
        listed = ", ".join(texts) or "none"
        raise InputError(f"{what}: has no column {field!r}", hint=f"its columns: {listed}")
    usual = {name.casefold(): name for name in reversed(texts)}
    return field or next((usual[name] for name in NAME_FIELDS if name in usual), None)


def _moved(table: gpd.GeoDataFrame, crs: Any, what: str) -> gpd.GeoDataFrame:
    moved = table.to_crs(crs)
    if len(moved) and not np.isfinite(moved.total_bounds).all():
        raise CrsError(f"{what}: lies outside the area of the map's coordinate system")
    return moved.reset_index(drop=True)


def _name_along(lane: shapely.LineString, streets: gpd.GeoDataFrame) -> str | None:
    """Return the name of the street that is nearest and parallel along most of a lane."""
    count = max(round(lane.length / SAMPLE_M), 1) + 1
    at = np.linspace(0.0, lane.length, count)
    points, way = _on(lane, at)
    asked, street = streets.sindex.query(
        shapely.points(points), predicate="dwithin", distance=NEAR_M
    )
    lines = streets.geometry.array[street]
    near = shapely.distance(lines, shapely.points(points[asked]))
    heading = np.array(
        [
            _on(line, np.array([line.project(shapely.Point(points[k]))]))[1][0]
            for line, k in zip(lines, asked, strict=True)
        ]
    )
    parallel = np.abs(np.sin(heading - way[asked])) < math.sin(PARALLEL_RAD)
    votes = Counter[str]()
    for k in np.unique(asked[parallel]):
        mine = np.flatnonzero(parallel & (asked == k))
        votes[streets[STREET].iat[street[mine[near[mine].argmin()]]]] += 1
    if not votes:
        return None
    name, most = votes.most_common(1)[0]
    return name if 2 * most >= count else None


def _on(line: shapely.LineString, at: Floats) -> tuple[Floats, Floats]:
    """Return points of a line and its direction there, radians."""
    behind, ahead = (
        shapely.get_coordinates(
            shapely.line_interpolate_point(line, np.clip(at + off, 0.0, line.length))
        )
        for off in (-0.5, 0.5)
    )
    way = ahead - behind
    points = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
    return points, np.arctan2(way[:, 1], way[:, 0])


def _warn(
    lanes: gpd.GeoDataFrame, streets: gpd.GeoDataFrame, what: str, reporter: Reporter
) -> None:
    """Report lanes without a name, and names that two streets have."""
    bare = int(lanes[STREET].isna().sum())
    if bare:
        reporter.log(
            f"{what}: {bare} of {len(lanes)} lanes run along none of its streets with a name and "
            "stay without",
            "warning" if bare == len(lanes) else "info",
        )
    for name, lines in streets[streets[STREET].isin(set(lanes[STREET]))].groupby(STREET):
        around = shapely.union_all(shapely.buffer(lines.geometry.array, APART_M / 2.0))
        pieces = [part for part in shapely.get_parts(around) if lanes.intersects(part).any()]
        if len(pieces) > 1:
            reporter.log(
                f"{what}: {len(pieces)} streets are called {name}; their lanes differ by number",
                "warning",
            )

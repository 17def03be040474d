"""Names of streets for lanes, from a layer of streets such as a city has."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import scipy
import shapely

from gis_radar.base import (
    CrsError,
    Floats,
    InputError,
    Reporter,
    Text,
    one_line,
    read_vector,
    wind_of,
)
from gis_radar.hdmap.tagging import STREET

_NAME_FIELDS = (
    "name", "street", "street_name", "road_name", "strassenname", "straßenname", "str_name",
    "strname", "strasse", "straße", "bezeichnung", "nom_voie", "naam", "straatnaam",
)  # fmt: skip
_PART = "street_part"  # column: of several streets with one name, the one that a lane is on
_NEAR_M = 20.0  # from the middle of a street to its outermost lane: six lanes and a tram
_PARALLEL_RAD = math.radians(30.0)  # between directions of a lane and of its street
_SAMPLE_M = 5.0  # between the points of a lane at which the street is looked up
_APART_M = 250.0  # between lines of one name, beyond which they are different streets


def name_streets(
    lanes: gpd.GeoDataFrame,
    streets: gpd.GeoDataFrame | str | Path | None,
    field: str | None,
    reporter: Reporter,
) -> gpd.GeoDataFrame:
    """Return lanes with names of streets where the map has none, and with `street_part`.

    A lane takes the name of the street that is nearest and parallel along most of it. Where streets
    far apart have one name, `street_part` is the place of the lane's street among them.

    Parameters
    ----------
    lanes : GeoDataFrame
        Lanes with the column `street`; lines in metres.
    streets : GeoDataFrame, str or Path, optional
        Lines of streets.
    field : str, optional
        Column of their names.
    reporter : Reporter
        Receives remarks on lanes without a name and streets of one name.

    Raises
    ------
    InputError
        If the streets cannot be read, or have no column of that name.
    CrsError
        If they state no coordinate system.
    """
    named, known, prefix = lanes.copy(), _no_streets(lanes.crs), ""
    if streets is not None:
        what = str(streets) if isinstance(streets, str | Path) else "streets"
        prefix = f"{what}: "
        known = _known_streets(streets, field, lanes.crs, what, reporter)
    if len(known):
        names = [_name_along(line, known) for line in lanes.geometry]
        named[STREET] = [tag or name for tag, name in zip(lanes[STREET], names, strict=True)]
        _report_unnamed(named, prefix, reporter)
    place = list(named.columns).index(STREET) + 1
    named.insert(place, _PART, _street_parts(named, known, prefix, reporter))
    return named


def _known_streets(
    streets: gpd.GeoDataFrame | str | Path, field: str | None, crs: Any, what: str,
    reporter: Reporter,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the lines that have a name, in the CRS of the lanes."""
    table = _read(streets, what)
    name = _field_of(table, field, what)
    if name is None:
        usual = ", ".join(_NAME_FIELDS[:4])
        reporter.warn(
            "{}: no column of names ({}, ...); lanes stay without names of streets",
            what,
            usual,
        )
        return _no_streets(crs)
    named = {STREET: table[name].to_numpy()}
    known = gpd.GeoDataFrame(named, geometry=table.geometry.array).explode(ignore_index=True)
    texts = known[STREET].map(lambda value: one_line(value) if isinstance(value, str) else "")
    known = known.assign(**{STREET: texts})
    known = known[(known[STREET] != "") & (known.geometry.geom_type == "LineString")]
    if known.empty:
        reporter.warn(
            "{}: its column {} holds no text beside a line; lanes stay without names of streets",
            what,
            repr(name),
        )
    return _reprojected(known, crs, what)


def _no_streets(crs: Any) -> gpd.GeoDataFrame:
    return gpd.GeoDataFrame({STREET: np.empty(0, object)}, geometry=[], crs=crs)


def _read(streets: gpd.GeoDataFrame | str | Path, what: str) -> gpd.GeoDataFrame:
    """Return the layer of streets; refuse one without lines or without a coordinate system."""
    table: Any = streets
    if isinstance(streets, str | Path):
        table = read_vector(streets, what="layer of streets", columns=None)
    kinds = set(table.geom_type.dropna()) if isinstance(table, gpd.GeoDataFrame) else set()
    if not kinds & {"LineString", "MultiLineString"}:
        has = ", ".join(sorted(kinds)) or Text("no geometry")
        raise InputError("{}: streets are lines, the layer has {}", what, has)
    if table.crs is None:
        raise CrsError(
            "{}: states no coordinate system", what, hint="save the layer with its CRS in QGIS"
        )
    return table


def _field_of(table: gpd.GeoDataFrame, field: str | None, what: str) -> str | None:
    """Return the column of names: `field` if given, else the first of the usual ones, or None."""
    texts = [str(name) for name in table.columns if name != table.geometry.name]
    if field is not None and field not in texts:
        listed = ", ".join(texts) or "none"
        raise InputError(
            "{}: has no column {}", what, repr(field), hint=Text("its columns: {}", listed)
        )
    usual = {name.casefold(): name for name in reversed(texts)}
    return field or next((usual[name] for name in _NAME_FIELDS if name in usual), None)


def _reprojected(table: gpd.GeoDataFrame, crs: Any, what: str) -> gpd.GeoDataFrame:
    reprojected = table.to_crs(crs)
    if len(reprojected) and not np.isfinite(reprojected.total_bounds).all():
        raise CrsError("{}: lies outside the area of the map's coordinate system", what)
    return reprojected.reset_index(drop=True)


def _name_along(lane: shapely.LineString, streets: gpd.GeoDataFrame) -> str | None:
    """Return the name of the street that is nearest and parallel along most of a lane."""
    count = max(round(lane.length / _SAMPLE_M), 1) + 1
    at = np.linspace(0.0, lane.length, count)
    points, heading_of_lane = _points_and_headings(lane, at)
    sample, street = streets.sindex.query(
        shapely.points(points), predicate="dwithin", distance=_NEAR_M
    )
    lines = streets.geometry.array[street]
    near = shapely.distance(lines, shapely.points(points[sample]))
    heading = np.array(
        [
            _points_and_headings(line, np.array([line.project(shapely.Point(points[k]))]))[1][0]
            for line, k in zip(lines, sample, strict=True)
        ]
    )
    parallel = np.abs(np.sin(heading - heading_of_lane[sample])) < math.sin(_PARALLEL_RAD)
    votes = Counter[str]()
    for k in np.unique(sample[parallel]):
        of_sample = np.flatnonzero(parallel & (sample == k))
        votes[streets[STREET].iat[street[of_sample[near[of_sample].argmin()]]]] += 1
    if not votes:
        return None
    name, most = votes.most_common(1)[0]
    return name if 2 * most >= count else None


def _points_and_headings(line: shapely.LineString, at: Floats) -> tuple[Floats, Floats]:
    """Return the points at distances `at` (m) along a line, and its directions there, radians."""
    behind, ahead = (
        shapely.get_coordinates(
            shapely.line_interpolate_point(line, np.clip(at + off, 0.0, line.length))
        )
        for off in (-0.5, 0.5)
    )
    step = ahead - behind
    points = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
    return points, np.arctan2(step[:, 1], step[:, 0])


def _report_unnamed(lanes: gpd.GeoDataFrame, prefix: str, reporter: Reporter) -> None:
    """Report the number of lanes without a name."""
    unnamed = int(lanes[STREET].isna().sum())
    if unnamed:
        reporter.log(
            Text(
                "{}{} of {} lanes run along none of its streets with a name and stay without",
                prefix,
                unnamed,
                len(lanes),
            ),
            "warning" if unnamed == len(lanes) else "info",
        )


def _street_parts(
    lanes: gpd.GeoDataFrame, streets: gpd.GeoDataFrame, prefix: str, reporter: Reporter
) -> list[str | None]:
    """Return `street_part` of each lane, None where one street has its name; warn of each name."""
    parts = np.full(len(lanes), None, object)
    names = lanes[STREET].to_numpy(object)
    for name in sorted({each for each in names if isinstance(each, str)}):
        of_name = np.flatnonzero(names == name)
        drawn = streets.geometry.array[np.flatnonzero(streets[STREET] == name)]
        street_of_line = _street_numbers([*lanes.geometry.array[of_name], *drawn])[: len(of_name)]
        if len(set(street_of_line)) > 1:
            words = _part_words(lanes.geometry.array[of_name], street_of_line)
            parts[of_name] = [words[number] for number in street_of_line]
            reporter.warn(
                "{}{} streets are called {}; their lanes differ by number",
                prefix,
                len(words),
                name,
            )
    return parts.tolist()


def _street_numbers(lines: list[shapely.LineString]) -> list[int]:
    """Return the number of each line's street: lines nearer than `_APART_M` are of one street."""
    near = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=_APART_M)
    links = scipy.sparse.coo_array((np.ones(near.shape[1]), near), shape=(len(lines), len(lines)))
    return list(scipy.sparse.csgraph.connected_components(links, directed=False)[1].tolist())


def _part_words(lanes: Any, street_of_lane: list[int]) -> dict[int, str]:
    """Return `street_part` by number of the street: the wind of its place, or 1, 2, ..."""
    known = sorted(set(street_of_lane))
    middles = shapely.get_coordinates(
        [shapely.union_all(lanes[np.equal(street_of_lane, each)]).centroid for each in known]
    )
    from_mean = middles - middles.mean(axis=0)
    words = [wind_of(*each) for each in from_mean]
    in_middle = np.hypot(*from_mean.T).min() < _APART_M / 4.0  # a street without a clear direction
    if len(set(words)) < len(known) or in_middle:
        words = [str(number) for number in range(1, len(known) + 1)]
    return dict(zip(known, words, strict=True))

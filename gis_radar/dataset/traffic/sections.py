"""Count sections: volumes by direction at lines drawn across a road."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
import shapely.ops

from gis_radar.base import (
    QUIET,
    Floats,
    InputError,
    Reporter,
    in_language,
    interval_steps,
    metric_crs,
    one_line,
    read_vector,
)
from gis_radar.dataset.days.lane_measures import LaneTraffic
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER
from gis_radar.dataset.files.frame_times import recorded_span
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.traffic.reader import TrafficReader
from gis_radar.hdmap import LANE_COLUMN, LANES_LAYER, TILES_LAYER
from gis_radar.measures import LaneNetwork, bound_name, place_on

_NAME_FIELDS = ("name", "section", "id")  # columns that may hold a section's name, in this order
ALONG = math.sin(math.radians(30.0))  # sine of the angle below which a section runs along a lane
_HALF_LANE_M = 1.75  # half of the usual width of a lane
_SAME_M = 0.01  # distance below which two places are one
_SNAPPED_M = 0.25  # a section that ends so near to the edge of a lane ends there, not inside
_FIGURES = ["visible_share", "counted", "volume", "volume_se", "heavy", "speed_time_mean_kmh"]


@dataclass(frozen=True)
class _Crossing:
    """Crossing of a section and a lane.

    Parameters
    ----------
    lane : int
        Number of the lane.
    along_m : float
        Place along the lane, metres.
    direction : (2,) array
        Unit vector of the lane's direction there.
    is_left : bool
        Whether traffic comes from the left of the section, seen from its first point.
    at_m : float
        Place along the section, metres.
    """

    lane: int
    along_m: float
    direction: Floats
    is_left: bool
    at_m: float


def count_sections(
    dataset: DatasetFiles, sections: gpd.GeoDataFrame | str | Path, interval: str = "15min", *,
    begin: Moment = None, end: Moment = None, language: str | None = None,
    reporter: Reporter = QUIET,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Count vehicles by direction at sections: lines across a road.

    Parameters
    ----------
    sections : GeoDataFrame, str or Path
        Lines in a projected coordinate system, with their names in a column `name`, `section`
        or `id`; without one they are numbered from 1.
    interval, begin, end, language
        As for :meth:`traffic`.
    reporter : Reporter
        Receives a warning about each section that ends inside a lane.

    Returns
    -------
    GeoDataFrame
        A row for each section, direction and interval: `section`, `direction` (`northbound`),
        `begin`, `end`, `visible_share` (of the least visible lane), `counted`, `volume`,
        `volume_se`, `volume_veh_h`, `heavy`, `speed_time_mean_kmh`; the part of the section's
        line on the lanes of the direction. Null where one of the lanes is not visible.

    Raises
    ------
    InputError
        If a section crosses no lane, one lane twice, or runs along one; if two have one name;
        if the dataset has no vehicles, nothing was measured from begin to end, or there are no
        exact tables of that time any more.
    CrsError
        If the sections state no projected coordinate system.
    """
    lines, what = _lines(sections, dataset.crs)
    require_vehicles(dataset)
    steps = min(interval_steps(interval), STEPS_PER_QUARTER)
    span = recorded_span(dataset, begin, end, steps)
    layer, network = dataset.layer(LANES_LAYER), LaneTraffic.of(dataset).network
    crossed = {
        name: _crossings(line, layer, network, f"{what}: section {name}")
        for name, line in lines.items()
    }
    _warn_of_ends(lines, crossed, dataset.layer(TILES_LAYER), reporter)
    by_section = dict[str, list[pd.DataFrame]]()
    for counted in _groups_with_distinct_lanes(crossed):
        along = {each.lane: each.along_m for name in counted for each in crossed[name]}
        rows = TrafficReader(
            dataset=dataset, interval=interval, span=span, language=language, line_m=along
        ).lanes()
        with in_language(language):
            by_section |= {
                name: _by_direction(rows, lines[name], crossed[name]) for name in counted
            }
    table = pd.concat(
        [part.assign(section=name) for name in lines for part in by_section[name]],
        ignore_index=True,
    )
    first = ["section", "direction", "begin", "end"]
    return gpd.GeoDataFrame(
        table[[*first, *(name for name in table if name not in first)]], crs=dataset.crs
    )


def _lines(
    sections: gpd.GeoDataFrame | str | Path, crs: Any
) -> tuple[dict[str, shapely.LineString], str]:
    """Return the sections by name, in the dataset's CRS, and a name of their layer for errors."""
    what: str = "sections"
    table: Any = sections
    if isinstance(sections, str | Path):
        what = str(sections)
        table = read_vector(
            sections, what="layer of count sections", choose=_only_lines, columns=None
        )
    metric_crs(table.crs, what=what)
    corners = shapely.get_coordinates(table.geometry)
    if table.geometry.isna().any() or not np.isfinite(corners).all():
        raise InputError("{}: a section has no line", what)
    table = table.to_crs(crs).reset_index(drop=True)
    lines = shapely.line_merge(np.asarray(table.geometry))  # QGIS stores lines as multi-lines
    if table.empty or {line.geom_type for line in lines} != {"LineString"}:
        raise InputError(
            "{}: sections are lines across a road", what, hint="each of one part, a row each"
        )
    columns = {str(name).lower(): name for name in reversed(table.columns)}
    column = next((columns[name] for name in _NAME_FIELDS if name in columns), None)
    names = pd.Series(range(1, len(table) + 1)).astype("string")
    if column is not None:  # a column of ids with an empty value is read as float
        given = table[column].convert_dtypes().astype("string").map(one_line, na_action="ignore")
        names = given.astype("string").replace("", pd.NA).fillna(names)  # all empty: of no type
    by_name = dict(zip(names, lines, strict=True))
    if len(by_name) < len(table):
        raise InputError("{}: two sections have one name", what)
    return by_name, what


def _only_lines(layers: Mapping[str, str], path: Path) -> str:
    """Return the layer of lines, else the first; refuse several of lines."""
    drawn = [name for name, kind in layers.items() if "LineString" in kind]
    if len(drawn) > 1:
        raise InputError(
            "{}: has {} layers of lines: {}", path, len(drawn), ", ".join(drawn),
            hint="save the sections as a file of their own",
        )  # fmt: skip
    return next(iter(drawn or layers))


def _crossings(
    line: shapely.LineString, lanes: gpd.GeoDataFrame, network: LaneNetwork, what: str
) -> list[_Crossing]:
    crossings, ends = [], []
    known = lanes.set_index("lane").geometry
    for number, length_m in zip(network.lane.tolist(), network.length_m.tolist(), strict=True):
        lane = known[number]
        points = shapely.get_coordinates(line.intersection(lane))[:, :2]
        if len(points) == 0:
            continue
        if len(points) > 1:
            raise InputError("{} crosses lane {} more than once", what, number)
        along = float(lane.project(shapely.Point(points[0])))
        direction = place_on(lane, along)[1]
        at_m = float(line.project(shapely.Point(points[0])))
        across = place_on(line, at_m)[1]
        sine = float(across[0] * direction[1] - across[1] * direction[0])  # sine of the angle
        if abs(sine) < ALONG:
            raise InputError("{} runs along lane {}", what, number, hint="draw it across the road")
        along_m = along / lane.length * length_m
        crossings.append(_Crossing(number, along_m, direction, is_left=sine < 0.0, at_m=at_m))
        if lane.length - along < _SAME_M:
            ends.append(lane.coords[-1][:2])
    if not crossings:
        raise InputError("{} crosses no lane", what, hint="draw it across a road of the map")
    # drawn through the end of a lane, as by snapping, it crosses the next ones at their begin
    return [
        each for each in crossings
        if each.along_m >= _SAME_M
        or all(math.dist(known[each.lane].coords[0][:2], end) >= _SAME_M for end in ends)
    ]  # fmt: skip


def _warn_of_ends(
    lines: Mapping[str, shapely.LineString], crossed: Mapping[str, Sequence[_Crossing]],
    tiles: gpd.GeoDataFrame, reporter: Reporter,
) -> None:  # fmt: skip
    """Warn of sections that end inside a lane before its middle: nobody is counted there."""
    for name, line in lines.items() if LANE_COLUMN in tiles else ():
        touched = set(tiles.loc[tiles.intersects(line.boundary), LANE_COLUMN])
        for lane in sorted(touched - {each.lane for each in crossed[name]}):
            area = shapely.union_all(tiles.geometry[tiles[LANE_COLUMN] == lane])
            if area.buffer(-_SNAPPED_M).intersects(line.boundary):
                reporter.warn(
                    "section {} ends inside lane {}, which it does not count; "
                    "draw it across the lane",
                    name, lane,
                )  # fmt: skip


def _groups_with_distinct_lanes(crossed: Mapping[str, Sequence[_Crossing]]) -> list[list[str]]:
    """Return the sections in groups without a common lane, as a lane is counted at one place."""
    groups: list[tuple[list[str], set[int]]] = []
    for name, mine in crossed.items():
        lanes = {each.lane for each in mine}
        free = next((group for group in groups if not group[1] & lanes), None)
        if free is None:
            groups.append(free := ([], set()))
        free[0].append(name)
        free[1].update(lanes)
    return [names for names, _ in groups]


def _by_direction(
    rows: gpd.GeoDataFrame, line: shapely.LineString, crossed: Sequence[_Crossing]
) -> list[pd.DataFrame]:
    """Return a table for each direction of a section."""
    tables = []
    for side in sorted({each.is_left for each in crossed}):
        crossings = [each for each in crossed if each.is_left is side]
        sums = _sums_of_lanes(rows, crossings)
        sums["direction"] = bound_name(np.sum([each.direction for each in crossings], axis=0))
        sums["geometry"] = gpd.GeoSeries([_part_of(line, crossings)] * len(sums))
        tables.append(sums)
    return tables


def _part_of(line: shapely.LineString, crossed: list[_Crossing]) -> shapely.LineString:
    """Return the part of a section on the lanes of one direction, half a lane beyond them."""
    at_m = [each.at_m for each in crossed]
    first, last = max(min(at_m) - _HALF_LANE_M, 0.0), min(max(at_m) + _HALF_LANE_M, line.length)
    return shapely.LineString(shapely.ops.substring(line, first, last).coords)


def _sums_of_lanes(rows: gpd.GeoDataFrame, crossed: list[_Crossing]) -> pd.DataFrame:
    """Return the sums over the lanes of one direction, by interval."""
    numbers = [each.lane for each in crossed]
    of_lanes = pd.DataFrame(rows.loc[rows["lane"].isin(numbers), ["begin", "end", *_FIGURES]])
    of_lanes = of_lanes.assign(
        counted=of_lanes["counted"].astype("Float64"),
        variance=of_lanes["volume_se"].astype(float) ** 2,
    )
    of_lanes["by_speed"] = of_lanes["speed_time_mean_kmh"] * of_lanes["counted"].astype(float)
    times = pd.MultiIndex.from_frame(rows[["begin", "end"]].drop_duplicates()).sort_values()
    groups = of_lanes.groupby(["begin", "end"])
    # a lane without a row was not observed
    all_seen = (groups.size() == len(numbers)).reindex(times, fill_value=False)
    sums = groups[["volume", "variance"]].sum(min_count=len(numbers)).reindex(times)
    known_sums = groups[["counted", "heavy", "by_speed"]].sum(min_count=1).reindex(times)
    table = pd.DataFrame(
        {
            "visible_share": groups["visible_share"].min().reindex(times).where(all_seen, 0.0),
            "counted": known_sums["counted"].astype("Int64"), "volume": sums["volume"],
            "volume_se": np.sqrt(sums["variance"]), "heavy": known_sums["heavy"],
            "speed_time_mean_kmh": known_sums["by_speed"] / known_sums["counted"].astype(float),
        }
    ).reset_index()  # fmt: skip
    hours = (table["end"] - table["begin"]).dt.total_seconds() / 3600.0
    table.insert(6, "volume_veh_h", table["volume"] / hours)
    return table

"""Lanes: chains of lanelets with number, street, direction, turns and stop line.

Lanes are made and numbered here only: tiles carry the number, from which heat maps, reports and
projects take it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import scipy
import shapely

from gis_radar.base import QUIET, Floats, Integers, Reporter, wind_of
from gis_radar.hdmap.streets import name_streets
from gis_radar.hdmap.tagging import STREET, TURN_TAG

LANES_LAYER, STOP_LINES_LAYER = "lanes", "stop_lines"
_TOUCH_M = 0.05  # between the ends of lanelets that follow each other: nodes may be drawn twice
_JOIN_RAD = math.radians(30.0)  # between their cross-lines: excludes the opposite direction
_SHAPE_M = 0.01  # tolerance of simplified centre lines: far below a pixel, a tenth of the points
LANE_EXIT_M = 5.0  # last part of a lane, which gives its direction: it may turn before
_STRAIGHT_RAD = math.radians(35.0)  # turns of the sample and four public maps: 57 degrees or more
_BACK_RAD = math.radians(150.0)  # from which on a turn is called `back` (a U-turn)
_SHARP_M = 50.0  # largest mean radius of a turn; roads that only bend have more
_STOP_NEAR_M = 2.0  # from the end of a lanelet to a stop line drawn behind it
_TURNS = ("left", "straight", "right", "back")
_STOP_KINDS: dict[str, Any] = {
    "stop_line": np.int64, "lane": np.int64, "lanelet_id": np.int64,
    "s_m": np.float64, "lane_m": np.float64, "sign": object,
}  # fmt: skip
_TAGGED = {"left": "left", "right": "right", "straight": "straight", "through": "straight"}


class _Ends(NamedTuple):
    """Starts and ends of lanelets: (n, 4), easting and northing of left and right bound, metres."""

    starts: Floats
    ends: Floats


def chain_lanelets(lanelet_id: Integers, starts: Floats, ends: Floats) -> list[tuple[int, ...]]:
    """Chain lanelets to lanes: each is the only successor of its only predecessor.

    Parameters
    ----------
    lanelet_id : (n,) int64 array
        Ids, ascending.
    starts, ends : (n, 4) arrays
        Easting and northing of the left and of the right bound at start and end, metres.

    Returns
    -------
    list of tuples of int
        The lanelets of each lane in driving order, lanes by their smallest id. A ring begins at its
        smallest.
    """
    nothing_stated = [()] * len(lanelet_id)
    return _chained(_successors_of(lanelet_id.tolist(), _Ends(starts, ends), nothing_stated))


def _chained(after: Mapping[int, Sequence[int]]) -> list[tuple[int, ...]]:
    """Return chains, by the ids of the lanelets that follow each; a ring begins at its smallest."""
    before = Counter(k for found in after.values() for k in found)
    only = {ref: k[0] for ref, k in after.items() if len(k) == 1 and before[k[0]] == 1}
    with_predecessor, seen, chains = set(only.values()), set[int](), list[tuple[int, ...]]()
    for first in [*(ref for ref in after if ref not in with_predecessor), *after]:
        chain, at = [], first
        while at not in seen:
            seen.add(at)
            chain.append(at)
            at = only.get(at, at)
        if chain:
            chains.append(tuple(chain))
    return sorted(chains, key=min)


def _successors_of(
    ids: list[int], at: _Ends, stated: Sequence[Collection[int]]
) -> dict[int, list[int]]:
    """Return, by id, the lanelets that follow each.

    Ends that touch count, and what the map states; those that only lie near each other, as from
    :func:`joining`, count where an end or a start has nothing else.
    """
    low = at.starts.min(axis=0) if len(ids) else 0.0
    trees = (scipy.spatial.cKDTree(each - low) for each in (at.ends, at.starts))
    touching = next(trees).query_ball_tree(next(trees), _TOUCH_M)
    position = {ref: index for index, ref in enumerate(ids)}
    successors = [
        {k for k in near if k != i} | {position[ref] for ref in refs if ref in position}
        for i, (near, refs) in enumerate(zip(touching, stated, strict=True))
    ]
    reached = {k for each in successors for k in each}
    near = joining(at.starts, at.ends, _TOUCH_M)
    return {
        ref: [ids[k] for k in sorted(each | {k for k in close if not each or k not in reached})]
        for ref, each, close in zip(ids, successors, near, strict=True)
    }


def joining(starts: Floats, ends: Floats, within_m: float) -> list[list[int]]:
    """Return, for each end, the starts that join it: near, and in the same direction.

    Parameters
    ----------
    starts, ends : (n, 4) arrays
        Easting and northing of the left and of the right bound, metres.
    within_m : float
        Distance between their middles.
    """
    (begin, opening), (end, closing) = (
        ((each[:, :2] + each[:, 2:]) / 2.0, np.arctan2(*(each[:, :2] - each[:, 2:]).T))
        for each in (starts, ends)
    )
    low = begin.min(axis=0) if len(begin) else 0.0
    trees = (scipy.spatial.cKDTree(each - low) for each in (end, begin))
    near = next(trees).query_ball_tree(next(trees), within_m)
    least = math.cos(_JOIN_RAD)
    return [
        sorted(k for k in found if k != i and math.cos(opening[k] - closing[i]) > least)
        for i, found in enumerate(near)
    ]


def lane_chains(lanelets: gpd.GeoDataFrame) -> list[tuple[int, ...]]:
    """Return the lanelets of each lane of a map, as :func:`chain_lanelets` orders them.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.
    """
    return _chained(_lanelets_after(_by_id(lanelets)))


def lane_style(layer: str) -> str:
    """Return the QGIS style of the layer of lanes or of stop lines as QML."""
    return (files("gis_radar.hdmap") / f"{layer}.qml").read_text(encoding="utf-8")


def _by_id(lanelets: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    return lanelets.set_index(lanelets["lanelet_id"].to_numpy(np.int64)).sort_index()


def _ends_of(lanelets: gpd.GeoDataFrame) -> _Ends:
    """Return the starts and ends of the bounds of lanelets."""
    sides = [lanelets[side].array for side in ("left", "right")]
    starts, ends = (
        np.column_stack([shapely.get_coordinates(shapely.get_point(side, at)) for side in sides])
        for at in (0, -1)
    )
    return _Ends(starts, ends)


def lane_numbers(lanelets: gpd.GeoDataFrame) -> dict[int, int]:
    """Return the number of each lanelet's lane: its smallest lanelet id."""
    return {ref: min(chain) for chain in lane_chains(lanelets) for ref in chain}


def make_lanes(
    lanelets: gpd.GeoDataFrame,
    regulatory: gpd.GeoDataFrame,
    *,
    streets: gpd.GeoDataFrame | str | Path | None = None,
    street_field: str | None = None,
    reporter: Reporter = QUIET,
) -> gpd.GeoDataFrame:
    """Return the lanes of a map; see :meth:`gis_radar.LaneletMap.lanes`."""
    table = _by_id(lanelets)
    after = _lanelets_after(table)
    chains = _chained(after)
    if len(table) > 1 and not any(after.values()):
        reporter.warn(
            "no lanelet of the map follows another: each is a lane of its own, without turns",
        )
    lines = [_centre_line([table.at[ref, "centre"] for ref in chain]) for chain in chains]
    turns = _lane_turns(chains, table, after)
    stops = find_stop_lines(lanelets, regulatory)
    stop_m = dict(zip(stops["lane"], stops["lane_m"], strict=True))
    result = gpd.GeoDataFrame(
        {
            "lane": np.array([min(chain) for chain in chains], np.int64),
            "lanelets": chains,
            "subtype": [table.at[chain[0], "subtype"] for chain in chains],
            STREET: [_tagged_street(table, chain) for chain in chains],
            "direction": [
                wind_of(*_exit_vector(line, stop_m.get(min(chain), line.length)))
                for chain, line in zip(chains, lines, strict=True)
            ],
            "turn": turns,
            "stop_line_m": [float(stop_m.get(min(chain), math.nan)) for chain in chains],
            "length_m": [float(line.length) for line in lines],
            "speed_limit_kmh": [_limit_along(table, chain) for chain in chains],
        },
        geometry=lines,
        crs=lanelets.crs,
    )
    return name_streets(result, streets, street_field, reporter)


def _lanelets_after(table: gpd.GeoDataFrame) -> dict[int, list[int]]:
    return _successors_of(table["lanelet_id"].tolist(), _ends_of(table), list(table["successors"]))


def _centre_line(parts: list[shapely.LineString]) -> shapely.LineString:
    """Return consecutive centre lines joined to one, in the plane, simplified."""
    points = np.concatenate([shapely.get_coordinates(part) for part in parts])
    apart = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-6)
    line = shapely.LineString(points[apart] if apart.sum() > 1 else points)
    return shapely.simplify(line, _SHAPE_M)


def _exit_vector(line: shapely.LineString, end_m: float) -> tuple[float, float]:
    """Return the vector (east, north), metres, of the last `LANE_EXIT_M` of a line to `end_m`.

    Where `end_m` is nearer to the line's begin, it is that of the first `LANE_EXIT_M`.
    """
    end_m = max(end_m, min(LANE_EXIT_M, line.length))
    end, before = line.interpolate(end_m), line.interpolate(max(end_m - LANE_EXIT_M, 0.0))
    return end.x - before.x, end.y - before.y


def _tagged_street(table: gpd.GeoDataFrame, chain: tuple[int, ...]) -> str | None:
    """Return the street's name that most of a lane's length is tagged with, or None."""
    lengths = Counter[str]()
    for ref in chain:
        if name := table.at[ref, STREET]:
            lengths[name] += table.at[ref, "centre"].length
    return lengths.most_common(1)[0][0] if lengths else None


def _limit_along(table: gpd.GeoDataFrame, chain: tuple[int, ...]) -> float:
    """Return the mean speed over a lane at its limits, km/h; NaN where one is unknown."""
    lengths = np.array([table.at[ref, "centre"].length for ref in chain])
    limits = np.array([float(table.at[ref, "speed_limit_kmh"]) for ref in chain])
    return float(lengths.sum() / (lengths / limits).sum())


# Turns.


def _lane_turns(
    chains: list[tuple[int, ...]], table: gpd.GeoDataFrame, after: Mapping[int, Sequence[int]]
) -> list[str | None]:
    """Return the turns of each lane, with those of the lanes that it branches into."""
    own = {ref: _turn_of(table, ref) for ref in table["lanelet_id"].tolist()}
    branches = {ref for found in after.values() if len(found) > 1 for ref in found}
    turns: list[str | None] = []
    for chain in chains:
        turns_of_lane = {own[ref] for ref in chain} - {""}
        ahead = after[chain[-1]]
        if len(ahead) > 1:
            turns_of_lane |= {own[ref] or "straight" for ref in ahead}
        elif chain[0] in branches and not turns_of_lane:
            turns_of_lane = {"straight"}
        turns.append(";".join(way for way in _TURNS if way in turns_of_lane) or None)
    return turns


def _turn_of(table: gpd.GeoDataFrame, ref: int) -> str:
    """Return the turn of a lanelet: by its tag, else by its geometry; empty where it has none."""
    if tag := str(table.at[ref, TURN_TAG] or "").lower():
        return _TAGGED.get(tag, "")
    gaps = np.diff(shapely.get_coordinates(table.at[ref, "centre"]), axis=0)
    lengths = np.hypot(*gaps.T)
    angle = np.unwrap(np.arctan2(gaps[:, 1], gaps[:, 0])[lengths > 1e-6])
    turn_rad = float(angle[-1] - angle[0]) if len(angle) else 0.0
    word = turn_word(turn_rad)
    return "" if word == "straight" or lengths.sum() > _SHARP_M * abs(turn_rad) else word


def turn_word(turn_rad: float) -> str:
    """Return the word for a turn, given in radians to the left."""
    if abs(turn_rad) < _STRAIGHT_RAD:
        return "straight"
    if abs(turn_rad) > _BACK_RAD:
        return "back"
    return "left" if turn_rad > 0.0 else "right"


# Stop lines.


def find_stop_lines(lanelets: gpd.GeoDataFrame, regulatory: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the stop lines of a map; see :meth:`gis_radar.LaneletMap.stop_lines`."""
    table = _by_id(lanelets)
    before: dict[int, tuple[int, float]] = {}
    for chain in lane_chains(table):
        start_m = np.cumsum([0.0, *(table.at[ref, "centre"].length for ref in chain)])
        before |= {ref: (min(chain), float(m)) for ref, m in zip(chain, start_m, strict=False)}
    rows: dict[tuple[int, int], tuple[Any, ...]] = {}
    for way, named, sign, line in _drawn_stop_lines(regulatory):
        for ref, s_m in _lanelets_ended_by(table["centre"], line, named):
            lane, lanelet_begin_m = before[ref]
            rows[way, lane] = (way, lane, ref, s_m, lanelet_begin_m + s_m, sign, line)
    order = sorted(rows.values(), key=lambda row: (row[1], row[4]))
    columns = {name: [row[i] for row in order] for i, name in enumerate(_STOP_KINDS)}
    lines = [row[-1] for row in order]
    return gpd.GeoDataFrame(columns, geometry=lines, crs=lanelets.crs).astype(_STOP_KINDS)


def _drawn_stop_lines(
    elements: gpd.GeoDataFrame,
) -> Iterator[tuple[int, set[int], str, shapely.LineString]]:
    """Yield id of each stop line, ids of the lanelets that name it, its sign, and its line."""
    found = elements[elements["member_type"].eq("stop_line") | elements["role"].eq("ref_line")]
    for way, rows in found.groupby("member_id"):
        line = rows.geometry.iloc[0]
        if line is not None and line.geom_type == "LineString":
            named = {ref for refs in rows["lanelet_ids"] for ref in refs}
            yield int(way), named, str(rows["member_sign"].iloc[0] or ""), shapely.force_2d(line)


def _lanelets_ended_by(
    centres: gpd.GeoSeries, line: shapely.LineString, named: Collection[int]
) -> list[tuple[int, float]]:
    """Return the lanelets that a stop line ends, each with the line's place along it, metres."""
    near = centres.index[shapely.dwithin(centres.array, line, _STOP_NEAR_M)].tolist()
    among = [ref for ref in (named or near) if ref in centres.index]
    met = [ref for ref in among if _ends_at(centres[ref], line)]
    along = [(ref, _meeting_place_m(centres[ref], line)) for ref in met or sorted(among)]
    # A line where one lanelet ends and the next begins ends the first.
    ended = [(ref, s_m) for ref, s_m in along if s_m > _STOP_NEAR_M / 2]
    return sorted(ended or along)


def _ends_at(centre: shapely.LineString, line: shapely.LineString) -> bool:
    """Return whether a centre line, extended by `_STOP_NEAR_M`, meets a stop line."""
    before, end = shapely.get_coordinates(centre)[-2:]
    ahead = (end - before) / max(float(np.hypot(*(end - before))), 1e-9)
    longer = shapely.LineString([before, end + _STOP_NEAR_M * ahead])
    return bool(centre.distance(line) < _TOUCH_M or longer.distance(line) < _TOUCH_M)


def _meeting_place_m(centre: shapely.LineString, line: shapely.LineString) -> float:
    """Return the place along a centre line (m) at which another line meets it or is nearest."""
    return float(centre.project(shapely.Point(shapely.shortest_line(centre, line).coords[0])))

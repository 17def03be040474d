"""Names of lanes as people use them: street, direction, number from the kerb, turn.

`Ostring northbound, lane 2 (left)` has the street (by the map or the city's layer), the direction
at the stop line or before the junction, else in the middle, the number of the lane from the kerb
(on the left where opposite lanes lie on the right), and its turns in the junction. Lanes of the
same name are numbered as sections, in driving order. Names are for people; programs use the lanes'
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
import shapely.ops

from gis_radar.base import Floats, Text, listed, street_label, tr, wind_of
from gis_radar.hdmap import turn_word
from gis_radar.measures.lane_network import LaneNetwork, Turn

_BEFORE_M = 5.0  # before stop line or junction, where direction and number of a lane are determined
_DIRECT_M = 15.0  # length of the exit in the line of a turn without connectors: a short connector's
_BESIDE_M = 5.5  # largest distance between the middles of lanes side by side
_ABREAST_M = 30.0  # width over which lanes of one direction are searched
_PARALLEL = math.cos(math.radians(30.0))  # least cosine between parallel lanes
BOUND_WORDS = {
    "north": Text("northbound"), "north-east": Text("north-eastbound"),
    "east": Text("eastbound"), "south-east": Text("south-eastbound"),
    "south": Text("southbound"), "south-west": Text("south-westbound"),
    "west": Text("westbound"), "north-west": Text("north-westbound"),
}  # fmt: skip
TURN_WORDS = {
    "left": Text("left turn"), "straight": Text("straight ahead"),
    "right": Text("right turn"), "back": Text("U-turn"),
}  # fmt: skip


def lane_names(lanes: gpd.GeoDataFrame, network: LaneNetwork) -> list[str]:
    """Return a unique name for each lane of a network, in the current language.

    Parameters
    ----------
    lanes : GeoDataFrame
        The layer `lanes`, with all lanes of the network; it may have more. A column `name` holds
        names of their own, where they have some.
    network : LaneNetwork
        Network of the site.
    """
    rows, points, directions = _places_of_lanes(lanes, network)
    lines, connector = list(rows.geometry.array), network.connector
    lines_of_lanes = [line for line, inside in zip(lines, connector, strict=True) if not inside]
    kerb = _kerb_side(points[~connector], directions[~connector], lines_of_lanes)
    names = []
    for k, (_, row) in enumerate(rows.iterrows()):
        if isinstance(own := row.get("name"), str) and own:
            names.append(own)
            continue
        if connector[k]:
            direction, place = place_on(lines[k], 0.0)[1], tr("in the junction")
        else:
            direction = directions[k]
            place = tr("lane {number}", number=_number(points[k], direction, lines_of_lanes, kerb))
        name = f"{_direction(row, direction)}, {place}"
        leads = connector[k] or network.has_stop_line[k] or connector[[*network.after[k]]].any()
        turns = str(row["turn"]).split(";") if leads and isinstance(row["turn"], str) else []
        words = listed([tr(TURN_WORDS[each]) for each in turns if each in TURN_WORDS])
        names.append(f"{name} ({words})" if words else name)
    return _made_unique(names, points, directions)


def lane_directions(lanes: gpd.GeoDataFrame, network: LaneNetwork) -> list[str]:
    """Return street and direction of each lane of a network, as they begin its name.

    Connectors lie in a junction, and have none: an empty text.

    Parameters
    ----------
    lanes, network
        As for :func:`lane_names`.
    """
    rows, _, directions = _places_of_lanes(lanes, network)
    return [
        "" if inside else _direction(row, way)
        for (_, row), way, inside in zip(
            rows.iterrows(), directions, network.connector, strict=True
        )
    ]


def _places_of_lanes(
    lanes: gpd.GeoDataFrame, network: LaneNetwork
) -> tuple[gpd.GeoDataFrame, Floats, Floats]:
    """Return the rows of lanes, the places at which they are named, and the directions there."""
    rows = lanes.set_index("lane").loc[network.lane.tolist()]
    lines = list(rows.geometry.array)
    meets = [network.connector[[*after]].any() for after in network.after]
    end_m = np.where(network.has_stop_line, network.line_m, [line.length for line in lines])
    named_m = np.where(network.has_stop_line | meets, end_m - _BEFORE_M, network.line_m)
    along_m = [float(np.clip(m, 0.0, line.length)) for m, line in zip(named_m, lines, strict=True)]
    points, directions = (
        np.array(each) for each in zip(*map(place_on, lines, along_m), strict=True)
    )
    return rows, points, directions


def _direction(row: pd.Series, direction: Floats) -> str:
    street = street_label(row["street"], row.get("street_part")) or tr("Road")
    return f"{street} {bound_name(direction)}"


def bound_name(direction: Floats) -> str:
    """Return the word for traffic in a direction, such as `northbound`."""
    return tr(BOUND_WORDS[wind_of(*direction) or "north"])


def place_on(line: shapely.LineString, along_m: float) -> tuple[Floats, Floats]:
    """Return a point (m) of a line, and the unit vector of its direction there."""
    low, high = max(along_m - 1.0, 0.0), min(along_m + 1.0, line.length)
    before, point, after = (line.interpolate(m).coords[0][:2] for m in (low, along_m, high))
    direction = np.subtract(after, before)
    return np.array(point), direction / max(float(np.hypot(*direction)), 1e-9)


def _kerb_side(points: Floats, directions: Floats, lines: Sequence[shapely.LineString]) -> float:
    """Return where the kerb is: 1 on the right, -1 on the left, as most opposite lanes say."""
    votes = 0.0
    for point, direction in zip(points, directions, strict=True):
        opposite = [
            off for off, along in _lines_abreast(point, direction, lines) if along < -_PARALLEL
        ]
        votes += np.sign(min(opposite, key=abs)) if opposite else 0.0
    return -1.0 if votes > 0.0 else 1.0


def _lines_abreast(
    point: Floats, direction: Floats, lines: Sequence[shapely.LineString]
) -> list[tuple[float, float]]:
    """Return how far lines lie to the right of a place, m, and the cosines of their directions."""
    right = np.array([direction[1], -direction[0]])
    across = shapely.LineString([point - _ABREAST_M * right, point + _ABREAST_M * right])
    offsets = []
    for k in np.flatnonzero(shapely.intersects(lines, across)).tolist():
        for met in shapely.get_coordinates(shapely.intersection(lines[k], across)):
            toward = place_on(lines[k], lines[k].project(shapely.Point(met)))[1]
            offsets.append((float((met - point) @ right), float(toward @ direction)))
    return offsets


def _number(
    point: Floats, direction: Floats, lines: Sequence[shapely.LineString], kerb: float
) -> int:
    """Return the number of a lane, from the kerb, among lanes side by side."""
    offsets = (
        kerb * off for off, along in _lines_abreast(point, direction, lines) if along > _PARALLEL
    )
    number, reached = 1, 0.0
    for offset_m in sorted(each for each in offsets if each > 0.0):
        if offset_m - reached > _BESIDE_M:
            break
        if offset_m - reached > 1.0:  # leaves out the lane itself and one that merges into it
            number, reached = number + 1, offset_m
    return number


def _made_unique(names: list[str], points: Floats, directions: Floats) -> list[str]:
    """Return names of which equal ones get the number of a section, in driving order."""
    unique = list(names)
    for name in sorted({each for each in names if names.count(each) > 1}):
        same_name = [k for k, each in enumerate(names) if each == name]
        direction = directions[same_name].sum(axis=0)
        order = sorted(same_name, key=lambda k: (float(points[k] @ direction), k))
        for section, k in enumerate(order, start=1):
            unique[k] = tr("{name}, section {section}", name=name, section=section)
    return unique


def turn_lines(
    lanes: gpd.GeoDataFrame, network: LaneNetwork, turns: Sequence[Turn]
) -> tuple[list[str], list[shapely.LineString]]:
    """Return the word (`left`, `straight`, `right` or `back`) and the line of each turn.

    The word is that of its connectors in the layer, as in the names of lanes; without one it is by
    the angle between approach and exit.

    The line runs from the stop line, else from the approach's end, to the begin of the exit, or
    some metres on where no connector lies between.
    """
    lines, called = lanes.set_index("lane").geometry, lanes.set_index("lane")["turn"]
    drawn = []
    for turn in turns:
        start, end, *via = (lines[network.lane[k]] for k in (turn.start, turn.end, *turn.via))
        stop = network.has_stop_line[turn.start]
        line_m = float(network.line_m[turn.start] if stop else start.length)
        rest = shapely.ops.substring(start, min(line_m, start.length - 1.0), start.length)
        entry = shapely.ops.substring(end, 0.0, min(1.0 if via else _DIRECT_M, end.length))
        points = np.concatenate([shapely.get_coordinates(each) for each in (rest, *via, entry)])
        new = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-3)
        start_way, end_way = place_on(start, max(line_m - _BEFORE_M, 0.0))[1], place_on(end, 0.0)[1]
        turned = math.atan2(
            start_way[0] * end_way[1] - start_way[1] * end_way[0], float(start_way @ end_way)
        )
        word = _word_of([called[network.lane[k]] for k in turn.via]) or turn_word(turned)
        drawn.append((word, shapely.LineString(points[new])))
    return [each for each, _ in drawn], [line for _, line in drawn]


def _word_of(connectors: Sequence[str | None]) -> str | None:
    """Return the only turn of consecutive connectors; None where they have none, or several."""
    words = set(connectors) & set(TURN_WORDS)
    turned = words - {"straight"} or words
    return next(iter(turned)) if len(turned) == 1 else None

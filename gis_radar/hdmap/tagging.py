"""Read tags and regulatory elements: participants, speed limits, stop lines, lights, priority."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

import geopandas as gpd
import numpy as np
from pyproj import CRS
from shapely import LineString, Point
from shapely.geometry.base import BaseGeometry

from gis_radar.base import Floats, one_line
from gis_radar.hdmap.osm import OsmMap, Relation

_VEHICLE, _BICYCLE, _PEDESTRIAN = "vehicle", "bicycle", "pedestrian"

# Lanelet2, "Tagging Lanelets and Areas", table "Subtype and Location".
_USERS: dict[str, tuple[str, ...]] = {
    "": (_VEHICLE,),
    "road": (_BICYCLE, _VEHICLE),
    "highway": (_VEHICLE,),
    "play_street": (_BICYCLE, _PEDESTRIAN, _VEHICLE),
    "exit": (_BICYCLE, _PEDESTRIAN, _VEHICLE),
    "emergency_lane": ("vehicle:emergency",),
    "bus_lane": ("vehicle:bus", "vehicle:emergency", "vehicle:taxi"),
    "bicycle_lane": (_BICYCLE,),
    "walkway": (_PEDESTRIAN,),
    "shared_walkway": (_BICYCLE, _PEDESTRIAN),
    "crosswalk": (_PEDESTRIAN,),
    "stairs": (_PEDESTRIAN,),
}
# Tags for the street's name, for which Lanelet2 has none; the most general come last.
STREET, _STREET_TAGS = "street", ("street_name", "road_name", "street", "addr:street", "name")
TURN_TAG = "turn_direction"  # of Autoware and CARLA: left, right, straight
_YES, _NO = {"yes", "true", "1"}, {"no", "false", "0"}
ON_FOOT_OR_BICYCLE = ("bicycle_lane", "crosswalk", "shared_walkway", "stairs", "walkway")
_KMH_PER_UNIT = {
    **dict.fromkeys(("", "km/h", "kmh", "kph", "kmph"), 1.0),
    **dict.fromkeys(("m/s", "mps", "ms"), 3.6),
    "mph": 1.609344,
}
_SPEED = re.compile(r"\s*(\d+(?:[.,]\d+)?)\s*([a-z/]*)\s*", re.IGNORECASE)
_SIGN = re.compile(r"(?:^|[^0-9])274(?:\.1)?[-_](\d{2,3})$")


def participants_of(tags: dict[str, str]) -> tuple[str, ...]:
    """Return who may use a lanelet, sorted: `vehicle`, `bicycle`, `pedestrian`, `vehicle:bus`, ...

    A tag `participant:*` overrides all that the subtype implies. A subtype unknown to Lanelet2 has
    no users.
    """
    override = {key: value for key, value in tags.items() if key.startswith("participant:")}
    if override:
        users = (key.removeprefix("participant:") for key in override if truth(override[key]))
        return tuple(sorted(users))
    return _USERS.get(tags.get("subtype", ""), ())


def subtype_of(tags: dict[str, str]) -> str:
    """Return the subtype; without a tag, as in old maps, the one that fits the participants."""
    if subtype := tags.get("subtype", ""):
        return subtype
    users = participants_of(tags)
    if any(user.startswith(_VEHICLE) for user in users):
        return "road"
    fitting = {
        (_BICYCLE,): "bicycle_lane",
        (_PEDESTRIAN,): "walkway",
        (_BICYCLE, _PEDESTRIAN): "shared_walkway",
    }
    return fitting.get(users, "unknown")


def is_driven(participants: Iterable[str]) -> bool:
    """Return whether vehicles, or some of them, use a lanelet, by its participants."""
    return any(each == "vehicle" or each.startswith("vehicle:") for each in participants)


def street_of(tags: dict[str, str]) -> str | None:
    """Return the street's name that a lanelet is tagged with, or None."""
    return next((name for key in _STREET_TAGS if (name := one_line(tags.get(key, "")))), None)


def one_way_of(tags: dict[str, str]) -> bool:
    """Return whether a lanelet is used in one direction only.

    Without a tag `one_way` it is, unless only pedestrians use it; a tag for single participants
    (`one_way:bicycle=no`) does not change that for others.
    """
    given = truth(tags.get("one_way", ""))
    if given is not None:
        return given
    return participants_of(tags) != (_PEDESTRIAN,)


def truth(text: str) -> bool | None:
    """Return the truth of yes, no, true, false, 1 or 0, or None for anything else."""
    word = text.strip().lower()
    return word in _YES if word in _YES | _NO else None


def kmh(text: str) -> float:
    """Return a speed in km/h from text such as `50`, `13.9 m/s` or `30 mph`; NaN if it is none.

    At a limit of 0 nobody would be delayed: that is none, too.
    """
    match = _SPEED.fullmatch(text)
    if match is None:
        return math.nan
    factor = _KMH_PER_UNIT.get(match[2].lower(), math.nan)
    return float(match[1].replace(",", ".")) * factor or math.nan


def kmh_of_signs(signs: Iterable[str]) -> float:
    """Return the lowest speed that signs state, km/h, else NaN: `50 km/h`, or German `de274-50`."""
    speeds = [kmh(sign) for sign in signs]
    speeds += [float(match[1]) for sign in signs if (match := _SIGN.search(sign))]
    return min((speed for speed in speeds if not math.isnan(speed)), default=math.nan)


_ELEMENT = "regulatory_element"
_COLUMNS = (
    "element_id",
    "subtype",
    "role",
    "lanelet_ids",
    "member_id",
    "member_type",
    "member_sign",
)


def lanelets_of_elements(osm: OsmMap) -> dict[int, tuple[int, ...]]:
    """Return, by regulatory element, the ids of the lanelets that name it, sorted."""
    users: dict[int, set[int]] = defaultdict(set)
    for lanelet_id, lanelet in osm.relations_of("lanelet"):
        for element in lanelet.refs("relation", _ELEMENT):
            users[element].add(lanelet_id)
    return {element: tuple(sorted(lanelets)) for element, lanelets in users.items()}


def regulated_kmh(osm: OsmMap, lanelet: Relation) -> float:
    """Return the lowest speed limit that regulatory elements set for a lanelet, km/h, else NaN."""
    signs: list[str] = []
    for ref in lanelet.refs("relation", _ELEMENT):
        element = osm.relations.get(ref)
        if element is None or element.tags.get("subtype") != "speed_limit":
            continue
        signs.append(element.tags.get("sign_type", ""))
        ways = (osm.ways.get(way) for way in element.refs("way", "refers"))
        signs.extend(way.tags.get("subtype", "") for way in ways if way is not None)
    return kmh_of_signs(signs) if signs else math.nan


def regulatory_table(osm: OsmMap, xyz: Floats, crs: CRS) -> gpd.GeoDataFrame:
    """Return all regulatory elements, a row for each of their members.

    Parameters
    ----------
    osm : OsmMap
        The map as read.
    xyz : (n, 3) array
        Positions of the nodes in `crs`.
    crs : CRS
        The system of the positions.

    Returns
    -------
    GeoDataFrame
        `element_id`, `subtype` of the element, `role` of the member, `lanelet_ids` (tuple: the
        lanelets that name the element; for a member that is a lanelet, that lanelet),
        `member_id`, `member_type` (`stop_line`, `traffic_light`, ...), `member_sign` (its
        subtype, such as `de205`), and the member's geometry, if it has one. Stop lines that no
        element names are rows of their own, with the way's id as `element_id`.
    """
    rows = [*_members(osm, xyz), *_lone_stop_lines(osm, xyz)]
    columns: dict[str, Any] = {name: [row[i] for row in rows] for i, name in enumerate(_COLUMNS)}
    for name in ("element_id", "member_id"):
        columns[name] = np.array(columns[name], dtype=np.int64)
    return gpd.GeoDataFrame(columns, geometry=[row[-1] for row in rows], crs=crs)


def _members(osm: OsmMap, xyz: Floats) -> Iterator[tuple[Any, ...]]:
    """Yield a row of :func:`regulatory_table` for each member of a regulatory element."""
    users = lanelets_of_elements(osm)
    for element_id, element in sorted(osm.relations_of(_ELEMENT)):
        for member in element.members:
            tags: dict[str, str] = {}
            lanelets = users.get(element_id, ())
            if member.kind == "relation":
                lanelets = (member.ref,)
            elif member.kind == "way" and member.ref in osm.ways:
                tags = osm.ways[member.ref].tags
            shape = _shape(osm, xyz, member.kind, member.ref)
            kind, sign = tags.get("type", member.kind), tags.get("subtype", "")
            subtype = element.tags.get("subtype", "")
            yield element_id, subtype, member.role, lanelets, member.ref, kind, sign, shape


def _lone_stop_lines(osm: OsmMap, xyz: Floats) -> Iterator[tuple[Any, ...]]:
    """Yield a row of :func:`regulatory_table` for each stop line that no element names."""
    elements = (element for _, element in osm.relations_of(_ELEMENT))
    named = {m.ref for element in elements for m in element.members if m.kind == "way"}
    for ref, way in sorted(osm.ways.items()):
        if way.tags.get("type") == "stop_line" and ref not in named:
            shape = _shape(osm, xyz, "way", ref)
            sign = way.tags.get("subtype", "")
            yield ref, "stop_line", "ref_line", (), ref, "stop_line", sign, shape


def _shape(osm: OsmMap, xyz: Floats, kind: str, ref: int) -> BaseGeometry | None:
    """Return the geometry of a way (a point if it has only one) or of a node; None of others."""
    nodes = osm.ways[ref].nodes if kind == "way" and ref in osm.ways else (ref,)
    known = [osm.node_index[node] for node in nodes if node in osm.node_index]
    points = xyz[known] if kind in {"way", "node"} else xyz[:0]
    points = points[np.isfinite(points[:, :2]).all(axis=1)]
    if not np.isfinite(points).all():
        points = points[:, :2]
    if len(points) == 0:
        return None
    return Point(points[0]) if len(points) == 1 else LineString(points)

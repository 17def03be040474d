"""Read Lanelet2 maps, project them to one metric system, and mend their lanelets."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
from pyproj import CRS
from shapely import LineString, MultiLineString
from shapely.geometry.base import BaseGeometry

from gis_radar.base import QUIET, Floats, InputError, Reporter, Text
from gis_radar.hdmap.bounds import (
    CannotMendError,
    arc_lengths,
    at_fractions,
    drawn_direction,
    rungs,
    slices,
    without_repeats,
)
from gis_radar.hdmap.lanelet_map import DOUBTFUL, LEFT_OUT, REPAIRED, LaneletMap
from gis_radar.hdmap.mending import Mended, mend, outline
from gis_radar.hdmap.osm import OsmMap, Relation, read_osm
from gis_radar.hdmap.positions import place_nodes
from gis_radar.hdmap.tagging import (
    STREET,
    TURN_TAG,
    kmh,
    one_way_of,
    participants_of,
    regulated_kmh,
    regulatory_table,
    street_of,
    subtype_of,
)

_STAGE = "reading lanelets"
_WIDE_M = 40.0  # width from which on a lanelet is doubtful: squares and turning areas are narrower
_WIDEST_M = 500.0  # width from which on a node must be in the wrong place
# Step in height between two corners, beyond the distance between them, from which on a lanelet is
# doubtful: of seven maps no corner lies steeper than 1 : 1 over the next, or over the other bound.
_JUMP_M = 3.0
_STRAY_M = 100_000.0  # from the middle of the map: no site is so large

# Lanelets, and their share, that lead against how they are drawn in a mirrored map: 37 to 100 %
# where latitudes and longitudes are swapped, at most 13 % in eight maps as they are.
_LEAST_AGAINST, _LEAST_AGAINST_SHARE = 10, 0.25


@dataclass(frozen=True, kw_only=True)
class _Lanelet:
    """A lanelet for the table; `start` and `end` are node ids of the left and the right bound."""

    id: int
    relation: Relation
    bounds: Mended
    start: tuple[int, int]
    end: tuple[int, int]
    turned: tuple[bool, bool]  # whether the left, and the right bound lead against how it is drawn


@dataclass(frozen=True, kw_only=True)
class _Problem:
    id: int
    action: str
    reason: str
    shape: BaseGeometry | None


def read_map(
    path: str | Path,
    *,
    crs: Any = None,
    origin: tuple[float, float] | None = None,
    reporter: Reporter = QUIET,
) -> LaneletMap:
    """Read a Lanelet2 map and mend what can be mended.

    Parameters
    ----------
    path : str or Path
        An OSM XML file with lanelets.
    crs : CRS, str or int, optional
        A projected system in metres; without it, the UTM zone of the map's middle.
    origin : (float, float), optional
        Easting and northing of the local (0, 0), for maps whose latitudes and longitudes are
        empty or false.
    reporter : Reporter
        Receives progress and remarks.

    Returns
    -------
    LaneletMap
        All lanelets that can be read, and a list of those mended or left out.

    Raises
    ------
    InputError
        If the file is no Lanelet2 map, has no position, or no lanelet can be read.
    CrsError
        If `crs` is not a projected one in metres.

    Examples
    --------
    >>> import gis_radar as gr
    >>> roads = gr.read_map(gr.sample_folder() / "junction.osm")
    >>> len(roads.lanelets), roads.crs.to_string()
    (48, 'EPSG:25832')
    """
    osm = read_osm(path)
    relations = dict(sorted(osm.relations_of("lanelet")))
    if not relations:
        raise InputError("{}: holds no lanelets", path, hint="a Lanelet2 map in OSM XML is needed")
    places = place_nodes(osm, _used(osm, relations), crs=crs, origin=origin)
    lanelets, problems = _assembled(osm, relations, places.xyz, reporter)
    if not lanelets:
        raise InputError(
            "{}: none of its {} lanelets can be read: lanelet {}: {}",
            path,
            len(relations),
            problems[0].id,
            problems[0].reason,
        )
    remarks = (*places.remarks, *_mirrored(lanelets), *_remarks(osm, problems))
    for remark in remarks:
        reporter.warn("{}: {}", Path(path).name, remark)
    return LaneletMap(
        lanelets=_lanelet_table(osm, lanelets, places.crs),
        regulatory=regulatory_table(osm, places.xyz, places.crs),
        problems=problem_table(problems, places.crs),
        crs=places.crs,
        remarks=remarks,
    )


def _mirrored(lanelets: list[_Lanelet]) -> tuple[str, ...]:
    """Return a remark on a map whose lanelets mostly lead against the way they are drawn."""
    against = sum(all(each.turned) for each in lanelets)
    along = sum(not any(each.turned) for each in lanelets)
    if against < max(_LEAST_AGAINST, _LEAST_AGAINST_SHARE * len(lanelets), 2 * along):
        return ()
    return (
        Text(
            "both bounds of {} of {} lanelets are drawn against the way they lead: are latitudes "
            "and longitudes, or local_x and local_y, swapped?",
            against,
            len(lanelets),
        ),
    )


def _used(osm: OsmMap, relations: dict[int, Relation]) -> Any:
    """Return a mask of the nodes that lanelets use."""
    refs = (m.ref for lanelet in relations.values() for m in lanelet.members if m.kind == "way")
    nodes = {node for ref in refs if ref in osm.ways for node in osm.ways[ref].nodes}
    return np.isin(osm.node_ids, np.fromiter(nodes, dtype=np.int64, count=len(nodes)))


def _assembled(
    osm: OsmMap, relations: dict[int, Relation], xyz: Floats, reporter: Reporter
) -> tuple[list[_Lanelet], list[_Problem]]:
    """Return the lanelets that can be made of relations, and the problems of all others."""
    lanelets: list[_Lanelet] = []
    problems: list[_Problem] = []
    for done, (ref, relation) in enumerate(relations.items()):
        if done % 200 == 0:
            reporter.progress(_STAGE, done, len(relations))
        drawn: list[Floats] = []
        try:
            lanelet, reasons = _lanelet(osm, ref, relation, xyz, drawn)
        except CannotMendError as error:
            problems.append(_left_out(ref, str(error), drawn))
            continue
        lanelets.append(lanelet)
        if reasons:
            shape = outline(lanelet.bounds.left, lanelet.bounds.right)
            reason = "; ".join(reasons)
            problems.append(_Problem(id=ref, action=REPAIRED, reason=reason, shape=shape))
    reporter.progress(_STAGE, len(relations), len(relations))
    plausible, implausible = _plausible(lanelets)
    return plausible, problems + implausible


def _plausible(lanelets: list[_Lanelet]) -> tuple[list[_Lanelet], list[_Problem]]:
    """Return the lanelets of possible place and shape, and problems: left out, or doubtful."""
    begins = np.array([each.bounds.left[0, :2] for each in lanelets]).reshape(-1, 2)
    away_m = np.hypot(*(begins - np.median(begins, axis=0)).T) if lanelets else begins[:, 0]
    kept, problems = [], []
    for lanelet, off_m in zip(lanelets, away_m.tolist(), strict=True):
        left, right = lanelet.bounds.left, lanelet.bounds.right
        along = np.linspace(0.0, 1.0, 5)
        apart = at_fractions(left, along)[:, :2] - at_fractions(right, along)[:, :2]
        width_m = float(np.median(np.hypot(*apart.T)))
        is_left_out = off_m > _STRAY_M or width_m > _WIDEST_M
        if not is_left_out:
            kept.append(lanelet)
        jump_m = _jump_m(left, right)
        if is_left_out or width_m > _WIDE_M or jump_m:
            far = Text("it lies {:.0f} km from the middle of the map", off_m / 1000.0)
            wide = Text("its bounds are {:.0f} m apart", width_m)
            steep = Text("its heights jump by {:.0f} m: is the ele of a node wrong?", jump_m)
            reason = far if off_m > _STRAY_M else wide if width_m > _WIDE_M else steep
            action = LEFT_OUT if is_left_out else DOUBTFUL
            shape = outline(left, right)
            problems.append(_Problem(id=lanelet.id, action=action, reason=reason, shape=shape))
    return kept, problems


def _jump_m(left: Floats, right: Floats) -> float:
    """Return the largest step in height to a next corner, or across; 0 where none is too steep."""
    if left.shape[1] + right.shape[1] < 6:  # without heights
        return 0.0
    across = left[[0, -1]] - right[[0, -1]]
    steps = np.concatenate([np.diff(left, axis=0), np.diff(right, axis=0), across])
    beyond_m = np.abs(steps[:, 2]) - np.hypot(*steps[:, :2].T)
    return float(np.abs(steps[beyond_m > _JUMP_M, 2]).max(initial=0.0))


def _left_out(ref: int, reason: str, drawn: list[Floats]) -> _Problem:
    lines = [LineString(bound[:, :2]) for bound in drawn if len(bound) > 1]
    shape = MultiLineString(lines) if lines else None
    return _Problem(id=ref, action=LEFT_OUT, reason=reason, shape=shape)


def _lanelet(
    osm: OsmMap, ref: int, relation: Relation, xyz: Floats, drawn: list[Floats]
) -> tuple[_Lanelet, tuple[str, ...]]:
    """Return a lanelet and its repairs; `drawn` receives its bounds, also where it then fails."""
    chains: list[Chain] = []
    for side in ("left", "right"):
        chains.append(chain_of(osm, relation.refs("way", side), xyz, side))
        drawn.append(chains[-1].points)
    left, right = chains
    turn_left, turn_right = drawn_direction(left.points, right.points)
    left = left.reversed() if turn_left else left
    right = right.reversed() if turn_right else right
    bounds = mend(*heights_filled(left.points, right.points))
    lanelet = _Lanelet(
        id=ref,
        relation=relation,
        bounds=bounds,
        start=(left.nodes[0], right.nodes[0]),
        end=(left.nodes[-1], right.nodes[-1]),
        turned=(turn_left, turn_right),
    )
    return lanelet, (*left.repairs, *right.repairs, *bounds.repairs)


def _lanelet_table(osm: OsmMap, lanelets: list[_Lanelet], crs: CRS) -> gpd.GeoDataFrame:
    """Return lanelets as the table of :class:`LaneletMap`."""
    tags = [lanelet.relation.tags for lanelet in lanelets]
    successors = _successors(lanelets)
    predecessors: dict[int, list[int]] = defaultdict(list)
    for ref, following in successors.items():
        for other in following:
            predecessors[other].append(ref)
    lines = {
        "left": [LineString(lanelet.bounds.left) for lanelet in lanelets],
        "right": [LineString(lanelet.bounds.right) for lanelet in lanelets],
        "centre": [_centre(lanelet.bounds) for lanelet in lanelets],
    }
    return gpd.GeoDataFrame(
        {
            "lanelet_id": np.array([lanelet.id for lanelet in lanelets], dtype=np.int64),
            "subtype": [subtype_of(tag) for tag in tags],
            "location": [tag.get("location") or None for tag in tags],
            STREET: [street_of(tag) for tag in tags],
            TURN_TAG: [tag.get(TURN_TAG) or None for tag in tags],
            "speed_limit_kmh": [_speed_limit(osm, lanelet.relation) for lanelet in lanelets],
            "one_way": [one_way_of(tag) for tag in tags],
            "participants": [participants_of(tag) for tag in tags],
            "successors": [successors[lanelet.id] for lanelet in lanelets],
            "predecessors": [tuple(predecessors[lanelet.id]) for lanelet in lanelets],
            **{name: gpd.GeoSeries(line, crs=crs) for name, line in lines.items()},
        },
        geometry=[outline(lanelet.bounds.left, lanelet.bounds.right) for lanelet in lanelets],
        crs=crs,
    )


def _centre(bounds: Mended) -> LineString:
    n = slices(bounds.left, bounds.right)
    left, right = rungs(bounds.left, bounds.right, n)
    return LineString((left + right) / 2.0)


def _speed_limit(osm: OsmMap, relation: Relation) -> float:
    """Return the limit in km/h, NaN if unknown; a regulatory element overrides the tag."""
    regulated = regulated_kmh(osm, relation)
    return kmh(relation.tags.get("speed_limit", "")) if math.isnan(regulated) else regulated


def _successors(lanelets: Iterable[_Lanelet]) -> dict[int, tuple[int, ...]]:
    """Return the successors of each lanelet: those whose two start nodes are its end nodes."""
    starting: dict[tuple[int, int], list[int]] = defaultdict(list)
    for lanelet in lanelets:
        starting[lanelet.start].append(lanelet.id)
    return {lanelet.id: tuple(starting.get(lanelet.end, ())) for lanelet in lanelets}


def problem_table(problems: Sequence[_Problem], crs: CRS) -> gpd.GeoDataFrame:
    """Return problems as a table, which may be empty."""
    return gpd.GeoDataFrame(
        {
            "lanelet_id": np.array([problem.id for problem in problems], dtype=np.int64),
            "action": np.array([problem.action for problem in problems], object),
            "reason": np.array([problem.reason for problem in problems], object),
        },
        geometry=[problem.shape for problem in problems],
        crs=crs,
    )


def _remarks(osm: OsmMap, problems: list[_Problem]) -> tuple[str, ...]:
    """Return remarks on skipped elements, and how many lanelets have problems."""
    areas = sum(relation.type in {"multipolygon", "area"} for relation in osm.relations.values())
    skipped = {
        "areas skipped": areas,
        "elements skipped whose id had been used before": len(osm.duplicates),
    }
    remarks = [Text("{}: {}", what, count) for what, count in skipped.items() if count]
    for action in (REPAIRED, LEFT_OUT, DOUBTFUL):
        count = sum(problem.action == action for problem in problems)
        if count:
            remarks.append(
                Text("{} lanelets {}, see layer problems of the tiles", count, Text(action))
                if count > 1
                else Text("{} lanelet {}, see layer problems of the tiles", count, Text(action))
            )
    return tuple(remarks)


@dataclass(frozen=True, kw_only=True)
class Chain:
    """One bound as drawn.

    Parameters
    ----------
    nodes : tuple of int
        Node ids in the order of `points`; only nodes with a position.
    points : (n, 3) array
        Positions in metres; heights may be NaN.
    repairs : tuple of str
        Description of what was dropped.
    """

    nodes: tuple[int, ...]
    points: Floats
    repairs: tuple[str, ...]

    def reversed(self) -> Chain:
        """Return the same bound the other way round."""
        return Chain(nodes=self.nodes[::-1], points=self.points[::-1], repairs=self.repairs)


def chain_of(osm: OsmMap, ways: tuple[int, ...], xyz: Floats, side: str) -> Chain:
    """Return the ways of a bound joined to one line, with the positions of its nodes.

    Parameters
    ----------
    osm : OsmMap
        The map as read.
    ways : tuple of int
        Ids of the ways with the role of this bound, in any order and direction.
    xyz : (n, 3) array
        Positions of the map's nodes, NaN where unusable.
    side : str
        `left` or `right`, for messages.

    Returns
    -------
    Chain
        Nodes and points of the bound, in the direction of the first way.

    Raises
    ------
    CannotMendError
        If the bound is missing, its ways form no chain, or under two usable points are left.
    """
    if not ways:
        raise CannotMendError(Text("the {} bound is missing", Text(side)))
    absent = [way for way in ways if way not in osm.ways]
    if absent:
        raise CannotMendError(
            Text("the {} bound is missing: way {} is not in the file", Text(side), absent[0])
        )
    nodes = joined([osm.ways[way].nodes for way in dict.fromkeys(ways)])
    if nodes is None:
        raise CannotMendError(Text("the ways of the {} bound do not form a chain", Text(side)))
    rows = np.array([osm.node_index.get(node, -1) for node in nodes], dtype=np.int64)
    usable = rows >= 0
    usable[usable] = np.isfinite(xyz[rows[usable], :2]).all(axis=1)
    points = xyz[rows[usable]]
    lost = len(nodes) - int(usable.sum())
    if len(points) < 2 or len(without_repeats(points)) < 2:
        why = (
            Text("{} of its {} nodes are missing", lost, len(nodes))
            if lost
            else Text("it has not two distinct points")
        )
        raise CannotMendError(Text("the {} bound has no length: {}", Text(side), why))
    lost_nodes = Text(
        "{} of {} nodes of the {} bound are missing or have no position",
        lost,
        len(nodes),
        Text(side),
    )
    kept = tuple(node for node, here in zip(nodes, usable, strict=True) if here)
    return Chain(nodes=kept, points=points, repairs=(lost_nodes,) if lost else ())


def joined(ways: list[tuple[int, ...]]) -> tuple[int, ...] | None:
    """Return the nodes of ways joined at common end nodes; None if they are not one chain."""
    chain, *rest = [list(way) for way in ways if way] or [[]]
    while rest:
        for i, way in enumerate(rest):
            longer = _chain_with(chain, way)
            if longer is not None:
                chain = longer
                del rest[i]
                break
        else:
            return None
    return tuple(chain)


def _chain_with(chain: list[int], way: list[int]) -> list[int] | None:
    """Return the chain with a way attached, reversed if needed; None if they share no end."""
    if chain[-1] in {way[0], way[-1]}:
        return chain + (way if way[0] == chain[-1] else way[::-1])[1:]
    if chain[0] in {way[0], way[-1]}:
        return (way if way[-1] == chain[0] else way[::-1])[:-1] + chain
    return None


def heights_filled(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return two parallel bounds without gaps in their heights.

    A gap is interpolated along its bound; a bound without any height takes those of the other. If
    neither has one, both are returned without heights.
    """
    known = [bool(np.isfinite(bound[:, 2]).any()) for bound in (left, right)]
    if not any(known):
        return left[:, :2], right[:, :2]
    left, right = (_interpolated(b) if k else b for b, k in zip((left, right), known, strict=True))
    if not known[0]:
        left = _with_heights_of(left, right)
    if not known[1]:
        right = _with_heights_of(right, left)
    return left, right


def _interpolated(bound: Floats) -> Floats:
    """Return a bound whose missing heights are interpolated along it."""
    given = np.isfinite(bound[:, 2])
    if given.all():
        return bound
    along = arc_lengths(bound)
    heights = np.interp(along, along[given], bound[given, 2])
    return np.column_stack([bound[:, :2], heights])


def _with_heights_of(bound: Floats, other: Floats) -> Floats:
    along = arc_lengths(bound)
    heights = at_fractions(other, along / along[-1])[:, 2]
    return np.column_stack([bound[:, :2], heights])

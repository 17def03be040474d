"""Files for Eclipse SUMO, whose edges are our lanes, or those of a network under them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, SubElement, iterparse

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from gis_radar.base import Floats, InputError, Integers, NoAnswerError
from gis_radar.measures import LaneNetwork
from gis_radar.products.results_folder import write_xml

# A lane lies on the lane of a network that is nearest, and leads the same way, at most of the
# places about its counting line: not across. Farther beside it is one that the network lacks.
_ON_M, _BESIDE_M, _SAME_COS, _MOST = 2.0, 5.0, 0.7, 0.5
_AROUND_M, _STEP_M = 15.0, 3.0
_LEAST_STEPS = 3  # on an edge on which a lane begins or ends
_NO_CARS = {
    "pedestrian", "wheelchair", "bicycle", "scooter", "ship", "subway", "tram", "cable_car",
    "rail", "rail_urban", "rail_electric", "rail_fast",
}  # fmt: skip
# What an attribute of an edge is of those of its lanes.
_SUM, _MEAN, _BY_FLOW = "sum", "mean", "mean by flow"
_AS_LONG = 0.1  # share by which lengths differ of lanes whose travel times are the same
_ATTRIBUTES = {
    "entered": ("volume", 1.0, _SUM),
    "speed": ("speed_kmh", 1 / 3.6, _BY_FLOW),
    "occupancy": ("occupancy", 100.0, _MEAN),
    "density": ("density_veh_km", 1.0, _SUM),
    "traveltime": ("travel_time_s", 1.0, _BY_FLOW),
    "timeLoss": ("lost_s", 1.0, _SUM),  # of all vehicles together
}


def read_sumo_network(path: str | Path) -> gpd.GeoDataFrame:
    """Read the lanes of a network for cars or buses, without those inside of junctions.

    Parameters
    ----------
    path : str or Path
        A network of SUMO (`.net.xml`) with a projection.

    Returns
    -------
    GeoDataFrame
        `edge` and `sumo_lane` (their names), and the line, in the network's projection.

    Raises
    ------
    InputError
        If it cannot be read, is no network, or has no projection.
    """
    try:
        found = [*_elements(Path(path))]
    except OSError as error:
        raise InputError("{}: cannot be read: {}", path, error.strerror or error) from error
    except (ParseError, ValueError, CRSError) as error:
        raise InputError("{}: no network of SUMO: {}", path, error) from error
    crs, offset, lanes = None, np.zeros(2), []
    for kind, *values in found:
        if kind == "location":
            crs, offset = values
        else:
            lanes.append(values)
    if not lanes:
        raise InputError("{}: no network of SUMO: it has no lanes", path)
    if crs is None:
        raise InputError(
            "{}: the network has no projection",
            path,
            hint="netconvert writes it by its option proj.utm",
        )
    edge, name, line = zip(*lanes, strict=True)
    geometry = [shapely.LineString(each - offset) for each in line]
    return gpd.GeoDataFrame({"edge": edge, "sumo_lane": name}, geometry=geometry, crs=crs)


def _elements(path: Path) -> Iterator[tuple[Any, ...]]:
    """Yield the location of a network (CRS, offset), and its lanes (edge, name, places)."""
    edge: str | None = None
    with path.open("rb") as file:
        # expat bounds what entities expand to, and reads no other file
        for event, element in iterparse(file, events=("start", "end")):  # noqa: S314
            if event == "end":
                element.clear()
            elif element.tag == "location":
                projection = element.get("projParameter", "!")
                offset = [float(each) for each in element.get("netOffset", "0,0").split(",")]
                yield (
                    "location",
                    None if projection in {"!", "-"} else CRS(projection),
                    np.array(offset),
                )
            elif element.tag == "edge":
                edge = element.get("id") if element.get("function", "normal") == "normal" else None
            elif element.tag == "lane" and edge is not None and _is_for_cars(element):
                places = [each.split(",")[:2] for each in element.get("shape", "").split()]
                if len(places) > 1:
                    yield "lane", edge, element.get("id"), np.array(places, np.float64)


def _is_for_cars(lane: Element) -> bool:
    allowed = set(lane.get("allow", "all").split())
    return bool(allowed - _NO_CARS) and lane.get("disallow") != "all"


def lanes_of_network(
    lanes: gpd.GeoDataFrame, order: LaneNetwork, network: gpd.GeoDataFrame
) -> pd.DataFrame:
    """Return on which lane of a network each lane begins, is counted and ends.

    Parameters
    ----------
    lanes : GeoDataFrame
        The layer `lanes` of a dataset.
    order : LaneNetwork
        Which of them follow each other, and which are connectors: these lie on no edge.
    network : GeoDataFrame
        From :func:`read_sumo_network`.

    Returns
    -------
    DataFrame
        `place` (`begin`, `line` or `end`), `lane`, `edge`, `sumo_lane`; `edge_lanes`, the number
        of lanes of that edge; `as_long`, whether both lanes are of one length; and `counts`: the
        traffic of that lane of the network is that of this lane, which none follows on the edge,
        and beside which none lies on the same lane of the network. Lanes on none have no row, nor
        have those of an edge beside which another one lies that the network lacks.

    Raises
    ------
    NoAnswerError
        If no lane lies on one of the network.
    """
    network = network.to_crs(lanes.crs)
    lanes = lanes[~lanes["lane"].isin(order.lane[order.connector])]
    rows = []
    for number, line, stop_m in zip(
        lanes["lane"], lanes.geometry, lanes["stop_line_m"].astype(np.float64), strict=True
    ):
        for place, k, is_on in _lanes_under(line, stop_m, network):
            rows.append((place, number, *network[["edge", "sumo_lane"]].iloc[k], is_on))
    table = pd.DataFrame(rows, columns=["place", "lane", "edge", "sumo_lane", "is_on"])
    parts = [_that_count(each, order) for _, each in table.groupby("place")]
    if not any("line" in set(each["place"]) for each in parts):
        raise NoAnswerError(
            "no lane of the dataset lies on one of the network: is it of another place or "
            "projection?"
        )
    found = pd.concat(parts, ignore_index=True)
    found["edge_lanes"] = found["edge"].map(network["edge"].value_counts())
    there = found["sumo_lane"].map(network.set_index("sumo_lane").length)
    ours = found["lane"].map(lanes.set_index("lane").length)
    found["as_long"] = (ours / there - 1.0).abs() < _AS_LONG
    return found.drop(columns="is_on")


def _that_count(found: pd.DataFrame, order: LaneNetwork) -> pd.DataFrame:
    """Return the lanes of edges that lack none, and which count for a lane of the network."""
    edge_of = dict(zip(found["lane"], found["edge"], strict=True))
    after = {
        lane: {edge_of.get(order.lane[k]) for k in following}
        for lane, following in zip(order.lane.tolist(), order.after, strict=True)
    }
    last = np.array([edge not in after[lane] for lane, edge in edge_of.items()], bool)
    lacking = found.loc[last & ~found["is_on"], "edge"]
    found = found.assign(counts=last)[found["is_on"] & ~found["edge"].isin(lacking)]
    alone = ~found["sumo_lane"].where(found["counts"]).duplicated(keep=False)
    return found.assign(counts=found["counts"] & alone)


def _lanes_under(
    line: shapely.LineString, stop_m: float, network: gpd.GeoDataFrame
) -> Iterator[tuple[str, int, bool]]:
    """Yield where a line begins, is counted and ends: the network's lane beside it, if it is on."""
    at_m = np.arange(0.0, line.length, _STEP_M)
    row, distance = _nearest(line, at_m, network)
    line_m, end_m = (0.5 * line.length, line.length) if np.isnan(stop_m) else (stop_m, stop_m)
    on_edges = np.flatnonzero((row >= 0) & (at_m <= end_m))
    places = {
        "begin": _first_of_many(row, on_edges),
        "line": np.flatnonzero(np.abs(at_m - line_m) <= _AROUND_M),
        "end": _first_of_many(row, on_edges[::-1]),
    }
    for place, steps in places.items():
        votes = np.bincount(row[steps] + 1, minlength=2)[1:]
        best = int(votes.argmax())
        if votes[best] > _MOST * len(steps):
            on = (row[steps] == best) & (distance[steps] < _ON_M)
            yield place, best, bool(on.sum() > _MOST * len(steps))


def _first_of_many(row: Integers, steps: Integers) -> Integers:
    """Return the first steps on a row that has enough of them."""
    steps = steps[(np.bincount(row[steps], minlength=1) >= _LEAST_STEPS)[row[steps]]]
    first: Integers = steps[row[steps] == row[steps[:1]]][:_LEAST_STEPS]
    return first


def _nearest(
    line: shapely.LineString, at_m: Floats, network: gpd.GeoDataFrame
) -> tuple[Integers, Floats]:
    """Return the nearest lane of a network that leads as a line at places, or -1; how far it is."""
    near, place = network.sindex.query(
        shapely.line_interpolate_point(line, at_m), predicate="dwithin", distance=_BESIDE_M
    )[::-1]
    along = _direction(np.full(len(place), line), at_m[place])
    beside = network.geometry.to_numpy()[near]
    points = shapely.line_interpolate_point(line, at_m[place])
    ahead = _direction(beside, shapely.line_locate_point(beside, points))
    distance = shapely.distance(beside, points)
    distance[(along * ahead).sum(axis=1) <= _SAME_COS] = np.inf
    order = np.lexsort((distance, place))
    first = order[np.diff(place[order], prepend=-1) > 0]
    row, distance_m = np.full(len(at_m), -1), np.full(len(at_m), np.inf)
    row[place[first]] = np.where(np.isfinite(distance[first]), near[first], -1)
    distance_m[place[first]] = distance[first]
    return row, distance_m


def _direction(lines: Any, at_m: Floats) -> Floats:
    """Return the unit vectors of lines at places along them, (n, 2)."""
    length = shapely.length(lines)
    begin = np.clip(at_m - 0.5, 0.0, np.maximum(length - 1.0, 0.0))
    ends = (shapely.line_interpolate_point(lines, begin + way) for way in (0.0, 1.0))
    one, other = (np.column_stack([shapely.get_x(each), shapely.get_y(each)]) for each in ends)
    step = other - one
    unit: Floats = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    return unit


def as_edges(lanes: Iterable[int]) -> pd.DataFrame:
    """Return lanes as edges of their own, as :func:`lanes_of_network` does."""
    lane = pd.Series(sorted(set(lanes)))
    name = lane.astype(str)
    own = pd.DataFrame({"lane": lane, "edge": name, "sumo_lane": name + "_0", "edge_lanes": 1})
    own[["as_long", "counts"]] = True
    return pd.concat([own.assign(place=place) for place in ("begin", "line", "end")])


def write_mean_data(
    lanes: pd.DataFrame, edges: pd.DataFrame, zero: pd.Timestamp, path: Path, *, by_lane: bool
) -> None:
    """Write SUMO's edgeData or laneData, without attributes for unknown values.

    Parameters
    ----------
    lanes : DataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    edges : DataFrame
        From :func:`lanes_of_network` or :func:`as_edges`. A volume, an occupancy, a density or the
        time lost on an edge is known where that of each of its lanes is.
    zero : Timestamp
        Time from which seconds count.
    path : Path
        The file.
    by_lane : bool
        Whether it is laneData.
    """
    root = Element("meandata")
    table = pd.DataFrame(lanes.drop(columns="geometry")).merge(
        edges[edges["counts"] & (edges["place"] == "line")], on="lane"
    )
    if by_lane:
        table["edge_lanes"] = 1
    table = _mean_data(table, ["begin", "end", "edge", "sumo_lane"][: 4 if by_lane else 3])
    for element, rows in _intervals(table, root, zero):
        for name, of_edge in rows.groupby("edge", sort=False):
            edge = SubElement(element, "edge", {"id": str(name)})
            for row in of_edge.to_dict("records"):
                place = SubElement(edge, "lane", {"id": row["sumo_lane"]}) if by_lane else edge
                for attribute in _ATTRIBUTES:
                    if pd.notna(row[attribute]):
                        place.set(attribute, f"{row[attribute]:.2f}")
    write_xml(root, path)


def _mean_data(table: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return the attributes of the lanes with the same keys together."""
    lost_s = (table["delay_s"] * table["volume"]).mask(table["volume"] == 0.0, 0.0)
    table = table.assign(lost_s=lost_s)
    table.loc[~table["as_long"], ["travel_time_s", "lost_s"]] = np.nan
    by = [table[key] for key in keys]
    together = table.groupby(by, sort=False)
    found = pd.DataFrame(index=together.size().index)
    for name, (column, factor, kind) in _ATTRIBUTES.items():
        value = table[column].astype(np.float64) * factor
        weight = table["flow_veh_h"].fillna(0.0) + 1e-9 if kind == _BY_FLOW else 1.0
        weight = pd.Series(weight, table.index).where(value.notna())
        total = (value * weight).groupby(by, sort=False).sum(min_count=1)
        found[name] = total if kind == _SUM else total / weight.groupby(by, sort=False).sum()
        if kind != _BY_FLOW:
            known = value.groupby(by, sort=False).count() == together["edge_lanes"].first()
            found[name] = found[name].where(known)
    return found.reset_index()


def write_turn_counts(
    turns: pd.DataFrame, edges: pd.DataFrame, zero: pd.Timestamp, path: Path
) -> None:
    """Write edge relations, which SUMO's jtrrouter and routeSampler read as turn counts.

    Parameters
    ----------
    turns : DataFrame
        From :meth:`gis_radar.Dataset.turns`. One between two edges is known where those between
        all their lanes are, and a lane lies on each of these.
    edges, zero, path
        As for :func:`write_mean_data`.
    """
    root, table = Element("edgeRelations"), pd.DataFrame(turns.drop(columns="geometry"))
    for way, place in {"from": "end", "to": "begin"}.items():
        there = edges[edges["place"] == place]
        covered = there.groupby("edge")["sumo_lane"].transform("nunique") == there["edge_lanes"]
        table[way] = table[f"{way}_lane"].map(there[covered].set_index("lane")["edge"])
    table = table[table["from"].notna() & table["to"].notna() & (table["from"] != table["to"])]
    keys = ["begin", "end", "from", "to"]
    volumes = table.groupby(keys, sort=False)["volume"].agg(lambda each: each.sum(skipna=False))
    for element, rows in _intervals(volumes.reset_index(), root, zero):
        for row in rows[rows["volume"].notna()].to_dict("records"):
            ends = {"from": row["from"], "to": row["to"]}
            SubElement(element, "edgeRelation", ends | {"count": f"{row['volume']:.2f}"})
    write_xml(root, path)


def _intervals(
    table: pd.DataFrame, root: Element, zero: pd.Timestamp
) -> list[tuple[Element, pd.DataFrame]]:
    """Add an element for each interval, in seconds from `zero`; return it with its rows."""
    intervals = []
    for begin, rows in table.groupby("begin", sort=True):
        edges = (pd.Timestamp(begin), rows["end"].iloc[0])  # type: ignore[arg-type]
        seconds = (f"{(each - zero).total_seconds():.2f}" for each in edges)
        stated = dict(zip(("begin", "end"), seconds, strict=True)) | {"id": edges[0].isoformat()}
        intervals.append((SubElement(root, "interval", stated), rows))
    return intervals

"""Files for Eclipse SUMO, whose edges are our lanes, or those of a network under them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, ParseError, SubElement, indent, iterparse

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from gis_radar.base import Floats, InputError, Integers, NoAnswerError

# A lane lies on the lane of a network that is nearest, and leads the same way, at most of the
# places about its counting line: beside it, not across or on the next one.
_BESIDE_M, _SAME_COS, _MOST = 2.0, 0.7, 0.5
_AROUND_M, _STEP_M = 15.0, 3.0
_NO_CARS = {
    "pedestrian", "bicycle", "ship", "subway", "tram", "cable_car",
    "rail", "rail_urban", "rail_electric", "rail_fast",
}  # fmt: skip
# What an attribute of an edge is of those of its lanes.
_SUM, _MEAN, _BY_FLOW = "sum", "mean", "mean by flow"
_ATTRIBUTES = {
    "entered": ("volume", 1.0, _SUM),
    "speed": ("speed_kmh", 1 / 3.6, _BY_FLOW),
    "occupancy": ("occupancy", 100.0, _MEAN),
    "density": ("density_veh_km", 1.0, _SUM),
    "traveltime": ("travel_time_s", 1.0, _BY_FLOW),
    "timeLoss": ("delay_s", 1.0, _BY_FLOW),
}


def read_sumo_network(path: str | Path) -> gpd.GeoDataFrame:
    """Read the lanes of a network on which cars may drive, without those inside of junctions.

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
                yield "location", None if projection == "!" else CRS(projection), np.array(offset)
            elif element.tag == "edge":
                edge = element.get("id") if element.get("function", "normal") == "normal" else None
            elif element.tag == "lane" and edge is not None and _is_for_cars(element):
                places = [each.split(",")[:2] for each in element.get("shape", "").split()]
                if len(places) > 1:
                    yield "lane", edge, element.get("id"), np.array(places, np.float64)


def _is_for_cars(lane: Element) -> bool:
    allowed = set(lane.get("allow", "all").split())
    return bool(allowed - _NO_CARS) and lane.get("disallow") != "all"


def lanes_of_network(lanes: gpd.GeoDataFrame, network: gpd.GeoDataFrame) -> pd.DataFrame:
    """Return on which lane of a network each lane is counted.

    Parameters
    ----------
    lanes : GeoDataFrame
        The layer `lanes` of a dataset.
    network : GeoDataFrame
        From :func:`read_sumo_network`.

    Returns
    -------
    DataFrame
        `lane`, `edge`, `sumo_lane`, and `edge_lanes`, the number of lanes of that edge. Where
        several lanes follow each other on one lane of the network, it is the last of them; lanes on
        none have no row.

    Raises
    ------
    NoAnswerError
        If no lane lies on one of the network.
    """
    network = network.to_crs(lanes.crs)
    rows = []
    for lane in lanes.itertuples():
        line, line_m = lane.geometry, float(lane.stop_line_m)
        line_m = 0.5 * line.length if np.isnan(line_m) else line_m
        k = _lane_under(line, line_m, network)
        if k >= 0:
            along_m = network.geometry.iloc[k].project(line.interpolate(line_m))
            rows.append((lane.lane, network["edge"].iloc[k], network["sumo_lane"].iloc[k], along_m))
    if not rows:
        raise NoAnswerError(
            "no lane of the dataset lies on one of the network: is it of another place or "
            "projection?"
        )
    found = pd.DataFrame(rows, columns=["lane", "edge", "sumo_lane", "along_m"])
    last = found.sort_values(["along_m", "lane"]).drop_duplicates("sumo_lane", keep="last")
    last["edge_lanes"] = last["edge"].map(network["edge"].value_counts())
    return last.drop(columns="along_m").sort_values("lane", ignore_index=True)


def _lane_under(line: shapely.LineString, line_m: float, network: gpd.GeoDataFrame) -> int:
    """Return the row of the network's lane on which a line lies about its counting line, or -1."""
    first, last = max(line_m - _AROUND_M, 0.0), min(line_m + _AROUND_M, line.length)
    at_m = np.arange(first, last + 1e-6, _STEP_M)
    near, place = network.sindex.query(
        shapely.line_interpolate_point(line, at_m), predicate="dwithin", distance=_BESIDE_M
    )[::-1]
    along = _direction(np.full(len(place), line), at_m[place])
    beside = network.geometry.to_numpy()[near]
    points = shapely.line_interpolate_point(line, at_m[place])
    ahead = _direction(beside, shapely.line_locate_point(beside, points))
    distance = shapely.distance(beside, points)
    same = (along * ahead).sum(axis=1) > _SAME_COS
    near, place = near[same], place[same]
    order = np.lexsort((distance[same], place))
    nearest = order[np.diff(place[order], prepend=-1) > 0]
    votes: Integers = np.bincount(near[nearest], minlength=1)
    best = int(votes.argmax())
    return best if votes[best] > _MOST * len(at_m) else -1


def _direction(lines: Any, at_m: Floats) -> Floats:
    """Return the unit vectors of lines at places along them, (n, 2)."""
    length = shapely.length(lines)
    begin = np.clip(at_m - 0.5, 0.0, np.maximum(length - 1.0, 0.0))
    ends = (shapely.line_interpolate_point(lines, begin + way) for way in (0.0, 1.0))
    one, other = (np.column_stack([shapely.get_x(each), shapely.get_y(each)]) for each in ends)
    step = other - one
    unit: Floats = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    return unit


def as_edges(lanes: pd.DataFrame) -> pd.DataFrame:
    """Return lanes as edges of their own, as :func:`lanes_of_network` does."""
    lane = lanes["lane"].drop_duplicates()
    name = lane.astype(str)
    return pd.DataFrame({"lane": lane, "edge": name, "sumo_lane": name + "_0", "edge_lanes": 1})


def write_mean_data(
    lanes: pd.DataFrame, edges: pd.DataFrame, zero: pd.Timestamp, path: Path, *, by_lane: bool
) -> None:
    """Write SUMO's edgeData or laneData, without attributes for unknown values.

    Parameters
    ----------
    lanes : DataFrame
        From :meth:`gis_radar.Dataset.traffic`.
    edges : DataFrame
        From :func:`lanes_of_network` or :func:`as_edges`. A volume, an occupancy or a density of an
        edge is known where that of each of its lanes is.
    zero : Timestamp
        Time from which seconds count.
    path : Path
        The file.
    by_lane : bool
        Whether it is laneData.
    """
    root = Element("meandata")
    table = pd.DataFrame(lanes.drop(columns="geometry")).merge(edges, on="lane")
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
    _write_xml(root, path)


def _mean_data(table: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return the attributes of the lanes with the same keys together."""
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
        all their lanes are.
    edges, zero, path
        As for :func:`write_mean_data`.
    """
    root, edge_of = Element("edgeRelations"), edges.set_index("lane")["edge"]
    table = pd.DataFrame(turns.drop(columns="geometry"))
    table = table.assign(**{at: table[f"{at}_lane"].map(edge_of) for at in ("from", "to")})
    table = table[table["from"].notna() & table["to"].notna() & (table["from"] != table["to"])]
    keys = ["begin", "end", "from", "to"]
    volumes = table.groupby(keys, sort=False)["volume"].agg(lambda each: each.sum(skipna=False))
    for element, rows in _intervals(volumes.reset_index(), root, zero):
        for row in rows[rows["volume"].notna()].to_dict("records"):
            ends = {"from": row["from"], "to": row["to"]}
            SubElement(element, "edgeRelation", ends | {"count": f"{row['volume']:.2f}"})
    _write_xml(root, path)


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


def _write_xml(root: Element, path: Path) -> None:
    indent(root)
    ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)

"""People: walkers along kerbs and across roads, cyclists at the edge of lanes and on cycle lanes.

They give way to vehicles: walkers cross, and cyclists pass junctions, in gaps of the traffic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from gis_radar.base import STEP_S, Booleans, Floats, Integers
from simulation.curves import arc_length, offset, points_at
from simulation.movement import Traffic
from simulation.network import Band, RoadNetwork

_BODY = {"walker": (0.4, 0.5, 1.75), "cyclist": (1.8, 0.6, 1.75)}  # length, width, height, m
# Mean and standard deviation of speeds: walkers by Weidmann (1993), cyclists assumed for towns.
_PACE_MPS = {"walker": (1.34, 0.26), "cyclist": (5.0, 1.0)}
_PAVEMENT_M = 1.8  # walkers from the edge of the road
_EDGE_M = 0.35  # cyclists from the edge of their lane
_CYCLE_LANE_M = 1.2  # cycle lanes from the edge of the road
_CROSSING_M = 25.0  # wider roads are not crossed at once
_MARGIN_M = 0.6  # between people and vehicles
_PAUSE_S = (4.0, 15.0)  # of walkers before they cross, least and most
_PATIENCE_S = 30  # after which a cyclist goes on in any case


@dataclass(frozen=True, kw_only=True)
class People:
    """Numbers of people.

    Parameters
    ----------
    walkers, cyclists : int
        People at every moment.
    crossing : float
        Share of the walkers that cross a road to and fro; the others go along kerbs.
    cycle_lanes : float
        Share of the cyclists on cycle lanes beside the road.
    reach_m : float
        Distance from the network's middle within which walkers stay.
    """

    walkers: int = 0
    cyclists: int = 0
    crossing: float = 0.25
    cycle_lanes: float = 0.4
    reach_m: float = 80.0


def simulate_people(
    network: RoadNetwork,
    road: shapely.Polygon | shapely.MultiPolygon,
    traffic: Traffic,
    people: People,
    *,
    seed: int,
) -> Traffic:
    """Return the movement of people among the traffic, over the same time.

    Parameters
    ----------
    network : RoadNetwork
        The lanes.
    road : Polygon or MultiPolygon
        The surface of the road.
    traffic : Traffic
        The vehicles.
    people : People
        Numbers of people.
    seed : int
        Seed of all random numbers.
    """
    rng = np.random.default_rng([seed, 7])
    middle = np.mean([band.centre.mean(axis=0) for band in network.bands.values()], axis=0)
    disc = shapely.Point(middle).buffer(people.reach_m)
    kerbs = _lines_in(shapely.boundary(road.buffer(_PAVEMENT_M)), disc)
    crossings = _crossings(network, road, disc)
    ways = []
    for _ in range(people.walkers):
        pace = _pace("walker", rng)
        if crossings and rng.random() < people.crossing:
            line = crossings[int(rng.integers(len(crossings)))]
            ways.append(("walker", _across(line, pace, traffic, rng)))
        else:
            lengths = np.array([arc_length(line)[-1] for line in kerbs])
            line = kerbs[int(rng.choice(len(kerbs), p=lengths / lengths.sum()))]
            ways.append(("walker", _to_and_fro(line, pace, len(traffic.speed), rng)))
    for _ in range(people.cyclists):
        aside = _CYCLE_LANE_M if rng.random() < people.cycle_lanes else -_EDGE_M
        ways += [("cyclist", way) for way in _rides(network, aside, traffic, rng)]
    return _moved(ways, traffic)


def _pace(kind: str, rng: np.random.Generator) -> float:
    mean, spread = _PACE_MPS[kind]
    return float(np.clip(rng.normal(mean, spread), mean - 2 * spread, mean + 2 * spread))


def _lines_in(lines: shapely.Geometry, disc: shapely.Polygon) -> list[Floats]:
    """Return the parts of lines inside a disc that are over 10 m long, a point every metre."""
    parts = shapely.get_parts(shapely.line_merge(shapely.intersection(lines, disc)))
    long = [part for part in parts if part.length > 10.0]
    return [shapely.get_coordinates(shapely.segmentize(part, 1.0)) for part in long]


def _crossings(network: RoadNetwork, road: shapely.Geometry, disc: shapely.Polygon) -> list[Floats]:
    """Return straight lines across the road, from pavement to pavement, near the ends of lanes."""
    found, walked = [], shapely.buffer(road, _PAVEMENT_M)
    for lane in network.lanes.values():
        place, before = points_at(lane.centre, arc_length(lane.centre)[-1] - np.array([4.0, 5.0]))
        if lane.index != 0 or not shapely.contains_xy(disc, *place):
            continue
        ahead = place - before
        across = np.array([-ahead[1], ahead[0]]) / np.hypot(*ahead)
        ray = shapely.LineString([place - _CROSSING_M * across, place + _CROSSING_M * across])
        parts = shapely.get_parts(shapely.intersection(ray, walked))
        here = shapely.distance(parts, shapely.Point(place)) < 1e-6
        short = shapely.length(parts) < _CROSSING_M
        found += [shapely.get_coordinates(part) for part in parts[here & short]]
    return found


def _to_and_fro(line: Floats, pace: float, steps: int, rng: np.random.Generator) -> Floats:
    """Return the places by step of a walker who goes along a line and back."""
    length = arc_length(line)[-1]
    s = (rng.uniform(0.0, 2.0 * length) + pace * STEP_S * np.arange(steps)) % (2.0 * length)
    return points_at(line, np.minimum(s, 2.0 * length - s))


def _across(line: Floats, pace: float, traffic: Traffic, rng: np.random.Generator) -> Floats:
    """Return the places by step of a walker who crosses a road in gaps of the traffic."""
    steps = len(traffic.speed)
    length = arc_length(line)[-1]
    need = int(np.ceil(length / pace / STEP_S))
    busy = np.cumsum(np.append(0, _on_line(line, traffic)))
    s, here, step = np.empty(steps), 0.0, 0
    while step < steps:
        pause = int(rng.uniform(*_PAUSE_S) / STEP_S)
        last = np.minimum(np.arange(steps) + need, steps)
        free = np.flatnonzero((busy[last] == busy[:steps]) & (np.arange(steps) >= step + pause))
        go = int(free[0]) if len(free) else steps
        s[step:go] = here
        done = min(go + need, steps)
        walked = np.minimum(np.arange(1, done - go + 1) * pace * STEP_S, length)
        s[go:done] = walked if here == 0.0 else length - walked
        here, step = length - here, done
    return points_at(line, s)


def _on_line(line: Floats, traffic: Traffic) -> Booleans:
    """Return at which steps a vehicle is on a line."""
    share = np.linspace(-0.5, 0.5, 7)[:, None, None] * traffic.size[:, 0]
    axis = np.stack([np.cos(traffic.heading), np.sin(traffic.heading)], axis=-1)
    way = (line[-1] - line[0]) / np.hypot(*(line[-1] - line[0]))
    hit = np.zeros(traffic.speed.shape, dtype=bool)
    for part in share:
        gap = traffic.centre + part[..., None] * axis - line[0]
        along = gap @ way
        beside = np.abs(gap[..., 0] * way[1] - gap[..., 1] * way[0])
        inside = (along > -_MARGIN_M) & (along < arc_length(line)[-1] + _MARGIN_M)
        hit |= inside & (beside < traffic.size[:, 1] / 2.0 + 2.0 * _MARGIN_M)
    return np.asarray(hit.any(axis=1))


def _rides(
    network: RoadNetwork, aside_m: float, traffic: Traffic, rng: np.random.Generator
) -> list[Floats]:
    """Return the places by step of cyclists one after the other; the first is on its way."""
    rides, begin, steps = [], 0, len(traffic.speed)
    while begin < steps:
        line, joints = _ride_line(network, aside_m, rng)
        length = arc_length(line)[-1]
        s = float(rng.uniform(0.0, 0.7 * length)) if begin == 0 else 0.0
        pace = _pace("cyclist", rng)
        way = np.full((steps, 2), np.nan)
        step = begin
        for stop in [*joints[(joints > s + 1.0) & (joints < length - 1.0)], length]:
            step += _wait(line, s, float(stop), pace, traffic, step, way)
            count = int(np.ceil((stop - s) / (pace * STEP_S)))
            end = min(step + count, steps)
            way[step:end] = points_at(line, s + pace * STEP_S * np.arange(float(end - step)))
            s, step = s + pace * STEP_S * count, end
            if step >= steps:
                break
        rides.append(way)
        begin = max(step, begin + 1)
    return rides


def _wait(
    line: Floats, s: float, stop: float, pace: float, traffic: Traffic, step: int, way: Floats
) -> int:
    """Return for how many steps a cyclist waits before a stretch, and write its place to `way`."""
    steps = len(traffic.speed)
    ahead = points_at(line, s + np.arange(0.0, min(stop - s, 30.0), pace * STEP_S))
    per_s = round(1.0 / STEP_S)
    for waited in range(0, _PATIENCE_S * per_s, per_s):
        rows = np.minimum(step + waited + np.arange(len(ahead)), steps - 1)
        if not _touched(ahead, rows, traffic).any():
            break
    way[step : min(step + waited, steps)] = ahead[0]
    return waited


def _touched(places: Floats, rows: Integers, traffic: Traffic) -> Booleans:
    """Return at which steps (`rows`) a vehicle overlaps a cyclist at `places`."""
    gap = places[:, None] - traffic.centre[rows]
    cos, sin = np.cos(traffic.heading[rows]), np.sin(traffic.heading[rows])
    along = np.abs(gap[..., 0] * cos + gap[..., 1] * sin)
    aside = np.abs(gap[..., 1] * cos - gap[..., 0] * sin)
    half = traffic.size[:, :2] / 2.0 + [1.0 + _MARGIN_M, 0.3]
    return np.asarray(((along < half[:, 0]) & (aside < half[:, 1])).any(axis=1))


def _ride_line(
    network: RoadNetwork, aside_m: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Draw a route through the network; return its line, and where on it turns begin and end."""
    begins = [f"{edge}_0" for edge in network.sources() if f"{edge}_0" in network.lanes]
    lane = network.lanes[begins[int(rng.integers(len(begins)))]]
    bands: list[Band] = [lane]
    for _ in range(30):
        turns = [t for t in network.turns.values() if t.source == lane.id]
        if not turns:
            break
        right = [t for t in turns if network.lanes[t.target].index == 0]
        chosen = (right or turns)[int(rng.integers(len(right or turns)))]
        lane = network.lanes[chosen.target]
        bands += [chosen, lane]
    lines = [_right_of(band, aside_m) for band in bands]
    ends = np.cumsum([arc_length(line)[-1] for line in lines])
    return np.vstack(lines), np.asarray(ends[:-1])


def _right_of(band: Band, aside_m: float) -> Floats:
    """Return the right bound of a band, moved to the right; never left of its centre line."""
    half = np.hypot(*(band.left - band.right).T) / 2.0
    return offset(band.centre, -np.maximum(half + aside_m, 0.0))


def _moved(ways: list[tuple[str, Floats]], traffic: Traffic) -> Traffic:
    """Return places by step as traffic; a person who stands keeps the last heading."""
    steps = len(traffic.speed)
    centre = np.full((steps, len(ways), 2), np.nan)
    heading = np.full((steps, len(ways)), np.nan)
    speed, yaw_rate = heading.copy(), heading.copy()
    for column, (_, way) in enumerate(ways):
        rows = np.flatnonzero(np.isfinite(way[:, 0]))
        if len(rows) < 2:
            continue
        move = np.gradient(way[rows], STEP_S, axis=0)
        pace = np.hypot(*move.T)
        goes = np.maximum.accumulate(np.where(pace > 0.05, np.arange(len(rows)), 0))
        turned = np.unwrap(np.arctan2(*move[goes].T[::-1]))
        centre[rows, column], heading[rows, column] = way[rows], turned
        speed[rows, column] = pace
        yaw_rate[rows, column] = np.clip(np.gradient(turned, STEP_S), -1.0, 1.0)
    return Traffic(
        start=traffic.start,
        centre=centre,
        heading=heading,
        speed=speed,
        yaw_rate=yaw_rate,
        size=np.array([_BODY[kind] for kind, _ in ways]).reshape(-1, 3),
        kind=tuple(kind for kind, _ in ways),
    )

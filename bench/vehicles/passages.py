"""True passages: which lanelets each vehicle follows, and when its front passes their middles.

The route is the chain of lanelets with the least cost (Viterbi algorithm). A lanelet costs more the
farther the front is from its centre line and the more the heading differs; a change to a lanelet
that does not follow costs extra.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from true_occupancy import TrueOccupancy, middle_lines
from true_traffic import HEAVY_M, TrueTraffic

import gis_radar as gr
from gis_radar.base import Floats, Integers
from gis_radar.hdmap import quads

LOOK_EVERY_M = 1.0  # distance along the route between looks at the vehicle
ACROSS_SIGMA_M, HEADING_SIGMA_RAD = 0.8, 0.35  # of fronts from the centre line of their lanelet
NEAR_M, MOST_TURNED_RAD = 3.5, 1.0  # of tiles that a front may be on
OTHER_COST, BESIDE_COST = 30.0, 12.0  # of a change to a lanelet that does not follow, or is beside
JOINED_M = 0.5  # from the end of a lanelet to the begin of the next, at most
WITHIN_STEPS = 20  # between a true and an estimated passage that agree: 1 s


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Lanelets as tiles.

    Parameters
    ----------
    lanelet : Integers
        Lanelet of each tile.
    index, tile_id : Integers
        Index in its lanelet, and id of each tile.
    middle : Floats
        Middles of the tiles, (n, 2), metres.
    heading : Floats
        Heading of the lanelet at each tile, rad.
    width : Floats
        Width of each tile, metres.
    half : dict
        By lanelet, the index of its middle tile.
    follows : set of (int, int)
        Pairs of a lanelet and a successor.
    """

    lanelet: Integers
    index: Integers
    tile_id: Integers
    middle: Floats = field(repr=False)
    heading: Floats = field(repr=False)
    width: Floats = field(repr=False)
    half: dict[int, int] = field(repr=False)
    follows: set[tuple[int, int]] = field(repr=False)


def lanes_of(tiles: gpd.GeoDataFrame, roads: gr.LaneletMap) -> Lanes:
    """Return the lanelets of a map as tiles."""
    lines = middle_lines(tiles)
    across = lines[:, 1] - lines[:, 0]
    count = tiles.groupby("lanelet_id")["index"].max() + 1
    table = zip(roads.lanelets["lanelet_id"], roads.lanelets["successors"], strict=True)
    follows = {(int(a), int(b)) for a, after in table for b in after} | joined(tiles)
    return Lanes(
        lanelet=tiles["lanelet_id"].to_numpy(np.int64),
        index=tiles["index"].to_numpy(np.int64),
        tile_id=tiles["tile_id"].to_numpy(np.int64),
        middle=lines.mean(axis=1),
        heading=np.arctan2(-across[:, 0], across[:, 1]),
        width=np.hypot(*across.T),
        half={int(k): int(n) // 2 for k, n in count.items()},
        follows=follows,
    )


def joined(tiles: gpd.GeoDataFrame) -> set[tuple[int, int]]:
    """Return pairs of a lanelet and one that begins where it ends, with or without shared nodes."""
    right0, right1, left1, left0 = np.moveaxis(quads(tiles), 1, 0)
    begin, end = (right0 + left0) / 2.0, (right1 + left1) / 2.0
    lanelet, index = tiles["lanelet_id"].to_numpy(), tiles["index"].to_numpy()
    last = np.flatnonzero(index == tiles.groupby("lanelet_id")["index"].transform("max"))
    first = np.flatnonzero(index == 0)
    heading = np.arctan2(*(end - begin).T[::-1])
    pairs = set()
    for row, near in zip(
        last, cKDTree(begin[first]).query_ball_point(end[last], JOINED_M), strict=True
    ):
        for other in first[near]:
            turn = (heading[other] - heading[row] + np.pi) % (2.0 * np.pi) - np.pi
            if abs(turn) < HEADING_SIGMA_RAD and lanelet[other] != lanelet[row]:
                pairs.add((int(lanelet[row]), int(lanelet[other])))
    return pairs


def true_passages(lanes: Lanes, traffic: TrueTraffic, truth: TrueOccupancy) -> pd.DataFrame:
    """Return the visible passages: ``vehicle lanelet_id step speed heavy``."""
    tree, rows = cKDTree(lanes.middle), []
    sight = {t: k for k, t in enumerate(truth.tile_id.tolist())}
    last = truth.first_step + truth.occupied.shape[1] - 1
    traffic = traffic.within(truth.first_step, last)
    at_half = {
        int(k): int(t)
        for k, i, t in zip(lanes.lanelet, lanes.index, lanes.tile_id, strict=True)
        if lanes.half[int(k)] == i
    }
    for vehicle, states in traffic.states.groupby("vehicle"):
        heavy = bool(states["length"].iloc[0] > HEAVY_M)
        for lanelet, row in way_of(lanes, tree, states):
            step = int(states["step"].iloc[row])
            tile = sight.get(at_half[lanelet])
            if tile is not None and truth.visible[tile, step - truth.first_step]:
                rows.append((vehicle, lanelet, step, float(states["speed"].iloc[row]), heavy))
    return pd.DataFrame(rows, columns=["vehicle", "lanelet_id", "step", "speed", "heavy"])


def way_of(lanes: Lanes, tree: cKDTree, states: pd.DataFrame) -> list[tuple[int, int]]:
    """Return the lanelets whose middles a vehicle passes, each with the row of its states."""
    front = states[["front_e", "front_n"]].to_numpy()
    rows, chain = followed(lanes, tree, front, states["heading"].to_numpy())
    passed = []
    for before, after in zip(range(len(chain) - 1), range(1, len(chain)), strict=True):
        (one, index), (other, later) = chain[before], chain[after]
        half = lanes.half[other]
        if later >= half and ((one == other and index < half) or (one != other)):
            at = rows[before] + 1 + _first_past(lanes, other, front[rows[before] + 1 : rows[after]])
            if one == other or _entered_before(index, one, other, lanes):
                passed.append((other, int(at)))
    return passed


def followed(
    lanes: Lanes, tree: cKDTree, front: Floats, heading: Floats
) -> tuple[Integers, list[tuple[int, int]]]:
    """Return the rows at which the route is known, and (lanelet, tile index) at each."""
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(front, axis=0).T))])
    looks = np.unique(
        np.searchsorted(driven, np.arange(0.0, driven[-1] + LOOK_EVERY_M, LOOK_EVERY_M))
    )
    looks = looks[looks < len(front)]
    options = [_options(lanes, tree, front[k], heading[k]) for k in looks]
    kept = [k for k, found in enumerate(options) if found]
    return looks[kept], _likeliest(lanes, [options[k] for k in kept]) if kept else []


def _entered_before(index: int, one: int, other: int, lanes: Lanes) -> bool:
    """Return whether a vehicle that enters a lanelet beyond its middle passes that middle.

    It does if it comes from a predecessor, or from the first half of a lanelet beside it.
    """
    return (one, other) in lanes.follows or index < lanes.half[one]


def _first_past(lanes: Lanes, lanelet: int, points: Floats) -> int:
    """Return how many points lie before the middle of a lanelet."""
    tile = np.flatnonzero((lanes.lanelet == lanelet) & (lanes.index == lanes.half[lanelet]))[0]
    turn = lanes.heading[tile]
    along = (points - lanes.middle[tile]) @ np.array([np.cos(turn), np.sin(turn)])
    return int((along < -0.25).sum())


def _options(
    lanes: Lanes, tree: cKDTree, place: Floats, heading: float
) -> dict[int, tuple[int, float]]:
    """Return the lanelets that a front may be on: index of the nearest tile, and the cost."""
    found: dict[int, tuple[int, float]] = {}
    near = np.array(tree.query_ball_point(place, NEAR_M), np.int64)
    if len(near) == 0:
        return found
    turn = (lanes.heading[near] - heading + np.pi) % (2.0 * np.pi) - np.pi
    away = place - lanes.middle[near]
    cos, sin = np.cos(lanes.heading[near]), np.sin(lanes.heading[near])
    along, across = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
    good = (np.abs(turn) < MOST_TURNED_RAD) & (np.abs(along) < 0.6)
    good &= np.abs(across) < lanes.width[near] / 2.0 + 1.0
    cost = (across / ACROSS_SIGMA_M) ** 2 / 2.0 + (turn / HEADING_SIGMA_RAD) ** 2 / 2.0
    for k in np.flatnonzero(good)[np.argsort(-cost[good])]:
        found[int(lanes.lanelet[near[k]])] = (int(lanes.index[near[k]]), float(cost[k]))
    return found


def _likeliest(lanes: Lanes, options: list[dict[int, tuple[int, float]]]) -> list[tuple[int, int]]:
    """Return the chain of (lanelet, tile index) with the least cost."""
    best = {k: cost for k, (_, cost) in options[0].items()}
    come: list[dict[int, int]] = []
    for now in options[1:]:
        step, source = {}, {}
        for lanelet, (_, cost) in now.items():
            costs = {b: past + _change_cost(lanes, b, lanelet, now) for b, past in best.items()}
            source[lanelet] = min(costs, key=lambda k: costs[k])
            step[lanelet] = costs[source[lanelet]] + cost
        best, come = step, [*come, source]
    lanelet = min(best, key=lambda k: best[k])
    chain = [lanelet]
    for source in reversed(come):
        chain.append(source[chain[-1]])
    return [(k, found[k][0]) for k, found in zip(chain[::-1], options, strict=True)]


def _change_cost(lanes: Lanes, one: int, other: int, now: dict[int, tuple[int, float]]) -> float:
    """Return the cost of a change from one lanelet to another."""
    if one == other or (one, other) in lanes.follows:
        return 0.0
    return BESIDE_COST if one in now else OTHER_COST


def score_passages(true: pd.DataFrame, given: pd.DataFrame) -> dict[str, float]:
    """Return errors of the counts by lanelet, and the shares of passages within 1 s of a true one.

    Parameters
    ----------
    true, given : DataFrame
        ``lanelet_id step``.
    """
    counts = pd.concat(
        {"true": true["lanelet_id"].value_counts(), "given": given["lanelet_id"].value_counts()},
        axis=1,
    ).fillna(0.0)
    hits = 0
    for lanelet, steps in true.groupby("lanelet_id")["step"]:
        others = given.loc[given["lanelet_id"] == lanelet, "step"]
        hits += _pairs(np.sort(steps.to_numpy()), np.sort(others.to_numpy()))
    total = max(len(true), 1)
    return {
        "passages": len(true),
        "count_bias": (len(given) - len(true)) / total,
        "count_error": float((counts["given"] - counts["true"]).abs().sum()) / total,
        "passages_recall": hits / total,
        "passages_precision": hits / max(len(given), 1),
    }


def _pairs(one: Integers, other: Integers) -> int:
    """Return the number of pairs of two ascending lists of steps that are within a second."""
    count = at = 0
    for step in one:
        while at < len(other) and other[at] < step - WITHIN_STEPS:
            at += 1
        if at < len(other) and other[at] <= step + WITHIN_STEPS:
            count, at = count + 1, at + 1
    return count

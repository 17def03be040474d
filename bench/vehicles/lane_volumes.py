"""Volumes, speeds, turns and queues of lanes by minute, beside the true ones.

True crossings of counting lines follow from the likeliest chain of lanelets of each true vehicle
(`passages.py`), apart from the package. Only lanes count whose counting line lies within 100 m of a
radar, and minutes in which they are visible for a fifth.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
import shapely
from passages import Lanes, followed, lanes_of
from scenes import SceneFiles
from scipy.spatial import cKDTree

import gis_radar as gr
from gis_radar.base import Floats, Integers, step_begin
from gis_radar.dataset import LaneTraffic
from gis_radar.measures import LaneNetwork

WITHIN_M = 100.0  # of a radar, for which accuracy is stated
LEAST_SHARE = 0.2  # of a minute in which a lane is visible, for it to count
WHOLE_SHARE = 0.95  # the same, for volumes and queues
QUEUE_M = 7.5  # target for the error of a queue's back: a vehicle and its gap
CYCLE_S, CYCLE_ERROR_S = 60.0, 2.0  # of simulated signals; error of a right one, at most
# The definition of a queue: speed and time of standing, gap to the next, front past the line.
SLOW_MPS, SLOW_STEPS, MOST_GAP_M, PAST_LINE_M = 5.0 / 3.6, 20, 10.0, 2.0


def score(site: SceneFiles, dataset: gr.Dataset) -> dict[str, str]:
    """Return the errors of lanes and turns as texts by name."""
    network = network_of(dataset)
    true = true_crossings(site, network)
    near = network.lane[lanes_near_radars(site, network)]
    lanes = minutes(dataset, near, true)
    count, speed = lanes["true"], lanes["true_speed"]
    # vehicles that pass in a part of the minute that was not recorded cannot be counted
    whole = lanes["visible_share"] > WHOLE_SHARE
    error = (lanes["volume"] - count)[whole]
    spread = lanes["volume_se"][whole]
    by_lane = lanes[whole].assign(true=count[whole]).groupby("lane")[["volume", "true"]].sum()
    off = (by_lane["volume"] - by_lane["true"]).abs().sum()
    both = whole & (lanes["counted"] > 0) & (count > 0)
    faster = lanes["speed_time_mean_kmh"][both] - 3.6 * speed[both]
    turns = dataset.turns("1min")
    turns = turns[turns["from_lane"].isin(near) & (turns["visible_share"] > WHOLE_SHARE)]
    turns = turns.dropna(subset="volume").join(
        by_minute(true[true["to_lane"] >= 0], ["lane", "to_lane"]),
        on=["from_lane", "to_lane", "begin"],
    )
    queues = dataset.queues("1min")
    queues = queues[queues["lane"].isin(near) & (queues["visible_share"] > WHOLE_SHARE)]
    backs = true_backs(site, network)
    keys = zip(queues["lane"], queues["begin"].dt.tz_convert("UTC"), strict=True)
    true_m = np.array([backs.get(key, 0.0) for key in keys])
    # a queue is compared as far as the lane is in sight
    true_m = np.minimum(true_m, queues["sight_m"].to_numpy())
    waits = (true_m > 0.0) | (queues["queue_max_m"] > 0.0).to_numpy()
    backs_m = np.minimum(queues["queue_max_m"], queues["sight_m"]).to_numpy()
    off_m = (backs_m - true_m)[waits]
    pairs = turns.assign(true=turns["true"].fillna(0.0)).groupby(["from_lane", "to_lane"])
    sums = pairs[["volume", "true"]].sum()
    turns_off = (sums["volume"] - sums["true"]).abs().sum()
    return {
        "lanes": f"{len(by_lane)}",
        "true": f"{int(by_lane['true'].sum())}",
        "found": f"{by_lane['volume'].sum():.1f}",
        "off": f"{off / max(by_lane['true'].sum(), 1.0):.1%}",
        "within_2_se": f"{(error.abs() <= 2.0 * spread + 1e-9).mean():.0%} of {len(error)}",
        "speed_off_kmh": f"{faster.abs().mean():.1f} (bias {faster.mean():+.1f})",
        "queues": _queues(off_m),
        "cycles": _cycles(dataset, near),
        "turns": f"{len(sums)}",
        "turns_off": f"{turns_off / sums['true'].sum():.1%}" if len(sums) else "none",
    }


def network_of(dataset: gr.Dataset) -> LaneNetwork:
    """Return the lanes of a dataset."""
    traffic = LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)
    return traffic.network


def minutes(dataset: gr.Dataset, lane: Integers, true: pd.DataFrame) -> pd.DataFrame:
    """Return the measures of some lanes by minute, with the columns `true` and `true_speed`."""
    lanes = dataset.traffic("1min")
    lanes = lanes[lanes["lane"].isin(lane) & (lanes["visible_share"] >= LEAST_SHARE)]
    lanes = lanes.join(by_minute(true, ["lane"]), on=["lane", "begin"])
    return pd.DataFrame(lanes.fillna({"true": 0.0}))


def _queues(off_m: Floats) -> str:
    """Return number and errors of the backs of queues as text; `off_m`: found minus true."""
    if len(off_m) == 0:
        return "none"
    within = np.mean(np.abs(off_m) <= QUEUE_M)
    return (
        f"{len(off_m)}, {within:.0%} within {QUEUE_M} m "
        f"(mean {np.abs(off_m).mean():.1f}, bias {off_m.mean():+.1f})"
    )


def by_minute(true: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return number (`true`) and mean speed (`true_speed`) of crossings by keys and minute."""
    groups = true.assign(begin=true["time"].dt.floor("min")).groupby([*keys, "begin"])["speed"]
    return pd.DataFrame({"true": groups.size(), "true_speed": groups.mean()})


def lanes_near_radars(site: SceneFiles, network: LaneNetwork) -> list[int]:
    """Return the rows of lanes whose counting line lies near a radar and truly in sight."""
    tiles = site.tiles().set_index("tile_id").geometry
    line = network.tile_id[network.tile_at(np.arange(len(network.lane)), network.line_m)]
    eyes = shapely.MultiPoint([pose.position[:2] for pose in site.poses])
    seen = set(site.truth().tile_id.tolist())
    return [
        k for k, tile in enumerate(line.tolist())
        if tile in seen and eyes.distance(tiles[tile].centroid) < WITHIN_M
    ]  # fmt: skip


def true_crossings(site: SceneFiles, network: LaneNetwork) -> pd.DataFrame:
    """Return when fronts cross the lines of lanes: `lane to_lane time speed vehicle`.

    `to_lane` is -1 where the vehicle takes no exit.
    """
    lanes, rows = lanes_of(site.tiles(), gr.read_map(site.map)), []
    tree, truth = cKDTree(lanes.middle), site.truth()
    exits: dict[int, set[int]] = {}
    for turn in network.turns():
        exits.setdefault(turn.start, set()).add(turn.end)
    traffic = site.traffic().within(
        truth.first_step, truth.first_step + truth.occupied.shape[1] - 1
    )
    for vehicle, states in traffic.states.groupby("vehicle"):
        way = lane_way(lanes, tree, states, network)
        seen = set[int]()
        for (row, lane, at), (later, other, reached) in pairwise(way):
            for passed in {lane, other} - seen:
                line = float(network.line_m[passed])
                before = at if lane == passed else reached - (network.length_m[lane] - at) - reached
                after = reached if other == passed else network.length_m[lane] + reached
                if lane != other and other not in network.after[lane]:
                    continue
                if before < line <= after:
                    part = (line - before) / max(after - before, 1e-9)
                    k = round(row + part * (later - row))
                    seen.add(passed)
                    ahead = [each for r, each, _ in way if r >= later]
                    to = next((e for e in ahead if e in exits.get(passed, ())), None)
                    rows.append((
                        int(network.lane[passed]), -1 if to is None else int(network.lane[to]),
                        step_begin(int(states["step"].iloc[k])), float(states["speed"].iloc[k]),
                        vehicle,
                    ))  # fmt: skip
    found = pd.DataFrame(rows, columns=["lane", "to_lane", "time", "speed", "vehicle"])
    return found.assign(time=pd.to_datetime(found["time"], utc=True))


def _cycles(dataset: gr.Dataset, near: Integers) -> str:
    """Return as text for how many stop lines a cycle is found, and is right."""
    found = dataset.signal_cycles()
    length = found[found["lane"].isin(near)].groupby("lane")["cycle_s"].max()
    right = (length - CYCLE_S).abs() <= CYCLE_ERROR_S
    return (
        f"{length.notna().sum()} of {len(length)} told, {right.sum()} within {CYCLE_ERROR_S:.0f} s"
    )


def true_standing(
    site: SceneFiles, network: LaneNetwork
) -> dict[tuple[int, int], list[tuple[float, float]]]:
    """Return the standing vehicles by approach and step: metres from front to line, and lengths.

    An approach (the way along strips to a stop line) is named by its last strip.
    """
    lanes, strips = lanes_of(site.tiles(), gr.read_map(site.map)), network.queue_strips
    places: dict[int, list[tuple[int, float]]] = {}
    for end in np.setdiff1d(np.arange(len(strips.lane)), strips.ahead).tolist():
        for each in strips.path_to(end):
            places.setdefault(int(strips.lane[each]), []).append((end, strips.to_line_m[each]))
    tree, truth = cKDTree(lanes.middle), site.truth()
    last = truth.first_step + truth.occupied.shape[1] - 1
    stand: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for _, states in site.traffic().within(truth.first_step, last).states.groupby("vehicle"):
        way = lane_way(lanes, tree, states, network)
        if not way:
            continue
        rows = np.array([row for row, *_ in way])
        slow = states["speed"].to_numpy() < SLOW_MPS
        for k in np.flatnonzero(states["step"].to_numpy() % 20 == 0).tolist():
            if k < SLOW_STEPS or not slow[k - SLOW_STEPS : k + 1].all() or k < rows[0]:
                continue
            at = int(np.searchsorted(rows, k, side="right")) - 1
            lane, metres = way[at][1:]
            if at + 1 < len(way) and way[at + 1][1] == lane:
                part = (k - rows[at]) / (rows[at + 1] - rows[at])
                metres += part * (way[at + 1][2] - metres)
            for end, to_line in places.get(lane, ()):
                key = (end, int(states["step"].iloc[k]))
                stand.setdefault(key, []).append(
                    (float(to_line) - metres, float(states["length"].iloc[k]))
                )
    return stand


def true_backs(site: SceneFiles, network: LaneNetwork) -> dict[tuple[int, pd.Timestamp], float]:
    """Return the farthest back of the queue, metres, by lane and minute; looked at each second."""
    backs: dict[tuple[int, pd.Timestamp], float] = {}
    for (end, step), fronts in true_standing(site, network).items():
        back = 0.0
        for front, length in sorted(each for each in fronts if each[0] >= -PAST_LINE_M):
            if front - back > MOST_GAP_M:
                break
            back = front + length
        minute = pd.Timestamp(step_begin(step)).floor("min")
        number = int(network.lane[network.queue_strips.stop_lane[end]])
        backs[number, minute] = max(backs.get((number, minute), 0.0), back)
    return backs


def lane_way(
    lanes: Lanes, tree: cKDTree, states: pd.DataFrame, network: LaneNetwork
) -> list[tuple[int, int, float]]:
    """Return (row of the states, row of the lane, metres along it) of a vehicle at every metre."""
    front: Floats = states[["front_e", "front_n"]].to_numpy()
    rows, chain = followed(lanes, tree, front, states["heading"].to_numpy())
    refs = np.array([lanelet for lanelet, _ in chain], np.int64)
    index = np.array([place for _, place in chain], np.float64)
    at, metres = network.place(refs, index * 0.5 + 0.25)
    return list(zip(rows.tolist(), at.tolist(), metres.tolist(), strict=True))

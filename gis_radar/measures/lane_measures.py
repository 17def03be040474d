"""Measures of lanes and turns by interval: volumes, speeds, density, occupancy, delays, queues.

Definitions are Edie's (:mod:`gis_radar.measures.lane_fronts`); those of stops, queues and delay are
from the Highway Capacity Manual (TRB, 7th edition, chapters 4 and 31).

The variance of a volume has three independent sources:

- *counting*: a counted vehicle may not exist, or one may be missing; half of the variance is for
  each of the two;
- *existence*: where the probability p that a vehicle exists is known, p (1 - p) replaces the first
  half;
- *visibility*: if n vehicles are counted in a visible share v of the interval and arrivals are a
  Poisson process, n w / v with variance (n + 1/2) w (v + w) / v^2 come in another share w of it.
  While vehicles hide the line, those count that are followed across it. More may have come, up to
  n w / v, where w is the hidden time in which no vehicle stands at the line. Any number between is
  taken as equally likely: the variance is a third of the squared difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers, quotient
from gis_radar.measures.lane_fronts import Crossings, StepGrid, TrackedLanes, driven
from gis_radar.measures.lane_network import LaneNetwork
from gis_radar.measures.queues import QUEUE_EVERY_STEPS, StandingFronts, blocked_shares, queue_backs

SPEED_CLASS_KMH = 5.0  # width of a class of speeds
SPEED_CLASSES = 40  # up to 200 km/h; the last one is open
# Share of an interval that must be visible for an estimate of the whole: with less, the error is
# that of a guess.
LEAST_VISIBLE_SHARE = 0.2
# Least flow of an interval with a travel time, vehicles in the interval: one that waits in it, and
# drives a part of the lane only, would give a travel time that nobody had.
LEAST_DRIVEN = 1.0
# Standard deviation that a counted vehicle adds: if measured, 5 % do not exist and as many are
# missing; if inferred, 25 % each. Hidden parts of the visible time have the error of inferred
# vehicles, too.
COUNTING_SEEN, COUNTING_INFERRED = 0.3, 0.7
_LEAST_OCCUPIED_S = 0.1  # least error of the occupied time of a tile: two steps


@dataclass(frozen=True, kw_only=True, eq=False)
class TileSteps:
    """Numbers of steps by tile and interval, from the table `tile_counts`.

    Parameters
    ----------
    tile_id, interval : (n,) int64 arrays
        Id of the tile, and number of the interval in the grid.
    visible, hidden, occupied, inferred, variance : (n,) arrays
        Steps visible, steps observed but not visible, steps occupied and visible, steps visible
        although hidden by vehicles, and the variance of the occupied steps, steps^2.
    """

    tile_id: Integers
    interval: Integers
    visible: Floats
    hidden: Floats
    occupied: Floats
    inferred: Floats
    variance: Floats


class Measured(NamedTuple):
    """Columns of `lane_measures` and of `turns`, `interval` as a number of the grid."""

    lanes: dict[str, Any]
    turns: dict[str, Any]


def measure_lanes(lanes: TrackedLanes, tiles: TileSteps) -> Measured:
    """Measure lanes and turns.

    Parameters
    ----------
    lanes : TrackedLanes
        The lanes and all vehicles on them.
    tiles : TileSteps
        Steps of tiles; a lane gets a row for each interval in which one of its tiles has one.
    """
    network, grid, crossed = lanes.network, lanes.grid, lanes.observed_crossings
    areas = _areas(lanes, tiles)
    share = _share_at(lanes.line_tile_id, grid, tiles)
    counts = _Counts.of(lanes.visible_crossings, lanes)
    standing = StandingFronts.of(lanes)
    followed = np.bincount(lanes.cell_of(crossed.lane, crossed.step), minlength=lanes.cells)
    hidden = _Hidden(
        _share_at(lanes.line_tile_id, grid, tiles, "hidden"),
        blocked_shares(standing, lanes),
        followed - counts.counted,
    )
    seconds, metres = driven(lanes)
    most_m, sum_m = queue_backs(standing, lanes)
    columns: dict[str, Any] = _volumes(counts, share, hidden)
    columns |= _speeds(counts, seconds, metres, share)
    columns |= _occupancies(areas)
    columns |= _flows(network, grid, areas, seconds, metres)
    queue_share = _share_at(lanes.queue_tile_id, grid, tiles)
    looks = queue_share * grid.steps / QUEUE_EVERY_STEPS
    stop = np.repeat(np.isfinite(network.queue_line_m), grid.count) & (queue_share > 0.0)
    columns["queue_max_m"] = np.where(stop, most_m, np.nan)
    columns["queue_mean_m"] = np.where(stop, quotient(sum_m, looks), np.nan)
    columns["stops"] = _masked(_stops(lanes), areas.visible_steps == 0.0)
    rows = np.flatnonzero(areas.known)
    table: dict[str, Any] = {
        "lane": network.lane[rows // grid.count],
        "interval": rows % grid.count,
    }
    table |= {name: values[rows] for name, values in columns.items()}
    table["speed_counts"] = _lists(counts.speeds[rows], columns["counted"].mask[rows])
    table["visible_km_h"] = areas.visible_km_h[rows]
    columns["followed"] = followed
    return Measured(table, _turns(lanes, crossed, columns, areas, tiles))


class _Areas(NamedTuple):
    """Sums over the tiles of lanes, by cells of lane and interval."""

    known: Booleans
    visible_steps: Floats
    occupied_steps: Floats
    error_steps: Floats
    visible_km_h: Floats


def _areas(lanes: TrackedLanes, tiles: TileSteps) -> _Areas:
    network, size = lanes.network, lanes.cells
    order = np.argsort(network.tile_id, kind="stable")
    tile = order[np.searchsorted(network.tile_id, tiles.tile_id, sorter=order)]
    cell = network.tile_lane[tile] * lanes.grid.count + tiles.interval
    share = quotient(tiles.occupied, tiles.visible)
    hidden = (COUNTING_INFERRED * tiles.inferred) ** 2 * np.nan_to_num(share * (1 - share))
    least = _LEAST_OCCUPIED_S * STEPS_PER_SECOND
    error = np.where(tiles.visible > 0, np.maximum(np.sqrt(tiles.variance + hidden), least), 0.0)
    metre_hours = tiles.visible * network.tile_length_m[tile] / STEPS_PER_SECOND / 3.6e6
    sums = (
        np.bincount(cell, values, size).astype(np.float64)
        for values in (tiles.visible, tiles.occupied, error, metre_hours)
    )
    return _Areas(np.bincount(cell, minlength=size) > 0, *sums)


def _share_at(tile_id: Integers, grid: StepGrid, tiles: TileSteps, of: str = "visible") -> Floats:
    """Return the share of each interval in a state, for each of some tiles and each interval."""
    wanted, place = np.unique(tile_id, return_inverse=True)
    shares = np.zeros(len(wanted) * grid.count)
    index = np.minimum(np.searchsorted(wanted, tiles.tile_id), max(len(wanted) - 1, 0))
    is_wanted = wanted[index] == tiles.tile_id if len(wanted) else np.zeros(len(index), np.bool_)
    shares[index[is_wanted] * grid.count + tiles.interval[is_wanted]] = (
        getattr(tiles, of)[is_wanted] / grid.steps
    )
    return np.asarray(shares.reshape(-1, grid.count)[place].ravel(), np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Counts:
    """Sums over crossings, by cells of lane and interval."""

    counted: Floats
    heavy: Floats
    variance: Floats
    speed: Floats
    speeds: Integers

    @classmethod
    def of(cls, crossed: Crossings, lanes: TrackedLanes) -> _Counts:
        vehicles = lanes.vehicles
        row, cell = vehicles.of(crossed.vehicle), lanes.cell_of(crossed.lane, crossed.step)
        error = np.where(crossed.seen, COUNTING_SEEN, COUNTING_INFERRED)
        exists = vehicles.p_exists[row]
        known = 0.5 * error**2 + exists * (1.0 - exists)  # half is for missing vehicles
        variance = np.where(np.isnan(exists), error**2, known)
        kmh = np.maximum(crossed.speed, 0.0) * 3.6
        group = np.minimum((kmh // SPEED_CLASS_KMH).astype(np.int64), SPEED_CLASSES - 1)
        counted, heavy, spread, speed = (
            np.bincount(cell, values, lanes.cells).astype(np.float64)
            for values in (None, vehicles.p_heavy[row], variance, crossed.speed)
        )
        speeds = np.bincount(cell * SPEED_CLASSES + group, minlength=lanes.cells * SPEED_CLASSES)
        return cls(
            counted=counted, heavy=heavy, variance=spread, speed=speed,
            speeds=speeds.reshape(lanes.cells, SPEED_CLASSES),
        )  # fmt: skip


class _Hidden(NamedTuple):
    """Hidden lines, by cells of lane and interval.

    Parameters
    ----------
    share, blocked : (cells,) arrays
        Shares of the interval: hidden, and hidden while a vehicle stands at the line.
    crossings : (cells,) array
        Number of fronts that cross the line while it is hidden.
    """

    share: Floats
    blocked: Floats
    crossings: Floats


def _volumes(counts: _Counts, share: Floats, hidden: _Hidden) -> dict[str, Any]:
    """Return the counts, and the estimates for whole intervals."""
    estimated = share >= LEAST_VISIBLE_SHARE
    visible = np.where(estimated, share, 1.0)
    observed = np.where(estimated, share + hidden.share, 1.0)
    passable = np.maximum(observed - visible - hidden.blocked, 0.0)
    unseen = np.where(estimated, hidden.crossings, 0.0)
    missed = counts.counted * passable / visible - unseen
    chance = (counts.counted + 0.5) * passable * (visible + passable) / visible**2
    variance = counts.variance + COUNTING_INFERRED**2 * unseen + (missed**2 + chance) / 3.0
    followed = counts.counted + unseen
    variance += (followed + 0.5) * (1.0 - observed)
    return {
        "visible_share": share,
        "counted": _masked(counts.counted, share == 0.0),
        "volume": np.where(estimated, followed / observed, np.nan),
        "volume_se": np.where(estimated, np.sqrt(variance) / observed, np.nan),
        "heavy": np.where(share > 0.0, counts.heavy, np.nan),
    }


def _speeds(counts: _Counts, seconds: Floats, metres: Floats, share: Floats) -> dict[str, Any]:
    """Return space-mean and time-mean speed, m/s."""
    mean = quotient(counts.speed, counts.counted)
    return {
        "speed_mean": np.maximum(quotient(metres, seconds), 0.0),
        "speed_time_mean": np.where(share > 0.0, mean, np.nan),
    }


def _occupancies(areas: _Areas) -> dict[str, Any]:
    """Return the mean occupancy of tiles; their errors are added as fully correlated."""
    return {
        "occupancy": quotient(areas.occupied_steps, areas.visible_steps),
        "occupancy_se": quotient(areas.error_steps, areas.visible_steps),
    }


def _flows(
    network: LaneNetwork, grid: StepGrid, areas: _Areas, seconds: Floats, metres: Floats
) -> dict[str, Any]:
    """Return density, flow, travel time and delay."""
    length, free = (np.repeat(each, grid.count) for each in (network.length_m, network.free_speed))
    whole_km_h = length * grid.steps / STEPS_PER_SECOND / 3.6e6
    enough = areas.visible_km_h >= LEAST_VISIBLE_SHARE * whole_km_h
    pace = np.where(enough & (metres > 0.0), quotient(seconds, metres), np.nan)
    return {
        "density": quotient(seconds / 3600.0, areas.visible_km_h),
        "flow": np.maximum(quotient(metres / 1000.0, areas.visible_km_h), 0.0),
        "travel_time_s": pace * length,
        "delay_s": np.maximum(pace * length - length / free, 0.0),
    }


def _stops(lanes: TrackedLanes) -> Floats:
    """Return the number of vehicles that stop on visible tiles, by lane and interval."""
    states, network = lanes.states, lanes.network
    row = np.flatnonzero(lanes.standing[1] & lanes.in_grid & (states.lane >= 0))
    tile = network.tile_id[network.tile_at(states.lane[row], states.along_m[row])]
    row = row[lanes.visible.at(tile, states.step[row])]
    cell = lanes.cell_of(states.lane[row], states.step[row])
    return np.bincount(cell, minlength=lanes.cells).astype(np.float64)


def _turns(
    lanes: TrackedLanes, crossed: Crossings, measured: Mapping[str, Any], areas: _Areas,
    tiles: TileSteps,
) -> dict[str, Any]:  # fmt: skip
    """Return turns: the volume of each approach, divided by the exits of vehicles where known.

    Vehicles without a known exit may have taken one that is not visible: then the other exits only
    get the share of the volume that is known for them.
    """
    network, grid = lanes.network, lanes.grid
    ways = _turn_rows(network)
    followed = _known_turns(lanes, crossed, ways)
    by_lane = {n: measured[n].reshape(-1, grid.count)[ways[:, 0]].ravel() for n in _OF_APPROACH}
    exits = network.tile_id[np.searchsorted(network.tile_lane, ways[:, 1])]
    lines = lanes.line_tile_id[ways[:, 2]]
    visible, line_share = _share_at(exits, grid, tiles), _share_at(lines, grid, tiles)
    connects = np.repeat(ways[:, 2] >= 0, grid.count)
    visible = np.where(connects, np.maximum(visible, line_share), visible)
    share = np.minimum(by_lane["visible_share"], visible)
    start = np.repeat(ways[:, 0], grid.count) * grid.count + np.tile(
        np.arange(grid.count), len(ways)
    )
    size, seen = lanes.cells, share >= LEAST_VISIBLE_SHARE
    total = np.bincount(start, followed * seen, size)[start]
    has_hidden_exit = np.bincount(start, ~seen, size)[start] > 0
    divisor = np.where(has_hidden_exit, np.maximum(by_lane["followed"], total), total)
    ways_on = np.repeat(np.bincount(ways[:, 0], minlength=1)[ways[:, 0]], grid.count)
    split = np.where(by_lane["volume"] > 0.0, quotient(followed, divisor), 0.0)
    split = np.where(ways_on == 1, 1.0, split)  # also where nobody was followed
    split = np.where(seen, split, np.nan)
    # as that of a volume: the half vehicle that may have come unseen takes each way alike
    error_split = (followed + 0.5 / ways_on) / (divisor + 0.5)
    volume, error = by_lane["volume"], by_lane["volume_se"]
    unknown = np.maximum(volume - followed, 0.0) * (divisor < volume)
    rows = np.flatnonzero(areas.known[start])
    columns = {
        "visible_share": share,
        "volume": volume * split,
        "volume_se": np.sqrt(error**2 * error_split + unknown * split * (1.0 - split)),
    }
    return {
        "from_lane": network.lane[start[rows] // grid.count],
        "to_lane": network.lane[np.repeat(ways[:, 1], grid.count)[rows]],
        "interval": rows % grid.count,
    } | {name: values[rows] for name, values in columns.items()}


_OF_APPROACH = ("visible_share", "followed", "volume", "volume_se")


def _turn_rows(network: LaneNetwork) -> Integers:
    """Return rows of start, end, and last connector of turns; -1 if that leads elsewhere, too."""
    rows = [
        (each.start, each.end, each.via[-1])
        if each.via and network.after[each.via[-1]] == (each.end,)
        else (each.start, each.end, -1)
        for each in network.turns()
    ]
    return np.array(rows, np.int64).reshape(-1, 3)


def _known_turns(lanes: TrackedLanes, crossed: Crossings, ways: Integers) -> Floats:
    """Return the number of vehicles from an approach's line to an exit, by way and interval.

    Each vehicle counts for the first exit of its approach that it reaches, else for the connector
    whose middle it passes.
    """
    states, grid, count = lanes.states, lanes.grid, len(lanes.network.lane)
    changes = np.flatnonzero(np.diff(states.lane, prepend=-2) != 0)
    ends = pd.DataFrame(
        {
            "vehicle": np.append(states.vehicle[changes], crossed.vehicle),
            "row": np.append(changes, crossed.row),
            # lanes that are reached, then those whose lines are crossed
            "end": np.append(states.lane[changes], count + crossed.lane),
        }
    )
    starts = pd.DataFrame(
        {
            "vehicle": crossed.vehicle, "row": crossed.row, "start": crossed.lane,
            "interval": grid.of(crossed.step),
        }
    )  # fmt: skip
    start, end, connector = ways.T
    exits = pd.concat(
        pd.DataFrame({"start": start, "end": reached, "only_passed": passed})
        .rename_axis("way").reset_index()[connector >= (0 if passed else -1)]
        for reached, passed in ((end, False), (count + connector, True))
    )  # fmt: skip
    pairs = starts.merge(ends, on="vehicle", suffixes=("", "_end")).merge(
        exits, on=["start", "end"]
    )
    pairs = pairs[pairs["row_end"] > pairs["row"]]
    pairs = pairs.sort_values(["vehicle", "start", "only_passed", "row_end"])
    pairs = pairs.drop_duplicates(["vehicle", "start"])
    cell = (pairs["way"] * grid.count + pairs["interval"]).to_numpy(np.int64)
    return np.bincount(cell, minlength=len(ways) * grid.count).astype(np.float64)


def _masked(values: Floats, missing: Booleans) -> Any:
    return np.ma.masked_array(values.astype(np.int64), missing)


def _lists(rows: Integers, missing: Booleans) -> pa.Array:
    """Return rows as lists, null where missing."""
    lists = [None if gone else row for row, gone in zip(rows, missing, strict=True)]
    return pa.array(lists, pa.list_(pa.int32()))

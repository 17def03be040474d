"""Batches: tables of the vehicles of each block of time, which keep their numbers over blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from gis_radar.base import STEP_S, Booleans, Floats, Integers, Text, nearest
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.hour_blocks import Block
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.routes import route_of
from gis_radar.tracking.tables import TRACKS_KIND, VEHICLES_KIND

_BIN_RAD = np.pi / 9.0  # width of a bin of directions: in one, lanes show the same shift of a pose
_BEND_M, _BEND_RAD = 5.0, 0.1  # a lane that bends by so much within so far is left out
_LEAST_ROWS = 5  # least detections of a vehicle on a lane for the median of their distances from it
_SURE_SIGMAS = 4.0  # least sigmas of a reported shift: hardly one of hundreds of sensors by chance
_LEAST_OF_WORST = 0.75  # least share of the largest shift of any sensor of a reported one
_SIDES = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
_SEEN_S = 0.5  # a state is seen within so many seconds of a detection (the contract)
_DRIVING_MPS = 3.0  # slower vehicles may turn in, park or load beside the lanes
_LEAST_JUDGED = 8  # least vehicles by which a pose is judged
_MOST_OFF_LANE = 0.2  # share of a sensor's vehicles on no lanelet above which its pose is doubtful
# Shift of all vehicles of a sensor from the centres of lanes, or from those of other sensors, above
# which its pose is doubtful.
_MOST_BESIDE_M = 0.6
# Sigma of the mean distance of a lane's drivers from its centre, as recorded at three junctions; of
# a driver's distance from that mean; of a pose.
_LANE_M, _BESIDE_M, _SHIFT_M = 0.25, 0.7, 1.0
_POSE_HINT = "gis-radar track, gis-radar localize"


@dataclass(frozen=True, kw_only=True)
class VehicleBatch:
    """Finished vehicles of a span of steps.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive, which follows that of the batch before. The last one ends with a frame.
    tracks : DataFrame
        The columns of `TRACKS_KIND`, by step and vehicle: all states in the span, one for each step
        from a vehicle's first to its last. `easting` and `northing` are the middle of the rectangle
        of its length and width: the middle of its front lies half a length ahead along `heading`,
        of vehicles over 12 m too.
    vehicles : DataFrame
        The columns of `VEHICLES_KIND`: each vehicle with a state in the span, as known so far. It
        may go on in the next batch under the same number.
    """

    first_step: int
    last_step: int
    tracks: pd.DataFrame
    vehicles: pd.DataFrame


class BatchMaker:
    """Maker of batches from the motions found in each block.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    """

    def __init__(self, graph: LaneGraph) -> None:
        self._graph = graph
        self._known: pd.DataFrame | None = None  # detections of vehicles at the edge
        self._edge = -1
        self._lane_offsets: list[pd.DataFrame] = []
        self.found = 0
        self.numbers: list[int] = []  # of the vehicles of the last block, in the order of motions

    def clear_lane_offsets(self) -> None:
        """Drop the distances of vehicles from their lanes so far."""
        self._lane_offsets = []

    def batch(self, block: Block, motions: list[Motion]) -> VehicleBatch:
        """Make the batch of a block from the motions of its vehicles.

        A vehicle keeps the number that it has in the block before, with which it shares detections.
        """
        states = [_States.of(each, block) for each in motions]
        inside = [k for k, each in enumerate(states) if len(each.step)]
        motions, states = [motions[k] for k in inside], [states[k] for k in inside]
        self.numbers = numbers = self._numbers(block, motions, states)
        tables = [TRACKS_KIND.empty()]
        rows, driven = [], []
        for number, motion, each in zip(numbers, motions, states, strict=True):
            table, lanelets = self._tables(each, motion)
            driven.append(_driven_detections(number, table, motion, block.detections))
            tables.append(table.assign(vehicle=number))
            rows.append(
                {
                    "vehicle": number, "first_step": each.step[0], "last_step": each.step[-1],
                    "length_m": motion.length_m, "width_m": motion.width_m,
                    "length_sigma_m": motion.length_sigma_m, "p_exists": motion.p_exists,
                    "p_heavy": motion.p_heavy,
                    "lanelets": lanelets,
                }
            )  # fmt: skip
        if driven:
            self._lane_offsets.append(_lane_offsets(driven))
        vehicles = pd.DataFrame(rows, columns=[*VEHICLES_KIND.columns]).sort_values("vehicle")
        tracks = pd.concat(tables, ignore_index=True).sort_values(["step", "vehicle"])
        return VehicleBatch(
            first_step=block.first_step, last_step=block.last_step, tracks=tracks,
            vehicles=vehicles,
        )  # fmt: skip

    def on_lanes(self, sensors: Sequence[str]) -> list[pd.DataFrame]:
        """Return distances of vehicles from their lanes by sensor, for :func:`warn_of_poses`."""
        names = np.array(sensors, object)
        return [each.assign(sensor=names[each["sensor"]]) for each in self._lane_offsets]

    def _numbers(self, block: Block, motions: list[Motion], states: list[_States]) -> list[int]:
        """Return the number of each vehicle: that in the block before, or a new one."""
        numbers = [-1] * len(motions)
        if self._known is not None and self._edge == block.first_step - 1:
            goes_on = [k for k, each in enumerate(states) if each.step[0] == block.first_step]
            for k, number in self._continued(block.detections, [motions[k] for k in goes_on]):
                numbers[goes_on[k]] = number
        for k, number in enumerate(numbers):
            if number < 0:
                numbers[k] = self.found
                self.found += 1
        kept = [
            _keys(block.detections, motion.rows).assign(vehicle=number)
            for number, motion, each in zip(numbers, motions, states, strict=True)
            if each.step[-1] == block.last_step
        ]
        self._edge = block.last_step
        self._known = pd.concat(kept, ignore_index=True) if kept else None
        return numbers

    def _continued(self, detections: MapDetections, motions: list[Motion]) -> list[tuple[int, int]]:
        """Return pairs of a motion and the vehicle of the block before that it continues.

        The assignment is that with the most shared detections.
        """
        known = self._known
        if known is None or not motions:
            return []
        mine = pd.concat(
            _keys(detections, motion.rows).assign(motion=k) for k, motion in enumerate(motions)
        )
        both = mine.merge(known, on=["sensor", "time", "east"])
        if both.empty:
            return []
        counts = pd.crosstab(both["motion"], both["vehicle"])
        shared = counts.to_numpy(np.float64)
        rows, columns = linear_sum_assignment(-shared)
        return [
            (int(counts.index[row]), int(counts.columns[column]))
            for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
            if shared[row, column] > 0
        ]

    def _tables(self, states: _States, motion: Motion) -> tuple[pd.DataFrame, Integers]:
        """Return the rows of `tracks` of a vehicle, and the lanelets that it follows."""
        graph = self._graph
        direction = np.column_stack([np.cos(states.heading), np.sin(states.heading)])
        fronts = states.middle + 0.5 * motion.length_m * direction
        route = route_of(fronts, states.heading, graph)
        on = route.lane >= 0
        lanelet = pd.Series(graph.lanelet_id[np.maximum(route.lane, 0)], dtype="Int64")
        towards = np.full(len(on), np.nan)
        for lane in np.unique(route.lane[on]).tolist():
            here = np.flatnonzero(route.lane == lane)
            before, now, after = (
                graph.place(lane, route.s_m[here] + more)[1] for more in (-_BEND_M, 0.0, _BEND_M)
            )
            straight = np.abs(after - before) < _BEND_RAD
            towards[here[straight]] = np.angle(np.exp(1j * now[straight]))
        table = pd.DataFrame(
            {
                "step": states.step,
                "easting": states.middle[:, 0] + graph.origin[0],
                "northing": states.middle[:, 1] + graph.origin[1],
                "heading": np.degrees(np.angle(np.exp(1j * states.heading))),
                "speed": states.speed,
                "lanelet_id": lanelet.where(on),
                "s_m": route.s_m,
                "d_m": route.d_m,
                "seen": states.seen,
                "towards": towards,  # direction of the lane where it is straight, to check poses
            }
        )
        return table, route.lanelets(graph)


def _driven_detections(
    number: int, table: pd.DataFrame, motion: Motion, detections: MapDetections
) -> pd.DataFrame:
    """Return the detections of a vehicle while it drives, with its distance left of its lane."""
    step = (detections.time[motion.rows] / STEP_S).astype(np.int64) - int(table["step"].iloc[0])
    inside = np.flatnonzero((step >= 0) & (step < len(table)))
    drives = inside[table["speed"].to_numpy()[step[inside]] > _DRIVING_MPS]
    at = step[drives]
    towards = table["towards"].to_numpy()[at]
    left_m = table["d_m"].to_numpy(np.float64, na_value=np.nan)[at]
    way = np.round(np.nan_to_num(towards) / _BIN_RAD).astype(np.int64) % round(2 * np.pi / _BIN_RAD)
    middle = _BIN_RAD * way
    return pd.DataFrame(
        {
            "vehicle": number,
            "sensor": detections.sensor[motion.rows[drives]],
            "way": way,
            "towards": middle + np.angle(np.exp(1j * (towards - middle))),
            "on": table["lanelet_id"].notna().to_numpy()[at],
            "left_m": np.where(np.isfinite(towards), left_m, np.nan),
        }
    )


def _lane_offsets(driven: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the distance of each vehicle left of its lane, by sensor and direction.

    All vehicles of a block are grouped at once, which takes no longer than for one.
    """
    return pd.concat(driven, ignore_index=True).groupby(["vehicle", "sensor", "way"]).agg(
        towards=("towards", "mean"), size=("on", "size"), on=("on", "sum"),
        count=("left_m", "count"), left_m=("left_m", "median"),
    ).reset_index()  # fmt: skip


def joined_rows(known: dict[str, Any] | None, row: dict[str, Any]) -> dict[str, Any]:
    """Join two rows of a continued vehicle: the better known size, lanelets of both."""
    if known is None:
        return row
    best = min((row, known), key=lambda each: float(each["length_sigma_m"]))
    before, after = known["lanelets"].tolist(), row["lanelets"].tolist()
    most = min(len(before), len(after))
    shared = max(n for n in range(most + 1) if before[len(before) - n :] == after[:n])
    return {
        **best,
        "first_step": min(known["first_step"], row["first_step"]),
        "last_step": max(known["last_step"], row["last_step"]),
        "lanelets": np.array([*before, *after[shared:]], np.int64),
    }


def warn_of_poses(seen: Sequence[pd.DataFrame]) -> list[str]:
    """Return a warning for each sensor whose vehicles do not drive on the lanes.

    Parameters
    ----------
    seen : sequence of DataFrame
        From :meth:`BatchMaker.on_lanes`; vehicles of different tables are different ones.
    """
    if not seen:
        return []
    whole, first = [], 0
    for each in seen:
        whole.append(each.assign(vehicle=each["vehicle"] + first))
        first = int(whole[-1]["vehicle"].max()) + 1
    table = pd.concat(whole, ignore_index=True)
    names, number = np.unique(table["sensor"].to_numpy(str), return_inverse=True)
    return pose_warnings(table.assign(sensor=number), names.tolist())


def pose_warnings(seen: pd.DataFrame, sensors: Sequence[str]) -> list[str]:
    """Return a warning for each sensor whose vehicles drive beside the lanes.

    Parameters
    ----------
    seen : DataFrame
        ``vehicle sensor way towards size on count left_m``: numbers of a sensor's detections of a
        vehicle while it drove (`size`), on a lanelet (`on`), where that is straight (`count`), by
        direction (bins of 20 degrees, and the mean, radians); distance left of its centre.
    sensors : sequence of str
        Names, by number.
    """
    judged: dict[int, tuple[float, float, Floats, float]] = {}
    for number in np.unique(seen["sensor"]).tolist():
        mine = seen[seen["sensor"] == number]
        if mine["vehicle"].nunique() >= _LEAST_JUDGED:
            counts = mine.groupby("vehicle")[["size", "on"]].sum()
            off = float((counts["on"] < 0.5 * counts["size"]).mean())
            left = mine[mine["count"] >= _LEAST_ROWS]
            enough = left["vehicle"].nunique() >= _LEAST_JUDGED
            beside = float(left["left_m"].abs().median()) if enough else np.nan
            judged[number] = off, beside, *_shift(left)
    shifts = {number: float(np.hypot(*each[2])) for number, each in judged.items()}
    lines: list[str] = []
    for number, (off, beside, shift, sigma) in judged.items():
        others = [
            each[1] for other, each in judged.items() if other != number and np.isfinite(each[1])
        ]
        apart = beside - float(np.median(others)) if others else 0.0
        least = max(_MOST_BESIDE_M, _SURE_SIGMAS * sigma, _LEAST_OF_WORST * max(shifts.values()))
        if off > _MOST_OFF_LANE:
            what = Text("{:.0%} of its vehicles follow no lanelet", off)
        elif shifts[number] > least:
            side = _SIDES[round(float(np.arctan2(shift[1], shift[0])) / (0.25 * np.pi)) % 8]
            what = Text("its vehicles drive {:.1f} m {} of the lanes", shifts[number], Text(side))
        elif apart > _MOST_BESIDE_M:
            what = Text(
                "its vehicles drive {:.1f} m farther from their lanes' centres than "
                "those of others",
                apart,
            )
        else:
            continue
        doubt = Text("its pose may be off")
        lines.append(Text("{}: {}: {} ({})", sensors[number], what, doubt, _POSE_HINT))
    return lines


def _shift(left: pd.DataFrame) -> tuple[Floats, float]:
    """Return the shift of a sensor's vehicles from the lanes, (east, north) metres, and its sigma.

    Vehicles show the shift across their direction. Those of one lane share an offset, so that many
    count little more than a few. A prior bounds the shift across which nobody drives.
    """
    ways = left.groupby("way").agg(
        towards=("towards", "mean"), left_m=("left_m", "median"), count=("left_m", "size")
    )
    way = ways["towards"].to_numpy(np.float64)
    normal = np.column_stack([-np.sin(way), np.cos(way)])
    var = _LANE_M**2 + _BESIDE_M**2 / ways["count"].to_numpy(np.float64)
    weighted = normal / var[:, None]
    prior = np.eye(2) / _SHIFT_M**2
    beside = ways["left_m"].to_numpy(np.float64)
    spread = np.linalg.inv(normal.T @ weighted + prior)
    shift = spread @ (weighted.T @ beside)
    side = shift / max(float(np.hypot(*shift)), 1e-9)
    return shift, float(np.sqrt(side @ spread @ side))


class _States:
    """States of a vehicle in the span of a block, step by step."""

    def __init__(
        self, step: Integers, middle: Floats, heading: Floats, speed: Floats, seen: Booleans
    ) -> None:
        self.step, self.middle, self.heading = step, middle, heading
        self.speed, self.seen = speed, seen

    @classmethod
    def of(cls, motion: Motion, block: Block) -> _States:
        """Return the states of a motion at all its steps within the span of a block."""
        first = max(motion.first_step, block.first_step)
        last = min(motion.last_step, block.last_step)
        step = np.arange(first, last + 1)
        time = np.asarray(step * STEP_S, np.float64)
        s_m, speed = motion.at(time)
        middle, heading = motion.path.at(s_m)
        hits = block.detections.time[motion.rows]
        seen = np.abs(hits[nearest(hits, time)] - time) <= _SEEN_S
        return cls(step, middle, heading, speed, seen)


def _keys(detections: MapDetections, rows: Integers) -> pd.DataFrame:
    """Return `sensor time east` of some detections, by which those of two blocks are compared."""
    return pd.DataFrame(
        {
            "sensor": detections.sensor[rows],
            "time": detections.time[rows],
            "east": detections.points[rows, 0],
        }
    )

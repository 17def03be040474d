"""Motions of blocks of time as the tables of a folder: vehicles keep their numbers over blocks."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from gis_radar.arrays import Booleans, Floats, Integers, nearest
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.steps import STEP_S
from gis_radar.vehicles.blocks import Block
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.folder import VehiclePiece
from gis_radar.vehicles.motion import Motion
from gis_radar.vehicles.routes import route_of
from gis_radar.vehicles.settings import PieceSettings, VehicleSettings
from gis_radar.vehicles.tables import TRACKS, VEHICLES

POSE_HINT = ": its pose may be off (gis-radar track, gis-radar localize)"


class PieceMaker:
    """Makes the pieces of a folder from what was found in each block.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    settings : VehicleSettings
        Of routes, and how long a vehicle goes on unseen.
    """

    def __init__(self, graph: LaneGraph, settings: VehicleSettings) -> None:
        self._graph, self._settings = graph, settings
        self._known: pd.DataFrame | None = None  # detections of vehicles at the edge: key, vehicle
        self._edge = -1
        self._off_lanes: list[pd.DataFrame] = []
        self.found = 0

    def piece(self, block: Block, motions: list[Motion]) -> VehiclePiece:
        """Return the states of the vehicles in the span of a block.

        A vehicle is the one of the block before with which it shares most detections.
        """
        states = [_States.of(each, block, self._settings) for each in motions]
        inside = [k for k, each in enumerate(states) if len(each.step)]
        motions, states = [motions[k] for k in inside], [states[k] for k in inside]
        numbers = self._numbers(block, motions, states)
        tables = [TRACKS.empty()]
        rows = []
        for number, motion, each in zip(numbers, motions, states, strict=True):
            table, lanelets = self._tables(each, motion)
            self._off_lanes.append(_off_lanes(table, motion, block.echoes, self._settings.pieces))
            tables.append(table.assign(vehicle=number))
            cut = (block.begins and each.step[0] == block.first_step) or (
                block.ends and each.step[-1] == block.last_step
            )
            rows.append(
                {
                    "vehicle": number, "first_step": each.step[0], "last_step": each.step[-1],
                    "length_m": motion.length_m, "width_m": motion.width_m,
                    "length_sigma_m": motion.length_sigma_m, "p_heavy": motion.p_heavy,
                    "lanelets": lanelets, "continues": cut,
                }
            )  # fmt: skip
        vehicles = pd.DataFrame(rows, columns=[*VEHICLES.columns]).sort_values("vehicle")
        tracks = pd.concat(tables, ignore_index=True).sort_values(["step", "vehicle"])
        return VehiclePiece(
            first_step=block.first_step, last_step=block.last_step, tracks=tracks,
            vehicles=vehicles, frames=block.frames,
        )  # fmt: skip

    def warnings(self, sensors: list[str]) -> list[str]:
        """Return a line for each sensor whose vehicles follow no lanelets."""
        if not self._off_lanes:
            return []
        limits, lines = self._settings.pieces, []
        seen = pd.concat(self._off_lanes, ignore_index=True)
        for number, name in enumerate(sensors):
            mine = seen[seen["sensor"] == number]
            off = float(mine["off"].mean()) if len(mine) >= limits.least_judged else 0.0
            if off > limits.most_off_lane:
                lines.append(f"{name}: {off:.0%} of its vehicles follow no lanelet{POSE_HINT}")
        return lines

    def _numbers(self, block: Block, motions: list[Motion], states: list[_States]) -> list[int]:
        """Return the number of each vehicle: that of the block before where it goes on."""
        numbers = [-1] * len(motions)
        if self._known is not None and self._edge == block.first_step - 1:
            goes_on = [k for k, each in enumerate(states) if each.step[0] == block.first_step]
            for k, number in self._same(block.echoes, [motions[k] for k in goes_on]):
                numbers[goes_on[k]] = number
        for k, number in enumerate(numbers):
            if number < 0:
                numbers[k] = self.found
                self.found += 1
        kept = [
            pd.DataFrame({"key": _keys(block.echoes.take(motion.rows)), "vehicle": number})
            for number, motion, each in zip(numbers, motions, states, strict=True)
            if each.step[-1] == block.last_step
        ]
        self._edge = block.last_step
        self._known = pd.concat(kept, ignore_index=True) if kept else None
        return numbers

    def _same(self, echoes: Echoes, motions: list[Motion]) -> list[tuple[int, int]]:
        """Return pairs of a motion and a known vehicle that share detections."""
        known = self._known
        if known is None or not motions:
            return []
        mine = pd.concat(
            pd.DataFrame({"key": _keys(echoes.take(motion.rows)), "motion": k})
            for k, motion in enumerate(motions)
        )
        both = mine.merge(known, on="key")
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
        way = np.column_stack([np.cos(states.heading), np.sin(states.heading)])
        fronts = states.middle + 0.5 * motion.length_m * way
        route = route_of(fronts, states.heading, graph, self._settings.routes)
        on = route.lane >= 0
        lanelet = pd.Series(graph.lanelet_id[np.maximum(route.lane, 0)], dtype="Int64")
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
            }
        )
        return table, route.lanelets(graph)


def _off_lanes(
    table: pd.DataFrame, motion: Motion, echoes: Echoes, settings: PieceSettings
) -> pd.DataFrame:
    """Return for each sensor that sees a vehicle whether it drives mostly on no lanelet."""
    step = (echoes.time[motion.rows] / STEP_S).astype(np.int64) - int(table["step"].iloc[0])
    inside = (step >= 0) & (step < len(table))
    step, rows = step[inside], motion.rows[inside]
    off = table["lanelet_id"].isna().to_numpy()[step]
    found = pd.DataFrame({"sensor": echoes.sensor[rows], "off": off})
    drives = table["speed"].to_numpy()[step] > settings.through_mps
    return (found[drives].groupby("sensor")["off"].mean() > 0.5).reset_index()


class _States:
    """A vehicle in the span of a block, step by step."""

    def __init__(
        self, step: Integers, middle: Floats, heading: Floats, speed: Floats, seen: Booleans
    ) -> None:
        self.step, self.middle, self.heading = step, middle, heading
        self.speed, self.seen = speed, seen

    @classmethod
    def of(cls, motion: Motion, block: Block, settings: VehicleSettings) -> _States:
        """Take the states of a motion; who drives goes on for a moment unseen at either end."""
        more = settings.pieces.unseen_steps
        before = more if motion.speed[0] > settings.pieces.driving_mps else 0
        after = more if motion.speed[-1] > settings.pieces.driving_mps else 0
        first = max(motion.first_step - before, block.first_step)
        last = min(motion.last_step + after, block.last_step)
        step = np.arange(first, last + 1)
        time = np.asarray(step * STEP_S, np.float64)
        s_m, speed = motion.at(time)
        middle, heading = motion.path.at(s_m)
        hits = block.echoes.time[motion.rows]
        seen = np.abs(hits[nearest(hits, time)] - time) <= settings.pieces.seen_s
        return cls(step, middle, heading, speed, seen)


def _keys(echoes: Echoes) -> list[tuple[int, float, float]]:
    """Return what tells one detection from all others."""
    return list(
        zip(echoes.sensor.tolist(), echoes.time.tolist(), echoes.points[:, 0].tolist(), strict=True)
    )

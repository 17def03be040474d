"""Expected number of detections of a vehicle by place; without one of them, none is there.

The detection rate of vehicles in a map cell is learned for each sensor from those that drive
through it, which includes the effects of range, aspect and obstacles. Occlusion by other vehicles
is computed from their places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from gis_radar.base import STEPS_PER_SECOND, Floats, Integers, compiled
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import HALF_STEPS, Motion

_HALF_WIDTH_M = 1.5  # half the width of an occluder: half a lorry and an error of place
_NEAREST_M = 1.0  # a body nearer to a place does not hide it; a sensor nearer to it does not see it
# Side of the map cells in which the detection rate is learned, each with its eight neighbours.
_RATE_CELL_M = 6.0
_DRIVING_MPS = 3.0  # least speed of the vehicles from which it is learned
# least time of vehicles in a cell and its neighbours; with less, the rate is unknown
_LEAST_S = 1.0
SILENT_S = 2.0  # shorter gaps between detections are no evidence


@dataclass(frozen=True, kw_only=True)
class Occluders:
    """Occluders: bodies of vehicles in each half second, which hide what is behind them.

    Parameters
    ----------
    half : (n,) int64 array
        Number of the half second.
    owner : (n,) int64 array
        Number of the vehicle, as the caller numbers them.
    shape : (n, 5) array
        Easting and northing of its middle, cosine and sine of its heading, half its length.
    """

    half: Integers
    owner: Integers
    shape: Floats

    @classmethod
    def of(cls, motions: Sequence[Motion]) -> Occluders:
        """Make occluders of motions, with their index as owner."""
        parts = []
        for number, motion in enumerate(motions):
            half, place, heading = motion.halves()
            reach = np.full(len(half), 0.5 * motion.length_m)
            shape = np.column_stack([place, np.cos(heading), np.sin(heading), reach])
            parts.append(cls(half=half, owner=np.full(len(half), number), shape=shape))
        return cls.join(parts)

    def near(self, place: Floats, halves: Integers, owner: int, within_m: float) -> Integers:
        """Return the half seconds in which another vehicle is at a place or near it.

        Parameters
        ----------
        place : (2,) array
            East and north, metres.
        halves : (n,) int64 array
            Half seconds to choose from.
        owner : int
            The vehicle that does not count.
        within_m : float
            Largest distance from the place to the nearest end of a vehicle, approximately.
        """
        low, high = np.searchsorted(self.half, [halves[0], halves[-1] + 1])
        part = slice(int(low), int(high))
        apart = np.hypot(*(self.shape[part, :2] - place).T) - self.shape[part, 4]
        close = (apart < within_m) & (self.owner[part] != owner)
        return np.unique(self.half[part][close])

    @classmethod
    def stationary(
        cls, number: int, span: tuple[float, float], x: float, y: float, heading: float,
        length_m: float,
    ) -> Occluders:  # fmt: skip
        """Make an occluder of a vehicle at rest between two times, UNIX seconds."""
        first, last = (int(each * STEPS_PER_SECOND) // HALF_STEPS for each in span)
        half = np.arange(first, last + 1)
        shape = np.array([x, y, np.cos(heading), np.sin(heading), 0.5 * length_m])
        return cls(
            half=half, owner=np.full(len(half), number, np.int64),
            shape=np.tile(shape, (len(half), 1)),
        )  # fmt: skip

    @classmethod
    def join(cls, parts: Sequence[Occluders]) -> Occluders:
        """Join several in the order of time."""
        if not parts:
            none = np.zeros(0, np.int64)
            return cls(half=none, owner=none, shape=np.zeros((0, 5)))
        half = np.concatenate([each.half for each in parts])
        order = np.argsort(half, kind="stable")
        return cls(
            half=half[order], owner=np.concatenate([each.owner for each in parts])[order],
            shape=np.vstack([each.shape for each in parts])[order],
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Detectability:
    """Expected number of detections of a vehicle by place and time.

    Parameters
    ----------
    sensor_xy : (k, 2) array
        Positions of the sensors in the map, metres.
    rate : (k, rows, columns) array
        Detection rate of a vehicle in a cell, 1/s; 0 where it is unknown.
    corner : (2,) array
        South-west corner of the first cell.
    first_half : int
        Number of the first half second of `is_active`.
    is_active : (k, n) array
        1 in half seconds in which a sensor detected anything, else 0.
    occluders : Occluders
        Vehicles that hide others.
    """

    sensor_xy: Floats
    rate: Floats
    corner: Floats
    first_half: int
    is_active: Floats
    occluders: Occluders

    @classmethod
    def learned(cls, detections: MapDetections, motions: Sequence[Motion]) -> Detectability:
        """Learn detection rates by place from moving vehicles.

        Parameters
        ----------
        detections : MapDetections
            All detections, at least one.
        motions : sequence of Motion
            Motions of vehicles.
        """
        sensor_xy = detections.sensor_positions()
        count = len(sensor_xy)
        corner = detections.points.min(axis=0) - _RATE_CELL_M
        size = np.ceil((detections.points.max(axis=0) - corner) / _RATE_CELL_M).astype(np.int64) + 1
        detected, present_s = np.zeros((count, *size)), np.zeros(tuple(size))
        for motion in motions:
            drives = motion.speed > _DRIVING_MPS
            if not drives.any():
                continue
            cell = _cells(motion.places[0][drives], corner, size)
            np.add.at(present_s, tuple(cell.T), 1.0 / STEPS_PER_SECOND)
            step = np.round(detections.time[motion.rows] * STEPS_PER_SECOND).astype(np.int64)
            step = np.clip(step - motion.first_step, 0, len(motion.speed) - 1)
            rows, step = motion.rows[drives[step]], step[drives[step]]
            cell = _cells(motion.places[0][step], corner, size)
            np.add.at(detected, (detections.sensor[rows], *cell.T), 1.0)
        present_near_s = uniform_filter(present_s, 3, mode="constant") * 9.0
        sums = [uniform_filter(each, 3, mode="constant") * 9.0 for each in detected]
        known = present_near_s > _LEAST_S
        rate = np.where(known, np.stack(sums) / np.maximum(present_near_s, 1e-9), 0.0)
        half = (detections.time * 2.0).astype(np.int64)
        first = int(half.min())
        is_active = np.zeros((count, int(half.max()) - first + 1))
        is_active[detections.sensor, half - first] = 1.0
        return cls(
            sensor_xy=sensor_xy, rate=rate, corner=corner, first_half=first,
            is_active=is_active, occluders=Occluders.of(motions),
        )  # fmt: skip

    def expected(self, places: Floats, halves: Integers, owners: tuple[int, int]) -> float:
        """Return the expected number of detections of a vehicle where no other one hides it.

        Parameters
        ----------
        places : (n, 2) array
            Places of its middle.
        halves : (n,) int64 array
            The half second at each place.
        owners : (int, int)
            Numbers of the occluders that are the vehicle itself, which do not hide it.
        """
        return float(
            _expected(
                places, halves, np.array(owners), self.sensor_xy, self.rate, self.corner,
                self.first_half, self.is_active, self.occluders.half, self.occluders.owner,
                self.occluders.shape,
            )
        )  # fmt: skip

    def expected_between(
        self, places: Floats, times: tuple[float, float], owners: tuple[int, int]
    ) -> float:
        """Return the expected number of detections on the straight line between two places.

        Parameters
        ----------
        places : (2, 2) array
            The places.
        times : (float, float)
            UNIX seconds; one half second at either end does not count.
        owners : (int, int)
            As for :meth:`expected`.
        """
        halves = np.arange(int(np.ceil(2.0 * times[0])) + 1, int(2.0 * times[1]) - 1)
        if len(halves) == 0:
            return 0.0
        share = (0.5 * halves - times[0]) / (times[1] - times[0])
        way = places[0] + share[:, None] * (places[1] - places[0])
        return self.expected(way, halves, owners)


def _cells(points: Floats, corner: Floats, size: Integers) -> Integers:
    """Return the cell of each point, row and column."""
    return np.clip(((points - corner) / _RATE_CELL_M).astype(np.int64), 0, size - 1)


@compiled
def _expected(  # noqa: PLR0917 - numba takes plain arrays
    places: Floats,
    halves: Integers,
    owners: Integers,
    sensor_xy: Floats,
    rate: Floats,
    corner: Floats,
    first_half: int,
    is_active: Floats,
    body_half: Integers,
    body_owner: Integers,
    shape: Floats,
) -> float:  # pragma: no cover - compiled
    """Return what :meth:`Detectability.expected` does, from its arrays."""
    total = 0.0
    for i in range(len(places)):
        h = halves[i] - first_half
        a = int((places[i, 0] - corner[0]) / _RATE_CELL_M)
        b = int((places[i, 1] - corner[1]) / _RATE_CELL_M)
        if h < 0 or h >= is_active.shape[1] or a < 0 or b < 0:
            continue
        if a >= rate.shape[1] or b >= rate.shape[2]:
            continue
        low = np.searchsorted(body_half, halves[i])
        high = np.searchsorted(body_half, halves[i], side="right")
        for k in range(len(sensor_xy)):
            if rate[k, a, b] <= 0.0 or is_active[k, h] == 0.0:
                continue
            others = np.flatnonzero(
                (body_owner[low:high] != owners[0]) & (body_owner[low:high] != owners[1])
            )
            if not _is_hidden(places[i] - sensor_xy[k], sensor_xy[k], shape[low:high][others]):
                total += 0.5 * rate[k, a, b]
    return total


@compiled
def _is_hidden(offset: Floats, xy: Floats, shape: Floats) -> bool:  # pragma: no cover - compiled
    """Return whether a body of `shape` hides the place at an offset from a sensor at xy."""
    range_m = np.hypot(offset[0], offset[1])
    if range_m < _NEAREST_M:
        return True
    c, s = offset[0] / range_m, offset[1] / range_m
    for j in range(len(shape)):
        x, y = shape[j, 0] - xy[0], shape[j, 1] - xy[1]
        ahead, aside = x * c + y * s, y * c - x * s
        across = abs(shape[j, 3] * c - shape[j, 2] * s) * shape[j, 4] + _HALF_WIDTH_M
        if abs(aside) < across and 0.0 < ahead < range_m - _NEAREST_M:
            return True
    return False

"""Background rate: detections of no vehicle, from fixed objects and from moving clutter."""

from __future__ import annotations

import math

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.posterior.frames import Frames
from gis_radar.tracking.posterior.likelihood import _BODY_RATE_SIGMA_MPS, RATE_CELL_M

_SPOT_M = 0.5  # side of the spots in which the rate of fixed objects is learned
_FIXED_MPS = 0.3  # largest absolute range rate of a detection of a fixed object
# Density of such a range rate, s/m: that of a vehicle at rest, too, so that it does not decide.
_STILL_DENSITY = 1.0 / (math.sqrt(2.0 * math.pi) * _BODY_RATE_SIGMA_MPS)
_AFTER_S = 1.5  # time after a vehicle drove over a spot in which hardly another one stands there
DRIVES_MPS = 2.0
_BESIDE_M = 0.5  # no fixed objects are counted on a body and so far around it: its own detections
_FEW = 20.0  # weight of the usual rate of fixed objects, frames
_SPEEDS = (3.0, 8.0)  # bounds between slow, middling and fast clutter, m/s
# Widths of these bins of range rates of both signs, m/s; fast ones end at 30 m/s.
_WIDTHS = np.array([2.0 * _SPEEDS[0], 2.0 * (_SPEEDS[1] - _SPEEDS[0]), 44.0])
_LEAST_RATE = 1e-7  # least rate, per frame, m2 and m/s: a hundredth of faint clutter, over 0


class Background:
    """Background rate at each detection, per frame, m2 and m/s.

    The rate of fixed objects at a spot is learned from the frames just after a vehicle drove over
    it, and from those in which no vehicle is on it: so a vehicle that stands throughout does not
    count as a fixed object. That of moving clutter is learned by map cell, sensor and speed.

    Parameters
    ----------
    detections : MapDetections
        Detections in the order of the frames.
    frames : Frames
        Frames of all sensors.
    """

    def __init__(self, detections: MapDetections, frames: Frames) -> None:
        self._frames, self._points = frames, detections.points
        self._still = np.abs(detections.range_rate) < _FIXED_MPS
        cell = ((detections.points - detections.points.min(axis=0)) / RATE_CELL_M).astype(np.int64)
        rows, columns = cell.max(axis=0) + 1
        speed = np.digitize(np.abs(detections.range_rate), _SPEEDS)
        self._clutter = ((detections.sensor * rows + cell[:, 0]) * columns + cell[:, 1]) * 3 + speed
        self._still_rate = np.zeros(len(detections))

    def learn_fixed(self, order: Integers, frame: Integers, shape: Floats) -> None:
        """Learn the rate of fixed objects from the frames in which no vehicle is on a spot.

        Parameters
        ----------
        order : (n,) int64 array
            States of vehicles, sorted by frame.
        frame, shape : (m,), (m, 9) arrays
            Frame and shape of all states.
        """
        frames = self._frames
        for low, high in zip(frames.begin[:-1].tolist(), frames.begin[1:].tolist(), strict=True):
            rows = slice(int(frames.first[low]), int(frames.first[high]))
            if rows.start < rows.stop:
                part = order[slice(*np.searchsorted(frame[order], [low, high]))]
                self._still_rate[rows] = self._fixed_rates((low, high), rows, part, frame, shape)

    def _fixed_rates(
        self, span: tuple[int, int], rows: slice, order: Integers, frame: Integers, shape: Floats
    ) -> Floats:
        """Return the rate of fixed objects at each detection of a sensor with a span of frames."""
        frames, points = self._frames, self._points[rows]
        corner = points.min(axis=0) - _SPOT_M
        spot = ((points - corner) / _SPOT_M).astype(np.int64)
        size = tuple((spot.max(axis=0) + 2).tolist())
        bare, (counted, after, counted_after) = (
            np.full(size, float(span[1] - span[0])),
            np.zeros((3, *size)),
        )
        _count(
            order, frame, shape, frames.time, frames.first, span, self._still, spot, corner, bare,
            counted, after, counted_after,
        )  # fmt: skip
        known = bare > 5.0 * _FEW
        mean_rate = counted[known].sum() / max(bare[known].sum(), 1.0)
        rate = (counted + _FEW * mean_rate) / (np.maximum(bare, 0.0) + _FEW)
        rate = (counted_after + 0.5 * _FEW * rate) / (after + 0.5 * _FEW)
        return np.asarray(self._still[rows] * rate[tuple(spot.T)] / _SPOT_M**2 * _STILL_DENSITY)

    def rates(self, unexplained: Floats) -> Floats:
        """Return the background rate at each detection: fixed objects, clutter, least rate.

        Parameters
        ----------
        unexplained : (n,) array
            Share of each detection that no vehicle explains: 1 less their responsibilities.
        """
        size = (int(self._clutter.max()) // 3 + 1) * 3
        cells = np.bincount(self._clutter, unexplained * ~self._still, size).reshape(-1, 3)
        used = np.bincount(self._clutter // 3, minlength=len(cells)) > 0
        frames = len(self._frames.time) / len(self._frames.sensor_xy)
        each = 0.5 * (cells + cells[used].mean(axis=0)) / (frames * RATE_CELL_M**2 * _WIDTHS)
        return np.asarray(self._still_rate + each.ravel()[self._clutter] + _LEAST_RATE)


@compiled
def _count(  # noqa: PLR0917 - numba takes plain arrays
    order: Integers, frame: Integers, shape: Floats, time: Floats, first: Integers,
    span: tuple[int, int], still: Booleans, spot: Integers, corner: Floats, bare: Floats,
    counted: Floats, after: Floats, counted_after: Floats,
) -> None:  # fmt: skip
    """Count the frames without a vehicle on a spot, and the still detections in them.

    Writes `bare` (frames) and `counted` (detections) of all frames without one, and `after` and
    `counted_after` of those within `_AFTER_S` after one drove over the spot.
    """
    frames = max(span[1] - span[0] - 1, 1)
    gap = max((time[span[1] - 1] - time[span[0]]) / frames, 1e-3)
    drove, last = np.full(bare.shape, -1e18), np.full(bare.shape, -1e18)
    at, begin = 0, first[span[0]]
    for f in range(span[0], span[1]):
        while at < len(order) and frame[order[at]] == f:
            _cover(shape[order[at]], time[f], gap, corner, bare, after, drove, last)
            at += 1
        for d in range(first[f], first[f + 1]):
            i, j = spot[d - begin, 0], spot[d - begin, 1]
            if still[d] and last[i, j] < time[f]:
                counted[i, j] += 1.0
                counted_after[i, j] += 1.0 if time[f] - drove[i, j] < _AFTER_S else 0.0
    for i in range(bare.shape[0]):
        for j in range(bare.shape[1]):
            if drove[i, j] > 0.0:
                after[i, j] += min(time[span[1] - 1] - drove[i, j], _AFTER_S) / gap


@compiled
def _cover(
    shape: Floats, now: float, gap: float, corner: Floats, bare: Floats, after: Floats,
    drove: Floats, last: Floats,
) -> None:  # fmt: skip
    """Subtract a frame of a vehicle from `bare` at the spots under it; note when it drove there."""
    x, y, c, s, speed = shape[0], shape[1], shape[2], shape[3], shape[4]
    a, b = 0.5 * shape[5] + _BESIDE_M, 0.5 * shape[6] + _BESIDE_M
    east, north = a * abs(c) + b * abs(s), a * abs(s) + b * abs(c)
    low_i, low_j = int((x - east - corner[0]) / _SPOT_M), int((y - north - corner[1]) / _SPOT_M)
    high_i, high_j = int((x + east - corner[0]) / _SPOT_M), int((y + north - corner[1]) / _SPOT_M)
    for i in range(max(low_i, 0), min(high_i + 1, bare.shape[0])):
        for j in range(max(low_j, 0), min(high_j + 1, bare.shape[1])):
            dx, dy = corner[0] + (i + 0.5) * _SPOT_M - x, corner[1] + (j + 0.5) * _SPOT_M - y
            if abs(dx * c + dy * s) > a or abs(dy * c - dx * s) > b or last[i, j] == now:
                continue
            bare[i, j] -= 1.0
            if drove[i, j] > 0.0 and last[i, j] == drove[i, j]:
                after[i, j] += min(max(now - drove[i, j] - gap, 0.0), _AFTER_S) / gap
            last[i, j] = now
            drove[i, j] = now if speed > DRIVES_MPS else -1e18

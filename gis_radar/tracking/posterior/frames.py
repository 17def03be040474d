"""Frames, and the states of vehicles in them, as flat arrays for compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion

WINDOW_S = 0.5  # time in which the brightness of a vehicle, and whether it exists, are constant
_SILENT_S = 10.0  # a sensor without a detection on any lane for longer may be off
# Columns of a shape; BEHIND and AHEAD are curvatures of the path there.
X, Y, COS, SIN, SHAPE_SPEED, LENGTH, WIDTH, BEHIND, AHEAD = _SHAPE_COLUMNS = range(9)
BEND_M = 9.0  # distance over which curvatures are taken: half of the longest body


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Detections by sensor and frame.

    Parameters
    ----------
    row : (n,) int64 array
        Rows of the detections, sorted by sensor and time.
    sensor, time : (f,) arrays
        Sensor and time (UNIX seconds) of each frame.
    first : (f + 1,) int64 array
        Index in `row` of the first detection of each frame.
    begin : (k + 1,) int64 array
        The first frame of each sensor.
    window, group : (f,) int64 arrays
        Number of each frame's half second, and of its group: the frames of one sensor in one half
        second.
    sensor_xy : (k, 2) array
        Positions of the sensors, metres.
    """

    row: Integers
    sensor: Integers
    time: Floats
    first: Integers
    begin: Integers
    window: Integers
    group: Integers
    sensor_xy: Floats

    @classmethod
    def of(cls, detections: MapDetections) -> Frames:
        """Find the frames of detections; add the frames without any on lanes."""
        count = int(detections.sensor.max()) + 1
        order = np.lexsort((detections.time, detections.sensor))
        sensor, time = detections.sensor[order], detections.time[order]
        times = [_without_gaps(np.unique(time[sensor == k])) for k in range(count)]
        begin = np.concatenate([[0], np.cumsum([len(each) for each in times])])
        frame = np.concatenate(
            [begin[k] + np.searchsorted(times[k], time[sensor == k]) for k in range(count)]
        )
        of, when = np.repeat(np.arange(count), np.diff(begin)), np.concatenate(times)
        window = window_of(when)
        return cls(
            row=order, sensor=of, time=when,
            first=np.searchsorted(frame, np.arange(begin[-1] + 1)), begin=begin,
            window=window, group=groups_of(of, window), sensor_xy=detections.sensor_positions(),
        )  # fmt: skip

    def during(self, motion: Motion) -> Integers:
        """Return the frames of all sensors within the time of a motion, by sensor and time."""
        edges = [(motion.first_step - 0.5) * STEP_S, (motion.last_step + 0.5) * STEP_S]
        spans = zip(self.begin[:-1].tolist(), self.begin[1:].tolist(), strict=True)
        parts = []
        for low, high in spans:
            inside = low + np.searchsorted(self.time[low:high], edges)
            parts.append(np.arange(inside[0], inside[1]))
        return np.concatenate(parts)


def _without_gaps(known: Floats) -> Floats:
    """Return the times of frames, ascending, with those of frames missing in between."""
    gaps = np.diff(known)
    cadence = float(np.median(gaps)) if len(gaps) else STEP_S
    missing = np.maximum(np.round(gaps / cadence).astype(np.int64) - 1, 0)
    missing[gaps > _SILENT_S] = 0
    between = [
        np.linspace(known[k], known[k + 1], missing[k] + 2)[1:-1]
        for k in np.flatnonzero(missing).tolist()
    ]
    return np.sort(np.concatenate([known, *between]))


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """States: each vehicle in each frame of each sensor, by vehicle, sensor and time.

    Parameters
    ----------
    frame : (n,) int64 array
        Its frame.
    shape : (n, 9) array
        Its shape: east and north of the middle, cosine and sine of the heading, speed, length,
        width, and curvature of the path behind the middle and ahead of it, 1/m, with which the body
        bends.
    first : (v + 1,) int64 array
        Index of the first state of each vehicle.
    group : (n,) int64 array
        Number of its group: the states of one vehicle and sensor in one half second.
    """

    frame: Integers
    shape: Floats
    first: Integers
    group: Integers

    @classmethod
    def of(cls, frame_of: Sequence[Integers], frames: Frames) -> States:
        """Join the states of vehicles, from the frames of each; shapes have to be filled in."""
        first = np.cumsum([0, *map(len, frame_of)])
        frame = np.concatenate([np.zeros(0, np.int64), *frame_of])
        vehicle = np.repeat(np.arange(len(frame_of)), np.diff(first))
        return cls(
            frame=frame, shape=np.empty((len(frame), len(_SHAPE_COLUMNS))), first=first,
            group=groups_of(vehicle, frames.group[frame]),
        )  # fmt: skip

    @property
    def vehicle(self) -> Integers:
        """The vehicle of each state, (n,)."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))

    def rows(self, vehicle: int) -> slice:
        """Return the slice of the states of a vehicle."""
        return slice(int(self.first[vehicle]), int(self.first[vehicle + 1]))


def window_of(time: Floats) -> Integers:
    """Return the number of the half second of each time (UNIX seconds)."""
    return np.floor(time / WINDOW_S).astype(np.int64)


def groups_of(*columns: Integers) -> Integers:
    """Return the number of each row's run of equal rows."""
    changes = np.ones(len(columns[0]), np.bool_)
    changes[1:] = False
    for each in columns:
        changes[1:] |= each[1:] != each[:-1]
    return np.cumsum(changes) - 1


def motion_shapes(motion: Motion, time: Floats) -> Floats:
    """Return the shapes of a motion at times (n,), UNIX seconds, as of :class:`States`."""
    s_m, speed = motion.at(time)
    rear, front = (motion.path.heading_at(s_m + way * BEND_M) for way in (-1.0, 1.0))
    shape = np.empty((len(time), len(_SHAPE_COLUMNS)))
    shape[:, :COS], heading = motion.path.at(s_m)
    shape[:, COS], shape[:, SIN], shape[:, SHAPE_SPEED] = np.cos(heading), np.sin(heading), speed
    shape[:, LENGTH], shape[:, WIDTH] = motion.length_m, motion.width_m
    shape[:, BEHIND], shape[:, AHEAD] = (heading - rear) / BEND_M, (front - heading) / BEND_M
    return shape

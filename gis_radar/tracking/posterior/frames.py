"""Frames, and the states of vehicles in them, as flat arrays for compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion

WINDOW_S = 0.5  # the brightness of a vehicle, and whether it is there, is constant so long
SILENT_S = 10.0  # who detects nothing on any lane for longer may be off
X, Y, COS, SIN, SPEED, LENGTH, WIDTH, BEHIND, AHEAD = COLUMNS = range(9)  # of a shape
BEND_M = 9.0  # half of the longest body: the way over which it bends


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Detections by sensor and frame.

    Parameters
    ----------
    row : (n,) int64 array
        Positions in the detections that were given, by sensor and time.
    sensor, time : (f,) arrays
        Of each frame; UNIX seconds.
    first : (f + 1,) int64 array
        Where in `row` the detections of each frame begin.
    begin : (k + 1,) int64 array
        The first frame of each sensor.
    window, group : (f,) int64 arrays
        Half second of each frame; the frames of one sensor and half second are a group.
    eyes : (k, 2) array
        Places of the sensors, metres.
    """

    row: Integers
    sensor: Integers
    time: Floats
    first: Integers
    begin: Integers
    window: Integers
    group: Integers
    eyes: Floats

    @classmethod
    def of(cls, detections: MapDetections) -> Frames:
        """Gather the frames of detections; those without any on lanes are filled in."""
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
            window=window, group=groups_of(of, window), eyes=detections.eyes(),
        )  # fmt: skip

    def between(self, begin: float, end: float) -> Integers:
        """Return the frames of all sensors from one time to another, by sensor and time."""
        spans = zip(self.begin[:-1].tolist(), self.begin[1:].tolist(), strict=True)
        parts = []
        for low, high in spans:
            inside = low + np.searchsorted(self.time[low:high], [begin, end])
            parts.append(np.arange(inside[0], inside[1]))
        return np.concatenate(parts)


def _without_gaps(known: Floats) -> Floats:
    """Return the times of frames with those that are missing in between."""
    gaps = np.diff(known)
    cadence = float(np.median(gaps)) if len(gaps) else STEP_S
    missing = np.maximum(np.round(gaps / cadence).astype(np.int64) - 1, 0)
    missing[gaps > SILENT_S] = 0
    between = [
        np.linspace(known[k], known[k + 1], missing[k] + 2)[1:-1]
        for k in np.flatnonzero(missing).tolist()
    ]
    return np.sort(np.concatenate([known, *between]))


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """Vehicles in each frame of each sensor, by vehicle, sensor and time.

    Parameters
    ----------
    vehicle, frame, window : (n,) int64 arrays
        Of whom, in which frame, and in which half second.
    shape : (n, 9) array
        Middle east and north, cosine and sine of the heading, speed, length, width; curvature of
        the path behind the middle and ahead of it, 1 / m: the body bends with it.
    first : (v + 1,) int64 array
        The first state of each vehicle.
    group : (n,) int64 array
        States of one vehicle, sensor and half second are a group.
    """

    vehicle: Integers
    frame: Integers
    window: Integers
    shape: Floats
    first: Integers
    group: Integers

    @classmethod
    def of(cls, frame_of: Sequence[Integers], shape_of: Sequence[Floats], frames: Frames) -> States:
        """Return the states of vehicles, by the frames and the shapes of each."""
        sizes = [len(each) for each in frame_of]
        frame = np.concatenate([np.zeros(0, np.int64), *frame_of])
        vehicle = np.repeat(np.arange(len(sizes)), sizes)
        return cls(
            vehicle=vehicle, frame=frame, window=frames.window[frame],
            shape=np.concatenate([np.zeros((0, len(COLUMNS))), *shape_of]),
            first=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            group=groups_of(vehicle, frames.group[frame]),
        )  # fmt: skip

    def rows(self, vehicle: int) -> slice:
        """Return where the states of a vehicle are."""
        return slice(int(self.first[vehicle]), int(self.first[vehicle + 1]))


def window_of(time: Floats) -> Integers:
    """Return the half second of each time."""
    return np.floor(time / WINDOW_S).astype(np.int64)


def groups_of(*columns: Integers) -> Integers:
    """Return the number of the run of equal rows that each row is in."""
    changes = np.ones(len(columns[0]), np.bool_)
    changes[1:] = False
    for each in columns:
        changes[1:] |= each[1:] != each[:-1]
    return np.cumsum(changes) - 1


def motion_states(motion: Motion, frames: Frames) -> tuple[Integers, Floats]:
    """Return the frames in which a motion has states, and its shape in each."""
    frame = frames.between((motion.first_step - 0.5) * STEP_S, (motion.last_step + 0.5) * STEP_S)
    s_m, speed = motion.at(frames.time[frame])
    rear, front = (motion.path.heading_at(s_m + way * BEND_M) for way in (-1.0, 1.0))
    shape = np.empty((len(frame), len(COLUMNS)))
    shape[:, :COS], heading = motion.path.at(s_m)
    shape[:, COS], shape[:, SIN], shape[:, SPEED] = np.cos(heading), np.sin(heading), speed
    shape[:, LENGTH], shape[:, WIDTH] = motion.length_m, motion.width_m
    shape[:, BEHIND], shape[:, AHEAD] = (heading - rear) / BEND_M, (front - heading) / BEND_M
    return frame, shape

"""Detections on lanes, of all sensors, in the map and in the order of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.hdmap import FieldArrays, LaneGraph, lanes_at
from gis_radar.poses import Pose
from gis_radar.recordings import Detections

_LEAST_COS = 0.3  # least cosine of the elevation: steeper below, range rates give no speed
# Heights over the road of vehicles' detections: multipath by the road lies below it, the highest
# trucks are 4 m.
LOW_M, HIGH_M = -1.0, 4.5
HEIGHT_RAD = 0.035  # tolerance of the height by the elevation: 2 sigma of a recorded ARS548
MOVING_MPS = 0.15  # least absolute range rate of what moves: seven sigma of a recorded ARS548
# The same in sigmas of the sensor's own noise, where that is more: of 500 fixed detections a frame,
# one seems to move every three minutes.
_STILL_SIGMAS = 5.0
# The noise is measured in the first NOISE_S by detections slower than SLOW_MPS, at least so many (a
# sigma to 3 %). SLOW_MPS is also the upper bound of the threshold.
NOISE_S, SLOW_MPS, _LEAST_SLOW = 20.0, 0.3, 1000
_PEAK_SHARE = 0.5  # least share of them below a third of SLOW_MPS; of uniform ones a third is
AZIMUTH_RAD = 0.004  # sigma of a bearing, including the bias of each target


@dataclass(frozen=True, kw_only=True)
class MapDetections:
    """Detections that can come from a vehicle on a lane, in the order of time.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds.
    points : (n, 2) array
        In the map, from the origin of the lane graph, metres.
    height_m : (n,) array
        Over the road; NaN where the sensor measures no elevation or the road's height is unknown.
    range_rate : (n,) array
        Range rate in the plane, m/s: the measured one divided by the cosine of the elevation.
    sight : (n, 2) array
        Line of sight: horizontal unit vectors from the sensor to the detection.
    range_m : (n,) array
        Distance from the sensor, metres.
    sensor : (n,) int64 array
        Number of the sensor.
    rcs : (n,) array
        dBm2; NaN where it is not known.
    """

    time: Floats
    points: Floats
    height_m: Floats
    range_rate: Floats
    sight: Floats
    range_m: Floats
    sensor: Integers
    rcs: Floats

    def __len__(self) -> int:
        return len(self.time)

    def take(self, keep: Booleans | Integers | slice) -> Self:
        """Return some rows."""
        return type(self)(**{each.name: getattr(self, each.name)[keep] for each in fields(self)})

    def sensor_positions(self) -> Floats:
        """Return the positions of the sensors, (sensors, 2), metres; 0 without detections."""
        away = self.points - self.sight * self.range_m[:, None]
        found = np.zeros((int(self.sensor.max(initial=-1)) + 1, 2))
        for sensor in np.unique(self.sensor).tolist():
            found[sensor] = np.median(away[self.sensor == sensor], axis=0)
        return found

    def reversed(self) -> MapDetections:
        """Return the detections in reversed time, with negative times and range rates."""
        back = self.take(slice(None, None, -1))
        return replace(back, time=-back.time, range_rate=-back.range_rate)

    @classmethod
    def none(cls) -> Self:
        """Return no detections."""
        empty = np.zeros(0)
        return cls(
            time=empty, points=np.zeros((0, 2)), height_m=empty, range_rate=empty,
            sight=np.zeros((0, 2)), range_m=empty, sensor=np.zeros(0, np.int64), rcs=empty,
        )  # fmt: skip

    @classmethod
    def join(cls, parts: Sequence[MapDetections]) -> Self:
        """Join several in the order of time."""
        if not parts:
            return cls.none()
        table = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(cls)
        }
        order = np.argsort(table["time"], kind="stable")
        return cls(**{name: values[order] for name, values in table.items()})


def map_detections(
    read: Detections,
    pose: Pose,
    number: int,
    graph: LaneGraph,
    *,
    road_m: float = np.nan,
    still_mps: float = 0.0,
) -> MapDetections:
    """Return the detections that lie on lanes, in the map.

    Parameters
    ----------
    read : Detections
        Rows of a recording, none of them an empty frame.
    pose : Pose
        Pose of the sensor.
    number : int
        Number of the sensor.
    graph : LaneGraph
        The lanes.
    road_m : float
        Height of the road near the sensor, metres, for one that measures no elevation.
    still_mps : float
        Largest range rate of still detections of this sensor, from :func:`still_rate`.
    """
    points = pose.to_map(read.points, road_m=road_m) - [*graph.origin, 0.0]
    points[np.isnan(read.points[:, 2]), 2] = np.nan
    sensor_place = pose.position - [*graph.origin, 0.0]
    range_m = read.range_m
    height, on = _over_lanes(points, range_m, graph.field.arrays)
    kept = np.flatnonzero(on & np.isfinite(read.range_rate))
    away = points[kept, :2] - sensor_place[:2]
    ground_range = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
    cos_elevation = np.maximum(ground_range / np.maximum(range_m[kept], 1e-6), _LEAST_COS)
    rate = read.range_rate[kept]
    return MapDetections(
        time=read.time[kept],
        points=points[kept, :2].copy(),
        height_m=height[kept],
        range_rate=np.where(np.abs(rate) < still_mps, 0.0, rate) / cos_elevation,
        sight=away / ground_range[:, None],
        range_m=range_m[kept],
        sensor=np.full(len(kept), number, np.int64),
        rcs=np.where(np.isfinite(read.rcs), read.rcs, np.nan)[kept],
    )


def still_rate(range_rate: Floats) -> float:
    """Return the largest absolute range rate of still detections of a sensor, m/s.

    Parameters
    ----------
    range_rate : (n,) array
        Range rates of all detections of some seconds, m/s. With fixed targets they have a peak at
        zero, whose width is the noise; where only moving ones are recorded there is none.
    """
    slow = np.abs(range_rate[np.abs(range_rate) < SLOW_MPS])
    peak = (slow < SLOW_MPS / 3.0).mean() if len(slow) >= _LEAST_SLOW else 0.0
    if peak < _PEAK_SHARE:
        return MOVING_MPS
    sigma = float(np.median(slow)) / 0.6745  # the median of a normal's absolute value
    return float(np.clip(_STILL_SIGMAS * sigma, MOVING_MPS, SLOW_MPS))


@compiled
def _over_lanes(points: Floats, range_m: Floats, field: FieldArrays) -> tuple[Floats, Booleans]:
    """Return each point's height over the nearest lane, and whether it can be of a vehicle."""
    lanes = np.empty((8, 6))
    height, on = np.full(len(points), np.nan), np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        found = lanes_at(points[i, 0], points[i, 1], field, lanes)
        tolerance = HEIGHT_RAD * range_m[i]
        for k in range(found):
            over = points[i, 2] - lanes[k, 5]
            if np.isnan(over):  # road or sensor without heights
                on[i] = True
            elif LOW_M - tolerance <= over <= HIGH_M + tolerance:
                on[i] = True
                if np.isnan(height[i]) or abs(over) < abs(height[i]):
                    height[i] = over
    return height, on

"""Detections near the road: select those that a sensor sends, and pack them to bytes.

A sensor sends the detections that the tracker uses: within a metre of a tile, at heights that
vehicles have, in the radar's order. Positions are in units of 4 mm, range rates of 2 mm/s, cut
towards zero so that values below a limit stay below it; rates within the radar's noise become 0, as
only the sensor has all detections that show this noise. With cm and cm/s a tenth of the vehicles'
states would differ from the recording's. A frame has a column for each quantity, in Rice codes: the
quotient by 2^k as ones and a zero, then the remainder in k bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Floats, InputError, Integers, compiled
from gis_radar.hdmap import LANE_MARGIN_M, TileGrid
from gis_radar.live.wire.payload import MOST_FRAMES, POSE_BYTES, Numbers, varint
from gis_radar.measures import NO_FURTHER
from gis_radar.poses import Pose
from gis_radar.recordings import Detections
from gis_radar.scans import SightTiles
from gis_radar.tracking import HEIGHT_RAD, HIGH_M, LOW_M, NOISE_S, SLOW_MPS, still_rate

_UNITS, _RATES = 250, 500  # units in a metre, and in a metre a second
UNKNOWN_Z, _UNKNOWN_DB = -2_500_000, -128  # no elevation, no cross section
_UNKNOWN_RATE = -2_500_000
FARTHEST = 25_000_000  # largest coordinate: 100 km
_MOST_DETECTIONS = 20_000  # most detections of a frame: a radar sends hundreds
_COLUMNS = 5
_MOST_LOW = 40  # most bits of a remainder
_LAST_SHIFT = 56  # shift of the last byte of a varint under 2**63
Bytes: TypeAlias = NDArray[np.uint8]
_LEARN_EVERY_S = 1.0  # between two estimates of the noise, while it is learned


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDetections:
    """The detections of a frame that the tracker needs.

    Parameters
    ----------
    time_us : int
        Microseconds since 1970, UTC.
    points : (n, 3) int64 array
        Sensor frame, 4 mm: x forward, y left, z up; `UNKNOWN_Z` for a z that is not measured.
    rates : (n,) int64 array
        Range rate, 2 mm/s, positive when receding, cut towards zero; 0 within the noise,
        `_UNKNOWN_RATE` where it is not known.
    rcs_db : (n,) int64 array
        Cross section, dBm2; `_UNKNOWN_DB` where it is not known.
    """

    time_us: int
    points: Integers
    rates: Integers
    rcs_db: Integers

    def as_rows(self) -> Detections:
        """Return the detections as rows of a recording: one row of NaN where there are none."""
        if len(self.points) == 0:
            gap = np.full(1, np.nan)
            return Detections(
                time=np.full(1, self.time_us / 1e6), points=np.full((1, 3), np.nan),
                range_rate=gap, rcs=gap, further=NO_FURTHER,
            )  # fmt: skip
        points = self.points / _UNITS
        points[self.points[:, 2] == UNKNOWN_Z, 2] = np.nan
        rcs = np.where(self.rcs_db == _UNKNOWN_DB, np.nan, self.rcs_db.astype(np.float64))
        # the middle of the rates that are cut to the same number
        rates = (self.rates + 0.5 * np.sign(self.rates)) / _RATES
        rates[self.rates == _UNKNOWN_RATE] = np.nan
        time = np.full(len(points), self.time_us / 1e6)
        return Detections(
            time=time, points=_as_float32(points), range_rate=_as_float32(rates), rcs=rcs,
            further=NO_FURTHER,
        )  # fmt: skip


def _as_float32(values: Floats) -> Floats:
    """Round to float32 as a recording does, so that the map of now counts as a dataset does."""
    return values.astype(np.float32).astype(np.float64)


class DetectionSelector:
    """Selector of the detections that the tracker needs, which learns the noise of range rates.

    Parameters
    ----------
    road : SightTiles
        All tiles.
    """

    def __init__(self, road: SightTiles) -> None:
        self._height = road.height
        self._grid = TileGrid(_widened(road.quads, LANE_MARGIN_M))
        self._rates: list[Floats] = []
        self._begin_s = self._learned_s = np.nan
        self.still_mps = SLOW_MPS  # until it is learned; high, so that nothing stationary moves

    def find(self, frame: Detections, pose: Pose, *, road_m: float) -> FrameDetections:
        """Return the detections of a frame that a tracker needs.

        Parameters
        ----------
        frame : Detections
            A whole frame.
        pose : Pose
            Pose of the sensor.
        road_m : float
            Height of the road near the sensor, metres, for one that measures no elevation.
        """
        time = float(frame.time[0])
        self._learn(frame, time)
        place = pose.to_map(frame.points, road_m=road_m)
        point, tile = self._grid.assign(place[:, 0], place[:, 1])
        height_m = place[point, 2] - self._height[tile]
        height_m[np.isnan(frame.points[point, 2])] = np.nan
        margin_m = HEIGHT_RAD * frame.range_m[point]
        fits = (height_m >= LOW_M - margin_m) & (height_m <= HIGH_M + margin_m)
        keep = np.zeros(len(frame), np.bool_)
        keep[point[fits | np.isnan(height_m)]] = True
        points, rate, rcs = frame.points[keep], frame.range_rate[keep], frame.rcs[keep]
        still = np.abs(rate) < self.still_mps
        return FrameDetections(
            time_us=int(np.rint(time * 1e6)),
            points=_rounded(_UNITS * points, UNKNOWN_Z),
            rates=_rounded(
                np.where(still, 0.0, np.trunc(np.round(_RATES * rate, 3))), _UNKNOWN_RATE
            ),
            rcs_db=_rounded(rcs, _UNKNOWN_DB),
        )

    def _learn(self, frame: Detections, time: float) -> None:
        """Learn from the first seconds the largest range rate of stationary detections."""
        if np.isnan(self._begin_s):
            self._begin_s = self._learned_s = time
        elif not self._rates:
            return
        if time < self._begin_s + NOISE_S:
            self._rates.append(frame.range_rate[np.isfinite(frame.range_rate)])
        done = time >= self._begin_s + NOISE_S
        if done or time >= self._learned_s + _LEARN_EVERY_S:
            self._learned_s = time
            self.still_mps = still_rate(np.concatenate(self._rates))
        if done:
            self._rates = []


def _widened(quads: Floats, by_m: float) -> Floats:
    """Return the corners of tiles, widened on both sides."""
    across = quads[:, [0, 1]] - quads[:, [3, 2]]
    across /= np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-6)
    return np.concatenate(
        [quads[:, [0, 1]] + by_m * across, quads[:, [2, 3]] - by_m * across[:, ::-1]], axis=1
    )


def _rounded(values: Floats, unknown: int) -> Integers:
    return np.where(np.isnan(values), unknown, np.rint(values)).astype(np.int64)


def pack_detections(frames: Sequence[FrameDetections], *, pose: bytes) -> bytes:
    """Return the detections of frames as the content of a message.

    Parameters
    ----------
    frames : sequence of FrameDetections
        In order of time.
    pose : bytes
        Key of the pose by which they were selected.
    """
    parts, before = [pose, varint(len(frames))], 0
    for frame in frames:
        parts += [varint(frame.time_us - before), varint(len(frame.points))]
        before = frame.time_us
        if len(frame.points):
            parts += map(_pack_column, (*frame.points.T, frame.rates, frame.rcs_db))
    return b"".join(parts)


def unpack_detections(content: bytes) -> tuple[bytes, tuple[FrameDetections, ...]]:
    """Return the key of the pose, and the detections of the frames of a message.

    Raises
    ------
    InputError
        If the bytes are no such content.
    """
    read = Numbers(content, 0)
    pose, count = read.bytes(POSE_BYTES), read.take()
    if not 0 < count <= MOST_FRAMES:
        raise InputError("a message of {} frames, expected 1 to {}", count, MOST_FRAMES)
    data, frames, time_us = np.frombuffer(content, np.uint8), [], 0
    for _ in range(count):
        time_us += read.take()
        size = read.take()
        if size > min(_MOST_DETECTIONS, 8 * (len(content) - read.at)):
            raise InputError("a frame of {} detections in {} bytes", size, len(content))
        columns = np.empty((_COLUMNS, size), np.int64)
        if size:
            read.at = _unpack_columns(data, read.at, columns)
            if read.at < 0:
                raise InputError("a message ends within its detections")
        frames.append(_frame_of(time_us, columns))
    read.end()
    return pose, tuple(frames)


def _frame_of(time_us: int, columns: Integers) -> FrameDetections:
    """Return a frame from its columns; refuse values that no radar measures."""
    if columns.size and (columns.min() < -FARTHEST or columns.max() > FARTHEST):
        raise InputError("a frame with a detection beyond {:g} km", FARTHEST / (1000 * _UNITS))
    level = columns[2] == UNKNOWN_Z
    if level.any() and not level.all():
        raise InputError("a frame in which some detections have a height and others none")
    points = np.ascontiguousarray(columns[:3].T)
    return FrameDetections(time_us=time_us, points=points, rates=columns[3], rcs_db=columns[4])


def _pack_column(values: Integers) -> bytes:
    """Pack numbers to bytes: k, their median, then quotients and remainders as bits."""
    middle = int(np.sort(values)[len(values) // 2])
    deviation = _folded(values - middle)
    mean = int(deviation.mean())
    most = range(max(mean.bit_length() - 2, 0), min(mean.bit_length() + 2, _MOST_LOW) + 1)
    low = min(most, key=lambda k: k * len(deviation) + int((deviation >> k).sum()))
    quotient = deviation >> low
    ends = np.cumsum(quotient + 1) - 1
    ones = np.ones(int(ends[-1]) + 1, np.uint8)
    ones[ends] = 0
    rest = (deviation[:, None] >> np.arange(low - 1, -1, -1)) & 1
    bits = np.concatenate([ones, rest.ravel().astype(np.uint8)])
    return bytes([low]) + varint(int(_folded(np.array(middle)))) + np.packbits(bits).tobytes()


def _folded(values: Integers) -> Integers:
    """Map signed numbers to numbers from 0: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    return np.asarray((values << 1) ^ (values >> 63))


@compiled
def _unpack_column(  # pragma: no cover - compiled
    data: Bytes, at: int, out: Integers
) -> int:
    """Unpack a column of :func:`_pack_column` into `out`; return its end, -1 if data are short."""
    if at >= len(data) or data[at] > _MOST_LOW:
        return -1
    low, middle, shift, more = int(data[at]), 0, 0, True
    while more:
        at += 1
        if at >= len(data) or shift > _LAST_SHIFT:
            return -1
        middle |= (int(data[at]) & 0x7F) << shift
        more = data[at] >= 0x80
        shift += 7
    middle = (middle >> 1) ^ -(middle & 1)
    bit, end = 8 * (at + 1), 8 * len(data)
    for k in range(len(out)):
        out[k] = 0
        while bit < end and data[bit >> 3] & (0x80 >> (bit & 7)):
            out[k] += 1
            bit += 1
        bit += 1
    if bit + len(out) * low > end:
        return -1
    for k in range(len(out)):
        value = out[k]
        for _ in range(low):
            value = (value << 1) | ((data[bit >> 3] >> (7 - (bit & 7))) & 1)
            bit += 1
        out[k] = ((value >> 1) ^ -(value & 1)) + middle
    return (bit + 7) >> 3


@compiled
def _unpack_columns(  # pragma: no cover - compiled
    data: Bytes, at: int, columns: Integers
) -> int:
    """Unpack the columns of a frame as :func:`_unpack_column` does each."""
    for k in range(len(columns)):
        if at >= 0:
            at = _unpack_column(data, at, columns[k])
    return at

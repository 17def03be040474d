"""Hashes of frames: equal for equal rows, independent of file and batch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Floats, Integers, compiled, contiguous
from gis_radar.recordings import Detections

Hashes: TypeAlias = NDArray[np.uint64]
Bits: TypeAlias = NDArray[np.uint32]
# Odd multipliers with about as many ones as zeros (Knuth's and Steele's), so that all bits mix.
_FIRST, _SECOND, _TURN = (
    np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(31),
)  # fmt: skip
_HALF = np.uint64(32)  # bits of half of a word
_STEP = np.uint64(0xD1342543DE82EF95)  # added for each row, so that the order of rows counts
_HASH, _DETECTIONS, _ROWS = 0, 1, 2  # entries of the state of the open frame


@dataclass(frozen=True, kw_only=True)
class HashedFrames:
    """Frames with their times, hashes and numbers of detections.

    Parameters
    ----------
    time : (f,) array
        Times, corrected, UNIX seconds, ascending.
    hash : (f,) uint64 array
        Hash of the rows' positions, range rates and, if read, radar cross sections.
    detections : (f,) int64 array
        Number of rows with a position.
    """

    time: Floats
    hash: Hashes
    detections: Integers

    def __len__(self) -> int:
        return len(self.time)

    @property
    def time_us(self) -> Integers:
        """Times in microseconds since 1970."""
        return np.rint(self.time * 1e6).astype(np.int64)

    def take(self, keep: Any) -> HashedFrames:
        """Return some of the frames, by a mask, indices or a slice."""
        return HashedFrames(
            time=self.time[keep], hash=self.hash[keep], detections=self.detections[keep]
        )

    @classmethod
    def join(cls, parts: list[HashedFrames]) -> HashedFrames:
        """Return the frames of several parts, one after the other."""
        empty = (np.empty(0), np.empty(0, np.uint64), np.empty(0, np.int64))
        columns = [empty, *((each.time, each.hash, each.detections) for each in parts)]
        time, hashes, detections = map(np.concatenate, zip(*columns, strict=True))
        return cls(time=time, hash=hashes, detections=detections)


@dataclass(kw_only=True)
class FrameHasher:
    """Hasher of the frames of a recording, batch by batch.

    Parameters
    ----------
    rcs : bool
        Whether radar cross sections count.
    """

    rcs: bool
    _time: Floats = field(default_factory=lambda: np.array([math.nan]))
    _state: Hashes = field(default_factory=lambda: np.zeros(3, np.uint64))
    _found: list[tuple[Floats, Hashes]] = field(default_factory=list)

    def add(self, time: Floats, rows: Detections, begin: int, end: int) -> None:
        """Take rows that follow those so far.

        Parameters
        ----------
        time : (n,) array
            Corrected times of all rows of the batch, UNIX seconds.
        rows : Detections
            The batch.
        begin, end : int
            Range of the rows to take.
        """
        x, y, z, rate, rcs = (
            _bits(each[begin:end]) for each in (*rows.points.T, rows.range_rate, rows.rcs)
        )
        rcs = rcs if self.rcs else rcs[:0]
        times, frames = np.empty(end - begin + 1), np.empty((end - begin + 1, 2), np.uint64)
        count = _hash_rows(
            contiguous(time[begin:end]), x, y, z, rate, rcs, self._time, self._state, times, frames
        )
        self._found.append((times[:count].copy(), frames[:count].copy()))

    def end(self) -> HashedFrames:
        """Close the open frame; return all frames."""
        if not math.isnan(self._time[0]):
            self._found.append((self._time.copy(), self._state[None, :_ROWS].copy()))
        times = np.concatenate([np.empty(0), *(each[0] for each in self._found)])
        frames = np.concatenate([np.empty((0, 2), np.uint64), *(each[1] for each in self._found)])
        return HashedFrames(
            time=times, hash=frames[:, _HASH].copy(),
            detections=frames[:, _DETECTIONS].astype(np.int64),
        )  # fmt: skip


def _bits(values: Floats) -> Bits:
    return np.asarray(contiguous(values.astype(np.float32, copy=False)).view(np.uint32))


@compiled
def _hash_rows(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    time: Floats, x: Bits, y: Bits, z: Bits, rate: Bits, rcs: Bits, open_time: Floats,
    state: Hashes, times: Floats, frames: Hashes,
) -> int:  # fmt: skip
    """Fill `times` and `frames` with the frames that end; return how many. The last stays open."""
    count, has_rcs = 0, len(rcs) > 0
    now, mixed, present, place = open_time[0], state[_HASH], state[_DETECTIONS], state[_ROWS]
    for k in range(len(time)):
        if time[k] != now:
            if not math.isnan(now):
                times[count], frames[count, _HASH], frames[count, _DETECTIONS] = now, mixed, present
                count += 1
            now, mixed, present, place = time[k], np.uint64(0), np.uint64(0), np.uint64(0)
        # The hash is a sum over rows, each mixed by itself: processors do several at once.
        place += _STEP
        row = (((np.uint64(x[k]) << _HALF) | np.uint64(y[k])) ^ place) * _FIRST
        row ^= (row >> _TURN) ^ ((np.uint64(z[k]) << _HALF) | np.uint64(rate[k]))
        row *= _SECOND
        if has_rcs:
            row = (row ^ (row >> _TURN) ^ np.uint64(rcs[k])) * _FIRST
        mixed += row ^ (row >> _TURN)
        # A NaN has all bits of the exponent: a row without a position is no detection.
        present += np.uint64((x[k] & np.uint32(0x7F800000)) != np.uint32(0x7F800000))
    open_time[0], state[_HASH], state[_DETECTIONS], state[_ROWS] = now, mixed, present, place
    return count

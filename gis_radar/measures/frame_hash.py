"""Hashes of frames: equal for equal rows, independent of file and batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import Floats, Integers, compiled
from gis_radar.measures.frames import FrameIndex
from gis_radar.recordings import Detections

Hashes: TypeAlias = NDArray[np.uint64]
Bits: TypeAlias = NDArray[np.uint32]
# Odd multipliers with about as many ones as zeros (Knuth's and Steele's), so that all bits mix.
_FIRST, _SECOND, _TURN = (
    np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(31),
)  # fmt: skip
_HALF = np.uint64(32)  # bits of half of a word
_STEP = np.uint64(0xD1342543DE82EF95)  # added for each row, so that the order of rows counts


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


def hash_frames(time: Floats, rows: Detections, *, rcs: bool) -> HashedFrames:
    """Hash frames.

    Parameters
    ----------
    time : (n,) array
        Corrected times of the rows, UNIX seconds, ascending.
    rows : Detections
        The rows of some frames, each whole.
    rcs : bool
        Whether radar cross sections count.
    """
    frames = FrameIndex.of(time)
    x, y, z, rate = map(_bits, (*rows.points.T, rows.range_rate))
    strength = _bits(rows.rcs if rcs else rows.rcs[:0])
    return HashedFrames(
        time=frames.time,
        hash=_hashed(x, y, z, rate, strength, frames.begins),
        detections=frames.count(rows.present),
    )


def _bits(values: Floats) -> Bits:
    return np.asarray(values).astype(np.float32).view(np.uint32)


@compiled
def _hashed(
    x: Bits, y: Bits, z: Bits, rate: Bits, rcs: Bits, begins: Integers
) -> Hashes:  # pragma: no cover - compiled
    """Return the hash of each frame: the sum over its rows, each mixed by itself and its place."""
    found = np.zeros(len(begins), np.uint64)
    for frame in range(len(begins)):
        end = begins[frame + 1] if frame + 1 < len(begins) else len(x)
        place = np.uint64(0)
        for k in range(begins[frame], end):
            place += _STEP
            row = (((np.uint64(x[k]) << _HALF) | np.uint64(y[k])) ^ place) * _FIRST
            row ^= (row >> _TURN) ^ ((np.uint64(z[k]) << _HALF) | np.uint64(rate[k]))
            row *= _SECOND
            if len(rcs) > 0:
                row = (row ^ (row >> _TURN) ^ np.uint64(rcs[k])) * _FIRST
            found[frame] += row ^ (row >> _TURN)
    return found

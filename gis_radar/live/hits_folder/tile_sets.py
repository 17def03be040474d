"""Sets of tiles as bytes: how hits are stored, and sent by a sensor's computer.

A set is written ascending: the first tile, then for each further one how many tiles were left out
since the one before. Each number is a varint (LEB128, as in Protocol Buffers): seven bits a byte,
the lowest first, the high bit set in all bytes but the last. No set has two forms, and what is no
set is refused: bytes that end within a number, numbers longer than need be, tiles over 2**63 - 1.
The empty set has no bytes. A frame's 50 tiles take 56 bytes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gis_radar.arrays import Integers, compiled
from gis_radar.errors import InputError

Bytes = NDArray[np.uint8]
MOST_BYTES = 9  # of a number under 2**63
LAST_TILE = int(np.iinfo(np.int64).max)
CUT, LONG, LARGE = 1, 2, 3
REASONS = {
    CUT: "it ends within a number",
    LONG: "a number is longer than need be",
    LARGE: "a tile is over 2**63 - 1",
}


def pack_tiles(tiles: Integers) -> bytes:
    """Return a set of tiles as bytes.

    Parameters
    ----------
    tiles : (k,) int64 array
        Ids or positions of tiles, from 0, ascending, each once.

    Raises
    ------
    InputError
        If they are not.

    Examples
    --------
    >>> pack_tiles(np.array([5, 6, 7, 310])).hex()
    '050000ae02'
    """
    tiles = np.asarray(tiles, np.int64)
    return pack_sets(tiles, np.array([0, len(tiles)]))[0].tobytes()


def unpack_tiles(
    blob: bytes, *, below: int | None = None, what: str = "a set of tiles"
) -> Integers:
    """Return the tiles of a set, ascending.

    Parameters
    ----------
    blob : bytes
        As of :func:`pack_tiles`.
    below : int, optional
        How many tiles there are; the set names none from this number on.
    what : str
        What it is, for the message.

    Raises
    ------
    InputError
        If the bytes are no set, or name a tile that is not there.
    """
    data = np.frombuffer(blob, np.uint8)
    tiles, _ = unpack_sets(data, np.array([0, len(data)]), what=what)
    if below is not None and len(tiles) and tiles[-1] >= below:
        raise InputError(f"{what}: damaged: names tile {tiles[-1]} of {below}")
    return tiles


def pack_sets(tiles: Integers, begins: Integers) -> tuple[Bytes, Integers]:
    """Return many sets of tiles as bytes, one after the other.

    Parameters
    ----------
    tiles : (k,) int64 array
        The tiles of all sets: each set ascending, from 0, each tile once.
    begins : (n + 1,) int64 array
        Where each set begins among them, and the end of the last one.

    Returns
    -------
    data : (m,) uint8 array
        All bytes.
    begins : (n + 1,) int64 array
        Where each set begins among them, and the end of the last one.

    Raises
    ------
    InputError
        If a set does not ascend, or has a negative tile.
    """
    data, at = np.empty(MOST_BYTES * len(tiles), np.uint8), np.zeros(len(begins), np.int64)
    bad = _encode(tiles, begins, data, at)
    if bad >= 0:
        raise InputError(
            f"tile {tiles[bad]} is in no place of a set of tiles: expected whole numbers from 0, "
            "ascending, each once"
        )
    return data[: at[-1]].copy(), at


def unpack_sets(
    data: Bytes, begins: Integers, *, what: str = "sets of tiles"
) -> tuple[Integers, Integers]:
    """Return the tiles of many sets; the reverse of :func:`pack_sets`.

    Parameters
    ----------
    data : (m,) uint8 array
        The bytes of all sets.
    begins : (n + 1,) int64 array
        Where each set begins among them, and the end of the last one.
    what : str
        What they are, for the message.

    Returns
    -------
    tiles : (k,) int64 array
        The tiles of all sets, each set ascending.
    begins : (n + 1,) int64 array
        Where each set begins among them, and the end of the last one.

    Raises
    ------
    InputError
        If bytes are no set.
    """
    tiles = np.empty(int(begins[-1] - begins[0]), np.int64)  # a tile takes a byte at least
    at = np.zeros(len(begins), np.int64)
    number, fault = _decode(data, begins, tiles, at)
    if fault:
        raise InputError(f"{what}: damaged: set {number + 1}: {REASONS[fault]}")
    return tiles[: at[-1]].copy(), at


@compiled
def _encode(  # pragma: no cover - compiled
    tiles: Integers, begins: Integers, data: Bytes, at: Integers
) -> int:
    """Fill in bytes, and where each set begins; return the place of a tile that is wrong, or -1."""
    size = 0
    for number in range(len(begins) - 1):
        before = -1
        for place in range(begins[number], begins[number + 1]):
            tile = tiles[place]
            if tile <= before:
                return place
            rest = tile - (before + 1)  # the last tile has no successor
            while rest >= 128:
                data[size] = rest & 127 | 128
                rest >>= 7
                size += 1
            data[size] = rest
            size += 1
            before = tile
        at[number + 1] = size
    return -1


@compiled
def _decode(  # pragma: no cover - compiled
    data: Bytes, begins: Integers, tiles: Integers, at: Integers
) -> tuple[int, int]:
    """Fill in tiles, and where each set begins; return the set that is damaged and why, or 0."""
    found = 0
    for number in range(len(begins) - 1):
        before, place = -1, begins[number]
        while place < begins[number + 1]:
            rest, place, fault = _varint(data, place, begins[number + 1])
            if fault == 0 and rest > LAST_TILE - 1 - before:
                fault = LARGE
            if fault != 0:
                return number, fault
            before += rest + 1
            tiles[found] = before
            found += 1
        at[number + 1] = found
    return 0, 0


@compiled
def _varint(  # pragma: no cover - compiled
    data: Bytes, place: int, end: int
) -> tuple[int, int, int]:
    """Return a number, where it ends, and what is wrong with it, or 0."""
    value = 0
    for k in range(MOST_BYTES):
        if place + k >= end:
            return 0, place, CUT
        byte = int(np.int64(data[place + k]))
        value |= (byte & 127) << (7 * k)
        if byte < 128:
            return value, place + k + 1, LONG if byte == 0 and k > 0 else 0
    return 0, place, LARGE

"""Unpack compressed data up to a limit: a few kilobytes can hold gigabytes of zeros."""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any, BinaryIO, Self

from gis_radar.base import Text
from gis_radar.recordings import settings


class ExplodingError(ValueError):
    """Packed bytes that grow beyond anything a radar delivers."""


class LimitedStream:
    """A stream of unpacked bytes that fails where they exceed a multiple of the packed ones.

    Parameters
    ----------
    stream : binary file
        Yields the unpacked bytes.
    packed_bytes : int
        Size of the packed file, bytes.
    """

    def __init__(self, stream: BinaryIO, packed_bytes: int) -> None:
        self._stream, self._read = stream, 0
        self._most = settings.FREE_EXPANSION_BYTES + settings.MOST_EXPANSION * packed_bytes

    def read(self, size: int = -1) -> bytes:
        """Read some bytes.

        Raises
        ------
        ExplodingError
            If more bytes were unpacked than honest packed bytes can hold.
        """
        data = self._stream.read(size)
        self._read += len(data)
        if self._read > self._most:
            times = settings.MOST_EXPANSION
            raise ExplodingError(Text("grows to over {} times its size when it is unpacked", times))
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()


def unpacked(make: Callable[[], Any], packed: bytes) -> bytes:
    """Return the unpacked bytes of one chunk of a bag.

    Parameters
    ----------
    make : callable
        Returns a decompressor of the standard library's kind: `decompress(data, max_length)`,
        `eof`, `unused_data`.
    packed : bytes
        The whole chunk: one compressed stream or several.

    Raises
    ------
    ExplodingError
        If it unpacks to more than a chunk may hold.
    """
    most = settings.MOST_CHUNK_BYTES
    plain = bytearray()
    while True:
        decompressor = make()
        plain += decompressor.decompress(packed, most + 1 - len(plain))
        if len(plain) > most:
            raise ExplodingError(
                Text("a chunk holds over {:,} MiB when it is unpacked", most >> 20)
            )
        if not decompressor.eof:
            raise ValueError(Text("a chunk is cut off"))
        packed = decompressor.unused_data
        if not packed:
            return bytes(plain)


@cache
def limit_rosbags() -> None:
    """Limit how much the library for bags unpacks: it has no limits of its own."""
    from rosbags.rosbag1 import reader as bag1  # noqa: PLC0415 - a fifth of a second
    from rosbags.rosbag2 import reader as bag2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    for module in (bag2, storage_mcap):
        if (zstd := getattr(module, "zstd", None)) is not None:
            setattr(module, "zstd", _limited_zstd(zstd))  # noqa: B010 - for any version
    frames: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor}
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # noqa: PLC0415

    frames["lz4"] = LZ4FrameDecompressor
    for name, make in frames.items():
        for known in (
            getattr(bag1, "decompressors", {}),
            getattr(storage_mcap, "DECOMPRESSORS", {}),
        ):
            if name in known:
                known[name] = lambda packed, *_, make=make: unpacked(make, packed)


def _limited_zstd(zstd: Any) -> SimpleNamespace:
    """Return a copy of the module `zstd` whose functions unpack up to the limits."""

    def opened(file: Any, *words: Any) -> LimitedStream:
        return LimitedStream(zstd.open(file, *words), os.fstat(file.fileno()).st_size)

    def decompress(packed: bytes) -> bytes:
        return unpacked(zstd.ZstdDecompressor, packed)

    return SimpleNamespace(**vars(zstd) | {"decompress": decompress, "open": opened})

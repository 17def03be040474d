"""Hits and the frame log of an hour on disk.

Hits are rows (step, tile, sensor), each once, ascending; on disk a row is a step of a sensor with
the set of its tiles. The frame log has a row a frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from gis_radar.arrays import Integers
from gis_radar.errors import InputError
from gis_radar.live.hits_folder.streams import (
    StreamTable,
    StreamTableWriter,
    merge_distinct,
    merge_streams,
)
from gis_radar.live.hits_folder.tile_sets import pack_sets, unpack_sets
from gis_radar.measures.rows import Rows, distinct, fresh

LOG_FILE = "deliveries.parquet"
LOG_COLUMNS = (
    "time_us", "sensor", "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum",
    "shift_us",
)  # fmt: skip
FRAME_LOG = StreamTable(
    schema=pa.schema([(n, pa.string() if n == "sensor" else pa.int64()) for n in LOG_COLUMNS]),
    rows_at_once=1 << 16,
    rows_in_group=1 << 16,
)
SETS = StreamTable(
    schema=pa.schema([("step", pa.int64()), ("sensor", pa.string()), ("tiles", pa.binary())]),
    rows_at_once=1 << 12,
    rows_in_group=1 << 14,
)
MOST_BYTES_AT_ONCE = 1 << 18  # of sets: a tile takes a byte at least
MOST_BYTES_OF_SET = 1 << 24  # sixteen million tiles: over any map's


class SetTable:
    """The hits on disk: a row a step and sensor, with its tiles as of `tile_sets`."""

    def write(
        self, rows: Iterator[Rows], path: Path, fingerprint: str, sensors: Sequence[str]
    ) -> None:
        """Write a stream of rows (step, tile, sensor); arguments as of :class:`StreamTableWriter`.

        Rows ascend by step; within a step they come in any order, also repeated.
        """
        with StreamTableWriter(SETS, path, fingerprint, sensors) as writer:
            for step, tile, sensor in merge_streams([rows], 3):
                writer.add(_as_sets(step, sensor, tile))

    def read(self, path: Path, sensors: Sequence[str]) -> Iterator[Rows]:
        """Read the rows (step, tile, sensor) of a file piece by piece.

        Parameters
        ----------
        path : Path
            The file.
        sensors : sequence of str
            All sensors, which give the numbers that stand for their names.

        Raises
        ------
        InputError
            If the file is damaged, its steps do not ascend, or it names another sensor.
        """
        hits = (
            rows
            for step, sensor, sets in SETS.read(path, sensors)
            for rows in _out_of_sets(step, sensor, sets, path)
        )
        # A step's sets come by sensor, rows by tile.
        yield from merge_distinct([hits], 3) if len(sensors) > 1 else hits


def _as_sets(step: Integers, sensor: Integers, tile: Integers) -> tuple[Any, ...]:
    """Return hits of whole steps as a row a step and sensor."""
    more = np.diff(step), np.diff(sensor), np.diff(tile)
    ascends = (more[0] > 0) | (more[0] == 0) & ((more[1] > 0) | (more[1] == 0) & (more[2] > 0))
    if not ascends.all():
        step, sensor, tile = distinct(step, sensor, tile)
    first = np.flatnonzero(fresh(step) | fresh(sensor))
    data, begins = pack_sets(tile, np.append(first, len(tile)))
    buffers = [None, pa.py_buffer(begins.astype(np.int32)), pa.py_buffer(data)]
    sets = pa.Array.from_buffers(pa.binary(), len(first), buffers)
    return step[first], sensor[first], sets


def _out_of_sets(
    step: Integers, sensor: Integers, sets: pa.BinaryArray, path: Path
) -> Iterator[Rows]:
    """Yield the hits of rows of sets, in pieces of bounded size."""
    _, offsets, data = sets.buffers()
    bounds = np.frombuffer(offsets, np.int32)[sets.offset : sets.offset + len(sets) + 1]
    begins = bounds.astype(np.int64)
    values = np.frombuffer(data or b"", np.uint8)
    if (longest := int(np.diff(begins).max(initial=0))) > MOST_BYTES_OF_SET:
        raise InputError(f"{path}: damaged: a set of tiles takes {longest:,} bytes")
    low = 0
    while low < len(sets):
        high = int(np.searchsorted(begins, begins[low] + MOST_BYTES_AT_ONCE, side="right")) - 1
        high = min(max(high, low + 1), len(sets))
        tile, at = unpack_sets(values, begins[low : high + 1], what=str(path))
        count = np.diff(at)
        yield np.repeat(step[low:high], count), tile, np.repeat(sensor[low:high], count)
        low = high


HITS = SetTable()


def merge_logs(streams: Sequence[Iterator[Rows]]) -> Iterator[Rows]:
    """Merge streams of rows into one that holds each frame of each sensor once.

    Parameters
    ----------
    streams : sequence of iterators of rows
        Arrays in the order of `LOG_COLUMNS`, the sensor as a number; ascending by time.
    """
    for rows in merge_streams(streams, len(LOG_COLUMNS)):
        time, sensor = rows[:2]
        order = np.lexsort((sensor, time))
        if np.any((np.diff(time[order]) == 0) & (np.diff(sensor[order]) == 0)):
            order = np.lexsort((*rows[:1:-1], sensor, time))
        time, sensor = time[order], sensor[order]
        last = np.ones(len(order), np.bool_)
        last[:-1] = (np.diff(time) != 0) | (np.diff(sensor) != 0)
        yield tuple(column[order[last]] for column in rows)

"""An hour of the journal, copied to a file of its own and written by another process.

A hundred sensors have seven million frames in it: minutes of work, beside which the map of now
would stand still in this process.
"""

from __future__ import annotations

import multiprocessing
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from pathlib import Path

from gis_radar.arrays import Integers
from gis_radar.errors import OutputError
from gis_radar.live.journal import FrameRow, Journal, read_frames
from gis_radar.live.store import KnownPose, Store
from gis_radar.processes import watch_parent

NICE = 10  # the map goes first


class HourCopy:
    """Frames of an hour, in a file that nobody else writes; read as those of a journal.

    Parameters
    ----------
    path : Path
        The file, from :meth:`gis_radar.live.journal.Journal.copy_hour`.
    """

    def __init__(self, path: Path) -> None:
        self.path: Path = path

    def frames(self, sensor: str, begin_us: int, end_us: int) -> Iterator[list[FrameRow]]:
        """Read the frames of a sensor in a time, the end left out, piece by piece."""
        with closing(sqlite3.connect(self.path)) as database:
            yield from read_frames(database, sensor, begin_us, end_us)

    def drop_hour(self, hour: int, sensors: Sequence[str]) -> None:
        """Leave all as it is: whoever made the copy drops it."""


def write_copied(
    store: Store, hour: int, journal: Journal, poses: Mapping[int, KnownPose],
    tiles: Mapping[str, Integers], sensors: Sequence[str],
) -> Path | None:  # fmt: skip
    """Write an hour as :meth:`gis_radar.live.store.Store.write_hour` does, by another process.

    Parameters
    ----------
    store : Store
        Where hours are written.
    hour : int
        Since 1970; the journal must watch it.
    journal : Journal
        With the frames.
    poses, tiles, sensors : mapping, mapping, sequence of str
        As of the store's own method.

    Raises
    ------
    OutputError
        If it cannot be written; the journal then keeps the frames.
    """
    path = journal.path.with_name("hour.sqlite")
    try:
        named = journal.copy_hour(hour, sensors, path)
        known = {number: poses[number] for number in named}
        views = {each.view: tiles[each.view] for each in known.values()}
        context = multiprocessing.get_context("spawn")
        try:
            with ProcessPoolExecutor(1, mp_context=context, initializer=_begin) as pool:
                done = pool.submit(_write, store, hour, path, known, views, sensors).result()
        except BrokenProcessPool as error:
            raise OutputError(
                f"{store.path_of(hour)}: the process that writes it was ended",
                hint="is there enough memory? It is tried again",
            ) from error
        if done is not None:
            journal.drop_hour(hour, sensors)
        return done
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _begin() -> None:
    watch_parent()
    if hasattr(os, "nice"):
        os.nice(NICE)


def _write(
    store: Store, hour: int, path: Path, poses: Mapping[int, KnownPose],
    tiles: Mapping[str, Integers], sensors: Sequence[str],
) -> Path | None:  # fmt: skip
    return store.write_hour(hour, HourCopy(path), poses, tiles, sensors)

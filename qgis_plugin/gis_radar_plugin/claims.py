"""Claim the outputs that are being written: one run at a time for each place; needs no QGIS."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from .runner import WorkerError

_LOCK = threading.Lock()
_TAKEN: set[str] = set()


@contextmanager
def claimed(outputs: Sequence[str]) -> Iterator[None]:
    """Keep other runs of this QGIS from the same outputs; leave nothing half-written there.

    Raises
    ------
    WorkerError
        If another run writes one of them, or their folder cannot be made.
    """
    places = [os.path.realpath(output) for output in outputs]
    with _LOCK:
        busy = [place for place in places if place in _TAKEN]
        if busy:
            raise WorkerError(
                "{place}: another run is writing this output (wait for it, or name another)",
                place=busy[0],
            )
        _TAKEN.update(places)
    began = time.time()
    try:
        for place in places:
            _make_folder(Path(place).parent)
        yield
    except BaseException:
        for place in places:
            _sweep(Path(place), began)
        raise
    finally:
        with _LOCK:
            _TAKEN.difference_update(places)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkerError(
            "{folder}: cannot be made: {reason}", folder=folder, reason=error.strerror or error
        ) from error


def _sweep(place: Path, began: float) -> None:
    """Remove what a killed worker left beside its output: its private folder of this run."""
    try:
        left = [part for part in place.parent.glob(f".{place.name}.*.part")
                if part.is_dir() and part.stat().st_mtime >= began - 2.0]  # fmt: skip
    except OSError:
        return
    for part in left:
        shutil.rmtree(part, ignore_errors=True)

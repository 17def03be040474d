"""Private folders of what is being written: alive by a lock, cleared when their run was killed."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path

_LONGEST_NAME = 255  # bytes, of most file systems
_ALIVE = ".alive"  # locked in a private folder as long as the process that made it lives
PLAN = ".places.json"  # in a private folder that is whole and about to be moved
PRIVATE = re.compile(r"\..+\.[0-9a-f]{8}\.(part|before)")
_ABANDONED_S = 86_400.0  # a private folder without a lock is of a file system without locks


def hidden_stem(path: Path) -> str:
    """Return how our hidden files beside an output begin, short enough for any file system."""
    name = f".{path.name}"
    if len(os.fsencode(name)) > _LONGEST_NAME - len(".12345678.before"):
        return f".{blake2b(os.fsencode(path.name), digest_size=16).hexdigest()}"
    return name


def private_pattern(path: Path, ending: str) -> re.Pattern[str]:
    """Return what private folders beside an output are named like."""
    return re.compile(rf"{re.escape(hidden_stem(path))}\.[0-9a-f]{{8}}\.{ending}")


def leftovers(path: Path, ending: str) -> list[Path]:
    """Return the private folders beside an output."""
    named = private_pattern(path, ending)
    with suppress(OSError):
        return [each for each in path.parent.iterdir() if named.fullmatch(each.name)]
    return []


@contextmanager
def living(private: Path) -> Iterator[None]:
    """Hold a lock in a private folder: it is somebody's as long as the lock is held."""
    from filelock import lock_descriptor  # noqa: PLC0415 - 70 ms

    handle = os.open(private / _ALIVE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        with suppress(OSError):  # no locks here
            lock_descriptor(handle, blocking=False)
        yield
    finally:
        os.close(handle)


def clear_abandoned(folder: Path, named: re.Pattern[str]) -> None:
    """Remove private folders that killed runs left in a folder; end what was being moved."""
    with suppress(OSError):
        found = [each for each in folder.iterdir() if named.fullmatch(each.name)]
        for private in found:
            if private.suffix == ".before" or private.is_symlink() or not _is_abandoned(private):
                continue
            with suppress(OSError, ValueError):
                for name, place in json.loads((private / PLAN).read_text(encoding="utf-8")):
                    if (private / Path(name).name).exists() and Path(place).parent == folder:
                        os.replace(private / Path(name).name, place)  # noqa: PTH105
            shutil.rmtree(private, ignore_errors=True)


def _is_abandoned(private: Path) -> bool:
    """Return whether the process that made a private folder is gone."""
    from filelock import lock_descriptor  # noqa: PLC0415 - 70 ms

    try:
        handle = os.open(private / _ALIVE, os.O_RDWR)
    except OSError:  # being made just now, or of a version without locks
        return time.time() - private.stat().st_mtime > _ABANDONED_S
    try:
        return lock_descriptor(handle, blocking=False)
    except OSError:
        return False
    finally:
        os.close(handle)

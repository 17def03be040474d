"""Private folders of unfinished outputs: locked by their run, removed once that was killed."""

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
LOCK_NAME = ".alive"  # locked in a private folder as long as the process that made it lives
PLAN = ".places.json"  # in a private folder whose files are complete: the moves still to be made
SCRATCH = ".gis_radar-scratch-"  # begin of the names of our temporary folders, and of no others
PRIVATE = re.compile(r"\..+\.[0-9a-f]{8}\.(part|before)")
_ABANDONED_S = 86_400.0  # age at which a private folder counts as abandoned if locks are missing
_MAKING_S = 60.0  # most time between making a private folder and locking it: a millisecond in fact


def hidden_stem(path: Path) -> str:
    """Return what the names of our hidden files beside an output begin with.

    Parameters
    ----------
    path : Path
        The output.

    Returns
    -------
    str
        Its name after a point; a digest of a long name, so that an ending fits behind it.
    """
    name = f".{path.name}"
    if len(os.fsencode(name)) > _LONGEST_NAME - len(".12345678.before"):
        return f".{blake2b(os.fsencode(path.name), digest_size=16).hexdigest()}"
    return name


def private_pattern(path: Path, ending: str) -> re.Pattern[str]:
    """Return the pattern of the names of private folders beside an output.

    Parameters
    ----------
    path : Path
        The output.
    ending : str
        `part` for an output that is being written, `before` for one that was moved aside.

    Returns
    -------
    re.Pattern
        Matches whole names.
    """
    return re.compile(rf"{re.escape(hidden_stem(path))}\.[0-9a-f]{{8}}\.{ending}")


def leftovers(path: Path, ending: str) -> list[Path]:
    """Return the private folders beside an output, whoever made them.

    Parameters
    ----------
    path : Path
        The output.
    ending : str
        As for :func:`private_pattern`.

    Returns
    -------
    list of Path
        Empty where the folder around the output cannot be read.
    """
    pattern = private_pattern(path, ending)
    with suppress(OSError):
        return [each for each in path.parent.iterdir() if pattern.fullmatch(each.name)]
    return []


@contextmanager
def hold_lock(private: Path) -> Iterator[None]:
    """Hold the lock of a private folder within the block: by it others see that it is in use.

    Parameters
    ----------
    private : Path
        The folder, just made. Where the file system has no locks, it counts as abandoned after a
        day.

    Raises
    ------
    OSError
        If the file of the lock cannot be made.
    """
    from filelock import lock_descriptor  # noqa: PLC0415 - 70 ms

    handle = os.open(private / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        with suppress(OSError):  # no locks here
            lock_descriptor(handle, blocking=True)  # others hold it for an instant, to test it
            os.write(handle, b"\n")  # from now on the lock counts
        yield
    finally:
        os.close(handle)


def clear_abandoned(folder: Path, pattern: re.Pattern[str], *, alone: bool = False) -> None:
    """Remove private folders that killed runs left beside outputs, after making their last moves.

    Parameters
    ----------
    folder : Path
        Folder of outputs, absolute.
    pattern : re.Pattern
        Names of the private folders: those of one output, or :data:`PRIVATE` for all.
    alone : bool
        Whether the caller holds the lock of the output: then no other run is making a private
        folder beside it.
    """
    for private in _abandoned(folder, pattern, alone=alone):
        with suppress(OSError, ValueError):
            for name, place in json.loads((private / PLAN).read_text(encoding="utf-8")):
                if (private / Path(name).name).exists() and Path(place).parent == folder:
                    os.replace(private / Path(name).name, place)  # noqa: PTH105
        shutil.rmtree(private, ignore_errors=True)


def clear_scratch(folder: Path) -> None:
    """Remove our temporary folders whose runs were killed.

    Parameters
    ----------
    folder : Path
        The system's for temporary files. Of what is there, only folders whose names begin with
        :data:`SCRATCH` and that hold our lock file are removed.
    """
    pattern = re.compile(rf"{re.escape(SCRATCH)}\w+")
    for private in _abandoned(folder, pattern):
        if (private / LOCK_NAME).is_file():
            shutil.rmtree(private, ignore_errors=True)


def _abandoned(folder: Path, pattern: re.Pattern[str], *, alone: bool = False) -> Iterator[Path]:
    """Yield the private folders of processes that are gone."""
    import filelock  # noqa: F401, PLC0415 - 70 ms, not between making a folder and locking it

    with suppress(OSError):
        for private in [each for each in folder.iterdir() if pattern.fullmatch(each.name)]:
            if private.suffix == ".before" or private.is_symlink():
                continue
            if is_abandoned(private, alone=alone):
                yield private


def is_abandoned(private: Path, *, alone: bool = False) -> bool:
    """Return whether the process that made a private folder is gone.

    Parameters
    ----------
    private : Path
        The folder.
    alone : bool
        As for :func:`clear_abandoned`.

    Returns
    -------
    bool
        Without locks, whether the folder is older than a day.
    """
    from filelock import lock_descriptor  # noqa: PLC0415 - 70 ms

    age_s = time.time() - private.stat().st_mtime
    made = alone or age_s > _MAKING_S  # else its maker may be about to lock it
    try:
        handle = os.open(private / LOCK_NAME, os.O_RDWR)
    except FileNotFoundError:
        return made
    except OSError:  # another user's, or no more files can be opened
        return age_s > _ABANDONED_S
    try:
        return lock_descriptor(handle, blocking=False) and (made or os.fstat(handle).st_size > 0)
    except OSError:  # no locks here
        return age_s > _ABANDONED_S
    finally:
        os.close(handle)

"""Locks: one run at a time writes a result; the system lets go of a run that was killed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gis_radar.errors import OutputError
from gis_radar.progress import Reporter

if sys.platform == "win32":
    import msvcrt

    def _take(handle: int) -> None:
        # Far behind the text, which others shall be able to read.
        os.lseek(handle, 1 << 20, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError from error
        finally:
            os.lseek(handle, 0, os.SEEK_SET)

else:
    import fcntl

    def _take(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def only_writer(
    path: Path, *, lock: Path | None = None, reporter: Reporter | None = None
) -> Iterator[None]:
    """Keep other runs from writing the same result while the block runs.

    Parameters
    ----------
    path : Path
        The result, for the message.
    lock : Path, optional
        The file that is locked, gone afterwards; by default a hidden one beside the result. It
        says which process holds it.
    reporter : Reporter, optional
        Told where the file system knows no locks, and there is none.

    Raises
    ------
    OutputError
        If another run is writing it.
    """
    lock = lock or path.with_name(f".{path.name}.lock")
    handle = _taken(lock, path, reporter)
    try:
        os.truncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode())
        yield
    finally:
        # While still held, where the system allows it: who opens it anew gets another file.
        with suppress(OSError):
            lock.unlink()
        os.close(handle)
        with suppress(OSError):
            if sys.platform == "win32":
                lock.unlink()


def _taken(lock: Path, path: Path, reporter: Reporter | None) -> int:
    """Open and lock the file; a file that was taken away meanwhile is no lock."""
    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _take(handle)
        except BlockingIOError as error:
            holder = os.read(handle, 20).decode(errors="replace").strip()
            os.close(handle)
            who = f" (process {holder})" if holder else ""
            raise OutputError(
                f"{path}: another run is writing it{who}",
                hint="wait for it, stop it, or name another output",
            ) from error
        except OSError as error:
            if reporter is not None:
                reporter.log(f"{path}: cannot be locked: {error.strerror}", "warning")
            return handle
        with suppress(OSError):
            if os.path.samestat(lock.stat(), os.fstat(handle)):
                return handle
        os.close(handle)

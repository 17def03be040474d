"""Write outputs whole or not at all, and let one run at a time write a result."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import date
from hashlib import blake2b
from pathlib import Path

from gis_radar.base.errors import GisRadarError, OutputError, first_line
from gis_radar.base.progress import QUIET, Reporter
from gis_radar.base.texts import Text

FILE_DATE = date(2000, 1, 1)
"""The date in files whose format needs one: fixed, so that equal runs write equal bytes."""
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
# Libraries that write our files. Their errors are recognised by module: importing takes a second.
_WRITERS = {"pyogrio", "lazrs", "laspy", "rasterio", "sqlite3", "pyarrow", "PIL", "xlsxwriter"}
_FULL_TEXTS = ("disk is full", "no space left", "file too large", "disk quota", "os error 28",
               "write error at scanline", "cannot rollback - no transaction")  # fmt: skip
LEAST_FREE = 1 << 16  # bytes: a disk with less is full, whatever a library's error states
_LONGEST_NAME, _LONGEST_HIDDEN = 200, 240  # bytes: file systems take 255, and names get endings
_NOT_IN_NAMES = frozenset('/\\:*?"<>|+#')  # + and # are wildcards of MQTT
_PRIVATE = ".*.????????.part"  # names of private folders of unfinished outputs
_ABANDONED_S = 86_400.0  # unchanged for so long, a private folder belongs to a run that was killed


def is_folder_name(text: str) -> bool:
    """Return whether folders can have a name on all systems, and topics of MQTT too."""
    return (
        text.isprintable()
        and text == text.strip()
        and text[:1] not in {"", "."}
        and text[-1] != "."
        and not _NOT_IN_NAMES & {*text}
        and len(text.encode()) <= _LONGEST_NAME
    )


def refuse_inputs(output: str | Path, *inputs: str | Path) -> None:
    """Refuse an output that would take the place of an input.

    Parameters
    ----------
    output : str or Path
        The file or folder to be written.
    *inputs : str or Path
        The files and folders that are read.

    Raises
    ------
    OutputError
        If the output is one of the inputs, under whatever name, or a folder that holds one.
    """
    place = Path(output)
    if not place.exists():
        return
    for source in map(Path, inputs):
        if source.exists() and any(
            place.samefile(part) for part in (source, *source.resolve().parents)
        ):
            raise OutputError(
                "{}: would replace the input {}", output, source, hint="name another output"
            )


def paths_of(given: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return paths: what is given may be a single one.

    Examples
    --------
    >>> [path.name for path in paths_of("scans/north.laz")]
    ['north.laz']
    """
    return [Path(path) for path in ([given] if isinstance(given, str | Path) else given)]


def require_folder(output: str | Path) -> None:
    """Refuse a file whose folder is not there, before any work.

    Parameters
    ----------
    output : str or Path
        The file to be written.

    Raises
    ------
    OutputError
        If the folder does not exist.
    """
    folder = Path(output).absolute().parent
    if not folder.is_dir():
        raise OutputError("{}: cannot be written: there is no folder {}", output, folder)


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Write a file that appears only when the block ends well.

    Parameters
    ----------
    path : Path
        Final path of the file; an existing file is replaced in one move.

    Yields
    ------
    Path
        A file name with the same ending in a private folder beside `path`.

    Raises
    ------
    OutputError
        If the folder around it does not exist, or the place cannot be written.
    """
    if path.is_dir():
        raise OutputError("{}: is a folder", path, hint="name a file for the output")
    with atomic_writes(path) as (private, places):
        places[private / path.name] = path
        yield private / path.name


@contextmanager
def atomic_writes(path: Path, *, flushed: bool = False) -> Iterator[tuple[Path, dict[Path, Path]]]:
    """Write several files that appear only when the block ends well.

    `path` is moved last: if the run is killed between two moves, the same command makes them again.

    Parameters
    ----------
    path : Path
        One of the files, or what they are named after; they stand on its file system.
    flushed : bool
        Flush each to the disk before the next one is moved, to survive a power failure.

    Yields
    ------
    private : Path
        An empty folder beside `path` to write in.
    places : dict of Path to Path
        Empty; to be filled with files in `private` and where they shall be.

    Raises
    ------
    OutputError
        If the folder around `path` does not exist, or a place cannot be written.
    """
    places: dict[Path, Path] = {}
    with _private_folder(path) as private:
        yield private, places
        for place in places.values():
            if place.is_dir():
                raise OutputError("{}: is a folder", place, hint="name a file for the output")
        for part, place in sorted(places.items(), key=lambda each: each[1] == path):
            with output_errors(place):
                if flushed:
                    with part.open("rb+") as file:
                        os.fsync(file.fileno())
                part.replace(place)
                if flushed:
                    sync_folder(place.parent)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to disk, where the system can."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def folder_to_fill(path: Path) -> Iterator[None]:
    """Make a folder for files that the block writes; one that is new stays only if that ends well.

    Raises
    ------
    OutputError
        If it cannot be made.
    """
    new: list[Path] = []
    try:
        with output_errors(path):  # asking for a folder may be refused, too
            new += [each for each in (path, *path.parents) if not each.exists()]
            path.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in new:
            with suppress(OSError):  # not made, or another program has put something there
                folder.rmdir()
        raise


@contextmanager
def atomic_folder(
    path: Path, *, owned: tuple[str, ...], reporter: Reporter = QUIET
) -> Iterator[Path]:
    """Write a folder that appears only when the block ends well.

    Parameters
    ----------
    path : Path
        Final path of the folder. An earlier result there is replaced as a whole.
    owned : tuple of str
        Prefixes of the names of our own files. A folder that holds anything else is not
        replaced.
    reporter : Reporter
        Receives a warning where the file system has no locks; the folder is then written without.

    Yields
    ------
    Path
        An empty private folder beside `path`.

    Raises
    ------
    OutputError
        If the place cannot be written, holds files that are not ours, is the folder that
        the program runs in, or is being written by another run.
    """
    path = path.resolve()
    if path.exists():
        _refuse_working_folder(path)
        refuse_foreign(path, owned)
    with only_writer(path, reporter=reporter), replacing_folder(path) as fresh:
        yield fresh


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a private folder that takes the place of `path` when the block ends well.

    Parameters
    ----------
    path : Path
        Final path of the folder; the caller is its only writer.

    Raises
    ------
    OutputError
        If the place cannot be written.
    """
    clear_leftovers(path)
    with _private_folder(path) as private:
        fresh, earlier = private / "new" / path.name, private / "earlier"
        fresh.mkdir(parents=True)
        yield fresh
        try:
            with output_errors(path):
                if path.exists():
                    path.rename(earlier)
                fresh.rename(path)
        finally:
            if earlier.exists() and fresh.exists():
                earlier.rename(path)


def _refuse_working_folder(path: Path) -> None:
    """Refuse the working folder: a shell in it would stay in the folder that is replaced."""
    here = Path.cwd()
    if path == here or path in here.parents:
        raise OutputError(
            "{}: is the folder you are in, which cannot be replaced",
            path,
            hint="name a folder in it, such as result",
        )


def refuse_foreign(path: Path, owned: tuple[str, ...]) -> None:
    """Refuse a file, or a folder that holds names which do not begin with one of `owned`."""
    if not path.is_dir():
        raise OutputError("{}: is a file", path, hint="name a folder for the output")
    names = {entry.name for entry in path.iterdir()} - {left.name for left in path.glob(_PRIVATE)}
    foreign = sorted(name for name in names if not name.startswith(owned))
    if foreign:
        raise OutputError(
            "{}: holds {}, which is not part of such a result",
            path,
            repr(foreign[0]),
            hint="name a new or an empty folder",
        )


def _hidden_stem(path: Path) -> str:
    """Return what hidden names beside an output begin with: a digest where its name is long."""
    name = os.fsencode(f".{path.name}")
    if len(name) > _LONGEST_HIDDEN:
        return f".{blake2b(name[1:], digest_size=16).hexdigest()}"
    return f".{path.name}"


def clear_leftovers(path: Path, *, alone: bool = True) -> None:
    """Remove what killed runs left of an output; finish a replacement that was killed midway.

    Parameters
    ----------
    path : Path
        The output.
    alone : bool
        Whether the caller is its only writer: all of it goes; else what is beside it and a day old.
    """
    beside = path.parent.glob(f"{glob.escape(_hidden_stem(path))}.????????.part")
    found = list[Path]()
    with suppress(OSError):  # a folder cannot be read
        found += [*beside, *(path.rglob(_PRIVATE) if alone else ())]
    for left in found:
        with suppress(OSError):  # just removed, by another run or with the one around it
            newest = max(each.lstat().st_mtime for each in (left, *left.rglob("*")))
            if alone or time.time() - newest > _ABANDONED_S:
                for fresh in (left / "new").iterdir() if (left / "earlier").exists() else ():
                    if not left.with_name(fresh.name).exists():  # killed between two moves
                        fresh.rename(left.with_name(fresh.name))
                shutil.rmtree(left, ignore_errors=True)


@contextmanager
def _private_folder(path: Path, *, named: Path | None = None) -> Iterator[Path]:
    """Yield a private folder on the file system of `path`; errors name `path`, or `named`."""
    if any("\ud800" <= letter <= "\udfff" for letter in str(path)):
        raise OutputError("{}: the name is not UTF-8, which libraries need to write it", path)
    clear_leftovers(path, alone=False)
    with output_errors(named or path):
        made = tempfile.TemporaryDirectory(
            prefix=f"{_hidden_stem(path)}.", suffix=".part", dir=path.absolute().parent,
            ignore_cleanup_errors=True,
        )  # fmt: skip
    try:
        with writing_errors(named or path):
            yield Path(made.name)
    finally:
        shutil.rmtree(made.name, ignore_errors=True)  # if interrupted, `made` does it at exit
        made.cleanup()


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for temporary files.

    Yields
    ------
    Path
        An empty folder in the system's folder for temporary files.

    Raises
    ------
    OutputError
        If there is no room.
    """
    root = Path(tempfile.gettempdir())
    with _private_folder(root / "gis_radar-scratch", named=root) as folder:
        yield folder


@contextmanager
def writing_errors(path: Path) -> Iterator[None]:
    """Turn errors of libraries that write files into one that names the output.

    Parameters
    ----------
    path : Path
        The output, for the message.

    Raises
    ------
    OutputError
        Where the disk is full, or a library that writes files of ours fails.
    """
    try:
        yield
    except GisRadarError:
        raise
    except Exception as error:
        number = error.errno if isinstance(error, OSError) else None
        of_writer = type(error).__module__.partition(".")[0] in _WRITERS
        # Arrow, GDAL and SQLite set no errno, only the text; some not even that.
        says_full = any(text in str(error).lower() for text in _FULL_TEXTS)
        if number in FULL or says_full or (of_writer and _is_full(path)):
            raise _disk_full_error(path) from error
        if of_writer:
            raise OutputError("{}: cannot be written: {}", path, first_line(error)) from error
        raise


def _disk_full_error(path: Path) -> OutputError:
    return OutputError(
        "{}: cannot be written: the disk is full", path, hint="make room and call it again"
    )


def _is_full(path: Path) -> bool:
    """Return whether the disk of a file has less than `LEAST_FREE` bytes left."""
    try:
        return shutil.disk_usage(path.absolute().parent).free < LEAST_FREE
    except OSError:
        return False


@contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Turn errors of the operating system into one that names the output.

    Parameters
    ----------
    path : Path
        The output, for the message.

    Raises
    ------
    OutputError
        Where the block raises an `OSError`.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise _disk_full_error(path) from error
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise OutputError("{}: cannot be written: {}", path, reason) from error


@contextmanager
def only_writer(
    path: Path, *, lock: Path | None = None, waits: bool = False, reporter: Reporter = QUIET
) -> Iterator[None]:
    """Keep other runs from writing the same result while the block runs.

    It locks a file by filelock's `lock_descriptor`: `FileLock` would leave the file behind and not
    name the process that holds it.

    Parameters
    ----------
    path : Path
        The result, for the message.
    lock : Path, optional
        The file that is locked, removed afterwards; by default a hidden one beside the result. It
        holds the process id of the holder.
    waits : bool
        Wait for another run to end, rather than refuse.
    reporter : Reporter
        Receives a warning where the file system has no locks; the block then runs without one.

    Raises
    ------
    OutputError
        If another run is writing it, or its folder cannot be written.
    """
    lock = lock or path.with_name(f"{_hidden_stem(path)}.lock")
    with output_errors(path):
        handle = _lock_descriptor(lock, path, reporter, waits=waits)
    try:
        with output_errors(path):
            os.truncate(handle, 0)
            # From the second byte on: Windows lets nobody else read the first, which is locked.
            os.write(handle, f"\n{os.getpid()}\n".encode())
        yield
    finally:
        # Removed while still locked, where the system allows it: others then make a new file.
        with suppress(OSError):
            lock.unlink()
        os.close(handle)
        with suppress(OSError):
            if sys.platform == "win32":
                lock.unlink()


def _lock_descriptor(lock: Path, path: Path, reporter: Reporter, *, waits: bool) -> int:
    """Return the descriptor of the locked file; open it again if its last holder has removed it."""
    from filelock import lock_descriptor  # noqa: PLC0415 - 70 ms

    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            free = lock_descriptor(handle, blocking=waits)
        except OSError as error:
            reporter.warn("{}: cannot be locked: {}", path, error.strerror)
            return handle
        if not free:
            os.lseek(handle, 1, os.SEEK_SET)
            holder = os.read(handle, 20).decode(errors="replace").strip()
            os.close(handle)
            who = Text(" (process {})", holder) if holder else ""
            raise OutputError(
                "{}: another run is writing it{}",
                path,
                who,
                hint="wait for it, stop it, or name another output",
            )
        with suppress(OSError):
            if os.path.samestat(lock.stat(), os.fstat(handle)):
                return handle
        os.close(handle)

"""Outputs appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gis_radar.errors import OutputError


def refuse_inputs(output: str | Path, *inputs: str | Path) -> None:
    """Refuse an output that would take the place of an input.

    Parameters
    ----------
    output : str or Path
        The file or folder that shall be written.
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
                f"{output}: would replace the input {source}", hint="name another output"
            )


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file that appears only when the block ends well.

    Parameters
    ----------
    path : Path
        Where the file shall be; an existing file is replaced in one move.

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
        raise OutputError(f"{path}: is a folder", hint="name a file for the output")
    with _beside(path) as private:
        yield private / path.name
        with _named(path):
            os.replace(private / path.name, path)  # noqa: PTH105 - atomic on every platform


@contextmanager
def whole_folder(path: Path, *, owned: tuple[str, ...]) -> Iterator[Path]:
    """Write a folder that appears only when the block ends well.

    Parameters
    ----------
    path : Path
        Where the folder shall be. An earlier result there is replaced as a whole.
    owned : tuple of str
        How the names of our own files begin. A folder that holds anything else is not ours
        to replace.

    Yields
    ------
    Path
        An empty private folder beside `path`.

    Raises
    ------
    OutputError
        If the place cannot be written, holds files that are not ours, or is the folder that
        the program runs in.
    """
    path = path.resolve()
    if path.exists():
        _refuse_here(path)
        _refuse_foreign(path, owned)
    with _beside(path) as private:
        fresh = private / path.name
        fresh.mkdir()
        yield fresh
        _replace_folder(path, fresh, private.with_suffix(".before"))


def _replace_folder(path: Path, fresh: Path, earlier: Path) -> None:
    """Move `fresh` to `path`; until it is there, the earlier result comes back."""
    try:
        with _named(path):
            if path.exists():
                path.rename(earlier)
            fresh.rename(path)
    finally:
        if earlier.exists() and fresh.exists():
            earlier.rename(path)
        elif earlier.exists():
            shutil.rmtree(earlier, ignore_errors=True)


def _refuse_here(path: Path) -> None:
    """Refuse the working folder: whoever is in it would stay in the one that is replaced."""
    here = Path.cwd()
    if path == here or path in here.parents:
        raise OutputError(
            f"{path}: is the folder you are in, which cannot be replaced",
            hint="name a folder in it, such as result",
        )


def _refuse_foreign(path: Path, owned: tuple[str, ...]) -> None:
    if not path.is_dir():
        raise OutputError(f"{path}: is a file", hint="name a folder for the output")
    foreign = sorted(entry.name for entry in path.iterdir() if not entry.name.startswith(owned))
    if foreign:
        raise OutputError(
            f"{path}: holds {foreign[0]!r}, which is not part of such a result",
            hint="name a new or an empty folder",
        )


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Yield a private folder on the same file system as `path`; it is gone afterwards."""
    with _named(path):
        private = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
    try:
        yield private
    finally:
        shutil.rmtree(private, ignore_errors=True)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Say which output it is that cannot be written."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{path}: cannot be written: {reason}") from error

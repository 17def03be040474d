"""What files hold, as short texts: hashed once, and again only when a file has changed."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path

from gis_radar.errors import InputError
from gis_radar.files import whole_file

_CHUNK = 1 << 20
_SETTLED_S = 2.0  # file systems tell times no finer: a file that young may yet change unseen
_LEFT_BY_VIEWERS = ("-wal", "-shm", "-journal", ".aux.xml", ".qmd")

Stamp = list[int]


class Contents:
    """Hashes of files and folders, remembered in a file by size and times.

    Parameters
    ----------
    memory : Path
        Where to remember them; a damaged or missing one only costs time.
    """

    def __init__(self, memory: Path) -> None:
        self._memory = memory
        self._known: dict[str, tuple[Stamp, str]] = _read(memory)

    def of(self, path: Path, progress: Callable[[int], None] = lambda _: None) -> str | None:
        """Return what a file or a folder holds as 32 characters; None where it is not there.

        Parameters
        ----------
        path : Path
            A file, or a folder of which all files count but those that viewers leave beside.
        progress : callable
            Told the bytes of each piece that was read.
        """
        if path.is_dir():
            files = (each for each in path.rglob("*") if each.is_file())
            parts = [
                (each.relative_to(path).as_posix(), each)
                for each in files
                if not each.name.endswith(_LEFT_BY_VIEWERS)
            ]
            listed = [(name, self.of(part, progress)) for name, part in sorted(parts)]
            return _digest(json.dumps(listed).encode())
        try:
            stamp = stamp_of(path)
        except OSError:
            return None
        name = str(path.resolve())
        known = self._known.get(name)
        if known is not None and known[0] == stamp:
            return known[1]
        found = _hash(path, progress)
        if time.time() - stamp[1] / 1e9 > _SETTLED_S:
            self._known[name] = (stamp, found)
        else:
            self._known.pop(name, None)
        return found

    def save(self) -> None:
        """Remember for the next run."""
        with whole_file(self._memory) as part:
            part.write_text(json.dumps(self._known, indent=0), encoding="utf-8")


def stamp_of(path: Path) -> Stamp:
    """Return size and times of a file; while they stay, so does what it holds."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def _read(memory: Path) -> dict[str, tuple[Stamp, str]]:
    try:
        found = json.loads(memory.read_text(encoding="utf-8"))
        return {str(name): (list(stamp), str(text)) for name, (stamp, text) in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _hash(path: Path, progress: Callable[[int], None]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    try:
        with path.open("rb") as file:
            while piece := file.read(_CHUNK):
                digest.update(piece)
                progress(len(piece))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return digest.hexdigest()


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()

"""The state of a run in one file: what its files held, and which stages need not be done again."""

from __future__ import annotations

import hashlib
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from gis_radar.errors import InputError, NoAnswerError
from gis_radar.files import whole_file
from gis_radar.site.plan import Outcome, Stage

LIBRARIES = (
    "numpy", "scipy", "pandas", "geopandas", "shapely", "pyogrio", "pyproj", "pyarrow",
    "rasterio", "laspy", "lazrs", "numba", "matplotlib", "open3d",
)  # fmt: skip

_CHUNK = 1 << 20
_SETTLED_S = 2.0  # file systems tell times no finer: a younger file may yet change unnoticed
_LEFT_BY_VIEWERS = ("-wal", "-shm", "-journal", ".aux.xml", ".qmd")

Stamp = list[int]


@dataclass(frozen=True, kw_only=True)
class Record:
    """A stage that ended, with a result or with a refusal.

    Parameters
    ----------
    key : str
        Hash of all that its result depends on.
    outputs : mapping
        What it made, and the hash of each; empty for a refusal.
    figures : mapping
        What is worth a look.
    warnings : sequence of str
        The warnings of its work.
    refusal : mapping or None
        Message and hint, where there was no trustworthy answer.
    seconds : float
        How long it took.
    """

    key: str
    outputs: Mapping[str, str | None]
    figures: Mapping[str, Any]
    warnings: Sequence[str]
    refusal: Mapping[str, str] | None
    seconds: float

    def outcome(self, stage: Stage) -> Outcome:
        """Return it as the outcome of a stage that need not be done again."""
        error = NoAnswerError(**self.refusal) if self.refusal else None
        return Outcome(
            stage=stage,
            state="refused" if error else "kept",
            figures=self.figures,
            warnings=self.warnings,
            error=error,
            seconds=self.seconds,
        )


class RunState:
    """Hashes of files, remembered by size and times, and records of stages.

    Parameters
    ----------
    path : Path
        The file (JSON); a damaged or missing one only costs time.
    root : Path
        The folder of the run: it may be moved.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self._path, self._root = path, root
        self._hashes: dict[str, tuple[Stamp, str]] = {}
        self.records: dict[str, Record] = {}
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            files = found["files"].items()
            self._hashes = {name: (list(stamp), str(each)) for name, (stamp, each) in files}
            self.records = {name: Record(**each) for name, each in found["stages"].items()}
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            self._hashes, self.records = {}, {}

    def save(self) -> None:
        """Write the file, whole or not at all."""
        stages = {name: asdict(each) for name, each in self.records.items()}
        with whole_file(self._path) as part:
            text = json.dumps({"files": self._hashes, "stages": stages}, ensure_ascii=False)
            part.write_text(text, encoding="utf-8")

    def hash_of(self, path: Path, progress: Callable[[int], None] = lambda _: None) -> str | None:
        """Return the hash of a file or a folder, 32 characters; None where it is not there.

        Parameters
        ----------
        path : Path
            A file, or a folder of which all files count but those that viewers leave beside.
        progress : callable
            Called with the bytes of each piece that was read.
        """
        if path.is_dir():
            files = (each for each in path.rglob("*") if each.is_file())
            parts = [
                (each.relative_to(path).as_posix(), each)
                for each in files
                if not each.name.endswith(_LEFT_BY_VIEWERS)
            ]
            return _digest([(name, self.hash_of(part, progress)) for name, part in sorted(parts)])
        try:
            stamp = stamp_of(path)
        except OSError:
            return None
        name = str(path.resolve())
        known = self._hashes.get(name)
        if known is not None and known[0] == stamp:
            return known[1]
        found = _hash(path, progress)
        if time.time() - stamp[1] / 1e9 > _SETTLED_S:
            self._hashes[name] = (stamp, found)
        else:
            self._hashes.pop(name, None)
        return found

    def key_of(self, stage: Stage) -> str:
        """Return the hash of all that a stage's result depends on; its inputs must be there."""
        return _digest(
            {
                "work": stage.work.__name__,
                "options": dict(stage.options),
                "software": software(),
                "inputs": [(self._name(p), held) for p in stage.reads if (held := self.hash_of(p))],
                "outputs": [self._name(path) for path in stage.outputs],
            }
        )

    def kept(self, stage: Stage, key: str) -> Outcome | None:
        """Return the outcome of a stage that need not be done again; None where it must be."""
        record = self.records.get(stage.name)
        if record is None or record.key != key:
            return None
        stands = record.refusal is not None or record.outputs == self._held(stage)
        return record.outcome(stage) if stands else None

    def keep(self, outcome: Outcome, key: str) -> None:
        """Record a stage that has ended with a result or a refusal."""
        stage, error = outcome.stage, outcome.error
        self.records[stage.name] = Record(
            key=key,
            outputs={} if error else self._held(stage),
            figures=outcome.figures,
            warnings=tuple(outcome.warnings),
            refusal={"message": error.message, "hint": error.hint} if error else None,
            seconds=outcome.seconds,
        )
        self.save()

    def forget(self, name: str) -> list[Path]:
        """Drop a record; return its outputs in the folder of the run."""
        paths = [self._root / each for each in self.records.pop(name).outputs]
        return [path for path in paths if path.resolve().is_relative_to(self._root.resolve())]

    def _held(self, stage: Stage) -> dict[str, str | None]:
        return {self._name(path): self.hash_of(path) for path in stage.outputs}

    def _name(self, path: Path) -> str:
        inside = path.is_relative_to(self._root)
        return path.relative_to(self._root).as_posix() if inside else path.name


def stamp_of(path: Path) -> Stamp:
    """Return size and times of a file; while they stay, so do its bytes."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


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


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@cache
def software() -> dict[str, str]:
    """Return the versions of all that has a part in the results.

    The entry `code` is the hash of our own modules: a checkout changes without a new version.
    """
    code = hashlib.blake2b(digest_size=8)
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        code.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return {
        "gis_radar": version("gis_radar"),
        "code": code.hexdigest(),
        "python": platform.python_version(),
        **{name: found for name in LIBRARIES if (found := _version(name))},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""

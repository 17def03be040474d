"""Records of finished stages: what went in, under what settings, and what came out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar import errors
from gis_radar.errors import GisRadarError, NoAnswerError
from gis_radar.files import whole_file
from gis_radar.site.contents import Contents
from gis_radar.site.stage import Outcome, Stage

KINDS = {
    kind.__name__: kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, GisRadarError)
}


@dataclass(frozen=True, kw_only=True)
class Record:
    """A stage that ended, with a result or with a refusal.

    Parameters
    ----------
    name : str
        The stage.
    key : str
        Follows from all that its result depends on.
    outputs : mapping
        What it made, and what each held; empty for a refusal.
    figures : mapping
        What is worth a look.
    warnings : sequence of str
        What its work warned of.
    refusal : mapping or None
        Message and hint, where there was no trustworthy answer.
    seconds : float
        How long it took.
    """

    name: str
    key: str
    outputs: Mapping[str, str | None]
    figures: Mapping[str, Any]
    warnings: Sequence[str]
    refusal: Mapping[str, str] | None
    seconds: float

    def outcome(self, stage: Stage) -> Outcome:
        """Return it as the outcome of a stage that need not be done again."""
        refused = self.refusal and NoAnswerError(self.refusal["message"], hint=self.refusal["hint"])
        return Outcome(
            stage=stage,
            state="refused" if refused else "kept",
            figures=self.figures,
            warnings=self.warnings,
            error=refused or None,
            seconds=self.seconds,
        )


def key_of(stage: Stage, software: Mapping[str, str], contents: Contents, root: Path) -> str:
    """Return a text that changes with all that a stage's result depends on.

    Parameters
    ----------
    stage : Stage
        Its inputs must be there.
    software : mapping
        Versions.
    contents : Contents
        What the files hold.
    root : Path
        The folder of the run: it may be moved.
    """
    lists = {**stage.inputs, **stage.parts}
    told = {
        "work": stage.work,
        "options": dict(stage.options),
        "software": dict(software),
        "inputs": {
            name: [(_named(path, root), found) for path in paths if (found := contents.of(path))]
            for name, paths in lists.items()
        },
        "outputs": [_named(path, root) for path in stage.outputs],
    }
    text = json.dumps(told, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _named(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


class Records:
    """The records of a folder, each a file that appears whole or not at all."""

    def __init__(self, folder: Path, root: Path) -> None:
        self._folder, self._root = folder, root

    def write(self, record: Record) -> None:
        """Keep a record in place of an earlier one of its stage."""
        with whole_file(self._path(record.name)) as part:
            text = json.dumps(vars(record), indent=1, ensure_ascii=False)
            part.write_text(text + "\n", encoding="utf-8")

    def read(self, name: str) -> Record | None:
        """Return the record of a stage; None where there is none, or it is damaged."""
        return _read(self._path(name))

    def standing(self, stage: Stage, key: str, contents: Contents) -> Record | None:
        """Return the record that makes doing a stage again needless, if there is one."""
        record = self.read(stage.name)
        if record is None or record.key != key:
            return None
        found = {_named(path, self._root): contents.of(path) for path in stage.outputs}
        whole = all(found.get(name) == held for name, held in record.outputs.items())
        return record if whole and (record.refusal or set(found) == set(record.outputs)) else None

    def names(self) -> list[str]:
        """Return the stages that have a record."""
        found = (_read(path) for path in sorted(self._folder.glob("*.json")))
        return [record.name for record in found if record is not None]

    def forget(self, name: str) -> list[Path]:
        """Remove a record; return the outputs it speaks of, which lie in the folder of the run."""
        record = self.read(name)
        self._path(name).unlink(missing_ok=True)
        paths = [self._root / each for each in record.outputs] if record else []
        return [path for path in paths if path.resolve().is_relative_to(self._root.resolve())]

    def held(self, stage: Stage, contents: Contents) -> dict[str, str | None]:
        """Return what each output of a stage holds now."""
        return {_named(path, self._root): contents.of(path) for path in stage.outputs}

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"


def _read(path: Path) -> Record | None:
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None

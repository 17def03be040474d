"""The manifest of a folder of vehicles: what they were made from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gis_radar.errors import InputError
from gis_radar.json_documents import read_json

RULES = 2
MANIFEST = "manifest.json"
AGAIN = "write it again with this version"


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """What vehicles were made from; two folders merge where this is equal, but for the times.

    Parameters
    ----------
    fingerprint : str
        Of the tiles.
    map : dict
        `digest` of the map, its `crs` and `origin` (the map-frame position of its local (0, 0),
        or None).
    sight : object
        How sight was told, as in the manifest of an occupancy.
    hold_s : dict
        By sensor, how long its frames hold, seconds.
    settings : dict
        Of the tracker and of the coverage, by name.
    sources : list of dict
        Per recording: file, sensor, poses, ...
    """

    fingerprint: str
    map: dict[str, Any]
    sight: Any = "view only"
    hold_s: dict[str, float]
    settings: dict[str, Any] = field(default_factory=dict)
    sources: list[dict[str, Any]]

    @property
    def poses(self) -> dict[str, list[str]]:
        """By sensor, where it stood and what it viewed, as texts that compare."""
        return poses_of(self.sources)


def poses_of(sources: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
    """Return by sensor the poses in the entries of a manifest, each once, as texts that compare."""
    wanted = ("crs", "easting", "northing", "height", "yaw", "pitch", "roll", "view")
    found: dict[str, set[str]] = {}
    for source in sources:
        texts = found.setdefault(str(source.get("sensor")), set())
        for pose in source.get("poses", []):
            texts.add(json.dumps([pose.get(name) for name in wanted], sort_keys=True))
    return {sensor: sorted(texts) for sensor, texts in sorted(found.items())}


def write_manifest(folder: Path, provenance: Provenance) -> None:
    """Write the manifest into an open folder."""
    manifest = asdict(provenance) | {
        "software": {"name": "gis_radar", "version": version("gis_radar")},
        "rules": RULES,
    }
    text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def read_manifest(folder: Path, *, lead: str) -> Provenance:
    """Read the manifest of a folder.

    Parameters
    ----------
    folder : Path
        The folder.
    lead : str
        Name of the file without which it is no folder of vehicles.

    Raises
    ------
    InputError
        If it is missing or damaged, or the folder follows other rules.
    """
    path = folder / MANIFEST
    for file in (MANIFEST, lead):
        if not (folder / file).is_file():
            raise InputError(
                f"{folder}: not a folder of vehicles: lacks {file}",
                hint="a folder that gis-radar vehicles wrote is needed",
            )
    known = read_json(path, what="a manifest of vehicles")
    try:
        rules = int(known["rules"])
        names = Provenance.__dataclass_fields__
        provenance = Provenance(**{name: known[name] for name in names})
        provenance = replace(
            provenance,
            map=dict(provenance.map),
            hold_s={str(name): float(s) for name, s in provenance.hold_s.items()},
            sources=[dict(source) for source in provenance.sources],
        )
        poses_of(provenance.sources)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: damaged: {error!r:.200}") from error
    if rules != RULES:
        raise InputError(f"{folder}: follows rules {rules}, expected {RULES}", hint=AGAIN)
    return provenance

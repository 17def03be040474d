"""Manifest of a dataset, `dataset.json`: its map, tiles and settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import geopandas as gpd
import numpy as np

from gis_radar.base import (
    InputError,
    Reporter,
    Text,
    UsageError,
    clear_leftovers,
    only_writer,
    output_errors,
    read_json,
    refuse_foreign,
    require_folder,
    restored,
    with_texts,
    zone_of,
)
from gis_radar.calibration import Finding, is_record
from gis_radar.dataset.files.parts import replacing, write_single_file
from gis_radar.dataset.files.tables import POSES, RECORDINGS, SCHEMA, SIGHTS
from gis_radar.hdmap import fingerprint, map_digest, read_tiles, write_tiles

MANIFEST, TILES_FILE, MAP = "dataset.json", "tiles.gpkg", "map.osm"
_OWNED = (  # begins of the names of files that a killed run may have left
    MAP, TILES_FILE, "recordings.parquet", "poses.parquet", "sights.parquet", ".",
)  # fmt: skip
BRING_BACK = Text("bring back the file that measure wrote")
_MAKE_ONE = Text("a folder that gis-radar measure wrote is needed")


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Map, tiles, coordinate system and settings of a dataset.

    Parameters
    ----------
    map : str
        Digest of the Lanelet2 map.
    fingerprint : str
        Fingerprint of the tiles.
    crs : str
        Map frame, such as `EPSG:25832`.
    origin : (int, int)
        Easting and northing from which tracks count, whole metres.
    timezone : str
        Time zone of the site, such as `Europe/Berlin`.
    settings : dict
        Settings in effect for all of its hours.
    checks : dict
        By sensor, the finding whether its pose and recordings fit, as
        :attr:`gis_radar.calibration.Finding.record`; hours do not follow from it.
    schema : int
        Number of the schema of the tables.
    heights : str
        Digest of the tiles' road heights; where it is empty, they are not compared.
    live : bool
        Whether the live system makes its hours, so that silence of all sensors is a fault.
    """

    map: str
    fingerprint: str
    crs: str
    origin: tuple[int, int]
    timezone: str = "UTC"
    settings: dict[str, Any] = field(default_factory=dict)
    checks: dict[str, dict[str, str]] = field(default_factory=dict, compare=False)
    schema: int = SCHEMA
    heights: str = ""
    live: bool = field(default=False, compare=False)

    def is_as(self, other: Manifest) -> bool:
        """Return whether another is of the same site and settings, where both state heights."""
        if not (self.heights and other.heights):
            other = replace(other, heights=self.heights)
        return self == other

    @property
    def digest(self) -> str:
        """Digest of what its hours follow from; not of time zone and checks."""
        hours_follow = (
            self.map, self.fingerprint, self.crs, self.origin, self.settings, self.heights,
        )  # fmt: skip
        text = json.dumps(hours_follow, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def findings(self) -> dict[str, Finding]:
        """Findings whether pose and recordings fit, by sensor."""
        return {name: Finding(sensor=name, **found) for name, found in self.checks.items()}

    @property
    def doubts(self) -> dict[str, str]:
        """Remarks on sensors whose pose and recordings are not known to fit, by sensor."""
        return {name: found.doubt for name, found in self.findings.items() if found.doubt}

    @property
    def not_measured(self) -> str:
        """Remark on hours that were drawn and not measured; empty where all were measured."""
        return str(self.settings.get("drawn", ""))

    def write(self, folder: Path) -> None:
        """Write `dataset.json`, replacing the present one."""
        path = folder / MANIFEST
        document = with_texts(asdict(self)) | {"digest": self.digest}
        text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        with replacing(path) as fresh:
            fresh.write_text(text, encoding="utf-8")

    @staticmethod
    def is_there(folder: Path) -> bool:
        """Return whether a folder is a dataset."""
        return (folder / MANIFEST).is_file()

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Read `dataset.json`.

        Raises
        ------
        InputError
            If the folder is no dataset, or has a newer schema.
        """
        path = Path(folder) / MANIFEST
        if not path.is_file():
            inside = Path(folder) / "dataset"
            hint = Text("did you mean {}?", inside) if cls.is_there(inside) else _MAKE_ONE
            raise InputError("{}: is no dataset: lacks {}", folder, MANIFEST, hint=hint)
        document = read_json(path, what="the manifest of a dataset", hint=_MAKE_ONE)
        try:
            if document["schema"] > SCHEMA:
                raise InputError(
                    "{}: has schema {}, newer than {}",
                    folder,
                    document["schema"],
                    SCHEMA,
                    hint="update gis_radar",
                )
            easting, northing = map(int, document["origin"])
            stated = document.pop("digest", None)  # without it, edits are not found
            manifest = cls(**{**restored(document), "origin": (easting, northing)})
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError("{}: damaged: {}", path, f"{error!r:.200}", hint=_MAKE_ONE) from error
        _check_types(path, manifest)
        if stated is not None and stated != manifest.digest:
            raise InputError("{}: was edited after it was written", path, hint=BRING_BACK)
        _check_zone(path, manifest.timezone)
        return manifest


def _check_types(path: Path, manifest: Manifest) -> None:
    """Refuse entries of another type."""
    for name in ("map", "fingerprint", "crs", "timezone", "heights"):
        if not isinstance(getattr(manifest, name), str):
            raise InputError("{}: damaged: {} is no text", path, name, hint=_MAKE_ONE)
    for name in ("settings", "checks"):
        if not isinstance(getattr(manifest, name), dict):
            raise InputError("{}: damaged: {} are none", path, name, hint=_MAKE_ONE)
    for sensor, check in manifest.checks.items():
        if not is_record(check):
            raise InputError(
                "{}: damaged: what was checked of {} is no record", path, sensor, hint=_MAKE_ONE
            )


def _check_zone(path: Path, timezone: str) -> None:
    """Refuse a time zone that there is not, with the name of the file that states it."""
    try:
        zone_of(timezone)
    except UsageError as error:
        raise InputError("{}: {}", path, error.message, hint=error.hint) from error


def create_dataset(
    folder: str | Path,
    manifest: Manifest,
    tiles: gpd.GeoDataFrame,
    *,
    map_file: str | Path | None = None,
    problems: gpd.GeoDataFrame | None = None,
    lanes: gpd.GeoDataFrame | None = None,
    stop_lines: gpd.GeoDataFrame | None = None,
) -> None:
    """Create a dataset: write map, tiles, empty tables of recordings, and last its manifest.

    Parameters
    ----------
    folder : str or Path
        New, or without `dataset.json`.
    manifest : Manifest
        The manifest of the dataset.
    tiles, problems, lanes, stop_lines : GeoDataFrame
        The layers of `tiles.gpkg`.
    map_file : str or Path, optional
        The Lanelet2 map; a copy is kept in the dataset, as hours may be made again.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    folder = Path(folder)
    with output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if map_file is not None:
        with replacing(folder / MAP) as fresh:
            fresh.write_bytes(Path(map_file).read_bytes())
    write_tiles(tiles, folder / TILES_FILE, problems=problems, lanes=lanes, stop_lines=stop_lines)
    for table in (RECORDINGS, POSES, SIGHTS):
        write_single_file(table, folder, table.empty(), manifest.fingerprint)
    manifest.write(folder)


def heights_digest(tiles: gpd.GeoDataFrame) -> str:
    """Return the digest of the road heights of tiles."""
    heights = tiles.sort_values("tile_id")["height_m"].to_numpy(np.float64)
    heights = np.where(np.isnan(heights), np.nan, heights + 0.0)  # as a file gives them back
    return hashlib.blake2b(heights.tobytes(), digest_size=16).hexdigest()


def refuse_other_map(folder: Path, manifest: Manifest) -> None:
    """Refuse a dataset without the map that it was made from, or with another one."""
    path = folder / MAP
    if manifest.map and not path.is_file():
        raise InputError("{}: no such file", path, hint=BRING_BACK)
    if path.is_file() and manifest.map != map_digest(path):
        raise InputError("{}: is of another run", path, hint=BRING_BACK)


def tiles_of_dataset(folder: Path, manifest: Manifest) -> gpd.GeoDataFrame:
    """Read the tiles of a dataset, ascending by `tile_id`.

    Raises
    ------
    InputError
        If they are not those that it was made from.
    """
    tiles = read_tiles(folder / TILES_FILE)
    if (got := fingerprint(tiles)) != manifest.fingerprint:
        raise InputError(
            "{}: has tiles {}, the dataset is of {}",
            folder / TILES_FILE,
            got,
            manifest.fingerprint,
            hint=BRING_BACK,
        )
    if manifest.heights not in {"", heights_digest(tiles)}:
        raise InputError(
            "{}: has road heights of another run", folder / TILES_FILE, hint=BRING_BACK
        )
    return tiles


def require_same_site(
    folder: Path, present: Manifest, *, map_digest: str, fingerprint: str, crs: str,
    heights: str = "",
) -> None:  # fmt: skip
    """Refuse to add to a dataset with other tiles, another map or coordinate system.

    Raises
    ------
    InputError
        If one differs.
    """
    pairs = (
        (Text("coordinate system"), present.crs, crs),
        (Text("map"), present.map, map_digest),
        (Text("set of tiles"), present.fingerprint, fingerprint),
        (Text("set of road heights"), present.heights or heights, heights or present.heights),
    )
    for what, own, given in pairs:
        if own != given:
            raise InputError(
                "{}: was made with another {}: {}, not {}",
                folder,
                what,
                own,
                given,
                hint="name the dataset's own, or another folder",
            )


def require_same_settings(folder: Path, present: Manifest, wanted: Manifest) -> None:
    """Refuse to add to a dataset of another site, or with other settings.

    Raises
    ------
    InputError
        If they differ.
    """
    require_same_site(
        folder, present, map_digest=wanted.map, fingerprint=wanted.fingerprint, crs=wanted.crs,
        heights=wanted.heights,
    )  # fmt: skip
    for name in wanted.settings:
        if differs := _difference(name, present.settings.get(name), wanted.settings[name]):
            raise InputError(
                "{}: was measured with other settings: {}",
                folder,
                differs,
                hint="name the same filters, scans and options, or another folder: "
                "another version's constants need one, too",
            )


def _difference(name: str, was: Any, now: Any) -> str:
    """Return the first setting that differs, with both values, as text; empty where none does."""
    if isinstance(was, Mapping) or isinstance(now, Mapping):  # one is None where the other lacks it
        was, now = (each if isinstance(each, Mapping) else {} for each in (was, now))
        keys = sorted(was.keys() | now.keys())
        found = (_difference(f"{name}.{key}", was.get(key), now.get(key)) for key in keys)
        return next(filter(None, found), "")
    return "" if was == now else Text("{} was {}, is now {}", name, _shown(was), _shown(now))


def _shown(setting: Any) -> str:
    """Return the value of a setting as text."""
    return Text("not set") if setting is None else json.dumps(setting)


@contextmanager
def locked_for_writing(folder: Path, reporter: Reporter) -> Iterator[None]:
    """Lock a dataset for writing, and finish or remove what a killed run left.

    Raises
    ------
    OutputError
        If another run is writing it, its parent folder is missing, or the folder holds other files.
    """
    place = folder.absolute()
    require_folder(place)
    if place.exists() and not Manifest.is_there(place):
        refuse_foreign(place, _OWNED)
    with output_errors(place), only_writer(place, reporter=reporter):
        clear_leftovers(place)
        yield

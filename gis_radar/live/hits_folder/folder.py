"""Read, write and merge a folder of hits: what fusion stores of an hour.

A folder holds frames and hits in the step of their time; how long they are valid is told beside.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.arrays import Integers
from gis_radar.errors import InputError
from gis_radar.json_documents import read_json
from gis_radar.live.hits_folder.streams import CHECKED, damage_named, merge_distinct
from gis_radar.live.hits_folder.tables import FRAME_LOG, HITS, LOG_FILE, SETS, merge_logs
from gis_radar.measures.rows import Rows
from gis_radar.measures.validity import Runs, steps_in
from gis_radar.poses.pose import pose_from_dict
from gis_radar.steps import FIRST_YEAR, LAST_YEAR, STEP_S, in_known_years

RULES = 2
MANIFEST, HITS_FILE = "manifest.json", "hits_by_sensor.parquet"
OWNED = (MANIFEST, "frames.parquet", "views.parquet", HITS_FILE, LOG_FILE)
NEEDED = {
    "frames.parquet": ("sensor", "view", "first_step", "last_step"),
    "views.parquet": ("sensor", "tile_id", "view", "first_step", "last_step"),
    HITS_FILE: SETS.schema.names,
    LOG_FILE: FRAME_LOG.schema.names,
}
MOST_VALIDITY_S = 90.0  # 1.5 cycles of the slowest sensor that may be stated, a frame a minute
AGAIN = "put the folder aside: fusion then writes the hour without it"
NOTHING: Integers = np.empty(0, np.int64)
RowsOfSensors = Callable[[Sequence[str]], Iterator[Rows]]


@dataclass(frozen=True, kw_only=True)
class StoredHits:
    """Hits of tiles, and what could have been hit.

    Parameters
    ----------
    fingerprint : str
        Of its tiles.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps in which a frame of the sensor falls
        while it had that view.
    views : DataFrame
        `sensor, tile_id, view, first_step, last_step`: the tiles each view sees, and from when
        to when the sensor had it. The name of a view stands for its set of tiles.
    hits_by_sensor : callable
        Takes the names of all sensors and starts reading the rows (step, tile_id, sensor), each
        once, ascending, piece by piece: the steps that frames fall in, sensors as numbers.
    sources : list of dict
        Per recording: file, sensor, poses, filters, settings.
    validity_s : dict
        Validity of the frames of each sensor, seconds.
    frame_log : callable
        Takes the names of all sensors and starts reading the rows of the frame log, as of
        :mod:`gis_radar.live.hits_folder.tables`.
    """

    fingerprint: str
    frames: pd.DataFrame
    views: pd.DataFrame
    hits_by_sensor: RowsOfSensors
    sources: list[dict[str, Any]]
    validity_s: dict[str, float]
    frame_log: RowsOfSensors

    @property
    def sensors(self) -> list[str]:
        """The names of the sensors that delivered frames."""
        return sorted(map(str, self.frames["sensor"].unique()))

    def write(self, folder: Path) -> None:
        """Write all tables into an open folder; equal content gives equal files."""
        names = self.sensors
        HITS.write(self.hits_by_sensor(names), folder / HITS_FILE, self.fingerprint, names)
        for name, table in (("frames", self.frames), ("views", self.views)):
            pq.write_table(
                pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(
                    {"fingerprint": self.fingerprint}
                ),
                folder / f"{name}.parquet",
                compression="zstd",
                write_page_checksum=True,
            )
        FRAME_LOG.write(self.frame_log(names), folder / LOG_FILE, self.fingerprint, names)
        manifest = {
            "fingerprint": self.fingerprint,
            "software": {"name": "gis_radar", "version": version("gis_radar")},
            "rules": RULES,
            "validity_s": self.validity_s,
            "sources": _ordered(self.sources),
        }
        text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        (folder / MANIFEST).write_text(text, encoding="utf-8")


def runs_of_frames(sensor: object, view: object, steps: Runs) -> pd.DataFrame:
    """Return the rows of the table of frames for one sensor and view."""
    return pd.DataFrame(
        {"sensor": sensor, "view": view, "first_step": steps.first, "last_step": steps.last}
    )


def table_of_frames(frames: pd.DataFrame) -> pd.DataFrame:
    """Return a table of frames in its one form: fewest runs, ordered by sensor, view and step."""
    empty = runs_of_frames("", "", steps_in(frames[:0]))
    groups = frames.groupby(["sensor", "view"], sort=True)
    pieces = [runs_of_frames(sensor, view, steps_in(rows)) for (sensor, view), rows in groups]
    return _typed(pd.concat(pieces, ignore_index=True) if pieces else empty)


def table_of_views(frames: pd.DataFrame, tiles: dict[str, Integers]) -> pd.DataFrame:
    """Return the table of views: each tile that a view sees, and the steps it held.

    Parameters
    ----------
    frames : DataFrame
        The table of frames: which sensor had which view in which steps.
    tiles : dict
        Ids of the tiles of each view; a view that is not there sees none.
    """
    held = frames.groupby(["sensor", "view"], sort=True, as_index=False).agg(
        first_step=("first_step", "min"), last_step=("last_step", "max")
    )
    seen = [np.sort(tiles.get(view, NOTHING)) for view in held["view"]]
    row = np.repeat(np.arange(len(seen)), np.array([len(ids) for ids in seen], np.int64))
    table = held.iloc[row].reset_index(drop=True)
    table.insert(1, "tile_id", np.concatenate([NOTHING, *seen]))
    return _typed(table)


def _typed(table: pd.DataFrame) -> pd.DataFrame:
    return table.astype({n: str if n in ("sensor", "view") else np.int64 for n in table.columns})


def read_stored_hits(folder: str | Path) -> StoredHits:
    """Open a folder of hits; hits stay on disk.

    Raises
    ------
    InputError
        If a file is missing, damaged, or made from other tiles than the rest, or the folder follows
        rules that are not known here.
    """
    folder = Path(folder)
    manifest = _read_manifest(folder)
    for name in NEEDED:
        _check_table(folder / name, manifest["fingerprint"])
    return StoredHits(
        frames=_read_table(folder / "frames.parquet"),
        views=_read_table(folder / "views.parquet"),
        hits_by_sensor=lambda names: HITS.read(folder / HITS_FILE, names),
        frame_log=lambda names: FRAME_LOG.read(folder / LOG_FILE, names),
        **manifest,
    )


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return what the manifest holds, by the names of the fields of :class:`StoredHits`."""
    path = folder / MANIFEST
    _require(path)
    manifest = read_json(path, what="a manifest of a folder of hits")
    try:
        found: dict[str, Any] = {
            "fingerprint": str(manifest["fingerprint"]),
            "sources": list(manifest["sources"]),
            "validity_s": {str(name): float(s) for name, s in manifest["validity_s"].items()},
        }
        rules = int(manifest["rules"])
        _check_sources(found["sources"], str(path))
        odd = [name for name, s in found["validity_s"].items() if not 0.0 <= s <= MOST_VALIDITY_S]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: damaged: {error!r:.200}") from error
    if odd:
        validity_s = found["validity_s"][odd[0]]
        raise InputError(f"{path}: damaged: frames of {odd[0]} hold {validity_s:g} s")
    if rules != RULES:
        raise InputError(f"{folder}: follows rules {rules}, expected {RULES}", hint=AGAIN)
    return found


def _check_sources(sources: list[Any], what: str) -> None:
    """Refuse entries of recordings that are not what is written; what reads them relies on it."""
    for source in sources:
        poses = source.get("poses", [])
        if not isinstance(source["sensor"], str) or not isinstance(poses, list):
            raise TypeError("a source names no sensor, or lists no poses")
        for pose in poses:
            pose_from_dict(dict(pose), what=what)
        for name in ("filters", "settings", "clock"):
            if not isinstance(source.get(name, {}), dict | None):
                raise TypeError(f"{name} of {source['sensor']:.40} are no table")


def _require(path: Path) -> None:
    if not path.is_file():
        raise InputError(
            f"{path.parent}: not a folder of hits: lacks {path.name}",
            hint=AGAIN,
        )


def _read_table(path: Path) -> pd.DataFrame:
    with damage_named(path):
        table = pd.DataFrame(pq.read_table(path, **CHECKED).to_pandas())
    if (table["first_step"] > table["last_step"]).any():
        raise InputError(f"{path}: damaged: steps that end before they begin")
    if table.isna().to_numpy().any():
        raise InputError(f"{path}: damaged: a value is missing")
    for column in ("first_step", "last_step"):
        if not in_known_years(table[column].to_numpy(np.float64) * STEP_S).all():
            raise InputError(
                f"{path}: damaged: steps outside the years {FIRST_YEAR} to {LAST_YEAR}"
            )
    return table


def _check_table(path: Path, fingerprint: str) -> None:
    """Refuse a table that is missing, lacks columns or was made from other tiles."""
    _require(path)
    with damage_named(path):
        schema = pq.read_schema(path)
    needed = NEEDED[path.name]
    if missing := [column for column in needed if column not in schema.names]:
        raise InputError(f"{path}: lacks the column {missing[0]}")
    for column in {"step", "tile_id", "first_step", "last_step"} & set(schema.names):
        if not pa.types.is_integer(kind := schema.field(column).type):
            raise InputError(f"{path}: column {column} is {kind}, expected whole numbers")
    for column in {"sensor", "view"} & set(schema.names):
        if not _is_text(kind := schema.field(column).type):
            raise InputError(f"{path}: column {column} is {kind}, expected text")
    if "tiles" in needed and not pa.types.is_binary(kind := schema.field("tiles").type):
        raise InputError(f"{path}: column tiles is {kind}, expected bytes")
    other = (
        (schema.metadata or {}).get(b"fingerprint", fingerprint.encode()).decode(errors="replace")
    )
    if other != fingerprint:
        raise InputError(f"{path}: was made from tiles {other}, its folder from {fingerprint}")


def _is_text(kind: pa.DataType) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def merge_stored_hits(parts: Sequence[StoredHits]) -> StoredHits:
    """Merge folders of hits of any times and sensors, exactly.

    The result does not depend on their order, on how the time was split between them, or on
    repetition: each table is a set, and its one written form follows from its content.

    Raises
    ------
    InputError
        If their tiles differ, or how long the frames of a sensor hold.
    """
    if len({part.fingerprint for part in parts}) > 1:
        raise InputError("the folders of hits were made with different tiles")
    validity_s: dict[str, float] = {}
    for sensor, this_s in (each for part in parts for each in part.validity_s.items()):
        if (other_s := validity_s.setdefault(sensor, this_s)) != this_s:
            held = f"{1000 * other_s:g} and {1000 * this_s:g} ms"
            raise InputError(f"frames of {sensor} hold {held}: they do not merge")
    frames = table_of_frames(pd.concat([part.frames for part in parts]))
    pairs = pd.concat([part.views[["view", "tile_id"]] for part in parts]).drop_duplicates()
    tiles = {
        str(view): group.to_numpy(np.int64) for view, group in pairs.groupby("view")["tile_id"]
    }
    return StoredHits(
        fingerprint=parts[0].fingerprint,
        frames=frames,
        views=table_of_views(frames, tiles),
        hits_by_sensor=lambda names: merge_distinct(
            [part.hits_by_sensor(names) for part in parts], 3
        ),
        sources=_ordered([source for part in parts for source in part.sources]),
        frame_log=lambda names: merge_logs([part.frame_log(names) for part in parts]),
        validity_s=validity_s,
    )


def _ordered(sources: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return each source once, in an order that follows from the sources alone."""
    texts = {json.dumps(source, sort_keys=True) for source in sources}
    return [json.loads(text) for text in sorted(texts)]

"""Read, write and merge the folder of an occupancy."""

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
from gis_radar.files import whole_folder
from gis_radar.notebooks import card
from gis_radar.occupancy.frame_log import COLUMNS, FILE, FRAME_LOG, merge_frame_logs
from gis_radar.occupancy.frame_steps import Runs, steps_in
from gis_radar.occupancy.hits import (
    CHECKED,
    HITS,
    Hits,
    Rows,
    damaged_as_input_error,
    merge_hits,
    read_hits,
)
from gis_radar.occupancy.views import name_of_view
from gis_radar.steps import STEP_S, iso_from_step

FILES = ("hits.parquet", "frames.parquet", "views.parquet", "manifest.json")
OWNED = (*FILES, FILE, "quality.")  # a table made of it may stand there
NEEDED = {
    "hits": ("step", "tile_id"),
    "frames": ("sensor", "first_step", "last_step"),
    "views": ("sensor", "tile_id"),
    "deliveries": COLUMNS,
}
NOTHING: Integers = np.empty(0, np.int64)
FrameLog = Callable[[Sequence[str]], Iterator[Rows]]


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Hits of tiles, and what could have been hit.

    Parameters
    ----------
    fingerprint : str
        Of its tiles.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps in which the sensor delivered a
        frame while it had that view.
    views : DataFrame
        `sensor, tile_id, view, first_step, last_step`: the tiles each view sees, and from when
        to when the sensor had it. The name of a view stands for its set of tiles.
    hits : callable
        Starts reading the pairs (step, tile_id), each once, ascending, piece by piece.
    sources : list of dict
        Per recording: file, sensor, poses, filters, settings.
    frame_log : callable
        Takes the names of all sensors and starts reading the rows of the frame log, as of
        :mod:`gis_radar.occupancy.frame_log`; none where the folder has no such log.
    """

    fingerprint: str
    frames: pd.DataFrame
    views: pd.DataFrame
    hits: Callable[[], Iterator[Hits]]
    sources: list[dict[str, Any]]
    frame_log: FrameLog = lambda _: iter(())

    @property
    def sensors(self) -> list[str]:
        """The names of the sensors that delivered frames."""
        return sorted(map(str, self.frames["sensor"].unique()))

    def __repr__(self) -> str:
        sensors = ", ".join(self.sensors)
        seconds = (self.frames["last_step"] - self.frames["first_step"] + 1).sum() * STEP_S
        tiles = self.views["tile_id"].nunique()
        return f"Occupancy({sensors}: {seconds:.1f} s of frames, {tiles} tiles seen)"

    def figures(self) -> dict[str, Any]:
        """Return sensors, time span, tiles and hits."""
        return self._span() | {"hits": sum(len(step) for step, _ in self.hits())}

    def _span(self) -> dict[str, Any]:
        first, last = int(self.frames["first_step"].min()), int(self.frames["last_step"].max())
        return {
            "sensors": self.sensors,
            "begin": iso_from_step(first),
            "end": iso_from_step(last + 1),
            "tiles_observed": int(self.views["tile_id"].nunique()),
        }

    def _repr_html_(self) -> str:
        if self.frames.empty:
            return card("Occupancy", {"frames": "none"})
        runs = self.frames.groupby("sensor")[["first_step", "last_step"]]
        seconds = {
            str(name): f"{(run['last_step'] - run['first_step'] + 1).sum() * STEP_S:.1f} s"
            for name, run in runs
        }
        return card("Occupancy", {**self._span(), "frames": seconds})

    def write(self, folder: str | Path) -> Path:
        """Write the folder, whole or not at all; equal content gives equal files."""
        folder = Path(folder)
        with whole_folder(folder, owned=OWNED) as part:
            HITS.write(self.hits(), part / "hits.parquet", self.fingerprint)
            self.write_beside_hits(part)
        return folder

    def write_beside_hits(self, folder: Path) -> None:
        """Write everything but the hits into an open folder."""
        for name, table in (("frames", self.frames), ("views", self.views)):
            pq.write_table(
                pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(
                    {"fingerprint": self.fingerprint}
                ),
                folder / f"{name}.parquet",
                compression="zstd",
                write_page_checksum=True,
            )
        rows = self.frame_log(self.sensors)
        FRAME_LOG.write(rows, folder / FILE, self.fingerprint, self.sensors)
        manifest = {
            "fingerprint": self.fingerprint,
            "software": {"name": "gis_radar", "version": version("gis_radar")},
            "sources": _ordered(self.sources),
        }
        text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        (folder / "manifest.json").write_text(text, encoding="utf-8")


def frames_of(sensor: object, view: object, steps: Runs) -> pd.DataFrame:
    """Return the rows of the table of frames for one sensor and view."""
    return pd.DataFrame(
        {"sensor": sensor, "view": view, "first_step": steps.first, "last_step": steps.last}
    )


def frames_table(frames: pd.DataFrame) -> pd.DataFrame:
    """Return a table of frames in its one form: fewest runs, ordered by sensor, view and step."""
    empty = frames_of("", "", steps_in(frames[:0]))
    groups = frames.groupby(["sensor", "view"], sort=True)
    pieces = [frames_of(sensor, view, steps_in(rows)) for (sensor, view), rows in groups]
    return _typed(pd.concat(pieces, ignore_index=True) if pieces else empty)


def views_table(frames: pd.DataFrame, tiles: dict[str, Integers]) -> pd.DataFrame:
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


def read_occupancy(folder: str | Path) -> Occupancy:
    """Open an occupancy folder; its hits stay on disk.

    Raises
    ------
    InputError
        If a file is missing, damaged, or made from other tiles than the rest.
    """
    folder = Path(folder)
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder}: not an occupancy folder: lacks {', '.join(missing)}",
            hint="make one with: gis-radar occupancy",
        )
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        fingerprint, sources = str(manifest["fingerprint"]), list(manifest["sources"])
    except (ValueError, OSError, KeyError, TypeError) as error:
        raise InputError(f"{folder / 'manifest.json'}: damaged: {error!r}") from error
    frames, views = (_read_table(folder, name, fingerprint) for name in ("frames", "views"))
    _check_table(folder, "hits", fingerprint)
    if (log := folder / FILE).exists():
        _check_table(folder, "deliveries", fingerprint)
    frames, views = _with_view_names(frames, views)
    return Occupancy(
        fingerprint=fingerprint,
        frames=frames,
        views=views,
        hits=lambda: read_hits(folder / "hits.parquet"),
        sources=sources,
        frame_log=lambda sensors: FRAME_LOG.read(log, sensors) if log.is_file() else iter(()),
    )


def _read_table(folder: Path, name: str, fingerprint: str) -> pd.DataFrame:
    _check_table(folder, name, fingerprint)
    path = folder / f"{name}.parquet"
    with damaged_as_input_error(path):
        return pd.DataFrame(pq.read_table(path, **CHECKED).to_pandas())


def _check_table(folder: Path, name: str, fingerprint: str) -> None:
    """Refuse a table that lacks columns or was made from other tiles."""
    path = folder / f"{name}.parquet"
    with damaged_as_input_error(path):
        schema = pq.read_schema(path)
    missing = [column for column in NEEDED[name] if column not in schema.names]
    if missing:
        raise InputError(f"{path}: lacks the column {missing[0]}")
    other = (schema.metadata or {}).get(b"fingerprint", fingerprint.encode()).decode()
    if other != fingerprint:
        raise InputError(f"{path}: was made from tiles {other}, its folder from {fingerprint}")


def _with_view_names(
    frames: pd.DataFrame, views: pd.DataFrame
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Name the views of tables that have none: one a sensor."""
    if "view" in frames and "view" in views:
        return frames, views
    seen = views.groupby("sensor")["tile_id"]
    names = {sensor: name_of_view(tiles.to_numpy(np.int64)) for sensor, tiles in seen}
    named = frames.assign(view=frames["sensor"].map(names).fillna(name_of_view(NOTHING)))
    tiles = {names[sensor]: ids.to_numpy(np.int64) for sensor, ids in seen}
    return named, views_table(named, tiles)


def merge_occupancies(parts: Sequence[Occupancy]) -> Occupancy:
    """Merge occupancies of any times and sensors, exactly.

    The result does not depend on their order, on how the time was split between them, or on
    repetition: each table is a set, and its one written form follows from its content.

    Raises
    ------
    InputError
        If their tiles differ.
    """
    if len({part.fingerprint for part in parts}) > 1:
        raise InputError("the occupancy folders were made with different tiles")
    frames = frames_table(pd.concat([part.frames for part in parts]))
    pairs = pd.concat([part.views[["view", "tile_id"]] for part in parts]).drop_duplicates()
    tiles = {
        str(view): group.to_numpy(np.int64) for view, group in pairs.groupby("view")["tile_id"]
    }
    return Occupancy(
        fingerprint=parts[0].fingerprint,
        frames=frames,
        views=views_table(frames, tiles),
        hits=lambda: merge_hits([part.hits() for part in parts]),
        sources=_ordered([source for part in parts for source in part.sources]),
        frame_log=lambda sensors: merge_frame_logs([part.frame_log(sensors) for part in parts]),
    )


def _ordered(sources: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return each source once, in an order that follows from the sources alone."""
    texts = {json.dumps(source, sort_keys=True) for source in sources}
    return [json.loads(text) for text in sorted(texts)]

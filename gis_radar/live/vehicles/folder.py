"""Write the folder of vehicles of an hour.

Finished vehicles come piece by piece in ascending time, and are written as they come: memory is
that of a batch and of a block of runs, not of the hour.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from gis_radar.errors import InputError
from gis_radar.files import atomic_folder
from gis_radar.live.hits_folder.folder import table_of_frames
from gis_radar.measures.validity import steps_in, valid_until
from gis_radar.tiles.tiles import fingerprint
from gis_radar.tracking.batches import VehicleBatch, joined_rows
from gis_radar.tracking.occupancy import OccupancyEngine
from gis_radar.tracking.occupancy_settings import OccupancySettings
from gis_radar.tracking.tables import (
    FRAMES,
    OCCUPIED,
    PASSAGES,
    TRACKS,
    VEHICLES,
    VISIBLE,
    TableKind,
)
from gis_radar.tracking.visibility import SensorView

RULES = 2
MANIFEST = "manifest.json"
BLOCK_STEPS = 18_000
"""Steps of a block of runs, at whole multiples: runs of tiles are cut at its edges."""

_TABLES = (TRACKS, VEHICLES, PASSAGES, OCCUPIED, VISIBLE, FRAMES)
_OWNED = (MANIFEST, *(kind.file for kind in _TABLES))
_ROWS_IN_GROUP = 1 << 17


def held_frames(frames: pd.DataFrame, validity_s: Mapping[str, float], end: int) -> pd.DataFrame:
    """Return a table of frames with the runs of steps in which they are valid, none after `end`."""
    held = [frames[:0]]
    for sensor, rows in frames.groupby("sensor", sort=True):
        last = rows["last_step"].to_numpy(np.int64)
        until = valid_until(last, steps_in(rows), validity_s[str(sensor)])
        held.append(rows.assign(last_step=np.minimum(until, end)))
    return pd.concat(held, ignore_index=True)


class VehicleTableWriter:
    """A table of a kind that is written as rows come.

    Parameters
    ----------
    kind : TableKind
        Its columns.
    path : Path
        The file.
    fingerprint : str
        Of the tiles, for the file's metadata.
    by_batch : bool
        Whether each batch becomes a row group of its own; without it, row groups have a size of
        their own, and the file does not depend on the batches.
    """

    def __init__(
        self, kind: TableKind, path: Path, fingerprint: str, *, by_batch: bool = False
    ) -> None:
        self._kind, self._by_batch = kind, by_batch
        self._waiting = kind.schema.empty_table()
        integers = [name for name, each in kind.columns.items() if pa.types.is_integer(each)]
        self._writer = pq.ParquetWriter(
            path,
            kind.schema.with_metadata({"fingerprint": fingerprint}),
            compression="zstd",
            use_dictionary=False,
            column_encoding=dict.fromkeys(integers, "DELTA_BINARY_PACKED"),
            write_page_checksum=True,
        )

    def __enter__(self) -> Self:
        return self

    def add(self, table: pd.DataFrame) -> None:
        """Add the rows of a typed table, which follow those so far."""
        rows = self._kind.to_arrow(table)
        if self._by_batch:
            if len(rows):
                self._writer.write_table(rows, row_group_size=len(rows))
            return
        self._waiting = pa.concat_tables([self._waiting, rows])
        while len(self._waiting) >= _ROWS_IN_GROUP:
            group = self._waiting.slice(0, _ROWS_IN_GROUP)
            self._writer.write_table(group, row_group_size=_ROWS_IN_GROUP)
            self._waiting = self._waiting.slice(_ROWS_IN_GROUP)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and len(self._waiting):
            self._writer.write_table(self._waiting.combine_chunks())
        self._writer.close()


class VehicleHourWriter:
    """A folder of vehicles that is written as finished pieces come."""

    def __init__(
        self, part: Path, manifest: dict[str, Any], engine: OccupancyEngine, files: ExitStack
    ) -> None:
        self.folder, self._manifest, self._engine = part, manifest, engine
        self._reached: int | None = None
        self._last: dict[int, int] = {}  # last step of the vehicles of the batch before
        self._vehicles: dict[int, dict[str, Any]] = {}
        self._passages: list[pd.DataFrame] = []
        self._frames: list[pd.DataFrame] = []
        self._recent = FRAMES.empty()  # of them, those that may be valid in later steps
        self._writers = {
            kind.name: files.enter_context(
                VehicleTableWriter(
                    kind, part / kind.file, manifest["fingerprint"],
                    by_batch=kind in (OCCUPIED, VISIBLE),
                )
            )
            for kind in (TRACKS, OCCUPIED, VISIBLE)
        }  # fmt: skip

    def warm_up(self, batch: VehicleBatch) -> None:
        """Take a batch before the first one: what it hides and where it drives, not its states."""
        tracks, vehicles = TRACKS.typed(batch.tracks), VEHICLES.typed(batch.vehicles)
        self._recent = FRAMES.typed(batch.frames.sort_values(["sensor", "view", "first_step"]))
        self._advance(batch, tracks, vehicles)
        self._engine.flush()
        self._passages = []

    def add(self, batch: VehicleBatch) -> None:
        """Write a batch that follows those so far.

        Raises
        ------
        InputError
            If its tables are not in order, or it does not follow.
        """
        tracks, vehicles = TRACKS.typed(batch.tracks), VEHICLES.typed(batch.vehicles)
        frames = FRAMES.typed(batch.frames.sort_values(["sensor", "view", "first_step"]))
        self._refuse_disorder(batch, tracks, vehicles)
        if self._reached is not None and batch.first_step // BLOCK_STEPS != self._block:
            self._flush()
        self._writers["tracks"].add(tracks)
        for row in vehicles.to_dict("records"):
            number = int(row["vehicle"])
            self._vehicles[number] = joined_rows(
                self._vehicles.get(number), {str(name): each for name, each in row.items()}
            )
        self._frames.append(frames)
        self._recent = pd.concat([self._recent, frames], ignore_index=True)
        late = self._recent["last_step"] >= batch.first_step - BLOCK_STEPS
        self._recent = self._recent[late].reset_index(drop=True)
        self._advance(batch, tracks, vehicles)

    def _advance(self, batch: VehicleBatch, tracks: pd.DataFrame, vehicles: pd.DataFrame) -> None:
        """Go on to the end of a batch, and write the blocks of runs that end in it."""
        held = held_frames(self._recent, self._manifest["validity_s"], batch.last_step)
        edges = range(batch.first_step // BLOCK_STEPS + 1, batch.last_step // BLOCK_STEPS + 1)
        begins = [batch.first_step, *(edge * BLOCK_STEPS for edge in edges)]
        for begin, after in zip(begins, [*begins[1:], batch.last_step + 1], strict=True):
            if begin > batch.first_step:
                self._flush()
            step = tracks["step"].to_numpy(np.int64)
            low, high = np.searchsorted(step, [begin, after])
            states = tracks.iloc[low:high].reset_index(drop=True)
            self._passages.append(self._engine.advance(states, vehicles, held, (begin, after)))
            self._reached = after - 1

    @property
    def _block(self) -> int:
        return (self._reached or 0) // BLOCK_STEPS

    def _refuse_disorder(
        self, batch: VehicleBatch, tracks: pd.DataFrame, vehicles: pd.DataFrame
    ) -> None:
        """Refuse states out of the span, without size, or with steps left out."""
        if batch.first_step > batch.last_step or batch.first_step <= (self._reached or -(2**62)):
            raise InputError(
                f"tracks: a batch of steps {batch.first_step} to {batch.last_step} does not follow "
                f"step {self._reached}"
            )
        by_vehicle = tracks.groupby("vehicle")["step"].agg(["min", "max", "size"])
        if not set(by_vehicle.index) <= set(vehicles["vehicle"]):
            raise InputError("tracks: has states of a vehicle that the vehicles lack")
        for number, (first, last, count) in zip(
            by_vehicle.index.tolist(), by_vehicle.to_numpy().tolist(), strict=True
        ):
            before = self._last.get(number, first - 1)
            if first < batch.first_step or last > batch.last_step:
                raise InputError(f"tracks: vehicle {number} has states out of its batch")
            if count != last - first + 1 or (number in self._vehicles and before != first - 1):
                raise InputError(f"tracks: vehicle {number} lacks a step from {before} to {last}")
        self._last = dict(zip(by_vehicle.index.tolist(), by_vehicle["max"].tolist(), strict=True))

    def _flush(self) -> None:
        occupied, visible = self._engine.flush()
        self._writers["occupied"].add(OCCUPIED.typed(occupied))
        self._writers["visible"].add(VISIBLE.typed(visible))

    def finish(self) -> None:
        """Write what is known only at the end: the last block, vehicles, passages, manifest."""
        self._flush()
        frames = table_of_frames(pd.concat([FRAMES.empty(), *self._frames], ignore_index=True))
        vehicles = pd.DataFrame([self._vehicles[n] for n in sorted(self._vehicles)])
        passages = pd.concat([PASSAGES.empty(), *self._passages], ignore_index=True)
        small = (
            (FRAMES, frames),
            (VEHICLES, vehicles if len(vehicles) else VEHICLES.empty()),
            (PASSAGES, passages.sort_values([*PASSAGES.order])),
        )
        for kind, table in small:
            path = self.folder / kind.file
            with VehicleTableWriter(kind, path, self._manifest["fingerprint"]) as writer:
                writer.add(kind.typed(table))
        text = json.dumps(self._manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        (self.folder / MANIFEST).write_text(text, encoding="utf-8")


@contextmanager
def write_vehicle_hour(
    folder: Path,
    *,
    tiles: gpd.GeoDataFrame,
    views: Sequence[SensorView],
    manifest: Mapping[str, Any],
) -> Iterator[VehicleHourWriter]:
    """Write a folder of vehicles, whole or not at all.

    Parameters
    ----------
    folder : Path
        Where; an earlier one there is replaced.
    tiles : GeoDataFrame
        All tiles.
    views : sequence of SensorView
        Where each sensor stood in each of its views, and the tiles that it had in sight.
    manifest : mapping
        What vehicles were made from: `fingerprint` of the tiles, `validity_s` by sensor, `map`,
        `sight`, `settings`, `sources`. Software, rules and the settings of the occupancy are added.

    Yields
    ------
    VehicleHourWriter
        Takes the batches in ascending time.

    Raises
    ------
    InputError
        If the tiles are not those of the manifest.
    """
    settings = OccupancySettings()
    if (got := fingerprint(tiles)) != manifest["fingerprint"]:
        raise InputError(f"the tiles have the fingerprint {got}, not {manifest['fingerprint']}")
    whole = {
        **manifest,
        "settings": {**manifest["settings"], "occupancy": asdict(settings)},
        "software": {"name": "gis_radar", "version": version("gis_radar")},
        "rules": RULES,
    }
    with atomic_folder(folder, owned=_OWNED) as part, ExitStack() as files:
        engine = OccupancyEngine(tiles, views, settings)
        writer = VehicleHourWriter(part, whole, engine, files)
        yield writer
        writer.finish()

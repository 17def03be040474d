"""Occupancy by block: counts of tiles, passages, and who stood at the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.live.hours import HOUR_STEPS
from gis_radar.live.vehicles.folder import held_frames
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.tracking.batches import VehicleBatch
from gis_radar.tracking.occupancy import OccupancyEngine
from gis_radar.tracking.tables import FRAMES, TRACKS, VEHICLES
from gis_radar.tracking.visibility import SensorView


@dataclass(frozen=True, kw_only=True)
class Finished:
    """What a block adds to the counts.

    Parameters
    ----------
    first_step, last_step : int
        The block.
    visible, occupied : (n,) int64 arrays
        By position of the tiles, steps in which each was visible, and occupied while it was.
    passages : DataFrame
        As :data:`gis_radar.tracking.tables.PASSAGES`.
    stood : (k, 5) array
        Who stood at its end: east and north from the origin of the graph, heading (rad), 0, length.
    """

    first_step: int
    last_step: int
    visible: Integers
    occupied: Integers
    passages: pd.DataFrame
    stood: Floats


class LiveOccupancy:
    """Counts occupied steps, batch by batch.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    """

    def __init__(self, tiles: gpd.GeoDataFrame) -> None:
        self._tile_id = tiles["tile_id"].to_numpy(np.int64)
        self._engine = OccupancyEngine(tiles, [])
        self._recent = FRAMES.empty()

    def add_view(self, view: SensorView) -> None:
        """Take in what a sensor sees from a pose."""
        self._engine.add_view(view)

    def keep_views(self, known: set[tuple[str, str]]) -> None:
        """Forget views but those of the last frames and some more, by sensor and name."""
        recent = {*zip(self._recent["sensor"], self._recent["view"], strict=True)}
        self._engine.keep_views(known=known | recent, used=recent)

    def add(self, batch: VehicleBatch, validity_s: Mapping[str, float], origin: Floats) -> Finished:
        """Return what a batch adds, which follows those so far."""
        tracks, vehicles = TRACKS.typed(batch.tracks), VEHICLES.typed(batch.vehicles)
        frames = FRAMES.typed(batch.frames.sort_values(["sensor", "view", "first_step"]))
        late = self._recent["last_step"] >= batch.first_step - HOUR_STEPS // 60
        self._recent = pd.concat([self._recent[late], frames], ignore_index=True)
        held = held_frames(self._recent, validity_s, batch.last_step)
        span = (batch.first_step, batch.last_step + 1)
        passages = self._engine.advance(tracks, vehicles, held, span)
        occupied, visible = self._engine.flush()
        seen, both = self._steps(occupied, visible, batch)
        return Finished(
            first_step=batch.first_step, last_step=batch.last_step, visible=seen, occupied=both,
            passages=passages, stood=_stood(tracks, vehicles, batch.last_step, origin),
        )  # fmt: skip

    def _steps(
        self, occupied: pd.DataFrame, visible: pd.DataFrame, batch: VehicleBatch
    ) -> tuple[Integers, Integers]:
        """Return the visible steps of each tile, and those in which it was occupied, too."""
        count = len(self._tile_id)
        tile = np.searchsorted(self._tile_id, visible["tile_id"])
        size = (visible["last_step"] - visible["first_step"] + 1).to_numpy(np.int64)
        seen = np.bincount(tile, size, count).astype(np.int64)
        some = np.unique(occupied["tile_id"].to_numpy(np.int64))
        flags = [
            _flags(runs[runs["tile_id"].isin(some)], some, batch) for runs in (occupied, visible)
        ]
        both = np.zeros(count, np.int64)
        both[np.searchsorted(self._tile_id, some)] = (flags[0] & flags[1]).sum(axis=1)
        return seen, both


def _flags(runs: pd.DataFrame, tiles: Integers, batch: VehicleBatch) -> np.ndarray:
    """Return (tile, step) flags of runs."""
    edges = np.zeros((len(tiles), batch.last_step - batch.first_step + 2), np.int8)
    row = np.searchsorted(tiles, runs["tile_id"].to_numpy(np.int64))
    for name, sign, more in (("first_step", 1, 0), ("last_step", -1, 1)):
        np.add.at(edges, (row, runs[name].to_numpy(np.int64) - batch.first_step + more), sign)
    return np.asarray(np.cumsum(edges[:, :-1], axis=1) > 0)


def _stood(tracks: pd.DataFrame, vehicles: pd.DataFrame, step: int, origin: Floats) -> Floats:
    """Return who stands at the end of a batch."""
    rows = tracks[(tracks["step"] == step) & (tracks["speed"] < DEFAULTS.gone_mps)]
    length = vehicles.set_index("vehicle")["length_m"].reindex(rows["vehicle"]).to_numpy()
    return np.column_stack(
        [
            rows[["easting", "northing"]].to_numpy(np.float64) - origin,
            np.radians(rows["heading"]), np.zeros(len(rows)), length,
        ]
    )  # fmt: skip

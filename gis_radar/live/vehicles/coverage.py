"""What vehicles cover, block by block: counts of tiles, passages, and who stood at the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.site.hours import HOUR_STEPS
from gis_radar.vehicles.coverage import CoverageEngine
from gis_radar.vehicles.folder import VehiclePiece, hold_frames
from gis_radar.vehicles.tables import FRAMES, TRACKS, VEHICLES
from gis_radar.vehicles.visibility import SensorView


@dataclass(frozen=True, kw_only=True)
class Finished:
    """What a block adds to the counts.

    Parameters
    ----------
    first_step, last_step : int
        The block.
    visible, covered : (n,) int64 arrays
        By position of the tiles, steps in which each was visible, and covered while it was.
    passages : DataFrame
        As :data:`gis_radar.vehicles.tables.PASSAGES`.
    stood : (k, 5) array
        Who stood at its end: east and north from the origin of the graph, heading (rad), 0, length.
    """

    first_step: int
    last_step: int
    visible: Integers
    covered: Integers
    passages: pd.DataFrame
    stood: Floats


class LiveCoverage:
    """Counts what vehicles cover, piece by piece.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    """

    def __init__(self, tiles: gpd.GeoDataFrame) -> None:
        self._tile_id = tiles["tile_id"].to_numpy(np.int64)
        self._engine = CoverageEngine(tiles, [])
        self._recent = FRAMES.empty()

    def add_view(self, view: SensorView) -> None:
        """Take in what a sensor sees from a pose."""
        self._engine.add_view(view)

    def keep_views(self, known: set[tuple[str, str]]) -> None:
        """Forget views but those of the last frames and some more, by sensor and name."""
        recent = {*zip(self._recent["sensor"], self._recent["view"], strict=True)}
        self._engine.keep_views(known=known | recent, used=recent)

    def add(self, piece: VehiclePiece, hold_s: Mapping[str, float], origin: Floats) -> Finished:
        """Return what a piece adds, which follows those so far."""
        tracks, vehicles = TRACKS.typed(piece.tracks), VEHICLES.typed(piece.vehicles)
        frames = FRAMES.typed(piece.frames.sort_values(["sensor", "view", "first_step"]))
        late = self._recent["last_step"] >= piece.first_step - HOUR_STEPS // 60
        self._recent = pd.concat([self._recent[late], frames], ignore_index=True)
        held = hold_frames(self._recent, dict(hold_s), piece.last_step)
        span = (piece.first_step, piece.last_step + 1)
        passages = self._engine.advance(tracks, vehicles, held, span)
        covered, visible = self._engine.flush()
        seen, both = self._steps(covered, visible, piece)
        return Finished(
            first_step=piece.first_step, last_step=piece.last_step, visible=seen, covered=both,
            passages=passages, stood=_stood(tracks, vehicles, piece.last_step, origin),
        )  # fmt: skip

    def _steps(
        self, covered: pd.DataFrame, visible: pd.DataFrame, piece: VehiclePiece
    ) -> tuple[Integers, Integers]:
        """Return the visible steps of each tile, and those in which it was covered, too."""
        count = len(self._tile_id)
        tile = np.searchsorted(self._tile_id, visible["tile_id"])
        size = (visible["last_step"] - visible["first_step"] + 1).to_numpy(np.int64)
        seen = np.bincount(tile, size, count).astype(np.int64)
        some = np.unique(covered["tile_id"].to_numpy(np.int64))
        flags = [
            _flags(runs[runs["tile_id"].isin(some)], some, piece) for runs in (covered, visible)
        ]
        both = np.zeros(count, np.int64)
        both[np.searchsorted(self._tile_id, some)] = (flags[0] & flags[1]).sum(axis=1)
        return seen, both


def _flags(runs: pd.DataFrame, tiles: Integers, piece: VehiclePiece) -> np.ndarray:
    """Return (tile, step) flags of runs."""
    edges = np.zeros((len(tiles), piece.last_step - piece.first_step + 2), np.int8)
    row = np.searchsorted(tiles, runs["tile_id"].to_numpy(np.int64))
    for name, sign, more in (("first_step", 1, 0), ("last_step", -1, 1)):
        np.add.at(edges, (row, runs[name].to_numpy(np.int64) - piece.first_step + more), sign)
    return np.asarray(np.cumsum(edges[:, :-1], axis=1) > 0)


def _stood(tracks: pd.DataFrame, vehicles: pd.DataFrame, step: int, origin: Floats) -> Floats:
    """Return who stands at the end of a piece."""
    rows = tracks[(tracks["step"] == step) & (tracks["speed"] < DEFAULTS.gone_mps)]
    length = vehicles.set_index("vehicle")["length_m"].reindex(rows["vehicle"]).to_numpy()
    return np.column_stack(
        [
            rows[["easting", "northing"]].to_numpy(np.float64) - origin,
            np.radians(rows["heading"]), np.zeros(len(rows)), length,
        ]
    )  # fmt: skip

"""Occupied and visible tiles and passages, from states in ascending time."""

from __future__ import annotations

from collections.abc import Mapping

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Floats, Integers
from gis_radar.measures import PoseSight
from gis_radar.tracking.footprints import (
    CrossLines,
    Footprints,
    PathBook,
    footprints_of,
    occupied_runs,
)
from gis_radar.tracking.passages import HEAVY, LaneletPlaces, PassageBook, levels_of
from gis_radar.tracking.visibility import Visibility

# Height of the box of a car, of a van and of a heavy vehicle: a compact car; panel vans are 2.2 to
# 2.8 m; a box body or trailer is 3.5 to 4 m. All 0.2 m lower or higher change the visible time of
# streets full of queues by 2 %.
_CAR_HEIGHT_M, _VAN_HEIGHT_M, _HEAVY_HEIGHT_M = 1.5, 2.3, 3.5
# A longer vehicle that is not heavy is a van: cars end at 5.1 m, vans with a high roof begin at
# 5.3 m.
_VAN_M = 5.2


class OccupancyEngine:
    """Engine that finds runs of occupied and visible tiles, and passages, by ascending time.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    sights : mapping
        Sights of the sensors' poses, by name.
    """

    def __init__(self, tiles: gpd.GeoDataFrame, sights: Mapping[str, PoseSight]) -> None:
        tiles = tiles.sort_values("tile_id", ignore_index=True)
        self._tile_id = tiles["tile_id"].to_numpy(np.int64)
        self._lines = CrossLines.of(tiles)
        self._places = LaneletPlaces.of(tiles)
        self._paths = PathBook()
        self._passages = PassageBook(places=self._places)
        self._visibility = Visibility(tiles, self._lines, sights)
        self._open_runs = np.full((len(tiles), 3), -1)
        self._stamps = np.full((len(tiles), 3), -1)
        self._ended: list[Integers] = []

    def advance(
        self,
        states: pd.DataFrame,
        vehicles: pd.DataFrame,
        valid_runs: pd.DataFrame,
        span: tuple[int, int],
    ) -> pd.DataFrame:
        """Advance over a span, whose end is exclusive; return the passages.

        Parameters
        ----------
        states : DataFrame
            Rows of `tracks` in the span.
        vehicles : DataFrame
            The vehicles of these states.
        valid_runs : DataFrame
            `sight, first_step, last_step`: runs of steps in which frames are valid.
        span : (int, int)
            First step, and the step after the last; of one block of runs.
        """
        level_m = levels_of(states, self._places, self._lines.height_m)
        prints = footprints_of(states, vehicles, level_m, self._lines.origin, self._paths)
        self._ended.append(self._occupy(prints))
        row = np.searchsorted(vehicles["vehicle"].to_numpy(), states["vehicle"].to_numpy())
        tall = self._heights(vehicles)[row]
        passages = self._passages.find(states, vehicles)
        asked = (passages["step"].to_numpy(np.int64), passages["tile"].to_numpy(np.int64))
        visible = self._visibility.advance(prints, tall, valid_runs, span, asked)
        return passages[visible].drop(columns="tile")

    def _heights(self, vehicles: pd.DataFrame) -> Floats:
        """Return the height of the box of each vehicle, metres."""
        van = vehicles["length_m"].to_numpy(float) > _VAN_M
        heavy = vehicles["p_heavy"].to_numpy(float) >= HEAVY
        light = np.where(van, _VAN_HEIGHT_M, _CAR_HEIGHT_M)
        return np.where(heavy, _HEAVY_HEIGHT_M, light)

    def _occupy(self, prints: Footprints) -> Integers:
        """Advance the runs of occupied tiles; return those that ended."""
        lines = self._lines
        return occupied_runs(
            prints.step, prints.boxes, prints.level_m, prints.seen, prints.path, prints.points,
            prints.begins, lines.lines, lines.height_m, *lines.cells, lines.columns, lines.rows,
            lines.cell_m, self._open_runs, self._stamps,
        )  # fmt: skip

    def flush(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the runs of occupied and visible tiles since the last call, by tile and step."""
        running = np.flatnonzero(self._open_runs[:, 0] >= 0)
        self._ended.append(np.column_stack([running, self._open_runs[running]]))
        self._open_runs[running] = -1
        occupied = self._table(np.concatenate(self._ended))
        self._ended = []
        return occupied, self._table(self._visibility.flush())

    def _table(self, runs: Integers) -> pd.DataFrame:
        """Return runs as a table, by tile and step."""
        runs = runs[np.lexsort((runs[:, 1], runs[:, 0]))]
        table = pd.DataFrame(runs, columns=["tile_id", "first_step", "last_step", "seen"])
        return table.assign(tile_id=self._tile_id[runs[:, 0]])

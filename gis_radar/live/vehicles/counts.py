"""What vehicles occupied lately, by tile and by lane."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.heatmap.by_lane import lane_totals, lanes_with_tiles
from gis_radar.live.recent import INTERVAL, KEPT
from gis_radar.live.vehicles.occupancy import Finished
from gis_radar.steps import STEP_S, step_begin


@dataclass(frozen=True, kw_only=True)
class TileOccupancy:
    """Steps of tiles: in which each was visible, and occupied while it was.

    Parameters
    ----------
    visible, occupied : (n,) int64 arrays
        By position of the tiles.
    """

    visible: Integers
    occupied: Integers

    def share(self) -> Floats:
        """Return the occupancy of each tile, NaN where it was not visible."""
        found = np.full(len(self.visible), np.nan)
        np.divide(self.occupied, self.visible, out=found, where=self.visible > 0)
        return found


class _Counted(NamedTuple):
    """A block with lane and speed of the passages that count."""

    block: Finished
    lane: Integers
    speeds: Floats


@dataclass(kw_only=True)
class _Interval:
    """Sums of lanes over 15 minutes."""

    seconds: Floats  # occupied, visible
    passages: Integers
    speeds: Floats


@dataclass(frozen=True, kw_only=True)
class Lately:
    """The 15 minutes up to the last block.

    Parameters
    ----------
    until_step : int
        The last step of that.
    tiles : TileOccupancy
        By position of the tiles.
    lanes : DataFrame
        `lane, occupied_s, visible_s, passages, speed` (m/s, mean).
    """

    until_step: int
    tiles: TileOccupancy
    lanes: pd.DataFrame


class VehicleCounts:
    """Sums what blocks of followed vehicles add; safe to read from another thread.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.
    interval : int
        Steps over which the cumulative map counts.
    """

    def __init__(self, tiles: gpd.GeoDataFrame, *, interval: int) -> None:
        lanes, self._lane_of_tile = lanes_with_tiles(tiles)
        self.lanes = [lane.number for lane in lanes]
        self._size, self._count, self._interval = len(lanes), len(tiles), interval
        self._tiles_of_lane = np.maximum(np.bincount(self._lane_of_tile, minlength=self._size), 1)
        lanelet = tiles["lanelet_id"].to_numpy(np.int64)
        self._lane_of = dict(zip(lanelet.tolist(), self._lane_of_tile.tolist(), strict=True))
        self._blocks: deque[_Counted] = deque()
        self._passed: set[tuple[int, int]] = set()  # vehicle and lane, in the last block
        self._since = TileOccupancy(visible=self._zeros(), occupied=self._zeros())
        self._number = -1
        self._done: dict[int, _Interval] = {}
        self._lately: Lately | None = None
        self.until_step = -1
        self._lock = Lock()

    def _zeros(self) -> Integers:
        return np.zeros(self._count, np.int64)

    def add(self, block: Finished) -> None:
        """Add a block; they come in order, each once."""
        with self._lock:
            if block.last_step <= self.until_step:
                return  # told again after the process began anew
            self.until_step = block.last_step
            counted = _Counted(block, *self._passages(block))
            self._blocks.append(counted)
            while self._blocks[0].block.last_step <= block.last_step - INTERVAL:
                self._blocks.popleft()
            if (number := block.first_step // self._interval) != self._number:
                self._number = number
                self._since = TileOccupancy(visible=self._zeros(), occupied=self._zeros())
            self._since = TileOccupancy(
                visible=self._since.visible + block.visible,
                occupied=self._since.occupied + block.occupied,
            )
            self._add_to_interval(*counted)

    def begin_anew(self, step: int) -> None:
        """Forget what is known from a step on, the begin of 15 minutes: it is told anew."""
        with self._lock:
            self._blocks.clear()
            self._passed, self._number, self.until_step = set(), -1, -1
            self._since = TileOccupancy(visible=self._zeros(), occupied=self._zeros())
            self._done = {k: each for k, each in self._done.items() if k < step // INTERVAL}
            self._lately = None

    def _add_to_interval(self, block: Finished, lane: Integers, speeds: Floats) -> None:
        number = block.first_step // INTERVAL
        found = self._done.setdefault(
            number,
            _Interval(
                seconds=np.zeros((2, self._size)), passages=np.zeros(self._size, np.int64),
                speeds=np.zeros(self._size),
            ),
        )  # fmt: skip
        found.seconds += self._by_lane(block)
        found.passages += np.bincount(lane, minlength=self._size)
        found.speeds += np.bincount(lane, speeds, self._size)
        for old in [each for each in self._done if each <= number - KEPT]:
            del self._done[old]

    def _passages(self, block: Finished) -> tuple[Integers, Floats]:
        """Return lane and speed of each passage of the middle of a lane, not of each lanelet."""
        table = block.passages
        lane = np.array([self._lane_of.get(each, -1) for each in table["lanelet_id"]], np.int64)
        keep, passed = lane >= 0, set[tuple[int, int]]()
        for k, pair in enumerate(zip(table["vehicle"].tolist(), lane.tolist(), strict=True)):
            keep[k] &= pair not in passed and pair not in self._passed
            passed.add(pair)
        self._passed = passed
        return lane[keep], table["speed"].to_numpy(np.float64)[keep]

    def _by_lane(self, block: Finished) -> Floats:
        rows = (block.occupied, block.visible)
        sums = [lane_totals(row.astype(float), self._lane_of_tile, self._size) for row in rows]
        return np.asarray(sums) / self._tiles_of_lane * STEP_S

    def last_minutes(self) -> TileOccupancy:
        """Return the steps of the 15 minutes up to the last block."""
        with self._lock:
            blocks = [each.block for each in self._blocks]
        visible, occupied = self._zeros(), self._zeros()
        for each in blocks:
            visible += each.visible
            occupied += each.occupied
        return TileOccupancy(visible=visible, occupied=occupied)

    def lately(self) -> Lately | None:
        """Return tiles and lanes of the last 15 minutes, made once a block; None without any."""
        if self.until_step >= 0 and (
            self._lately is None or self._lately.until_step != self.until_step
        ):
            self._lately = Lately(
                until_step=self.until_step, tiles=self.last_minutes(), lanes=self.lanes_lately()
            )
        return self._lately

    def interval(self) -> TileOccupancy:
        """Return the steps since the interval last began, of the last block."""
        return self._since

    def lanes_lately(self) -> pd.DataFrame:
        """Return `occupied_s, visible_s, passages, speed` (m/s, mean) of the last 15 minutes."""
        with self._lock:
            blocks = list(self._blocks)
        seconds = sum((self._by_lane(each.block) for each in blocks), np.zeros((2, self._size)))
        lane = np.concatenate([np.zeros(0, np.int64), *(each.lane for each in blocks)])
        speeds = np.concatenate([np.zeros(0), *(each.speeds for each in blocks)])
        passages = np.bincount(lane, minlength=self._size)
        return self._table(
            _Interval(
                seconds=seconds,
                passages=passages,
                speeds=np.bincount(lane, speeds, self._size).astype(np.float64),
            )
        )

    def _table(self, found: _Interval) -> pd.DataFrame:
        speed = np.full(self._size, np.nan)
        np.divide(found.speeds, found.passages, out=speed, where=found.passages > 0)
        return pd.DataFrame(
            {
                "lane": self.lanes, "occupied_s": found.seconds[0], "visible_s": found.seconds[1],
                "passages": found.passages, "speed": speed,
            }
        )  # fmt: skip

    def intervals(self) -> pd.DataFrame:
        """Return the same of intervals of 15 minutes, with `begin`, of at most a day."""
        with self._lock:
            tables = [
                self._table(each).assign(begin=step_begin(number * INTERVAL))
                for number, each in self._done.items()
            ]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

"""Show the map that fusion keeps, and counts of the last minutes, as the page takes them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import Protocol

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.errors import InputError
from gis_radar.heatmap.by_lane import lane_totals
from gis_radar.live.intake import SensorState
from gis_radar.live.map_of_now import MapState
from gis_radar.live.page import make_app
from gis_radar.live.quarters import Quarters
from gis_radar.live.settings import LiveSite
from gis_radar.live.snapshot import Place, ShownSensor, Snapshot, place_of
from gis_radar.live.vehicles_now import LiveVehicles
from gis_radar.live.web_server import WebServer
from gis_radar.site.live_table import PageTable
from gis_radar.steps import STEP_S, step_begin

MINUTE = 1_200  # steps
MINUTES = 15  # of a moving sum, and of an interval
INTERVAL = MINUTES * MINUTE  # steps
KEPT = 96  # intervals: a day


class RecentCounts:
    """Counts steps in which tiles are hit and observed; safe to read from another thread.

    Parameters
    ----------
    lane_of_tile : (n,) int64 array
        Of each tile, the position of its lane.
    lanes : sequence of int
        Numbers of the lanes.
    """

    def __init__(self, lane_of_tile: Integers, lanes: Sequence[int]) -> None:
        self._lane_of_tile, self._lanes = lane_of_tile, list(lanes)
        self._tiles_of_lane = np.maximum(np.bincount(lane_of_tile, minlength=len(lanes)), 1)
        # a row a minute, in turn: hit, observed
        self._by_minute = np.zeros((2, MINUTES, len(lane_of_tile)), np.int64)
        self._interval = np.zeros((2, len(lane_of_tile)), np.int64)
        self._done: deque[tuple[int, Floats]] = deque(maxlen=KEPT)
        self._minute = self._number = -1
        self._lock = Lock()

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a step; steps ascend, until a clock is set back.

        Parameters
        ----------
        step : int
            The step.
        hit, observed : (n,) bool arrays
            Which tiles are, in it.
        """
        with self._lock:
            self._begin_anew(step)
            slot = self._by_minute[:, self._minute % MINUTES]
            for counts in (slot, self._interval):
                counts[0] += hit
                counts[1] += observed

    def _begin_anew(self, step: int) -> None:
        """Clear what is of an earlier minute or interval."""
        minute, number = step // MINUTE, step // INTERVAL
        if minute < self._minute:  # the clock was set back
            self._by_minute[:], self._minute = 0, minute
        if number < self._number:
            self._interval[:], self._number = 0, number
            self._done = deque((each for each in self._done if each[0] < number), maxlen=KEPT)
        if minute != self._minute:
            passed = range(max(self._minute + 1, minute - MINUTES + 1), minute + 1)
            self._by_minute[:, [each % MINUTES for each in passed]] = 0
            self._minute = minute
        if number != self._number:
            if self._number >= 0:
                self._done.append((self._number, self._by_lane()))
            self._interval[:] = 0
            self._number = number

    def last_minutes(self) -> tuple[Integers, Integers]:
        """Return the steps in which each tile was hit and observed: 14 to 15 minutes."""
        with self._lock:
            hit, observed = self._by_minute.sum(axis=1)
        return hit, observed

    def lane_intervals(self) -> pd.DataFrame:
        """Return `lane, begin, end` (UTC), `hit_s, observed_s`: means of a lane's tiles."""
        with self._lock:
            rows = [*self._done]
            if self._number >= 0:
                rows.append((self._number, self._by_lane()))
        tables = [
            pd.DataFrame(
                {
                    "lane": self._lanes,
                    "begin": step_begin(number * INTERVAL),
                    "end": step_begin((number + 1) * INTERVAL),
                    "hit_s": seconds[0],
                    "observed_s": seconds[1],
                }
            )
            for number, seconds in rows
        ]
        names = ["lane", "begin", "end", "hit_s", "observed_s"]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=names)

    def _by_lane(self) -> Floats:
        size = len(self._lanes)
        sums = [lane_totals(row.astype(float), self._lane_of_tile, size) for row in self._interval]
        return np.asarray(sums) / self._tiles_of_lane * STEP_S


RATE_S = 10.0  # over which frames are counted


class FusedMap(Protocol):
    """The part of fusion that is shown."""

    sensors: dict[str, SensorState]
    quarters: Quarters

    def state(self) -> MapState:
        """Return the map of now."""

    def metrics(self) -> str:
        """Return counts and alarms as text for Prometheus."""

    @property
    def vehicles(self) -> LiveVehicles | None:
        """Vehicles, where they are followed."""


class ShownMap:
    """The map of fusion for the page and its services.

    Parameters
    ----------
    fusion : FusedMap
        The map of now, sensors, vehicles.
    place : Place
        Tiles and lanes.
    recent : RecentCounts
        Counts of the last minutes.
    """

    def __init__(self, fusion: FusedMap, place: Place, recent: RecentCounts) -> None:
        self._fusion, self._place, self._recent = fusion, place, recent
        self._frames: deque[tuple[float, dict[str, int]]] = deque()
        self._lock = Lock()

    @property
    def place(self) -> Place:
        """Tiles and lanes."""
        return self._place

    def snapshot(self) -> Snapshot:
        """Return the map of now."""
        state = self._fusion.state()
        hit, observed = self._recent.last_minutes()
        rates, followed = self._rates(), self._fusion.vehicles
        return Snapshot(
            step=state.step,
            now=np.flatnonzero(state.hit),
            observed_now=state.observed,
            hit=hit,
            observed=observed,
            sensors=[
                self._shown(name, each, rates.get(name, 0.0))
                for name, each in list(self._fusion.sensors.items())
            ],
            vehicles=None if followed is None else followed.now(),
            lately=self._fusion.quarters.lately(),
        )

    def lane_intervals(self) -> pd.DataFrame:
        """Return what was measured of each lane by quarter of an hour, and hits since then."""
        both = [self._fusion.quarters.intervals(), self._recent.lane_intervals()]
        table = pd.concat([each for each in both if len(each)] or both, ignore_index=True)
        return table.drop_duplicates(["lane", "begin"]).sort_values("begin", kind="stable")

    def metrics(self) -> str:
        """Return counts and alarms as text for Prometheus."""
        return self._fusion.metrics()

    def _rates(self) -> dict[str, float]:
        """Return frames a second of each sensor over the last seconds."""
        now = time.monotonic()
        counts = {name: each.health.counts["frames"] for name, each in self._fusion.sensors.items()}
        with self._lock:
            self._frames.append((now, counts))
            while now - self._frames[0][0] > RATE_S and len(self._frames) > 1:
                self._frames.popleft()
            since, before = self._frames[0]
        passed_s = max(now - since, 1e-3)
        return {name: (count - before.get(name, 0)) / passed_s for name, count in counts.items()}

    def _shown(self, name: str, sensor: SensorState, rate: float) -> ShownSensor:
        health = sensor.health
        alarms = dict(health.alarms)
        return ShownSensor(
            name=name,
            online="offline" not in alarms and bool(sensor.stream),
            alarms={kind: text for kind, text in alarms.items() if kind != "offline"},
            pose=sensor.pose,
            lag_s=health.lag_s,
            frames_per_s=rate,
            lost=health.counts["lost"],
        )


def read_token(path: Path) -> str:
    """Read the token that readers of a page must show.

    Raises
    ------
    InputError
        If the file cannot be read, or holds none.
    """
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("{}: cannot be read: {}", path, error) from error
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            "{}: holds no token", path, hint="a token is one word of visible ASCII characters"
        )
    return token


class Page:
    """The page of a site's live map, with the counts that it shows.

    Parameters
    ----------
    fusion : FusedMap
        The map of now, sensors, vehicles.
    site : LiveSite
        Of the site's file.
    table : PageTable
        Address of the page and access to it.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.

    Raises
    ------
    InputError
        If the map cannot be read, or the file with the token cannot or is empty.
    OutputError
        If the address is taken.
    """

    def __init__(
        self, fusion: FusedMap, site: LiveSite, table: PageTable, tiles: gpd.GeoDataFrame
    ) -> None:
        place = place_of(site, tiles)
        self._recent = RecentCounts(place.lane_of_tile, place.lane_numbers)
        token = "" if table.token_file is None else read_token(table.token_file)
        app = make_app(ShownMap(fusion, place, self._recent), token)
        self._server = WebServer(app, table.address, table.names)

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a closed step."""
        self._recent.take(step, hit, observed)

    def open(self) -> str:
        """Begin to serve; return the address."""
        return self._server.open()

    def close(self) -> None:
        """Serve no more."""
        self._server.close()

"""Show the map that fusion keeps: as the page takes it, on a thread of its own."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from threading import Lock, Thread
from typing import Protocol

import geopandas as gpd
import numpy as np
import pandas as pd
import uvicorn

from gis_radar.arrays import Booleans
from gis_radar.errors import InputError, OutputError
from gis_radar.live.intake import SensorState
from gis_radar.live.map_of_now import MapState
from gis_radar.live.page import Access, make_app
from gis_radar.live.recent import RecentCounts
from gis_radar.live.settings import LiveSite
from gis_radar.live.snapshot import Place, ShownSensor, Snapshot, place_of
from gis_radar.live.vehicles_now import LiveVehicles
from gis_radar.site.live_table import PageTable

START_S, END_S = 10.0, 2.0
RATE_S = 10.0  # over which frames are counted


class FusedMap(Protocol):
    """What is shown of fusion."""

    sensors: dict[str, SensorState]

    def state(self) -> MapState:
        """Return the map of now."""

    def metrics(self) -> str:
        """Return health as text for Prometheus."""

    @property
    def vehicles(self) -> LiveVehicles | None:
        """What follows vehicles."""


class ShownMap:
    """The map of fusion, as the page and its services take it.

    Parameters
    ----------
    fusion : FusedMap
        Which keeps the map.
    place : Place
        What stays.
    recent : RecentCounts
        Counts of the last minutes.
    """

    def __init__(self, fusion: FusedMap, place: Place, recent: RecentCounts) -> None:
        self._fusion, self._place, self._recent = fusion, place, recent
        self._frames: deque[tuple[float, dict[str, int]]] = deque()
        self._lock = Lock()

    @property
    def place(self) -> Place:
        """What stays."""
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
            lately=None if followed is None else followed.counts.lately(),
        )

    def lane_intervals(self) -> pd.DataFrame:
        """Return hit and observed seconds of each lane in intervals of 15 minutes."""
        table = self._recent.lane_intervals()
        followed = self._fusion.vehicles
        known = followed.counts.intervals() if followed is not None else pd.DataFrame()
        return table if known.empty else table.merge(known, on=["lane", "begin"], how="left")

    def metrics(self) -> str:
        """Return counts and lags as Prometheus reads them."""
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
            lost=health.lost,
        )


def access_of(table: PageTable) -> Access:
    """Return who may read, as a site's file states it.

    Raises
    ------
    InputError
        If the file with the token cannot be read, or is empty.
    UsageError
        If everybody could read.
    """
    host = table.address.rpartition(":")[0].strip("[]")
    token = _token(table.token_file) if table.token_file is not None else ""
    return Access(host=host, token=token, behind_proxy=table.behind_proxy, names=tuple(table.names))


def _token(path: Path) -> str:
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            f"{path}: holds no token", hint="a token is one word of visible ASCII characters"
        )
    return token


class Page:
    """The page of a site's live map, with the counts that it shows.

    Parameters
    ----------
    fusion : FusedMap
        Which keeps the map.
    site : LiveSite
        Of the site's file.
    table : PageTable
        Where the page is, and who may read.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.

    Raises
    ------
    InputError
        If map or token cannot be read.
    UsageError
        If everybody could read.
    """

    def __init__(
        self, fusion: FusedMap, site: LiveSite, table: PageTable, tiles: gpd.GeoDataFrame
    ) -> None:
        self._host, _, port = table.address.rpartition(":")
        self._table = table
        place = place_of(site, tiles)
        self._recent = RecentCounts(place.lane_of_tile, place.lane_numbers)
        self.shown = ShownMap(fusion, place, self._recent)
        config = uvicorn.Config(
            make_app(self.shown, access_of(table)), host=self._host.strip("[]"), port=int(port),
            log_level="critical", lifespan="on", timeout_graceful_shutdown=1,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = Thread(target=self._run, daemon=True, name="page")

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a closed step."""
        self._recent.take(step, hit, observed)

    def open(self) -> str:
        """Begin to serve; return the address.

        Raises
        ------
        OutputError
            If the address is taken.
        """
        self._thread.start()
        until = time.monotonic() + START_S
        while not self._server.started and self._thread.is_alive() and time.monotonic() < until:
            time.sleep(0.01)
        if not self._server.started:
            raise OutputError(
                f"{self._table.address}: the page cannot be served there",
                hint="another program may use the address",
            )
        port = self._server.servers[0].sockets[0].getsockname()[1]
        return f"http://{self._host}:{port}/"

    def _run(self) -> None:
        try:
            self._server.run()
        except SystemExit:  # the way in which uvicorn reports an address that is taken
            return

    def close(self) -> None:
        """Serve no more."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(END_S)

"""Show the map that fusion keeps, as the page takes it."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import STEP_S, InputError, step_begin
from gis_radar.live.intake import SensorState
from gis_radar.live.page import make_app
from gis_radar.live.recent import QUARTER
from gis_radar.live.settings import LiveSite
from gis_radar.live.snapshot import Place, ShownSensor, Snapshot, place_of
from gis_radar.live.web_server import WebServer
from gis_radar.site import PageTable

if TYPE_CHECKING:
    from gis_radar.live.fusion import Fusion

RATE_S = 10.0  # over which frames are counted


class ShownMap:
    """The map of fusion for the page and its services.

    Parameters
    ----------
    fusion : Fusion
        The map of now, sensors, vehicles.
    place : Place
        Tiles and lanes.
    """

    def __init__(self, fusion: Fusion, place: Place) -> None:
        self._fusion, self._place = fusion, place
        self._frames: deque[tuple[float, dict[str, int]]] = deque()
        self._lock = Lock()

    @property
    def place(self) -> Place:
        """Tiles and lanes."""
        return self._place

    def snapshot(self) -> Snapshot:
        """Return the map of now."""
        state = self._fusion.state()
        hit, observed = self._fusion.counts.last_minutes()
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
        tables = [self._fusion.quarters.intervals()]
        for number, counts in self._fusion.counts.quarters():
            hit_s, observed_s = (STEP_S * self._place.means_by_lane(each) for each in counts)
            tables.append(pd.DataFrame({
                "lane": self._place.lane_numbers, "hit_s": hit_s, "observed_s": observed_s,
                "begin": step_begin(number * QUARTER), "end": step_begin((number + 1) * QUARTER),
            }))  # fmt: skip
        table = pd.concat([each for each in tables if len(each)] or tables, ignore_index=True)
        columns = ["lane", "begin", "end", "hit_s", "observed_s"]
        table = table.reindex(columns=[*columns, *table.columns.difference(columns)])
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
            lag_s=health.lag_s if rate > 0.0 else float("nan"),  # else it is of long ago
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


def page_server(
    fusion: Fusion, site: LiveSite, table: PageTable, tiles: gpd.GeoDataFrame
) -> WebServer:
    """Return what serves the page of a site's live map once it is opened.

    Parameters
    ----------
    fusion : Fusion
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
    token = "" if table.token_file is None else read_token(table.token_file)
    app = make_app(ShownMap(fusion, place_of(site, tiles)), token)
    return WebServer(app, table.address, table.names)

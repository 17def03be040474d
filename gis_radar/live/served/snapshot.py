"""Live map for the page and its services: its constant part, and snapshots of one moment."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, Protocol
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from pyproj import CRS, Transformer

from gis_radar.base import (
    STEP_S,
    Booleans,
    Floats,
    InputError,
    Integers,
    quotient,
    step_begin,
    transformer,
    zone_of,
)
from gis_radar.dataset import stated_lanes
from gis_radar.hdmap import fingerprint, read_map
from gis_radar.live.hours.quarters import QuarterMeasures, Quarters
from gis_radar.live.hours.recent import QUARTER, RecentCounts
from gis_radar.live.intake import SensorState
from gis_radar.live.now.map_of_now import MapState
from gis_radar.live.now.now_filter import VehiclesNow
from gis_radar.live.now.vehicles_now import LiveVehicles
from gis_radar.live.wire.settings import LiveSite
from gis_radar.measures import LaneNetwork, lane_names
from gis_radar.poses import Pose
from gis_radar.products import BREAKS, lane_totals, lanes_with_tiles

NO_CLASS = -1  # in place of a class
DEGREES = 7  # digits after the point of a degree: a centimetre
_RINGS = 1_000  # most rings of views in the cache: poses of a following sensor change every 5 s
_RATE_S = 10.0  # time over which frames are counted
_GEOGRAPHIC = "OGC:CRS84"  # longitude, latitude: as web maps and OGC API - Features use


def geometries(shapes: Any) -> list[dict[str, Any] | None]:
    """Return shapes in longitude and latitude as GeoJSON geometries; None for missing ones."""
    rounded = shapely.set_precision(shapes, 10.0**-DEGREES, mode="pointwise")
    return [text and json.loads(text) for text in shapely.to_geojson(rounded)]


@dataclass(frozen=True, kw_only=True)
class Place:
    """Constant part of a live map: tiles, lanes, title and time zone of the site.

    Parameters
    ----------
    title : str
        Title of the site.
    zone : ZoneInfo
        Time zone of the site.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.
    lanes : GeoDataFrame
        As from :meth:`gis_radar.LaneletMap.lanes`, with the site's own names of lanes.
    """

    title: str
    zone: ZoneInfo
    tiles: gpd.GeoDataFrame
    lanes: gpd.GeoDataFrame

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of the tiles."""
        return fingerprint(self.tiles)

    def lane_names(self) -> list[str]:
        """Return the lanes' names as people use them, as `lane_numbers`, in the current language.

        Their own names are those of the site's file.
        """
        stops = dict(zip(self.lanes["lane"], self.lanes["stop_line_m"], strict=True))
        return lane_names(self.lanes, LaneNetwork.of(self.tiles, stops))

    @cached_property
    def lane_of_tile(self) -> Integers:
        """Position of each tile's lane in :attr:`lane_numbers`."""
        return lanes_with_tiles(self.tiles)[1]

    @cached_property
    def lane_numbers(self) -> list[int]:
        """Numbers of the lanes that have tiles, ascending."""
        return [lane.number for lane in lanes_with_tiles(self.tiles)[0]]

    def totals_by_lane(self, values: Integers) -> Floats:
        """Return the sum over each lane's tiles of a value by tile."""
        return lane_totals(values.astype(float), self.lane_of_tile, len(self.lane_numbers))

    def means_by_lane(self, values: Integers) -> Floats:
        """Return the mean over each lane's tiles of a value by tile."""
        return self.totals_by_lane(values) / self.totals_by_lane(np.ones_like(values))

    def in_degrees(self, layer: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
        """Return a layer of the site in longitude and latitude."""
        return layer.to_crs(_GEOGRAPHIC)

    def degrees_of(self, pose: Pose) -> tuple[float, float]:
        """Return longitude and latitude of a sensor."""
        east, north = self._to_degrees.transform(pose.easting, pose.northing)
        return float(east), float(north)

    def view_of(self, pose: Pose) -> list[list[float]]:
        """Return the outline of a sensor's view: a ring of longitudes and latitudes."""
        key = (pose.easting, pose.northing, pose.yaw, pose.pitch, pose.roll, pose.view)
        if key not in self._rings:
            if len(self._rings) >= _RINGS:
                self._rings.clear()
            ring = np.asarray(pose.outline().exterior.coords)[:, :2]
            east, north = self._to_degrees.transform(*ring.T)
            self._rings[key] = np.column_stack([east, north]).round(DEGREES).tolist()
        return self._rings[key]

    def ends_in_degrees(self, now: VehiclesNow) -> Floats:
        """Return (n, 4) longitude and latitude of the rear and of the front of vehicles."""
        yaw = np.radians(now.heading)
        half = 0.5 * now.length_m[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        ends = [
            self._to_degrees.transform(*each.T) for each in (now.place - half, now.place + half)
        ]
        return np.column_stack([*ends[0], *ends[1]]).round(DEGREES)

    @cached_property
    def _rings(self) -> dict[object, list[list[float]]]:
        """Cache of rings of views, as a view is shown many times."""
        return {}

    @cached_property
    def _to_degrees(self) -> Transformer:
        return transformer(self.tiles.crs, CRS.from_user_input(_GEOGRAPHIC))


@dataclass(frozen=True, kw_only=True)
class ShownSensor:
    """State of a sensor as it is shown.

    Parameters
    ----------
    name : str
        Its name in the site file.
    online : bool
        Whether it is linked to the broker; missing frames are an alarm.
    alarms : mapping
        Details of its alarms, by kind of :data:`gis_radar.live.health.ALARMS`.
    pose : Pose, optional
        Its pose, once that is known.
    lag_s : float
        From a frame's time to its arrival, seconds, the median of the last frames; NaN without.
    frames_per_s : float
        Frames that arrived in the last 10 s.
    lost : int
        Messages that the sensor lost since its start, as its buffer was full.
    """

    name: str
    online: bool
    alarms: Mapping[str, str] = field(default_factory=dict)
    pose: Pose | None = None
    lag_s: float = float("nan")
    frames_per_s: float = 0.0
    lost: int = 0


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The map at one moment.

    Parameters
    ----------
    step : int
        The last closed step.
    now : (k,) int64 array
        Positions of the tiles that are hit in it, ascending.
    observed_now : (n,) bool array
        Which tiles are observed in it.
    hit, observed : (n,) int64 arrays
        Steps of the last 15 minutes in which each tile was hit and observed.
    sensors : sequence of ShownSensor
        All sensors of the site file.
    vehicles : VehiclesNow, optional
        Vehicles of this moment, where they are followed.
    quarter : QuarterMeasures, optional
        The newest measured quarter of an hour with vehicles, once there is one.
    """

    step: int
    now: Integers
    observed_now: Booleans
    hit: Integers
    observed: Integers
    sensors: Sequence[ShownSensor] = field(default=())
    vehicles: VehiclesNow | None = None
    quarter: QuarterMeasures | None = None

    def hit_share(self) -> Floats:
        """Return the hit share of each tile over the last 15 minutes, NaN where not observed."""
        return quotient(self.hit, self.observed)

    def classes(self) -> Integers:
        """Return each tile's class of hit share: 0 never hit, then as the legend, -1 unobserved."""
        return classes_of(self.hit_share())

    def occupancy_classes(self) -> Integers:
        """Return each tile's class of occupancy, as `classes` does; -1 where it was not visible."""
        if self.quarter is None:
            return np.full(len(self.observed), NO_CLASS)
        return classes_of(self.quarter.occupancy())

    def by_lane(self, place: Place) -> Floats:
        """Return the hit share of each lane over the last 15 minutes, NaN where not observed."""
        observed = place.totals_by_lane(self.observed)
        return quotient(place.totals_by_lane(self.hit), observed)


def classes_of(share: Floats) -> Integers:
    """Return the class of each share: 0 for none, then as in the legend; -1 where not known."""
    found = np.searchsorted(BREAKS[:-1], np.nan_to_num(share), side="left")
    return np.where(np.isnan(share), NO_CLASS, found).astype(np.int64)


class FusedMap(Protocol):
    """The part of fusion that is shown."""

    sensors: dict[str, SensorState]
    quarters: Quarters
    counts: RecentCounts
    vehicles: LiveVehicles | None

    def state(self) -> MapState:
        """Return the map of now."""

    def metrics(self) -> str:
        """Return counts and alarms as text for Prometheus."""


class ShownMap:
    """The map of fusion for the page and its services.

    Parameters
    ----------
    fusion : FusedMap
        The map of now, sensors, vehicles.
    place : Place
        Tiles and lanes.
    """

    def __init__(self, fusion: FusedMap, place: Place) -> None:
        self._fusion, self.place = fusion, place
        self._frames: deque[tuple[float, dict[str, int]]] = deque()
        self._lock = Lock()

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
            quarter=self._fusion.quarters.newest(),
        )

    def lane_intervals(self) -> pd.DataFrame:
        """Return the measures of each lane by quarter of an hour, and hits since the last one."""
        tables = [self._fusion.quarters.intervals()]
        for number, counts in self._fusion.counts.quarters():
            hit_s, observed_s = (STEP_S * self.place.means_by_lane(each) for each in counts)
            tables.append(pd.DataFrame({
                "lane": self.place.lane_numbers, "hit_s": hit_s, "observed_s": observed_s,
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
        """Return the frames a second of each sensor over the last `_RATE_S`."""
        now = time.monotonic()
        counts = {name: each.health.counts["frames"] for name, each in self._fusion.sensors.items()}
        with self._lock:
            self._frames.append((now, counts))
            while now - self._frames[0][0] > _RATE_S and len(self._frames) > 1:
                self._frames.popleft()
            since, before = self._frames[0]
        passed_s = max(now - since, 1e-3)
        return {name: (count - before.get(name, 0)) / passed_s for name, count in counts.items()}

    def _shown(self, name: str, sensor: SensorState, rate: float) -> ShownSensor:
        """Return the state of a sensor as it is shown."""
        health = sensor.health
        alarms = dict(health.alarms)
        return ShownSensor(
            name=name,
            online="offline" not in alarms and bool(sensor.stream),
            alarms={kind: text for kind, text in alarms.items() if kind != "offline"},
            pose=sensor.pose,
            lag_s=float("nan") if "silent" in alarms else health.lag_s,  # it is of long ago then
            frames_per_s=rate,
            lost=health.counts["lost"],
        )


def lanes_of_map(site: LiveSite, tiles: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the lanes of a site's map, with the streets that its file names."""
    roads = read_map(site.map.file, crs=tiles.crs, origin=site.map.origin)
    return roads.lanes(streets=site.map.streets, street_field=site.map.street_field)


def place_of(site: LiveSite, tiles: gpd.GeoDataFrame) -> Place:
    """Return the constant part of a site's live map.

    Raises
    ------
    InputError
        If the map cannot be read, is not that of the tiles, or has no lane that the site's file
        names.
    """
    layer = lanes_of_map(site, tiles)
    place = Place(
        title=site.title, zone=zone_of(site.timezone), tiles=tiles,
        lanes=stated_lanes(layer, **site.of_lanes, source=site.path),
    )  # fmt: skip
    if missing := set(place.lane_numbers) - set(layer["lane"].tolist()):
        raise InputError(
            "{}: has no lane {}, which {} has", site.map.file, min(missing), site.live.tiles,
            hint="make the tiles again from this map",
        )  # fmt: skip
    return place

"""Datasets of drawn days, without recordings: usual traffic on straight lanes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow as pa
import shapely

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, Floats, Integers
from gis_radar.dataset import (
    FRAMES,
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    HourRecord,
    HourWriter,
    Manifest,
    Origin,
    RollUps,
    TableSchema,
    create_dataset,
    hour_text,
    part_path,
    read_hours,
    replacing,
    write_record,
    write_single_file,
)
from gis_radar.dataset.days.lane_measures import LANES_METHOD
from gis_radar.dataset.files.parts import PartDigest, common_metadata, write_part
from gis_radar.dataset.files.tables import HOUR_TABLES, LANE_MEASURES, SIGHTS, TURNS
from gis_radar.hdmap import fingerprint

FIRST_HOUR = 490_896  # since 1970: begin of 2026, UTC
HOURS, QUARTERS = 24, 96  # of a day
MOST_MISSING = 3000  # steps without a frame in a quarter
TILES_A_LANE, LENGTH_M, LANES_A_STREET = 200, 0.5, 4
LANE_M, SPEED_CLASSES = TILES_A_LANE * LENGTH_M, 40
DRAWN_METHOD, DRAWN = 1, "drawn"  # `method` and `inputs` of the hours
# Parts of an hour whose exact tables are dropped.
GONE = {table.name: PartDigest(rows=1, size=1, sha256="0" * 64) for table in HOUR_TABLES}


def write_days(
    folder: Path, *, tiles: int, days: int, in_sight: float = 0.8, busy: bool = False,
    counts: bool = True, dropped: bool = False,
) -> gr.Dataset:  # fmt: skip
    """Write a dataset of some days from 1 January 2026 on.

    Parameters
    ----------
    folder : Path
        The dataset.
    tiles, days : int
        Their numbers.
    in_sight : float
        Share of the lanes that are in sight.
    busy : bool
        Whether every tile is in sight, occupied in every quarter, and hidden for a while; else
        traffic follows the time of day.
    counts : bool
        Whether tile counts are drawn beside the lane measures.
    dropped : bool
        Whether the exact tables are dropped, as after `keep`; else they hold frames alone.
    """
    rng, rng_of_lanes = np.random.default_rng(1), np.random.default_rng(2)
    table = tiles_of_lanes(tiles, rng)
    lane = np.arange(tiles) // TILES_A_LANE
    looked_at = np.ones(lane[-1] + 1, np.bool_) if busy else rng.random(lane[-1] + 1) < in_sight
    seen = np.flatnonzero(looked_at[lane])
    west, south = np.floor(table.total_bounds[:2]).astype(int).tolist()
    manifest = Manifest(
        map="0" * 64, fingerprint=fingerprint(table), crs="EPSG:25832", origin=(west, south),
        timezone="Europe/Berlin", settings={"vehicles": True},
    )  # fmt: skip
    lanes = _lanes_of(table)
    create_dataset(folder, manifest, table, lanes=lanes)
    sights = {"pose": np.full(len(seen), "a"), "tile_id": seen}
    write_single_file(SIGHTS, folder, sights, manifest.fingerprint)
    origin = Origin(fingerprint=manifest.fingerprint, method=DRAWN_METHOD, inputs=DRAWN)
    for hour in range(FIRST_HOUR, FIRST_HOUR + HOURS * days):
        if dropped:
            write_record(folder, HourRecord(hour=hour, origin=origin, parts=GONE, dropped=(*GONE,)))
        else:
            _write_hour(folder, hour, origin)
    for day in range(FIRST_HOUR, FIRST_HOUR + HOURS * days, HOURS):
        rows = _measures(lanes["lane"].to_numpy(), rng_of_lanes)
        drawn = _counts(seen, lane[seen], rng, busy=busy) if counts else TILE_COUNTS.empty()
        for part, made in ((LANE_MEASURES, rows), (TURNS, TURNS.empty()), (TILE_COUNTS, drawn)):
            _write(folder, part, day, manifest.fingerprint, made)
    return gr.open_dataset(folder)


def _write_hour(folder: Path, hour: int, origin: Origin) -> None:
    """Write an hour of a sensor that delivers a frame a second, each valid up to the next."""
    first = hour * STEPS_PER_HOUR + np.arange(0, STEPS_PER_HOUR, 20)
    frames = dict.fromkeys(FRAMES.names, np.ones(len(first), np.int64)) | {
        "sensor": np.full(len(first), "R1"), "pose": np.full(len(first), "a"),
        "pose_in_force": np.full(len(first), "a"),
        "time_us": first * 50_000, "first_step": first, "last_step": first + 19,
    }  # fmt: skip
    with HourWriter(folder=folder, hour=hour, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, frames if table is FRAMES else table.empty())


def roll_up(dataset: gr.Dataset) -> None:
    """Write the roll-ups of a dataset."""
    manifest, records = dataset.manifest, read_hours(dataset.folder)
    RollUps(
        folder=dataset.folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone
    ).update(records, records)


def _write(
    folder: Path, table: TableSchema, day: int, known: str, rows: pa.Table | Mapping[str, Any]
) -> None:
    """Write a table of a date, with the key of each hour in its metadata, as `measure` does."""
    own: list[str | int] = [DRAWN_METHOD, DRAWN]
    keys = dict.fromkeys(range(day, day + HOURS), own)
    if table is not TILE_COUNTS:  # lane measures depend on the hour before, too
        keys = {
            hour: [LANES_METHOD, *own, *(own if hour > FIRST_HOUR else [0, ""])] for hour in keys
        }
    metadata = common_metadata(table, known) | {"hour": hour_text(day), "hours": json.dumps(keys)}
    path = part_path(folder, table, day)
    with replacing(path) as fresh:
        write_part(table, fresh, rows, metadata)


def _lanes_of(tiles: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the layer of lanes, `LANES_A_STREET` of them to a street."""
    groups = tiles.groupby("lane")
    ends = [(of.geometry.iloc[0].centroid, of.geometry.iloc[-1].centroid) for _, of in groups]
    lane = list(groups.groups)
    columns = {
        "lane": lane, "lanelets": [[each] for each in lane], "subtype": "road",
        "street": [f"Street {k // LANES_A_STREET}" for k in range(len(lane))],
        "street_part": None, "turn": None, "stop_line_m": np.nan, "speed_limit_kmh": 50.0,
        "length_m": LANE_M,
    }  # fmt: skip
    return gpd.GeoDataFrame(columns, geometry=[shapely.LineString(e) for e in ends], crs=tiles.crs)


def _measures(lanes: Integers, rng: np.random.Generator) -> pa.Table:
    """Draw the lane measures of a day."""
    rate = np.outer(rng.gamma(3.0, 30.0, len(lanes)), _by_quarter()).ravel()
    size = len(rate)
    counted = rng.poisson(rate)
    share = 1.0 - 0.3 * rng.random(size) * (rng.random(size) < 0.3)
    speed = rng.normal(11.0, 1.5, size).clip(2.0)
    group = np.minimum(speed * 3.6 / 5.0, SPEED_CLASSES - 1).astype(np.int64)
    speeds = np.zeros((size, SPEED_CLASSES), np.int32)
    for off, part in ((-1, 0.25), (0, 0.5), (1, 0.25)):
        place = (group + off).clip(0, SPEED_CLASSES - 1)
        np.add.at(speeds, (np.arange(size), place), rng.binomial(counted, part).astype(np.int32))
    flow = 4.0 * counted / share
    columns = {
        "lane": np.repeat(lanes, QUARTERS), "interval": np.tile(np.arange(QUARTERS), len(lanes)),
        "visible_share": share, "counted": counted, "volume": counted / share,
        "volume_se": np.sqrt(counted * 0.1 + 0.5), "heavy": 0.08 * counted, "speed_mean": speed,
        "speed_time_mean": 1.05 * speed, "speed_counts": pa.array(list(speeds)),
        "occupancy": (counted * 5.0 / speed / 900.0).clip(0.0, 1.0),
        "occupancy_se": 0.003 * rng.random(size), "density": flow / speed / 3.6, "flow": flow,
        "travel_time_s": LANE_M / speed, "delay_s": (LANE_M / speed - 7.2).clip(0.0),
        "queue_max_m": 60.0 * rng.random(size), "queue_mean_m": 20.0 * rng.random(size),
        "stops": counted // 4, "visible_km_h": share * LANE_M / 1000.0 / 4.0,
    }  # fmt: skip
    return LANE_MEASURES.to_arrow(columns)


def _counts(seen: Integers, lane: Integers, rng: np.random.Generator, *, busy: bool) -> pa.Table:
    """Draw the tile counts of a day."""
    shape = (len(seen), QUARTERS)
    observed = np.broadcast_to(
        STEPS_PER_QUARTER - rng.integers(0, MOST_MISSING, (1, QUARTERS)), shape
    )
    if busy:
        hidden, occupied = rng.integers(129, 3000, shape), rng.uniform(0.02, 0.9, shape)
    else:
        hidden = (rng.random(shape) < 0.3) * rng.integers(0, 2000, shape)
        rate = rng.gamma(0.7, 0.15, lane.max() + 1)[lane][:, None] * _by_quarter()
        vehicles = rng.poisson(120.0 * rate)  # a quarter hour
        occupied = np.minimum(vehicles * rng.uniform(6, 40, shape) / STEPS_PER_QUARTER, 0.95)
    visible = observed - hidden
    steps = (visible * occupied).astype(np.int64)
    columns = {
        "tile_id": np.repeat(seen, QUARTERS),
        "interval": np.tile(np.arange(QUARTERS), len(seen)),
        "hit_steps": (steps * rng.uniform(0.1, 0.4, shape)).astype(np.int64),
        "observed_steps": observed, "occupied_steps": steps, "visible_steps": visible,
        "hidden_steps": hidden, "occupied_variance": 6.0 * steps, "inferred_steps": hidden // 4,
    }  # fmt: skip
    return TILE_COUNTS.to_arrow({name: np.ravel(values) for name, values in columns.items()})


def _by_quarter() -> Floats:
    """Return the traffic of each quarter of a day as a share of the busiest."""
    hour = 24.0 * np.arange(QUARTERS) / QUARTERS
    return np.asarray(np.clip(np.sin((hour - 4.0) / 20.0 * np.pi), 0.02, 1.0) ** 1.5)


def tiles_of_lanes(tiles: int, rng: np.random.Generator) -> gpd.GeoDataFrame:
    """Return straight lanes in all directions, cut into tiles."""
    number = np.arange(tiles)
    lane, index = number // TILES_A_LANE, number % TILES_A_LANE
    lanes = int(lane[-1]) + 1
    east, north = rng.uniform(-500.0, 500.0, (2, lanes)) + np.array([[691_000.0], [5_336_000.0]])
    way = rng.uniform(0.0, 2.0 * np.pi, lanes)
    along, across = LENGTH_M * (index[:, None] + [0, 0, 1, 1]), np.array([1.6, -1.6, -1.6, 1.6])
    cos, sin = np.cos(way)[lane, None], np.sin(way)[lane, None]
    corners = np.stack(
        [
            east[lane, None] + along * cos - across * sin,
            north[lane, None] + along * sin + across * cos,
        ],
        axis=-1,
    )
    ids = np.sort(rng.integers(1, 2**62, lanes))[lane]
    columns = {
        "tile_id": number, "lanelet_id": ids, "index": index, "s_m": LENGTH_M * index,
        "length_m": LENGTH_M, "width_m": 3.2 + 0.01 * rng.random(tiles),
        "height_m": 370.0 + rng.random(tiles), "subtype": "road", "lane": ids,
    }  # fmt: skip
    return gpd.GeoDataFrame(columns, geometry=shapely.polygons(corners), crs="EPSG:25832")

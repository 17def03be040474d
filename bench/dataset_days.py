"""Days of a dataset that nothing was recorded for: traffic as usual on lanes in all directions."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, Integers
from gis_radar.dataset import (
    FRAMES,
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    HourWriter,
    Manifest,
    Origin,
    create_dataset,
    hour_text,
    part_path,
    write_whole,
)
from gis_radar.dataset.files.parts import rename_whole, whole_metadata, write_part
from gis_radar.dataset.files.tables import HOUR_TABLES, SIGHTS
from gis_radar.hdmap import fingerprint

FIRST_HOUR = 489_696 // 24 * 24  # of a day in November 2025
HOURS, QUARTERS = 24, 96
MOST_MISSING = 3000  # steps without a frame in a quarter
TILES_A_LANE, LENGTH_M = 200, 0.5


def write_days(folder: Path, *, tiles: int, days: int, busy: bool = False) -> gr.Dataset:
    """Write a dataset of some days, with counts and frames alone.

    Parameters
    ----------
    folder : Path
        The dataset.
    tiles : int
        Of which a fifth is out of sight, where it is not busy.
    days : int
        How many.
    busy : bool
        Every tile occupied in every quarter, and hidden for a while; else few vehicles at night.
    """
    rng = np.random.default_rng(1)
    table = tiles_of_lanes(tiles, rng)
    lane = np.arange(tiles) // TILES_A_LANE
    in_sight = np.ones(lane[-1] + 1, np.bool_) if busy else rng.random(lane[-1] + 1) < 0.8
    seen = np.flatnonzero(in_sight[lane])
    west, south = np.floor(table.total_bounds[:2]).astype(int).tolist()
    manifest = Manifest(
        map="0" * 64, fingerprint=fingerprint(table), crs="EPSG:25832", origin=(west, south),
        timezone="Europe/Berlin", settings={"vehicles": True},
    )  # fmt: skip
    create_dataset(folder, manifest, table)
    write_whole(
        SIGHTS, folder, {"pose": np.full(len(seen), "a"), "tile_id": seen}, manifest.fingerprint
    )
    origin = Origin(fingerprint=manifest.fingerprint, method=1, inputs="made")
    for hour in range(FIRST_HOUR, FIRST_HOUR + HOURS * days):
        _write_hour(folder, hour, origin)
    for day in range(FIRST_HOUR, FIRST_HOUR + HOURS * days, HOURS):
        counts = _counts(seen, lane[seen], rng, busy=busy)
        metadata = whole_metadata(TILE_COUNTS, manifest.fingerprint) | {
            "hour": hour_text(day),
            "hours": json.dumps({day + k: [origin.method, origin.inputs] for k in range(HOURS)}),
        }
        path = part_path(folder, TILE_COUNTS, day)
        write_part(TILE_COUNTS, path, TILE_COUNTS.to_arrow(counts), metadata)
        rename_whole(path)
    return gr.open_dataset(folder)


def _write_hour(folder: Path, hour: int, origin: Origin) -> None:
    """Write the hour of a sensor that delivers a frame a second, each valid for long."""
    first = hour * STEPS_PER_HOUR + np.arange(0, STEPS_PER_HOUR, 20)
    frames = dict.fromkeys(FRAMES.names, np.ones(len(first), np.int64)) | {
        "sensor": np.full(len(first), "R1"), "pose": np.full(len(first), "a"),
        "pose_in_force": np.full(len(first), "a"),
        "time_us": first * 50_000, "first_step": first, "last_step": first + 19,
    }  # fmt: skip
    with HourWriter(folder=folder, hour=hour, origin=origin) as writer:
        for table in HOUR_TABLES:
            writer.write(table, frames if table is FRAMES else table.empty())


def _counts(
    seen: Integers, lane: Integers, rng: np.random.Generator, *, busy: bool
) -> dict[str, np.ndarray]:
    """Return the rows of a day, by tile and quarter."""
    shape = (len(seen), QUARTERS)
    observed = np.broadcast_to(
        STEPS_PER_QUARTER - rng.integers(0, MOST_MISSING, (1, QUARTERS)), shape
    )
    if busy:
        hidden, occupied = rng.integers(129, 3000, shape), rng.uniform(0.02, 0.9, shape)
    else:
        hidden = (rng.random(shape) < 0.3) * rng.integers(0, 2000, shape)
        rate = rng.gamma(0.7, 0.15, lane.max() + 1)[lane][:, None] * _by_hour(QUARTERS)
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
    return {name: np.ravel(values) for name, values in columns.items()}


def _by_hour(intervals: int) -> np.ndarray:
    """Return traffic over a day, 1 at most: little at night."""
    hour = 24.0 * np.arange(intervals) / intervals
    return np.clip(np.sin((hour - 4.0) / 20.0 * np.pi), 0.02, 1.0) ** 1.5


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

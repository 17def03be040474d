"""Months of a dataset that nothing was recorded for: lane measures and counts, no exact tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow as pa
import shapely
from dataset_days import tiles_of_lanes

import gis_radar as gr
from gis_radar.dataset import (
    TILE_COUNTS,
    HourRecord,
    Manifest,
    Origin,
    RollUps,
    TableSchema,
    create_dataset,
    hour_text,
    part_path,
    read_hours,
    write_record,
    write_whole,
)
from gis_radar.dataset.days.lane_measures import METHOD
from gis_radar.dataset.files.parts import PartDigest, rename_whole, whole_metadata, write_part
from gis_radar.dataset.files.tables import HOUR_TABLES, LANE_MEASURES, SIGHTS, TURNS
from gis_radar.hdmap import fingerprint

HOURS, QUARTERS, CLASSES = 24, 96, 40
FIRST_HOUR = 490_896  # of the first of January 2026, UTC
LANES_A_STREET, LENGTH_M = 4, 100.0
DRAWN_METHOD, DRAWN = 1, "drawn"
GONE = tuple(table.name for table in HOUR_TABLES)


def write_months(folder: Path, *, tiles: int, days: int, counts: bool) -> gr.Dataset:
    """Write a dataset of some days from January on, whose exact tables were dropped.

    Parameters
    ----------
    folder : Path
        The dataset.
    tiles, days : int
        How many.
    counts : bool
        Whether tile counts are drawn beside the lane measures.
    """
    rng = np.random.default_rng(1)
    table = tiles_of_lanes(tiles, rng)
    lanes = _lanes_of(table)
    manifest = Manifest(
        map="0" * 64, fingerprint=fingerprint(table), crs="EPSG:25832",
        origin=(691_000, 5_336_000), timezone="Europe/Berlin", settings={"vehicles": True},
    )  # fmt: skip
    create_dataset(folder, manifest, table, lanes=lanes)
    seen = {"pose": np.full(tiles, "a"), "tile_id": np.arange(tiles)}
    write_whole(SIGHTS, folder, seen, manifest.fingerprint)
    origin = Origin(fingerprint=manifest.fingerprint, method=DRAWN_METHOD, inputs=DRAWN)
    parts = {name: PartDigest(rows=1, size=1, sha256="0" * 64) for name in GONE}
    number = lanes["lane"].to_numpy()
    for hour in range(FIRST_HOUR, FIRST_HOUR + HOURS * days):
        write_record(folder, HourRecord(hour=hour, origin=origin, parts=parts, dropped=GONE))
    for day in range(FIRST_HOUR, FIRST_HOUR + HOURS * days, HOURS):
        _write(folder, LANE_MEASURES, day, manifest, _measures(number, rng), _key_of_lanes)
        _write(folder, TURNS, day, manifest, TURNS.empty(), _key_of_lanes)
        drawn = _counts(tiles, rng) if counts else TILE_COUNTS.empty()
        _write(folder, TILE_COUNTS, day, manifest, drawn, _key_of_counts)
    return gr.open_dataset(folder)


def roll_up(dataset: gr.Dataset) -> None:
    """Write the roll-ups of a dataset."""
    manifest, records = dataset.manifest, read_hours(dataset.folder)
    RollUps(
        folder=dataset.folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone
    ).update(records, records)


def _write(
    folder: Path, table: TableSchema, day: int, manifest: Manifest, rows: pa.Table,
    key: Callable[[int], list[str | int]],
) -> None:  # fmt: skip
    """Write a table of a date with the keys of its hours, as those that measure write it."""
    keys = {day + k: key(day + k) for k in range(HOURS)}
    metadata = whole_metadata(table, manifest.fingerprint) | {
        "hour": hour_text(day), "hours": json.dumps(keys),
    }  # fmt: skip
    path = part_path(folder, table, day)
    write_part(table, path, rows, metadata)
    rename_whole(path)


def _key_of_counts(_: int) -> list[str | int]:
    return [DRAWN_METHOD, DRAWN]


def _key_of_lanes(hour: int) -> list[str | int]:
    before: list[str | int] = [0, ""] if hour == FIRST_HOUR else [DRAWN_METHOD, DRAWN]
    return [METHOD, DRAWN_METHOD, DRAWN, *before]


def _lanes_of(tiles: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the layer of lanes, of which some are a street."""
    groups = tiles.groupby("lane")
    ends = [(of.geometry.iloc[0].centroid, of.geometry.iloc[-1].centroid) for _, of in groups]
    lane = list(groups.groups)
    columns = {
        "lane": lane, "lanelets": [[each] for each in lane], "subtype": "road",
        "street": [f"Street {k // LANES_A_STREET}" for k in range(len(lane))],
        "street_part": None, "turn": None, "stop_line_m": np.nan, "speed_limit_kmh": 50.0,
        "length_m": LENGTH_M,
    }  # fmt: skip
    return gpd.GeoDataFrame(columns, geometry=[shapely.LineString(e) for e in ends], crs=tiles.crs)


def _by_quarter() -> np.ndarray:
    hour = np.arange(QUARTERS) / 4
    return np.clip(np.sin((hour - 4.0) / 20.0 * np.pi), 0.02, 1.0) ** 1.5


def _measures(lanes: np.ndarray, rng: np.random.Generator) -> pa.Table:
    """Return the lane measures of a day."""
    rate = np.outer(rng.gamma(3.0, 30.0, len(lanes)), _by_quarter()).ravel()
    size = len(rate)
    counted = rng.poisson(rate)
    share = 1.0 - 0.3 * rng.random(size) * (rng.random(size) < 0.3)
    speed = rng.normal(11.0, 1.5, size).clip(2.0)
    group = np.minimum(speed * 3.6 / 5.0, CLASSES - 1).astype(np.int64)
    speeds = np.zeros((size, CLASSES), np.int32)
    for off, part in ((-1, 0.25), (0, 0.5), (1, 0.25)):
        place = (group + off).clip(0, CLASSES - 1)
        np.add.at(speeds, (np.arange(size), place), rng.binomial(counted, part).astype(np.int32))
    flow = 4.0 * counted / share
    columns = {
        "lane": np.repeat(lanes, QUARTERS), "interval": np.tile(np.arange(QUARTERS), len(lanes)),
        "visible_share": share, "counted": counted, "volume": counted / share,
        "volume_se": np.sqrt(counted * 0.1 + 0.5), "heavy": 0.08 * counted, "speed_mean": speed,
        "speed_time_mean": 1.05 * speed, "speed_counts": pa.array(list(speeds)),
        "occupancy": (counted * 5.0 / speed / 900.0).clip(0.0, 1.0),
        "occupancy_se": 0.003 * rng.random(size), "density": flow / speed / 3.6, "flow": flow,
        "travel_time_s": LENGTH_M / speed, "delay_s": (LENGTH_M / speed - 7.2).clip(0.0),
        "queue_max_m": 60.0 * rng.random(size), "queue_mean_m": 20.0 * rng.random(size),
        "stops": counted // 4, "visible_km_h": share * LENGTH_M / 1000.0 / 4.0,
    }  # fmt: skip
    return LANE_MEASURES.to_arrow(columns)


def _counts(tiles: int, rng: np.random.Generator) -> pa.Table:
    """Return the tile counts of a day."""
    shape = (tiles, QUARTERS)
    observed = np.broadcast_to(18_000 - rng.integers(0, 3000, (1, QUARTERS)), shape)
    hidden = (rng.random(shape) < 0.3) * rng.integers(0, 2000, shape)
    visible = observed - hidden
    share = rng.gamma(2.0, 0.04, (tiles, 1)) * _by_quarter() * rng.uniform(0.5, 1.5, shape)
    steps = (visible * share.clip(0.0, 0.95)).astype(np.int64)
    columns = {
        "tile_id": np.repeat(np.arange(tiles), QUARTERS),
        "interval": np.tile(np.arange(QUARTERS), tiles), "hit_steps": steps // 4,
        "observed_steps": observed, "occupied_steps": steps, "visible_steps": visible,
        "hidden_steps": hidden, "occupied_variance": 6.0 * steps, "inferred_steps": hidden // 4,
    }  # fmt: skip
    return TILE_COUNTS.to_arrow({name: np.ravel(values) for name, values in columns.items()})

"""Datasets of months whose day tables are drawn: a street of three lanes."""

from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pyarrow as pa
from datasets import write_dataset
from maps import EAST, NORTH, UTM
from shapely import LineString, Polygon

from gis_radar.dataset import (
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    LaneTraffic,
    RollUps,
    TileCounts,
    read_hours,
)
from gis_radar.dataset.files.parts import days_of
from gis_radar.dataset.files.tables import LANE_MEASURES, TURNS

LENGTH_M, WIDTH_M, TILES_A_LANE = 10.0, 3.0, 20


def street_tiles(at=(EAST, NORTH), crs=UTM):
    """Make the tiles of three lanes: two eastbound ones, and one westbound."""
    rows = []
    for lane, north, way in ((11, 0.0, 1), (12, 3.0, 1), (13, 6.0, -1)):
        for k in range(TILES_A_LANE):
            low, high = 0.5 * k, 0.5 * (k + 1)
            if way < 0:
                low, high = LENGTH_M - low, LENGTH_M - high
            left, right = north + (way + 1) / 2 * WIDTH_M, north + (1 - way) / 2 * WIDTH_M
            corners = [(low, right), (high, right), (high, left), (low, left)]
            rows.append(
                {
                    "tile_id": len(rows), "lanelet_id": lane, "index": k, "s_m": 0.5 * k,
                    "length_m": 0.5, "width_m": WIDTH_M, "height_m": 0.0, "subtype": "road",
                    "lane": lane, "geometry": Polygon([(at[0] + x, at[1] + y) for x, y in corners]),
                }
            )  # fmt: skip
    return gpd.GeoDataFrame(rows, crs=crs)


def street_lanes(at=(EAST, NORTH), crs=UTM, street="Ring"):
    """Make the layer of these lanes."""
    ways = [((0.0, y), (LENGTH_M, y)) for y in (1.5, 4.5)] + [((LENGTH_M, 7.5), (0.0, 7.5))]
    lines = [LineString([(at[0] + x, at[1] + y) for x, y in way]) for way in ways]
    return gpd.GeoDataFrame(
        {
            "lane": [11, 12, 13], "lanelets": [[11], [12], [13]], "subtype": ["road"] * 3,
            "street": [street] * 3, "street_part": [None] * 3, "turn": ["straight"] * 3,
            "stop_line_m": [np.nan] * 3, "speed_limit_kmh": [50.0] * 3, "length_m": [LENGTH_M] * 3,
        },
        geometry=lines, crs=crs,
    )  # fmt: skip


def drawn_months(folder, hours, *, seed=0, timezone="Europe/Berlin", at=(EAST, NORTH), crs=UTM,
    street="Ring",
):  # fmt: skip
    """Write a dataset of some hours, whose counts and lane measures are drawn."""
    dataset = write_dataset(
        folder, tiles=street_tiles(at, crs), lanes=street_lanes(at, crs, street), hours=hours,
        timezone=timezone, sights={"pose": ["a"] * 60, "tile_id": np.arange(60)},
    )  # fmt: skip
    draw_days(dataset, seed)
    return dataset


def draw_days(dataset, seed=0):
    """Draw the day tables of the hours of a dataset, each from its number and a seed."""
    of = {"folder": dataset.folder, "fingerprint": dataset.manifest.fingerprint, "seed": seed}
    for day in days_of(read_hours(dataset.folder)):
        for maker in (_DrawnCounts(**of), _DrawnLanes(**of)):
            for table in maker.tables:
                maker.file(table, day).path.unlink(missing_ok=True)
            maker.update(day)


@dataclass(frozen=True, kw_only=True, eq=False)
class _DrawnCounts(TileCounts):
    seed: int

    def make(self, record):
        return (_counts(record.hour, self.seed),)


@dataclass(frozen=True, kw_only=True, eq=False)
class _DrawnLanes(LaneTraffic):
    seed: int

    def make(self, record):
        return _lanes(record.hour, self.seed), TURNS.empty()


def roll_up(dataset):
    """Bring the roll-ups of a dataset up to date, as those do who write it."""
    manifest, records = dataset.manifest, read_hours(dataset.folder)
    rolled = RollUps(
        folder=dataset.folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone
    )
    rolled.update(records, records)
    return rolled


def _counts(hour, seed):
    rng = np.random.default_rng([hour, seed])
    tile, quarter = (each.ravel() for each in np.mgrid[0:60, 0:4])
    observed = rng.integers(1, STEPS_PER_QUARTER, 240)
    visible = rng.integers(0, observed + 1)
    occupied = rng.integers(0, visible + 1)
    columns = {
        "tile_id": tile, "interval": hour % 24 * 4 + quarter, "hit_steps": occupied // 2,
        "observed_steps": observed, "occupied_steps": occupied, "visible_steps": visible,
        "hidden_steps": observed - visible, "occupied_variance": occupied * 0.3,
        "inferred_steps": visible // 3,
    }  # fmt: skip
    kept = rng.random(240) < 0.9
    return TILE_COUNTS.to_arrow({name: each[kept] for name, each in columns.items()})


def _lanes(hour, seed):
    rng = np.random.default_rng([hour, seed, 1])
    lane, quarter = (each.ravel() for each in np.mgrid[11:14, 0:4])
    share = rng.choice([0.0, 0.1, 0.7, 1.0], 12)
    known, visible = share >= 0.2, share > 0.0
    area = share * LENGTH_M / 1000.0 * 0.25
    counted = rng.integers(0, 200, 12)
    density = rng.uniform(0.0, 60.0, 12)
    classes = [
        row if each else None
        for row, each in zip(rng.integers(0, 9, (12, 40)), visible, strict=True)
    ]

    def where(mask, values):
        return np.where(mask, values, np.nan)

    columns = {
        "lane": lane, "interval": hour % 24 * 4 + quarter, "visible_share": share,
        "counted": np.ma.masked_array(counted, ~visible),
        "volume": where(known, counted / np.maximum(share, 0.1)),
        "volume_se": where(known, np.sqrt(counted)), "heavy": where(visible, counted * 0.1),
        "speed_mean": where(visible, 9.0), "speed_time_mean": where(visible, 10.0),
        "speed_counts": pa.array(classes, pa.list_(pa.int32())),
        "occupancy": where(visible, rng.random(12)),
        "occupancy_se": where(visible, 0.1 * rng.random(12)), "density": where(visible, density),
        "flow": where(visible, density * rng.uniform(10.0, 50.0, 12)),
        "travel_time_s": where(known, 2.0), "delay_s": where(known, rng.random(12)),
        "queue_max_m": where(visible & (lane == 13), rng.uniform(0.0, 90.0, 12)),
        "queue_mean_m": where(visible & (lane == 13), rng.uniform(0.0, 50.0, 12)),
        "stops": np.ma.masked_array(counted // 3, ~visible), "visible_km_h": area,
    }  # fmt: skip
    return LANE_MEASURES.to_arrow(columns)


def hour_at(moment):
    """Return the hour since 1970 of a time in UTC."""
    return int(np.datetime64(moment, "h").astype(int))

"""Sites for heat maps: datasets that are also kept as sets of steps, as the oracle."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import geopandas as gpd
import numpy as np
import shapely
from datasets import stepwise_dataset

from gis_radar.products import HeatMap

T0 = 1_700_000_000 * 20  # a step of today's size, the begin of an aligned 20 s
EAST, NORTH = 677_885.3, 5_403_673.1
FOLDERS = tempfile.TemporaryDirectory()


def lane_tiles(
    count: int, *, turn: float = 0.3, crs: str | None = "EPSG:25832"
) -> gpd.GeoDataFrame:
    """Tiles of two lanes that cross, in UTM."""
    along = np.arange(count) * 0.5
    shapes = [
        shapely.affinity.rotate(
            shapely.box(EAST + x - 5, NORTH - 1.6, EAST + x - 4.5, NORTH + 1.6),
            turn + lane * 1.2, origin=(EAST, NORTH), use_radians=True,
        )
        for lane in (0, 1) for x in along[: (count + 1 - lane) // 2]
    ]  # fmt: skip
    lanes = np.arange(count) * 2 >= count + count % 2
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(count),
            "lanelet_id": np.where(lanes, 9_000_000_000_000_000_001, 7),
            "index": np.arange(count),
            "s_m": along,
            "length_m": 0.5,
            "width_m": 3.2,
            "height_m": np.nan,
            "subtype": "road",
        },
        geometry=shapes,
        crs=crs,
    )


@dataclass(frozen=True, kw_only=True)
class Site:
    """A dataset that is also kept as sets, for the oracle."""

    tiles: gpd.GeoDataFrame
    delivered: dict[tuple[str, str], set[int]]  # steps that a frame covers, of each view
    seen: dict[tuple[str, str], set[int]]  # tiles, of each view
    hit: set[tuple[int, int]]

    @cached_property
    def dataset(self):
        folder = Path(tempfile.mkdtemp(dir=FOLDERS.name)) / "site"
        return stepwise_dataset(folder, self.tiles, self.delivered, self.seen, self.hit)

    def counts(self, first: int, after: int) -> dict[int, tuple[int, int]]:
        """Count (hit, observed) steps of each tile, in the plainest way."""
        result = {}
        for tile in self.tiles["tile_id"]:
            observed = {
                step
                for key, steps in self.delivered.items() if tile in self.seen.get(key, set())
                for step in steps if first <= step < after
            }  # fmt: skip
            hit = {step for step, hit in self.hit if hit == tile} & observed
            result[tile] = (len(hit), len(observed))
        return result


def make_site(
    tiles: gpd.GeoDataFrame,
    delivered: dict[tuple[str, str], set[int]],
    seen: dict[tuple[str, str], set[int]],
    hit: set[tuple[int, int]],
) -> Site:
    return Site(tiles=tiles, delivered=delivered, seen=seen, hit=hit)


def two_sensors(steps: int = 400) -> Site:
    """One radar at 50 ms with a gap, one at 57 ms whose pose changes; views overlap."""
    tiles = lane_tiles(16)
    slow = {T0 + k * 57 // 50 for k in range(steps * 50 // 57)}
    change = T0 + steps // 2
    delivered = {
        ("R1", "a"): set(range(T0 + 3, T0 + steps)) - set(range(T0 + 100, T0 + 130)),
        ("R2", "a"): {step for step in slow if step < change},
        ("R2", "b"): {step for step in slow if step >= change},
    }
    seen = {
        ("R1", "a"): set(range(8)),
        ("R2", "a"): set(range(5, 12)),
        ("R2", "b"): set(range(6, 13)),
    }
    rng = np.random.default_rng(5)
    hit = {
        (T0 + int(step), int(tile))
        for step, tile in zip(
            rng.integers(-5, steps + 5, 3000), rng.integers(0, 15, 3000), strict=True
        )
        if tile != 9
    }
    return make_site(tiles, delivered, seen, hit)


def assert_like_oracle(site: Site, heatmap: HeatMap) -> None:
    timeline = heatmap.timeline
    spans = [(None, int(heatmap.whole.begin[0]), int(heatmap.whole.end[0]))]
    spans += [(i, int(timeline.begin[i]), int(timeline.end[i])) for i in range(len(timeline))]
    for interval, first, after in spans:
        shares = heatmap.shares(interval)
        for position, (hit, observed) in enumerate(site.counts(first, after).values()):
            assert shares.observed_s[position] == observed / 20
            if observed:
                assert shares.hit_s[position] == hit / 20
                assert shares.hit_share[position] == hit / observed
            else:
                assert np.isnan(shares.hit_s[position])
                assert np.isnan(shares.hit_share[position])

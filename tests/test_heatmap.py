"""What a heat map counts, against sets of steps counted one by one."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from datasets import stepwise_dataset
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gis_radar.base import InputError
from gis_radar.products import HeatMap, make_heatmap

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


@pytest.mark.parametrize("interval", ["1.5s", "7s", "15min"])
def test_counts_are_those_of_the_oracle(interval):
    site = two_sensors()
    assert_like_oracle(site, make_heatmap(site.dataset, interval=interval))


steps = st.sets(st.integers(T0, T0 + 60), max_size=40)
keys = st.sampled_from([("R1", "a"), ("R1", "b"), ("R2", "a")])


@given(
    delivered=st.dictionaries(keys, steps, min_size=1),
    seen=st.dictionaries(keys, st.sets(st.integers(0, 5)), min_size=1),
    hit=st.sets(st.tuples(st.integers(T0 - 2, T0 + 62), st.integers(0, 5))),
    interval=st.sampled_from([None, "50ms", "250ms", "1s", "1h"]),
)
@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.filter_too_much])
def test_any_views_frames_and_hits_count_as_in_the_oracle(delivered, seen, hit, interval):
    site = make_site(lane_tiles(6), delivered, seen, hit)
    if not any(delivered.values()) or not any(seen.values()):
        with pytest.raises(InputError):
            make_heatmap(site.dataset, interval=interval)
        return
    heatmap = make_heatmap(site.dataset, interval=interval)
    assert_like_oracle(site, heatmap)
    assert np.nanmax(np.append(heatmap.long()["hit_share"], 0.0)) <= 1.0


def test_225_of_2000_steps_are_11_25_seconds():
    tiles = lane_tiles(2)
    view = ("R1", "a")
    hit = {(T0 + 7 * k, 1) for k in range(225)}
    site = make_site(tiles, {view: set(range(T0, T0 + 2000))}, {view: {0, 1}}, hit)
    row = make_heatmap(site.dataset).wide().iloc[1]
    assert row["hit_s"] == 11.25
    assert row["observed_s"] == 100.0
    assert row["hit_share"] == 0.1125


def test_overlapping_views_never_count_twice():
    both = {("R1", "a"): {T0, T0 + 1}, ("R2", "a"): {T0 + 1, T0 + 2}}
    site = make_site(lane_tiles(1), both, {key: {0} for key in both}, {(T0 + 1, 0)})
    shares = make_heatmap(site.dataset).shares()
    assert shares.observed_s[0] == 0.15
    assert shares.hit_s[0] == 0.05


def test_the_map_of_one_moment():
    site = two_sensors()
    heatmap = make_heatmap(site.dataset, at="2023-11-14T22:13:21.02Z")
    assert_like_oracle(site, heatmap)
    assert (int(heatmap.whole.begin[0]), int(heatmap.whole.end[0])) == (T0 + 20, T0 + 21)
    assert set(heatmap.wide()["hit_s"].dropna()) == {0.0, 0.05}
    assert len(heatmap.long()) == len(site.tiles)


def test_inputs_are_not_changed_and_other_columns_are_left():
    site = two_sensors()
    tiles = site.tiles.rename_geometry("geom").assign(hit_s=1.0, note="x")
    before = tiles.copy()
    wide = make_heatmap(site.dataset).wide()
    assert tiles.equals(before)
    assert "note" not in wide
    assert wide.geometry.name == "geometry"


def test_repr_says_the_time_of_the_site_and_ranks_nothing_by_hits():
    site = two_sensors()
    text = repr(make_heatmap(site.dataset, interval="5s", timezone="Europe/Berlin"))
    assert "HeatMap(2023-11-14T23:13:20+01:00 to 2023-11-14T23:13:40+01:00 (Europe/Berlin)" in text
    assert "4 intervals" in text
    assert "13 of 16 tiles observed" in text
    assert "busiest" not in text
    empty = make_site(site.tiles, {("R1", "a"): {T0}}, {("R1", "a"): {0}}, set())
    assert "(UTC), 1 interval, 1 of 16 tiles observed, 0 hit)" in repr(make_heatmap(empty.dataset))


def test_a_heat_maps_card_shows_the_time_of_the_site():
    site = two_sensors()
    page = make_heatmap(site.dataset, timezone="Europe/Berlin")._repr_html_()
    assert "2023-11-14T23:13:20+01:00" in page
    assert "Europe/Berlin" in page
    assert "busiest" not in page


def test_figures_are_plain_numbers_and_text():
    tiles, view = lane_tiles(2), ("R1", "a")
    site = make_site(tiles, {view: set(range(T0, T0 + 40))}, {view: {0, 1}}, {(T0 + 3, 1)})
    figures = make_heatmap(site.dataset, interval="1s").figures()
    assert json.loads(json.dumps(figures)) == {
        "begin": "2023-11-14T22:13:20Z",
        "end": "2023-11-14T22:13:22Z",
        "intervals": 2,
        "tiles_observed": 2,
        "tiles_hit": 1,
    }

"""Tiles that frames hit as they come, against the grid and numpy."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gis_radar as gr
from bench.tile_oracles import TileTree
from gis_radar.base import InputError
from gis_radar.hdmap import TileGrid, quads
from gis_radar.measures import FrameCounter, PoseNumbers
from gis_radar.measures.counting_loop import DETECTIONS, TILES_HIT
from gis_radar.measures.hit_counter import HitCounter, rows_of_detections
from gis_radar.recordings import Detections, RangeCounts
from gis_radar.scans import SightTiles

SAMPLE = gr.sample_folder()
BEGIN = 1749713400.0  # of its recordings


@pytest.fixture(scope="module")
def tiles():
    return gr.make_tiles(gr.read_map(SAMPLE / "junction.osm"))


def test_each_frame_has_the_tiles_that_it_hits(tiles):
    pose = gr.read_pose(SAMPLE / "R1.json")
    frames = FrameCounter(SightTiles.of(tiles))
    detections = next(gr.open_recording(SAMPLE / "R1.parquet").read())
    place = pose.to_map(detections.points)
    point, tile = TileGrid(quads(tiles)).assign(place[:, 0], place[:, 1])
    times, frame = np.unique(detections.time, return_inverse=True)
    expected = [np.unique(tile[frame[point] == k]).tolist() for k in range(50)]
    few = detections.take(frame < 50)
    for _ in range(2):  # what came before leaves no trace
        found = frames.count(few, pose)
        assert [each.time_us for each in found] == np.rint(times[:50] * 1e6).tolist()
        assert [each.tiles.tolist() for each in found] == expected
    assert sum(map(len, expected)) > 1000


def test_a_frame_without_positions_hits_nothing(tiles):
    pose = gr.read_pose(SAMPLE / "R1.json")
    frames = FrameCounter(SightTiles.of(tiles))
    detections = next(gr.open_recording(SAMPLE / "R1.parquet").read())
    first = detections.take(detections.time == detections.time[0])
    for gone in (np.nan, np.inf):
        first.points[:] = gone
        assert [each.tiles.tolist() for each in frames.count(first, pose)] == [[]]
    first.time[-1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        frames.count(first, pose)


@pytest.fixture(scope="module")
def tree(tiles):
    return TileTree(quads(tiles))


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(1, 3000),
    kind=st.sampled_from([np.float32, np.float64]),
    level=st.booleans(),
    least=st.sampled_from([None, 0.3]),
)
@settings(max_examples=25)  # compiled at the first call
def test_any_rows_hit_what_the_tree_and_numpy_say(tiles, tree, seed, rows, kind, level, least):
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, [60.0, 60.0, 2.0], (rows, 3)).astype(kind)
    points[:, 2] = np.nan if level else points[:, 2]
    points[rng.random(rows) < 0.1] = np.nan
    points[rng.random(rows) < 0.01] *= 1e4
    rate = rng.normal(0.0, 1.0, rows).astype(kind)
    time = np.sort(BEGIN + rng.integers(0, 4, rows) * 0.04)
    pose = replace(gr.read_pose(SAMPLE / "R1.json"), yaw=float(rng.uniform(-180.0, 180.0)))
    road = SightTiles.of(tiles)
    ranges = RangeCounts()
    counter = HitCounter(
        road, TileGrid(road.quads), filters=gr.Filters(min_speed=least), ranges=ranges
    )
    none = pa.RecordBatch.from_arrays([], names=[])
    batch = Detections(time=time, points=points, range_rate=rate, rcs=rate, further=none)
    columns = rows_of_detections(batch, time)
    road_m = pose.height - 3.0
    numbers = PoseNumbers.of(pose, road_m=road_m)
    found = [*counter.add(columns, 0, rows, numbers), counter.end()]

    points = points.astype(np.float64)
    range_m = np.sqrt((np.nan_to_num(points) ** 2).sum(axis=1))
    present = ~np.isnan(points[:, 0])
    hits = present if least is None else present & (np.abs(rate) >= least)
    hits = hits & ~(np.isnan(points[:, 2]) & (range_m <= 3.0)) & pose.view.sees(points)
    place = pose.to_map(points[hits], road_m=road_m)
    point, tile = tree.assign(place[:, 0], place[:, 1])
    time_us = np.rint(time * 1e6).astype(np.int64)
    frames = np.concatenate([each.frames for each in found])
    times, frame = np.unique(time_us, return_inverse=True)
    pairs = np.unique(np.stack([frame[hits][point], tile]), axis=1)
    of_frame = np.repeat(np.arange(len(times)), frames[:, TILES_HIT])
    counted = np.stack([of_frame, np.concatenate([each.tile for each in found])])
    assert np.array_equal(counted[:, np.lexsort(counted[::-1])], pairs)
    assert frames[:, 0].tolist() == times.tolist()
    assert frames[:, TILES_HIT].tolist() == np.bincount(pairs[0], minlength=len(times)).tolist()
    assert frames[:, DETECTIONS].tolist() == np.bincount(frame, present).astype(int).tolist()
    metres = np.minimum(range_m[present], len(ranges.counts) - 1).astype(np.int64)
    assert np.array_equal(ranges.counts, np.bincount(metres, minlength=len(ranges.counts)))

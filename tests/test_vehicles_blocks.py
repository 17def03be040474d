"""The blocks of an hour: their spans, and that two hours make the one at their edge alike."""

from functools import cache
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, STEPS_PER_SECOND
from gis_radar.hdmap import lane_graph
from gis_radar.measures import HashedFrames, HourWindow, PlacedRecording, PoseSight, SensorHour
from gis_radar.measures.counting_loop import FRAME_COLUMNS
from gis_radar.poses import as_track
from gis_radar.recordings import Recording
from gis_radar.recordings.recording import COLUMNS
from gis_radar.tracking import hour_blocks
from gis_radar.tracking.hour_blocks import blocks_of

SAMPLE = gr.sample_folder()
HOUR = 472_222
BEGIN = HOUR * STEPS_PER_HOUR


@pytest.fixture(scope="module", autouse=True)
def _short_blocks():
    with pytest.MonkeyPatch.context() as shorter:
        shorter.setattr(hour_blocks, "BLOCK_STEPS", 30)
        shorter.setattr(hour_blocks, "BLOCK_MARGIN_STEPS", 10)
        yield


@cache
def graph():
    return lane_graph(gr.read_map(SAMPLE / "junction.osm").lanelets)


def sensor_of(steps, window, sensor="R1"):
    """What a sensor delivered that has one detection in each of some steps, in memory."""
    first, after = window.span
    time = (BEGIN + np.array(sorted(steps))) / STEPS_PER_SECOND
    values = {"x": 30.0, "y": 30.0, "z": -2.0, "range_rate": 1.0, "rcs": 1.0}
    columns = {name: np.full(len(time), values.get(name)) for name in COLUMNS} | {"time": time}
    batch = pa.RecordBatch.from_pydict({n: np.array(each, float) for n, each in columns.items()})
    track = as_track(gr.read_pose(SAMPLE / f"{sensor}.json"))
    sight = PoseSight(
        name="p", pose=track.poses[0], tile_id=np.empty(0, np.int64), road_m=float("nan")
    )
    source = PlacedRecording(
        recording=Recording(path=SAMPLE / "R1", rows=len(time), batches=lambda _: iter([batch])),
        track=track, track_name="p", sights=[sight], clock=None,
    )  # fmt: skip
    step = np.rint(time * STEPS_PER_SECOND)
    inside = time[(step >= first) & (step < after)]
    none = np.zeros(len(inside), np.int64)
    return SensorHour(
        sensor=sensor, sources=[source], source=none, pose=none, tile=[], evidence=[],
        frames=HashedFrames(time=inside, hash=none.astype(np.uint64), detections=none),
        counted=np.empty((0, FRAME_COLUMNS), np.int64),
    )  # fmt: skip


def blocks(steps, hour=HOUR):
    window = HourWindow(hour=hour, margin=20)
    found = blocks_of([sensor_of(steps, window)], window, graph())
    return [block for _, block in found]


def spans(steps, hour=HOUR):
    return [(b.first_step - BEGIN, b.last_step - BEGIN) for b in blocks(steps, hour)]


def test_blocks_are_whole_where_frames_are_missing_at_their_inner_edges():
    assert spans([13, 14, 25, 35, 44, 63, 75]) == [(13, 29), (30, 59), (63, 75)]


def test_a_block_ends_with_its_last_frame_where_none_follows_in_the_margin():
    assert spans([13, 14, 45, 200]) == [(13, 14), (45, 45), (200, 200)]
    assert spans([13, 24, 39, 200]) == [(13, 29), (30, 39), (200, 200)]


def test_a_long_gap_belongs_to_no_block():
    assert spans([13, 305, 306]) == [(13, 13), (305, 306)]


def test_the_first_block_straddles_the_begin_of_the_hour():
    assert spans([-3, 2, 9, 12]) == [(-3, 9), (10, 12)]
    assert spans([-15, 2, 12]) == [(-10, 9), (10, 12)]
    assert spans([STEPS_PER_HOUR - 2, STEPS_PER_HOUR + 3]) == [
        (STEPS_PER_HOUR - 2, STEPS_PER_HOUR + 3)
    ]


@settings(max_examples=25)
@given(st.sets(st.integers(-60, 60), min_size=1))
def test_two_hours_make_the_block_at_their_edge_alike(steps):
    at_edge = [
        [
            (b.first_step, b.last_step, b.detections.time.tolist())
            for b in blocks(steps, hour)
            if -10 <= b.first_step - BEGIN < 10
        ]
        for hour in (HOUR - 1, HOUR)
    ]
    assert at_edge[0] == at_edge[1]


@settings(max_examples=25)
@given(st.sets(st.integers(0, 300), min_size=1))
def test_each_frame_of_the_hour_lies_in_one_block(steps):
    found = spans(steps)
    assert all(after > last for (_, last), (after, _) in pairwise(found))
    assert {s for s in steps if any(a <= s <= b for a, b in found)} == steps

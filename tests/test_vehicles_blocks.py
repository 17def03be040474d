"""Recordings read in blocks: their spans, and what says that a recording cannot be used."""

from functools import cache
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gis_radar as gr
from gis_radar.lanelets.graph import lane_graph
from gis_radar.occupancy.views import PlacedRecording
from gis_radar.poses.files import as_track
from gis_radar.progress import QUIET
from gis_radar.recordings.recording import COLUMNS, Recording
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.blocks import SourceReader
from gis_radar.vehicles.settings import BlockSettings, VehicleSettings

SAMPLE = gr.sample_folder()
BEGIN = 1_700_000_000 * STEPS_PER_SECOND
STEPS = 20
SETTINGS = VehicleSettings(blocks=BlockSettings(steps=STEPS, margin_steps=10))


@cache
def graph():
    return lane_graph(gr.read_map(SAMPLE / "junction.osm").lanelets)


def placed(steps, *, name="R1", sensor="R1", detections=False, rate=1.0):
    """Make a recording with one row in each of some steps, in memory."""
    time = (BEGIN + np.asarray(steps)) / STEPS_PER_SECOND
    place = 30.0 if detections else np.nan
    values = {"time": time, "x": place, "y": place, "z": -2.0, "range_rate": rate, "rcs": 1.0}
    if not detections:
        values = dict.fromkeys(COLUMNS, np.nan) | {"time": time}
    columns = {column: np.broadcast_to(values[column], time.shape) for column in COLUMNS}
    batch = pa.RecordBatch.from_pydict({n: np.array(each) for n, each in columns.items()})
    return PlacedRecording(
        recording=Recording(path=SAMPLE / name, rows=len(time), batches=lambda _: iter([batch])),
        track=as_track(gr.read_pose(SAMPLE / f"{sensor}.json")), views=["view"], clock=None,
    )  # fmt: skip


def reader_of(*sources):
    return SourceReader(
        sources, graph(), dict.fromkeys([("R1", "view"), ("R2", "view")], np.nan), SETTINGS, QUIET
    )


def spans(*sources):
    return [
        (block.first_step - BEGIN, block.last_step - BEGIN)
        for block in reader_of(*sources).blocks()
    ]


def test_inner_blocks_are_whole_where_frames_are_missing_at_their_edges():
    assert spans(placed([3, 4, 15, 27, 33, 45])) == [(3, 19), (20, 39), (40, 45)]


def test_a_long_gap_belongs_to_no_block():
    assert spans(placed([3, 105, 106])) == [(3, 19), (100, 106)]


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, 200), min_size=1), st.sets(st.integers(0, 200), min_size=1))
def test_blocks_hold_each_frame_once_and_leave_out_no_step_between_neighbours(one, other):
    sources = placed(sorted(one)), placed(sorted(other), name="R2", sensor="R2")
    blocks = list(reader_of(*sources).blocks())
    held = [
        (row.sensor, step - BEGIN)
        for block in blocks
        for row in block.frames.itertuples()
        for step in range(row.first_step, row.last_step + 1)
    ]
    assert sorted(held) == [("R1", s) for s in sorted(one)] + [("R2", s) for s in sorted(other)]
    assert [blocks[0].first_step, blocks[-1].last_step] == [
        BEGIN + min(one | other), BEGIN + max(one | other),
    ]  # fmt: skip
    for before, after in pairwise(blocks):
        assert (before.last_step + 1) % STEPS == 0 == after.first_step % STEPS
        assert before.last_step < after.first_step
    assert [block.begins for block in blocks] == [True, *[False] * (len(blocks) - 1)]
    assert [block.ends for block in blocks] == [*[False] * (len(blocks) - 1), True]


def test_a_recording_of_empty_frames_is_read():
    reader = reader_of(placed([0, 1, 2]))
    assert [len(block.echoes) for block in reader.blocks()] == [0]
    assert reader.records()[0]["rows"] == 3


def test_a_recording_whose_rows_another_one_holds_is_read():
    whole = placed([0, 1, 2, 3], detections=True)
    reader = reader_of(whole, placed([1, 2], name="again", detections=True))
    assert len(list(reader.blocks())) == 1
    assert [line for line in reader.warnings() if "again: overlaps another" in line]


def test_detections_without_a_range_rate_are_refused():
    reader = reader_of(placed([0, 1], detections=True, rate=np.nan))
    with pytest.raises(gr.InputError, match="no range rates"):
        list(reader.blocks())

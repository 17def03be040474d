"""What runs often is compiled before a program begins, which a stop does not wait for."""

import signal
import subprocess
import sys

import pytest
from live_programs import Program, takes_long
from live_site import LiveSite, wait_for

from gis_radar.live.wire.first_run import COMPILING

BEGIN = """
import gis_radar as gr
from gis_radar.live.wire import first_run
from gis_radar.live.wire.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.wire.sources import frames_of_recording
from gis_radar.measures.hit_counter import FrameCounter
from gis_radar.scans import SightTiles
from numba.core.dispatcher import Dispatcher
import gc

def compiled():
    return {
        each.py_func.__qualname__.rpartition("_")[0]: len(each.signatures)
        for each in gc.get_objects() if isinstance(each, Dispatcher) and each.signatures
    }

sample = gr.sample_folder()
road = SightTiles.of(gr.make_tiles(gr.read_map(sample / "junction.osm")))
pose, selector = gr.read_pose(sample / "R2.json"), DetectionSelector(road)
"""
OF_SENSOR = (
    BEGIN
    + """
first_run.run_sensor_once()
first_run.run_fusion_once()
before = compiled()
for filters in (gr.Filters(), gr.Filters(min_speed=1.0, min_rcs=-10.0)):
    counter = FrameCounter(road, filters=filters)
    for k, frame in zip(range(20), frames_of_recording(sample / "R2.parquet")):
        content = pack_detections([selector.find(frame, pose, road_m=0.0)], pose=b"pose")
        counter.count(unpack_detections(content)[1][0].as_rows(), pose)
print({name: count for name, count in compiled().items() if before.get(name) != count})
print(sorted(before))
"""
)
OF_VEHICLES = (
    BEGIN
    + """
from gis_radar.hdmap import lane_graph
from gis_radar.live.now.vehicles_now import PlacedMessage, VehicleFollower, run_vehicles_once
run_vehicles_once()
following = VehicleFollower(lane_graph(gr.read_map(sample / "junction.osm").lanelets))
before = compiled()
for k, frame in zip(range(600), frames_of_recording(sample / "R2.parquet")):
    content = pack_detections([selector.find(frame, pose, road_m=0.0)], pose=b"pose")
    following.go_on([PlacedMessage(1, pose, 0.0, content)])
assert len(following.go_on([]))
print({name: count for name, count in compiled().items() if before.get(name) != count})
print(sorted(before))
"""
)


def said_by(code):
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return done.stdout.splitlines()


def test_no_frame_of_a_sensor_waits_for_the_compiler():
    more, loops = said_by(OF_SENSOR)
    assert more == "{}"
    assert "count_rows" in loops
    assert "_unpack_column" in loops


@takes_long
def test_no_vehicle_waits_for_the_compiler():
    more, loops = said_by(OF_VEHICLES)
    assert more == "{}"
    assert "_follow" in loops


@pytest.mark.parametrize("word", ["edge", pytest.param("live", marks=takes_long)])
def test_a_stop_does_not_wait_for_the_compiler(word, tmp_path, once, monkeypatch):
    """Nothing is kept yet, so all must be compiled; there is no broker, and none is asked."""
    kept = tmp_path / "kept"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(kept))
    site = LiveSite(tmp_path, once, vehicles="true")
    program = Program(tmp_path, word, site.edge("R1") if word == "edge" else site.file)
    wait_for(lambda: program.told(COMPILING))  # from here on it takes seconds on any machine
    program.process.send_signal(signal.SIGTERM)
    program.wait()
    assert not [*kept.rglob("*count_rows*.nbi"), *kept.rglob("*_follow*.nbi")]

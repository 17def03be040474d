"""What runs often is compiled before a program begins, which a stop does not wait for."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from live_programs import Program, takes_long
from live_site import LiveSite, wait_for

from gis_radar.live.first_run import COMPILING

OF_SENSOR = """
import gis_radar as gr
from gis_radar.arrays import _Compiled
from gis_radar.live import first_run
from gis_radar.live.detections import DetectionSelector, pack_detections
from gis_radar.live.payload import pack_hits, unpack_hits
from gis_radar.live.sources import frames_of_recording
from gis_radar.live.tile_finder import TileFinder
from gis_radar.sight import SightTiles
import gc

def compiled():
    return {
        each.function.__name__: len(each.machine_code.signatures)
        for each in gc.get_objects() if isinstance(each, _Compiled) and each._is_begun
    }

first_run.run_sensor_once()
first_run.run_fusion_once()
before = compiled()
sample = gr.sample_folder()
road = SightTiles.of(gr.make_tiles(gr.read_map(sample / "junction.osm")))
for filters in (gr.Filters(), gr.Filters(min_speed=1.0, min_rcs=-10.0)):
    finder = TileFinder(road, gr.TileGrid(road.quads), filters, gr.read_pose(sample / "R2.json"))
    selector = DetectionSelector(road)
    for k, frame in zip(range(20), frames_of_recording(sample / "R2.parquet")):
        content = pack_hits([finder.find(frame)], pose=1, fingerprint=road.fingerprint)
        unpack_hits(content, tiles=len(road.tile_id))
        pack_detections([finder.detections(frame, selector)], pose=1)
print({name: count for name, count in compiled().items() if before.get(name) != count})
print(sorted(before))
"""
OF_VEHICLES = """
import sys; sys.path.insert(0, {tests!r})
from pathlib import Path
from test_live_first_run import OF_SENSOR
exec(OF_SENSOR.split("first_run.run_sensor_once")[0])
from gis_radar.live.vehicles.first_run import run_vehicles_once
run_vehicles_once()
before = compiled()
from live_vehicles import Sent
sample = gr.sample_folder()
sent = Sent(sample / "junction.osm", [sample / "R2.parquet"], [gr.read_pose(sample / "R2.json")],
            Path({folder!r}))
counted = compiled()
follower = sent.follower()
blocks = [*sent.feed(follower, sent.messages[:600]), *sent.end(follower)]
follower.write_hour(blocks[0].first_step // 72_000)
print({{name: count for name, count in compiled().items() if counted.get(name) != count}})
print(sorted(before))
"""


def said_by(code):
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return done.stdout.splitlines()


def test_no_frame_of_a_sensor_waits_for_the_compiler():
    more, loops = said_by(OF_SENSOR)
    assert more == "{}"
    assert "count_rows" in loops
    assert "_decode" in loops


@takes_long
def test_no_vehicle_waits_for_the_compiler(tmp_path):
    more, loops = said_by(
        OF_VEHICLES.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    )
    assert more == "{}"
    assert "_follow" in loops


@pytest.mark.parametrize("word", ["edge", "live"])
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

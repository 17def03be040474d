"""The live system with a real broker: what it stores is what the batch counts, whatever breaks."""

import numpy as np
import pytest
from live_site import SAMPLE, Background, LiveSite, needs_mosquitto

import gis_radar as gr
from gis_radar.live.edge import Edge
from gis_radar.live.fusion import Fusion
from gis_radar.live.settings import read_edge_file, read_live_site

NAMES = ("R1", "R2")
pytestmark = needs_mosquitto


@pytest.fixture
def site(tmp_path, once):
    """Give a live site whose broker runs."""
    made = LiveSite(tmp_path, once)
    made.broker.start()
    yield made
    made.broker.kill()


def columns(stream):
    return [np.concatenate(each) for each in zip(*stream, strict=True)]


def assert_same_tables(one, other):
    """Compare all tables of two occupancies exactly."""
    assert one.fingerprint == other.fingerprint
    assert one.frames.equals(other.frames)
    assert one.views.equals(other.views)
    assert one.hold_s == other.hold_s
    names = one.sensors
    for read in ("hits_by_sensor", "frame_log"):
        mine, theirs = (columns(getattr(each, read)(names)) for each in (one, other))
        assert len(mine[0])
        for number, (a, b) in enumerate(zip(mine, theirs, strict=True)):
            assert np.array_equal(a, b), f"{read}, column {number}"


@pytest.fixture(scope="session")
def batch(once):
    """Give the folder that the batch makes of the sample's recordings."""

    def make(folder):
        tiles = gr.make_tiles(gr.read_map(SAMPLE / "junction.osm"))
        poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in NAMES]
        recordings = [SAMPLE / f"{name}.parquet" for name in NAMES]
        gr.measure_occupancy(recordings, poses, tiles, folder / "occupancy")
        return folder / "occupancy"

    return gr.read_occupancy(once("live_batch", make))


def test_what_fusion_stores_equals_the_batch(site, batch):
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edges = [Edge(read_edge_file(site.edge(name))) for name in NAMES]
    work = [Background(each.run) for each in edges]
    for each in work:
        each.join(60.0)
        each.end()
    middle.end()
    hours = sorted((site.folder / "live" / "occupancy").iterdir())
    assert [path.name for path in hours] == ["2025-06-12T07Z"]
    assert_same_tables(gr.read_occupancy(hours), batch)
    assert [edge.frames for edge in edges] == [2000, 2002]

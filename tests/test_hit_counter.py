"""Tiles that frames hit as they come, against the grid and numpy."""

import numpy as np
import pytest

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.occupancy.hit_counter import FrameHits
from gis_radar.sight import SightTiles

SAMPLE = gr.sample_folder()


@pytest.fixture(scope="module")
def tiles():
    return gr.make_tiles(gr.read_map(SAMPLE / "junction.osm"))


def test_each_frame_has_the_tiles_that_it_hits(tiles):
    pose = gr.read_pose(SAMPLE / "R1.json")
    frames = FrameHits(SightTiles.of(tiles))
    detections = next(gr.open_recording(SAMPLE / "R1.parquet").read())
    place = pose.to_map(detections.points)
    point, tile = gr.TileGrid(gr.quads(tiles)).assign(place[:, 0], place[:, 1])
    times, frame = np.unique(detections.time, return_inverse=True)
    expected = [np.unique(tile[frame[point] == k]).tolist() for k in range(50)]
    few = detections.take(frame < 50)
    for _ in range(2):  # what came before leaves no trace
        found = frames.of(few, pose)
        assert [time_us for time_us, _ in found] == np.rint(times[:50] * 1e6).tolist()
        assert [hits.tolist() for _, hits in found] == expected
    assert sum(map(len, expected)) > 1000


def test_a_frame_without_detections_hits_nothing(tiles):
    pose = gr.read_pose(SAMPLE / "R1.json")
    detections = next(gr.open_recording(SAMPLE / "R1.parquet").read())
    first = detections.take(detections.time == detections.time[0])
    first.points[:] = np.nan
    ((_, hits),) = FrameHits(SightTiles.of(tiles)).of(first, pose)
    assert hits.tolist() == []
    first.time[-1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        FrameHits(SightTiles.of(tiles)).of(first, pose)

"""A whole town through a real broker: what live measures is what the batch does, to the bit."""

import json

import numpy as np
import pytest
from live_programs import (
    Lines,
    assert_equal_to_batch,
    pose_beside,
    recorded,
    recordings_of,
    takes_long,
)
from live_site import Background, LiveSite, needs_mosquitto
from maps import SHARED

import gis_radar as gr
from gis_radar.live import Edge, Fusion, read_edge_file, read_live_site

TOWN = SHARED / "town02"
NAMES = ("R1", "R2", "R3")
pytestmark = [
    needs_mosquitto,
    takes_long,
    pytest.mark.skipif(not TOWN.exists(), reason="shared data absent: town02"),
]


@pytest.fixture(scope="module")
def inputs(once):
    """Give a folder with tiles, road and true poses of the town."""

    def make(folder):
        roads = gr.read_map(TOWN / "map.osm")
        gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
        gr.mask_road([TOWN / "als.laz"], roads).write(folder / "road.laz")
        truth = json.loads((TOWN / "truth.json").read_text())
        for name in NAMES:
            keys = ("easting", "northing", "height", "yaw", "pitch", "roll")
            pose = {key: truth[name][key] for key in keys}
            pose |= {"sensor": name, "crs": "EPSG:25832", "view": {"max_range_m": 200.0}}
            (folder / f"{name}.json").write_text(json.dumps(pose))
        return folder

    return once("live_town", make)


def test_a_town_with_a_scan_and_poses_that_are_given_and_followed(tmp_path, once, inputs):
    """R2 follows its pose, R1 and R3 keep theirs; fusion knows what hides."""
    scan = TOWN / "als.laz"
    site = LiveSite(
        tmp_path, once, names=NAMES, recordings=TOWN, tiles=inputs / "tiles.gpkg",
        map_file=TOWN / "map.osm", of_site=f'[scan]\nfiles = "{scan}"\n',
    )  # fmt: skip
    site.broker.start()
    lanes = f'[map]\nfile = "{TOWN / "map.osm"}"\n[view]\nmax_range_m = 200.0\n'
    road = f'"{inputs / "road.laz"}"'
    own = {
        "R1": {"pose": f'"{inputs / "R1.json"}"'},
        "R2": {"pose": f'"{inputs / "R2.json"}"', "road": road, "follow": "true", "more": lanes,
               "source": "speed = 1.0"},
        "R3": {"pose": f'"{inputs / "R3.json"}"'},
    }  # fmt: skip
    said = Lines()
    try:
        middle = Background(Fusion(read_live_site(site.file), reporter=said).run)
        edges = [Edge(read_edge_file(site.edge(name, **own[name])), reporter=said)
                 for name in NAMES]  # fmt: skip
        work = [Background(each.run) for each in edges]
        for each in work:
            each.join()
            each.end()
        middle.end()
    finally:
        site.broker.kill()
    tracks = [gr.read_track(pose_beside(recordings_of(tmp_path, name)[0])) for name in NAMES]
    assert [len(track.poses) for track in tracks][::2] == [1, 1]
    assert len(tracks[1].poses) > 2, said.lines  # it was followed
    assert_equal_to_batch(site, NAMES, scans=[scan])
    for name, edge in zip(NAMES, edges, strict=True):
        sent = recorded(tmp_path, name)["time"].nunique()
        assert sent == edge.frames == len(np.unique(times(TOWN / f"{name}.parquet")))


def times(path):
    return np.concatenate([piece.time for piece in gr.open_recording(path).read()])

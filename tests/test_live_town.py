"""A whole town through a real broker: what live stores is what the batch counts, to the bit."""

import json
import threading

import numpy as np
import pytest
from live_programs import Lines, assert_same_tables, stored, takes_long
from live_site import Background, LiveSite, needs_mosquitto, wait_for
from maps import SHARED

import gis_radar as gr
from gis_radar.live.broker import BrokerAddress, Link, SensorTopics
from gis_radar.live.edge import Edge
from gis_radar.live.fusion import Fusion
from gis_radar.live.payload import PoseContent, unpack_message
from gis_radar.live.settings import read_edge_file, read_live_site
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import pose_from_dict
from gis_radar.steps import STEP_US

TOWN = SHARED / "town02"
NAMES = ("R1", "R2", "R3")
pytestmark = [
    needs_mosquitto,
    takes_long,
    pytest.mark.skipif(not TOWN.exists(), reason="shared data absent: town02"),
]


class Observer:
    """Keeps the poses that sensors publish, with a log-in of its own."""

    def __init__(self, site):
        known = BrokerAddress.of(site.address, user="observer", password=site.password("observer"))
        topics = (SensorTopics("junction", "+").of("pose"),)
        self.link = Link(known, name="witness", topics=topics)
        self.link.open()
        self.poses = {name: {} for name in NAMES}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        wait_for(lambda: self.link.connected)

    def _read(self):
        while not self._ended.is_set():
            if (message := self.link.take(0.1)) is not None:
                envelope, content = unpack_message(message.payload)
                name = message.topic.split("/")[2]
                self.poses[name][envelope.number] = PoseContent.unpack(content)

    def tracks(self):
        """Return the track that each sensor published."""
        self._ended.set()
        self._thread.join()
        self.link.close()
        return [_track(self.poses[name]) for name in NAMES]


def _track(found):
    contents = [found[number] for number in sorted(found)]
    assert all(each.trusted for each in contents)
    poses = tuple(pose_from_dict(each.pose, what="a pose") for each in contents)
    return PoseTrack(poses=poses, since=np.array([c.since_step * STEP_US / 1e6 for c in contents]))


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


def test_a_town_with_a_scan_and_poses_that_are_found_and_followed(tmp_path, once, inputs):
    """R1 finds its pose, R2 follows a given one, R3 keeps its own; fusion knows what hides."""
    scan = TOWN / "als.laz"
    site = LiveSite(
        tmp_path, once, names=NAMES, recordings=TOWN, tiles=inputs / "tiles.gpkg",
        map_file=TOWN / "map.osm", of_site=f'[scan]\nfiles = "{scan}"\n',
    )  # fmt: skip
    site.let_in("observer", "topic read v1/junction/+/pose")
    site.broker.start()
    lanes = f'[map]\nfile = "{TOWN / "map.osm"}"\n[view]\nmax_range_m = 200.0\n'
    truth = gr.read_pose(inputs / "R1.json")
    road = f'"{inputs / "road.laz"}"'
    own = {
        "R1": {
            "pose": None, "guess": f"[{truth.easting + 4:.1f}, {truth.northing - 3:.1f}]",
            "road": road, "follow": "true", "more": lanes,
        },
        "R2": {"pose": f'"{inputs / "R2.json"}"', "road": road, "follow": "true", "more": lanes,
               "source": "speed = 1.0"},
        "R3": {"pose": f'"{inputs / "R3.json"}"'},
    }  # fmt: skip
    said = Lines()
    try:
        witness = Observer(site)
        middle = Background(Fusion(read_live_site(site.file), reporter=said).run)
        edges = [Edge(read_edge_file(site.edge(name, **own[name])), reporter=said)
                 for name in NAMES]  # fmt: skip
        work = [Background(each.run) for each in edges]
        for each in work:
            each.join()
            each.end()
        middle.end()
        tracks = witness.tracks()
    finally:
        site.broker.kill()
    assert [len(track.poses) for track in tracks][::2] == [1, 1]
    assert len(tracks[1].poses) > 2, said.lines  # it was followed
    recordings = [TOWN / f"{name}.parquet" for name in NAMES]
    batch = gr.measure(
        recordings, tracks, gr.read_tiles(site.tiles), TOWN / "map.osm", tmp_path / "batch",
        scans=[scan], hits_only=True,
    )  # fmt: skip
    live = stored(tmp_path)
    assert live.sensors == list(NAMES)
    assert_same_tables(live, batch)
    assert [edge.frames for edge in edges] == [len(np.unique(times(path))) for path in recordings]


def times(path):
    return np.concatenate([piece.time for piece in gr.open_recording(path).read()])

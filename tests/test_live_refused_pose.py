"""A start pose that traffic refuses: it is waited for, and counts only once traffic confirms it."""

from dataclasses import replace
from itertools import count, cycle

import numpy as np
import pytest
from live_programs import Lines
from live_site import SAMPLE, Background, LiveSite, wait_for

import gis_radar as gr
from gis_radar.base import CrsError
from gis_radar.live import (
    DiskBuffer,
    Edge,
    Outbox,
    PoseContent,
    frames_of_recording,
    read_edge_file,
)
from gis_radar.live.own_pose import FollowedPose
from gis_radar.scans import SightTiles

RIGHT = gr.read_pose(SAMPLE / "R1.json")
WRONG = replace(RIGHT, easting=RIGHT.easting + 6.0)
LANES = f'[map]\nfile = "{SAMPLE / "junction.osm"}"\n'


class Script:
    """A follower that says what traffic says: it refuses the wrong pose, after a while."""

    def __init__(self, start, doubted, trusts):
        self.start, self.doubted, self.trusts = start, doubted, trusts
        self.seen, self.closed = 0, False

    def push(self, _frame):
        assert not self.closed
        self.seen += 1
        return self.seen > 1  # too slow for the first one

    def latest(self):
        if self.seen != 100 or (self.start.easting == RIGHT.easting and not self.doubted):
            return None
        refused = "" if self.trusts else "traffic lies elsewhere"
        return FollowedPose(pose=self.start, trusted=self.trusts, refused=refused)

    def close(self):
        self.closed = True


class FedEdge(Edge):
    """A sensor's side whose frames and followers a test makes."""

    def __init__(self, *given, frames, trusted=(), **more):
        super().__init__(*given, **more)
        self.fed, self.trusted, self.made = frames, trusted, []

    def source(self):
        yield from self.fed

    def new_follower(self, start, begin, *, doubted):
        del begin
        self.made.append((start.easting, doubted))
        trusts = len(self.made) in self.trusted or start.easting == RIGHT.easting
        return Script(start, doubted, trusts)


@pytest.fixture
def run(tmp_path, once):
    """Give a function that lets an edge take frames; it returns what waits to be sent and said."""
    site = LiveSite(tmp_path, once)  # whose broker does not run
    frames = list(frames_of_recording(SAMPLE / "R1.parquet"))

    def take(number, *, trusted=(), **keys):
        said = Lines()
        road = f'"{SAMPLE / "scan.laz"}"'
        file = read_edge_file(site.edge("R1", more=LANES, road=road, follow="true", **keys))
        file.buffer_path.unlink(missing_ok=True)
        fed = (
            replace(frame, time=np.full(len(frame), 1_750_000_000.0 + 0.05 * k))
            for k, frame in zip(range(number), cycle(frames))
        )
        edge = FedEdge(file, frames=fed, trusted=trusted, reporter=said)
        work = Background(edge.run)
        wait_for(lambda: edge.frames == number or work.error)
        work.end()
        print_ = SightTiles.of(gr.read_tiles(file.tiles)).fingerprint
        with DiskBuffer(file.buffer_path, most_bytes=10**9, fingerprint=print_) as buffer:
            poses = [PoseContent.unpack(buffer.pose_of(k + 1)) for k in range(len(buffer))]
        return edge, [each.pose["easting"] for each in poses], said.lines

    return take


def test_a_given_pose_that_is_refused_is_tried_again_and_trusted_once_traffic_confirms_it(
    run, tmp_path
):
    WRONG.write(tmp_path / "R1.pose.json")
    edge, sent, said = run(1500, pose='"R1.pose.json"', trusted={3})
    assert [doubted for _, doubted in edge.made] == [False, True, True]
    assert len(sent) + edge.not_sent == 1500
    assert 1100 < edge.not_sent < 1300  # from its refusal on, until traffic says otherwise
    assert sum("not confirmed" in line for line in said) == 1


def test_a_doubt_that_a_full_disk_did_not_take_counts_once_there_is_room(
    run, tmp_path, monkeypatch
):
    WRONG.write(tmp_path / "R1.pose.json")
    store, tries = Outbox.put_pose, count()
    monkeypatch.setattr(
        Outbox, "put_pose",
        lambda box, message: next(tries) not in range(1, 31) and store(box, message),
    )  # fmt: skip
    edge, sent, said = run(400, pose='"R1.pose.json"')
    assert (len(sent), edge.not_sent) == (130, 270)  # it is refused at the hundredth frame
    assert sum("not confirmed" in line for line in said) == 1


def test_a_pose_in_another_system_than_the_tiles_is_refused(tmp_path, once):
    replace(RIGHT, crs="EPSG:25833").write(tmp_path / "other.json")
    file = LiveSite(tmp_path, once).edge("R1", pose='"other.json"')
    with pytest.raises(CrsError, match="of R1 is in EPSG:25833, but the tiles in EPSG:25832"):
        Edge(read_edge_file(file))

"""A start pose that traffic refuses: it is searched anew, or waited for, and counts only then."""

from dataclasses import replace
from itertools import cycle
from threading import Event

import numpy as np
import pytest
from live_programs import Lines
from live_site import SAMPLE, LiveSite

import gis_radar as gr
from gis_radar.base import CrsError, NoAnswerError
from gis_radar.calibration import FRAMES
from gis_radar.live import Edge, PoseContent, frames_of_recording, read_edge_file
from gis_radar.live import edge as edge_module
from gis_radar.live.own_pose import Followed

RIGHT = gr.read_pose(SAMPLE / "R1.json")
WRONG = replace(RIGHT, easting=RIGHT.easting + 6.0)
LANES = f'[map]\nfile = "{SAMPLE / "junction.osm"}"\n'


class Outbox:
    """Keeps the poses that are sent, and counts the messages by each."""

    lost, empty = 0, True

    def __init__(self, *_, **__):
        self.poses, self.sent = [], []

    def put_pose(self, message):
        self.poses.append(PoseContent.unpack(message).pose["easting"])
        self.sent.append(0)
        return True

    def put(self, _content):
        self.sent[-1] += 1
        return True

    def pump(self):
        """Send nothing."""


class FedEdge(Edge):
    """A sensor's side whose frames a test makes."""

    def __init__(self, *given, frames, **more):
        super().__init__(*given, **more)
        self.fed = frames

    def source(self):
        yield from self.fed


class NoLink:
    """A link to no broker."""

    def __init__(self, *_, **__):
        self.open = self.close = lambda *_: None


class Script:
    """A follower that says what traffic says: it refuses the wrong pose, after a while."""

    made = ()

    def __init__(self, _file, start, _begin, *, doubted, **_):
        Script.made = (*Script.made, (start.easting, doubted))
        self.start, self.doubted, self.seen, self.closed = start, doubted, 0, False

    def push(self, _frame):
        assert not self.closed
        self.seen += 1
        return self.seen > 1  # too slow for the first one

    def latest(self):
        if self.seen == 100 and self.start.easting == WRONG.easting:
            return Followed(pose=self.start, trusted=False, refused="traffic lies elsewhere")
        if self.seen == 100 and self.doubted:
            return Followed(pose=self.start, trusted=True)
        return None

    def close(self):
        self.closed = True


@pytest.fixture
def run(tmp_path, once, monkeypatch):
    """Give a function that lets an edge take frames; it returns what was sent and said."""
    site = LiveSite(tmp_path, once)
    monkeypatch.setattr(edge_module, "PoseFollower", Script)
    monkeypatch.setattr(edge_module, "Outbox", Outbox)
    monkeypatch.setattr(edge_module, "Link", NoLink)
    monkeypatch.setattr(edge_module, "compile_first", lambda *_: None)
    monkeypatch.setattr(Script, "made", ())
    frames = list(frames_of_recording(SAMPLE / "R1.parquet"))

    def take(number, **keys):
        said = Lines()
        road = f'"{SAMPLE / "scan.laz"}"'
        file = site.edge("R1", more=LANES, road=road, follow="true", **keys)
        fed = (
            replace(frame, time=np.full(len(frame), 1_750_000_000.0 + 0.05 * k))
            for k, frame in zip(range(number), cycle(frames))
        )
        edge = FedEdge(read_edge_file(file), frames=fed, reporter=said)
        edge.run(Event())
        return edge, said.lines

    return take


def test_a_pose_that_was_found_and_is_refused_is_searched_anew(run, monkeypatch):
    found = iter([WRONG, None, RIGHT])

    def find(_file, gathered, *, reporter):
        assert len(gathered) == FRAMES
        if (pose := next(found)) is None:
            raise NoAnswerError("too few vehicles")
        return pose

    monkeypatch.setattr(edge_module, "find_own_pose", find)
    guess = f"[{RIGHT.easting}, {RIGHT.northing}]"
    edge, said = run(2000 + 100 + 2000 + 500 + 50, pose=None, guess=guess)
    wrong, right = WRONG.easting, RIGHT.easting
    assert edge.outbox.poses == [wrong, wrong, right]
    assert edge.outbox.sent[1] == 0  # nothing is sent by a pose that is doubted
    assert edge.not_sent == 4650 - sum(edge.outbox.sent) > 2400
    assert edge.not_followed == len(Script.made)
    assert Script.made == ((wrong, False), (right, False))
    assert sum("not confirmed: traffic lies elsewhere" in line for line in said) == 1
    assert edge.frames == 4650


def test_a_given_pose_that_is_refused_is_tried_again_and_trusted_once_traffic_confirms_it(
    run, monkeypatch, tmp_path
):
    gr.write_pose(WRONG, tmp_path / "R1.pose.json")
    edge, said = run(2000, pose='"R1.pose.json"')
    assert (len(edge.outbox.poses), edge.outbox.sent[1]) == (2, 0)
    assert len(Script.made) > 2
    assert [doubted for _, doubted in Script.made] == [False, *[True] * (len(Script.made) - 1)]
    assert sum("not confirmed" in line for line in said) == 1
    # the same traffic puts it right after all: not before it says so
    monkeypatch.setattr(edge_module, "AGAIN_FRAMES", 50)
    confirmed = []

    class Later(Script):
        def latest(self):
            answer = super().latest()
            if answer is not None and len(Script.made) == 3:
                confirmed.append(self.doubted)
                return Followed(pose=self.start, trusted=True)
            return answer

    monkeypatch.setattr(edge_module, "PoseFollower", Later)
    Script.made = ()
    edge, _ = run(700, pose='"R1.pose.json"')
    assert len(edge.outbox.poses) == 3
    assert [bool(count) for count in edge.outbox.sent] == [True, False, True]
    assert confirmed == [True]


def test_a_recording_that_ends_before_the_pose_is_known_is_used_as_far_as_it_goes(
    run, monkeypatch, tmp_path
):
    searched = []

    def find(_file, gathered, **_):
        searched.append(len(gathered))
        return RIGHT

    monkeypatch.setattr(edge_module, "find_own_pose", find)
    guess = f"[{RIGHT.easting}, {RIGHT.northing}]"
    edge, _ = run(700, pose=None, guess=guess)
    assert searched == [700]  # once there are no more, and not before
    assert edge.frames == 700


def test_frames_are_counted_whose_pose_the_buffer_refuses(run, monkeypatch):
    monkeypatch.setattr(Outbox, "put_pose", lambda *_: False)
    edge, _ = run(50)
    assert (edge.frames, edge.not_sent) == (50, 50)


def test_a_pose_in_another_system_than_the_tiles_is_refused(tmp_path, once):
    gr.write_pose(replace(RIGHT, crs="EPSG:25833"), tmp_path / "other.json")
    file = LiveSite(tmp_path, once).edge("R1", pose='"other.json"')
    with pytest.raises(CrsError, match="of R1 is in EPSG:25833, but the tiles in EPSG:25832"):
        Edge(read_edge_file(file))

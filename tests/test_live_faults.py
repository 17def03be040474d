"""What may go wrong in the live system, without a network: nothing acknowledged is lost then."""

import numpy as np
import pytest
from live_site import SAMPLE

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.live.broker import Received
from gis_radar.live.intake import Intake
from gis_radar.live.journal import HOUR_US, FrameRow, Journal
from gis_radar.live.map_of_now import MapOfNow
from gis_radar.live.payload import HITS, POSE, Envelope, PoseContent, pack_hits, pack_message
from gis_radar.live.payload import unpack_hits as unpacked_hits
from gis_radar.live.store import KnownPose, Store
from gis_radar.live.windows import Windows
from gis_radar.occupancy.hit_counter import CountedFrame
from gis_radar.occupancy.tile_sets import encode_tiles
from gis_radar.occupancy.views import ViewBook
from gis_radar.progress import Reporter
from gis_radar.sight import SightTiles

PRINT = "00112233445566778899aabbccddeeff"
HOUR = 486_111  # since 1970: 2025-06
STREAM = b"abcd"


class Lines(Reporter):
    """A reporter that keeps what it is told."""

    def __init__(self):
        self.lines = []

    def log(self, message, _level="info"):
        self.lines.append(message)


@pytest.fixture(scope="module")
def road():
    return SightTiles.of(gr.make_tiles(gr.read_map(SAMPLE / "junction.osm")))


def counted(time_us, *tiles):
    return CountedFrame(
        time_us=time_us, detections=2, moving=1, wild=0, checksum=5, tiles=np.array(tiles, np.int64)
    )


def row(sensor, time_us, pose=1):
    return FrameRow(sensor, time_us, pose, 1, 1, 0, 5, encode_tiles(np.array([1])))


def pose_content(fingerprint=PRINT, **changes):
    pose = gr.read_pose(SAMPLE / "R1.json").as_dict() | changes
    return PoseContent(pose=pose, since_step=0, fingerprint=fingerprint)


def intake_of(journal, road, *, names=("R1",), reporter=None):
    return Intake(
        names, site="s", book=ViewBook(road=road), journal=journal, windows=Windows(0.2),
        current=MapOfNow(len(road.tile_id), interval=18_000), reporter=reporter or Lines(),
    )  # fmt: skip


def message(kind, number, content, previous=None):
    previous = number - 1 if previous is None else previous
    envelope = Envelope(kind=kind, stream=STREAM, number=number, previous=previous)
    topic = {HITS: "hits", POSE: "pose"}[kind]
    return Received(f"v1/s/R1/{topic}", pack_message(envelope, content), 1.0, retained=False)


def test_frames_of_a_sensor_that_left_the_site_stay_in_the_journal(tmp_path, road):
    store = Store(folder=tmp_path / "o", fingerprint=PRINT, tile_id=np.arange(10), sight="none")
    known = {1: KnownPose(content=pose_content(), view="v")}
    with Journal(tmp_path / "j", fingerprint=PRINT) as journal:
        for name in ("R1", "R2"):
            frames = [row(name, HOUR * HOUR_US + k * 50_000) for k in range(9)]
            journal.add(frames, name, "aa", 1)
        journal.commit()
        store.write_hour(HOUR, journal, known, {"v": np.arange(10)}, ["R1"])
        kept = list(journal.frames("R2", 0, 2**60))
        assert [len(piece) for piece in kept] == [9]
        assert list(journal.frames("R1", 0, 2**60)) == []
        reporter = Lines()
        intake_of(journal, road, reporter=reporter)
        assert any("R2" in line and "no longer names" in line for line in reporter.lines)
        store.write_hour(HOUR, journal, known, {"v": np.arange(10)}, ["R1", "R2"])  # named again
        assert journal.hours() == []
    assert gr.read_occupancy(store.path_of(HOUR)).sensors == ["R1", "R2"]


@pytest.mark.parametrize("times", [(1,), (2**62,), (2**63 - 1, 2**63)])
def test_a_frame_of_no_known_year_is_refused_and_stops_nothing(tmp_path, road, times):
    frames, sound = [counted(each, 1) for each in times], times == (1,)
    content = pack_hits(frames, pose=1, fingerprint=road.fingerprint)
    if not sound:
        with pytest.raises(InputError, match="outside the years"):
            unpacked_hits(content, tiles=10)
    with Journal(tmp_path / "j", fingerprint=road.fingerprint) as journal:
        intake = intake_of(journal, road)
        intake.handle(message(POSE, 1, pose_content(road.fingerprint).pack(), 0))
        intake.handle(message(HITS, 2, content))
        assert intake.sensors["R1"].received == 2  # else it would come again for ever
        assert intake.sensors["R1"].health.counts["damaged"] == (not sound)
        journal.commit()
        for hour in journal.hours():
            Store(folder=tmp_path, fingerprint=PRINT, tile_id=np.arange(1), sight="").path_of(hour)

"""Fusion's intake without a broker: messages of one sensor of the sample."""

import time

import numpy as np
from live_site import SAMPLE

import gis_radar as gr
from gis_radar.live import (
    Envelope,
    FrameDetections,
    Intake,
    MapOfNow,
    PoseContent,
    Received,
    Spool,
    SpoolFile,
    Windows,
    key_of_pose,
    pack_detections,
    pack_message,
    spool_files,
)
from gis_radar.measures import FrameCounter
from gis_radar.scans import SightTiles

STREAM = b"abcd"
ROAD = SightTiles.of(gr.make_tiles(gr.read_map(SAMPLE / "junction.osm")))
NOW_US = int(time.time()) * 1_000_000


def pose_message(fingerprint=None, **changes):
    """Return the pose of R1 as its sensor sends it."""
    pose = gr.read_pose(SAMPLE / "R1.json").as_dict() | changes
    return PoseContent(pose=pose, fingerprint=fingerprint or ROAD.fingerprint).pack()


def frame(time_us, *, x=30.0):
    """Return a frame with a detection on the road."""
    points = np.array([[round(250 * x), 0, round(-250 * 0.06 * x)]])
    return FrameDetections(
        time_us=time_us, points=points, rates=np.array([2500]), rcs_db=np.array([10])
    )


class FedIntake:
    """An intake and its spool, fed message by message."""

    def __init__(self, folder, *, names=("R1",), reporter=None):
        self.folder, self.spool = folder, Spool(folder / "spool")
        files = [SpoolFile(path) for path in spool_files(folder / "spool")]
        given = {} if reporter is None else {"reporter": reporter}
        self.map = MapOfNow(len(ROAD.tile_id))
        self.windows = Windows(0.2)
        self.intake = Intake(
            names, spool=self.spool, road=ROAD,
            counter=FrameCounter(ROAD), windows=self.windows,
            oldest_s=3 * 86_400.0, **given,
        )  # fmt: skip
        self.intake.resume(files)
        self.spool.rotate()
        self.sensor = self.intake.sensors[names[0]]

    @property
    def stored(self):
        return self.spool.mark_of("R1", self.sensor.stream).number

    @property
    def counts(self):
        return self.sensor.health.counts

    def send(self, payload, kind="detections", *, sensor="R1", retained=False):
        topic = f"v1/s/{sensor}/{kind}"
        self.intake.handle(Received(topic, payload, time.time(), retained))

    def pose(self, message=None):
        """Send a pose; return its key."""
        message = message or pose_message()
        self.send(message, "pose")
        return key_of_pose(message)

    def frames(self, number, *frames, key=None, stream=STREAM, first=False):
        """Send frames as a message; return its content."""
        made = frames or (frame(NOW_US + 50_000 * number),)
        content = pack_detections(made, pose=key or key_of_pose(pose_message()))
        envelope = Envelope(stream=stream, number=number, first=first)
        self.send(pack_message(envelope, content))
        return content

    def commit(self):
        """Bring what came to the disk, as fusion does each second."""
        self.spool.collect()
        self.spool.write()

    def spooled(self):
        """Return the records in all files of the spool, without their heads."""
        files = [SpoolFile(path) for path in spool_files(self.folder / "spool")]
        return [record for file in files for _, record in file.records() if record.sensor]

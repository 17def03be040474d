"""Following vehicles is compiled before it begins: it runs once, on the sample's first seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory
from typing import Any

from gis_radar.lanelets.graph import lane_graph
from gis_radar.live.detections import DetectionSelector, pack_detections
from gis_radar.live.first_run import SampleSensor
from gis_radar.live.vehicles.follower import FollowedSite
from gis_radar.live.vehicles.settings import DEFAULTS, FollowSettings
from gis_radar.live.vehicles.store import FollowedPose, VehicleStore
from gis_radar.live.vehicles.worker import EndMessage, FramesMessage, PoseMessage, VehicleWorker
from gis_radar.measures.views import ViewBook
from gis_radar.tracking.map_check import describe_map
from gis_radar.tracking.visibility import SensorView

FRAMES = 100  # 5 s: with so many, vehicles are found


def run_vehicles_once(settings: FollowSettings = DEFAULTS) -> None:
    """Follow a few seconds as the process follows all, in a folder that goes away."""
    sample = SampleSensor()
    pose, name = sample.pose, sample.pose.sensor
    book = ViewBook(road=sample.road)
    view = book.see(pose)
    road_m = book.road_m[name, view]
    seen = SensorView(
        sensor=name, view=view, tile_id=book.tiles[view], position=pose.position
    )  # fmt: skip
    named = FollowedPose(sensor=name, view=view, validity_s=0.1, content=pose.as_dict())
    finder = DetectionSelector(sample.road)
    rows = [
        (name, 1, pack_detections([finder.find(frame, pose, road_m=road_m)], pose=1))
        for frame in sample.frames(FRAMES)
    ]
    inbox: Queue[Any] = Queue()
    inbox.put(PoseMessage(number=1, pose=named, view=seen, road_m=road_m))
    inbox.put(FramesMessage(rows=rows))
    inbox.put(EndMessage())
    with TemporaryDirectory(prefix="gis_radar-") as folder:
        site = FollowedSite(
            sensors=[name], tiles=sample.tiles, fingerprint=sample.road.fingerprint,
            graph=lane_graph(sample.roads.lanelets),
            map=describe_map(sample.map_file, sample.roads, sample.tiles), sight="view only",
            folder=Path(folder),
        )  # fmt: skip
        store = VehicleStore(site.folder / "store", fingerprint=site.fingerprint)
        told_each_time = replace(settings, now_s=0.0)
        VehicleWorker(site, store, inbox, lambda _told: None, told_each_time).run()
        store.close()

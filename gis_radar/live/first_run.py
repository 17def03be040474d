"""What runs often is compiled before a program begins: it runs once, on the sample's first frames.

Later, compiling would hold up the frames that come meanwhile. Where the machine code is kept (see
:func:`gis_radar.base.arrays.compiled`), later starts only load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice
from threading import Event

import geopandas as gpd
import numpy as np

from gis_radar.base import GisRadarError, Reporter, run_unless_stopped
from gis_radar.hdmap import make_tiles, read_map
from gis_radar.live.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.payload import POSE_BYTES
from gis_radar.live.sources import frames_of_recording
from gis_radar.measures import FrameCounter
from gis_radar.poses import Pose, read_pose
from gis_radar.recordings import Detections
from gis_radar.sample import sample_folder
from gis_radar.scans import SightTiles

COMPILING = "compiling what runs often: up to minutes at the first start, seconds at later ones"
NOT_COMPILED = "what runs often is compiled only when it is needed: {}"


def compile_first(work: Callable[[], object], stop: Event, reporter: Reporter) -> None:
    """Run once what is compiled by that, and say so; a stop breaks it off.

    Parameters
    ----------
    work : callable
        One of this module.
    stop : Event
        As of :func:`gis_radar.base.processes.run_unless_stopped`.
    reporter : Reporter
        Receives what is done.
    """
    reporter.log(COMPILING)
    try:
        run_unless_stopped(work, stop)
    except (GisRadarError, OSError) as error:
        reporter.warn(NOT_COMPILED.format(error))


class SampleSensor:
    """A radar of the sample junction with its tiles."""

    def __init__(self) -> None:
        folder = sample_folder()
        self.map_file = folder / "junction.osm"
        self.roads = read_map(self.map_file)
        self.tiles: gpd.GeoDataFrame = make_tiles(self.roads)
        self.road = SightTiles.of(self.tiles)
        self.pose: Pose = read_pose(folder / "R1.json")
        self._recording = folder / "R1.parquet"

    def frames(self, count: int) -> Iterator[Detections]:
        """Yield the first frames of its recording."""
        return islice(frames_of_recording(self._recording), count)


def _first_message(sample: SampleSensor) -> bytes:
    (frame,) = sample.frames(1)
    found = DetectionSelector(sample.road).find(frame, sample.pose, road_m=np.nan)
    return pack_detections([found], pose=bytes(POSE_BYTES))


@cache
def run_sensor_once() -> None:
    """Do with a frame what a sensor's program does with each."""
    _first_message(SampleSensor())


@cache
def run_fusion_once() -> None:
    """Do with a message what fusion does with each."""
    sample = SampleSensor()
    _, (frame,) = unpack_detections(_first_message(sample))
    FrameCounter(sample.road).count(frame.as_rows(), sample.pose)

"""Compile loops before a program starts, by running them once on the sample's first frames.

Later, compiling would delay the frames that arrive meanwhile. Where the machine code is cached (see
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
from gis_radar.live.wire.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.wire.payload import POSE_BYTES
from gis_radar.live.wire.sources import frames_of_recording
from gis_radar.measures import FrameCounter
from gis_radar.poses import Pose, read_pose
from gis_radar.recordings import Detections
from gis_radar.sample import sample_folder
from gis_radar.scans import SightTiles

COMPILING = "compiling what runs often: up to minutes at the first start, seconds at later ones"
NOT_COMPILED = "what runs often is compiled only when it is needed: {}"


def compile_first(work: Callable[[], object], stop: Event, reporter: Reporter) -> None:
    """Run work once, so that its loops are compiled, and log it; a stop interrupts it.

    Parameters
    ----------
    work : callable
        `run_sensor_once` or `run_fusion_once`, or another function to run.
    stop : Event
        As for :func:`gis_radar.base.processes.run_unless_stopped`.
    reporter : Reporter
        Receives the log.
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
    """Process a frame as a sensor's program does."""
    _first_message(SampleSensor())


@cache
def run_fusion_once() -> None:
    """Process a message as fusion does."""
    sample = SampleSensor()
    _, (frame,) = unpack_detections(_first_message(sample))
    FrameCounter(sample.road).count(frame.as_rows(), sample.pose)

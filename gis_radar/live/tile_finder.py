"""The tiles that a sensor's frames hit, and the detections that a tracker needs of them."""

from __future__ import annotations

from gis_radar.live.detections import DetectionSelector, FrameDetections
from gis_radar.measures import Filters
from gis_radar.measures.hit_counter import CountedFrame, FrameCounter
from gis_radar.measures.views import road_near
from gis_radar.poses.pose import Pose
from gis_radar.recordings.recording import Detections
from gis_radar.sight import SightTiles, find_sight
from gis_radar.tiles import TileGrid


class TileFinder:
    """Finds the tiles that frames hit, as `gis-radar hits` does.

    Parameters
    ----------
    road : SightTiles
        All tiles.
    grid : TileGrid
        Of the same tiles.
    filters : Filters
        Which detections count.
    pose : Pose
        Of the sensor.
    """

    def __init__(self, road: SightTiles, grid: TileGrid, filters: Filters, pose: Pose) -> None:
        self.pose = pose
        self._grid = grid
        self._road_m = road_near(find_sight(pose, road), road)
        self._counter = FrameCounter(road, grid=grid, filters=filters)

    def find(self, frame: Detections) -> CountedFrame:
        """Return the tiles that a frame hits."""
        (found,) = self._counter.count(frame, self.pose, road_m=self._road_m)
        return found

    def detections(self, frame: Detections, finder: DetectionSelector) -> FrameDetections:
        """Return what a tracker needs of a frame."""
        return finder.find(frame, self.pose, road_m=self._road_m)

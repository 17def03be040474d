"""The level frame of a pose, and its cells: ahead, left, and the map's height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.pose import Pose

CELL_M = 0.5


@dataclass(frozen=True, kw_only=True)
class Level:
    """A frame that stands under a sensor, looks where it looks, and has the map's heights.

    In it, nothing depends on where on earth a site lies and how it is turned.

    Parameters
    ----------
    pose : Pose
        The sensor.
    """

    pose: Pose

    @property
    def _turn(self) -> Floats:
        yaw = np.radians(self.pose.yaw)
        return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])

    def from_map(self, xyz: Floats) -> Floats:
        """Move (n, 3) points from the map into the frame."""
        return np.column_stack([(xyz[:, :2] - self.pose.position[:2]) @ self._turn, xyz[:, 2]])

    def to_map(self, xyz: Floats) -> Floats:
        """Move (n, 2) or (n, 3) points from the frame into the map."""
        flat = xyz[:, :2] @ self._turn.T + self.pose.position[:2]
        return np.column_stack([flat, xyz[:, 2:]])

    def from_sensor(self, xyz: Floats) -> Floats:
        """Move (n, 3) points from the sensor frame into the frame."""
        return self.from_map(self.pose.to_map(xyz))

    @staticmethod
    def cells(points: Floats, size: int) -> tuple[Integers, Integers]:
        """Return row and column, ahead and left, of points in a grid of `size` cells a side.

        The sensor stands in the grid's middle; points beyond its edge count to the outermost.
        """
        place = np.floor(points[:, :2] / CELL_M).astype(np.int64) + size // 2
        rows, columns = np.clip(place, 0, size - 1).T
        return rows, columns

"""What a registration estimates: the pose, and how high vehicles reflect."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.arrays import Floats

# The order of a step: metres, radians about the map's axes, then how high vehicles reflect.
NAMES = ("easting", "northing", "height", "turn_x", "turn_y", "turn_z", "reflection")
SIZE = len(NAMES)
POSE = slice(0, 6)
TURN = slice(3, 6)
REFLECTION = 6


@dataclass(frozen=True, kw_only=True)
class State:
    """A pose in local coordinates and the reflections' height on vehicles.

    Parameters
    ----------
    position : (3,) array
        Local easting and northing and the height, metres.
    R_map_sensor : (3, 3) array
        Rotation from the sensor frame to the map frame.
    reflection : float
        Mean height of reflections from bumpers, sills and wheels over the road, metres.
    """

    position: Floats
    R_map_sensor: Floats
    reflection: float

    def moved(self, step: Floats) -> State:
        """Return the state after a step in the order of `NAMES`; turns are about the map's axes."""
        return replace(
            self,
            position=self.position + step[:3],
            R_map_sensor=Rotation.from_rotvec(step[TURN]).as_matrix() @ self.R_map_sensor,
            reflection=self.reflection + float(step[REFLECTION]),
        )

    def to_map(self, points: Floats) -> Floats:
        """Move (n, 3) points from the sensor frame to local map coordinates."""
        return np.asarray(points @ self.R_map_sensor.T + self.position)

    @property
    def yaw_pitch_roll(self) -> Floats:
        """Intrinsic Z-Y-X angles, radians."""
        return np.asarray(Rotation.from_matrix(self.R_map_sensor).as_euler("ZYX"))

    def difference(self, other: State) -> Floats:
        """Return the step from another state to this one."""
        turn = Rotation.from_matrix(self.R_map_sensor @ other.R_map_sensor.T).as_rotvec()
        return np.concatenate(
            [self.position - other.position, turn, [self.reflection - other.reflection]]
        )


def angles_from_turn(yaw: float, pitch: float) -> Floats:
    """Return the (3, 3) matrix from a small turn about the map's axes to (roll, pitch, yaw).

    Columns of its inverse are the axes about which roll, pitch and yaw turn, in the map frame:
    `Rz(yaw) Ry(pitch) e_x`, `Rz(yaw) e_y` and `e_z`.
    """
    axes = np.array(
        [
            [np.cos(yaw) * np.cos(pitch), -np.sin(yaw), 0.0],
            [np.sin(yaw) * np.cos(pitch), np.cos(yaw), 0.0],
            [-np.sin(pitch), 0.0, 1.0],
        ]
    )
    return np.asarray(np.linalg.inv(axes))

"""State of a registration: the pose of the sensor, and the mean height of reflections."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from gis_radar.base import Floats

# Order of a step (change of the state): metres, radians about the map's axes, metres.
NAMES = ("easting", "northing", "height", "turn_x", "turn_y", "turn_z", "reflection")
SIZE = len(NAMES)
POSE_PART = slice(0, 6)
TURN = slice(3, 6)
REFLECTION = 6
_SMALL = 1e-12  # smaller angles (radians) take the limit of a formula
LEVER_M = 50.0  # converts turns to metres: the usual distance of traces from the sensor


@dataclass(frozen=True, kw_only=True)
class State:
    """Pose in local coordinates, and mean height of reflections over the road.

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
        """Return the state after a step, (7,) in the order of `NAMES`."""
        return replace(
            self,
            position=self.position + step[:3],
            R_map_sensor=_rotation_matrix(step[TURN]) @ self.R_map_sensor,
            reflection=self.reflection + float(step[REFLECTION]),
        )

    def moved_along_arc(self, step: Floats) -> State:
        """Return the state after a step whose displacement is along an arc (:func:`along_arc`)."""
        x, y = along_arc(step[0], step[1], step[TURN][2])
        return self.moved(np.array([x, y, *step[2:]]))

    def to_heading(self, step: Floats, other: State) -> Floats:
        """Return a step of `other` with its displacement rotated to the yaw of this state."""
        turn = rotation(float(self.yaw_pitch_roll[0] - other.yaw_pitch_roll[0]))
        return np.concatenate([turn @ step[:2], step[2:]])

    def to_map(self, points: Floats) -> Floats:
        """Move (n, 3) points from the sensor frame to local map coordinates."""
        return np.asarray(points @ self.R_map_sensor.T + self.position)

    @property
    def yaw_pitch_roll(self) -> Floats:
        """Intrinsic Z-Y-X angles, radians."""
        return np.asarray(
            scipy.spatial.transform.Rotation.from_matrix(self.R_map_sensor).as_euler("ZYX")
        )

    @property
    def to_angles(self) -> Floats:
        """Jacobian (6, 6) from a step of the pose to one of position, roll, pitch and yaw."""
        yaw, pitch, _ = self.yaw_pitch_roll
        return angles_from_turn(float(yaw), float(pitch))

    def difference(self, other: State) -> Floats:
        """Return the step that moves the other state to this one."""
        turn = _rotation_vector(self.R_map_sensor @ other.R_map_sensor.T)
        return np.concatenate(
            [self.position - other.position, turn, [self.reflection - other.reflection]]
        )


def along_arc(x: Any, y: Any, turn: Any) -> tuple[Any, Any]:
    """Return the displacement of steps along circular arcs (exponential map of SE(2)).

    Parameters
    ----------
    x, y : float or array
        The twist: length of the arc along the axes, in its direction at the start, metres.
    turn : float or array
        Change of yaw along the arc, radians.
    """
    chord, cos, sin = np.sinc(turn / (2.0 * np.pi)), np.cos(turn / 2.0), np.sin(turn / 2.0)
    return chord * (cos * x - sin * y), chord * (sin * x + cos * y)


def from_arc(x: float, y: float, turn: float) -> tuple[float, float]:
    """Return the twist of a displacement along an arc: the inverse of :func:`along_arc`."""
    x, y = along_arc(x, y, -turn)
    chord = float(np.sinc(turn / (2.0 * np.pi))) ** 2
    return x / chord, y / chord


def rotation(angle: float) -> Floats:
    """Return the (2, 2) matrix that turns by an angle, radians, counter-clockwise."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _rotation_matrix(turn: Floats) -> Floats:
    """Return the rotation matrix of a rotation vector, radians (Rodrigues).

    Not by scipy, whose rotations of single vectors would take a tenth of the solver's time.
    """
    x, y, z = turn.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    sine_term = math.sin(angle) / angle if angle > _SMALL else 1.0
    cosine_term = 2.0 * (math.sin(angle / 2.0) / angle) ** 2 if angle > _SMALL else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sine_term * cross + cosine_term * (cross @ cross))


def _rotation_vector(matrix: Floats) -> Floats:
    """Return the rotation vector of a rotation matrix, by its quaternion (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    w = 1.0 + a + e + i
    # the quaternion scaled by each of its components, of which the largest is the most exact
    quaternions = (
        (h - f, c - g, d - b, w),
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
    )
    x, y, z, w = max(quaternions, key=lambda q: q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    sine = math.sqrt(x * x + y * y + z * z)
    sine, w = (sine, w) if w >= 0.0 else (-sine, -w)
    scale = 2.0 * math.atan2(abs(sine), w) / sine if abs(sine) > _SMALL * w else 2.0 / w
    return np.array([x, y, z]) * scale


def angles_from_turn(yaw: float, pitch: float) -> Floats:
    """Return the Jacobian (6, 6) from a step of a pose to one of position, roll, pitch and yaw.

    Its rotational block is the inverse of a matrix whose columns are the axes of roll, pitch and
    yaw in the map frame: `Rz(yaw) Ry(pitch) e_x`, `Rz(yaw) e_y` and `e_z`.
    """
    axes = np.eye(6)
    axes[TURN, TURN] = [
        [np.cos(yaw) * np.cos(pitch), -np.sin(yaw), 0.0],
        [np.sin(yaw) * np.cos(pitch), np.cos(yaw), 0.0],
        [-np.sin(pitch), 0.0, 1.0],
    ]
    return np.asarray(np.linalg.inv(axes))

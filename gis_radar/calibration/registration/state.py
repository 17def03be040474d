"""State of a registration: the pose, and the height at which vehicles reflect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from gis_radar.base import Floats

# Order of a step: metres, radians about the map's axes, height of reflections (m).
NAMES = ("easting", "northing", "height", "turn_x", "turn_y", "turn_z", "reflection")
SIZE = len(NAMES)
POSE = slice(0, 6)
TURN = slice(3, 6)
REFLECTION = 6
SMALL = 1e-12
LEVER_M = 50.0  # a turn counts in metres at this distance, which is that of usual traces


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
            R_map_sensor=_matrix(step[TURN]) @ self.R_map_sensor,
            reflection=self.reflection + float(step[REFLECTION]),
        )

    def moved_along_arc(self, step: Floats) -> State:
        """Return the state after a step whose way across the map turns as the sensor does."""
        x, y = along_arc(step[0], step[1], step[TURN][2])
        return self.moved(np.array([x, y, *step[2:]]))

    def to_heading(self, step: Floats, other: State) -> Floats:
        """Return a step turned by the difference in yaw of this state and another one."""
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
        """The (6, 6) matrix from a step of the pose to one in roll, pitch and yaw."""
        yaw, pitch, _ = self.yaw_pitch_roll
        return angles_from_turn(float(yaw), float(pitch))

    def difference(self, other: State) -> Floats:
        """Return the step from another state to this one."""
        turn = _turn(self.R_map_sensor @ other.R_map_sensor.T)
        return np.concatenate(
            [self.position - other.position, turn, [self.reflection - other.reflection]]
        )


def along_arc(x: Any, y: Any, turn: Any) -> tuple[Any, Any]:
    """Return the displacement of steps along arcs (exponential map of SE(2)).

    Steps with one turn for each metre lie on one circle.

    Parameters
    ----------
    x, y : float or array
        Length of the arc along the axes, by its direction at its start (the twist), metres.
    turn : float or array
        Turn of the sensor on this way, radians.
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


def _matrix(turn: Floats) -> Floats:
    """Return the rotation matrix of a rotation vector (Rodrigues).

    The solver calls this thousands of times: scipy's rotations, made for arrays of them, would take
    a tenth of its time.
    """
    x, y, z = turn.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > SMALL else 1.0
    second = 2.0 * (math.sin(angle / 2.0) / angle) ** 2 if angle > SMALL else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def _turn(matrix: Floats) -> Floats:
    """Return the rotation vector of a rotation matrix, by its quaternion (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    w = 1.0 + a + e + i
    # four times the quaternion times each of its components: the largest component is most exact
    each = (
        (h - f, c - g, d - b, w),
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
    )
    x, y, z, w = max(each, key=lambda q: q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    sine = math.sqrt(x * x + y * y + z * z)
    sine, w = (sine, w) if w >= 0.0 else (-sine, -w)
    scale = 2.0 * math.atan2(abs(sine), w) / sine if abs(sine) > SMALL * w else 2.0 / w
    return np.array([x, y, z]) * scale


def angles_from_turn(yaw: float, pitch: float) -> Floats:
    """Return the (6, 6) matrix from a small step of a pose to one in roll, pitch and yaw.

    Columns of the inverse of its turning part are the axes about which roll, pitch and yaw turn, in
    the map frame: `Rz(yaw) Ry(pitch) e_x`, `Rz(yaw) e_y` and `e_z`.
    """
    axes = np.eye(6)
    axes[TURN, TURN] = [
        [np.cos(yaw) * np.cos(pitch), -np.sin(yaw), 0.0],
        [np.sin(yaw) * np.cos(pitch), np.cos(yaw), 0.0],
        [-np.sin(pitch), 0.0, 1.0],
    ]
    return np.asarray(np.linalg.inv(axes))

"""Kalman filter of a nearly constant pose, with measurements that share a common error.

The paper's Kalman filter ("Localization with ICP", Eqs. 2-7) on the error of the state: metres, and
a rotation vector about the map's axes. An error that all measurements share, such as that of the
map, does not average out; it is a further component of the state that is considered and not
estimated (a Schmidt-Kalman filter). Without it the equations are the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.base import Floats
from gis_radar.calibration.registration.state import LEVER_M, State, angles_from_turn

HOUR_S = 3600.0
CYCLE_S = 5.0  # time between two corrected poses (the paper)
# 1 sigma of easting, northing, height (m) and turns about the map's axes (radians): DRIFT of a mast
# within an hour, by sun and wind; KNOCK, the move of a sensor by a blow after which it still works.
DRIFT = np.array([0.02, 0.02, 0.01, *np.radians([0.1, 0.1, 0.1])])
KNOCK = np.array([0.7, 0.7, 0.4, *np.radians([3.0, 3.0, 4.0])])
LEVER = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of a pose: the paper's state (Eq. 2).

    Parameters
    ----------
    time : float
        UNIX seconds; no later data are used.
    position : (3,) array
        Local easting and northing and the height, metres.
    quaternion : (4,) array
        Rotation sensor -> map as (x, y, z, w), of length one.
    covariance : (6, 6) array
        P, of easting, northing, height and a turn about the map's axes; metres and radians.
    common : (6, 6) array
        Cross-covariance of the estimate's error (truth less estimate) and the common error of all
        measurements, the latter in standard deviations.
    """

    time: float
    position: Floats
    quaternion: Floats
    covariance: Floats
    common: Floats = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def angle_covariance(self) -> Floats:
        """The covariance in the order easting, northing, height, roll, pitch, yaw."""
        return covariance_of_angles(self.quaternion, self.covariance)

    def state(self, reflection_m: float) -> State:
        """Return the pose as a registration's state, with the height of reflections, metres."""
        turn = Rotation.from_quat(self.quaternion).as_matrix()
        return State(position=self.position, R_map_sensor=turn, reflection=reflection_m)


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Measurement of a pose by one window of data: `z = x + v` with `v ~ N(0, R)`.

    Parameters
    ----------
    position, quaternion
        As in :class:`Estimate`.
    covariance : (6, 6) array
        R, in the estimate's coordinates.
    noise : (6, 6) array
        The part of R that is independent in each window; the rest is common to all windows.
    """

    position: Floats
    quaternion: Floats
    covariance: Floats
    noise: Floats

    @property
    def common(self) -> Floats:
        """Change of the measurement by one standard deviation of the common error, (6, 6)."""
        return by_common_error(self.covariance - self.noise)


@dataclass(frozen=True, kw_only=True)
class Innovation:
    """Difference of a measurement and an estimate.

    Parameters
    ----------
    gap : (6,) array
        `z - x`, metres and a turn about the map's axes in radians.
    covariance : (6, 6) array
        Covariance of the gap.
    """

    gap: Floats
    covariance: Floats

    @property
    def chi2(self) -> float:
        """Squared Mahalanobis distance, of six degrees of freedom."""
        return float(self.gap @ np.linalg.solve(self.covariance, self.gap))


def by_common_error(covariance: Floats) -> Floats:
    """Return the symmetric square root (6, 6) of a pose's covariance, scaled by `LEVER`."""
    values, vectors = np.linalg.eigh(LEVER[:, None] * covariance * LEVER)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(root / LEVER[:, None])


def covariance_from_angles(quaternion: Floats, covariance: Floats) -> Floats:
    """Convert a covariance of roll, pitch and yaw to one of a turn about the map's axes."""
    to_turn = np.linalg.inv(_angle_jacobian(quaternion))
    return np.asarray(to_turn @ covariance @ to_turn.T)


def covariance_of_angles(quaternion: Floats, covariance: Floats) -> Floats:
    """Convert a covariance of a turn about the map's axes to one of roll, pitch and yaw."""
    to_angles = _angle_jacobian(quaternion)
    return np.asarray(to_angles @ covariance @ to_angles.T)


def predicted(estimate: Estimate, time: float) -> Estimate:
    """Predict an estimate to a later time: the pose stays, its covariance grows (Eqs. 3, 4).

    Parameters
    ----------
    estimate : Estimate
        The last estimate.
    time : float
        UNIX seconds.
    """
    hours = max(time - estimate.time, 0.0) / HOUR_S
    covariance = estimate.covariance + np.diag(np.square(DRIFT) * hours)
    return replace(estimate, time=time, covariance=covariance)


def innovation(estimate: Estimate, measurement: Measurement) -> Innovation:
    """Return `z - x` and its covariance: `P + R` and the cross terms of the common error."""
    turn = (
        Rotation.from_quat(measurement.quaternion) * Rotation.from_quat(estimate.quaternion).inv()
    )
    cross = estimate.common @ measurement.common.T
    return Innovation(
        gap=np.concatenate([measurement.position - estimate.position, turn.as_rotvec()]),
        covariance=estimate.covariance + cross + cross.T + measurement.covariance,
    )


def likeliest_move(gap: Innovation) -> Floats:
    """Return the likeliest move (6,) given an innovation and the prior of blows, `KNOCK`."""
    prior = np.diag(np.square(KNOCK))
    return np.asarray(prior @ np.linalg.solve(prior + gap.covariance, gap.gap))


def widened(estimate: Estimate, move: Floats) -> Estimate:
    """Widen an estimate so that a move is within one standard deviation.

    Parameters
    ----------
    estimate : Estimate
        The estimate to widen.
    move : (6,) array
        Metres and a turn about the map's axes in radians.
    """
    chi2 = float(move @ np.linalg.solve(estimate.covariance, move))
    if chi2 <= 1.0:
        return estimate
    widening = (1.0 - 1.0 / chi2) * np.outer(move, move)
    return replace(estimate, covariance=estimate.covariance + widening)


def displaced(estimate: Estimate, move: Floats, covariance: Floats) -> Estimate:
    """Move an estimate, and add the covariance of the move.

    Parameters
    ----------
    estimate : Estimate
        The estimate before the move.
    move : (6,) array
        Metres and a turn about the map's axes in radians.
    covariance : (6, 6) array
        Covariance of the move.
    """
    turn = Rotation.from_rotvec(move[3:]) * Rotation.from_quat(estimate.quaternion)
    return replace(
        estimate,
        position=estimate.position + move[:3],
        quaternion=same_sign(np.asarray(turn.as_quat()), estimate.quaternion),
        covariance=estimate.covariance + covariance,
    )


def corrected(estimate: Estimate, measurement: Measurement) -> Estimate:
    """Correct an estimate by a measurement (Eqs. 5-7).

    Parameters
    ----------
    estimate : Estimate
        The estimate predicted to the measurement's time, from data that the measurement does not
        use.
    measurement : Measurement
        The measurement of the pose.
    """
    observed = innovation(estimate, measurement)
    cross = estimate.common @ measurement.common.T
    gain = np.linalg.solve(observed.covariance, (estimate.covariance + cross).T).T  # Eq. 5
    step = gain @ observed.gap
    turn = Rotation.from_rotvec(step[3:]) * Rotation.from_quat(estimate.quaternion)
    keep = np.eye(6) - gain
    covariance = (  # Eq. 7, with the terms of the common error
        keep @ estimate.covariance @ keep.T
        + gain @ measurement.covariance @ gain.T
        - keep @ cross @ gain.T
        - gain @ cross.T @ keep.T
    )
    return replace(
        estimate,
        position=estimate.position + step[:3],  # Eq. 6
        quaternion=same_sign(np.asarray(turn.as_quat()), estimate.quaternion),
        covariance=(covariance + covariance.T) / 2.0,
        common=keep @ estimate.common - gain @ measurement.common,
    )


def same_sign(quaternion: Floats, like: Floats) -> Floats:
    """Normalise a quaternion, with the sign that is nearer to another quaternion."""
    unit = quaternion / np.linalg.norm(quaternion)
    return np.asarray(-unit if unit @ like < 0.0 else unit)


def _angle_jacobian(quaternion: Floats) -> Floats:
    """Return the Jacobian (6, 6) from a turn about the map's axes to roll, pitch and yaw."""
    yaw, pitch, _ = Rotation.from_quat(quaternion).as_euler("ZYX")
    return angles_from_turn(float(yaw), float(pitch))

"""The residuals of a registration, by name, with their derivatives.

Every family is a table of rows `r = r(state) + a b_k`, where `b_k` is what one vehicle adds to all
its rows: the driver's own place in the lane, the height at which this vehicle reflects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.registration.lanes import Lanes
from gis_radar.registration.matching import Matches, directions
from gis_radar.registration.state import HABIT, HALF_WIDTH, REFLECTION, SIZE, TURN, State
from gis_radar.traces import Samples

BEARING = np.radians(0.2)  # 1 sigma of a bearing
ELEVATION = np.radians(0.6)  # 1 sigma of an elevation angle
FACE_M = 0.25  # how sharp a vehicle's side is, and a third of its front
FRONT = (-2.0 / 3.0, 0.0, 2.0 / 3.0)  # thirds of a front or rear, in half widths
LOW_M = 0.25  # how reflections from bumpers, sills and wheels scatter up and down
BODY_OVER_M, BODY_M = 1.0, 0.8  # how much higher, and how widely, the rest of a body reflects
BODY_SHARE = 0.3
VIEW_EDGE = np.radians(1.0)
STRAY_HEIGHT_M = 8.0
DRIVER_M = 0.25  # how drivers differ in their place in the lane
VEHICLE_M = 0.3  # how vehicles differ in the height at which they reflect
STRAY = 0.1  # share of detections that are on no vehicle, over a width of
STRAY_WIDTH_M = 8.0
SIDE_STRENGTH = 1.0  # of a side against a front, both seen straight on
NO_VEHICLE = -np.log(STRAY * np.sqrt(2.0 * np.pi) / STRAY_WIDTH_M)  # loss of a sample off all lanes


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """One family of residuals.

    Parameters
    ----------
    name : str
        What it compares.
    value : (n,) array
        Metres.
    jacobian : (n, 9) array
        By the state, in the order of `gis_radar.registration.state.NAMES`.
    track : (n,) array
        The vehicle of each row.
    shared : float
        Standard deviation of what a vehicle adds to all its rows, metres.
    weight : (n,) array
        Of each row: inverse variance by the chance that the row holds.
    loss : (n,) array
        What each row costs, a negative logarithm of likelihood.
    """

    name: str
    value: Floats
    jacobian: Floats
    track: Integers
    shared: float
    weight: Floats
    loss: Floats


def lateral(
    lanes: Lanes, samples: Samples, matches: Matches, state: State, own: Floats, scale_m: float
) -> Residuals:
    """Compare samples with the centre line of their lane, across it.

    A radar sees the faces of a vehicle that are turned to it: its side, sharp and `half_width`
    nearer than the centre line, its front or rear, evenly about the centre line; or what it sees
    is no vehicle at all. Each sample has a row for the side and one for each third of the front,
    weighted by its chance (expectation maximisation).

    Parameters
    ----------
    lanes, samples, matches, state
        The map, the traces, who lies where, and the pose.
    own : (tracks,) array
        How far each vehicle drives to the left of the lane's centre, metres.
    scale_m : float
        Added to all spreads (root of squares), to widen the basin at first.
    """
    points, arms = _placed(samples, state)
    along = lanes.along[matches.lane]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    off = np.sum((points - lanes.points[matches.lane])[:, :2] * normal, axis=1)
    off -= own[samples.track] + state.habit
    sight = directions(arms[:, :2])
    left, ahead = -np.sum(sight * normal, axis=1), np.abs(np.sum(sight * along, axis=1))
    side = np.abs(left) * SIDE_STRENGTH / (np.abs(left) * SIDE_STRENGTH + ahead)
    faces = np.column_stack([np.sign(left), *(np.full(len(off), at) for at in FRONT)]).T
    share = np.stack([side, *([(1.0 - side) / len(FRONT)] * len(FRONT))]) * matches.found
    noise = np.hypot(BEARING * np.hypot(arms[:, 0], arms[:, 1]) * ahead, scale_m)
    value = off - faces * state.half_width
    sigma = np.broadcast_to(np.hypot(FACE_M, noise), value.shape)
    density = (1.0 - STRAY) * share * np.exp(-0.5 * (value / sigma) ** 2) / sigma
    whole = density.sum(axis=0) + np.exp(-NO_VEHICLE)
    jacobian = np.zeros((len(off), SIZE))
    jacobian[:, :2] = normal
    jacobian[:, TURN] = np.cross(arms, np.pad(normal, ((0, 0), (0, 1))))
    jacobian[:, HABIT] = -1.0
    jacobian = np.tile(jacobian, (len(faces), 1))
    jacobian[:, HALF_WIDTH] = -faces.ravel()
    return Residuals(
        name="lateral",
        value=value.ravel(),
        jacobian=jacobian,
        track=np.tile(samples.track, len(faces)),
        shared=DRIVER_M,
        weight=(density / whole / sigma**2).ravel(),
        loss=-np.log(whole),
    )


def height(
    lanes: Lanes, samples: Samples, matches: Matches, state: State, own: Floats, scale_m: float
) -> Residuals:
    """Compare samples with the scanned road below them plus the height of reflections.

    Parameters
    ----------
    lanes, samples, matches, state
        The map, the traces, who lies where, and the pose.
    own : (tracks,) array
        How much higher than others each vehicle reflects, metres.
    scale_m : float
        Added to the spread (root of squares).
    """
    points, arms = _placed(samples, state)
    lane = matches.lane
    along, slope = lanes.along[lane], lanes.slope[lane]
    off = points - lanes.points[lane]
    value = off[:, 2] - slope * np.sum(off[:, :2] * along, axis=1) - state.reflection
    value = value - own[samples.track]
    plane = np.column_stack([-slope[:, None] * along, np.ones(len(samples))])
    jacobian = np.zeros((len(samples), SIZE))
    jacobian[:, :3] = plane
    jacobian[:, TURN] = np.cross(arms, plane)
    jacobian[:, REFLECTION] = -1.0
    value = np.concatenate([value, value - BODY_OVER_M])
    noise = np.hypot(ELEVATION * np.linalg.norm(arms, axis=1), scale_m)
    sigma = np.hypot(np.repeat([LOW_M, BODY_M], len(off)), np.tile(noise, 2))
    valid = matches.found & np.isfinite(off[:, 2]) & _in_view(samples, arms, off[:, 2])
    value = np.nan_to_num(value)
    share = np.repeat([1.0 - BODY_SHARE, BODY_SHARE], len(off))
    density = (1.0 - STRAY) * share * np.exp(-0.5 * (value / sigma) ** 2) / sigma
    whole = density.reshape(2, -1).sum(axis=0) + STRAY * np.sqrt(2.0 * np.pi) / STRAY_HEIGHT_M
    return Residuals(
        name="height",
        value=value,
        jacobian=np.tile(jacobian, (2, 1)),
        track=np.tile(samples.track, 2),
        shared=VEHICLE_M,
        weight=density / np.tile(whole, 2) / sigma**2 * np.tile(valid, 2),
        loss=np.where(valid, -np.log(whole), 0.0),
    )


def _in_view(samples: Samples, arms: Floats, over_m: Floats) -> Booleans:
    """Tell where the road itself would be in view: below it only the tall are seen."""
    flat = np.hypot(arms[:, 0], arms[:, 1])
    lower = np.arctan2(arms[:, 2] - np.nan_to_num(over_m), flat) - np.arctan2(arms[:, 2], flat)
    x, y, z = samples.points.T
    angle = np.abs(np.arctan2(z, np.hypot(x, y)) + np.sign(z) * np.abs(lower))
    return np.asarray(angle < samples.elevation - VIEW_EDGE)


def _placed(samples: Samples, state: State) -> tuple[Floats, Floats]:
    """Return the samples in the map, and as seen from the sensor in the map's axes."""
    arms = samples.points @ state.R_map_sensor.T
    return arms + state.position, arms

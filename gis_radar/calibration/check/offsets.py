"""How far, and to which side, a given pose is off the one that the traffic shows.

A cause of a fault is named only if nothing is off once what it says is corrected (:func:`fits_if`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.base import Text
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.check.fitted_pose import (
    FittedPose,
    fit_pose,
    mistakes_apart,
    single_mistakes,
)
from gis_radar.calibration.check.rivals import LaneMap, Rival
from gis_radar.calibration.findings import sense, side
from gis_radar.calibration.monitoring.kalman_filter import Measurement, covariance_of_angles
from gis_radar.calibration.registration.state import State
from gis_radar.poses import Pose

# A pose is doubted if it is farther off than maps, drivers' habits and a careful survey together
# (metres; degrees of yaw, pitch, roll; standard errors), and refused if it is TOO_FAR times as far
# off, and FAR_SIGMAS, as standard errors assume usual habits of drivers.
OFF_M, OFF_DEG, OFF_SIGMAS = 0.7, (0.7, 1.5, 2.5), 3.0
TOO_FAR, FAR_SIGMAS = 2.0, 5.0
# A pose fits only if the traffic would show an error larger than this (metres; degrees of yaw,
# pitch, roll): a third of a lane's width, here or 60 m ahead, and tilts that would be refused.
SHOWS_M, SHOWS_DEG = 1.0, (1.0, TOO_FAR * OFF_DEG[1], TOO_FAR * OFF_DEG[2])
LIKELY = 2.0  # standard errors by which a pose may be farther off than it is measured to be
FARTHEST_M, FARTHEST_DEG = 20.0, 20.0  # farther off is another place, turned farther other lanes
TURNS = ("yaw", "pitch", "roll")


@dataclass(frozen=True, kw_only=True)
class Off:
    """How far a pose is off, and what to set.

    Parameters
    ----------
    amount, sigma : float
        How far it is off and one standard error, metres or degrees.
    least : float
        Largest error of a pose that is not doubted.
    text, right : Text
        How the sensor would have to be moved, with the error, and the right value, for a message.
    """

    amount: float
    sigma: float
    least: float
    text: Text
    right: Text

    @property
    def far(self) -> bool:
        """Whether it is off for sure."""
        return self.amount > max(self.least, OFF_SIGMAS * self.sigma)

    @property
    def too_far(self) -> bool:
        """Whether the pose is refused."""
        return self.far and self.amount > max(TOO_FAR * self.least, FAR_SIGMAS * self.sigma)


def offs_of(pose: Pose, seen: Measurement, centre: State) -> list[Off]:
    """Return how far a pose is off in place, yaw, pitch and roll.

    Parameters
    ----------
    pose : Pose
        As given.
    seen : Measurement
        The pose by the traffic, in local coordinates.
    centre : State
        The given pose in these.
    """
    off_m, sigma_m = _aside(seen, centre)
    east, north = (seen.position - centre.position)[:2].tolist()
    text = Text(
        "{:.2f} \u00b1 {:.2f} m away: {:.2f} m to the {} and {:.2f} m to the {}",
        off_m, sigma_m, abs(east), side(east, 0.0), abs(north), side(0.0, north),
    )  # fmt: skip
    right = Text("easting {:.2f}, northing {:.2f}", pose.easting + east, pose.northing + north)
    offs = [Off(amount=off_m, sigma=sigma_m, least=OFF_M, text=text, right=right)]
    for k, (turn, sigma) in enumerate(turns_of(pose, seen)):
        text = _turned(TURNS[k], turn, sigma)
        angle = (getattr(pose, TURNS[k]) + turn + 180.0) % 360.0 - 180.0
        right = Text("{} {:.2f} deg", TURNS[k], angle)
        offs.append(Off(amount=abs(turn), sigma=sigma, least=OFF_DEG[k], text=text, right=right))
    return offs


def _turned(name: str, turn: float, sigma: float) -> Text:
    """Return how the sensor would have to be turned, as somebody sees it who stands there."""
    amount = abs(turn), sigma
    if name == "pitch":
        way = Text("down") if turn > 0.0 else Text("up")
        return Text("tilted {:.2f} \u00b1 {:.2f} deg {}", *amount, way)
    if name == "roll":
        return Text("rolled {:.2f} \u00b1 {:.2f} deg {}, seen from behind", *amount, sense(-turn))
    return Text("turned {:.2f} \u00b1 {:.2f} deg {}, seen from above", *amount, sense(turn))


def discrepancy(fitted: FittedPose) -> list[Off]:
    """Return by what a given pose is off, by the likeliest mistake; nothing where it is right.

    Parameters
    ----------
    fitted : FittedPose
        Of the sensor.
    """
    mistakes = single_mistakes(fitted.seen, fitted.centre)
    ways = (offs_of(fitted.pose, each, fitted.centre) for each in mistakes)
    far = ([each for each in offs if each.far] for offs in ways)
    return next(filter(None, far), [])


def hidden(pose: Pose, seen: Measurement, centre: State) -> list[Text]:
    """Return what of a pose may be off so far that it should show, and does not.

    Parameters
    ----------
    pose, seen, centre
        As for :func:`offs_of`.
    """
    of_place, of_yaw = (each for each, _ in mistakes_apart(seen, centre))
    off_m, sigma_m = _aside(of_place, centre)
    values, axes = np.linalg.eigh(of_place.covariance[:2, :2])
    widest_m, axis = OFF_SIGMAS * float(np.sqrt(values[-1])), axes[:, -1]
    most_m = off_m + LIKELY * sigma_m
    if most_m > widest_m:
        axis = (of_place.position - centre.position)[:2]
    found = []
    if max(widest_m, most_m) > SHOWS_M:
        sides = side(*axis), side(*-axis)
        shown_m = min(max(widest_m, most_m), FARTHEST_M)
        found.append(Text("{:.1f} m to the {} or {}", shown_m, *sides))
    turns = turns_of(pose, of_yaw)
    for name, (turn, sigma), least in zip(TURNS, turns, SHOWS_DEG, strict=True):
        most_deg = max(OFF_SIGMAS * sigma, abs(turn) + LIKELY * sigma)
        if most_deg > least:
            found.append(Text("{:.1f} deg of {}", min(most_deg, FARTHEST_DEG), name))
    return found


def _aside(seen: Measurement, centre: State) -> tuple[float, float]:
    """Return the distance in the plane of a measured pose from a place, and its error, metres.

    Distance over error is that of the covariance in the plane (Mahalanobis).
    """
    gap, spread = (seen.position - centre.position)[:2], seen.covariance[:2, :2]
    off_m = float(np.hypot(*gap))
    return off_m, off_m / max(float(np.sqrt(gap @ np.linalg.solve(spread, gap))), 1e-9)


def turns_of(pose: Pose, seen: Measurement) -> list[tuple[float, float]]:
    """Return the turns from a pose to a measured one, of yaw, pitch and roll, with errors, degrees.

    Parameters
    ----------
    pose : Pose
        As given.
    seen : Measurement
        The pose by the traffic.
    """
    angles = Rotation.from_quat(seen.quaternion).as_euler("ZYX", degrees=True)
    spread = covariance_of_angles(seen.quaternion, seen.covariance)
    sigmas = np.degrees(np.sqrt(np.diag(spread)[5:2:-1]))
    turns = [
        (a - getattr(pose, n) + 180.0) % 360.0 - 180.0 for a, n in zip(angles, TURNS, strict=True)
    ]
    return list(zip(turns, sigmas.tolist(), strict=True))


def fits_if(excerpt: Excerpt, lanes: LaneMap, mistake: Rival) -> bool:
    """Return whether the traffic fits pose and map once a mistake is corrected.

    A pose that a search found is only a place from which one is to be found: there the traffic must
    fit some pose.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    mistake : Rival
        The mistake.
    """
    if mistake.signless:
        return True  # which sign each range rate had is not known
    fitted = fit_pose(corrected(excerpt, mistake), lanes)
    return fitted is not None and (mistake.searched or not discrepancy(fitted))


def corrected(excerpt: Excerpt, mistake: Rival) -> Excerpt:
    """Return an excerpt as it would be without a mistake.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    mistake : Rival
        The mistake.
    """
    points, sign = mistake.points, -1.0 if mistake.against else 1.0
    moving = excerpt.moving
    return replace(
        excerpt, points=points(excerpt.points), range_rate=sign * excerpt.range_rate,
        moving=replace(
            moving, points=points(moving.points), range_rate=sign * moving.range_rate
        ),
        poses=tuple(map(mistake.turned, excerpt.poses)),
    )  # fmt: skip

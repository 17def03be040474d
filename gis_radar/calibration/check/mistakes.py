"""Mistakes that would explain a sensor's traffic, and how its input has to be changed back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gis_radar.base import Floats, Text, yaw_from_compass
from gis_radar.calibration.check.evidence import MEAN_REFLECTION_M, LaneMap, Score, score
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.findings import Cause, sense, side
from gis_radar.calibration.registration.hypotheses import find_hypotheses, mirrored
from gis_radar.calibration.registration.lanes import Scene
from gis_radar.calibration.registration.traces import thin
from gis_radar.calibration.unit_mistakes import ABSOLUTE, FEET, SIGN, USUAL_MISTAKES, YARDS
from gis_radar.poses import ANGLES, Pose

# Searched poses that differ by less are equal (metres; degrees of yaw, pitch, roll).
_SAME_PLACE_M, _SAME_DEG = 2.0, (2.0, 3.0, 5.0)
# A pose with a single mistake has either place or yaw right, up to these errors of the search.
_ONE_MISTAKE_M, _ONE_MISTAKE_DEG = 3.0, 3.0
_CHANGE_SIGN = "change the sign of {} of all detections"
_STEP_DEG, _NEAR_DEG = 10.0, 20.0  # of tried yaws: step, and least distance from the given yaw
XYZ = (1, 2, 3)  # axes of a right recording
_FARTHEST_M = 20.0  # the search finds poses up to 15 m off; farther off is another place
_TILTED_DEG = 10.0  # of roll or pitch: at a wrong place the search is off by 4 deg
SEARCHED = 3  # number of likeliest poses taken from a search
_DATUM_M = 10.0  # larger errors of a height may be of its datum


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """A mistake that would explain a sensor's traffic, and how to correct it.

    Parameters
    ----------
    causes : tuple of Cause
        What it may be, for a message; several if all are corrected alike, empty for no mistake.
    pose : callable
        Function that corrects a pose: from the given one to the one without the mistake.
    axes : tuple of int
        Which of the recording's columns (1, 2, 3 for x, y, z) are x forward, y left, z up;
        negative where the sign is changed.
    scale : float
        Factor by which recorded positions are too long.
    backwards : bool
        Whether range rates and the direction of the map's lanes contradict each other.
    signless : bool
        Whether range rates have lost their sign.
    fitted : int
        Number of parameters fitted to the traffic; 0 for a mistake of known size.
    """

    causes: tuple[Cause, ...] = ()
    pose: Callable[[Pose], Pose] = lambda pose: pose
    axes: tuple[int, ...] = XYZ
    scale: float = 1.0
    backwards: bool = False
    signless: bool = False
    fitted: int = 0

    @property
    def searched(self) -> bool:
        """Whether its pose comes from a search, so that all its components are fitted."""
        return self.fitted > 1

    def corrected(self, excerpt: Excerpt) -> Excerpt:
        """Return an excerpt as it would be without the mistake, up to lost signs of range rates."""
        axes, sign = np.array(self.axes), -1.0 if self.backwards else 1.0

        def points(recorded: Floats) -> Floats:
            return np.asarray(recorded[:, np.abs(axes) - 1] * np.sign(axes) / self.scale)

        moving = replace(
            excerpt.moving, points=points(excerpt.moving.points),
            range_rate=sign * excerpt.moving.range_rate,
        )  # fmt: skip
        return replace(
            excerpt, points=points(excerpt.points), range_rate=sign * excerpt.range_rate,
            moving=moving, poses=tuple(map(self.pose, excerpt.poses)),
        )  # fmt: skip

    def score(self, excerpt: Excerpt, lanes: LaneMap) -> Score:
        """Score how well the traffic fits the lanes once the mistake is corrected."""
        return score(self.corrected(excerpt), lanes, signless=self.signless)

    def off(self, pose: Pose) -> tuple[float, float]:
        """Return by how much it has put a pose off: metres in the plane, degrees of yaw."""
        actual = self.pose(pose)
        turn = within_half_turn(actual.yaw - pose.yaw)
        return float(np.hypot(*(actual.position - pose.position)[:2])), turn

    def is_twofold(self, pose: Pose) -> bool:
        """Return whether a searched mistake is more than one, of axes, place and yaw of a pose."""
        off_m, turn = self.off(pose)
        wrong = self.axes != XYZ, off_m > _ONE_MISTAKE_M, abs(turn) > _ONE_MISTAKE_DEG
        return self.searched and sum(wrong) > 1

    def is_equivalent(self, other: Mistake, pose: Pose) -> bool:
        """Return whether two mistakes are corrected alike, up to the error of a search.

        All searched poses with the given yaw are alike, as traffic of one street does not fix the
        place along it.
        """
        mine, others = self.pose(pose), other.pose(pose)
        turns = [
            abs(within_half_turn(getattr(mine, name) - getattr(others, name))) < least
            for name, least in zip(ANGLES, _SAME_DEG, strict=True)
        ]
        alike = all(getattr(self, n) == getattr(other, n) for n in ("axes", "backwards", "scale"))
        apart_m = float(np.linalg.norm(mine.position - others.position))
        same_yaw = all(m.searched and abs(m.off(pose)[1]) < _ONE_MISTAKE_DEG for m in (self, other))
        return alike and ((apart_m < _SAME_PLACE_M and all(turns)) or same_yaw)

    def by(self, pose: Pose, there: Pose) -> Mistake:
        """Return this mistake with a pose, too; every one is off as `pose` is from `there`."""
        names = ("easting", "northing", "height", "yaw", "pitch", "roll")
        step = {name: getattr(there, name) - getattr(pose, name) for name in names}
        return replace(
            self, pose=lambda p: replace(p, **{n: getattr(p, n) + step[n] for n in names})
        )


NO_MISTAKE = Mistake()
AGAINST = Cause(
    Text("traffic runs against the lanes"),
    Text("the map's left and right bounds are swapped: turn its lanes"),
)
SIGNLESS = Mistake(causes=(ABSOLUTE,), signless=True)


def _of_axes(looks: Text, advice: Text, *axes: int) -> Mistake:
    return Mistake(causes=(Cause(looks, advice),), axes=axes)


MIRRORED = _of_axes(
    Text("left and right are swapped, in the recording or in the map"),
    Text("change the sign of y of all detections, or mirror the map"), 1, -2, 3,
)  # fmt: skip
_AXES_IN_PLANE = (  # mistakes of axes that are found from x and y alone
    _of_axes(Text("x and y are swapped"), Text("swap x and y"), 2, 1, 3),
    _of_axes(
        Text("x points to the right and y forward"),
        Text("turn the axes: x forward, y to the left"), 2, -1, 3,
    ),
    _of_axes(Text("x points backward"), Text(_CHANGE_SIGN, "x"), -1, 2, 3),
    MIRRORED,
)  # fmt: skip
_AXES_WITH_Z = (  # mistakes of axes that need elevations
    _of_axes(Text("z points down"), Text(_CHANGE_SIGN, "z"), 1, 2, -3),
    _of_axes(Text("y and z are swapped"), Text("swap y and z"), 1, 3, 2),
)


def of_angle(
    name: str, looks: Text, pose: Pose, right: Callable[[float], Any], fitted: int = 0
) -> Mistake:
    """Return the mistake that an angle of a pose is off.

    Parameters
    ----------
    name : str
        `yaw`, `pitch` or `roll`.
    looks : Text
        The mistake, for a message.
    pose : Pose
        The pose for which the advice gives the right value.
    right : callable
        Right value of a given one, degrees.
    fitted : int
        As of :class:`Mistake`.
    """
    advice = Text("set {} to {:.1f} deg", name, within_half_turn(right(getattr(pose, name))))
    return Mistake(
        causes=(Cause(looks, advice),), fitted=fitted,
        pose=lambda p: replace(p, **{name: right(getattr(p, name))}),
    )  # fmt: skip


def within_half_turn(angle: float) -> float:
    """Return an angle wrapped to -180 to 180 degrees."""
    return (angle + 180.0) % 360.0 - 180.0


def usual_mistakes(
    excerpt: Excerpt, others: Mapping[str, Pose], *, units_known: bool
) -> list[Mistake]:
    """Return usual mistakes, among them the poses of the site's other sensors.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    others : mapping of str to Pose
        The poses of other sensors of the site.
    units_known : bool
        Whether the range rates show that the units, and their sign, are right.
    """
    pose = excerpt.usual
    compass = yaw_from_compass(pose.yaw, pose.crs, pose.easting, pose.northing)
    turn = within_half_turn(pose.roll + 180.0)
    rolled = Cause(
        Text("roll is off by 180 deg, or y points to the right and z down"),
        Text("set roll to {:.1f} deg, or change the signs of y and z", turn),
    )
    against = (AGAINST,) if units_known else (AGAINST, SIGN)
    mistakes = [
        of_angle("yaw", Text("yaw is off by 180 deg"), pose, lambda yaw: yaw + 180.0),
        of_angle("yaw", Text("its yaw is a bearing from true north"), pose,
                 lambda yaw: yaw + compass - pose.yaw),
        of_angle("yaw", Text("its yaw is a bearing from grid north"), pose, lambda yaw: 90.0 - yaw),
        of_angle("yaw", Text("its yaw counts clockwise"), pose, lambda yaw: -yaw),
        *_AXES_IN_PLANE,
        Mistake(causes=against, backwards=True),
    ]  # fmt: skip
    if np.isfinite(excerpt.points[:, 2]).any():
        mistakes += [
            of_angle("pitch", Text("pitch has the wrong sign"), pose, lambda pitch: -pitch),
            of_angle("roll", Text("roll has the wrong sign"), pose, lambda roll: -roll),
            *_AXES_WITH_Z,
            Mistake(causes=(rolled,), pose=lambda p: replace(p, roll=p.roll + 180.0)),
        ]
    mistakes += [SIGNLESS] if excerpt.one_sign else []
    if not units_known:
        mistakes += [Mistake(causes=(c,), scale=USUAL_MISTAKES[c]) for c in (FEET, YARDS)]
    return mistakes + [_of_another(name, other) for name, other in others.items()]


def _of_another(name: str, other: Pose) -> Mistake:
    """Return the mistake that the recording is of another sensor of the site."""
    cause = Cause(
        Text("recording and pose are mixed up: the recording fits the pose of {}", name),
        Text("give this recording with the pose of {}", name),
    )
    return Mistake(causes=(cause,), pose=lambda _: other)


def other_yaws(pose: Pose) -> Iterator[Mistake]:
    """Yield the pose with yaws all around the circle: they explain traffic by chance only."""
    for turn in np.arange(_NEAR_DEG, 360.0 - _NEAR_DEG + 0.1, _STEP_DEG).tolist():
        yield NO_MISTAKE.by(pose, replace(pose, yaw=pose.yaw + turn))


def search_poses(excerpt: Excerpt, lanes: LaneMap) -> list[Mistake]:
    """Return other poses that a search finds as mistakes, also with left and right swapped.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    """
    pose = excerpt.usual
    near = lanes.around(pose, excerpt.reach_m)
    if near is None or not np.isfinite(excerpt.moving.points).all():
        return []
    scene = Scene(lanes=near, samples=thin(*excerpt.as_usual))
    found = []
    variants = (NO_MISTAKE, scene), (MIRRORED, scene.of(mirrored(scene.samples)))
    for recorded, seen in variants:
        for hypothesis in find_hypotheses(seen, heading=None)[:SEARCHED]:
            state = hypothesis.fit.state
            if np.hypot(*state.position[:2]) > _FARTHEST_M:
                continue
            place = (state.position + np.append(near.origin, 0.0)).tolist()
            angles = np.degrees(state.yaw_pitch_roll).tolist()
            there = dict(zip(("easting", "northing", "height"), place, strict=True))
            turn = dict(zip(("yaw", "pitch", "roll"), angles, strict=True))
            # the place along a street is not fixed: one mistake may explain as much as two
            for change in ({"yaw": turn["yaw"]}, there, there | turn):
                other = replace(pose, **change)
                is_mirrored = recorded is MIRRORED
                found.append(MIRRORED.by(pose, other) if is_mirrored else other_pose(pose, other))
    return [replace(each, fitted=6) for each in found]


def other_pose(pose: Pose, there: Pose) -> Mistake:
    """Return the mistake that a sensor with the given pose `pose` has the pose `there`."""
    mistake = NO_MISTAKE.by(pose, there)
    off_m, turn = mistake.off(pose)
    is_away, is_turned = off_m > _ONE_MISTAKE_M, abs(turn) > _ONE_MISTAKE_DEG
    tilt = max(abs(there.pitch - pose.pitch), abs(within_half_turn(there.roll - pose.roll)))
    parts = []
    if is_away:
        to = side(*(there.position - pose.position)[:2])
        parts.append(Text("{:.1f} m to the {}", off_m, to))
    if is_turned or not (is_away or tilt > _TILTED_DEG):
        way = sense(turn)
        parts.append(Text("turned {:.1f} deg {}, seen from above", abs(turn), way))
    if tilt > _TILTED_DEG:
        parts.append(Text("tilted by {:.0f} deg", tilt))
    cause = Cause(
        Text("its pose is off: compared with it, the sensor is {}", Text(", ").join(parts)),
        Text(
            "find it with gis-radar localize, near easting {:.1f}, northing {:.1f}, yaw {:.1f} deg",
            there.easting, there.northing, there.yaw,
        ),
    )  # fmt: skip
    return replace(mistake, causes=(cause,))


def of_height(excerpt: Excerpt, given: Score) -> list[Mistake]:
    """Return mistakes of height or pitch, estimated from heights over the road.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    given : Score
        Score of the given pose, without heights in the likelihood.
    """
    ahead = excerpt.points[:, 0]
    known = np.isfinite(given.height_over_m) & (ahead > 1.0)
    if not known.any():
        return []
    over_m = given.height_over_m[known] - MEAN_REFLECTION_M
    high_m, tilt = float(np.median(over_m)), float(np.degrees(np.median(over_m / ahead[known])))
    height = Text("height is {:.1f} m too high", high_m)
    if high_m < 0.0:
        height = Text("height is {:.1f} m too low", -high_m)
    if abs(high_m) > _DATUM_M:
        height = Text("{}: is it of another vertical datum, as over the ellipsoid?", height)
    pitch = Text("pitch is {:.1f} deg too low: the sensor looks farther down", tilt)
    if tilt < 0.0:
        pitch = Text("pitch is {:.1f} deg too high: the sensor looks farther up", -tilt)
    pose = excerpt.usual
    advice = Text("set height to {:.1f} m", pose.height - high_m)
    return [
        Mistake(
            causes=(Cause(height, advice),), fitted=1,
            pose=lambda p: replace(p, height=p.height - high_m),
        ),
        of_angle("pitch", pitch, pose, lambda angle: angle + tilt, fitted=1),
    ]  # fmt: skip

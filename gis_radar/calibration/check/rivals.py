"""Rival explanations of a sensor's traffic, and scores of how well they fit the lanes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import geopandas as gpd
import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, NoAnswerError, Text, yaw_from_compass
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.findings import sense, side
from gis_radar.calibration.registration.certainty import z_score
from gis_radar.calibration.registration.hypotheses import find_hypotheses, mirrored
from gis_radar.calibration.registration.lanes import (
    LANE_STEP_M,
    MARGIN_M,
    Lanes,
    Scene,
    sample_lanes,
)
from gis_radar.calibration.registration.matches import match_along
from gis_radar.calibration.registration.traces import thin
from gis_radar.calibration.unit_mistakes import ABSOLUTE, UnitMistake
from gis_radar.poses import Pose

# Mixture of the likelihood. On a lane: uniform over its width, with edges blurred by the errors of
# poses, maps and bearings (1 sigma: metres, and share of the range).
EDGE_M, EDGE_SHARE = 0.5, 0.01
OTHERS = 0.1  # share of detections that are of anything else than vehicles on lanes
AREA_M = 8.0  # width and height over which those are uniform
# Height over the road of reflections: mean, 1 sigma, 1 sigma of elevation as a share of the range.
REFLECTION_M, HEIGHT_M, HEIGHT_SHARE = 0.7, 1.0, 0.012
FARTHEST_M = 20.0  # the search finds poses up to 15 m off; farther off is another place
SAME_M = 0.3  # poses so near to each other, as those of a pose track, share sampled lanes
MOST_CACHED = 4  # places whose lanes are held in memory, 25 MB each
# Searched poses that differ by less are equal (metres; degrees of yaw, pitch, roll).
SAME_PLACE_M, SAME_DEG, TURNS = 2.0, (2.0, 3.0, 5.0), ("yaw", "pitch", "roll")
# A pose with a single mistake has either place or yaw right, up to these errors of the search.
ONE_MISTAKE_M, ONE_MISTAKE_DEG = 3.0, 3.0
TILTED_DEG = 10.0  # of roll or pitch: at a wrong place the search is off by 4 deg
SEARCHED = 3  # number of likeliest poses taken from a search
DATUM_M = 10.0  # larger errors of a height may be of its datum
CHANGE_SIGN = "change the sign of {} of all detections"
STEP_DEG, NEAR_DEG = 10.0, 20.0  # of tried yaws: step, and least distance from the given yaw


class Axes(Enum):
    """Which columns of a recording are x forward, y left, z up, and with which signs."""

    GIVEN = (0, 1, 2), (1.0, 1.0, 1.0)
    MIRRORED = (0, 1, 2), (1.0, -1.0, 1.0)
    SWAPPED = (1, 0, 2), (1.0, 1.0, 1.0)
    AHEAD = (1, 0, 2), (1.0, -1.0, 1.0)
    BACK = (0, 1, 2), (-1.0, 1.0, 1.0)
    DOWN = (0, 1, 2), (1.0, 1.0, -1.0)
    UPRIGHT = (0, 2, 1), (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Rival:
    """Explanation of a sensor's traffic by a mistake, compared with that by the given pose.

    Parameters
    ----------
    cause : str
        The mistake, for a message; empty for the given pose.
    advice : str
        How to correct the mistake.
    turned : callable
        Function that corrects a pose: from the given one to the one without the mistake.
    axes : Axes
        Columns and signs of the recording that are x forward, y left, z up.
    against : bool
        Whether vehicles drive against the direction of the map's lanes.
    heights : bool
        Whether the likelihood uses heights over the road.
    scale : float
        Factor by which recorded positions are too long.
    signless : bool
        Whether range rates have lost their sign.
    fitted : int
        Number of parameters fitted to the traffic; 0 for a mistake of known size.
    """

    cause: str = ""
    advice: str = ""
    turned: Callable[[Pose], Pose] = lambda pose: pose
    axes: Axes = Axes.GIVEN
    against: bool = False
    heights: bool = True
    scale: float = 1.0
    signless: bool = False
    fitted: int = 0

    @property
    def searched(self) -> bool:
        """Whether its pose comes from a search, so that all its components are fitted."""
        return self.fitted > 1

    def points(self, recorded: Floats) -> Floats:
        """Return recorded points, corrected: x forward, y left, z up, metres."""
        order, signs = self.axes.value
        return np.asarray(recorded[:, order] * np.array(signs) / self.scale)

    def off(self, pose: Pose) -> tuple[float, float]:
        """Return by how much this explanation corrects a pose: metres in the plane, deg of yaw."""
        actual = self.turned(pose)
        turn = _within_half_turn(actual.yaw - pose.yaw)
        return float(np.hypot(*(actual.position - pose.position)[:2])), turn

    def assumes_two_mistakes(self, pose: Pose) -> bool:
        """Return whether a searched explanation corrects more than one of axes, place and yaw."""
        off_m, turn = self.off(pose)
        wrong = self.axes is not Axes.GIVEN, off_m > ONE_MISTAKE_M, abs(turn) > ONE_MISTAKE_DEG
        return self.searched and sum(wrong) > 1

    def is_equivalent(self, other: Rival, pose: Pose) -> bool:
        """Return whether two explanations correct a pose alike, up to the error of a search.

        All searched poses with the given yaw are alike, as traffic of one street does not fix the
        place along it.
        """
        mine, others = self.turned(pose), other.turned(pose)
        turns = [
            abs(_within_half_turn(getattr(mine, name) - getattr(others, name))) < least
            for name, least in zip(TURNS, SAME_DEG, strict=True)
        ]
        alike = (self.axes, self.against, self.scale) == (other.axes, other.against, other.scale)
        apart_m = float(np.linalg.norm(mine.position - others.position))
        same_yaw = all(r.searched and abs(r.off(pose)[1]) < ONE_MISTAKE_DEG for r in (self, other))
        return alike and ((apart_m < SAME_PLACE_M and all(turns)) or same_yaw)

    def by(self, pose: Pose, there: Pose) -> Rival:
        """Return this explanation; it corrects every pose by what `pose` differs from `there`."""
        names = ("easting", "northing", "height", "yaw", "pitch", "roll")
        step = {name: getattr(there, name) - getattr(pose, name) for name in names}
        return replace(
            self, turned=lambda p: replace(p, **{n: getattr(p, n) + step[n] for n in names})
        )


GIVEN = Rival()
AGAINST = Rival(
    cause=Text("traffic runs against the lanes"),
    advice=Text("the map's left and right bounds are swapped: turn its lanes"),
    against=True,
)
MIRRORED = Rival(
    cause=Text("left and right are swapped, in the recording or in the map"),
    advice=Text("change the sign of y of all detections, or mirror the map"),
    axes=Axes.MIRRORED,
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score of how well an explanation fits the lanes.

    Parameters
    ----------
    log_likelihood : (v,) array
        Mean log likelihood of the detections of each vehicle.
    on_lane : (v,) array
        Share of each vehicle's detections that are likelier on a lane than elsewhere.
    height_over_m : (n,) array
        Height of each detection over its lane, metres; NaN off the lanes or without elevation.
    """

    log_likelihood: Floats
    on_lane: Floats
    height_over_m: Floats

    @property
    def driving(self) -> Booleans:
        """Which vehicles drive along lanes: with most of their detections on them."""
        return self.on_lane > 0.5

    @property
    def share(self) -> float:
        """Share of the vehicles that drive along lanes."""
        return float(self.driving.mean()) if len(self.on_lane) else 0.0

    def z_score_over(self, other: Score) -> float:
        """Return the z score of the vehicles' log likelihoods, this explanation less the other."""
        return z_score(self.log_likelihood - other.log_likelihood)


@dataclass(frozen=True, kw_only=True)
class LaneMap:
    """Lanes of a site, sampled around a sensor on first use and cached.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.
    road : (n, 3) array
        Points of the road's surface in the map's CRS, metres, for the heights of lanes.
    """

    lanelets: gpd.GeoDataFrame
    road: Floats
    _cache: dict[tuple[float, float, float], Lanes | None] = field(default_factory=dict, init=False)

    @staticmethod
    def reach_m(excerpt: Excerpt) -> float:
        """Return the radius of lanes that a sensor's detections need, metres, in steps of 10 m."""
        return float(np.ceil((excerpt.reach_m + MARGIN_M) / 10.0) * 10.0)

    def around(self, pose: Pose, reach_m: float) -> Lanes | None:
        """Return the lanes within reach (m) of a pose; None where there is none."""
        key = pose.easting, pose.northing, reach_m
        for east, north, reach in self._cache:
            if reach == reach_m and np.hypot(east - key[0], north - key[1]) < SAME_M:
                key = east, north, reach
        if key not in self._cache:
            while len(self._cache) >= MOST_CACHED:
                del self._cache[next(iter(self._cache))]
            try:
                self._cache[key] = sample_lanes(
                    self.lanelets, self.road, place=pose.position[:2], reach_m=reach_m
                )
            except NoAnswerError:
                self._cache[key] = None
        return self._cache[key]


def score(excerpt: Excerpt, lanes: LaneMap, rival: Rival = GIVEN) -> Score:
    """Score how well an explanation of the traffic fits the lanes.

    The likelihood of a detection is a mixture: of a vehicle that moves along a lane, in its
    direction and below its top speed, and of anything else. Each vehicle counts once.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    rival : Rival
        The explanation.
    """
    points = rival.points(excerpt.points)
    rate = -excerpt.range_rate if rival.against else excerpt.range_rate
    reach_m = lanes.reach_m(excerpt)
    log_likelihood = np.full(len(points), np.log(OTHERS / AREA_M**2))
    on_lane, height_over_m = np.zeros(len(points), dtype=bool), np.full(len(points), np.nan)
    for index, given in enumerate(excerpt.poses):
        rows, pose = np.flatnonzero(excerpt.pose == index), rival.turned(given)
        near = lanes.around(pose, reach_m)
        if near is not None and len(rows):
            for sign in (1.0, -1.0) if rival.signless else (1.0,):
                tried = _lane_likelihoods(
                    points[rows], sign * rate[rows], pose, near, heights=rival.heights
                )
                better = tried[0] > log_likelihood[rows] if sign < 0.0 else np.full(len(rows), True)
                log_likelihood[rows[better]], on_lane[rows[better]], height_over_m[rows[better]] = (
                    each[better] for each in tried
                )
    number = np.unique(excerpt.vehicle, return_inverse=True)[1]
    count = np.bincount(number)
    return Score(
        log_likelihood=np.bincount(number, log_likelihood) / count,
        on_lane=np.bincount(number, on_lane) / count,
        height_over_m=height_over_m,
    )


def _lane_likelihoods(
    points: Floats, rate: Floats, pose: Pose, lanes: Lanes, *, heights: bool
) -> tuple[Floats, Booleans, Floats]:
    """Return each detection's log likelihood, whether it is on a lane, and its height over it."""
    local = pose.to_map(points) - [*lanes.origin, 0.0]
    offset = local - (pose.position - [*lanes.origin, 0.0])
    reach, flat = np.linalg.norm(offset, axis=1), np.hypot(*offset[:, :2].T)
    level = np.isnan(points[:, 2]) | (not heights)
    matched = local.copy()
    matched[level, 2] = np.nan
    direction = offset[:, :2] / np.maximum(flat, 1e-9)[:, None]
    matches = match_along(lanes, matched, direction, rate, reach)
    ahead, left, height_over_m = lanes.beside(matches.lane, local)
    half, edge = lanes.width_m[matches.lane] / 2.0, np.hypot(EDGE_M, EDGE_SHARE * reach)
    beyond = np.maximum(np.abs(ahead) - 1.5 * LANE_STEP_M, 0.0) / edge
    across = [scipy.special.ndtr((side * left + half) / edge) for side in (1.0, -1.0)]
    lane_density = (across[0] + across[1] - 1.0) / (2.0 * half) * np.exp(-0.5 * beyond**2)
    height_over_m[np.isnan(points[:, 2])] = np.nan
    spread = np.hypot(HEIGHT_M, HEIGHT_SHARE * reach)
    normal = np.exp(-0.5 * ((height_over_m - REFLECTION_M) / spread) ** 2)
    normal /= np.sqrt(2.0 * np.pi) * spread
    height_density = np.where(np.isnan(height_over_m) | (not heights), 1.0 / AREA_M, normal)
    lane = matches.found * (1.0 - OTHERS) * lane_density * height_density
    elsewhere = OTHERS / AREA_M**2
    on_lane = lane > elsewhere
    return np.log(lane + elsewhere), on_lane, np.where(on_lane, height_over_m, np.nan)


def _within_half_turn(angle: float) -> float:
    """Return an angle wrapped to -180 to 180 degrees."""
    return (angle + 180.0) % 360.0 - 180.0


def usual_mistakes(
    excerpt: Excerpt, others: Mapping[str, Pose], units: Sequence[UnitMistake] = ()
) -> list[Rival]:
    """Return explanations by usual mistakes, and by the poses of the site's other sensors.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    others : mapping of str to Pose
        The poses of other sensors of the site.
    units : sequence of UnitMistake
        Units of the positions that the range rates do not rule out.
    """
    pose = excerpt.usual
    compass = yaw_from_compass(pose.yaw, pose.crs, pose.easting, pose.northing)
    yaw_back, roll_over = (_within_half_turn(angle + 180.0) for angle in (pose.yaw, pose.roll))
    has_elevation = bool(np.isfinite(excerpt.points[:, 2]).any())
    mistakes = [
        Rival(cause=Text("yaw is off by 180 deg"), advice=Text("set yaw to {:.1f} deg", yaw_back),
              turned=lambda p: replace(p, yaw=p.yaw + 180.0)),
        Rival(cause=Text("its yaw is a bearing from true north"),
              advice=Text("set yaw to {:.1f} deg", _within_half_turn(compass)),
              turned=lambda p: replace(p, yaw=p.yaw + compass - pose.yaw)),
        Rival(cause=Text("its yaw is a bearing from grid north"),
              advice=Text("set yaw to {:.1f} deg", _within_half_turn(90.0 - pose.yaw)),
              turned=lambda p: replace(p, yaw=90.0 - p.yaw)),
        Rival(cause=Text("its yaw counts clockwise"),
              advice=Text("set yaw to {:.1f} deg", _within_half_turn(-pose.yaw)),
              turned=lambda p: replace(p, yaw=-p.yaw)),
        Rival(cause=Text("x and y are swapped"), advice=Text("swap x and y"), axes=Axes.SWAPPED),
        Rival(cause=Text("x points to the right and y forward"),
              advice=Text("turn the axes: x forward, y to the left"), axes=Axes.AHEAD),
        Rival(cause=Text("x points backward"), advice=Text(CHANGE_SIGN, "x"), axes=Axes.BACK),
        MIRRORED,
        AGAINST,
    ]  # fmt: skip
    if has_elevation:
        mistakes += [
            Rival(cause=Text("pitch has the wrong sign"),
                  advice=Text("set pitch to {:.1f} deg", -pose.pitch),
                  turned=lambda p: replace(p, pitch=-p.pitch)),
            Rival(cause=Text("roll has the wrong sign"),
                  advice=Text("set roll to {:.1f} deg", -pose.roll),
                  turned=lambda p: replace(p, roll=-p.roll)),
            Rival(cause=Text("z points down"), advice=Text(CHANGE_SIGN, "z"), axes=Axes.DOWN),
            Rival(cause=Text("y and z are swapped"), advice=Text("swap y and z"),
                  axes=Axes.UPRIGHT),
            Rival(cause=Text("roll is off by 180 deg, or y points to the right and z down"),
                  advice=Text("set roll to {:.1f} deg, or change the signs of y and z", roll_over),
                  turned=lambda p: replace(p, roll=p.roll + 180.0)),
        ]  # fmt: skip
    without_sign = signs_lost(excerpt)
    return (
        mistakes
        + ([without_sign] if without_sign else [])
        + [Rival(cause=each.looks, advice=each.advice, scale=each.factor) for each in units]
        + [_of_another(name, other) for name, other in others.items()]
    )


def signs_lost(excerpt: Excerpt) -> Rival | None:
    """Return the explanation that range rates are absolute values; None where both signs occur."""
    if (excerpt.range_rate > 0.0).all() or (excerpt.range_rate < 0.0).all():
        return Rival(cause=ABSOLUTE.looks, advice=ABSOLUTE.advice, signless=True)
    return None


def _of_another(name: str, other: Pose) -> Rival:
    """Return the explanation that the recording is of another sensor of the site."""
    return Rival(
        cause=Text("recording and pose are mixed up: the recording fits the pose of {}", name),
        advice=Text("give this recording with the pose of {}", name),
        turned=lambda _: other,
    )


def other_yaws(pose: Pose) -> Iterator[Rival]:
    """Yield the pose with yaws all around the circle: they explain traffic by chance only."""
    for turn in np.arange(NEAR_DEG, 360.0 - NEAR_DEG + 0.1, STEP_DEG).tolist():
        yield GIVEN.by(pose, replace(pose, yaw=pose.yaw + turn))


def search_poses(excerpt: Excerpt, lanes: LaneMap) -> list[Rival]:
    """Return explanations by poses that a search finds, also with left and right swapped.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    """
    pose = excerpt.usual
    lanes_near = lanes.around(pose, lanes.reach_m(excerpt))
    if lanes_near is None or not np.isfinite(excerpt.moving.points).all():
        return []
    scene = Scene(lanes=lanes_near, samples=thin(*excerpt.as_usual))
    rivals = []
    for axes, variant in ((Axes.GIVEN, scene), (Axes.MIRRORED, scene.of(mirrored(scene.samples)))):
        for hypothesis in find_hypotheses(variant, heading=None)[:SEARCHED]:
            state = hypothesis.fit.state
            if np.hypot(*state.position[:2]) > FARTHEST_M:
                continue
            place = state.position + np.append(lanes_near.origin, 0.0)
            yaw, pitch, roll = np.degrees(state.yaw_pitch_roll).tolist()
            searched = replace(
                pose, easting=float(place[0]), northing=float(place[1]), height=float(place[2]),
                yaw=yaw, pitch=pitch, roll=roll,
            )  # fmt: skip
            # the place along a street is not fixed: one mistake may explain as much as two
            turned = replace(pose, yaw=yaw)
            moved = replace(searched, yaw=pose.yaw, pitch=pose.pitch, roll=pose.roll)
            rivals += [
                other_pose(pose, there) if axes is Axes.GIVEN else MIRRORED.by(pose, there)
                for there in (turned, moved, searched)
            ]
    return [replace(rival, fitted=6) for rival in rivals]


def other_pose(pose: Pose, there: Pose) -> Rival:
    """Return the explanation that a sensor with the given pose `pose` has the pose `there`."""
    off_m, turn = GIVEN.by(pose, there).off(pose)
    to = side(*(there.position - pose.position)[:2])
    away = Text("{:.1f} m to the {}", off_m, to)
    turned = Text("turned {:.1f} deg {}, seen from above", abs(turn), sense(turn))
    parts = [away, turned]
    is_away, is_turned = off_m > ONE_MISTAKE_M, abs(turn) > ONE_MISTAKE_DEG
    if not (is_away and is_turned):
        parts = [away] if is_away else [turned]
    tilt = max(abs(there.pitch - pose.pitch), abs((there.roll - pose.roll + 180.0) % 360.0 - 180.0))
    if tilt > TILTED_DEG:
        parts = [*(parts if is_away or is_turned else []), Text("tilted by {:.0f} deg", tilt)]
    return Rival(
        cause=Text("its pose is off: compared with it, the sensor is {}", Text(", ").join(parts)),
        advice=Text(
            "find it with gis-radar localize, near easting {:.1f}, northing {:.1f}, yaw {:.1f} deg",
            there.easting, there.northing, there.yaw,
        ),
    ).by(pose, there)  # fmt: skip


def height_or_pitch_mistakes(excerpt: Excerpt, given: Score) -> list[Rival]:
    """Return explanations by a wrong height or pitch, estimated from heights over the road.

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
    high_m = float(np.median(given.height_over_m[known])) - REFLECTION_M
    tilt = np.degrees(np.median((given.height_over_m[known] - REFLECTION_M) / ahead[known]))
    pose = excerpt.usual
    height = Text("height is {:.1f} m too high", high_m)
    if high_m < 0.0:
        height = Text("height is {:.1f} m too low", -high_m)
    if abs(high_m) > DATUM_M:
        height = Text("{}: is it of another vertical datum, as over the ellipsoid?", height)
    pitch = Text("pitch is {:.1f} deg too low: the sensor looks farther down", tilt)
    if tilt < 0.0:
        pitch = Text("pitch is {:.1f} deg too high: the sensor looks farther up", -tilt)
    return [
        Rival(cause=height,
              advice=Text("set height to {:.1f} m", pose.height - high_m), fitted=1,
              turned=lambda p: replace(p, height=p.height - high_m)),
        Rival(cause=pitch,
              advice=Text("set pitch to {:.1f} deg", pose.pitch + tilt), fitted=1,
              turned=lambda p: replace(p, pitch=p.pitch + tilt)),
    ]  # fmt: skip

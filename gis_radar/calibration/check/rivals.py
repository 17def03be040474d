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
from gis_radar.calibration.timing.lane_detections import LaneDetections, placed_on_lanes
from gis_radar.calibration.unit_mistakes import ABSOLUTE, UnitMistake
from gis_radar.poses import Pose

# A detection is of a vehicle, anywhere on the width of a lane whose edges are blurred by errors of
# poses, maps and bearings (1 sigma: metres, and share of the range); or of anything else.
EDGE_M, EDGE_SHARE = 0.5, 0.01
OTHERS = 0.1  # share of detections of anything else
AREA_M = 8.0  # width and height over which these spread evenly
# Mean height of reflections over the road; 1 sigma of it, and of elevation as a share of the range.
REFLECTION_M, HEIGHT_M, HEIGHT_SHARE = 0.7, 1.0, 0.012
FARTHEST_M = 20.0  # the search finds poses up to 15 m off; farther off is another place
SAME_M = 0.3  # places so near, as the poses of a pose track, share sampled lanes
LANES_KEPT = 4  # places around which the lanes are held at once, 25 MB each
# Poses so near to each other are one (metres; degrees of yaw, pitch, roll: of a rough search).
SAME_PLACE_M, SAME_DEG, TURNS = 2.0, (2.0, 3.0, 5.0), ("yaw", "pitch", "roll")
# A single mistake changes place or yaw, and the other by the error of a search at most.
ONE_MISTAKE_M, ONE_MISTAKE_DEG = 3.0, 3.0
SEARCHED = 3  # number of likeliest poses taken from a search
STEP_DEG, NEAR_DEG = 10.0, 20.0  # step of random yaws, and their least distance from the given yaw


class Axes(Enum):
    """Which columns of a recording are x forward, y left, z up, and with which signs."""

    GIVEN = (0, 1, 2), (1.0, 1.0, 1.0)
    MIRRORED = (0, 1, 2), (1.0, -1.0, 1.0)
    SWAPPED = (1, 0, 2), (1.0, 1.0, 1.0)
    AHEAD = (1, 0, 2), (1.0, -1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Rival:
    """Rival explanation of a sensor's recording: which pose and which axes are right.

    Parameters
    ----------
    cause : str
        The mistake, for a message; empty for what is given.
    advice : str
        How to correct it.
    turned : callable
        Returns the right pose for a given one.
    axes : Axes
        Columns and signs of the recording that are x forward, y left, z up.
    against : bool
        Whether lanes are driven against their direction.
    heights : bool
        Whether heights over the road count.
    scale : float
        Factor by which ranges are too long.
    signless : bool
        Whether range rates have lost their sign.
    fitted : int
        How many of its numbers were fitted to the traffic; 0 for a named mistake.
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
        """Whether its pose was found by a search."""
        return self.fitted > 1

    def points(self, recorded: Floats) -> Floats:
        """Return recorded points as this explanation has them, x forward, y left, metres."""
        order, signs = self.axes.value
        return np.asarray(recorded[:, order] * np.array(signs) / self.scale)

    def off(self, pose: Pose) -> tuple[float, float]:
        """Return by how many metres and degrees a pose is off, if this explanation is right."""
        there = self.turned(pose)
        turn = (there.yaw - pose.yaw + 180.0) % 360.0 - 180.0
        return float(np.hypot(*(there.position - pose.position)[:2])), turn

    def twofold(self, pose: Pose) -> bool:
        """Return whether it assumes two mistakes at once, of axes, place or yaw."""
        off_m, turn = self.off(pose)
        wrong = self.axes is not Axes.GIVEN, off_m > ONE_MISTAKE_M, abs(turn) > ONE_MISTAKE_DEG
        return self.searched and sum(wrong) > 1

    def same_as(self, other: Rival, pose: Pose) -> bool:
        """Return whether two explanations of one pose differ by no more than a search's error.

        All searched places with the given yaw are one, as the place along a street is not fixed.
        """
        here, there = self.turned(pose), other.turned(pose)
        turns = [
            abs((getattr(here, name) - getattr(there, name) + 180.0) % 360.0 - 180.0) < least
            for name, least in zip(TURNS, SAME_DEG, strict=True)
        ]
        alike = (self.axes, self.against, self.scale) == (other.axes, other.against, other.scale)
        apart_m = float(np.linalg.norm(here.position - there.position))
        aside = all(r.searched and abs(r.off(pose)[1]) < ONE_MISTAKE_DEG for r in (self, other))
        return alike and ((apart_m < SAME_PLACE_M and all(turns)) or aside)

    def by(self, pose: Pose, there: Pose) -> Rival:
        """Return the explanation that all poses change as `pose` does to `there`."""
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
    fit : (v,) array
        Mean log likelihood of the detections of each vehicle.
    on : (v,) array
        Share of each vehicle's detections that are likelier on a lane than elsewhere.
    over : (n,) array
        Height of each detection over its lane, metres; NaN where there is none.
    """

    fit: Floats
    on: Floats
    over: Floats

    @property
    def driving(self) -> Booleans:
        """Which vehicles drive along lanes."""
        return self.on > 0.5

    @property
    def share(self) -> float:
        """Share of the vehicles that drive along lanes."""
        return float(self.driving.mean()) if len(self.on) else 0.0

    def ahead_of(self, other: Score) -> float:
        """Return by how many standard errors the vehicles prefer this explanation."""
        return z_score(self.fit - other.fit)


@dataclass(frozen=True, kw_only=True)
class LaneMap:
    """Lanes of a site, sampled around a place when they are first needed.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.
    road : (n, 3) array
        Points of the road's surface in the map's CRS, metres; they give the heights.
    """

    lanelets: gpd.GeoDataFrame
    road: Floats
    kept: dict[tuple[float, float, float], Lanes | None] = field(default_factory=dict)

    @staticmethod
    def reach_m(excerpt: Excerpt) -> float:
        """Return how far around a sensor lanes are needed for its detections, metres."""
        return float(np.ceil((excerpt.reach_m + MARGIN_M) / 10.0) * 10.0)

    def around(self, pose: Pose, reach_m: float) -> Lanes | None:
        """Return the lanes within reach (m) of a pose; None where there is none."""
        key = pose.easting, pose.northing, reach_m
        for east, north, reach in self.kept:
            if reach == reach_m and np.hypot(east - key[0], north - key[1]) < SAME_M:
                key = east, north, reach
        if key not in self.kept:
            while len(self.kept) >= LANES_KEPT:
                del self.kept[next(iter(self.kept))]
            try:
                self.kept[key] = sample_lanes(
                    self.lanelets, self.road, place=pose.position[:2], reach_m=reach_m
                )
            except NoAnswerError:
                self.kept[key] = None
        return self.kept[key]


def score(excerpt: Excerpt, lanes: LaneMap, rival: Rival = GIVEN) -> Score:
    """Score how well an explanation of the traffic fits the lanes.

    The likelihood is a mixture: a detection is of a vehicle that moves along a lane, in its
    direction and below its top speed, or of anything else. Each vehicle counts once.

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
    fit = np.full(len(points), np.log(OTHERS / AREA_M**2))
    on, over = np.zeros(len(points), dtype=bool), np.full(len(points), np.nan)
    for k, given in enumerate(excerpt.poses):
        mine, pose = excerpt.pose == k, rival.turned(given)
        near = lanes.around(pose, reach_m)
        if near is not None and mine.any():
            for sign in (1.0, -1.0) if rival.signless else (1.0,):
                found = _compared(
                    points[mine], sign * rate[mine], pose, near, heights=rival.heights
                )
                better = found[0] > fit[mine] if sign < 0.0 else np.ones(mine.sum(), dtype=bool)
                rows = np.flatnonzero(mine)[better]
                fit[rows], on[rows], over[rows] = (each[better] for each in found)
    number = np.unique(excerpt.vehicle, return_inverse=True)[1]
    count = np.bincount(number)
    return Score(
        fit=np.bincount(number, fit) / count, on=np.bincount(number, on) / count, over=over
    )


def _compared(
    points: Floats, rate: Floats, pose: Pose, lanes: Lanes, *, heights: bool
) -> tuple[Floats, Booleans, Floats]:
    """Return each detection's log likelihood, whether it is on a lane, and its height over it."""
    here = pose.to_map(points) - [*lanes.origin, 0.0]
    arm = here - (pose.position - [*lanes.origin, 0.0])
    reach, flat = np.linalg.norm(arm, axis=1), np.hypot(*arm[:, :2].T)
    level = np.isnan(points[:, 2]) | (not heights)
    matched = here.copy()
    matched[level, 2] = np.nan
    way = arm[:, :2] / np.maximum(flat, 1e-9)[:, None]
    matches = match_along(lanes, matched, way, rate, reach)
    ahead, left, over = lanes.beside(matches.lane, here)
    half, edge = lanes.width_m[matches.lane] / 2.0, np.hypot(EDGE_M, EDGE_SHARE * reach)
    beyond = np.maximum(np.abs(ahead) - 1.5 * LANE_STEP_M, 0.0) / edge
    across = [scipy.special.ndtr((side * left + half) / edge) for side in (1.0, -1.0)]
    lane = (across[0] + across[1] - 1.0) / (2.0 * half) * np.exp(-0.5 * beyond**2)
    over[np.isnan(points[:, 2])] = np.nan
    spread = np.hypot(HEIGHT_M, HEIGHT_SHARE * reach)
    bell = np.exp(-0.5 * ((over - REFLECTION_M) / spread) ** 2) / (np.sqrt(2.0 * np.pi) * spread)
    high = np.where(np.isnan(over) | (not heights), 1.0 / AREA_M, bell)
    mine, other = matches.found * (1.0 - OTHERS) * lane * high, OTHERS / AREA_M**2
    return np.log(mine + other), mine > other, np.where(mine > other, over, np.nan)


def _within_half_turn(angle: float) -> float:
    """Return an angle as one from -180 to 180 degrees."""
    return (angle + 180.0) % 360.0 - 180.0


def ways_to_be_wrong(
    excerpt: Excerpt, others: Mapping[str, Pose], units: Sequence[UnitMistake] = ()
) -> list[Rival]:
    """Return explanations by usual mistakes, and by the poses of the site's other sensors.

    Parameters
    ----------
    excerpt : Excerpt
        Of the sensor.
    others : mapping of str to Pose
        The poses of other sensors of the site.
    units : sequence of UnitMistake
        Units of the positions that the range rates do not rule out.
    """
    pose = excerpt.usual
    compass = yaw_from_compass(pose.yaw, pose.crs, pose.easting, pose.northing)
    back, over = _within_half_turn(pose.yaw + 180.0), _within_half_turn(pose.roll + 180.0)
    measured = bool(np.isfinite(excerpt.points[:, 2]).any())
    found = [
        Rival(cause=Text("yaw is off by 180 deg"), advice=Text("set yaw to {:.1f} deg", back),
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
        MIRRORED,
        AGAINST,
    ]  # fmt: skip
    if measured:
        found += [
            Rival(cause=Text("pitch has the wrong sign"),
                  advice=Text("set pitch to {:.1f} deg", -pose.pitch),
                  turned=lambda p: replace(p, pitch=-p.pitch)),
            Rival(cause=Text("roll has the wrong sign"),
                  advice=Text("set roll to {:.1f} deg", -pose.roll),
                  turned=lambda p: replace(p, roll=-p.roll)),
            Rival(cause=Text("roll is off by 180 deg"), advice=Text("set roll to {:.1f} deg", over),
                  turned=lambda p: replace(p, roll=p.roll + 180.0)),
        ]  # fmt: skip
    lost = signs_lost(excerpt)
    return (
        found
        + ([lost] if lost else [])
        + [Rival(cause=each.looks, advice=each.advice, scale=each.factor) for each in units]
        + [_of_another(name, other) for name, other in others.items()]
    )


def signs_lost(excerpt: Excerpt) -> Rival | None:
    """Return the explanation that range rates lost their signs; None where both signs occur."""
    if (excerpt.range_rate > 0.0).all() or (excerpt.range_rate < 0.0).all():
        return Rival(cause=ABSOLUTE.looks, advice=ABSOLUTE.advice, signless=True)
    return None


def _of_another(name: str, other: Pose) -> Rival:
    return Rival(
        cause=Text("recording and pose are mixed up: the recording fits the pose of {}", name),
        advice=Text("give this recording with the pose of {}", name),
        turned=lambda _: other,
    )


def other_yaws(pose: Pose) -> Iterator[Rival]:
    """Yield explanations with other yaws all around; what these explain is chance."""
    for turn in np.arange(NEAR_DEG, 360.0 - NEAR_DEG + 0.1, STEP_DEG).tolist():
        yield GIVEN.by(pose, replace(pose, yaw=pose.yaw + turn))


def found_poses(excerpt: Excerpt, lanes: LaneMap) -> list[Rival]:
    """Search the pose near the given one, as recorded and with left and right swapped.

    Parameters
    ----------
    excerpt : Excerpt
        Of the sensor.
    lanes : LaneMap
        The map.
    """
    pose = excerpt.usual
    near = lanes.around(pose, lanes.reach_m(excerpt))
    if near is None or not np.isfinite(excerpt.moving.points).all():
        return []
    scene = Scene(lanes=near, samples=thin(*excerpt.as_usual))
    found = []
    for axes, part in ((Axes.GIVEN, scene), (Axes.MIRRORED, scene.of(mirrored(scene.samples)))):
        for tried in find_hypotheses(part, heading=None)[:SEARCHED]:
            state = tried.fit.state
            if np.hypot(*state.position[:2]) > FARTHEST_M:
                continue
            place = state.position + np.append(near.origin, 0.0)
            yaw, pitch, roll = np.degrees(state.yaw_pitch_roll).tolist()
            there = replace(
                pose, easting=float(place[0]), northing=float(place[1]), height=float(place[2]),
                yaw=yaw, pitch=pitch, roll=roll,
            )  # fmt: skip
            # the place along a street is not fixed: one mistake may explain as much as two
            turned = replace(pose, yaw=yaw)
            aside = replace(there, yaw=pose.yaw, pitch=pose.pitch, roll=pose.roll)
            for each in (turned, aside, there):
                rival = other_pose(pose, each) if axes is Axes.GIVEN else MIRRORED.by(pose, each)
                found.append(replace(rival, fitted=6))
    return found


def other_pose(pose: Pose, there: Pose) -> Rival:
    """Return the explanation that a sensor has the pose `there` instead."""
    off_m, turn = GIVEN.by(pose, there).off(pose)
    to = side(*(there.position - pose.position)[:2])
    away = Text("{:.1f} m to the {}", off_m, to)
    turned = Text("turned {:.1f} deg {}, seen from above", abs(turn), sense(turn))
    parts = [away, turned]
    if off_m <= ONE_MISTAKE_M or abs(turn) <= ONE_MISTAKE_DEG:
        parts = [away] if off_m > ONE_MISTAKE_M else [turned]
    cause = Text("its pose is off: compared with it, the sensor is {}", Text(", ").join(parts))
    return Rival(
        cause=cause,
        advice=Text(
            "find it with gis-radar localize, near easting {:.1f}, northing {:.1f}, yaw {:.1f} deg",
            there.easting, there.northing, there.yaw,
        ),
    ).by(pose, there)  # fmt: skip


def lower_or_tilted(excerpt: Excerpt, given: Score) -> list[Rival]:
    """Return explanations by a wrong height or pitch, estimated from heights over the road.

    Parameters
    ----------
    excerpt : Excerpt
        Of the sensor.
    given : Score
        Of the given pose without heights.
    """
    ahead = excerpt.points[:, 0]
    known = np.isfinite(given.over) & (ahead > 1.0)
    if not known.any():
        return []
    high_m = float(np.median(given.over[known])) - REFLECTION_M
    tilt = np.degrees(np.median((given.over[known] - REFLECTION_M) / ahead[known]))
    pose = excerpt.usual
    height = Text("height is {:.1f} m too high", high_m)
    if high_m < 0.0:
        height = Text("height is {:.1f} m too low", -high_m)
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


def on_lanes(excerpt: Excerpt, lanes: LaneMap) -> LaneDetections:
    """Return the detections that move along lanes, for the comparison of clocks.

    Parameters
    ----------
    excerpt : Excerpt
        Of a sensor.
    lanes : LaneMap
        The map.
    """
    moving, found = excerpt.moving, list[LaneDetections]()
    for number, pose in enumerate(excerpt.poses):
        mine, near = excerpt.held == number, lanes.around(pose, lanes.reach_m(excerpt))
        if near is None:
            continue
        found.append(
            placed_on_lanes(
                near, moving.time[mine], moving.points[mine], moving.range_rate[mine], pose
            )
        )
    seen = LaneDetections.joined(found)
    return seen.take(np.argsort(seen.time, kind="stable"))


def best_split(driving: Booleans, least: int) -> tuple[int, float]:
    """Return the index where a share changes most clearly, and its log likelihood ratio.

    Either side has at least `least` vehicles; the ratio is over no change.
    """
    count, total = len(driving), int(driving.sum())
    before = np.arange(least, count - least + 1).astype(np.float64)
    if len(before) == 0:
        return 0, 0.0
    hits = np.cumsum(driving)[before.astype(np.int64) - 1].astype(np.float64)

    def likelihood(hit: Floats, of: Floats) -> Floats:
        share = np.clip(hit / of, 1e-9, 1.0 - 1e-9)
        return np.asarray(hit * np.log(share) + (of - hit) * np.log(1.0 - share))

    apart = likelihood(hits, before) + likelihood(total - hits, count - before)
    gain = apart - likelihood(np.array([float(total)]), np.array([float(count)]))
    best = int(gain.argmax())
    return int(before[best]), float(gain[best])

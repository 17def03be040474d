"""Place a sensor by vehicles that other sensors see, too, with shifts on a grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Text
from gis_radar.calibration.registration.certainty import z_score
from gis_radar.calibration.registration.traces import Moving
from gis_radar.calibration.several.correspondences import (
    FARTHEST_M,
    LEAST_PAIRS,
    MOMENT_S,
    PLANAR,
    Moments,
    Names,
    Rows,
    assign,
    compare_moments,
    mean_gaps,
)
from gis_radar.calibration.timing.lane_detections import LaneDetections
from gis_radar.poses import Pose

GATE_CHI2 = 13.8  # two degrees of freedom: 1 in 1000 true pairs is lost
# Step of the grid on which the shift between two sensors is looked for, and its least reach.
STEP_M = 1.0
REACH_M = 6.0
# Shifts nearer than this, a vehicle's length, are one answer: the adjustment merges them.
APART_M = 5.0
# Standard deviations by which vehicles must prefer a place to all others (as for one sensor), and
# to the score by chance.
CLEAR_Z = 2.5
# As CLEAR_Z, against places with another offset of the clock: places that were wrong reached 1.0 in
# simulation, right ones with balanced traffic 1.9 to 4.
CLOCK_Z = 1.5
# Time shifts of one sensor that give the score by chance: its vehicles meet other traffic.
CHANCE_S: tuple[float, ...] = (-15.0, -8.0, 8.0, 15.0)
# Largest offset of a clock that is tried: at 12 m/s a vehicle drives FARTHEST_M in it.
REACH_S = FARTHEST_M / 12.0
# Standard deviations by which vehicles must prefer another offset of the clock to the present one.
LAG_CLEAR = 2.0
CONTRADICTION_CHI2 = 16.3  # three degrees of freedom: 1 in 1000 sites is refused in error

TRIED = 30  # best shifts by the rough score that are scored one to one
GRID_YAW = math.radians(0.5)  # step of the headings under which correspondences are looked for


@dataclass(frozen=True, kw_only=True)
class Station:
    """A sensor of a network.

    Parameters
    ----------
    name : str
        Name of the sensor.
    moving : Moving
        Its moving detections while the others recorded, too.
    poses : tuple of Pose
        Its own poses: the answer of its localization, or several that fit alike.
    clock_s : float, optional
        Standard deviation of its clock, seconds, where that was measured.
    """

    name: str
    moving: Moving
    poses: tuple[Pose, ...]
    clock_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One of a sensor's own poses, with its vehicles.

    Parameters
    ----------
    seen : Moments
        The sensor's vehicles, placed in the map by this pose.
    driven : LaneDetections
        Detections that move along lanes.
    covariance : (3, 3) array
        Of easting, northing (m), yaw (radians).
    yaw : float
        Yaw of the pose, radians.
    """

    seen: Moments
    driven: LaneDetections
    covariance: Floats
    yaw: float = 0.0

    def turned(self, other: Choice) -> bool:
        """Return whether another choice differs in yaw by more than the grid allows for."""
        gap = (self.yaw - other.yaw + math.pi) % (2.0 * math.pi) - math.pi
        return abs(gap) > 2.0 * GRID_YAW


@dataclass(frozen=True, kw_only=True)
class Shift:
    """Shift of a sensor, and how well its vehicles there agree with those of others.

    Parameters
    ----------
    choice : int
        Index of the one of its own poses from which the shift starts.
    step : (3,) array
        Easting, northing (m), yaw (radians) from that pose.
    ahead : int
        By how many moments the sensor's clock is ahead.
    scores : (tracks,) array
        Score of each of its tracks.
    pairs : dict
        Number of pairs with each other sensor, by name.
    """

    choice: int
    step: Floats
    ahead: int
    scores: Floats
    pairs: Mapping[str, int]


def total_score(shift: Shift) -> float:
    """Return the sum of the scores of a shift."""
    return float(shift.scores.sum())


@dataclass(frozen=True, kw_only=True)
class Placing:
    """Evidence of other sensors about a sensor's pose.

    Parameters
    ----------
    inside : Shift or None
        The best place within the sensor's own answer; None where there are too few pairs.
    z_score, clock_z : float
        By how many standard deviations its vehicles prefer that to other such places, at the same
        offset of the clock and at other ones.
    in_time : Floats
        Scores by track at the best place if the clock is right; empty where there is none.
    beyond : Shift or None
        A place outside its own answer that its vehicles clearly prefer.
    """

    inside: Shift | None
    z_score: float
    clock_z: float
    in_time: Floats
    beyond: Shift | None

    @property
    def doubt(self) -> str | None:
        """Why the best place is not clear; None where it is, or where there is none."""
        if self.inside is None:
            return None
        if self.clock_z < CLOCK_Z:
            return Text(
                "its vehicles fit those of others in several places, each with another offset of "
                "its clock: traffic in both directions, a measured clock or a scan tells them apart"
            )
        if self.z_score < CLEAR_Z:
            return Text("its vehicles fit those of others in several places")
        return None


def find_place(
    choices: Sequence[Choice], others: Mapping[str, Choice], *, reach_s: float = 0.0
) -> Placing:
    """Find the shift at which a sensor's vehicles agree with those of others.

    Parameters
    ----------
    choices : sequence of Choice
        The sensor's own poses: one, or several that fit alike.
    others : mapping
        Sensors that have a place, by name.
    reach_s : float
        How far the sensor's clock may be off. A place must be better than all others at any such
        offset, since along a road a vehicle seen late looks like one seen from elsewhere.
    """
    tracks = 1 + max((int(c.seen.track.max(initial=-1)) for c in choices), default=-1)
    allowed: list[Shift] = []
    beyond: list[Shift] = []
    chance: list[Shift] = []
    most = round(reach_s / MOMENT_S)
    for number, choice in enumerate(choices):
        steps, inside = _grid(choice.covariance)
        for ahead in range(-most, most + 1):
            score = _Score(choice, others, tracks, ahead)
            allowed += score.best(number, steps[inside])
            if ahead == 0 and len(choices) == 1:
                beyond += score.best(number, steps[~inside])
        for ahead in [round(each / MOMENT_S) for each in CHANCE_S]:
            chance += _Score(choice, others, tracks, ahead).best(number, steps)[:1]

    def good(shift: Shift) -> bool:
        z_scores = (preference(shift.scores, each.scores) for each in chance)
        return min(z_scores, default=math.inf) > CLEAR_Z

    allowed, beyond = [s for s in allowed if good(s)], [s for s in beyond if good(s)]
    in_time = max((s for s in allowed if not s.ahead), key=total_score, default=None)
    first = _first(allowed, in_time)
    rivals: dict[bool, list[Shift]] = {True: [], False: []}  # with the same offset of the clock
    for shift in allowed:
        if first is not None and _differ(choices, first, shift):
            rivals[shift.ahead == first.ahead].append(shift)
    there = [s for s in (in_time, _contradiction(in_time, beyond)) if s is not None]
    return Placing(
        inside=first,
        z_score=_least(first, rivals[True]),
        clock_z=_least(first, rivals[False]),
        in_time=max(there, key=total_score).scores if there else np.empty(0),
        beyond=_contradiction(first, beyond),
    )


def _first(allowed: Sequence[Shift], in_time: Shift | None) -> Shift | None:
    """Return the best shift: one with the clock as it is where no other is clearly better."""
    best = max(allowed, key=total_score, default=None)
    if best is None or in_time is None or preference(best.scores, in_time.scores) >= LAG_CLEAR:
        return best
    return in_time


def _least(first: Shift | None, rivals: Sequence[Shift]) -> float:
    """Return the least preference of the best shift to any of its rivals."""
    if first is None:
        return 0.0
    return min((preference(first.scores, each.scores) for each in rivals), default=math.inf)


def _contradiction(best: Shift | None, beyond: Sequence[Shift]) -> Shift | None:
    """Return the place outside a sensor's own answer that its vehicles clearly prefer to it."""
    if best is not None:
        beyond = [
            shift
            for shift in beyond
            if np.hypot(*(shift.step - best.step)[:2]) > 2.0 * STEP_M
            and preference(shift.scores, best.scores) > CLEAR_Z
        ]
    return max(beyond, key=total_score, default=None)


def _differ(choices: Sequence[Choice], one: Shift, other: Shift) -> bool:
    """Return whether two shifts are different answers, too far apart for the fit to merge."""
    ends = [choices[shift.choice].seen.place[:2] + shift.step[:2] for shift in (one, other)]
    apart_m = float(np.hypot(*(ends[1] - ends[0])))
    if one.choice == other.choice:
        return apart_m > APART_M
    return apart_m > 2.0 * STEP_M or choices[one.choice].turned(choices[other.choice])


def preference(scores: Floats, others: Floats) -> float:
    """Return by how many standard deviations tracks prefer one place to another (Vuong 1989)."""
    longest = max(len(scores), len(others))
    one, other = (np.pad(each, (0, longest - len(each))) for each in (scores, others))
    gain = (one - other)[(one > 0.0) | (other > 0.0)]
    return z_score(gain) if len(gain) > 1 else 0.0


def _grid(covariance: Floats) -> tuple[Floats, Booleans]:
    """Return steps of easting, northing, yaw, and which are within the sensor's own answer."""
    values, axes = np.linalg.eigh(covariance[:2, :2])
    far_m = math.sqrt(CONTRADICTION_CHI2) * np.sqrt(values)
    far_m = np.clip(far_m, REACH_M, FARTHEST_M)
    half = np.ceil(far_m / STEP_M).astype(np.int64)
    u, v = np.mgrid[-half[0] : half[0] + 1, -half[1] : half[1] + 1] * STEP_M
    flat = np.stack([u.ravel(), v.ravel()], axis=1)
    chi2 = np.sum(flat**2 / values, axis=1)
    inside = chi2 < CONTRADICTION_CHI2
    east_north = flat @ axes.T
    # in a direction that the scene does not fix, place and heading are correlated
    turn = east_north @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2])
    return np.column_stack([east_north, np.where(inside, turn, 0.0)]), inside


class _Score:
    """Score of how well a sensor's vehicles agree with those of others after a step.

    The sensor's clock counts as some moments ahead.
    """

    def __init__(
        self,
        choice: Choice,
        others: Mapping[str, Choice],
        tracks: int,
        ahead: int,
    ) -> None:
        self.tracks, self.ahead = tracks, ahead
        self.parts: dict[str, tuple[Rows, Floats, Floats, Floats]] = {}
        loose = np.diag([STEP_M**2 / 3.0, STEP_M**2 / 3.0, GRID_YAW**2])
        for name, other in others.items():
            rows = compare_moments(other.seen.later(self.ahead), choice.seen)
            if not len(rows.tracks):
                continue
            covariance = np.zeros((2 * PLANAR, 2 * PLANAR))
            covariance[:PLANAR, :PLANAR] = other.covariance
            covariance[PLANAR:, PLANAR:] = loose
            gap, known = mean_gaps(rows, covariance)
            slope = rows.means(rows.poses)[:, :, PLANAR:]
            self.parts[name] = rows, gap, slope, np.asarray(np.linalg.inv(known))

    def best(self, choice: int, steps: Floats) -> list[Shift]:
        """Return the best of some steps, and the best of the steps apart from that one."""
        if not self.parts or not len(steps):
            return []
        rough = np.array([self._rough(step) for step in steps])
        order = np.argsort(-rough, kind="stable")
        first = self._most(choice, steps[order[:TRIED]])
        away = np.hypot(*(steps[order, :2] - first.step[:2]).T) > APART_M
        found = [first]
        if away.any():
            found.append(self._most(choice, steps[order[away][:TRIED]]))
        return [each for each in found if sum(each.pairs.values()) >= LEAST_PAIRS]

    def _most(self, choice: int, steps: Floats) -> Shift:
        shifts = [self._shift(choice, step) for step in steps]
        return max(shifts, key=total_score)

    def _chi2(self, name: str, step: Floats) -> Floats:
        _, gap, slope, inverse = self.parts[name]
        moved = gap + slope @ step
        return np.asarray(np.einsum("pi,pij,pj->p", moved, inverse, moved))

    def _rough(self, step: Floats) -> float:
        """Return the score where a track of another sensor may be paired more than once."""
        total = 0.0
        for name, (rows, *_) in self.parts.items():
            gain = np.zeros(self.tracks)
            won = np.maximum(GATE_CHI2 - self._chi2(name, step), 0.0)
            np.maximum.at(gain, rows.tracks[:, 1], won)
            total += float(gain.sum())
        return total

    def _shift(self, choice: int, step: Floats) -> Shift:
        scores, pairs = np.zeros(self.tracks), {}
        for name, (rows, *_) in self.parts.items():
            chi2 = self._chi2(name, step)
            taken: Integers = assign(chi2, rows.tracks, GATE_CHI2)
            np.add.at(scores, rows.tracks[taken, 1], GATE_CHI2 - chi2[taken])
            pairs[name] = len(taken)
        return Shift(choice=choice, step=step, ahead=self.ahead, scores=scores, pairs=pairs)


def contradiction_text(names: Names, vehicles: int, gap_m: float) -> str:
    """Return the text that the poses of two sensors contradict each other."""
    return Text(
        "{} and {}: their poses contradict each other: {} vehicles that both see lie "
        "{:.1f} m apart",
        *names,
        vehicles,
        gap_m,
    )


def clash_text(names: Names, shift: Shift) -> str:
    """Return the text that a sensor's pose contradicts another's, with the shift that fits."""
    return contradiction_text(names, sum(shift.pairs.values()), float(np.hypot(*shift.step[:2])))

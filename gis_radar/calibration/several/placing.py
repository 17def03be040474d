"""Place a sensor by vehicles that other sensors see, too: score shifts of its pose on a grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, Text
from gis_radar.calibration.registration.certainty import z_score
from gis_radar.calibration.registration.traces import Moving
from gis_radar.calibration.several.correspondences import (
    FARTHEST_TRACK_M,
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

GATE_CHI2 = 13.8  # two degrees of freedom: one of 1000 true pairs is lost
# Step and least reach of the grid of shifts.
STEP_M = 1.0
_REACH_M = 6.0
# Shifts nearer than this, a vehicle's length, are one answer: the adjustment merges them.
_APART_M = 5.0
_CLEAR_Z = 2.5  # least z score of a shift over all others (as for one sensor), and over chance
# As _CLEAR_Z, over shifts with another clock offset: in simulation wrong shifts reached 1.0, right
# ones with traffic in both directions 1.9 to 4.
_CLOCK_Z = 1.5
# Time shifts of one sensor that give the score by chance, as its vehicles are then other ones.
_CHANCE_S: tuple[float, ...] = (-15.0, -8.0, 8.0, 15.0)
# Largest tried clock offset: at 12 m/s a vehicle drives FARTHEST_TRACK_M in it.
REACH_S = FARTHEST_TRACK_M / 12.0
OFFSET_Z = 2.0  # least z score of another clock offset over the current one
CONTRADICTION_CHI2 = 16.3  # three degrees of freedom: one of 1000 sites is refused in error

_MOST_SCORED = 30  # shifts of highest upper bound whose score is computed
GRID_YAW = math.radians(0.5)  # 1 sigma of yaw within which a shift on the grid finds its pairs


@dataclass(frozen=True, kw_only=True)
class Station:
    """A sensor of a network.

    Parameters
    ----------
    name : str
        Name of the sensor.
    moving : Moving
        Its moving detections in the time common to the sensors.
    poses : tuple of Pose
        Its poses by single localization: one, or several that fit alike.
    clock_s : float, optional
        Standard deviation of its clock, seconds, where that was measured.
    """

    name: str
    moving: Moving
    poses: tuple[Pose, ...]
    clock_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One of a sensor's poses by single localization, with its vehicles.

    Parameters
    ----------
    seen : Moments
        The sensor's vehicles, placed in the map by this pose.
    driven : LaneDetections
        Detections that move along lanes.
    covariance : (3, 3) array
        Covariance of easting, northing (m), yaw (radians).
    yaw : float
        Yaw of the pose, radians.
    """

    seen: Moments
    driven: LaneDetections
    covariance: Floats
    yaw: float = 0.0

    def differs_in_yaw(self, other: Choice) -> bool:
        """Return whether another choice differs in yaw by more than twice `GRID_YAW`."""
        gap = (self.yaw - other.yaw + math.pi) % (2.0 * math.pi) - math.pi
        return abs(gap) > 2.0 * GRID_YAW


@dataclass(frozen=True, kw_only=True)
class Shift:
    """Shift of a sensor's pose, with the score of its correspondences.

    Parameters
    ----------
    choice : int
        Index of the pose by single localization from which the shift starts.
    step : (3,) array
        Easting, northing (m), yaw (radians) from that pose.
    ahead : int
        Assumed clock offset of the sensor, in moments.
    scores : (tracks,) array
        Score of each of its tracks: `GATE_CHI2` less the chi-square of its pairs.
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
    """Result of the search for a sensor's pose by other sensors.

    Parameters
    ----------
    inside : Shift or None
        Best shift within the confidence region of the single localization; None where there are too
        few pairs.
    z_score, clock_z : float
        Least z score of that shift over others in the region, with the same clock offset and with
        other ones.
    scores_in_time : Floats
        Scores by track of the best shift without clock offset; empty where there is none.
    beyond : Shift or None
        Shift outside the confidence region with a z score above `_CLEAR_Z`.
    """

    inside: Shift | None
    z_score: float
    clock_z: float
    scores_in_time: Floats
    beyond: Shift | None

    @property
    def doubt(self) -> str | None:
        """Reason why the best shift is ambiguous; None where it is not, or where there is none."""
        if self.inside is None:
            return None
        if self.clock_z < _CLOCK_Z:
            return Text(
                "its vehicles fit those of others in several places, each with another offset of "
                "its clock: traffic in both directions, a measured clock or a scan tells them apart"
            )
        if self.z_score < _CLEAR_Z:
            return Text("its vehicles fit those of others in several places")
        return None


def find_place(
    choices: Sequence[Choice], others: Mapping[str, Choice], *, reach_s: float = 0.0
) -> Placing:
    """Find the shift at which a sensor's vehicles agree with those of others.

    Parameters
    ----------
    choices : sequence of Choice
        The sensor's poses by single localization: one, or several that fit alike.
    others : mapping
        Sensors with a known pose, by name.
    reach_s : float
        Largest clock offset that is tried, seconds: along a road, an offset of the clock looks
        like a shift of the sensor.
    """
    tracks = 1 + max((int(c.seen.track.max(initial=-1)) for c in choices), default=-1)
    inside: list[Shift] = []
    beyond: list[Shift] = []
    chance: list[Shift] = []
    most_moments = round(reach_s / MOMENT_S)
    for number, choice in enumerate(choices):
        steps, within = _grid(choice.covariance)
        for ahead in range(-most_moments, most_moments + 1):
            score = _ShiftScorer(choice, others, tracks, ahead)
            inside += score.best(number, steps[within])
            if ahead == 0 and len(choices) == 1:
                beyond += score.best(number, steps[~within])
        for ahead in [round(each / MOMENT_S) for each in _CHANCE_S]:
            chance += _ShiftScorer(choice, others, tracks, ahead).best(number, steps)[:1]

    def above_chance(shift: Shift) -> bool:
        z_scores = (preference(shift.scores, each.scores) for each in chance)
        return min(z_scores, default=math.inf) > _CLEAR_Z

    inside, beyond = [s for s in inside if above_chance(s)], [s for s in beyond if above_chance(s)]
    unshifted = max((s for s in inside if not s.ahead), key=total_score, default=None)
    best = _best_shift(inside, unshifted)
    rivals: dict[bool, list[Shift]] = {True: [], False: []}  # with the same offset of the clock
    for shift in inside:
        if best is not None and _different_answers(choices, best, shift):
            rivals[shift.ahead == best.ahead].append(shift)
    candidates = [s for s in (unshifted, _contradiction(unshifted, beyond)) if s is not None]
    return Placing(
        inside=best,
        z_score=_least_preference(best, rivals[True]),
        clock_z=_least_preference(best, rivals[False]),
        scores_in_time=max(candidates, key=total_score).scores if candidates else np.empty(0),
        beyond=_contradiction(best, beyond),
    )


def _best_shift(allowed: Sequence[Shift], in_time: Shift | None) -> Shift | None:
    """Return the best shift, with a clock offset only if its z score reaches `OFFSET_Z`."""
    best = max(allowed, key=total_score, default=None)
    if best is None or in_time is None or preference(best.scores, in_time.scores) >= OFFSET_Z:
        return best
    return in_time


def _least_preference(best: Shift | None, rivals: Sequence[Shift]) -> float:
    """Return the least z score of the best shift over its rivals; 0 without a best one."""
    if best is None:
        return 0.0
    return min((preference(best.scores, each.scores) for each in rivals), default=math.inf)


def _contradiction(best: Shift | None, beyond: Sequence[Shift]) -> Shift | None:
    """Return the best shift outside the confidence region that is clearly better than `best`."""
    if best is not None:
        beyond = [
            shift
            for shift in beyond
            if np.hypot(*(shift.step - best.step)[:2]) > 2.0 * STEP_M
            and preference(shift.scores, best.scores) > _CLEAR_Z
        ]
    return max(beyond, key=total_score, default=None)


def _different_answers(choices: Sequence[Choice], one: Shift, other: Shift) -> bool:
    """Return whether two shifts are so far apart that the adjustment does not merge them."""
    ends = [choices[shift.choice].seen.place[:2] + shift.step[:2] for shift in (one, other)]
    apart_m = float(np.hypot(*(ends[1] - ends[0])))
    if one.choice == other.choice:
        return apart_m > _APART_M
    return apart_m > 2.0 * STEP_M or choices[one.choice].differs_in_yaw(choices[other.choice])


def preference(scores: Floats, others: Floats) -> float:
    """Return the z score of one shift over another, by the scores of tracks (Vuong 1989)."""
    longest = max(len(scores), len(others))
    first, second = (np.pad(each, (0, longest - len(each))) for each in (scores, others))
    gain = (first - second)[(first > 0.0) | (second > 0.0)]
    return z_score(gain) if len(gain) > 1 else 0.0


def _grid(covariance: Floats) -> tuple[Floats, Booleans]:
    """Return steps of easting, northing, yaw, and which are within the confidence region."""
    values, axes = np.linalg.eigh(covariance[:2, :2])
    far_m = math.sqrt(CONTRADICTION_CHI2) * np.sqrt(values)
    far_m = np.clip(far_m, _REACH_M, FARTHEST_TRACK_M)
    half = np.ceil(far_m / STEP_M).astype(np.int64)
    major, minor = np.mgrid[-half[0] : half[0] + 1, -half[1] : half[1] + 1] * STEP_M
    along_axes = np.stack([major.ravel(), minor.ravel()], axis=1)
    chi2 = np.sum(along_axes**2 / values, axis=1)
    inside = chi2 < CONTRADICTION_CHI2
    east_north = along_axes @ axes.T
    # the yaw of a step is its expectation given the displacement
    turn = east_north @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2])
    return np.column_stack([east_north, np.where(inside, turn, 0.0)]), inside


class _ShiftScorer:
    """Scores shifts of a sensor by its correspondences with others, with one clock offset.

    Parameters
    ----------
    choice : Choice
        The pose from which shifts start.
    others : mapping
        Sensors with a known pose, by name.
    tracks : int
        Number of tracks of the sensor.
    ahead : int
        Assumed clock offset of the sensor, in moments.
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
            rows = compare_moments(other.seen.delayed(self.ahead), choice.seen)
            if not len(rows.tracks):
                continue
            covariance = np.zeros((2 * PLANAR, 2 * PLANAR))
            covariance[:PLANAR, :PLANAR] = other.covariance
            covariance[PLANAR:, PLANAR:] = loose
            gap, known = mean_gaps(rows, covariance)
            slope = rows.means(rows.poses)[:, :, PLANAR:]
            self.parts[name] = rows, gap, slope, np.asarray(np.linalg.inv(known))

    def best(self, choice: int, steps: Floats) -> list[Shift]:
        """Return the best shift of some steps, and the best of those `_APART_M` from it.

        Shifts with fewer than `LEAST_PAIRS` are left out.
        """
        if not self.parts or not len(steps):
            return []
        bounds = np.array([self._upper_bound(step) for step in steps])
        order = np.argsort(-bounds, kind="stable")
        first = self._best_of(choice, steps[order[:_MOST_SCORED]])
        apart = np.hypot(*(steps[order, :2] - first.step[:2]).T) > _APART_M
        shifts = [first]
        if apart.any():
            shifts.append(self._best_of(choice, steps[order[apart][:_MOST_SCORED]]))
        return [each for each in shifts if sum(each.pairs.values()) >= LEAST_PAIRS]

    def _best_of(self, choice: int, steps: Floats) -> Shift:
        """Return the shift of highest score."""
        shifts = [self._shift(choice, step) for step in steps]
        return max(shifts, key=total_score)

    def _chi2(self, name: str, step: Floats) -> Floats:
        """Return the chi-square of each pair with another sensor after a step."""
        _, gap, slope, inverse = self.parts[name]
        moved = gap + slope @ step
        return np.asarray(np.einsum("pi,pij,pj->p", moved, inverse, moved))

    def _upper_bound(self, step: Floats) -> float:
        """Return an upper bound of the score: a track of another sensor may be in several pairs."""
        total = 0.0
        for name, (rows, *_) in self.parts.items():
            gain = np.zeros(self.tracks)
            won = np.maximum(GATE_CHI2 - self._chi2(name, step), 0.0)
            np.maximum.at(gain, rows.tracks[:, 1], won)
            total += float(gain.sum())
        return total

    def _shift(self, choice: int, step: Floats) -> Shift:
        """Return the shift by a step, with the scores of an optimal assignment of tracks."""
        scores, pairs = np.zeros(self.tracks), {}
        for name, (rows, *_) in self.parts.items():
            chi2 = self._chi2(name, step)
            taken: Integers = assign(chi2, rows.tracks, GATE_CHI2)
            np.add.at(scores, rows.tracks[taken, 1], GATE_CHI2 - chi2[taken])
            pairs[name] = len(taken)
        return Shift(choice=choice, step=step, ahead=self.ahead, scores=scores, pairs=pairs)


def contradiction_text(names: Names, vehicles: int, gap_m: float) -> str:
    """Return the message that the poses of two sensors contradict each other."""
    return Text(
        "{} and {}: their poses contradict each other: {} vehicles that both see lie "
        "{:.1f} m apart",
        *names,
        vehicles,
        gap_m,
    )


def clash_text(names: Names, shift: Shift) -> str:
    """Return the message that the poses of two sensors contradict each other by a shift."""
    return contradiction_text(names, sum(shift.pairs.values()), float(np.hypot(*shift.step[:2])))

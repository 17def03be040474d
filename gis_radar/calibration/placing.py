"""Place a sensor by the vehicles that others see, too: shifts on a grid, and lags of its clock."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import scipy

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.calibration.certainty import z_score
from gis_radar.calibration.correspondences import (
    FARTHEST_M,
    FLAT,
    HALF_LENGTH_M,
    LEAST_ALIKE,
    LEAST_MOMENTS,
    LEAST_PAIRS,
    LEVEL_M,
    MOMENT_S,
    PLANE,
    SPEED_MPS,
    Moments,
    Rows,
    assign,
    compare,
    faces,
    mean_gaps,
)
from gis_radar.calibration.model import MODEL, Model

GATE_CHI2 = 13.8  # two degrees of freedom: 1 in 1000 true pairs is lost
# Grid on which the shift between two sensors is looked for, and how far at least.
STEP_M = 1.0
REACH_M = 6.0
# Shifts nearer than this, a vehicle's length, are one answer: the adjustment pulls them in.
APART_M = 5.0
# Standard deviations by which vehicles must prefer a place to all others (as for one sensor), and
# to what chance gives.
CLEAR_Z = 2.5
# What chance gives is seen where one sensor's times are wrong by so much: other traffic.
CHANCE_S: tuple[float, ...] = (-15.0, -8.0, 8.0, 15.0)
CONTRADICTION_CHI2 = 16.3  # three degrees of freedom: 1 in 1000 sites is refused in error

TRIED = 30  # shifts scored one to one, of those that look best
GRID_YAW = math.radians(0.5)  # between the headings that correspondences are looked for under
# Largest offset of clocks that is looked for: beyond it, radars have no common time at all.
MOST_LAG_S = 10.0
# Rates of clocks that are looked for: quartz keeps 1e-4, an ARS430 was 0.8 % slow.
CLOCK_RATES: tuple[float, ...] = (
    -0.012, -0.01, -0.008, -0.006, -0.004, -0.002, 0.002, 0.004, 0.006, 0.008, 0.01, 0.012,
)  # fmt: skip
# Votes for a lag nearer than this agree: a vehicle's length at 30 km/h, poses within 1 m.
LAG_S = 0.25
# Moments farther apart are of two places; slower vehicles fix no time.
LAG_PLACE_M = 4.0
LAG_SPEED_MPS = 3.0
# By how many standard deviations, as counts scatter, the votes for a lag exceed those for any
# other and for none, and with another rate those without: chance gave 3 in 13.
LAG_Z = 5.0
SAME_LAG_S = 1.0  # lags nearer than this are one


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One pose that a sensor alone may have.

    Parameters
    ----------
    seen : Moments
        Its vehicles, put on the map by it.
    covariance : (3, 3) array
        Of easting, northing, yaw.
    yaw : float
        Where it looks, radians.
    """

    seen: Moments
    covariance: Floats
    yaw: float = 0.0

    def later(self, moments: int) -> Choice:
        """Return it with all vehicles seen so many moments later."""
        return replace(self, seen=self.seen.later(moments))

    def turned(self, other: Choice) -> bool:
        """Whether another one looks elsewhere, by more than the grid allows for."""
        gap = (self.yaw - other.yaw + math.pi) % (2.0 * math.pi) - math.pi
        return abs(gap) > 2.0 * GRID_YAW


@dataclass(frozen=True, kw_only=True)
class Shift:
    """A pose of a sensor, and how well its vehicles there agree with those of others.

    Parameters
    ----------
    choice : int
        Which of the poses that it alone may have.
    step : (3,) array
        From there: easting, northing, yaw.
    scores : (tracks,) array
        Of each of its tracks.
    pairs : dict
        How many pairs there are with each other sensor, by name.
    """

    choice: int
    step: Floats
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
        The best place that the sensor's own answer allows; None where there are too few pairs.
    z_score : float
        By how many standard deviations its vehicles prefer that to other places allowed.
    beyond : Shift or None
        A place that its own answer rules out and its vehicles clearly prefer.
    """

    inside: Shift | None
    z_score: float
    beyond: Shift | None

    @property
    def best(self) -> Floats:
        """The scores of the better place; empty where there is none."""
        there = [each for each in (self.inside, self.beyond) if each is not None]
        return max(there, key=total_score).scores if there else np.empty(0)


def find_place(choices: Sequence[Choice], others: Mapping[str, Choice]) -> Placing:
    """Find the shift at which a sensor's vehicles agree with those of others.

    Parameters
    ----------
    choices : sequence of Choice
        The poses that the sensor alone may have: one, or several that fit alike.
    others : mapping
        Sensors that have a place, by name.
    """
    tracks = 1 + max((int(c.seen.track.max(initial=-1)) for c in choices), default=-1)
    allowed: list[Shift] = []
    beyond: list[Shift] = []
    chance: list[Shift] = []
    for number, choice in enumerate(choices):
        score = _Score(choice, others, tracks)
        steps, inside = _grid(choice.covariance)
        allowed += score.best(number, steps[inside])
        if len(choices) == 1:
            beyond += score.best(number, steps[~inside])
        for late_s in CHANCE_S:
            late = round(late_s / MOMENT_S)
            wrong = {name: other.later(late) for name, other in others.items()}
            chance += _Score(choice, wrong, tracks).best(number, steps)[:1]

    def good(shift: Shift) -> bool:
        z_scores = (preference(shift.scores, each.scores) for each in chance)
        return min(z_scores, default=math.inf) > CLEAR_Z

    allowed, beyond = [s for s in allowed if good(s)], [s for s in beyond if good(s)]
    best = max(allowed, key=total_score, default=None)
    rivals = [s for s in allowed if best is not None and _differ(choices, best, s)]
    z_score = min((preference(best.scores, s.scores) for s in rivals if best), default=math.inf)
    return Placing(
        inside=best,
        z_score=z_score if best is not None else 0.0,
        beyond=_contradiction(best, beyond),
    )


def _contradiction(best: Shift | None, beyond: Sequence[Shift]) -> Shift | None:
    """Return the place beyond a sensor's own answer that its vehicles clearly prefer to it."""
    if best is not None:
        beyond = [
            shift
            for shift in beyond
            if np.hypot(*(shift.step - best.step)[:2]) > 2.0 * STEP_M
            and preference(shift.scores, best.scores) > CLEAR_Z
        ]
    return max(beyond, key=total_score, default=None)


def _differ(choices: Sequence[Choice], one: Shift, other: Shift) -> bool:
    """Return whether two shifts give two answers: the fit merges near ones."""
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
    """Return steps of easting, northing, yaw, and which of them the sensor's answer allows."""
    values, axes = np.linalg.eigh(covariance[:2, :2])
    far_m = math.sqrt(CONTRADICTION_CHI2) * np.sqrt(values)
    far_m = np.clip(far_m, REACH_M, FARTHEST_M)
    half = np.ceil(far_m / STEP_M).astype(np.int64)
    u, v = np.mgrid[-half[0] : half[0] + 1, -half[1] : half[1] + 1] * STEP_M
    flat = np.stack([u.ravel(), v.ravel()], axis=1)
    chi2 = np.sum(flat**2 / values, axis=1)
    inside = chi2 < CONTRADICTION_CHI2
    east_north = flat @ axes.T
    # along what a scene does not fix, place and heading go together
    turn = east_north @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2])
    return np.column_stack([east_north, np.where(inside, turn, 0.0)]), inside


class _Score:
    """How well a sensor's vehicles agree with those of others, after a step."""

    def __init__(
        self,
        choice: Choice,
        others: Mapping[str, Choice],
        tracks: int,
    ) -> None:
        self.tracks = tracks
        self.parts: dict[str, tuple[Rows, Floats, Floats, Floats]] = {}
        loose = np.diag([STEP_M**2 / 3.0, STEP_M**2 / 3.0, GRID_YAW**2])
        for name, other in others.items():
            rows = compare(other.seen, choice.seen)
            if not len(rows.tracks):
                continue
            covariance = np.zeros((2 * PLANE, 2 * PLANE))
            covariance[:PLANE, :PLANE] = other.covariance
            covariance[PLANE:, PLANE:] = loose
            gap, known = mean_gaps(rows, covariance)
            slope = rows.means(rows.poses)[:, :, PLANE:]
            self.parts[name] = rows, gap, slope, np.asarray(np.linalg.inv(known))

    def best(self, choice: int, steps: Floats) -> list[Shift]:
        """Return the best of some steps, and the best of those apart from it."""
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
        return Shift(choice=choice, step=step, scores=scores, pairs=pairs)


@dataclass(frozen=True, kw_only=True)
class Lag:
    """How far the clock of a sensor is ahead of that of another.

    Parameters
    ----------
    offset_s : float
        Seconds, at the time `at`.
    rate : float
        By how much it runs fast, seconds a second.
    at : float
        UNIX seconds on its own clock.
    """

    offset_s: float = 0.0
    rate: float = 0.0
    at: float = 0.0

    def corrected(self, time: Floats) -> Floats:
        """Return times of this clock as the other one would have stamped them."""
        return np.asarray(time - self.offset_s - self.rate * (time - self.at))

    def later(self, offset_s: float) -> Lag:
        """Return a clock that is ahead by so much more."""
        return Lag(offset_s=self.offset_s + offset_s, rate=self.rate, at=self.at)


def find_lag(seen: Moments, others: Sequence[Moments]) -> Lag | None:
    """Find the lag at which a sensor's vehicles pass places where others saw vehicles pass.

    Each pair of tracks on one lane votes for the lag at which they are one vehicle; true pairs
    agree on it, at a clock of another rate on a line over time.

    Parameters
    ----------
    seen : Moments
        The vehicles of the sensor.
    others : sequence of Moments
        Those of sensors with a place.

    Returns
    -------
    Lag or None
        The one with clearly more votes than any other, and than no lag at all.
    """
    votes = pd.concat([_votes(other, seen) for other in others], ignore_index=True)
    if len(votes) < LEAST_PAIRS:
        return None
    lag, time = votes["lag"].to_numpy(), votes["time"].to_numpy()
    at = float(np.mean([time.min(), time.max()]))

    def exceeds(count: int, other: int) -> bool:
        return count - other > LAG_Z * math.sqrt(max(other, 1))

    offset, most = _most(lag)
    away = np.abs(lag - offset) > SAME_LAG_S
    second = _most(lag[away])[1] if away.any() else 0
    found = Lag(offset_s=offset, at=at)
    rates = [(*_most(lag - rate * (time - at)), rate) for rate in CLOCK_RATES]
    there, number, rate = max(rates, key=lambda each: each[1])
    if exceeds(number, most):
        near = np.abs(lag - rate * (time - at) - there) < LAG_S
        found, most = _line(lag[near], time[near], at), number
    none = int((np.abs(lag) < LAG_S).sum())
    return found if exceeds(most, max(second, none)) else None


def _most(lag: Floats) -> tuple[float, int]:
    """Return the lag about which most votes lie, and how many."""
    ordered = np.sort(lag)
    end = np.searchsorted(ordered, ordered + 2.0 * LAG_S, side="right")
    number = end - np.arange(len(ordered))
    first = int(number.argmax())
    return float(np.median(ordered[first : end[first]])), int(number[first])


def _line(lag: Floats, time: Floats, at: float) -> Lag:
    """Return the line through votes, by least squares without the farthest."""
    keep: Booleans = np.ones(len(lag), dtype=bool)
    for _ in range(3):
        rate, offset = np.polyfit(time[keep] - at, lag[keep], 1)
        off = np.abs(lag - offset - rate * (time - at))
        keep = off <= 2.0 * max(float(np.median(off)), 0.05)
    return Lag(offset_s=float(offset), rate=float(rate), at=at)


def _votes(one: Moments, other: Moments, model: Model = MODEL) -> pd.DataFrame:
    """Return for each pair of tracks that pass the same places its lag, and when that was."""
    a, b = _near(one, other)
    begin, end = _middles(one, model)[a], _middles(other, model)[b]
    speed = (one.speed[a] + other.speed[b]) / 2.0
    alike = (
        (np.sum(one.along[a] * other.along[b], axis=1) > LEAST_ALIKE)
        & (np.abs(one.speed[a] - other.speed[b]) < SPEED_MPS)
        & (np.abs(begin[:, 2] - end[:, 2]) < LEVEL_M)
        & (speed > LAG_SPEED_MPS)
    )
    a, b = a[alike], b[alike]
    gap = np.sum(one.along[a] * (end - begin)[alike, FLAT], axis=1)
    late = (other.moment[b] - one.moment[a]) * MOMENT_S - gap / speed[alike]
    table = pd.DataFrame({
        "one": one.track[a], "other": other.track[b], "lag": late,
        "time": (other.moment[b] + 0.5) * MOMENT_S,
    })  # fmt: skip
    both = table.groupby(["one", "other"])
    found = both[["lag", "time"]].median()
    found["apart"] = both["lag"].quantile(0.75) - both["lag"].quantile(0.25)
    found = found[both.size() >= LEAST_MOMENTS]
    good = (found["apart"] < 2.0 * LAG_S) & (found["lag"].abs() < MOST_LAG_S)
    return found[good].reset_index()


def _near(one: Moments, other: Moments) -> tuple[Integers, Integers]:
    """Return pairs of moments at one place within the largest lag."""
    first = one.moment.min(initial=0)
    trees = []
    for seen in (one, other):
        late_s = (seen.moment - first) * MOMENT_S
        at = np.column_stack([
            seen.points[:, FLAT] / LAG_PLACE_M, late_s / MOST_LAG_S
        ])  # fmt: skip
        trees.append(scipy.spatial.cKDTree(at))
    pairs = trees[0].sparse_distance_matrix(trees[1], 1.0, p=np.inf, output_type="coo_matrix")
    return np.asarray(pairs.row), np.asarray(pairs.col)


def _middles(seen: Moments, model: Model) -> Floats:
    """Return the middles of the vehicles, by the faces that are seen."""
    shown, points = faces(seen, model), seen.points.copy()
    left = np.column_stack([-seen.along[:, 1], seen.along[:, 0]])
    ends = HALF_LENGTH_M * (1.0 - shown.side) * shown.ahead
    points[:, FLAT] += ends[:, None] * seen.along
    points[:, FLAT] += (model.half_width * shown.side * shown.left)[:, None] * left
    return np.asarray(points)

"""The alarm: small moves of a sensor, noticed against what it saw in its own first hour.

Where in their lanes drivers keep, and the map's own error, are known to some decimetres only, but
are the same before and after a move. So the mean place of vehicles in each cell of the lanes is
learnt as the sensor sees it, and the newest minutes are compared with it: a move shifts all lanes
together, a change of habit or an obstacle one of them.

The evidence about the cells' means `m` is kept as normal equations `A m = b`, in which each
vehicle's own place in the lane is eliminated (a random effect, so vehicles are the units and not
their detections); only sums of these are stored. Reference (A, b) and newest blocks (A', b') give
the move: `A m = b`, `A' (m + K x) = b'`, where `x` is the move and the change of drivers' habits.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.monitoring.kalman_filter import DRIFT, HOUR_S
from gis_radar.calibration.monitoring.lane_places import WITHIN_M, Cells, LanePlaces

# *Measured* is on two hours of the sample junction, simulated as recorded (`bench/alarm.py`).
BLOCK_S = 60.0  # traffic is summed by blocks, and tested at the end of each
SETTLE_S = 7.0  # a vehicle counts in the block that holds this time after its last detection
# Newest blocks that are tested: five for a strong move, nine for a small one (with SETTLE_S within
# ten minutes), thirty for light traffic.
BLOCKS = (5, 9, 30)
# Largest share of all blocks that is tested: five blocks are tested from 15 minutes on, nine from
# 27 on, thirty from 90 on.
SHARE = 0.34
# The reference is the first hour; then it forgets with a time constant of an hour or of
# REFERENCE_VEHICLES, whichever is longer, to follow slow changes.
REFERENCE_H, REFERENCE_VEHICLES = 1.0, 1000
# Scatter between blocks over that of independent vehicles, a ratio of variances (broken tracks,
# platoons; measured 1.4 to 2.1): its prior mean, and the blocks that this prior counts for.
DISPERSION, DISPERSION_BLOCKS = 2.0, 20.0
# Standard deviations of drivers' habit on a stretch beyond which a change is taken for an obstacle
# and weighs less and less.
OUTLIER = 2.0
# Score beyond which a move is noticed: 0.2 false alarms a month, 95 % under 2.0, by the tail of 240
# hours of changing traffic (`bench/alarm.py`).
GATE = 24.0

TAPER_M = 1.3  # farther from the middle of its lane a vehicle counts less and less
# Standard deviations: between vehicles, from cell to cell, and of one detection (faces, bearing).
# Measured: 0.35, 0.45 to 0.49, 0.3 to 0.6.
DRIVER_M = 0.35
SWAY_M = 0.46
HIT_M = 0.5
# The same for heights over the road; ELEVATION_RAD grows with range; measured.
TALL_M = 0.55
BUMP_M = 0.3
ELEVATION_HIT_M = 1.0
ELEVATION_RAD = 0.014
WARM_UP = 10  # blocks of reference with which the dispersion can be measured
LEAST_VEHICLES = 12  # fewer in the tested blocks contradict nothing
# Cells with less than so many vehicles in the reference do not measure dispersion.
KNOWN_VEHICLES = 3.0
# Nor do combinations of moves and habits with a smaller (scaled) eigenvalue of information.
LEAST_SEEN = 0.05
# How far drivers change their habit on a stretch within an hour, one standard deviation.
STRETCH_HABIT_M = 0.05
# The same for all drivers at once (rain, night), and for where vehicles reflect across the sight
# (trucks are broader).
COMMON_M = 0.05
BREADTH_M = 0.02
# The same for heights over the road: on a stretch, of all vehicles at once.
HEIGHT_HABIT_M = 0.08
TALLER_M = 0.15
ROUNDS = 4  # reweightings of stretches

FREE = RIDGE = 1e-6  # information of a prior that knows nothing, 1/m^2
MOVE = 6


@dataclass(frozen=True, kw_only=True)
class Habits:
    """Evidence of some vehicles about the mean place in each cell, as normal equations.

    Parameters
    ----------
    cell : (c,) array
        The cells that they drove through, ascending.
    weight : (c, c) array
        A, 1/m^2.
    gradient : (c,) array
        b, 1/m.
    vehicles : float
        Number of vehicles, forgotten ones counted in part.
    time : float
        Mean time of the vehicles, UNIX seconds.
    """

    cell: Integers
    weight: Floats
    gradient: Floats
    vehicles: float = 0.0
    time: float = 0.0

    def __add__(self, other: Habits) -> Habits:
        """Return the evidence of both together."""
        cell = np.union1d(self.cell, other.cell)
        (weight, gradient), (more, steeper) = self.over(cell), other.over(cell)
        vehicles = self.vehicles + other.vehicles
        whole = self.vehicles * self.time + other.vehicles * other.time
        return Habits(
            cell=cell,
            weight=weight + more,
            gradient=gradient + steeper,
            vehicles=vehicles,
            time=whole / vehicles if vehicles else other.time,
        )

    def over(self, cell: Integers) -> tuple[Floats, Floats]:
        """Return weight and gradient for a list of cells that holds all of its own."""
        if len(cell) == len(self.cell):
            return self.weight, self.gradient
        place = np.searchsorted(cell, self.cell)
        weight, gradient = np.zeros((len(cell), len(cell))), np.zeros(len(cell))
        weight[np.ix_(place, place)] = self.weight
        gradient[place] = self.gradient
        return weight, gradient

    def kept(self, share: float) -> Habits:
        """Return a share of the evidence; the rest is forgotten."""
        return replace(
            self,
            weight=share * self.weight,
            gradient=share * self.gradient,
            vehicles=share * self.vehicles,
        )

    def where(self, good: Booleans) -> Habits:
        """Return the evidence about some cells, with the means of the others eliminated."""
        if good.all():
            return self
        cut = self.weight[np.ix_(good, ~good)]
        inner = self.weight[np.ix_(~good, ~good)] + RIDGE * np.eye(int((~good).sum()))
        gain = np.linalg.solve(inner, cut.T).T
        return replace(
            self,
            cell=self.cell[good],
            weight=self.weight[np.ix_(good, good)] - gain @ cut.T,
            gradient=self.gradient[good] - gain @ self.gradient[~good],
        )


NOTHING = Habits(cell=np.empty(0, dtype=np.int64), weight=np.empty((0, 0)), gradient=np.empty(0))


def habits_of(
    seen: LanePlaces, value: Floats, *, sigma: tuple[float, Floats, float], time: float
) -> Habits:
    """Sum up vehicles; the rows of one have `V = driver^2 11' + diag(sway^2 + hit^2/n)`.

    Parameters
    ----------
    seen : LanePlaces
        Places of some vehicles, a row a vehicle and cell.
    value : (n,) array
        The coordinate that is averaged (place in the lane or height), metres; NaN is left out.
    sigma : (float, (c,) array, float)
        Standard deviations between vehicles, between a vehicle's cells (by cell), and of one
        detection.
    time : float
        UNIX seconds.
    """
    good = np.isfinite(value)
    cell, column = np.unique(seen.cell[good], return_inverse=True)
    driver, sway, hit = sigma
    precision = 1.0 / (sway[seen.cell[good]] ** 2 + hit**2 / seen.count[good])
    rows = np.zeros((seen.vehicles, len(cell)))
    rows[seen.vehicle[good], column] = precision
    gain = 1.0 / (driver**-2 + rows.sum(axis=1))
    force = np.zeros((seen.vehicles, len(cell)))
    force[seen.vehicle[good], column] = precision * value[good]
    weight = np.diag(rows.sum(axis=0)) - (rows * gain[:, None]).T @ rows
    gradient = force.sum(axis=0) - rows.T @ (gain * force.sum(axis=1))
    return Habits(
        cell=cell, weight=weight, gradient=gradient, vehicles=float(seen.vehicles), time=time
    )


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """A move of a sensor that explains what changed.

    Parameters
    ----------
    score : float
        How far it is beyond chance: the chi-square of the moved components, reduced for the heavy
        tails of few vehicles or targets.
    seconds : float
        Length of the newest time that was tested, seconds.
    move : (6,) array
        Metres, and a turn about the map's axes in radians; zeros where nothing is known.
    covariance : (6, 6) array
        Of the move.
    """

    score: float
    seconds: float
    move: Floats
    covariance: Floats

    def turned(self, turn: Floats) -> Displacement:
        """Turn a displacement in the sensor's axes into the map's, by `turn` = `R_map_sensor`."""
        both = np.kron(np.eye(2), turn)
        return replace(self, move=both @ self.move, covariance=both @ self.covariance @ both.T)


@dataclass(frozen=True, kw_only=True)
class ChangeDetector:
    """A coordinate of vehicles that moves of the sensor change: place in the lane, or height.

    Parameters
    ----------
    moved : tuple of int
        Which components of a move it shows.
    by_move : (c, d) array
        By how much each of them changes the mean of each cell.
    by_habit : (c, k) array
        The same for habits that change for all vehicles at once.
    habit_m : (k,) array
        Change of these habits within an hour, one standard deviation.
    stretch : (c,) array
        The stretch of each cell.
    stretch_m : float
        Change of the habit on a stretch, one standard deviation.
    sigma : (float, (c,) array, float)
        As for :func:`habits_of`.
    edge_m : (float, float)
        Distances from the middle of the lane up to which a place counts fully, and from which on
        not at all; infinite where every place counts fully.
    """

    moved: tuple[int, ...]
    by_move: Floats
    by_habit: Floats
    habit_m: Floats
    stretch: Integers
    stretch_m: float
    sigma: tuple[float, Floats, float]
    edge_m: tuple[float, float]

    def counted(self, value: Floats) -> tuple[Floats, Floats]:
        """Return places tapered towards the lane's edge, and the slope (Hampel's function).

        A vehicle beyond the edge of its lane is taken for one in the next, on the other side of its
        middle. So places near an edge are tapered; the slope tells by how much smaller that makes
        a move look.
        """
        full_m, edge_m = self.edge_m
        slope = np.where(np.isfinite(value), 1.0, np.nan)
        if not np.isfinite(edge_m):
            return value, slope
        steep = full_m / (edge_m - full_m)
        size = np.abs(value)
        tapered = np.sign(value) * np.maximum(full_m - steep * (size - full_m), 0.0)
        falling = np.where(size < edge_m, -steep, 0.0)
        return np.where(size > full_m, tapered, value), np.where(size > full_m, falling, slope)


def detectors(cells: Cells, place: Floats) -> tuple[ChangeDetector, ChangeDetector]:
    """Return the detectors of place in the lane (moves in the plane) and of height (tilts).

    With the old pose, a sensor that has moved by `d` and turned by `w` shows a point at the
    offset `a` from it at `a - d - w x a`.

    Parameters
    ----------
    cells : Cells
        The lanes.
    place : (2,) array
        Of the sensor, local coordinates.
    """
    arm, left = cells.centre - place, cells.left
    side = np.sum(arm * left, axis=1) / np.maximum(np.hypot(*arm.T), 1.0)
    ones = np.ones(len(cells))
    turned = left[:, 1] * arm[:, 0] - left[:, 0] * arm[:, 1]
    across = ChangeDetector(
        moved=(0, 1, 5),
        by_move=-np.column_stack([left, turned]),
        by_habit=np.column_stack([ones, -side]),
        habit_m=np.array([COMMON_M, BREADTH_M]),
        stretch=cells.stretch,
        stretch_m=STRETCH_HABIT_M,
        sigma=(DRIVER_M, SWAY_M * ones, HIT_M),
        edge_m=(TAPER_M, WITHIN_M),
    )
    bump_m = np.hypot(BUMP_M, ELEVATION_RAD * np.hypot(*arm.T))
    over = ChangeDetector(
        moved=(3, 4),
        by_move=np.column_stack([-arm[:, 1], arm[:, 0]]),
        by_habit=ones[:, None],
        habit_m=np.array([TALLER_M]),
        stretch=cells.stretch,
        stretch_m=HEIGHT_HABIT_M,
        sigma=(TALL_M, bump_m, ELEVATION_HIT_M),
        edge_m=(np.inf, np.inf),
    )
    return across, over


class Memory:
    """The reference of a change detector, and its newest blocks.

    Parameters
    ----------
    detector : ChangeDetector
        The coordinate that is followed.
    """

    def __init__(self, detector: ChangeDetector) -> None:
        self.detector = detector
        self.reference = NOTHING
        self.learnt = 0
        self._recent: deque[Habits] = deque()
        self._scatter = np.zeros(2)  # squares, and how many blocks
        self._slope = np.zeros(2)  # of `ChangeDetector.counted`, summed, and how many places
        effects = np.eye(int(detector.stretch.max(initial=-1)) + 1)[detector.stretch]
        self._effects = np.hstack([detector.by_move, detector.by_habit, effects])
        self._drift = np.diag(np.square(DRIFT)[list(detector.moved)]) / HOUR_S

    @property
    def dispersion(self) -> float:
        """Scatter of blocks over that of independent vehicles, a ratio of variances, at least 1."""
        squares, blocks = DISPERSION_BLOCKS * DISPERSION, DISPERSION_BLOCKS
        return float(max((squares + self._scatter[0]) / (blocks + self._scatter[1]), 1.0))

    def push(self, seen: LanePlaces, value: Floats, time: float) -> None:
        """Add the newest block; blocks that are no longer tested join the reference."""
        value, slope = self.detector.counted(value)
        self._slope += [np.nansum(slope), np.isfinite(slope).sum()]
        self._recent.append(habits_of(seen, value, sigma=self.detector.sigma, time=time))
        held = SHARE * (self.learnt + len(self._recent))
        while len(self._recent) > min(max(held, BLOCKS[-2]), BLOCKS[-1]):
            self._learn(self._recent.popleft())

    def _learn(self, block: Habits) -> None:
        if self.learnt >= WARM_UP and block.vehicles >= LEAST_VEHICLES:
            self._measure_scatter(block)
        self.learnt += 1
        share = 1.0
        hours = self.learnt * BLOCK_S / HOUR_S
        if hours > REFERENCE_H and self.reference.vehicles > REFERENCE_VEHICLES:
            forgotten = block.vehicles / self.reference.vehicles
            share = 1.0 - min(BLOCK_S / HOUR_S / REFERENCE_H, forgotten)
        self.reference = self.reference.kept(share) + block

    def _measure_scatter(self, block: Habits) -> None:
        """Compare a block with the reference: `b - A m` has covariance `A + A A_ref^-1 A`."""
        detector = self.detector
        least = KNOWN_VEHICLES / detector.sigma[0] ** 2
        before = self.reference.where(np.diag(self.reference.weight) > least)
        part = block.where(np.isin(block.cell, before.cell))
        if len(part.cell) == 0:
            return
        weight, gradient = part.over(before.cell)
        factor = _factor(before.weight)
        columns = detector.by_move.shape[1] + detector.by_habit.shape[1]
        design = self._effects[before.cell, :columns]
        weighted = weight @ design
        rest = gradient - weight @ cho_solve(factor, before.gradient)
        square = design.T @ weighted + weighted.T @ cho_solve(factor, weighted)
        scale = np.sqrt(np.maximum(np.diag(square), RIDGE))
        values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
        seen = values > LEAST_SEEN
        score = vectors.T @ (design.T @ rest / scale)
        self._scatter += [np.mean(np.square(score[seen]) / values[seen]), 1.0]

    def displacements(self, now: float) -> list[Displacement]:
        """Return the likeliest move for each tested number of newest blocks."""
        found = []
        newest, tested = NOTHING, {}
        every = self.learnt + len(self._recent)
        for number, block in enumerate(reversed(self._recent), start=1):
            newest = newest + block
            if number in BLOCKS and number <= SHARE * every:
                tested[number] = newest
        whole = self.reference + newest
        for number, part in tested.items():
            if part.vehicles >= LEAST_VEHICLES:
                found.append(self._displacement(whole, part, number, now))
        return found

    def _displacement(self, whole: Habits, newest: Habits, blocks: int, now: float) -> Displacement:
        moved = list(self.detector.moved)
        mean, covariance = self._solved(whole, newest)
        before = max(whole.vehicles - newest.vehicles, 1.0)
        time = (whole.vehicles * whole.time - newest.vehicles * newest.time) / before
        # a random walk: from about the middle of each to now
        lag_s = max(now - 0.5 * (newest.time + time), 0.0)
        covariance = covariance + lag_s * self._drift
        chi2 = float(mean @ np.linalg.solve(covariance, mean))
        score = newest.vehicles * float(np.log1p(chi2 / newest.vehicles))
        move, every = np.zeros(MOVE), np.zeros((MOVE, MOVE))
        move[moved] = mean
        every[np.ix_(moved, moved)] = covariance
        seconds = blocks * BLOCK_S
        return Displacement(score=score, seconds=seconds, move=move, covariance=every)

    def _solved(self, whole: Habits, newest: Habits) -> tuple[Floats, Floats]:
        """Return the move and its covariance, with cells and habits eliminated."""
        detector = self.detector
        there = np.flatnonzero(np.any(self._effects[newest.cell] != 0.0, axis=0))
        slope = self._slope[0] / self._slope[1]
        effects, size = slope * self._effects[np.ix_(whole.cell, there)], len(detector.moved)
        weight, gradient = newest.over(whole.cell)
        weighted = weight @ effects
        both = cho_solve(_factor(whole.weight), weighted)
        information = (effects.T @ weighted - weighted.T @ both) / self.dispersion
        force = (effects.T @ gradient - both.T @ whole.gradient) / self.dispersion
        first = np.concatenate([np.full(size, FREE), detector.habit_m**-2.0])
        usual_m = detector.stretch_m
        spread = np.full(len(there) - len(first), usual_m)
        for _ in range(ROUNDS):
            prior = np.diag(np.concatenate([first, spread**-2.0]))
            covariance = np.linalg.inv(information + prior)
            answer = covariance @ force
            off = np.abs(answer[len(first) :]) / (OUTLIER * usual_m)
            spread = usual_m * np.maximum(off, 1.0)
        return answer[:size], covariance[:size, :size]


def _factor(weight: Floats) -> tuple[Floats, bool]:
    return cho_factor(weight + RIDGE * np.eye(len(weight)))


class Alarm:
    """Alarm of small moves of a sensor, from where vehicles drive in their lanes.

    Parameters
    ----------
    cells : Cells
        Cells of the lanes around the sensor.
    place : (2,) array
        The sensor's place, local coordinates.
    """

    def __init__(self, cells: Cells, place: Floats) -> None:
        self.memories = [Memory(each) for each in detectors(cells, place)]

    def push(self, seen: LanePlaces, time: float) -> Displacement | None:
        """Add the vehicles of a block that ended at a time; return the likeliest move, if any.

        Parameters
        ----------
        seen : LanePlaces
            Places of the block's vehicles.
        time : float
            UNIX seconds.
        """
        found: list[Displacement] = []
        for memory, value in zip(self.memories, (seen.across_m, seen.over_m), strict=True):
            memory.push(seen, value, time)
            found += memory.displacements(time)
        return max(found, key=lambda shift: shift.score, default=None)

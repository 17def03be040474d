"""Detect small moves of a sensor by a change of the vehicles' mean offsets in their lanes.

Drivers' offsets and the map's error are known to some decimetres only, but do not change with a
move of the sensor. The mean offset in each cell of the lanes is learnt as a reference, from the
first hour on, and compared with that of the newest minutes: a move changes it on all lanes, an
obstacle or a new habit of drivers on one.

The information about the cells' means `m` is stored as normal equations `A m = b`, in which the
random effect of each vehicle is eliminated, so that vehicles are the units. Reference (A, b) and
newest blocks (A', b') give the move: `A m = b`, `A' (m + K x) = b'`, where `x` are the move and
changes of drivers' habits.
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
BLOCK_S = 60.0  # length of a block of traffic; tests are made at its end
SETTLE_S = 7.0  # time after its last detection at which a vehicle is assigned to a block
# Numbers of newest blocks that are tested: five for a strong move, nine for a small one (with
# SETTLE_S within ten minutes), thirty for light traffic.
BLOCKS = (5, 9, 30)
# Largest share of all blocks that is tested: five blocks are tested from 15 minutes on, nine from
# 27 on, thirty from 90 on.
SHARE = 0.34
# The reference is the first hour; then it forgets with a time constant of an hour or of
# REFERENCE_VEHICLES, whichever is longer, to follow slow changes.
REFERENCE_H, REFERENCE_VEHICLES = 1.0, 1000
# Variance between blocks over that of independent vehicles (broken tracks, platoons; measured 1.4
# to 2.1): prior mean, and number of blocks as which the prior counts.
DISPERSION, DISPERSION_BLOCKS = 2.0, 20.0
# A change on a stretch beyond so many standard deviations of drivers' habit is taken for an
# obstacle and has a lower weight.
OUTLIER = 2.0
# Least score of a significant move: 0.2 false alarms a month, below 2.0 with 95 % confidence, by
# the tail of 240 hours of changing traffic (`bench/alarm.py`).
GATE = 24.0

TAPER_M = 1.3  # offsets beyond this have a lower weight
# Standard deviations of offsets: between vehicles, between cells of a vehicle, and of a detection
# (faces, azimuth). Measured: 0.35, 0.45 to 0.49, 0.3 to 0.6.
DRIVER_M = 0.35
SWAY_M = 0.46
HIT_M = 0.5
# The same of heights over the road; that between cells grows with range by ELEVATION_RAD; measured.
TALL_M = 0.55
BUMP_M = 0.3
ELEVATION_HIT_M = 1.0
ELEVATION_RAD = 0.014
WARM_UP = 10  # least number of blocks in the reference to measure the dispersion
LEAST_VEHICLES = 12  # least number of vehicles in tested blocks
# The dispersion is measured in cells with so many vehicles in the reference, ...
KNOWN_VEHICLES = 3.0
# ... and by combinations of moves and habits with a (scaled) eigenvalue of information above this.
LEAST_SEEN = 0.05
# 1 sigma of the change within an hour of drivers' offsets on a stretch, ...
STRETCH_HABIT_M = 0.05
# ... of all drivers' offsets (rain, night), and of the visible half width (trucks are broader).
COMMON_M = 0.05
BREADTH_M = 0.02
# 1 sigma of the change within an hour of heights on a stretch, and of all vehicles.
HEIGHT_HABIT_M = 0.08
TALLER_M = 0.15
ROUNDS = 4  # reweightings of stretches

FREE = RIDGE = 1e-6  # information of a vague prior, 1/m^2
MOVE = 6  # number of components of a move


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Normal equations of the mean offset or height in each cell, from some vehicles.

    Parameters
    ----------
    cell : (c,) array
        The cells with vehicles, ascending.
    weight : (c, c) array
        A, 1/m^2.
    gradient : (c,) array
        b, 1/m.
    vehicles : float
        Number of vehicles, reduced by forgetting.
    time : float
        Mean time of the vehicles, UNIX seconds.
    """

    cell: Integers
    weight: Floats
    gradient: Floats
    vehicles: float = 0.0
    time: float = 0.0

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return the sum of both normal equations."""
        cell = np.union1d(self.cell, other.cell)
        (weight, gradient), (other_weight, other_gradient) = (
            self.expanded(cell),
            other.expanded(cell),
        )
        vehicles = self.vehicles + other.vehicles
        time_sum = self.vehicles * self.time + other.vehicles * other.time
        return NormalEquations(
            cell=cell,
            weight=weight + other_weight,
            gradient=gradient + other_gradient,
            vehicles=vehicles,
            time=time_sum / vehicles if vehicles else other.time,
        )

    def expanded(self, cell: Integers) -> tuple[Floats, Floats]:
        """Return weight and gradient for a superset of its cells."""
        if len(cell) == len(self.cell):
            return self.weight, self.gradient
        place = np.searchsorted(cell, self.cell)
        weight, gradient = np.zeros((len(cell), len(cell))), np.zeros(len(cell))
        weight[np.ix_(place, place)] = self.weight
        gradient[place] = self.gradient
        return weight, gradient

    def scaled(self, share: float) -> NormalEquations:
        """Return the normal equations times `share`: the rest is forgotten."""
        return replace(
            self,
            weight=share * self.weight,
            gradient=share * self.gradient,
            vehicles=share * self.vehicles,
        )

    def marginal(self, keep: Booleans) -> NormalEquations:
        """Return the normal equations of some cells, with the means of the others eliminated."""
        if keep.all():
            return self
        cross = self.weight[np.ix_(keep, ~keep)]
        inner = self.weight[np.ix_(~keep, ~keep)] + RIDGE * np.eye(int((~keep).sum()))
        gain = np.linalg.solve(inner, cross.T).T
        return replace(
            self,
            cell=self.cell[keep],
            weight=self.weight[np.ix_(keep, keep)] - gain @ cross.T,
            gradient=self.gradient[keep] - gain @ self.gradient[~keep],
        )


NO_EVIDENCE = NormalEquations(
    cell=np.empty(0, dtype=np.int64), weight=np.empty((0, 0)), gradient=np.empty(0)
)


def normal_equations(
    places: LanePlaces, value: Floats, *, sigma: tuple[float, Floats, float], time: float
) -> NormalEquations:
    """Return the normal equations of vehicles, with their random effects eliminated.

    The rows of a vehicle have the covariance `driver^2 11' + diag(sway^2 + hit^2/n)`.

    Parameters
    ----------
    places : LanePlaces
        Offsets of vehicles, a row for each vehicle and cell.
    value : (n,) array
        The value of each row that is averaged (offset or height), metres; NaN is left out.
    sigma : (float, (c,) array, float)
        Standard deviations between vehicles, between a vehicle's cells (by cell), and of one
        detection.
    time : float
        UNIX seconds.
    """
    known = np.isfinite(value)
    cell, column = np.unique(places.cell[known], return_inverse=True)
    driver, sway, hit = sigma
    precision = 1.0 / (sway[places.cell[known]] ** 2 + hit**2 / places.count[known])
    rows = np.zeros((places.vehicles, len(cell)))
    rows[places.vehicle[known], column] = precision
    gain = 1.0 / (driver**-2 + rows.sum(axis=1))
    weighted = np.zeros((places.vehicles, len(cell)))
    weighted[places.vehicle[known], column] = precision * value[known]
    weight = np.diag(rows.sum(axis=0)) - (rows * gain[:, None]).T @ rows
    gradient = weighted.sum(axis=0) - rows.T @ (gain * weighted.sum(axis=1))
    return NormalEquations(
        cell=cell, weight=weight, gradient=gradient, vehicles=float(places.vehicles), time=time
    )


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Move of a sensor, estimated from a change of its data.

    Parameters
    ----------
    score : float
        Chi-square of the estimated components, reduced for the heavy tails of few vehicles or
        targets.
    seconds : float
        Length of the newest time that was tested, seconds.
    move : (6,) array
        Metres, and a turn about the map's axes in radians; zeros where nothing is known.
    covariance : (6, 6) array
        Covariance of the move.
    """

    score: float
    seconds: float
    move: Floats
    covariance: Floats

    def turned(self, turn: Floats) -> Displacement:
        """Rotate a displacement from the sensor's axes to the map's by `turn` = `R_map_sensor`."""
        rotation = np.kron(np.eye(2), turn)
        return replace(
            self, move=rotation @ self.move, covariance=rotation @ self.covariance @ rotation.T
        )


@dataclass(frozen=True, kw_only=True)
class ChangeDetector:
    """Model of a value of vehicles, offset or height, that changes with a move of the sensor.

    Parameters
    ----------
    moved : tuple of int
        Indices of the components of a move that it observes.
    by_move : (c, d) array
        Derivative of the mean of each cell by these components.
    by_habit : (c, k) array
        Derivative of the mean of each cell by changes that all vehicles share.
    habit_m : (k,) array
        1 sigma of these changes within an hour.
    stretch : (c,) array
        The stretch of each cell.
    stretch_m : float
        1 sigma of the change of a stretch.
    sigma : (float, (c,) array, float)
        As for :func:`normal_equations`.
    edge_m : (float, float)
        Absolute value up to which a value is not tapered, and that from which on it is 0; infinite
        for no taper.
    """

    moved: tuple[int, ...]
    by_move: Floats
    by_habit: Floats
    habit_m: Floats
    stretch: Integers
    stretch_m: float
    sigma: tuple[float, Floats, float]
    edge_m: tuple[float, float]

    def taper(self, value: Floats) -> tuple[Floats, Floats]:
        """Return values tapered to 0 at the lane's edge, and the slopes (Hampel's function).

        A vehicle beyond the edge of its lane is matched to the next lane with an offset of the
        other sign, so offsets near an edge are unreliable. The mean slope is the factor by which
        the taper reduces a move.
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
    """Return the detectors of offsets in the lane (moves in the plane) and of heights (tilts).

    Placed by the old pose, detections of a sensor that has moved by `d` and turned by `w` are
    displaced from the vector `a` to `a - d - w x a`.

    Parameters
    ----------
    cells : Cells
        The lanes.
    place : (2,) array
        Position of the sensor, local coordinates, metres.
    """
    offset, left = cells.centre - place, cells.left
    side = np.sum(offset * left, axis=1) / np.maximum(np.hypot(*offset.T), 1.0)
    ones = np.ones(len(cells))
    by_turn = left[:, 1] * offset[:, 0] - left[:, 0] * offset[:, 1]
    across = ChangeDetector(
        moved=(0, 1, 5),
        by_move=-np.column_stack([left, by_turn]),
        by_habit=np.column_stack([ones, -side]),
        habit_m=np.array([COMMON_M, BREADTH_M]),
        stretch=cells.stretch,
        stretch_m=STRETCH_HABIT_M,
        sigma=(DRIVER_M, SWAY_M * ones, HIT_M),
        edge_m=(TAPER_M, WITHIN_M),
    )
    bump_m = np.hypot(BUMP_M, ELEVATION_RAD * np.hypot(*offset.T))
    height = ChangeDetector(
        moved=(3, 4),
        by_move=np.column_stack([-offset[:, 1], offset[:, 0]]),
        by_habit=ones[:, None],
        habit_m=np.array([TALLER_M]),
        stretch=cells.stretch,
        stretch_m=HEIGHT_HABIT_M,
        sigma=(TALL_M, bump_m, ELEVATION_HIT_M),
        edge_m=(np.inf, np.inf),
    )
    return across, height


class Memory:
    """Reference of a change detector, and its newest blocks.

    Parameters
    ----------
    detector : ChangeDetector
        The model of the compared value.
    """

    def __init__(self, detector: ChangeDetector) -> None:
        self.detector = detector
        self.reference = NO_EVIDENCE
        self.learnt_blocks = 0
        self._recent: deque[NormalEquations] = deque()
        self._scatter = np.zeros(2)  # sum of squares, and number of blocks
        self._slope = np.zeros(2)  # sum of slopes of `ChangeDetector.taper`, and their number
        effects = np.eye(int(detector.stretch.max(initial=-1)) + 1)[detector.stretch]
        self._effects = np.hstack([detector.by_move, detector.by_habit, effects])
        self._drift = np.diag(np.square(DRIFT)[list(detector.moved)]) / HOUR_S

    @property
    def dispersion(self) -> float:
        """Variance between blocks over that of independent vehicles, at least 1."""
        squares, blocks = DISPERSION_BLOCKS * DISPERSION, DISPERSION_BLOCKS
        return float(max((squares + self._scatter[0]) / (blocks + self._scatter[1]), 1.0))

    def push(self, places: LanePlaces, value: Floats, time: float) -> None:
        """Add a block; blocks that are no longer tested are added to the reference."""
        value, slope = self.detector.taper(value)
        self._slope += [np.nansum(slope), np.isfinite(slope).sum()]
        self._recent.append(normal_equations(places, value, sigma=self.detector.sigma, time=time))
        most_recent = SHARE * (self.learnt_blocks + len(self._recent))
        while len(self._recent) > min(max(most_recent, BLOCKS[-2]), BLOCKS[-1]):
            self._join_reference(self._recent.popleft())

    def _join_reference(self, block: NormalEquations) -> None:
        """Add a block to the reference, which forgets by its time constant."""
        if self.learnt_blocks >= WARM_UP and block.vehicles >= LEAST_VEHICLES:
            self._measure_scatter(block)
        self.learnt_blocks += 1
        share = 1.0
        hours = self.learnt_blocks * BLOCK_S / HOUR_S
        if hours > REFERENCE_H and self.reference.vehicles > REFERENCE_VEHICLES:
            forgotten = block.vehicles / self.reference.vehicles
            share = 1.0 - min(BLOCK_S / HOUR_S / REFERENCE_H, forgotten)
        self.reference = self.reference.scaled(share) + block

    def _measure_scatter(self, block: NormalEquations) -> None:
        """Add the scatter of a block about the reference.

        The residual `b - A m` has the covariance `A + A A_ref^-1 A` for independent vehicles.
        """
        detector = self.detector
        least = KNOWN_VEHICLES / detector.sigma[0] ** 2
        reference = self.reference.marginal(np.diag(self.reference.weight) > least)
        common = block.marginal(np.isin(block.cell, reference.cell))
        if len(common.cell) == 0:
            return
        weight, gradient = common.expanded(reference.cell)
        factor = _factor(reference.weight)
        columns = detector.by_move.shape[1] + detector.by_habit.shape[1]
        design = self._effects[reference.cell, :columns]
        weighted = weight @ design
        residual = gradient - weight @ cho_solve(factor, reference.gradient)
        square = design.T @ weighted + weighted.T @ cho_solve(factor, weighted)
        scale = np.sqrt(np.maximum(np.diag(square), RIDGE))
        values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
        observable = values > LEAST_SEEN
        score = vectors.T @ (design.T @ residual / scale)
        self._scatter += [np.mean(np.square(score[observable]) / values[observable]), 1.0]

    def displacements(self, now: float) -> list[Displacement]:
        """Return the likeliest move for each number of newest blocks that is tested."""
        moves = []
        recent, tested = NO_EVIDENCE, {}
        count = self.learnt_blocks + len(self._recent)
        for number, block in enumerate(reversed(self._recent), start=1):
            recent = recent + block
            if number in BLOCKS and number <= SHARE * count:
                tested[number] = recent
        total = self.reference + recent
        for number, part in tested.items():
            if part.vehicles >= LEAST_VEHICLES:
                moves.append(self._displacement(total, part, number, now))
        return moves

    def _displacement(
        self, total: NormalEquations, newest: NormalEquations, blocks: int, now: float
    ) -> Displacement:
        """Return the move between the blocks before and the newest ones, with its score."""
        moved = list(self.detector.moved)
        mean, covariance = self._solve_move(total, newest)
        before = max(total.vehicles - newest.vehicles, 1.0)
        time = (total.vehicles * total.time - newest.vehicles * newest.time) / before
        # the pose drifts as a random walk between the mean times of both, and up to now
        lag_s = max(now - 0.5 * (newest.time + time), 0.0)
        covariance = covariance + lag_s * self._drift
        chi2 = float(mean @ np.linalg.solve(covariance, mean))
        score = newest.vehicles * float(np.log1p(chi2 / newest.vehicles))
        move, full_covariance = np.zeros(MOVE), np.zeros((MOVE, MOVE))
        move[moved] = mean
        full_covariance[np.ix_(moved, moved)] = covariance
        seconds = blocks * BLOCK_S
        return Displacement(score=score, seconds=seconds, move=move, covariance=full_covariance)

    def _solve_move(self, total: NormalEquations, newest: NormalEquations) -> tuple[Floats, Floats]:
        """Return the move and its covariance, with the cells' means and habits eliminated."""
        detector = self.detector
        involved = np.flatnonzero(np.any(self._effects[newest.cell] != 0.0, axis=0))
        slope = self._slope[0] / self._slope[1]
        effects, size = slope * self._effects[np.ix_(total.cell, involved)], len(detector.moved)
        weight, gradient = newest.expanded(total.cell)
        weighted = weight @ effects
        eliminated = cho_solve(_factor(total.weight), weighted)
        information = (effects.T @ weighted - weighted.T @ eliminated) / self.dispersion
        gradient_of_effects = (
            effects.T @ gradient - eliminated.T @ total.gradient
        ) / self.dispersion
        known_prior = np.concatenate([np.full(size, FREE), detector.habit_m**-2.0])
        usual_m = detector.stretch_m
        spread = np.full(len(involved) - len(known_prior), usual_m)
        for _ in range(ROUNDS):
            prior = np.diag(np.concatenate([known_prior, spread**-2.0]))
            covariance = np.linalg.inv(information + prior)
            solution = covariance @ gradient_of_effects
            excess = np.abs(solution[len(known_prior) :]) / (OUTLIER * usual_m)
            spread = usual_m * np.maximum(excess, 1.0)
        return solution[:size], covariance[:size, :size]


def _factor(weight: Floats) -> tuple[Floats, bool]:
    """Return the Cholesky factor of regularised normal equations."""
    return cho_factor(weight + RIDGE * np.eye(len(weight)))


class Alarm:
    """Alarm of small moves of a sensor, by offsets and heights of vehicles in their lanes.

    Parameters
    ----------
    cells : Cells
        Cells of the lanes around the sensor.
    place : (2,) array
        Position of the sensor, local coordinates, metres.
    """

    def __init__(self, cells: Cells, place: Floats) -> None:
        self.memories = [Memory(each) for each in detectors(cells, place)]

    def push(self, places: LanePlaces, time: float) -> Displacement | None:
        """Add the vehicles of a block that ended at a time; return the move of highest score.

        Parameters
        ----------
        places : LanePlaces
            Offsets of the block's vehicles.
        time : float
            UNIX seconds.
        """
        displacements: list[Displacement] = []
        for memory, value in zip(self.memories, (places.across_m, places.over_m), strict=True):
            memory.push(places, value, time)
            displacements += memory.displacements(time)
        return max(displacements, key=lambda shift: shift.score, default=None)

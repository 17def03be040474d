"""Detect small moves of a sensor by the stationary targets around it.

Walls, posts, signs, kerbs and parked cars return in frame after frame. The place of such a target
in the sensor's own frame changes only if the sensor moves: a move by `d` and a turn by `w` take it
from `a` to `a - d - w x a`. Each target also wanders by itself over seconds (neighbours and the
ground distort its angles), and it may be a car that leaves. So targets are the units: the part of
their displacements that no common move explains is their noise, whatever its cause and duration,
and is measured in the same comparison.

Memory holds a block of detections, a map of hits in range and azimuth, and some hundred targets.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.monitoring.alarm import Displacement
from gis_radar.calibration.monitoring.kalman_filter import DRIFT, HOUR_S, KNOCK
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS

# Reach and cells of the map of hits by range and azimuth: finer than a target's wander.
REACH_M = 300.0
CELL_M = 0.2
CELL_RAD = math.radians(0.4)
# *Recorded* is on recordings of an ARS548 (a target repeats to 0.01 m, 0.05 and 0.1 to 2 degrees;
# over seconds it wanders by 0.1 m, 0.15 and 1 degree), *measured* on `bench/alarm.py`.
BLOCK_S = 20.0  # length of a block, over which places are medians: longer than a shake; four cycles
SEARCH_BLOCKS = 15  # blocks between searches for new targets: five minutes
# Time constant, in blocks, of the mean places: 10 minutes, twice the longest test; over an hour the
# allowed drift of a mast would hide half a degree.
REFERENCE_BLOCKS = 30
BLOCKS = (6, 15)  # newest blocks that are tested for a move, longer than any gust
LEAST_TARGETS = 12  # fewer contradict nothing
WANTED_M, WANTED_RAD = 0.3, math.radians(0.5)  # move in the plane and turn that must be noticed
# Score beyond which a move is noticed, from 120 hours of changing days of one radar
# (`bench/alarm.py --seed 1`); false alarms on other hours are in docs/limits.md.
GATE = 28.0
FIRST_SEARCH = 6  # blocks before the first search for targets: two minutes
# Least hits a frame of a target. Recorded: cells hit in half of the frames or more hold 46 to 84 %
# of the still detections.
LEAST_RATE = 0.3
# Largest distance of a target's detection from its mean: three times the wander and the wanted
# move, to either side; across the sight the wanted move once more.
GATE_M = 0.7
GATE_RAD = math.radians(1.0)
# Least distance between targets: gates do not overlap at 100 m, and a parked car is two targets at
# most.
APART_M = 3.0
LEAST_SHARE = 0.5  # least share of its usual hits with which a target is seen in a block
GONE_BLOCKS = 180  # a target not seen for so many blocks, an hour, is dropped
LEAST_AGE = 6  # least blocks in a mean that is used; no verdict before seven minutes
# Tests in a row that must find a move: the scatter of some dozen targets is a rough figure, and in
# one test in some thousands far too small.
LASTING_BLOCKS = 3
# A smaller share of all targets contradicts nothing: in snow, or after a blow that moves all out of
# their gates.
LEAST_PRESENT = 0.5
# Start values of the targets' wander in the search for the common move; recorded.
WANDER_M = 0.1
WANDER_RAD = (math.radians(0.15), math.radians(1.0))
# Least scatter of a target in range, azimuth and elevation: the resolution of recorded values.
LEAST_SCATTER = (0.004, math.radians(0.005), math.radians(0.02))
# Displacement in units of the scatter from which on a target counts less (Cauchy's weight): a car
# that came where another left.
OUTLIER = 2.0
ROUNDS = 10  # of weights and scatter; both are settled after seven
# Where a standard deviation is above this share of the wanted move, in the plane or of an angle,
# vehicles decide, too.
SURE = 0.34

NONE = -1
PLANE_AND_ANGLES = [0, 1, 3, 4, 5]  # components of a move; height alone moves nothing off its lane


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict of the targets on a move between the learnt blocks and the newest ones.

    Parameters
    ----------
    found : Displacement
        The likeliest move, in the sensor's frame, with its score and the length of the newest
        blocks.
    sees : bool
        Whether a move of `WANTED_M` in the plane or of `WANTED_RAD` about any axis would show.
    rests : bool
        Whether there was no blow: a move as large as `KNOCK` would show, and
        none was found.
    """

    found: Displacement
    sees: bool
    rests: bool


def polar_of(points: Floats) -> Floats:
    """Return range (m), azimuth and elevation (rad) of points in the sensor frame, (n, 3)."""
    x, y, z = points.T
    flat = np.hypot(x, y)
    return np.column_stack([np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)])


def by_move(polar: Floats) -> Floats:
    """Return the derivatives of range, azimuth and elevation of targets by a move.

    Parameters
    ----------
    polar : (n, 3) array
        Range (m), azimuth and elevation (rad) of the targets.

    Returns
    -------
    (n, 3, 6) array
        Derivatives by metres along x, y, z of the sensor and by a turn about them, radians.
    """
    reach, azimuth, elevation = polar.T
    level, none = np.cos(elevation), np.zeros(len(polar))
    ahead = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    left = np.column_stack([-np.sin(azimuth), np.cos(azimuth), none])
    up = np.cross(ahead, left)
    arm = reach[:, None] * ahead
    ways = (ahead, left / (reach * level)[:, None], up / reach[:, None])
    return np.stack([np.hstack([-way, -np.cross(arm, way)]) for way in ways], axis=1)


class StationaryTargets:
    """Stationary targets of one sensor, whose newest places are compared with earlier ones.

    Detections are pushed; every `BLOCK_S` seconds a block ends with the median place of each
    target. The newest blocks are kept apart for the tests; then they join the mean. From time to
    time, places in the map of hits that are hit often and belong to no target become targets.

    Parameters
    ----------
    search_blocks : int
        Number of blocks between searches for new targets.
    """

    def __init__(self, *, search_blocks: int = SEARCH_BLOCKS) -> None:
        self._search_blocks = search_blocks
        self._batches: list[Floats] = []  # stationary detections since the last block: polar
        self._frames = self._searched = self._blocks = 0  # frames of block and map; ended blocks
        cells = (round(REACH_M / CELL_M), round(2 * np.pi / CELL_RAD))
        self._hits = np.zeros(cells, dtype=np.int64)
        self._recent: deque[Floats] = deque()  # places in the newest blocks, not yet in the mean
        self.tested: list[Verdict] = []  # verdicts at the end of the last block
        self._scores = {n: deque[float](maxlen=LASTING_BLOCKS) for n in BLOCKS}
        self.know(np.empty((0, 3)), np.empty(0))

    def know(self, place: Floats, rate: Floats) -> None:
        """Set the targets of this sensor; their mean places follow from later detections.

        Earlier targets and their blocks are forgotten.

        Parameters
        ----------
        place : (n, 3) array
            Approximate range (m), azimuth and elevation (rad) of each.
        rate : (n,) array
            Hits a frame.
        """
        self._recent.clear()
        self.tested = []
        for scores in self._scores.values():
            scores.clear()
        self._hold(place.copy(), rate, np.zeros(len(rate)), np.zeros(len(rate)))

    def _hold(self, place: Floats, rate: Floats, age: Floats, absent: Floats) -> None:
        self.place, self.rate = place, rate  # the mean before the newest blocks; hits a frame
        self._age = age  # blocks that the mean holds
        self._absent = absent  # blocks since it was last seen
        self._label = self._labels()

    def __len__(self) -> int:
        return len(self.place)

    def push(self, time: Floats, points: Floats, range_rate: Floats) -> None:
        """Add the next detections.

        Parameters
        ----------
        time : (n,) array
            UNIX seconds, ascending; whole frames.
        points : (n, 3) array
            Sensor frame, metres; NaN where a frame has none.
        range_rate : (n,) array
            Range rates, m/s.
        """
        still = np.abs(range_rate) <= MIN_SPEED_MPS
        polar = polar_of(points[still & np.isfinite(points).all(axis=1)])
        self._batches.append(polar[(polar[:, 0] > 0.0) & (polar[:, 0] < REACH_M)])
        self._frames += len(np.unique(time))

    def end_block(self) -> None:
        """Sum up the detections since the last block."""
        self.take(self.summary())

    def summary(self) -> Floats:
        """Return the median range, azimuth, elevation of each target since the last block, (n, 3).

        It is NaN where a target is hidden or gone. All hits are mapped for the next search.
        """
        polar = np.vstack([np.empty((0, 3)), *self._batches])
        frames, self._batches, self._frames = self._frames, [], 0
        cell = self._cells(polar)
        np.add.at(self._hits, cell, 1)
        self._searched += frames
        return self._medians(polar, self._label[cell], frames)

    def take(self, seen: Floats) -> None:
        """Process the places of all targets in the newest block; search for new ones."""
        there = np.isfinite(seen[:, 0])
        self._absent = np.where(there, 0.0, self._absent + 1.0)
        self._recent.append(seen)
        self._blocks += 1
        # of a short past only a third is tested: two thirds are learnt, to compare with
        held = max(self._blocks // 3, BLOCKS[0])
        while len(self._recent) > min(held, BLOCKS[-1]):
            self._learn(self._recent.popleft())
        self.tested = [each for each in map(self._lasting, BLOCKS) if each is not None]
        first = self._blocks == FIRST_SEARCH
        if first or self._blocks % self._search_blocks == 0:
            self._search()

    def _cells(self, polar: Floats) -> tuple[Integers, Integers]:
        size = [CELL_M, CELL_RAD]
        cell = ((polar[:, :2] + [0.0, np.pi]) / size).astype(np.int64)
        far, round_ = self._hits.shape
        return np.minimum(cell[:, 0], far - 1), cell[:, 1] % round_

    def _medians(self, polar: Floats, label: Integers, frames: int) -> Floats:
        found, mine = np.full((len(self), 3), np.nan), label != NONE
        polar, label = polar[mine], label[mine]
        count = np.bincount(label, minlength=len(self))
        enough = count > np.maximum(LEAST_SHARE * self.rate * frames, 1.0)
        middle = (np.cumsum(count) - count + count // 2)[enough]
        for k in range(3):
            found[enough, k] = polar[np.lexsort((polar[:, k], label)), k][middle]
        return found

    def _learn(self, seen: Floats) -> None:
        """Add a block that is no longer new to the running mean."""
        there = np.isfinite(seen[:, 0])
        self._age[there] = np.minimum(self._age[there] + 1.0, REFERENCE_BLOCKS)
        self.place[there] += (seen[there] - self.place[there]) / self._age[there, None]

    def _search(self) -> None:
        """Drop targets that have left, and add frequently hit places apart from others."""
        kept = self._absent < GONE_BLOCKS
        old = int(kept.sum())
        found, hits = _peaks(self._hits, LEAST_RATE * self._searched)
        place = np.vstack([self.place[kept], found])
        free = _apart(place, old, APART_M)
        new = free[old:]
        none, nothing = np.zeros(int(new.sum())), np.full((int(new.sum()), 3), np.nan)
        self._recent = deque(np.vstack([block[kept], nothing]) for block in self._recent)
        self._hold(
            place[free],
            np.concatenate([self.rate[kept], hits[new] / max(self._searched, 1)]),
            np.concatenate([self._age[kept], none]),
            np.concatenate([self._absent[kept], none]),
        )
        self._hits[:], self._searched = 0, 0

    def _labels(self) -> Integers:
        """Return the target that each cell of range and azimuth belongs to."""
        label = np.full(self._hits.shape, NONE)
        rows, columns = self._cells(self.place)
        high = round(GATE_M / CELL_M)
        for number, (row, column) in enumerate(zip(rows, columns, strict=True)):
            across = GATE_RAD + WANTED_M / self.place[number, 0]
            wide = round(across / CELL_RAD)
            beside = np.arange(column - wide, column + wide + 1) % label.shape[1]
            label[max(row - high, 0) : row + high + 1, beside] = number
        return label

    def _lasting(self, blocks: int) -> Verdict | None:
        """Return the verdict on the newest blocks, with the least of its last scores."""
        found, scores = self.verdict(blocks), self._scores[blocks]
        if found is None:
            scores.clear()
            return None
        scores.append(found.found.score)
        least = min(scores) if len(scores) == scores.maxlen else 0.0
        return replace(found, found=replace(found.found, score=least))

    def verdict(self, blocks: int) -> Verdict | None:
        """Return the verdict on the newest blocks, or None where targets are too few.

        Parameters
        ----------
        blocks : int
            Number of newest blocks.
        """
        if len(self._recent) < blocks:
            return None
        newest = np.array(list(self._recent)[-blocks:])
        there = np.isfinite(newest[..., 0])
        old = self._age >= LEAST_AGE
        good = old & (2 * there.sum(axis=0) >= blocks) & there.any(axis=0)
        if good.sum() < max(LEAST_TARGETS, LEAST_PRESENT * old.sum()):
            return None
        gap = np.nanmean(newest[:, good], axis=0) - self.place[good]
        move, covariance = self._move(self.place[good], gap)
        # blocks from the middle of the mean, limited by its age, to the middle of the newest ones
        waiting = len(self._recent) - blocks
        lag = 0.5 * blocks + waiting + float(np.median(self._age[good]))
        # a drift is nearly the same in all directions: the sensor's axes may replace the map's
        covariance = covariance + lag * BLOCK_S * np.diag(np.square(DRIFT) / HOUR_S)
        chi2 = float(move @ np.linalg.solve(covariance, move))
        count = int(good.sum())
        sigma = np.sqrt(np.diag(covariance))[PLANE_AND_ANGLES]
        wanted = np.repeat([WANTED_M, WANTED_RAD], [2, 3])
        score = count * float(np.log1p(chi2 / count))
        found = Displacement(
            score=score,
            seconds=blocks * BLOCK_S,
            move=move,
            covariance=covariance,
        )
        return Verdict(
            found=found,
            sees=bool((sigma < SURE * wanted).all()),
            rests=score < GATE and bool((sigma < SURE * KNOCK[PLANE_AND_ANGLES]).all()),
        )

    def _move(self, place: Floats, gap: Floats) -> tuple[Floats, Floats]:
        """Return the common move and its covariance; targets that move otherwise weigh little."""
        sigma = np.array([WANDER_M, *WANDER_RAD])
        least = np.array(LEAST_SCATTER)
        prior = np.diag(np.square(KNOCK) ** -1.0)
        design = by_move(place).reshape(-1, len(prior))
        weight = np.ones(gap.shape)
        for _ in range(ROUNDS):
            precision = weight / sigma**2
            weighted = design.T * precision.ravel()
            covariance = np.linalg.inv(weighted @ design + prior)
            move = covariance @ weighted @ gap.ravel()
            rest = gap - (design @ move).reshape(gap.shape)
            # normalised median of absolute deviations
            sigma = np.maximum(1.4826 * np.median(np.abs(rest), axis=0), least)
            weight = 1.0 / (1.0 + np.square(rest / (OUTLIER * sigma)))
        return move, covariance


def _peaks(hits: Integers, least: float) -> tuple[Floats, Floats]:
    """Return places and hits of the maxima of a map of hits, strongest first."""
    window = 2 * round(GATE_M / CELL_M / 2) + 1
    near = uniform_filter(hits.astype(np.float64), (window, window), mode=("constant", "wrap"))
    near = near * window**2
    top = (near == maximum_filter(near, (window, window), mode=("constant", "wrap"))) & (
        near > least
    )
    row, column = np.nonzero(top)
    order = np.argsort(-near[row, column], kind="stable")
    row, column = row[order], column[order]
    place = np.column_stack(
        [(row + 0.5) * CELL_M, (column + 0.5) * CELL_RAD - np.pi, np.zeros(len(row))]
    )
    return place, near[row, column]


def _apart(place: Floats, kept: int, apart_m: float) -> Booleans:
    """Return which places are far enough from those before them; the first ones stay."""
    plane = place[:, :1] * np.column_stack([np.cos(place[:, 1]), np.sin(place[:, 1])])
    free = np.arange(len(place)) < kept
    for i in range(kept, len(place)):
        free[i] = bool((np.hypot(*(plane[:i][free[:i]] - plane[i]).T) > apart_m).all())
    return free

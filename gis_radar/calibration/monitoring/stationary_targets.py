"""Detect small moves of a sensor by the stationary targets around it.

Walls, posts, signs, kerbs and parked cars are detected in most frames. The position of such a
target in the sensor frame changes with the sensor: a move by `d` and a turn by `w` displace it from
`a` to `a - d - w x a`. It also varies over seconds by multipath, and may be of a car that leaves.
Targets are therefore the units: residuals of their displacements from the common move give the
noise.

Memory holds a block of detections, a map of hits by range and azimuth, and some hundred targets.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.monitoring.kalman_filter import DRIFT, HOUR_S, KNOCK
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS
from gis_radar.recordings import Detections

# Reach and cells of the map of hits by range and azimuth: finer than the variation of a target.
_REACH_M = 300.0
_TARGET_CELL_M = 0.2
_CELL_RAD = math.radians(0.4)
# *Recorded* means in recordings of an ARS548, in which a target varies from frame to frame by 0.01
# m, 0.05 and 0.1 to 2 degrees, and over seconds by 0.1 m, 0.15 and 1 degree.
BLOCK_S = 20.0  # length of a block, over which positions are medians: longer than a shake
SEARCH_BLOCKS = 15  # blocks between searches for new targets: five minutes
# Time constant, in blocks, of mean positions: 10 minutes, twice the longest test; over an hour the
# allowed drift of a mast would hide half a degree.
_REFERENCE_BLOCKS = 30
BLOCKS = (6, 15)  # numbers of newest blocks that are tested for a move; longer than gusts
_LEAST_TARGETS = 12  # least number of targets of a test
_WANTED_M = 0.3  # shift that must be detected
# Least score of a significant move, from 120 hours of changing days of one radar
# (`bench/alarm.py --seed 1`); false alarms on other hours are in docs/limits.md.
LEAST_MOVE_SCORE = 28.0
_FIRST_SEARCH = 6  # blocks before the first search for targets: two minutes
# Least number of hits a frame of a target. Recorded: cells hit in half of the frames or more hold
# 46 to 84 % of the stationary detections.
_LEAST_RATE = 0.3
# Largest distance of a detection from its target's mean: three times the variation plus the wanted
# move; in azimuth plus the wanted shift.
GATE_M = 0.7
GATE_RAD = math.radians(1.0)
# Least distance between targets: gates do not overlap at 100 m, and a parked car gives at most two.
_APART_M = 3.0
_LEAST_SHARE = 0.5  # least share of its mean hits with which a target is present in a block
GONE_BLOCKS = 180  # a target absent for so many blocks, an hour, is dropped
LEAST_AGE = 6  # least number of blocks in a mean that is used; no verdict before seven minutes
# Number of tests in a row that must find a move: the estimated noise of some dozen targets is far
# too small in one of some thousand tests.
_LASTING_BLOCKS = 3
# Least share of all targets that must be present for a test: fewer are in snow, or after a blow
# that moves all out of their gates.
_LEAST_PRESENT = 0.5
# Start values of the targets' noise in the fit of the common move; recorded.
START_SIGMA_M = 0.1
START_SIGMA_RAD = (math.radians(0.15), math.radians(1.0))
# Least noise of a target in range, azimuth and elevation: the resolution of recorded values.
_LEAST_SCATTER = (0.004, math.radians(0.005), math.radians(0.02))
# Scale of the Cauchy weights of residuals, in units of the noise: a car may replace another.
_OUTLIER = 2.0
_ROUNDS = 10  # iterations of weights and noise; both converge in seven
# A move would be noticed if its standard deviation is below this share of it.
_SENSITIVE_SHARE = 0.34
# Number of newest blocks that are tested for a blow, and from which the size of a move is measured.
_BLOW_BLOCKS = 1
_LATEST_BLOCKS = 3

NONE = -1
# Tested components of a move; height moves nothing off its lane
_PLANE_AND_ANGLES = [0, 1, 3, 4, 5]


@dataclass(frozen=True, kw_only=True)
class Displacement:
    """Move of a sensor, estimated from displacements of its targets.

    Parameters
    ----------
    score : float
        Chi-square of the move, reduced for the heavy tails of few targets.
    seconds : float
        Length of the newest time that was tested, seconds.
    move : (6,) array
        Metres, and a turn about the axes in radians.
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
class Verdict:
    """Verdict of stationary targets on a move between the means and the newest blocks.

    Parameters
    ----------
    displacement : Displacement
        The likeliest move, in the sensor frame, with its score.
    at_rest : bool
        Whether a move of `KNOCK` would be detected, and none is.
    """

    displacement: Displacement
    at_rest: bool


class Watch:
    """Watches a sensor for small moves while its pose is followed."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset targets and means, after the sensor was moved."""
        self._targets = StationaryTargets()
        self._block_since = np.nan
        self._newest: Verdict | None = None

    def push(self, batch: Detections) -> None:
        """Add the next detections, moving and stationary ones."""
        self._targets.push(batch.time, batch.points, batch.range_rate)

    @property
    def unmoved(self) -> bool:
        """Whether stationary targets show that the sensor was not moved, up to the last block."""
        return self._newest is not None and self._newest.at_rest

    def find_move(self, turn: Floats, time: float) -> Displacement | None:
        """Return the significant move up to a time, if any, in the map's axes.

        Parameters
        ----------
        turn : (3, 3) array
            `R_map_sensor`.
        time : float
            UNIX seconds.
        """
        if np.isnan(self._block_since):
            self._block_since = time
        if time - self._block_since < BLOCK_S:
            return None
        self._block_since = time
        self._targets.end_block()
        self._newest = self._targets.verdict(_BLOW_BLOCKS)
        tested = (each.displacement for each in self._targets.tested)
        move = max(tested, key=lambda each: each.score, default=None)
        if move is None or move.score <= LEAST_MOVE_SCORE:
            return None
        # measured by the latest blocks only: earlier ones may be from before the move
        latest = self._targets.verdict(_LATEST_BLOCKS)
        if latest is not None:
            move = replace(
                move, move=latest.displacement.move, covariance=latest.displacement.covariance
            )
        return move.turned(turn)


def polar_of(points: Floats) -> Floats:
    """Return range (m), azimuth and elevation (rad) of points in the sensor frame, (n, 3)."""
    x, y, z = points.T
    flat = np.hypot(x, y)
    return np.column_stack([np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)])


def by_move(polar: Floats) -> Floats:
    """Return the Jacobian of range, azimuth and elevation of targets by a move of the sensor.

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
    level, zeros = np.cos(elevation), np.zeros(len(polar))
    ahead = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    left = np.column_stack([-np.sin(azimuth), np.cos(azimuth), zeros])
    up = np.cross(ahead, left)
    offset = reach[:, None] * ahead
    axes = (ahead, left / (reach * level)[:, None], up / reach[:, None])
    return np.stack([np.hstack([-way, -np.cross(offset, way)]) for way in axes], axis=1)


class StationaryTargets:
    """Stationary targets of one sensor, whose newest positions are compared with their means.

    A block gives the median position of each target. The newest blocks are tested; older ones are
    added to the means. Every `search_blocks`, frequently hit cells that belong to no target become
    targets.

    Parameters
    ----------
    search_blocks : int
        Number of blocks between searches for new targets.
    """

    def __init__(self, *, search_blocks: int = SEARCH_BLOCKS) -> None:
        self._search_blocks = search_blocks
        self._batches: list[Floats] = []  # stationary detections since the last block: polar
        self._frames = self._searched = self._blocks = 0  # frames of block and map; ended blocks
        cells = (round(_REACH_M / _TARGET_CELL_M), round(2 * np.pi / _CELL_RAD))
        self._hits = np.zeros(cells, dtype=np.int64)
        self._recent: deque[Floats] = deque()  # positions in the newest blocks, not yet in the mean
        self.tested: list[Verdict] = []  # verdicts at the end of the last block
        self._scores = {n: deque[float](maxlen=_LASTING_BLOCKS) for n in BLOCKS}
        self.set_targets(np.empty((0, 3)), np.empty(0))

    def set_targets(self, place: Floats, rate: Floats) -> None:
        """Replace the targets; their means are computed from later detections.

        Parameters
        ----------
        place : (n, 3) array
            Approximate range (m), azimuth and elevation (rad) of each target.
        rate : (n,) array
            Number of hits a frame of each target.
        """
        self._recent.clear()
        self.tested = []
        for scores in self._scores.values():
            scores.clear()
        self._store(place.copy(), rate, np.zeros(len(rate)), np.zeros(len(rate)))

    def _store(self, place: Floats, rate: Floats, age: Floats, absent: Floats) -> None:
        """Replace all targets: positions, hits a frame, blocks in the mean, blocks of absence."""
        self.place, self.rate = place, rate  # means; hits a frame
        self._age = age  # number of blocks in the mean
        self._absent = absent  # blocks since it was last seen
        self._label = self._label_cells()

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
        self._batches.append(polar[(polar[:, 0] > 0.0) & (polar[:, 0] < _REACH_M)])
        self._frames += len(np.unique(time))

    def end_block(self) -> None:
        """End a block: update and test the targets by the detections since the last one."""
        self.process(self.summary())

    def summary(self) -> Floats:
        """Return the median range, azimuth, elevation of each target since the last block, (n, 3).

        It is NaN where a target is absent. All hits are added to the map for the next search.
        """
        polar = np.vstack([np.empty((0, 3)), *self._batches])
        frames, self._batches, self._frames = self._frames, [], 0
        cell = self._cell_indices(polar)
        np.add.at(self._hits, cell, 1)
        self._searched += frames
        return self._target_medians(polar, self._label[cell], frames)

    def process(self, seen: Floats) -> None:
        """Update and test the targets by their positions in a block; search for new ones if due."""
        present = np.isfinite(seen[:, 0])
        self._absent = np.where(present, 0.0, self._absent + 1.0)
        self._recent.append(seen)
        self._blocks += 1
        # at the start, test at most a third of the blocks: the others give the mean
        most_recent = max(self._blocks // 3, BLOCKS[0])
        while len(self._recent) > min(most_recent, BLOCKS[-1]):
            self._add_to_mean(self._recent.popleft())
        self.tested = [each for each in map(self._lasting_verdict, BLOCKS) if each is not None]
        first = self._blocks == _FIRST_SEARCH
        if first or self._blocks % self._search_blocks == 0:
            self._search()

    def _cell_indices(self, polar: Floats) -> tuple[Integers, Integers]:
        """Return row (range) and column (azimuth) in the map of hits."""
        size = [_TARGET_CELL_M, _CELL_RAD]
        cell = ((polar[:, :2] + [0.0, np.pi]) / size).astype(np.int64)
        far, round_ = self._hits.shape
        return np.minimum(cell[:, 0], far - 1), cell[:, 1] % round_

    def _target_medians(self, polar: Floats, label: Integers, frames: int) -> Floats:
        """Return the median of each target's detections; NaN where a target is absent."""
        medians, labelled = np.full((len(self), 3), np.nan), label != NONE
        polar, label = polar[labelled], label[labelled]
        count = np.bincount(label, minlength=len(self))
        enough = count > np.maximum(_LEAST_SHARE * self.rate * frames, 1.0)
        middle = (np.cumsum(count) - count + count // 2)[enough]
        for k in range(3):
            medians[enough, k] = polar[np.lexsort((polar[:, k], label)), k][middle]
        return medians

    def _add_to_mean(self, seen: Floats) -> None:
        """Add a block to the running means."""
        present = np.isfinite(seen[:, 0])
        self._age[present] = np.minimum(self._age[present] + 1.0, _REFERENCE_BLOCKS)
        self.place[present] += (seen[present] - self.place[present]) / self._age[present, None]

    def _search(self) -> None:
        """Drop targets that are gone, and add peaks of the map of hits away from other targets."""
        staying = self._absent < GONE_BLOCKS
        count = int(staying.sum())
        peaks, hits = _peaks_of_hits(self._hits, _LEAST_RATE * self._searched)
        place = np.vstack([self.place[staying], peaks])
        apart = _far_apart(place, count, _APART_M)
        new = apart[count:]
        zeros, unseen = np.zeros(int(new.sum())), np.full((int(new.sum()), 3), np.nan)
        self._recent = deque(np.vstack([block[staying], unseen]) for block in self._recent)
        self._store(
            place[apart],
            np.concatenate([self.rate[staying], hits[new] / max(self._searched, 1)]),
            np.concatenate([self._age[staying], zeros]),
            np.concatenate([self._absent[staying], zeros]),
        )
        self._hits[:], self._searched = 0, 0

    def _label_cells(self) -> Integers:
        """Return for each cell of range and azimuth the target in whose gate it is, or `NONE`."""
        label = np.full(self._hits.shape, NONE)
        rows, columns = self._cell_indices(self.place)
        high = round(GATE_M / _TARGET_CELL_M)
        for number, (row, column) in enumerate(zip(rows, columns, strict=True)):
            across = GATE_RAD + _WANTED_M / self.place[number, 0]
            wide = round(across / _CELL_RAD)
            beside = np.arange(column - wide, column + wide + 1) % label.shape[1]
            label[max(row - high, 0) : row + high + 1, beside] = number
        return label

    def _lasting_verdict(self, blocks: int) -> Verdict | None:
        """Return the verdict on the newest blocks, with the least of the last scores."""
        result, scores = self.verdict(blocks), self._scores[blocks]
        if result is None:
            scores.clear()
            return None
        scores.append(result.displacement.score)
        least = min(scores) if len(scores) == scores.maxlen else 0.0
        return replace(result, displacement=replace(result.displacement, score=least))

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
        present = np.isfinite(newest[..., 0])
        old = self._age >= LEAST_AGE
        usable = old & (2 * present.sum(axis=0) >= blocks) & present.any(axis=0)
        if usable.sum() < max(_LEAST_TARGETS, _LEAST_PRESENT * old.sum()):
            return None
        gap = np.nanmean(newest[:, usable], axis=0) - self.place[usable]
        move, covariance = self._fit_move(self.place[usable], gap)
        # number of blocks from the middle of the mean to the middle of the newest ones
        waiting = len(self._recent) - blocks
        lag = 0.5 * blocks + waiting + float(np.median(self._age[usable]))
        # DRIFT, of the map's axes, is about equal in all directions, so it holds for the sensor's
        covariance = covariance + lag * BLOCK_S * np.diag(np.square(DRIFT) / HOUR_S)
        chi2 = float(move @ np.linalg.solve(covariance, move))
        count = int(usable.sum())
        sigma = np.sqrt(np.diag(covariance))[_PLANE_AND_ANGLES]
        score = count * float(np.log1p(chi2 / count))
        displacement = Displacement(
            score=score,
            seconds=blocks * BLOCK_S,
            move=move,
            covariance=covariance,
        )
        return Verdict(
            displacement=displacement,
            at_rest=score < LEAST_MOVE_SCORE
            and bool((sigma < _SENSITIVE_SHARE * KNOCK[_PLANE_AND_ANGLES]).all()),
        )

    def _fit_move(self, place: Floats, gap: Floats) -> tuple[Floats, Floats]:
        """Fit the common move, robustly; return it and its covariance."""
        sigma = np.array([START_SIGMA_M, *START_SIGMA_RAD])
        least = np.array(_LEAST_SCATTER)
        prior = np.diag(np.square(KNOCK) ** -1.0)
        design = by_move(place).reshape(-1, len(prior))
        weight = np.ones(gap.shape)
        for _ in range(_ROUNDS):
            precision = weight / sigma**2
            weighted = design.T * precision.ravel()
            covariance = np.linalg.inv(weighted @ design + prior)
            move = covariance @ weighted @ gap.ravel()
            residual = gap - (design @ move).reshape(gap.shape)
            # normalised median of absolute residuals
            sigma = np.maximum(1.4826 * np.median(np.abs(residual), axis=0), least)
            weight = 1.0 / (1.0 + np.square(residual / (_OUTLIER * sigma)))
        return move, covariance


def _peaks_of_hits(hits: Integers, least: float) -> tuple[Floats, Floats]:
    """Return positions and hits of the local maxima of a map of hits, strongest first."""
    window = 2 * round(GATE_M / _TARGET_CELL_M / 2) + 1
    hits_near = uniform_filter(hits.astype(np.float64), (window, window), mode=("constant", "wrap"))
    hits_near = hits_near * window**2
    top = (hits_near == maximum_filter(hits_near, (window, window), mode=("constant", "wrap"))) & (
        hits_near > least
    )
    row, column = np.nonzero(top)
    order = np.argsort(-hits_near[row, column], kind="stable")
    row, column = row[order], column[order]
    place = np.column_stack(
        [(row + 0.5) * _TARGET_CELL_M, (column + 0.5) * _CELL_RAD - np.pi, np.zeros(len(row))]
    )
    return place, hits_near[row, column]


def _far_apart(place: Floats, kept: int, apart_m: float) -> Booleans:
    """Return which positions are `apart_m` from all accepted before; the first `kept` are."""
    plane = place[:, :1] * np.column_stack([np.cos(place[:, 1]), np.sin(place[:, 1])])
    apart = np.arange(len(place)) < kept
    for i in range(kept, len(place)):
        apart[i] = bool((np.hypot(*(plane[:i][apart[:i]] - plane[i]).T) > apart_m).all())
    return apart

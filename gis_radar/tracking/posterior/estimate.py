"""The posterior of vehicles: expected detections, brightness, background, and evidence."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import (
    STEPS_PER_SECOND,
    Booleans,
    Floats,
    Integers,
    give_back_memory,
    ranges,
)
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.background import Background
from gis_radar.tracking.posterior.frames import (
    SPEED,
    Frames,
    States,
    motion_states,
)
from gis_radar.tracking.posterior.likelihood import (
    CELL_M,
    KINDS,
    STANDS_MPS,
    Rates,
    Seen,
    evaluate,
    evaluate_pairs,
    find_pairs,
    hide,
    kinds_and_cells,
    overlap,
)

ROUNDS = 4  # of expectation and maximization
FIRST_GUESS = 0.5  # detections a frame
KIND_FEW, CELL_FEW = 40.0, 5.0  # expected detections that what is usual counts as
OTHERS_FEW = 1.0  # the same, of what all other vehicles show of a cell
DULLEST, BRIGHTEST = 0.02, 4.0  # factor of a cell
ALPHAS = (0.3, 8.0)  # shape of the distribution of brightness: at least, at most
LEAST_GROUPS = 50
LEAST_SHARE = 0.25  # of a vehicle on another one

Placed: TypeAlias = tuple[Integers, Floats, Integers, Integers, Floats, Integers]
# frame, shape, kind and cell of each state; where its detections begin, their densities and rows


class Posterior:
    """All detections of a span of time against the vehicles in it.

    Detections are a Poisson process, whose rate is the sum of those of all vehicles and of the
    background. How many a vehicle gives is learned by range, aspect, length and whether it stands,
    and by cell of the map and sensor; its brightness to a sensor is gamma distributed from half
    second to half second, because a radar loses a vehicle for seconds.

    Parameters
    ----------
    detections : MapDetections
        All of them, one at least.
    motions : sequence of Motion
        The vehicles to begin with.

    Attributes
    ----------
    motions : list of Motion
        The vehicles.
    alive : (n,) bool array
        Which of their states count.
    """

    def __init__(self, detections: MapDetections, motions: Sequence[Motion]) -> None:
        self.given = detections
        self.frames = Frames.of(detections)
        d = detections.take(self.frames.row)
        self._background = Background(d, self.frames)
        self._seen = (self.frames.first, d.points, d.sight, d.range_m, d.range_rate, d.height_m)
        self._corner = d.points.min(axis=0) - 2.0 * CELL_M
        span = d.points.max(axis=0) + 2.0 * CELL_M - self._corner
        self._size = np.ceil(span / CELL_M).astype(np.int64) + 1
        self._table = np.full(int(np.prod(KINDS)), FIRST_GUESS)
        self._factor = np.ones(len(self.frames.eyes) * int(self._size.prod()))
        self.alpha = np.array([2.0, 1.0])
        self.total = np.zeros(len(d))
        self._placed: dict[tuple[int, int, float], Placed] = {}
        del d  # times, sensors and cross sections are no longer needed
        self.learn(motions)

    @property
    def rates(self) -> Rates:
        """What is expected of a state, as compiled loops take it."""
        return self.frames.eyes, self._table, self._factor, self._corner, self._size

    @property
    def seen(self) -> Seen:
        """The detections, as compiled loops take them."""
        return (*self._seen, self.total)

    def learn(self, motions: Sequence[Motion]) -> None:
        """Take motions as the vehicles; learn from them what to expect."""
        self._place(motions)
        self._background.watch(self._by_frame, self.states.frame, self.states.shape)
        n, share = len(self.states.frame), np.zeros(len(self.total))
        share[self._pair_row] = 0.5
        mu, bright = FIRST_GUESS * self.open, np.ones(n)
        for _ in range(ROUNDS):
            part = self._parts(mu * bright, self._background.rates(1.0 - share))
            share = np.minimum(np.bincount(self._pair_row, part, len(self.total)), 1.0)
            explained = np.bincount(self._pair_state, part, n).astype(np.float64)
            self._expect(explained)
            mu = self._mu()
            bright = self._brightness(explained, mu)
        self._base = self._background.rates(1.0 - share)
        self._sum_up(mu, bright)

    def place(self, motions: Sequence[Motion]) -> None:
        """Take motions as the vehicles; expect what was learned before."""
        self._place(motions)
        mu = self._mu()
        bright = np.ones(len(mu))
        for _ in range(2):
            part = self._parts(mu * bright, self._base)
            explained = np.bincount(self._pair_state, part, len(mu)).astype(np.float64)
            bright = self._brightness(explained, mu)
        self._sum_up(mu, bright)

    def _parts(self, rate: Floats, base: Floats) -> Floats:
        """Return which part of each detection each state explains, by the rates of states."""
        part = self._density * rate[self._pair_state]
        total = base + np.bincount(self._pair_row, part, len(base))
        part /= total[self._pair_row]
        return np.asarray(part)

    def _place(self, motions: Sequence[Motion]) -> None:
        """Compute states, which detections each may explain, and what hides it.

        These arrays are most of the memory of a block: each old one goes as the new one is made.
        """
        placed = [self._placed.get(_key(each)) or self._placed_anew(each) for each in motions]
        self.motions = list(motions)
        frame, shape = [each[0] for each in placed], [each[1] for each in placed]
        kinds, begins, density, row = ([each[k] for each in placed] for k in range(2, 6))
        placed, self._placed, self.states = [], {}, States.of([], [], self.frames)
        self.open = self._rate = self._due = np.zeros(0)
        self.sensor = self._by_frame = self._pair_state = np.zeros(0, np.int64)
        give_back_memory()
        kind = _joined(kinds, np.zeros((0, 2), np.int64))
        self._kind, self._cell = kind[:, 0], kind[:, 1]
        self._density = _joined(density, np.zeros(0))
        self._pair_row = _joined(row, np.zeros(0, np.int64))
        self.states = states = States.of(frame, shape, self.frames)
        del frame, shape
        self.sensor = self.frames.sensor[states.frame]
        self.alive = np.ones(len(states.frame), np.bool_)
        count = _joined([np.diff(each) for each in begins], np.zeros(0, np.int64))
        self._pair_begin = np.concatenate([[0], np.cumsum(count)])
        self._pair_state = np.repeat(np.arange(len(count)), count)
        self._placed = {_key(each): self._part(k, kind) for k, each in enumerate(motions)}
        self._hide()

    def _part(self, vehicle: int, kind: Integers) -> Placed:
        """Return what is placed of a vehicle, as parts of the arrays of all: it is there once."""
        rows = self.states.rows(vehicle)
        begins = self._pair_begin[rows.start : rows.stop + 1]
        pairs = slice(begins[0], begins[-1])
        return (
            self.states.frame[rows], self.states.shape[rows], kind[rows], begins,
            self._density[pairs], self._pair_row[pairs],
        )  # fmt: skip

    def _placed_anew(self, motion: Motion) -> Placed:
        frame, shape = motion_states(motion, self.frames)
        kind = kinds_and_cells(shape, self.frames.sensor[frame], self.rates)
        return (frame, shape, kind, *find_pairs(shape, frame, self.seen))

    def cover(self) -> None:
        """Compute again which share of each state others hide, of those that are left."""
        self._hide()
        self._due = self._mu()

    def _hide(self) -> None:
        states, alive = self.states, np.flatnonzero(self.alive)
        self._by_frame = alive[np.argsort(states.frame[alive], kind="stable")]
        self._frame_begin = np.searchsorted(
            states.frame[self._by_frame], np.arange(len(self.frames.time) + 1)
        )
        self.open = np.ones(len(states.frame))
        hide(
            self._by_frame, self._frame_begin, self.frames.sensor, states.shape, self.frames.eyes,
            self.open,
        )  # fmt: skip

    @property
    def by_frame(self) -> tuple[Integers, Integers]:
        """States in the order of frames, and where each frame begins among them."""
        return self._by_frame, self._frame_begin

    def _expect(self, explained: Floats) -> None:
        """Learn expected detections by kind and cell."""
        seen = np.bincount(self._kind, explained, len(self._table)).reshape(KINDS)
        due = np.bincount(self._kind, self.open, len(self._table)).reshape(KINDS)
        usual = (seen.sum(axis=(1, 2, 3)) + 1.0) / (due.sum(axis=(1, 2, 3)) + 3.0)
        self._table = (
            (seen + KIND_FEW * usual[:, None, None, None]) / (due + KIND_FEW)
        ).ravel()  # fmt: skip
        count = len(self._factor)
        got = np.bincount(self._cell, explained, count)
        want = np.bincount(self._cell, self._table[self._kind] * self.open, count)
        self._factor = np.clip((got + CELL_FEW) / (want + CELL_FEW), DULLEST, BRIGHTEST)

    def _mu(self) -> Floats:
        return np.asarray(self._table[self._kind] * self._factor[self._cell] * self.open)

    def _brightness(self, explained: Floats, mu: Floats) -> Floats:
        """Return the brightness of each state; learn how much it varies."""
        group = self.states.group
        n, m = np.bincount(group, explained), np.bincount(group, mu)
        first = np.flatnonzero(np.diff(group, prepend=-1))
        stands = (self.states.shape[first, SPEED] < STANDS_MPS).astype(np.int64)
        for kind in (0, 1):
            mine = (stands == kind) & (m > 0.5)
            if mine.sum() > LEAST_GROUPS:
                extra = float(((n - m) ** 2 - n)[mine].sum())
                shape = float((m[mine] ** 2).sum()) / max(extra, 1e-9)
                self.alpha[kind] = min(max(shape, ALPHAS[0]), ALPHAS[1])
        alpha = self.alpha[stands]
        return np.asarray(((alpha + n) / (alpha + m))[group])

    def _sum_up(self, mu: Floats, bright: Floats) -> None:
        self._due = mu
        self._rate = self._density * (mu * bright)[self._pair_state]
        self.total = self._base + np.bincount(self._pair_row, self._rate, len(self.total))

    def gains(self, rows: Integers, shape: Floats, *, add: bool = False) -> Floats:
        """Return (groups, 2) the gain of states over all else, and what is due.

        Parameters
        ----------
        rows : (n,) int64 array
            States whose frames, groups and hiding are taken over.
        shape : (n, 9) array
            The vehicle there.
        add : bool
            Whether it joins what is there.
        """
        return evaluate(
            self.states.group[rows], self.states.frame[rows], self.sensor[rows], shape,
            self.open[rows], self.rates, self.seen, self.alpha, add,
        )  # fmt: skip

    def silence_by_others(self) -> tuple[Floats, Floats]:
        """Return of each state its time, UNIX seconds, and what its silence costs, nats.

        What is due follows from how often all other vehicles that are placed over its cell are
        detected there; no detection at all costs a vehicle, whose brightness is gamma-distributed,
        so many nats in a half second (see :func:`gain_of`), of which each state has its part.
        """
        usual = self._table[self._kind] * self.open
        part = self._rate / self.total[self._pair_row]
        explained = np.bincount(self._pair_state, part, len(usual))
        vehicle = np.repeat(np.arange(len(self.motions)), np.diff(self.states.first))
        count = len(self._factor)
        own, at = np.unique(vehicle * count + self._cell, return_inverse=True)
        got, want = (
            np.bincount(self._cell, each, count)[self._cell] - np.bincount(at, each, len(own))[at]
            for each in (explained, usual)
        )
        due = usual * np.minimum((got + OTHERS_FEW) / (want + OTHERS_FEW), BRIGHTEST)
        group, slow = self.states.group, self.states.shape[:, SPEED] < STANDS_MPS
        whole, alpha = np.bincount(group, due)[group], self.alpha[slow.astype(np.int64)]
        cost = alpha * np.log1p(whole / alpha) * due / np.maximum(whole, 1e-12)
        return self.frames.time[self.states.frame], np.asarray(cost)

    def covered(self, spans: Sequence[tuple[int, int]]) -> Booleans:
        """Return which states lie on another vehicle while that is in its span of steps."""
        states = self.states
        step = self.frames.time[states.frame] * STEPS_PER_SECOND
        inside, share = np.zeros(len(step), np.bool_), np.zeros(len(step))
        for k, (first, last) in enumerate(spans):
            rows = states.rows(k)
            inside[rows] = (step[rows] > first - 0.5) & (step[rows] < last + 0.5)
        for begin, end in pairwise(states.first.tolist()):
            mine = np.arange(begin, end)
            if len(mine):
                share[mine] = overlap(mine, states.frame, states.shape, inside, *self.by_frame)
        return share > LEAST_SHARE

    def own_gains(self, vehicle: int) -> Floats:
        """Return (groups, 2) the gain of a vehicle as it is over all else, and what is due."""
        rows = self.states.rows(vehicle)
        begin = self._pair_begin[rows.start : rows.stop + 1]
        pairs = slice(begin[0], begin[-1])
        return evaluate_pairs(
            self.states.group[rows], self.states.shape[rows], self._due[rows],
            begin - begin[0], self._density[pairs], self._pair_row[pairs], self._rate[pairs],
            self.total, self.alpha,
        )  # fmt: skip

    def strengths(self) -> Floats:
        """Return the gain of each vehicle as it is over all else."""
        states = self.states
        found = evaluate_pairs(
            states.group, states.shape, self._due, self._pair_begin, self._density, self._pair_row,
            self._rate, self.total, self.alpha,
        )  # fmt: skip
        vehicle = states.vehicle[np.diff(states.group, prepend=-1) > 0]
        return np.bincount(vehicle, found[:, 0], len(self.motions)).astype(np.float64)

    def detections_by(self, states: Integers) -> Integers:
        """Return the detections in the frames of some states: their places in the total."""
        frame = np.unique(self.states.frame[states])
        first = self.frames.first[frame]
        return ranges(first, self.frames.first[frame + 1] - first)

    def gain(self, motion: Motion, *, add: bool = False, within: tuple[float, float] | None = None
    ) -> float:  # fmt: skip
        """Return the gain of a motion over all else, in view, between two times if given."""
        frame, shape = motion_states(motion, self.frames)
        if within is not None:
            time = self.frames.time[frame]
            inside = (time > within[0]) & (time < within[1])
            frame, shape = frame[inside], shape[inside]
        sensor = self.frames.sensor[frame]
        found = evaluate(
            self.frames.group[frame], frame, sensor, shape, np.ones(len(frame)), self.rates,
            self.seen, self.alpha, add,
        )  # fmt: skip
        return float(found[:, 0].sum())

    def lift(self, vehicle: int, sign: float = -1.0) -> None:
        """Take a vehicle from what is there; with +1, put it back."""
        rows, rate = self._pairs_of(vehicle)
        np.add.at(self.total, rows, sign * rate)

    def _pairs_of(self, vehicle: int) -> tuple[Integers, Floats]:
        rows = self.states.rows(vehicle)
        part = slice(self._pair_begin[rows.start], self._pair_begin[rows.stop])
        return self._pair_row[part], self._rate[part]

    def remove(self, states: Integers) -> None:
        """Remove states."""
        begin = self._pair_begin[states]
        pairs = ranges(begin, self._pair_begin[states + 1] - begin)
        np.subtract.at(self.total, self._pair_row[pairs], self._rate[pairs])
        self._rate[pairs] = 0.0
        self.alive[states] = False

    def explained(self, vehicle: int) -> Integers:
        """Return the detections of a vehicle, in the order of time: those more likely of it."""
        rows, rate = self._pairs_of(vehicle)
        mine = np.unique(self.frames.row[rows[rate > 0.5 * self.total[rows]]])
        return mine[np.argsort(self.given.time[mine], kind="stable")]


def _joined(parts: list[NDArray[Any]], none: NDArray[Any]) -> NDArray[Any]:
    """Return arrays joined to one; the list is emptied, so that none is kept twice."""
    whole = np.concatenate([none, *parts])
    parts.clear()
    return whole


def _key(motion: Motion) -> tuple[int, int, float]:
    """Return what tells motions apart that have other states; those that are compared live on."""
    return id(motion.path), id(motion.s_m), motion.length_m

"""Posterior of vehicles: the likelihood of all detections, and what each vehicle adds to it.

A *gain* is a log likelihood ratio in nats: of the detections with a vehicle over those without it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import STEPS_PER_SECOND, Booleans, Floats, Integers, give_back_memory, ranges
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.background import Background
from gis_radar.tracking.posterior.frames import SHAPE_SPEED, Frames, States, motion_shapes
from gis_radar.tracking.posterior.likelihood import (
    CLASSES,
    RATE_CELL_M,
    STANDS_MPS,
    DetectionArrays,
    RateModel,
    classes_and_cells,
    fill_visible_share,
    find_pairs,
    overlap,
    placed_gains,
    window_gains,
)

_ROUNDS = 4  # rounds of expectation and maximization
_FIRST_GUESS = 0.5  # expected detections of a vehicle in a frame, before any are learned
# Weights of the priors in detections: the mean of all classes of one range for the rate of a class,
# 1 for the factor of a cell; and for that factor as all other vehicles alone show it.
CLASS_PRIOR, CELL_PRIOR, _OTHERS_PRIOR = 40.0, 5.0, 1.0
_LEAST_FACTOR, MOST_FACTOR = 0.02, 4.0  # bounds of the factor of a cell
ALPHA_BOUNDS = (0.3, 8.0)  # bounds of the gamma shape: silent for seconds, nearly Poisson
_LEAST_GROUPS = 50  # least groups (vehicle, sensor, half second) that give a gamma shape
_OVERLAP_SHARE = 0.25  # share of the shorter body above which two vehicles overlap

# Frame, shape, and (class, cell) of each state of a vehicle; the index of its first detection, and
# the density and the row of each detection.
Placed: TypeAlias = tuple[Integers, Floats, Integers, Integers, Floats, Integers]


class Posterior:
    """Likelihood of all detections of a span of time, given the vehicles in it.

    Detections are a Poisson process, whose rate is the sum of the rates of all vehicles and of the
    background. The expected number of detections of a vehicle in a frame is learned by class
    (range, aspect, length, whether it stands) and by map cell and sensor. Its *brightness*, a
    factor on that number, is gamma distributed: one value for each vehicle, sensor and half second,
    because a radar loses a vehicle for seconds.

    A *state* is a vehicle in a frame of a sensor; a *pair* is a state and a detection near it.

    Parameters
    ----------
    detections : MapDetections
        All detections, at least one.
    motions : sequence of Motion
        The vehicles to begin with.

    Attributes
    ----------
    motions : list of Motion
        The vehicles.
    states : States
        Their states, n in all.
    visible_share : (n,) array
        Share of each state that other vehicles do not hide from the sensor.
    alive : (n,) bool array
        Which states are not deleted.
    alpha : (2,) array
        Gamma shape of the brightness of vehicles that move, and that stand.
    total_rate : (d,) array
        Rate density at each detection by all vehicles and the background, per frame, m2 and m/s; in
        the order of `frames.row`.
    """

    def __init__(self, detections: MapDetections, motions: Sequence[Motion]) -> None:
        self.detections = detections
        self.frames = Frames.of(detections)
        d = detections.take(self.frames.row)
        self._background = Background(d, self.frames)
        self._arrays = (self.frames.first, d.points, d.sight, d.range_m, d.range_rate, d.height_m)
        self._corner = d.points.min(axis=0) - 2.0 * RATE_CELL_M
        span = d.points.max(axis=0) + 2.0 * RATE_CELL_M - self._corner
        self._size = np.ceil(span / RATE_CELL_M).astype(np.int64) + 1
        self._class_rate = np.full(int(np.prod(CLASSES)), _FIRST_GUESS)
        self._cell_factor = np.ones(len(self.frames.sensor_xy) * int(self._size.prod()))
        self.alpha = np.array([2.0, 1.0])
        self.total_rate = np.zeros(len(d))
        self._placed: dict[tuple[int, int, float], Placed] = {}
        del d  # times, sensors and cross sections are no longer needed
        self.learn(motions)

    @property
    def rate_model(self) -> RateModel:
        """Expected numbers of detections, as compiled loops take them."""
        rate, factor = self._class_rate, self._cell_factor
        return self.frames.sensor_xy, rate, factor, self._corner, self._size

    @property
    def detection_arrays(self) -> DetectionArrays:
        """The detections, as compiled loops take them."""
        return (*self._arrays, self.total_rate)

    def learn(self, motions: Sequence[Motion]) -> None:
        """Set the vehicles; learn detection rates and background from them (EM)."""
        self._set_states(motions)
        self._background.learn_fixed(self._by_frame, self.states.frame, self.states.shape)
        n, share = len(self.states.frame), np.zeros(len(self.total_rate))
        share[self._pair_row] = 0.5
        rate = expected = _FIRST_GUESS * self.visible_share
        for _ in range(_ROUNDS):
            responsibility = self._responsibilities(rate, self._background.rates(1.0 - share))
            of_all = np.bincount(self._pair_row, responsibility, len(self.total_rate))
            share = np.minimum(of_all, 1.0)  # the share of each detection by all vehicles
            explained = np.bincount(self._pair_state, responsibility, n).astype(np.float64)
            self._learn_rates(explained)
            expected = self._expected_detections()
            rate = expected * self._brightness(explained, expected)
        self._background_rate = self._background.rates(1.0 - share)
        self._set_rates(expected, rate)

    def set_vehicles(self, motions: Sequence[Motion]) -> None:
        """Set the vehicles; keep the detection rates and the background learned before."""
        self._set_states(motions)
        rate = expected = self._expected_detections()
        for _ in range(2):
            responsibility = self._responsibilities(rate, self._background_rate)
            explained = np.bincount(self._pair_state, responsibility, len(expected))
            del responsibility, rate  # they would be kept beside their successors
            rate = expected * self._brightness(explained.astype(np.float64, copy=False), expected)
        self._set_rates(expected, rate)

    def _responsibilities(self, rate: Floats, background: Floats) -> Floats:
        """Return each state's responsibility for each of its detections, a value a pair.

        Parameters
        ----------
        rate : (n,) array
            Expected detections of each state.
        background : (d,) array
            Rate density of the background at each detection.
        """
        share = self._pair_density * rate[self._pair_state]
        total_rate = background + np.bincount(self._pair_row, share, len(background))
        share /= total_rate[self._pair_row]
        return np.asarray(share)

    def _set_states(self, motions: Sequence[Motion]) -> None:
        """Compute the states of motions, their pairs with detections, and their visible shares.

        These arrays are most of the memory of a block: old ones are freed as soon as no vehicle
        takes its part from them any more.
        """
        placed = [self._placed.get(_state_key(each)) for each in motions]
        self.motions, self._placed = list(motions), {}
        self.states = States.of([], self.frames)
        self.visible_share = self._expected = self._pair_rate = self._pair_density = np.zeros(0)
        self._by_frame = self._state_class = self._state_cell = np.zeros(0, np.int64)
        self._pair_begin = self._pair_state = self._pair_row = np.zeros(0, np.int64)
        give_back_memory()
        frame_of = [
            self.frames.during(motion) if known is None else known[0]
            for motion, known in zip(motions, placed, strict=True)
        ]
        self.states = states = States.of(frame_of, self.frames)
        del frame_of
        class_cell = np.empty((len(states.frame), 2), np.int64)
        pairs: list[list[NDArray[Any]]] = [[], [], []]
        for k, motion in enumerate(motions):
            rows = states.rows(k)
            states.shape[rows], class_cell[rows], *found = (
                placed[k] or self._computed(motion, states.frame[rows])
            )[1:]
            placed[k] = None  # frees its arrays, or the old ones with the last part of them
            for part, each in zip(pairs, found, strict=True):
                part.append(each)
        self._set_pairs(*pairs)
        self._state_class, self._state_cell = class_cell[:, 0], class_cell[:, 1]
        self.alive = np.ones(len(states.frame), np.bool_)
        self._placed = {
            _state_key(each): self._view_of(k, class_cell) for k, each in enumerate(motions)
        }
        self._update_visible_share()

    def _set_pairs(
        self, begins: list[Integers], density: list[Floats], row: list[Integers]
    ) -> None:
        """Set the pairs of all states from those of each vehicle."""
        count = _joined([np.diff(each) for each in begins], np.zeros(0, np.int64))
        self._pair_begin = np.concatenate([[0], np.cumsum(count)])
        self._pair_state = np.repeat(np.arange(len(count)), count)
        self._pair_density = _joined(density, np.zeros(0))
        self._pair_row = _joined(row, np.zeros(0, np.int64))

    def _view_of(self, vehicle: int, class_cell: Integers) -> Placed:
        """Return a vehicle's states and pairs as views of the arrays of all vehicles."""
        rows = self.states.rows(vehicle)
        begins = self._pair_begin[rows.start : rows.stop + 1]
        pairs = slice(begins[0], begins[-1])
        return (
            self.states.frame[rows], self.states.shape[rows], class_cell[rows], begins,
            self._pair_density[pairs], self._pair_row[pairs],
        )  # fmt: skip

    def _computed(self, motion: Motion, frame: Integers) -> Placed:
        """Return the states and pairs of a motion that was not placed before."""
        shape = motion_shapes(motion, self.frames.time[frame])
        class_cell = classes_and_cells(shape, self.frames.sensor[frame], self.rate_model)
        return (frame, shape, class_cell, *find_pairs(shape, frame, self.detection_arrays))

    def update_occlusion(self) -> None:
        """Compute visible shares and expected detections anew, by the states that are alive."""
        self._update_visible_share()
        self._expected = self._expected_detections()

    def _update_visible_share(self) -> None:
        """Sort the states that are alive by frame, and compute which share of each is visible."""
        states = self.states
        order = np.argsort(states.frame, kind="stable")
        self._by_frame = order = order[self.alive[order]]
        self._frame_begin = np.searchsorted(
            states.frame[order], np.arange(len(self.frames.time) + 1)
        )
        self.visible_share = np.ones(len(states.frame))
        fill_visible_share(
            self._by_frame, self._frame_begin, self.frames.sensor, states.shape,
            self.frames.sensor_xy, self.visible_share,
        )  # fmt: skip

    def windows(self, rows: slice | Integers) -> Integers:
        """Return the number of the half second of each of some states."""
        return np.asarray(self.frames.window[self.states.frame[rows]])

    @property
    def by_frame(self) -> tuple[Integers, Integers]:
        """States that are alive, in the order of frames, and the index of each frame's first."""
        return self._by_frame, self._frame_begin

    def _learn_rates(self, explained: Floats) -> None:
        """Learn expected detections by class and by cell, from the detections of each state."""
        detected, frames = (
            np.bincount(self._state_class, each, len(self._class_rate)).reshape(CLASSES)
            for each in (explained, self.visible_share)
        )
        of_range = (detected.sum(axis=(1, 2, 3)) + 1.0) / (frames.sum(axis=(1, 2, 3)) + 3.0)
        self._class_rate = (
            (detected + CLASS_PRIOR * of_range[:, None, None, None]) / (frames + CLASS_PRIOR)
        ).ravel()  # fmt: skip
        count = len(self._cell_factor)
        got = np.bincount(self._state_cell, explained, count)
        want = np.bincount(
            self._state_cell, self._class_rate[self._state_class] * self.visible_share, count
        )
        self._cell_factor = np.clip(
            (got + CELL_PRIOR) / (want + CELL_PRIOR), _LEAST_FACTOR, MOST_FACTOR
        )

    def _expected_detections(self) -> Floats:
        """Return the expected number of detections of each state, at brightness 1."""
        return np.asarray(
            self._class_rate[self._state_class]
            * self._cell_factor[self._state_cell]
            * self.visible_share
        )

    def _brightness(self, explained: Floats, expected: Floats) -> Floats:
        """Return the posterior mean of the brightness of each state; learn the gamma shapes.

        The shape is that of a negative binomial distribution, by the method of moments.
        """
        group = self.states.group
        n, m = np.bincount(group, explained), np.bincount(group, expected)
        first = np.searchsorted(group, np.arange(len(n)))
        stands = (self.states.shape[first, SHAPE_SPEED] < STANDS_MPS).astype(np.int64)
        for standing in (0, 1):
            used = (stands == standing) & (m > 0.5)
            if used.sum() > _LEAST_GROUPS:
                extra_variance = float(((n - m) ** 2 - n)[used].sum())
                shape = float((m[used] ** 2).sum()) / max(extra_variance, 1e-9)
                self.alpha[standing] = min(max(shape, ALPHA_BOUNDS[0]), ALPHA_BOUNDS[1])
        alpha = self.alpha[stands]
        return np.asarray(((alpha + n) / (alpha + m))[group])

    def _set_rates(self, expected: Floats, rate: Floats) -> None:
        """Set the rate of each pair and the total rate of each detection."""
        self._expected = expected
        self._pair_rate = self._pair_density * rate[self._pair_state]
        self.total_rate = self._background_rate + np.bincount(
            self._pair_row, self._pair_rate, len(self.total_rate)
        )

    def gains(self, rows: Integers, shape: Floats, *, add: bool = False) -> Floats:
        """Return gain and expected number of detections of a hypothetical vehicle, by group.

        Parameters
        ----------
        rows : (n,) int64 array
            States whose frames, groups and visible shares it takes over.
        shape : (n, 9) array
            Its shapes in these frames, as of :class:`States`.
        add : bool
            Whether to add its rates to the total rates.

        Returns
        -------
        (groups, 2) array
            For each sensor and half second.
        """
        frame = self.states.frame[rows]
        return window_gains(
            self.states.group[rows], frame, self.frames.sensor[frame], shape,
            self.visible_share[rows], self.rate_model, self.detection_arrays, self.alpha, add,
        )  # fmt: skip

    def costs_of_silence(self) -> Iterator[Floats]:
        """Yield for each vehicle the cost of each of its states if it is not detected, nats.

        The factor of its cell is that of all other vehicles alone. A vehicle without a detection in
        a half second costs ``alpha ln(1 + mu / alpha)`` where ``mu`` detections are expected
        (:func:`log_likelihood_ratio`); its states share that cost by their expected detections.
        """
        by_class = self._class_rate[self._state_class] * self.visible_share
        responsibility = self._pair_rate / self.total_rate[self._pair_row]
        explained = np.bincount(self._pair_state, responsibility, len(by_class))
        del responsibility
        of_all = [
            np.bincount(self._state_cell, each, len(self._cell_factor))
            for each in (explained, by_class)
        ]
        for begin, end in pairwise(self.states.first.tolist()):
            rows = slice(begin, end)
            cell, at = np.unique(self._state_cell[rows], return_inverse=True)
            got, want = (
                (total[cell] - np.bincount(at, each[rows], len(cell)))[at]
                for total, each in zip(of_all, (explained, by_class), strict=True)
            )
            factor = (got + _OTHERS_PRIOR) / (want + _OTHERS_PRIOR)
            expected = by_class[rows] * np.minimum(factor, MOST_FACTOR)
            group = self.states.group[rows] - self.states.group[rows][:1]
            slow = self.states.shape[rows, SHAPE_SPEED] < STANDS_MPS
            of_group, alpha = np.bincount(group, expected)[group], self.alpha[slow.astype(np.int64)]
            yield alpha * np.log1p(of_group / alpha) * expected / np.maximum(of_group, 1e-12)

    def overlapping(self, spans: Sequence[tuple[int, int]]) -> Booleans:
        """Return which states overlap another vehicle while that is within its span.

        Parameters
        ----------
        spans : sequence of (int, int)
            First and last step of each vehicle.
        """
        states = self.states
        inside, share = np.zeros(len(states.frame), np.bool_), np.zeros(len(states.frame))
        for k, (first, last) in enumerate(spans):
            rows = states.rows(k)
            step = self.frames.time[states.frame[rows]] * STEPS_PER_SECOND
            inside[rows] = (step > first - 0.5) & (step < last + 0.5)
        for begin, end in pairwise(states.first.tolist()):
            mine = np.arange(begin, end)
            if len(mine):
                share[mine] = overlap(mine, states.frame, states.shape, inside, *self.by_frame)
        return share > _OVERLAP_SHARE

    def own_gains(self, vehicle: int) -> Floats:
        """Return the gain and the expected number of detections of a vehicle, (groups, 2)."""
        rows = self.states.rows(vehicle)
        begin = self._pair_begin[rows.start : rows.stop + 1]
        pairs = slice(begin[0], begin[-1])
        return placed_gains(
            self.states.group[rows], self.states.shape[rows], self._expected[rows],
            begin - begin[0], self._pair_density[pairs], self._pair_row[pairs],
            self._pair_rate[pairs], self.total_rate, self.alpha,
        )  # fmt: skip

    def vehicle_gains(self) -> Floats:
        """Return the gain of each vehicle, nats."""
        states = self.states
        found = placed_gains(
            states.group, states.shape, self._expected, self._pair_begin, self._pair_density,
            self._pair_row, self._pair_rate, self.total_rate, self.alpha,
        )  # fmt: skip
        vehicle = states.vehicle[np.diff(states.group, prepend=-1) > 0]
        return np.bincount(vehicle, found[:, 0], len(self.motions)).astype(np.float64)

    def rows_in_frames_of(self, states: Integers) -> Integers:
        """Return the indices in `total_rate` of the detections in the frames of some states."""
        frame = np.unique(self.states.frame[states])
        first = self.frames.first[frame]
        return ranges(first, self.frames.first[frame + 1] - first)

    def gain(self, motion: Motion, *, add: bool = False, within: tuple[float, float] | None = None
    ) -> float:  # fmt: skip
        """Return the gain of a motion that nothing hides, nats.

        Parameters
        ----------
        motion : Motion
            A vehicle; its rates must not be among the total rates.
        add : bool
            Whether to add its rates to the total rates.
        within : (float, float), optional
            UNIX seconds; only its states between them count.
        """
        frame = self.frames.during(motion)
        if within is not None:
            time = self.frames.time[frame]
            frame = frame[(time > within[0]) & (time < within[1])]
        found = window_gains(
            self.frames.group[frame], frame, self.frames.sensor[frame],
            motion_shapes(motion, self.frames.time[frame]), np.ones(len(frame)), self.rate_model,
            self.detection_arrays, self.alpha, add,
        )  # fmt: skip
        return float(found[:, 0].sum())

    def exclude(self, vehicle: int) -> None:
        """Subtract a vehicle's rates from the total rates, so that others can take its place."""
        rows, rate = self._pairs_of(vehicle)
        np.subtract.at(self.total_rate, rows, rate)

    def include(self, vehicle: int) -> None:
        """Add the rates of an excluded vehicle to the total rates again."""
        rows, rate = self._pairs_of(vehicle)
        np.add.at(self.total_rate, rows, rate)

    def _pairs_of(self, vehicle: int) -> tuple[Integers, Floats]:
        """Return the rows and the rates of a vehicle's pairs."""
        rows = self.states.rows(vehicle)
        pairs = slice(self._pair_begin[rows.start], self._pair_begin[rows.stop])
        return self._pair_row[pairs], self._pair_rate[pairs]

    def delete_states(self, states: Integers) -> None:
        """Delete states: subtract their rates from the total rates; they hide nothing any more."""
        begin = self._pair_begin[states]
        pairs = ranges(begin, self._pair_begin[states + 1] - begin)
        np.subtract.at(self.total_rate, self._pair_row[pairs], self._pair_rate[pairs])
        self._pair_rate[pairs] = 0.0
        self.alive[states] = False

    def associated_rows(self, vehicle: int) -> Integers:
        """Return the detections, by time, for which a vehicle's responsibility is over a half."""
        rows, rate = self._pairs_of(vehicle)
        mine = np.unique(self.frames.row[rows[rate > 0.5 * self.total_rate[rows]]])
        return mine[np.argsort(self.detections.time[mine], kind="stable")]


def _joined(parts: list[NDArray[Any]], empty: NDArray[Any]) -> NDArray[Any]:
    """Return arrays joined to one; empty the list, so that no array is kept twice."""
    joined = np.concatenate([empty, *parts])
    parts.clear()
    return joined


def _state_key(motion: Motion) -> tuple[int, int, float]:
    """Return a key that differs between motions with different states, while both exist."""
    return id(motion.path), id(motion.s_m), motion.length_m

"""Hours in which a sensor stays where it is, drawn from simulated minutes.

Three minutes on end are drawn at a time. The deviations of stationary targets from their mean place
get a random sign, the same in these minutes: a wild cluster bootstrap, which keeps spread and
correlation. A :class:`Day` adds what changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.stats import genpareto

from gis_radar.base import Booleans, Floats
from gis_radar.calibration import DRIFT
from gis_radar.calibration.monitoring.kalman_filter import HOUR_S
from gis_radar.calibration.monitoring.stationary_targets import (
    GATE_M,
    GATE_RAD,
    START_SIGMA_M,
    START_SIGMA_RAD,
    by_move,
)

RUN_MINUTES = 3  # drawn together
MONTH_H = 720.0
APART_MINUTES = 30  # between independent scores: the longest time that a test looks at
SLOW_H, SWAY_S = 2.0, 120.0  # correlation times: of targets; of a mast in the wind
SWAY_SIGMA = (0.005, 0.005, 0.002, np.radians(0.03), np.radians(0.03), np.radians(0.02))  # m, rad
WET_H = 1.0  # for which rain hides targets
CAR_RADIUS_M = 5.0  # targets so near to each other may be of one parked car
# Range (m), azimuth, elevation (rad): how far a target of the next car on a parking place lies from
# the last one's, 1 sigma; and up to where it is taken for the last one's.
BESIDE_SIGMA = np.array([0.5, GATE_RAD / 2.0, START_SIGMA_RAD[1]])
MATCH_GATE = np.array([GATE_M, GATE_RAD, np.inf])


# Range (m), azimuth and elevation (rad) of each stationary target (targets, 3), by the blocks of a
# minute; NaN: not seen.
Minute: TypeAlias = list[Floats]


@dataclass(frozen=True, kw_only=True)
class Day:
    """What changes in a day.

    Parameters
    ----------
    drift, sway : float
        Of the mast: drift as a multiple of what the settings allow, sway in the wind of
        `SWAY_SIGMA`.
    wander : (3,) tuple
        Standard deviations of slow changes of each stationary target: range (m), azimuth and
        elevation (rad).
    parked : float
        Share of the stationary targets that are of parked cars.
    stay_h : float
        Mean time for which a car stays; the place is then empty for a third of it, in the mean.
    wet : float
        Showers an hour: all targets are displaced at once, and 40 % are lost for `WET_H`.
    """

    drift: float = 0.0
    sway: float = 0.0
    wander: tuple[float, float, float] = (0.0, 0.0, 0.0)
    parked: float = 0.0
    stay_h: float = 1.5
    wet: float = 0.0


CHANGING = Day(drift=1.0, sway=1.0, wander=(START_SIGMA_M, *START_SIGMA_RAD), parked=0.33, wet=0.1)


class DrawnHours:
    """Source of drawn minutes.

    Parameters
    ----------
    minutes : sequence of Minute
        Simulated minutes to draw from.
    turn : (3, 3) array
        R_map_sensor.
    seed : int
        Seed of all random numbers.
    """

    def __init__(self, minutes: Sequence[Minute], turn: Floats, seed: int) -> None:
        self.minutes, self.turn = minutes, turn
        self.rng = np.random.default_rng(seed)
        self.middle = np.nanmedian([part for minute in minutes for part in minute], axis=0)

    def drawn(self, hours: float, day: Day) -> Iterator[Minute]:
        """Yield the minutes of a day."""
        rng, slow = self.rng, _SlowChanges(self.rng, day, self.middle)
        used: list[int] = []
        place, sign = 0, 1.0
        for minute in range(round(60.0 * hours)):
            if minute % RUN_MINUTES == 0:
                place = self._draw(used)
                used = [*used, place][-APART_MINUTES // RUN_MINUTES :]
                sign = float(rng.choice([-1.0, 1.0]))
            slow.step()
            shift = np.kron(np.eye(2), self.turn.T) @ slow.moved
            common = by_move(self.middle) @ shift
            yield [
                self.middle + sign * (part - self.middle) + common + slow.targets()
                for part in self.minutes[place + minute % RUN_MINUTES]
            ]

    def _draw(self, used: Sequence[int]) -> int:
        """Return the first minute of the next run; none is used again within half an hour."""
        places = np.arange(len(self.minutes) - RUN_MINUTES + 1)
        free = [k for k in places if all(abs(k - other) >= RUN_MINUTES for other in used)]
        return int(self.rng.choice(free or places))


class _SlowChanges:
    """State of what a `Day` changes, minute by minute."""

    def __init__(self, rng: np.random.Generator, day: Day, still: Floats) -> None:
        self._rng, self._day = rng, day
        self._sway = _SlowProcess(rng, day.sway * np.array(SWAY_SIGMA), SWAY_S / HOUR_S)
        self._still = _SlowProcess(rng, np.tile(day.wander, (len(still), 1)), SLOW_H)
        self._drift = np.zeros(6)
        self._cars = _cars(still, day.parked, rng)
        self._parked = np.zeros_like(still)
        self._until = rng.exponential(60.0 * day.stay_h, len(self._cars))
        self._away = np.zeros(len(self._cars), dtype=bool)
        self._wet_left, self._lost = 0, np.zeros(len(still), dtype=bool)

    @property
    def moved(self) -> Floats:
        """How far drift and wind have moved the mast: 3 m, 3 rad."""
        return self._drift + self._sway.value

    def step(self) -> None:
        """Advance by a minute."""
        rng, day = self._rng, self._day
        self._sway.step()
        self._still.step()
        hourly = day.drift * DRIFT
        self._drift = self._drift + hourly * rng.normal(size=6) * np.sqrt(60.0 / HOUR_S)
        self._park()
        self._wet_left -= 1
        if rng.random() < day.wet / 60.0:
            self._wet_left = round(60.0 * WET_H)
            self._lost = rng.random(len(self._lost)) < 0.4
            self._still.draw()

    def _park(self) -> None:
        """Let parked cars leave and others come; NaN where no target matches the first car's."""
        rng, day = self._rng, self._day
        self._until -= 1.0
        for number in np.flatnonzero(self._until <= 0.0):
            rows, away = self._cars[number], not self._away[number]
            self._away[number] = away
            self._until[number] = rng.exponential(60.0 * day.stay_h * (1.0 / 3.0 if away else 1.0))
            offset = BESIDE_SIGMA * rng.normal(size=(len(rows), 3))
            gone: Booleans = np.less(MATCH_GATE, np.abs(offset)).any(axis=1) | away
            self._parked[rows] = np.where(gone[:, None], np.nan, offset)

    def targets(self) -> Floats:
        """Return how far each stationary target is from its mean place; NaN: it is not seen."""
        lost = self._lost & (self._wet_left > 0)
        return np.where(lost[:, None], np.nan, self._still.value + self._parked)


class _SlowProcess:
    """Stationary random processes (AR(1) by minute) of given deviations and correlation time."""

    def __init__(self, rng: np.random.Generator, sigma: Floats, hours: float) -> None:
        self._rng, self._sigma, self._keep = rng, sigma, np.exp(-1.0 / 60.0 / hours)
        self.draw()

    def draw(self) -> None:
        """Draw new values."""
        self.value = self._sigma * self._rng.normal(size=self._sigma.shape)

    def step(self) -> None:
        """Advance by a minute."""
        noise = np.sqrt(1.0 - self._keep**2) * self._rng.normal(size=self._sigma.shape)
        self.value = self._keep * self.value + self._sigma * noise


def _cars(still: Floats, share: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Return the rows of the targets of each parked car: neighbours, up to a share of all."""
    plane = still[:, :1] * np.column_stack([np.cos(still[:, 1]), np.sin(still[:, 1])])
    free, groups = np.ones(len(still), dtype=bool), []
    while len(still) and free.mean() > 1.0 - share:
        middle = plane[int(rng.choice(np.flatnonzero(free)))]
        near: Booleans = free & (np.hypot(*(plane - middle).T) < CAR_RADIUS_M)
        groups.append(np.flatnonzero(near))
        free &= ~near
    return groups


def fit_false_alarms(days: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return the false alarms a month (scores over 1), by a Pareto distribution of high scores.

    It is fitted to the largest score of each half hour of the days. Neighbouring half hours share
    tested blocks: of neighbours above the threshold the largest counts. The interval is that of
    500 draws of the exceedances with replacement.
    """
    parts = [np.array(day[: len(day) - len(day) % APART_MINUTES]) for day in days]
    largest = np.concatenate(parts).reshape(-1, APART_MINUTES).max(axis=1)
    level = float(np.quantile(largest, 0.9))
    above = largest > level
    hours = len(largest) * APART_MINUTES / 60.0
    if not above.any():
        return {"hours": hours, "largest": level, "alarms": 0, "monthly": 0.0}
    begins = np.concatenate([[True], ~above[:-1]])
    groups = np.cumsum(begins)[above]
    peaks = np.array([largest[above][groups == g].max() for g in np.unique(groups)])
    excess = peaks - level
    rng = np.random.default_rng(0)

    def monthly(sample: Floats) -> float:
        shape, _, scale = genpareto.fit(sample, floc=0.0)
        rate = len(sample) / hours * MONTH_H
        return float(rate * genpareto.sf(1.0 - level, shape, scale=scale))

    draws = [monthly(rng.choice(excess, max(int(rng.poisson(len(excess))), 5))) for _ in range(500)]
    low, high = np.quantile(draws, [0.025, 0.975])
    return {
        "hours": hours, "largest": float(largest.max()), "alarms": int((peaks > 1.0).sum()),
        "monthly": monthly(excess), "monthly_95": [float(low), float(high)],
    }  # fmt: skip

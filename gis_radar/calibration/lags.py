"""Clocks that are seconds off: at which lag the vehicles of one sensor meet those of another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.calibration.correspondences import (
    FLAT,
    HALF_LENGTH_M,
    LEAST_ALIKE,
    LEAST_MOMENTS,
    LEAST_PAIRS,
    LEVEL_M,
    MOMENT_S,
    SPEED_MPS,
    Moments,
    faces,
)
from gis_radar.calibration.model import MODEL, Model

# Largest offset of clocks that is looked for: beyond it, radars have no common time at all.
MOST_LAG_S = 10.0
# Rates of clocks that are looked for: quartz keeps 1e-4, an ARS430 was 0.8 % slow.
CLOCK_RATES: tuple[float, ...] = (
    -0.012, -0.01, -0.008, -0.006, -0.004, -0.002, 0.002, 0.004, 0.006, 0.008, 0.01, 0.012,
)  # fmt: skip
# Votes for a lag nearer than this agree: a vehicle's length at 30 km/h, poses within 1 m.
LAG_S = 0.25
# Moments farther apart are of two places; slower vehicles tell no time.
LAG_PLACE_M = 4.0
LAG_SPEED_MPS = 3.0
# By how many standard deviations, as counts scatter, the votes for a lag exceed those for any
# other and for none, and with another rate those without: chance gave 3 in 13.
LAG_Z = 5.0
SAME_LAG_S = 1.0  # lags nearer than this are one


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
    """Return the middles of the vehicles, as far as the faces seen tell."""
    shown, points = faces(seen, model), seen.points.copy()
    left = np.column_stack([-seen.along[:, 1], seen.along[:, 0]])
    ends = HALF_LENGTH_M * (1.0 - shown.side) * shown.ahead
    points[:, FLAT] += ends[:, None] * seen.along
    points[:, FLAT] += (model.half_width * shown.side * shown.left)[:, None] * left
    return np.asarray(points)

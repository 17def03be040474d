"""Compare a measure of a lane in two periods: its difference, and the error of that.

The length of the periods decides what is compared:

- *days*: each period has three days or more. The mean of each day is one value; two sets of days
  are compared by Welch's t-test (Welch 1947). Values within a day are correlated, so days, not
  intervals, are taken as independent.
- *times of day*: there are fewer days. Over more than two hours, in which the traffic follows the
  time of day, the same times before and after make pairs; their differences are compared with 0.
  Shorter periods are compared as a whole, which leaves the error twice the degrees of freedom.
- *intervals*: the periods share less than three times of day. They are compared as a whole; a
  difference may then be one between times of day.

A mean within a day is a quotient of sums over intervals: of distances and times for a speed, of
time lost and vehicles for a delay. So intervals count by their traffic (Cochran 1977, ch. 6).
Consecutive intervals are correlated, as the cycles of a signal and queues last. The error of a mean
follows from how slow waves of the intervals vary: the means of the squares of the first cosine
coefficients, each with one degree of freedom (Mueller 2007; Lazarus, Lewis, Stock, Watson 2018).
The variance of few vehicles is known no better than that of as many intervals (Kish 1965).

Of many lanes some seem to differ by chance. Probabilities are corrected by Holm's procedure (Holm
1979): the chance to name any unchanged lane stays under the level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from gis_radar.base import Floats, Text

_DAYS, _TIMES, INTERVALS = Text("days"), Text("times of day"), Text("intervals")
LEVEL = 0.05  # chance to name any lane where nothing changed
_LEAST_UNITS = 3  # days, pairs or intervals for the estimate of a variance; that of two is useless
_LEAST_WAVE = 10  # intervals in the shortest wave: by minute, over two of the longest cycles
_MOST_WAVES = 12  # as an hour has by minute; of longer periods the longest waves are taken
_PROFILE_MIN = 120  # beyond so many minutes the traffic follows the time of day


@dataclass(frozen=True)
class Difference:
    """A difference with its error.

    Parameters
    ----------
    before, after : float
        Means of the values compared, in each period.
    se : float
        Standard error of `after - before`; NaN if it cannot be estimated.
    freedom : float
        Degrees of freedom of the error.
    units : str
        What was compared: days, times of day or intervals.
    count : int
        Number of units in the period that has fewer.
    """

    before: float
    after: float
    se: float
    freedom: float
    units: str
    count: int

    @property
    def difference(self) -> float:
        """Difference `after - before`."""
        return self.after - self.before

    def half_width(self, level: float) -> float:
        """Return half of the confidence interval that misses the difference at a chance `level`."""
        half = float(scipy.stats.t.isf(level / 2.0, self.freedom) * self.se)
        return half if half > 0.0 or self.difference == 0.0 else float("nan")

    @property
    def p(self) -> float:
        """Chance of such a difference, or a larger one, if nothing has changed."""
        if not self.se > 0.0:  # equal values have no variance
            return 1.0 if self.se == self.difference == 0.0 else float("nan")
        return float(2.0 * scipy.stats.t.sf(abs(self.difference) / self.se, self.freedom))


def compare_values(before: pd.DataFrame, after: pd.DataFrame) -> Difference:
    """Compare a measure in two periods.

    Parameters
    ----------
    before, after : DataFrame
        `day` (ascending), `time` (begin of the interval, minutes of the day) and `value`; rows in
        the order of time, without those of unknown value. Of a quotient of sums `value` is the one,
        and a column `weight` the other.

    Returns
    -------
    Difference
        With `se` NaN where there are too few values.
    """
    before, after = (each.assign(weight=each.get("weight", 1.0)) for each in (before, after))
    shared = np.intersect1d(before["time"], after["time"])
    several = min(before["day"].nunique(), after["day"].nunique()) >= _LEAST_UNITS
    if len(shared) >= _LEAST_UNITS or several:
        before, after = (each[each["time"].isin(shared)] for each in (before, after))
    if several and len(shared):
        days = [_day_means(each, before, after) for each in (before, after)]
        if min(map(len, days)) >= _LEAST_UNITS:
            return _welch(_mean_of_days(days[0]), _mean_of_days(days[1]), _DAYS)
    alike = len(shared) >= _LEAST_UNITS
    if alike and np.ptp(shared) >= _PROFILE_MIN:
        return _paired(before, after)
    units = _TIMES if alike else INTERVALS
    return _welch(_mean_of_intervals(before), _mean_of_intervals(after), units)


class _Mean(NamedTuple):
    """A mean, its variance with degrees of freedom, and the number of values that it is of."""

    mean: float
    variance: float
    freedom: float
    size: int


def _day_means(table: pd.DataFrame, before: pd.DataFrame, after: pd.DataFrame) -> Floats:
    """Return the mean of each day, adjusted for missing times of day.

    A day without its peak is not a quiet day: its values are compared with the usual ones of their
    times, and the mean deviation is added to the usual mean.
    """
    if before.empty or after.empty:
        return np.zeros(0)
    before, after, table = (
        each.assign(value=each["value"] / each["weight"])[each["weight"] > 0.0]
        for each in (before, after, table)
    )
    usual = 0.5 * (before.groupby("time")["value"].mean() + after.groupby("time")["value"].mean())
    deviation = table["value"] - table["time"].map(usual)
    means = usual.mean() + deviation.groupby(table["day"]).mean()
    return np.asarray(means.to_numpy(np.float64))


def _mean_of_days(values: Floats) -> _Mean:
    freedom = len(values) - 1
    return _Mean(
        float(values.mean()), float(values.var(ddof=1)) / len(values), freedom, len(values)
    )


def _mean_of_intervals(table: pd.DataFrame) -> _Mean:
    mean, deviations, size = _quotient(table)
    return _Mean(mean, *_variance(deviations, size), len(table))


def _paired(before: pd.DataFrame, after: pd.DataFrame) -> Difference:
    sums = [
        each.groupby("time")[["value", "weight"]].sum().sort_index() for each in (before, after)
    ]
    (first, deviations, size), (second, other_deviations, other_size) = map(_quotient, sums)
    variance, freedom = _variance(other_deviations - deviations, min(size, other_size))
    return Difference(first, second, float(np.sqrt(variance)), freedom, _TIMES, len(deviations))


def _welch(before: _Mean, after: _Mean, units: str) -> Difference:
    both = (before, after)
    total = before.variance + after.variance
    spread = sum(each.variance**2 / each.freedom for each in both)
    freedom = total**2 / spread if spread > 0.0 else min(each.freedom for each in both)
    size = min(before.size, after.size)
    return Difference(before.mean, after.mean, float(np.sqrt(total)), freedom, units, size)


def _quotient(sums: pd.DataFrame) -> tuple[float, Floats, float]:
    """Return a quotient of sums, deviations of the intervals, and their effective number (Kish)."""
    value, weight = (sums[name].to_numpy(np.float64) for name in ("value", "weight"))
    if not weight.sum() > 0.0:
        return np.nan, np.full(len(sums), np.nan), 0.0
    mean = float(value.sum() / weight.sum())
    size = float(weight.sum() ** 2 / (weight**2).sum())
    return mean, np.asarray((value - mean * weight) / weight.mean()), size


def _variance(deviations: Floats, size: float) -> tuple[float, float]:
    """Return the variance of a mean, from its first cosine coefficients, and degrees of freedom.

    Parameters
    ----------
    deviations : (n,) array
        Deviations from the mean in the order of time.
    size : float
        Effective number of values: less than n where some weigh more than others.
    """
    count = len(deviations)
    if min(size, count) < _LEAST_UNITS - 1e-6:
        return np.nan, np.nan
    waves = np.arange(1, max(min(2 * count // _LEAST_WAVE, _MOST_WAVES), 1) + 1)
    phase = np.pi * np.outer(waves, np.arange(count) + 0.5) / count
    powers = 2.0 / count * (np.cos(phase) @ deviations) ** 2
    return float(powers.mean() / count * size / (size - 1.0)), min(len(waves), size - 1.0)


def holm_corrected(p: Floats) -> Floats:
    """Return probabilities corrected for the number of tests, by Holm's procedure.

    Parameters
    ----------
    p : (n,) array
        Probability of each test by itself; NaN for no test.
    """
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    corrected: Floats = np.full(len(p), np.nan)
    steps = p[order] * np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected

"""Compare a measure of a lane in two periods: its difference, and the error of that.

The length of the periods decides what is compared:

- *days*: each period has three days or more. The mean of each day is one value; two sets of days
  are compared by Welch's t-test (Welch 1947). Values within a day are correlated, so days, not
  intervals, are taken as independent.
- *times of day*: there are fewer days. The same times of day, before and after, make pairs; their
  differences are compared with 0 by a t-test of one sample.
- *intervals*: the periods share less than three times of day. Their intervals are compared by
  Welch's test; a difference may then be one between times of day.

Consecutive intervals are correlated, as a queue lasts. With a correlation r of neighbours, n values
count as n (1 - r) / (1 + r) independent ones (Bartlett 1946).

Of many lanes some seem to differ by chance. Probabilities are corrected by Holm's procedure (Holm
1979): the chance to name any unchanged lane stays under the level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy

from gis_radar.base import Floats, Text

DAYS, TIMES, INTERVALS = Text("days"), Text("times of day"), Text("intervals")
LEVEL = 0.05  # chance to name any lane where nothing changed
LEAST_UNITS = 3  # days, pairs or intervals for the estimate of a variance; that of two is useless
MOST_ALIKE = 0.8  # upper limit of the correlation of neighbours: few values give it badly


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
        found = float(scipy.stats.t.isf(level / 2.0, self.freedom) * self.se)
        return found if found > 0.0 or self.difference == 0.0 else float("nan")

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
        `day` (ascending), `time` (begin of the interval within the day, in any unit) and `value`;
        rows in the order of time, without those of unknown value.

    Returns
    -------
    Difference
        With `se` NaN where there are too few values.
    """
    shared = np.intersect1d(before["time"], after["time"])
    if (
        len(shared) >= LEAST_UNITS
        or min(before["day"].nunique(), after["day"].nunique()) >= LEAST_UNITS
    ):
        before, after = (each[each["time"].isin(shared)] for each in (before, after))
    days = [_day_means(each, before, after) for each in (before, after)]
    if len(shared) and min(map(len, days)) >= LEAST_UNITS:
        return _welch(days[0], days[1], DAYS, 0.0)
    if len(shared) >= LEAST_UNITS:
        return _paired(before, after)
    values = [each["value"].to_numpy(np.float64) for each in (before, after)]
    if min(map(len, values)) < LEAST_UNITS:
        means = [float(each.mean()) if len(each) else np.nan for each in values]
        return Difference(means[0], means[1], np.nan, np.nan, INTERVALS, min(map(len, values)))
    alike = max(_alike(each) for each in values)
    return _welch(values[0], values[1], INTERVALS, alike)


def _day_means(table: pd.DataFrame, before: pd.DataFrame, after: pd.DataFrame) -> Floats:
    """Return the mean of each day, adjusted for missing times of day.

    A day without its peak is not a quiet day: its values are compared with the usual ones of their
    times, and the mean deviation is added to the usual mean.
    """
    if before.empty or after.empty:
        return np.zeros(0)
    usual = 0.5 * (before.groupby("time")["value"].mean() + after.groupby("time")["value"].mean())
    beyond = table["value"] - table["time"].map(usual)
    found = usual.mean() + beyond.groupby(table["day"]).mean()
    return np.asarray(found.to_numpy(np.float64))


def _paired(before: pd.DataFrame, after: pd.DataFrame) -> Difference:
    first, second = (each.groupby("time")["value"].mean().sort_index() for each in (before, after))
    apart = (second - first).to_numpy(np.float64)
    alike = _alike(apart)
    independent = len(apart) * (1.0 - alike) / (1.0 + alike)
    se = float(apart.std(ddof=1) / np.sqrt(independent))
    freedom = max(independent - 1.0, 1.0)
    return Difference(float(first.mean()), float(second.mean()), se, freedom, TIMES, len(apart))


def _welch(before: Floats, after: Floats, units: str, alike: float) -> Difference:
    counts = [len(each) * (1.0 - alike) / (1.0 + alike) for each in (before, after)]
    parts = [float(each.var(ddof=1)) / n for each, n in zip((before, after), counts, strict=True)]
    spread = sum(part**2 / max(n - 1.0, 1.0) for part, n in zip(parts, counts, strict=True))
    freedom = sum(parts) ** 2 / spread if spread > 0.0 else max(min(counts) - 1.0, 1.0)
    count = min(len(before), len(after))
    return Difference(
        float(before.mean()), float(after.mean()), float(np.sqrt(sum(parts))), freedom, units, count
    )


def _alike(values: Floats) -> float:
    """Return the correlation of neighbouring values, within 0 and `MOST_ALIKE`.

    The correlation r of a sample of n is too low by about (1 + 4 r) / n (Marriott and Pope 1954).
    """
    count = len(values)
    if count <= 4:
        return MOST_ALIKE
    off = values - values.mean()
    power = float((off**2).sum())
    found = float((off[1:] * off[:-1]).sum()) / power if power > 0.0 else 0.0
    return min(max((count * found + 1.0) / (count - 4), 0.0), MOST_ALIKE)


def holm_corrected(p: Floats) -> Floats:
    """Return probabilities corrected for the number of tests, by Holm's procedure.

    Parameters
    ----------
    p : (n,) array
        Probability of each test by itself; NaN for no test.
    """
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    found: Floats = np.full(len(p), np.nan)
    steps = p[order] * np.arange(len(order), 0, -1)
    found[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return found

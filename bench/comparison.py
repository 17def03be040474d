"""Power and false alarms of `gis-radar compare`: 5 % fewer vehicles on one of twenty lanes.

    python bench/comparison.py [--trials 400]

Days are drawn: a profile by quarters of an hour from 6 to 22 h, Poisson counts, the error of a
count as `gis-radar traffic` states it, and a random factor a day. Shown is how often the lane that
changes is significant, and how often any other one is, corrected for the number of lanes as
`gis_radar.compare` does it.
"""

from __future__ import annotations

import argparse

import numpy as np
import pandas as pd
from figures import table

from gis_radar.measures import compare_values, holm_corrected

LANES, LEVEL = 20, 0.05  # level of significance
QUARTERS = np.arange(24, 88)  # quarters of an hour from 6 to 22 h
COUNT_ERROR = 0.3  # root of the variance that a counted vehicle adds, as in lane measures
PROFILE = 1.0 + 0.5 * np.sin(QUARTERS / 10.0)  # of the volume, by quarter


def days(rng: np.random.Generator, count: int, veh_h: float, spread: float) -> pd.DataFrame:
    """Draw the volumes of a lane on some days; `spread` is the deviation from day to day."""
    parts = []
    for day in range(count):
        vehicles = rng.poisson(veh_h / 4.0 * PROFILE * max(rng.normal(1.0, spread), 0.1))
        errors = rng.normal(0.0, 1.0, len(vehicles)) * COUNT_ERROR * np.sqrt(vehicles)
        parts.append(
            pd.DataFrame({"day": day, "time": QUARTERS, "value": 4.0 * (vehicles + errors)})
        )
    return pd.concat(parts, ignore_index=True)


def trial(
    rng: np.random.Generator, count: int, veh_h: float, spread: float, change: float
) -> tuple[bool, bool]:
    """Return whether the lane that changes is significant, and whether any of the others is."""
    p = []
    for lane in range(LANES):
        factor = change if lane == 0 else 1.0
        before, after = (days(rng, count, veh_h * each, spread) for each in (1.0, factor))
        p.append(compare_values(before, after).p)
    told = holm_corrected(np.array(p)) < LEVEL
    return bool(told[0]), bool(told[1:].any())


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--trials", type=int, default=400)
    words.add_argument("--days", type=int, default=10)
    given = words.parse_args()
    rows = []
    for veh_h in (100.0, 400.0):
        for spread in (0.0, 0.02, 0.04):
            rng = np.random.default_rng(11)
            found = np.array(
                [trial(rng, given.days, veh_h, spread, 0.95) for _ in range(given.trials)]
            )
            told, false = found.mean(axis=0)
            rows.append([f"{veh_h:.0f}", f"{spread:.0%}", f"{told:.0%}", f"{false:.1%}"])
    print(table(["veh/h", "days differ by", "5 % fewer, told", "any other lane told"], rows))


if __name__ == "__main__":
    main()

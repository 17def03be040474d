"""Data quality as a picture: sensors by hours."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from gis_radar.quality.verdict import GOOD, NO_DATA

MOST_NUMBERS = 24  # hours; beyond that numbers would overlap
KINDS = {"good": "#a8c8e8", "at fault": "#d9641a", "no data": "#e5e7eb"}


def draw_hours(ax: Axes, table: pd.DataFrame, timezone: str) -> None:
    """Draw a row a sensor and a column an hour, coloured by the verdict.

    Parameters
    ----------
    ax : Axes
        Where.
    table : DataFrame
        As of :class:`gis_radar.Quality`.
    timezone : str
        Of its local hours.
    """
    sensors, hours = table["sensor"].unique(), np.sort(table["begin"].unique())
    row = pd.Index(sensors).get_indexer(table["sensor"])
    column = pd.Index(hours).get_indexer(table["begin"])
    kind = np.full((len(sensors), len(hours)), 2)
    bad = (table["verdict"] != GOOD).to_numpy(int)
    kind[row, column] = np.where(table["verdict"] == NO_DATA, 2, bad)
    ax.pcolormesh(kind, cmap=ListedColormap(list(KINDS.values())), vmin=0, vmax=2,
                  edgecolors="white", linewidth=1.0)  # fmt: skip
    if len(hours) <= MOST_NUMBERS:
        expected = table["frames_expected"].clip(lower=1)
        share = (100.0 * (table["frames"] - table["doubled"]) / expected).round()
        for x, y, text in zip(column, row, share, strict=True):
            ax.text(x + 0.5, y + 0.5, f"{text:.0f} %", ha="center", va="center", fontsize=8)
    local = pd.DatetimeIndex(hours).tz_convert(timezone)
    every = max(1, len(hours) // 12)
    labels = [f"{t:%H:%M}" + (f"\n{t:%Y-%m-%d}" if i == 0 or t.hour == 0 else "")
              for i, t in enumerate(local)]  # fmt: skip
    ax.set_xticks(np.arange(0, len(hours), every) + 0.5, labels[::every])
    ax.set_yticks(np.arange(len(sensors)) + 0.5, sensors)
    ax.invert_yaxis()
    ax.tick_params(length=0)
    ax.set(xlabel=f"hour ({timezone})", title="Data quality; share of the frames expected")
    ax.legend(handles=[Patch(color=c, label=n) for n, c in KINDS.items()], frameon=False,
              loc="upper left", bbox_to_anchor=(1.0, 1.0))  # fmt: skip

"""Frames: the steps in which a sensor delivered one, as runs of consecutive steps."""

from __future__ import annotations

import numpy as np
import pandas as pd

from gis_radar.occupancy.runs import Runs, union

COLUMNS = ("sensor", "view", "first_step", "last_step")


def runs_in(frames: pd.DataFrame) -> Runs:
    """Return the rows of a table of frames as they stand, as runs."""
    return Runs(
        first=frames["first_step"].to_numpy(np.int64), last=frames["last_step"].to_numpy(np.int64)
    )


def frames_table(frames: pd.DataFrame) -> pd.DataFrame:
    """Return a table of frames in its one form: fewest runs, ordered by sensor, view and step."""
    pieces = []
    for (sensor, view), group in frames.groupby(["sensor", "view"], sort=True):
        runs = union([runs_in(group)])
        pieces.append(
            pd.DataFrame(
                {"sensor": sensor, "view": view, "first_step": runs.first, "last_step": runs.last}
            )
        )
    empty = pd.DataFrame({"sensor": [], "view": [], "first_step": [], "last_step": []})
    table = pd.concat(pieces, ignore_index=True) if pieces else empty
    kinds = {"sensor": str, "view": str, "first_step": np.int64, "last_step": np.int64}
    return table.astype(kinds)[list(COLUMNS)]

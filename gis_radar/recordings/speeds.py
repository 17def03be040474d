"""Whether range rates are m/s: a look at the first frames of a recording."""

from __future__ import annotations

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.recordings.raw_rows import read_raw
from gis_radar.recordings.recording import Recording
from gis_radar.recordings.units import LEAST_JUDGED, MOVING_MPS, compare_speeds
from gis_radar.texts import Text

MOST_FRAMES = 2000  # read; 20 to 150 ms
ENOUGH = 4000  # moving detections
FAST_MPS = 20.0  # in m/s half of those that are over it are under 45; in cm/s what stands is under
FASTEST_MPS = 70.0  # over 250 km/h: no vehicle; in cm/s every walker
MOST_WILD = 0.02  # share of the detections that are so fast; as of data quality


def odd_speeds(recording: Recording) -> str:
    """Return what is odd in the range rates of a recording's begin; empty if nothing is.

    Parameters
    ----------
    recording : Recording
        Some hundred to 2000 frames are read.

    Returns
    -------
    str
        For a message that begins with the file's name.
    """
    batches: list[tuple[Floats, Floats, Floats]] = []
    frames = moving = rows = wild = 0
    for batch in read_raw(recording, rcs=False):
        speed = np.abs(batch.range_rate)
        moves = ~np.isnan(batch.x) & (speed >= MOVING_MPS)
        columns = (batch.x, batch.y, batch.z, batch.range_rate)
        x, y, z, fast = (values[moves].astype(np.float64) for values in columns)
        batches.append((batch.time[moves], np.column_stack([x, y, z]), fast))
        frames += 1 + int(np.count_nonzero(np.diff(batch.time)))
        rows, moving = rows + len(speed), moving + int(moves.sum())
        wild += int((speed > FASTEST_MPS).sum())
        if frames >= MOST_FRAMES or moving >= ENOUGH:
            break
    if not batches:
        return ""
    time, points, rate = (np.concatenate(part) for part in zip(*batches, strict=True))
    if odd := compare_speeds(time, points, rate):
        return odd
    fast = np.abs(rate[np.abs(rate) >= FAST_MPS])
    median = float(np.median(fast)) if len(fast) >= LEAST_JUDGED else 0.0
    if median <= FASTEST_MPS and wild <= MOST_WILD * rows:
        return ""
    return Text(
        "{:.1f} % of the detections are faster than {:g} m/s: range rates look like cm/s or mm/s",
        100.0 * wild / rows,
        FASTEST_MPS,
    )

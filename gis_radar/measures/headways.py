"""Headways and gaps at the counting lines of lanes.

A headway is the time from front to front of consecutive vehicles over a line, a gap that from the
rear of the first one to the front of the second one (Highway Capacity Manual, TRB, 7th edition,
chapter 4): gap = headway - length / speed of the first one. The mean headway is the inverse of the
flow (L. C. Edie, 1963).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gis_radar.base import STEP_S, Floats, Integers
from gis_radar.measures.lane_fronts import STOPPED_MPS, TrackedLanes
from gis_radar.measures.lane_measures import COUNTING_INFERRED, COUNTING_SEEN


class Headways(NamedTuple):
    """Headways, one for each pair of consecutive vehicles, sorted by lane and step.

    Parameters
    ----------
    lane, step : (k,) int64 arrays
        Position of the lane; step in which the second vehicle crosses its line.
    headway_s : (k,) array
        From front to front, seconds.
    gap_s : (k,) array
        From rear to front, at least 0; NaN where the first vehicle may have stopped over the line.
    variance : (k,) array
        Variance that the second vehicle adds to the number counted.
    """

    lane: Integers
    step: Integers
    headway_s: Floats
    gap_s: Floats
    variance: Floats


def headways(lanes: TrackedLanes) -> Headways:
    """Return the headways within a grid, of pairs between which the line is visible throughout."""
    crossed, line = lanes.visible_crossings, lanes.line_tile_id
    crossed = crossed.take(np.asarray(np.lexsort((crossed.step, crossed.lane)), np.int64))
    leader, follower = (crossed.take(each) for each in (slice(None, -1), slice(1, None)))
    pairs = leader.lane == follower.lane
    pairs &= lanes.visible.throughout(line[follower.lane], leader.step, follower.step)
    leader, follower = leader.take(pairs), follower.take(pairs)
    headway = np.asarray((follower.step - leader.step) * STEP_S, np.float64)
    length = lanes.vehicles.length_m[lanes.vehicles.of(leader.vehicle)]
    passing_s = np.where(
        leader.speed >= STOPPED_MPS, length / np.maximum(leader.speed, STOPPED_MPS), np.nan
    )
    error = np.where(follower.seen, COUNTING_SEEN, COUNTING_INFERRED)
    gap = np.asarray(np.maximum(headway - passing_s, 0.0), np.float64)
    return Headways(follower.lane, follower.step, headway, gap, np.asarray(error**2, np.float64))

"""Watch for small moves, by stationary targets and by the places of vehicles in their lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.calibration.monitoring import alarm
from gis_radar.calibration.monitoring.alarm import Alarm, Displacement
from gis_radar.calibration.monitoring.lane_places import Cells, cells_along, lane_places
from gis_radar.calibration.monitoring.stationary_targets import (
    BLOCK_S,
    GATE,
    StationaryTargets,
    Verdict,
)
from gis_radar.calibration.monitoring.windows import WindowFitter, WindowTraffic
from gis_radar.calibration.registration.state import State
from gis_radar.recordings import Detections

# Number of newest blocks by which a blow is excluded, and by which the size of a move is measured.
BLOW_BLOCKS = 1
LATEST_BLOCKS = 3


def decided(verdicts: Sequence[Verdict], driven: Displacement | None) -> Displacement | None:
    """Return the move that is beyond chance, or None.

    Where stationary targets would show a move of the wanted size, they alone decide: they measure
    it to centimetres and hundredths of degrees, vehicles in ten minutes to decimetres, and drivers
    change their habits. Elsewhere a move by either is reported.

    Parameters
    ----------
    verdicts : sequence of Verdict
        Verdicts of stationary targets.
    driven : Displacement or None
        The move by vehicles.
    """
    found = max((each.found for each in verdicts), key=lambda f: f.score, default=None)
    if found is not None and found.score > GATE:
        return found
    if driven is None or any(each.sees for each in verdicts):
        return None
    return driven if driven.score > alarm.GATE else None


class Watch:
    """Watch of a sensor for small moves while its pose is followed.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    """

    def __init__(self, fitter: WindowFitter) -> None:
        self._fitter = fitter
        self.restart()

    def restart(self) -> None:
        """Reset what was learnt: the sensor was moved."""
        self._cells: Cells | None = None
        self._since = np.nan
        self._still = StationaryTargets()
        self._block_since = np.nan
        self._newest: Verdict | None = None

    def push(self, batch: Detections) -> None:
        """Add the next detections, stationary ones, too."""
        self._still.push(batch.time, batch.points, batch.range_rate)

    @property
    def unmoved(self) -> bool:
        """Whether stationary targets show that the sensor was not moved, up to the last block."""
        return self._newest is not None and self._newest.rests

    def look(self, traffic: WindowTraffic | None, state: State, time: float) -> Displacement | None:
        """Return the move noticed so far, if any.

        Parameters
        ----------
        traffic : WindowTraffic or None
            The window up to now; None while there is no whole one with vehicles.
        state : State
            The pose; vehicles are placed by the first one since the start.
        time : float
            The present, UNIX seconds.
        """
        ended = self._still_block(time)
        driven = self._by_vehicles(traffic, state, time) if traffic is not None else None
        if not ended and driven is None:
            return None
        found = decided(self._still.tested, driven)
        if found is None or found is driven:
            return found
        # blocks from before a recent move would make it too small
        latest = self._still.verdict(LATEST_BLOCKS)
        if latest is not None:
            found = replace(found, move=latest.found.move, covariance=latest.found.covariance)
        return found.turned(state.R_map_sensor)

    def _still_block(self, time: float) -> bool:
        """Compare stationary targets if a block ends; return whether it did."""
        if np.isnan(self._block_since):
            self._block_since = time
        if time - self._block_since < BLOCK_S:
            return False
        self._block_since = time
        self._still.end_block()
        self._newest = self._still.verdict(BLOW_BLOCKS)
        return True

    def _by_vehicles(
        self, traffic: WindowTraffic, state: State, time: float
    ) -> Displacement | None:
        if self._cells is None:
            self._cells = cells_along(self._fitter.lanes(traffic.samples()))
            self._state, self._since = state, time
            self._alarm = Alarm(self._cells, state.position[:2])
        if time - self._since < alarm.BLOCK_S:
            return None
        seen = lane_places(
            traffic.moving,
            self._cells,
            self._state,
            since=self._since - alarm.SETTLE_S,
            until=time - alarm.SETTLE_S,
        )
        self._since = time
        return self._alarm.push(seen, time)

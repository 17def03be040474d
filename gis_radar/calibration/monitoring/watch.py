"""Detect small moves of a sensor, by stationary targets and by offsets of vehicles in lanes."""

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

# Number of newest blocks that are tested for a blow, and from which the size of a move is measured.
BLOW_BLOCKS = 1
LATEST_BLOCKS = 3


def decided(verdicts: Sequence[Verdict], by_vehicles: Displacement | None) -> Displacement | None:
    """Return the significant move, by stationary targets or by vehicles, or None.

    Where stationary targets are sensitive, they alone decide: they measure a move to centimetres
    and hundredths of degrees; vehicles, in ten minutes, to decimetres, and drivers change their
    habits. Elsewhere a move by either is reported.

    Parameters
    ----------
    verdicts : sequence of Verdict
        Verdicts of stationary targets.
    by_vehicles : Displacement or None
        The likeliest move by vehicles.
    """
    by_targets = max((each.displacement for each in verdicts), key=lambda f: f.score, default=None)
    if by_targets is not None and by_targets.score > GATE:
        return by_targets
    if by_vehicles is None or any(each.sensitive for each in verdicts):
        return None
    return by_vehicles if by_vehicles.score > alarm.GATE else None


class Watch:
    """Watches a sensor for small moves while its pose is followed.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    """

    def __init__(self, fitter: WindowFitter) -> None:
        self._fitter = fitter
        self.restart()

    def restart(self) -> None:
        """Reset cells, targets and references, after the sensor was moved."""
        self._cells: Cells | None = None
        self._vehicles_since = np.nan
        self._targets = StationaryTargets()
        self._block_since = np.nan
        self._newest: Verdict | None = None

    def push(self, batch: Detections) -> None:
        """Add the next detections, moving and stationary ones."""
        self._targets.push(batch.time, batch.points, batch.range_rate)

    @property
    def unmoved(self) -> bool:
        """Whether stationary targets show that the sensor was not moved, up to the last block."""
        return self._newest is not None and self._newest.at_rest

    def look(self, traffic: WindowTraffic | None, state: State, time: float) -> Displacement | None:
        """Return the significant move up to a time, if any, in the map's axes.

        Parameters
        ----------
        traffic : WindowTraffic or None
            The window up to the time; None while the window is not full or has no vehicles.
        state : State
            The pose; the first one since the last restart places the vehicles.
        time : float
            UNIX seconds.
        """
        block_ended = self._end_block_if_due(time)
        by_vehicles = self._move_by_vehicles(traffic, state, time) if traffic is not None else None
        if not block_ended and by_vehicles is None:
            return None
        move = decided(self._targets.tested, by_vehicles)
        if move is None or move is by_vehicles:
            return move
        # measured by the latest blocks only: earlier ones may be from before the move
        latest = self._targets.verdict(LATEST_BLOCKS)
        if latest is not None:
            move = replace(
                move, move=latest.displacement.move, covariance=latest.displacement.covariance
            )
        return move.turned(state.R_map_sensor)

    def _end_block_if_due(self, time: float) -> bool:
        """End a block of the stationary targets if it is due; return whether it was."""
        if np.isnan(self._block_since):
            self._block_since = time
        if time - self._block_since < BLOCK_S:
            return False
        self._block_since = time
        self._targets.end_block()
        self._newest = self._targets.verdict(BLOW_BLOCKS)
        return True

    def _move_by_vehicles(
        self, traffic: WindowTraffic, state: State, time: float
    ) -> Displacement | None:
        """End a block of vehicles if it is due; return the move of highest score, if any."""
        if self._cells is None:
            self._cells = cells_along(self._fitter.lanes(traffic.samples()))
            self._state, self._vehicles_since = state, time
            self._alarm = Alarm(self._cells, state.position[:2])
        if time - self._vehicles_since < alarm.BLOCK_S:
            return None
        seen = lane_places(
            traffic.moving,
            self._cells,
            self._state,
            since=self._vehicles_since - alarm.SETTLE_S,
            until=time - alarm.SETTLE_S,
        )
        self._vehicles_since = time
        return self._alarm.push(seen, time)

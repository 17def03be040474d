"""Blocks of time: the detections around a span of steps, in which vehicles are followed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pandas as pd

from gis_radar.tracking.detections import MapDetections


@dataclass(frozen=True, kw_only=True)
class Block:
    """Detections around a span of steps, with the frames in it.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive: whole, but that the first block begins at the first frame and the last
        one ends at the last frame, where there are none on the other side of the edge.
    detections : MapDetections
        Of the span and so much before and after as vehicles need to be known by.
    frames : DataFrame
        `sensor, view, first_step, last_step`: runs of steps with a frame, in the span.
    frames_before : DataFrame
        The same of the margin before it.
    begins, ends : bool
        Whether it is the first and the last block.
    """

    first_step: int
    last_step: int
    detections: MapDetections
    frames: pd.DataFrame
    frames_before: pd.DataFrame
    begins: bool
    ends: bool

    @property
    def margin(self) -> Block | None:
        """The margin before it as a block of its own; None where it has no frames."""
        before = self.frames_before
        if before.empty:
            return None
        first, last = int(before["first_step"].min()), self.first_step - 1
        return replace(
            self, first_step=first, last_step=last, frames=before, frames_before=before[:0]
        )

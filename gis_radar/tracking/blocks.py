"""Blocks of time, with the detections around a span of steps in which vehicles are followed."""

from __future__ import annotations

from dataclasses import dataclass

from gis_radar.tracking.detections import MapDetections


@dataclass(frozen=True, kw_only=True)
class Block:
    """The detections around a span of steps.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive. The first block begins at the first frame and the last one ends at the
        last frame, where there are no frames on the other side of the edge.
    detections : MapDetections
        Detections of the span and of the margins before and after it.
    """

    first_step: int
    last_step: int
    detections: MapDetections

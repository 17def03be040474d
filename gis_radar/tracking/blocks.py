"""Blocks of time: the detections around a span of steps, in which vehicles are followed."""

from __future__ import annotations

from dataclasses import dataclass

from gis_radar.tracking.detections import MapDetections


@dataclass(frozen=True, kw_only=True)
class Block:
    """The detections around a span of steps.

    Parameters
    ----------
    first_step, last_step : int
        The span, inclusive: whole, but that the first block begins at the first frame and the last
        one ends at the last frame, where there are none on the other side of the edge.
    detections : MapDetections
        Of the span and so much before and after as vehicles need to be known by.
    """

    first_step: int
    last_step: int
    detections: MapDetections

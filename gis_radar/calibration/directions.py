"""Directions as somebody sees them who stands beside a sensor, for messages."""

from __future__ import annotations

import math

from gis_radar.base import Text

SIDES = (
    Text("east"), Text("north-east"), Text("north"), Text("north-west"), Text("west"),
    Text("south-west"), Text("south"), Text("south-east"),
)  # fmt: skip
CLOCKWISE, ANTICLOCKWISE = Text("clockwise"), Text("anticlockwise")


def side(east: float, north: float) -> Text:
    """Return the side to which a step in the plane leads, of eight.

    Parameters
    ----------
    east, north : float
        The step.

    Examples
    --------
    >>> side(-2.0, 1.9)
    'north-west'
    """
    return SIDES[round(math.degrees(math.atan2(north, east)) / 45.0) % 8]


def sense(turn: float) -> Text:
    """Return the sense of a turn of yaw, seen from above, or of roll, seen from ahead.

    Parameters
    ----------
    turn : float
        The turn, positive as yaw counts.
    """
    return CLOCKWISE if turn < 0.0 else ANTICLOCKWISE

"""Curves: directions along the smooth line that a polyline of a map stands for.

A map draws a bend as a few chords, with a jump of direction at each corner; a vehicle turns
steadily. The speed is the range rate divided by the cosine of the angle between direction and line
of sight: near 90 degrees, an error of a few degrees in the direction changes it by half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import shapely

from gis_radar.base import Floats, heading_difference

_DRAWING_ERROR_M = 0.05  # accuracy of drawn lines: a vertex nearer to a chord is no corner
_EQUAL_TURN_RAD = np.radians(5.0)  # two turns that differ by less are equal
_BEND_RAD = np.radians(30.0)  # a sharper turn from lane to lane is a corner, not a bend


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Direction along a line; at a corner it changes over half of the shorter chord on either side.

    Parameters
    ----------
    length_m : (n,) array
        Lengths of the chords.
    heading : (n,) array
        Directions of the chords, radians counter-clockwise from east, without jumps of 2 pi.
    """

    length_m: Floats
    heading: Floats

    @classmethod
    def of(cls, line: shapely.LineString) -> Self:
        """Return the curve that a polyline stands for."""
        chords = np.diff(shapely.get_coordinates(line.simplify(_DRAWING_ERROR_M)), axis=0)
        chords = chords[np.hypot(*chords.T) > 0.0] if chords.any() else chords[:1]
        heading = np.unwrap(np.arctan2(chords[:, 1], chords[:, 0]))
        return cls(length_m=np.hypot(*chords.T), heading=heading)

    def heading_at(self, share: Floats, before: Curve | None, after: Curve | None) -> Floats:
        """Return directions (k,), radians, at shares of the length.

        Parameters
        ----------
        share : (k,) array
            Shares of the length, in [0, 1].
        before, after : Curve, optional
            Curves that join it without a corner.
        """
        length, heading, begin = self.length_m, self.heading, 0.0
        if before is not None:
            begin = float(before.length_m[-1])
            length = np.append(begin, length)
            heading = np.append(
                heading[0] + heading_difference(before.heading[-1], heading[0]), heading
            )
        if after is not None:
            length = np.append(length, after.length_m[0])
            heading = np.append(
                heading, heading[-1] + heading_difference(after.heading[0], heading[-1])
            )
        corner, half = np.cumsum(length)[:-1], 0.5 * np.minimum(length[:-1], length[1:])
        bend_ends = np.column_stack([corner - half, corner + half]).ravel()
        headings = np.repeat(heading, 2)[1:-1]
        place = begin + share * self.length_m.sum()
        if len(heading) == 1:
            return np.full(len(share), heading[0])
        return np.asarray(np.interp(place, bend_ends, headings))


def lane_headings(
    bounds: Sequence[tuple[shapely.LineString, shapely.LineString]],
    shares: Sequence[Floats],
    after: Sequence[Sequence[int]],
) -> list[Floats]:
    """Return the directions along the middle of lanes; bends continue from lane to lane.

    Parameters
    ----------
    bounds : sequence of pairs of LineString
        Left and right bound of each lane.
    shares : sequence of (k,) arrays
        For each lane, the places to return directions for: shares of the length, in [0, 1].
    after : sequence of sequences of int
        Positions of the lanes that follow each.

    Returns
    -------
    list of (k,) arrays
        Radians counter-clockwise from east, without jumps of 2 pi within a lane.
    """
    curves = [tuple(Curve.of(line) for line in pair) for pair in bounds]
    before = [list[int]() for _ in bounds]
    for k, following in enumerate(after):
        for other in following:
            before[other].append(k)
    headings = []
    for k, share in enumerate(shares):
        displacement = np.zeros((len(share), 2))
        for side, curve in enumerate(curves[k]):
            turns_before = {
                heading_difference(curve.heading[0], curves[j][side].heading[-1]): j
                for j in before[k]
            }
            turns_after = {
                heading_difference(curves[j][side].heading[0], curve.heading[-1]): j
                for j in after[k]
            }
            earlier, later = _straightest(turns_before), _straightest(turns_after)
            heading = curve.heading_at(
                share,
                None if earlier is None else curves[earlier][side],
                None if later is None else curves[later][side],
            )
            # Displacements of both sides add up to twice that of the middle: the same direction.
            displacement += curve.length_m.sum() * np.column_stack(
                [np.cos(heading), np.sin(heading)]
            )
        headings.append(np.unwrap(np.arctan2(displacement[:, 1], displacement[:, 0])))
    return headings


def _straightest(turns: dict[float, int]) -> int | None:
    """Return the lane, of those by their turn (rad), that continues straightest.

    None where all turn by `_BEND_RAD` or more, or where two of them fork evenly.
    """
    least, *others = sorted(turns, key=abs) or [np.inf]
    parts = any(
        abs(each - least) > _EQUAL_TURN_RAD and abs(each) - abs(least) < _EQUAL_TURN_RAD
        for each in others
    )
    return None if parts or abs(least) >= _BEND_RAD else turns[least]

"""Levels: roads that pass over or steeply beside each other, told apart by the map's heights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

from gis_radar.arrays import Floats, Integers
from gis_radar.lanelets.bounds import at_fractions, length

SPACING_M = 2.0
# Two lanelets this close belong to one surface unless the way from one to the other would be
# steeper than any road.
NEAR_M = 6.0
STEP_M = 1.0
STEEPEST = 0.3


@dataclass(frozen=True, kw_only=True)
class Level:
    """Roads that make one surface in the plane: at no place does one pass over another.

    Parameters
    ----------
    shapes : array of Polygon
        Their outlines, which may overlap.
    heights : (n, 3) array
        Easting, northing and height of points on them; empty where the map knows no heights.
    """

    shapes: Any = field(repr=False)
    heights: Floats = field(default_factory=lambda: np.empty((0, 3)), repr=False)

    @property
    def has_heights(self) -> bool:
        """Whether the map knows how high these roads lie."""
        return len(self.heights) > 0

    @cached_property
    def tree(self) -> shapely.STRtree:
        """Finds the shapes at a place."""
        return shapely.STRtree(self.shapes)

    def height_near(self, xy: Floats) -> Floats:
        """Return the map's height of the road nearest to the 2 m square of each place, (n,)."""
        squares = np.floor(xy / SPACING_M).astype(np.int64)
        squares -= squares.min(axis=0) if len(squares) else 0
        width = int(squares[:, 0].max(initial=0)) + 1
        unique, which = np.unique(squares[:, 1] * width + squares[:, 0], return_inverse=True)
        first = np.empty(len(unique), np.int64)
        first[which] = np.arange(len(xy))
        middle = (np.floor(xy[first] / SPACING_M) + 0.5) * SPACING_M
        return np.asarray(self._heights_at(middle)[which])

    def _heights_at(self, xy: Floats) -> Floats:
        _, nearest = self._samples.query(xy)
        return np.asarray(self.heights[nearest, 2])

    @cached_property
    def _samples(self) -> cKDTree:
        return cKDTree(self.heights[:, :2])


def levels_of(outlines: Any, lefts: Iterable[Any], rights: Iterable[Any]) -> tuple[Level, ...]:
    """Sort lanelets into levels.

    Parameters
    ----------
    outlines : array of Polygon
        The lanelets in the plane.
    lefts, rights : iterables of LineString
        Their bounds, with heights where the map knows them.
    """
    outlines = np.asarray(outlines)
    samples = [_sampled(left, right) for left, right in zip(lefts, rights, strict=True)]
    owner = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    points = np.concatenate(samples)
    known = np.isfinite(points[:, 2])
    if not known.any():
        return (Level(shapes=outlines),)
    points, owner = points[known], owner[known]
    number = _numbered(points, owner, len(outlines))
    return tuple(
        Level(shapes=outlines[number == level], heights=points[number[owner] == level])
        for level in range(int(number.max()) + 1)
    )


def _sampled(left: shapely.LineString, right: shapely.LineString) -> Floats:
    """Return points on both bounds and between them, (n, 3)."""
    bounds = [shapely.get_coordinates(line, include_z=True) for line in (left, right)]
    count = max(2, round(max(length(bound) for bound in bounds) / SPACING_M) + 1)
    fractions = np.linspace(0.0, 1.0, count)
    on_left, on_right = (at_fractions(bound, fractions) for bound in bounds)
    return np.concatenate([on_left, (on_left + on_right) / 2.0, on_right])


def _numbered(points: Floats, owner: Integers, count: int) -> Integers:
    """Return the level of each lanelet: the lowest that none in conflict with it has taken."""
    above, below = _conflicts(points, owner)
    number = np.zeros(count, np.int64)
    mean = np.bincount(owner, points[:, 2], count) / np.maximum(np.bincount(owner, None, count), 1)
    rivals: dict[int, set[int]] = {}
    for a, b in zip(above.tolist(), below.tolist(), strict=True):
        rivals.setdefault(a, set()).add(b)
        rivals.setdefault(b, set()).add(a)
    settled: set[int] = set()
    for lanelet in sorted(rivals, key=lambda one: (mean[one], one)):
        taken = {int(number[other]) for other in rivals[lanelet] & settled}
        number[lanelet] = next(level for level in range(count) if level not in taken)
        settled.add(lanelet)
    return number


def _conflicts(points: Floats, owner: Integers) -> tuple[Integers, Integers]:
    """Return pairs of lanelets that cannot be one surface."""
    if np.ptp(points[:, 2]) <= STEP_M:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    pairs = cKDTree(points[:, :2]).query_pairs(NEAR_M, output_type="ndarray")
    a, b = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]].T
    step = np.abs(points[a, 2] - points[b, 2])
    near = np.hypot(*(points[a, :2] - points[b, :2]).T)
    steep = step > STEP_M + STEEPEST * near
    unique = np.unique(np.column_stack([owner[a[steep]], owner[b[steep]]]), axis=0)
    return unique[:, 0], unique[:, 1]

"""Shapes of a sensor on the map: what it reaches, and where it may truly stand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely

from gis_radar.arrays import Floats

_ARC_DEG = 2.0  # between points of a drawn arc: 5 cm off at 300 m
_CHI2_95 = -2.0 * math.log(0.05)  # of two degrees of freedom
INK = "#111827"


def rim(position: Floats, R_map_sensor: Floats, view: Any) -> shapely.Polygon:  # noqa: N803
    """Return what a sensor's azimuth and range reach in the map, seen from above.

    The rim is the view's azimuths at elevation 0 in the sensor frame, turned by the whole pose:
    a sensor that hangs upside down or looks down is drawn where it looks.

    Parameters
    ----------
    position : (3,) array
        In the map, metres.
    R_map_sensor : (3, 3) array
        Where it looks.
    view : View
        What it sees.
    """
    half = math.radians(view.azimuth_deg) / 2
    steps = max(2, math.ceil(view.azimuth_deg / _ARC_DEG) + 1)
    angle = np.linspace(-half, half, steps)
    rays = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(steps)])
    flat = (rays @ R_map_sensor.T)[:, :2]
    outer, inner = (position[:2] + flat * reach for reach in (view.max_range_m, view.min_range_m))
    if view.azimuth_deg >= 360.0:
        return shapely.Polygon(outer, [inner])
    return shapely.Polygon(np.concatenate([outer, inner[::-1]]))


def ellipse(centre: Floats, covariance: Floats) -> shapely.Polygon:
    """Return the ellipse that holds the true place with 95 % probability.

    Parameters
    ----------
    centre : (2,) array
        Easting, northing, metres.
    covariance : (2, 2) array
        Of easting and northing, m^2.
    """
    values, axes = np.linalg.eigh(covariance)
    half_m = np.sqrt(np.maximum(values, 0.0) * _CHI2_95)
    angle = np.linspace(0.0, 2 * math.pi, 73)
    return shapely.Polygon(
        centre + np.column_stack([np.cos(angle), np.sin(angle)]) * half_m @ axes.T
    )


def draw_sensor(
    ax: Any, position: Floats, ahead: Floats, ring: shapely.Polygon | None, label: str
) -> None:
    """Draw a sensor, an arrow to where it looks, and the ellipse of its place.

    Parameters
    ----------
    ax : matplotlib Axes
        In metres of the map.
    position : (2,) or (3,) array
        Where it stands.
    ahead : (2,) array
        The arrow, metres.
    ring : Polygon, optional
        The ellipse.
    label : str
        For the legend.
    """
    place = tuple(position[:2])
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.5, "shrinkA": 0, "shrinkB": 0}
    tip = (position[0] + ahead[0], position[1] + ahead[1])
    ax.annotate("", tip, place, arrowprops=arrow, zorder=5, annotation_clip=True)
    ax.scatter(*place, s=34, color=INK, marker="^", label=label, zorder=6)
    if ring is not None:
        x, y = ring.exterior.xy
        ax.plot(x, y, color=INK, linewidth=1.0, label="95 % ellipse of the place", zorder=5)

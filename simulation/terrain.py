"""Terrain: the height of the ground as a formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.base import Floats


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """A tilted plane with a long, low wave.

    Parameters
    ----------
    origin : tuple of float
        Easting and northing of a point of the plane.
    height_m : float
        Height of that point.
    slope : tuple of float
        Rise per metre to the east and to the north.
    wave_m, wave_length_m : float
        Amplitude and length of the wave.
    """

    origin: tuple[float, float]
    height_m: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    wave_m: float = 0.0
    wave_length_m: float = 200.0

    def height(self, points: Floats) -> Floats:
        """Return the ground's height at ``(n, 2)`` points, metres."""
        local = np.asarray(points)[..., :2] - np.array(self.origin)
        turn = 2.0 * np.pi / self.wave_length_m
        wave = np.sin(local[..., 0] * turn) * np.cos(local[..., 1] * turn)
        return np.asarray(self.height_m + local @ np.array(self.slope) + self.wave_m * wave)

    def gradient(self, points: Floats) -> Floats:
        """Return the rise per metre to the east and to the north at ``(n, 2)`` points."""
        turn = 2.0 * np.pi / self.wave_length_m
        east, north = ((np.asarray(points)[..., :2] - np.array(self.origin)) * turn).T
        wave = np.stack([np.cos(east) * np.cos(north), -np.sin(east) * np.sin(north)], axis=-1)
        return np.asarray(np.array(self.slope) + self.wave_m * turn * wave)

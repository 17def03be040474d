"""Targets over time: drawn anew in every frame, or lasting with errors of their own.

In a textbook's model points and errors are independent from frame to frame and average out. In
recordings the same scatter points are seen again and again, each with its own cross section, and
errors of range and angles change over seconds (multipath).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from gis_radar.base import Floats, Integers
from simulation.clutter import Clutter
from simulation.movement import Vehicles
from simulation.scatterers import (
    SPOT_DB,
    Scatterers,
    Spots,
    draw_spots,
    face_rates,
    place_spots,
    vehicle_scatterers,
)
from simulation.scene import Scene

_VEHICLE_SLOTS = 1024  # sets of scatter points that last; vehicles share them by number
_SPOTS_PER_FACE = 6  # of a car's end: two lamps, two corners, bumper and plate
_WAVES = 8  # sines that sum up to a slow error: nearly normal (kurtosis 2.8)
_MOST_CHANCE = 0.98  # of a fixed point to be in a frame
_AROUND_M = 4.0  # radius of the mean that a detector of constant false-alarm rate (CFAR) compares
# Loss of open frames beside a car's body; with their size a motorcycle is 7 dB below a car, a
# bicycle 9 dB. Assumed, not measured; it decides how often each is detected.
OPEN_FRAME_DB = {"motorcycle": 4.0, "cyclist": 6.0}


class Targets(Protocol):
    """Interface of the targets around a radar over its whole recording."""

    @property
    def clutter(self) -> Clutter:
        """Fixed points."""

    @property
    def chance(self) -> Floats:
        """Chance of each fixed point to be in a frame."""

    def fade(self, count: int, rng: np.random.Generator) -> Floats:
        """Return how the cross sections of `count` fixed points differ from their mean, dB."""

    def vehicle_scatterers(
        self, vehicles: Vehicles, scene: Scene, eye: Floats, *, density: float,
        rng: np.random.Generator,
    ) -> Scatterers:  # fmt: skip
        """Return the scatter points of vehicles in this frame."""

    def of(self, number: Integers) -> Integers:
        """Return the numbers of the lasting targets of vehicles; -1: none lasts."""

    def bias(self, target: Integers, time: float) -> Floats:
        """Return the errors of range (m), azimuth and elevation (rad) of targets, (n, 3)."""


@dataclass(frozen=True, kw_only=True)
class Fleeting:
    """Targets of a textbook's radar, drawn anew in every frame.

    Parameters
    ----------
    fade_db : float
        Standard deviation of a fixed point's cross section from frame to frame.
    """

    fade_db: float = 3.0

    def draw(
        self, clutter: Clutter, strength_db: Floats, per_frame: float, rng: np.random.Generator
    ) -> Targets:
        """Return the targets of a recording; weak fixed points are detected in some frames."""
        del rng
        chance = _scaled(expit(strength_db / 2.0), per_frame)
        return _FleetingTargets(clutter=clutter, chance=chance, fade_db=self.fade_db)


@dataclass(frozen=True, kw_only=True)
class _FleetingTargets:
    """The targets of `Fleeting` around one radar."""

    clutter: Clutter
    chance: Floats
    fade_db: float

    def fade(self, count: int, rng: np.random.Generator) -> Floats:
        """Return a new draw."""
        return rng.normal(0.0, self.fade_db, count)

    def vehicle_scatterers(
        self, vehicles: Vehicles, scene: Scene, eye: Floats, *, density: float,
        rng: np.random.Generator,
    ) -> Scatterers:  # fmt: skip
        """Return new scatter points."""
        return vehicle_scatterers(vehicles, scene, eye, density=density, rng=rng)

    def of(self, number: Integers) -> Integers:
        """Return that no target lasts."""
        return np.full(len(number), -1)

    def bias(self, target: Integers, time: float) -> Floats:
        """Return zeros: all errors are independent from frame to frame."""
        del time
        return np.zeros((len(target), 3))


@dataclass(frozen=True, kw_only=True)
class Lasting:
    """Targets as recorded, the same in every frame.

    Parameters
    ----------
    range_m, azimuth_deg, elevation_deg : float
        Standard deviations of each target's slowly changing error.
    seconds : float
        Correlation time of that error (correlation ``exp(-dt^2 / (2 seconds^2))``).
    softness_db : float
        Width of the rise of a fixed point's chance where its strength passes the threshold.
    """

    range_m: float
    azimuth_deg: float
    elevation_deg: float
    seconds: float
    softness_db: float

    def draw(
        self, clutter: Clutter, strength_db: Floats, per_frame: float, rng: np.random.Generator
    ) -> Targets:
        """Return the targets of a recording; fixed points that stand out are always detected.

        Each fixed point gets a speckle (exponential power) that stays: nothing moves.
        """
        speckle = 10.0 * np.log10(rng.exponential(1.0, len(clutter.rcs)))
        clutter = Clutter(point=clutter.point, rcs=clutter.rcs + speckle, wobble=clutter.wobble)
        contrast_db = _contrast(clutter.point, strength_db + speckle)
        size = np.array([self.range_m, *np.radians([self.azimuth_deg, self.elevation_deg])])
        shape = (len(speckle) + _VEHICLE_SLOTS, 3, _WAVES)
        side = np.repeat([False, True], 2 * _SPOTS_PER_FACE)
        return _LastingTargets(
            clutter=clutter,
            chance=_thresholded(contrast_db / self.softness_db, per_frame),
            spots=draw_spots(np.tile(side, _VEHICLE_SLOTS), rng),
            spot_rcs=rng.normal(0.0, SPOT_DB, len(side) * _VEHICLE_SLOTS),
            pace=rng.normal(0.0, 1.0 / self.seconds, shape),
            phase=rng.uniform(0.0, 2.0 * np.pi, shape),
            size=size * np.sqrt(2.0 / _WAVES),
        )


@dataclass(frozen=True, kw_only=True)
class _LastingTargets:
    """The targets of `Lasting` around one radar: fixed points, then vehicles by number."""

    clutter: Clutter
    chance: Floats
    spots: Spots = field(repr=False)
    spot_rcs: Floats = field(repr=False)
    pace: Floats = field(repr=False)
    phase: Floats = field(repr=False)
    size: Floats = field(repr=False)

    def fade(self, count: int, rng: np.random.Generator) -> Floats:
        """Return zeros: only the measurement's noise changes."""
        del rng
        return np.zeros(count)

    def vehicle_scatterers(
        self, vehicles: Vehicles, scene: Scene, eye: Floats, *, density: float,
        rng: np.random.Generator,
    ) -> Scatterers:  # fmt: skip
        """Draw which of each vehicle's scatter points are in this frame."""
        rates, signs = face_rates(vehicles, eye, density)
        outward = np.tile(np.repeat([1.0, -1.0], _SPOTS_PER_FACE), 2)
        lit = np.repeat(signs.T, 2 * _SPOTS_PER_FACE, axis=1) == outward
        chance = np.repeat(rates.T, 2 * _SPOTS_PER_FACE, axis=1) / _SPOTS_PER_FACE
        owner, slot = np.nonzero(lit & (rng.random(lit.shape) < chance))
        number = vehicles.number[owner]
        row = number % _VEHICLE_SLOTS * lit.shape[1] + slot
        less = np.array([OPEN_FRAME_DB.get(kind, 0.0) for kind in vehicles.kind])
        scatterers = place_spots(
            vehicles, scene, owner, outward[slot], self.spots.where(row),
            spin=rng.uniform(0.0, 2.0 * np.pi, len(row)), rcs=self.spot_rcs[row] - less[owner],
        )  # fmt: skip
        return scatterers.of(self.of(number))

    def of(self, number: Integers) -> Integers:
        """Return numbers after those of the fixed points."""
        return len(self.clutter.rcs) + number % _VEHICLE_SLOTS

    def bias(self, target: Integers, time: float) -> Floats:
        """Return the errors at a time: sums of sines."""
        swing = np.cos(self.pace[target] * time + self.phase[target]).sum(axis=-1)
        return np.where(target[:, None] >= 0, swing * self.size, 0.0)


def _scaled(chance: Floats, total: float) -> Floats:
    """Return chances scaled to a sum, each at most 0.95."""
    low, high = 0.0, 100.0
    for _ in range(40):
        middle = (low + high) / 2.0
        enough = float(np.minimum(chance * middle, 0.95).sum()) > total
        low, high = (low, middle) if enough else (middle, high)
    return np.minimum(chance * low, 0.95)


def _contrast(point: Floats, strength_db: Floats) -> Floats:
    """Return the strength of points over noise and the mean around them, dB (CFAR)."""
    if not len(point):
        return strength_db
    power = 10.0 ** (strength_db / 10.0)
    around = cKDTree(point).query_ball_point(point, _AROUND_M)
    mean = np.array([power[rows].mean() for rows in around])
    return np.asarray(strength_db - 10.0 * np.log10(1.0 + mean))


def _thresholded(strength: Floats, total: float) -> Floats:
    """Return chances that rise where strength passes a threshold, which gives them a sum."""
    low, high = -100.0, 100.0
    for _ in range(40):
        middle = (low + high) / 2.0
        enough = float(expit(strength - middle).sum()) * _MOST_CHANCE > total
        low, high = (middle, high) if enough else (low, middle)
    return np.asarray(_MOST_CHANCE * expit(strength - low))

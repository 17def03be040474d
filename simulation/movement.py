"""Movement: place and motion of every road user, every 50 ms and in between."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gis_radar.base import STEP_S, Booleans, Floats, Integers
from simulation.terrain import Terrain

Names: TypeAlias = NDArray[np.str_]


@dataclass(frozen=True, kw_only=True)
class Vehicles:
    """The vehicles at one moment, one row each.

    Parameters
    ----------
    time : float
        UNIX seconds.
    number : Integers
        Column in `Traffic`, ``(n,)``.
    kind : Names
        Kind, ``(n,)``, as in `Traffic`.
    centre : Floats
        Middle of the vehicle in the map, ``(n, 2)``, metres.
    heading : Floats
        Radians, counter-clockwise from grid east.
    speed : Floats
        m/s.
    yaw_rate : Floats
        rad/s.
    size : Floats
        Length, width and height, ``(n, 3)``, metres.
    """

    time: float
    number: Integers
    kind: Names
    centre: Floats
    heading: Floats
    speed: Floats
    yaw_rate: Floats
    size: Floats

    def where(self, keep: Booleans | Integers) -> Vehicles:
        """Return the vehicles for which `keep` is true, or of these rows."""
        rows = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "time"}
        return Vehicles(time=self.time, **rows)


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """Coupling of a trailer.

    Parameters
    ----------
    drawn_by : int
        The body that draws it.
    whole_m : float
        Length of the whole vehicle when it is straight, metres.
    """

    drawn_by: int
    whole_m: float


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Movement of all vehicles every 50 ms; a trailer is a vehicle of its own here.

    Parameters
    ----------
    start : float
        UNIX seconds of the first row.
    centre : Floats
        ``(times, vehicles, 2)`` in the map, metres; NaN where the vehicle is not there.
    heading, speed, yaw_rate : Floats
        ``(times, vehicles)`` in rad (continuous), m/s, rad/s.
    size : Floats
        Length, width and height, ``(vehicles, 3)``, metres.
    kind : tuple of str
        Kind of every vehicle.
    couplings : dict[int, Coupling]
        Trailers by their column.
    """

    start: float
    centre: Floats = field(repr=False)
    heading: Floats = field(repr=False)
    speed: Floats = field(repr=False)
    yaw_rate: Floats = field(repr=False)
    size: Floats = field(repr=False)
    kind: tuple[str, ...] = field(repr=False)
    couplings: dict[int, Coupling] = field(default_factory=dict, repr=False)

    def at(self, time: float) -> Vehicles:
        """Return the vehicles at a time (UNIX seconds), interpolated between rows."""
        place = np.clip((time - self.start) / STEP_S, 0.0, len(self.speed) - 1.0)
        low = min(int(place), len(self.speed) - 2)
        share = place - low

        def between(values: Floats) -> Floats:
            return np.asarray(values[low] * (1.0 - share) + values[low + 1] * share)

        centre = between(self.centre)
        there = np.flatnonzero(np.isfinite(centre[:, 0]))
        return Vehicles(
            time=time,
            number=there,
            kind=np.array(self.kind, dtype=np.str_)[there],
            centre=centre[there],
            heading=between(self.heading)[there],
            speed=between(self.speed)[there],
            yaw_rate=between(self.yaw_rate)[there],
            size=self.size[there],
        )

    def joined(self, other: Traffic) -> Traffic:
        """Return this traffic and the other's, of the same time, as one."""
        count = len(self.kind)
        more = {
            body + count: Coupling(drawn_by=c.drawn_by + count, whole_m=c.whole_m)
            for body, c in other.couplings.items()
        }
        return Traffic(
            start=self.start,
            centre=np.concatenate([self.centre, other.centre], axis=1),
            heading=np.concatenate([self.heading, other.heading], axis=1),
            speed=np.concatenate([self.speed, other.speed], axis=1),
            yaw_rate=np.concatenate([self.yaw_rate, other.yaw_rate], axis=1),
            size=np.concatenate([self.size, other.size]),
            kind=self.kind + other.kind,
            couplings=self.couplings | more,
        )

    def table(self, terrain: Terrain) -> pd.DataFrame:
        """Return the true traffic as a table, sorted by time and vehicle.

        Returns
        -------
        DataFrame
            ``t`` UNIX seconds; ``id``; ``easting northing height`` of the middle of the vehicle
            at road height, metres; ``heading`` degrees counter-clockwise from grid east;
            ``speed`` m/s; ``length width vehicle_height`` metres; ``kind``. A vehicle with a
            trailer has two rows of one ``id``: ``part`` 0 draws, 1 is the trailer; in
            ``whole_length`` both have the length of the vehicle.
        """
        row, column = np.nonzero(np.isfinite(self.speed))
        centre = self.centre[row, column]
        turned = np.degrees(self.heading[row, column])
        length, width, height = self.size[column].T
        drawn_by, whole = np.arange(len(self.kind)), self.size[:, 0].copy()
        for body, coupling in self.couplings.items():
            drawn_by[body] = coupling.drawn_by
            whole[[body, coupling.drawn_by]] = coupling.whole_m
        # rounded to 1/1024 m: such numbers compress well
        place = np.rint(np.column_stack([centre, terrain.height(centre)]) * 1024.0) / 1024.0
        return pd.DataFrame(
            {
                "t": np.round(self.start + row * STEP_S, 3),
                "id": drawn_by[column].astype(np.int32),
                "easting": place[:, 0],
                "northing": place[:, 1],
                "height": place[:, 2],
                "heading": (np.rint(turned * 64.0) / 64.0 + 180.0) % 360.0 - 180.0,
                "speed": np.rint(self.speed[row, column] * 256.0) / 256.0,
                "length": length,
                "width": width,
                "vehicle_height": height,
                "kind": np.array(self.kind, dtype=np.str_)[column],
                "part": (drawn_by != np.arange(len(drawn_by)))[column].astype(np.int8),
                "whole_length": whole[column],
            }
        )

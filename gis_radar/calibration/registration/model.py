"""Model of how vehicles drive and reflect: constants, each with the uncertainty of its value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np


def _known(value: float, *, within: float) -> Any:
    """Return a field for a constant whose logarithm has the standard deviation `log(within)`."""
    return field(default=value, metadata={"within": within})


@dataclass(frozen=True, kw_only=True)
class Model:
    """Constants of vehicles and the radar that a registration assumes.

    Lengths in metres, angles in radians. No constant holds for every radar and every street, so
    each carries the standard deviation of its own error, which goes into an answer's covariance
    (considered parameters after Schmidt; Tapley, Schutz and Born 2004, section 6.3).

    Parameters
    ----------
    habit : float
        Mean offset of drivers to the left of the middle of their lane.
    half_width : float
        Half of a vehicle's width: small cars to lorries are 1.7 to 2.5 m wide.
    side_strength : float
        Number of detections of a side over that of a front, both seen perpendicularly.
    hidden_strength, hidden_share : float
        The same ratio of vehicles in a queue, whose fronts and rears are hidden, and the share of
        such vehicles.
    face : float
        One standard deviation of reflections about a side, or about a third of a front.
    driver : float
        One standard deviation, among vehicles, of the offset from `habit`.
    wander : float
        One standard deviation of a vehicle's offset from one ten metres of its lane to the next.
    bearing, elevation : float
        One standard deviation of the radar's angles.
    low : float
        One standard deviation of the height of reflections from bumpers, sills and wheels.
    vehicle : float
        One standard deviation, among vehicles, of the mean height of these reflections.
    bent : float
        One standard deviation of an error of elevation that all detections of a vehicle share, by
        multipath over the ground and other vehicles.
    lasting : float
        Correlation time of that error, seconds: of a Matern covariance of order 3/2.
    body_share, body_over, body : float
        Reflections from the rest of the body: their share, mean height over the others, and one
        standard deviation of it.
    """

    habit: float = field(default=0.0, metadata={"sigma": 0.1})
    half_width: float = _known(0.9, within=1.1)
    side_strength: float = _known(1.0, within=1.5)
    hidden_strength: float = _known(10.0, within=1.5)
    hidden_share: float = _known(0.3, within=1.5)
    face: float = _known(0.25, within=1.4)
    driver: float = _known(0.25, within=1.4)
    wander: float = _known(0.2, within=1.4)
    bearing: float = _known(float(np.radians(0.2)), within=1.5)
    elevation: float = _known(float(np.radians(0.6)), within=1.3)
    low: float = _known(0.25, within=1.4)
    vehicle: float = _known(0.3, within=1.3)
    bent: float = _known(float(np.radians(0.5)), within=1.5)
    lasting: float = _known(4.0, within=1.5)
    body_share: float = _known(0.3, within=1.5)
    body_over: float = _known(1.0, within=1.3)
    body: float = _known(0.8, within=1.3)

    def variations(self) -> Iterator[tuple[str, Model, Model]]:
        """Yield each constant's name, and the models with it one sigma lower and higher."""
        for constant in fields(self):
            value = getattr(self, constant.name)
            sigma, within = (
                constant.metadata.get("sigma", 0.0),
                constant.metadata.get("within", 1.0),
            )
            yield (
                constant.name,
                replace(self, **{constant.name: value / within - sigma}),
                replace(self, **{constant.name: value * within + sigma}),
            )


MODEL = Model()

"""Normal equations, in which what each vehicle adds by itself is eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.compiled import compiled
from gis_radar.registration.residuals import Residuals
from gis_radar.registration.state import SIZE


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Normal equations with the vehicles' own terms eliminated (Schur complement).

    Parameters
    ----------
    information : (7, 7) array
        Of the state.
    gradient : (7,) array
        Of the cost by the state.
    scores : (tracks, 7) array
        Each vehicle's part of the gradient.
    shared : list of (gradient, coupling, variance)
        For each family what gives the vehicles' own terms back.
    """

    information: Floats
    gradient: Floats
    scores: Floats
    shared: list[tuple[Floats, Floats, Floats]]


def assemble(
    families: list[Residuals], own: Floats, track: Integers, *, curved: bool = False
) -> Normal:
    """Sum up the families of residuals; `curved` by what the loss truly tells, not by the weights.

    For rows with weights p and a term b_k ~ N(0, tau^2) of vehicle k the information is
    `sum p J J' - sum_k g_k g_k' / (1 / tau^2 + sum_k p)` with `g_k = -sum_k p J`.
    """
    tracks = own.shape[1]
    information, scores = np.zeros((SIZE, SIZE)), np.zeros((tracks, SIZE))
    shared = []
    for family, b in zip(families, own, strict=True):
        p = family.say * (_curvature(family, track, tracks) if curved else family.weight)
        pj, force = p[:, None] * family.jacobian, family.say * family.weight * family.value
        columns = sums(track, np.column_stack([pj, p, force]), tracks)
        g, mass, pull = -columns[:, :SIZE], columns[:, SIZE], columns[:, SIZE + 1]
        variance = 1.0 / (family.shared**-2 + mass)
        gradient = b * family.shared**-2 - pull
        information += family.jacobian.T @ pj - g.T @ (variance[:, None] * g)
        scores += sums(track, force[:, None] * family.jacobian, tracks)
        scores -= g * (variance * gradient)[:, None]
        shared.append((gradient, g, variance))
    return Normal(
        information=information, gradient=scores.sum(axis=0), scores=scores, shared=shared
    )


def _curvature(family: Residuals, track: Integers, tracks: int) -> Floats:
    """Return the curvatures of a family; a vehicle that tells nothing in all counts nothing."""
    mass = np.bincount(track, weights=family.say * family.curvature, minlength=tracks)
    return np.where(mass[track] > 0.0, family.curvature, 0.0)


def sums(track: Integers, rows: Floats, tracks: int) -> Floats:
    """Return the sum of the rows of each track, (tracks, columns)."""
    total = np.zeros((tracks, rows.shape[1]))
    _add(total, track, rows)
    return total


@compiled
def _add(total: Floats, track: Integers, rows: Floats) -> None:  # pragma: no cover - compiled
    for i in range(len(rows)):
        for j in range(rows.shape[1]):
            total[track[i], j] += rows[i, j]


def at_least(information: Floats, floor: Floats) -> Floats:
    """Return an information that in no direction is below a positive definite floor."""
    root = np.linalg.cholesky((floor + floor.T) / 2.0)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ (information + information.T) @ inverse.T / 2.0)
    wide = root @ vectors
    return np.asarray((wide * np.maximum(values, 1.0)) @ wide.T)

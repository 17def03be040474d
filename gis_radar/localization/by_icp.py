"""The method `icp`: the paper's, traces against the surface of the scanned road."""

from __future__ import annotations

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import NoAnswerError
from gis_radar.localization.answer import STAGE, Localization, Site, common
from gis_radar.progress import Reporter
from gis_radar.registration import GUESS_M
from gis_radar.registration.icp import (
    MAST_M,
    VOXEL_M,
    compass_starts,
    register_icp,
    source_voxels,
)
from gis_radar.traces import Moving, voxels

FAR_M = 2.0 * GUESS_M


def by_icp(site: Site, moving: Moving, reporter: Reporter) -> Localization:
    """Lay the traces on the road's surface, as the paper does."""
    reporter.progress(STAGE, 1, 3)
    source = source_voxels(moving)
    local = site.road - [*site.guess[:2], 0.0]
    reach_m = float(np.hypot(source[:, 0], source[:, 1]).max()) + GUESS_M
    local = local[np.hypot(local[:, 0], local[:, 1]) < reach_m]
    if len(local) == 0:
        raise NoAnswerError(f"{site.name}: no road within {reach_m:.0f} m of the guess")
    reporter.progress(STAGE, 2, 3)
    height = site.guess[2] if len(site.guess) == 3 else _mast_top(local)
    starts = compass_starts(np.array([0.0, 0.0, height]), site.heading)
    fit = register_icp(source, voxels(local, VOXEL_M), starts)
    away = float(np.hypot(*fit.state.position[:2]))
    if away > FAR_M:
        raise NoAnswerError(
            f"{site.name}: the registration went {away:.0f} m from the guess", hint="guess closer"
        )
    reporter.progress(STAGE, 3, 3)
    evidence = {**common(moving, "icp"), "fitness": fit.fitness}
    return Localization(
        pose=site.pose(fit.state, evidence),
        fitness=fit.fitness,
        observable=True,
        samples=len(source),
        traces=source,
        range_rate=np.full(len(source), np.nan),
    )


def _mast_top(local: Floats) -> float:
    """Return the height of a usual mast at the local (0, 0)."""
    nearest = np.argsort(np.hypot(local[:, 0], local[:, 1]))[:100]
    return float(np.median(local[nearest, 2])) + MAST_M

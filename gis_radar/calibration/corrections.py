"""The rule by which causes are named: what a cause says is corrected, and then all must fit."""

from __future__ import annotations

from dataclasses import replace

from gis_radar.calibration.excerpt import Excerpt
from gis_radar.calibration.fitted_pose import fit_pose
from gis_radar.calibration.offsets import discrepancy
from gis_radar.calibration.rivals import LaneMap, Rival


def fits_if(excerpt: Excerpt, lanes: LaneMap, mistake: Rival) -> bool:
    """Return whether the traffic fits pose and map once a mistake is corrected.

    A pose that a search found is only a place from which one is to be found: there the traffic must
    fit some pose.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    mistake : Rival
        The mistake.
    """
    if mistake.signless:
        return True  # which sign each range rate had is not known
    fitted = fit_pose(corrected(excerpt, mistake), lanes)
    return fitted is not None and (mistake.searched or discrepancy(fitted)[0] is None)


def corrected(excerpt: Excerpt, mistake: Rival) -> Excerpt:
    """Return an excerpt as it would be without a mistake.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    mistake : Rival
        The mistake.
    """
    points, sign = mistake.points, -1.0 if mistake.against else 1.0
    moving = excerpt.moving
    return replace(
        excerpt, points=points(excerpt.points), range_rate=sign * excerpt.range_rate,
        moving=replace(
            moving, points=points(moving.points), range_rate=sign * moving.range_rate
        ),
        poses=tuple(map(mistake.turned, excerpt.poses)),
    )  # fmt: skip

"""Joint estimate of all vehicles: the posterior of their tracks, and moves that raise it.

Detections are a superposition of Poisson processes, one a vehicle and one of the background (Khan
et al. 2005, Oh et al. 2009: moves of tracks; Meyer and Williams 2021: extended objects).
"""

from __future__ import annotations

from collections.abc import Sequence

from gis_radar.hdmap import LaneGraph
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.posterior.cuts import cut
from gis_radar.tracking.posterior.ends import lengthen, with_undetected_ends
from gis_radar.tracking.posterior.estimate import Posterior
from gis_radar.tracking.posterior.existence import with_existence
from gis_radar.tracking.posterior.neighbours import join_neighbours, split_long
from gis_radar.tracking.posterior.refits import reassociate, refit
from gis_radar.tracking.posterior.sizes import resize

__all__ = ["Posterior", "improve"]


def improve(motions: Sequence[Motion], detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Return vehicles with a higher posterior than those to begin with.

    Moves that raise the posterior are made in turn: change lengths, split long vehicles, merge
    neighbours, cut stretches without support, lengthen tracks along the lanes, associate detections
    anew and smooth motions over them. All are made twice, since what one vehicle loses another one
    gains. At the end lengths, merges and cuts are made once more, tracks are extended where few
    detections are expected, and the probability that each vehicle exists is computed.

    Parameters
    ----------
    motions : sequence of Motion
        The vehicles to begin with.
    detections : MapDetections
        All detections.
    graph : LaneGraph
        The lanes.
    """
    if not motions:
        return []
    posterior = Posterior(detections, motions)
    posterior.learn(_sized_and_cut(posterior, split=True))
    posterior.set_vehicles(lengthen(posterior, graph))
    posterior.motions = reassociate(posterior)
    posterior.set_vehicles(refit(posterior))
    posterior.learn(_sized_and_cut(posterior, split=True))
    posterior.set_vehicles(lengthen(posterior, graph))
    posterior.motions = reassociate(posterior)
    # no splits now: halves of a body that was merged by its motion drive alike, and would stay two
    found = with_undetected_ends(posterior, _sized_and_cut(posterior, split=False), graph)
    return with_existence(posterior, found)


def _sized_and_cut(posterior: Posterior, *, split: bool) -> list[Motion]:
    """Return the vehicles after changing lengths, splitting (if asked), merging and cutting."""
    posterior.set_vehicles(resize(posterior))
    if split:
        posterior.set_vehicles(split_long(posterior))
    posterior.set_vehicles(join_neighbours(posterior))
    return cut(posterior)

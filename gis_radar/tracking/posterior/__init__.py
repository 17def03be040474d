"""Vehicles as one estimate: the probability of all detections, and moves that raise it.

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
from gis_radar.tracking.posterior.refits import reassign, refit
from gis_radar.tracking.posterior.sizes import resize

__all__ = ["Posterior", "improve"]


def improve(motions: Sequence[Motion], detections: MapDetections, graph: LaneGraph) -> list[Motion]:
    """Return vehicles under which the detections are more likely.

    Lengths are chosen, long vehicles split in two and neighbours joined to one, stretches that
    nothing supports cut. Then ends are lengthened along the lanes and motions fitted to the
    detections that are theirs. Twice, since what one vehicle loses another one gains; at the end
    lengths, joins and stretches again, each vehicle is extended while hardly a detection is due,
    and told how likely it exists.

    Parameters
    ----------
    motions : sequence of Motion
        The vehicles to begin with.
    detections : MapDetections
        All of them.
    graph : LaneGraph
        The lanes.
    """
    if not motions:
        return []
    posterior = Posterior(detections, motions)
    posterior.learn(_sized_and_cut(posterior, split=True))
    posterior.place(lengthen(posterior, graph))
    posterior.motions = reassign(posterior)
    posterior.place(refit(posterior))
    posterior.learn(_sized_and_cut(posterior, split=True))
    posterior.place(lengthen(posterior, graph))
    posterior.motions = reassign(posterior)
    # two that were joined by how they drove drive alike since: nothing would join them once more
    found = with_undetected_ends(posterior, _sized_and_cut(posterior, split=False), graph)
    return with_existence(posterior, found)


def _sized_and_cut(posterior: Posterior, *, split: bool) -> list[Motion]:
    posterior.place(resize(posterior))
    if split:
        posterior.place(split_long(posterior))
    posterior.place(join_neighbours(posterior))
    return cut(posterior)

"""Registration: traces laid on lanes and on the scanned road."""

from gis_radar.registration.evidence import Certainty, advantage, certainty
from gis_radar.registration.hypotheses import (
    GUESS_M,
    Hypothesis,
    explore,
    mirrored,
    promise,
    refine,
    rough,
    surveyed,
)
from gis_radar.registration.lanes import Lanes, sample_lanes
from gis_radar.registration.solver import Fit, Prior, solve
from gis_radar.registration.state import State

__all__ = [
    "GUESS_M",
    "Certainty",
    "Fit",
    "Hypothesis",
    "Lanes",
    "Prior",
    "State",
    "advantage",
    "certainty",
    "explore",
    "mirrored",
    "promise",
    "refine",
    "rough",
    "sample_lanes",
    "solve",
    "surveyed",
]

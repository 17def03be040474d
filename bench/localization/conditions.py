"""Conditions: which radar, which drivers and which people, by name.

Places and poses are the same under each, and the demand but where traffic is light.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from places import Manners

from simulation.demand import ALL_KINDS, KINDS, VehicleKind
from simulation.driving import LaneKeeping
from simulation.people import People
from simulation.presets import DRIVERS, RADARS
from simulation.radar import RadarModel

# Localization takes moving detections only: few fixed ones a frame, and as many false ones of
# them as of the 480 that a radar of the paper's kind delivers.
STATIC_PER_FRAME, FALSE_DOPPLER_SHARE = 40.0, 0.0015 * 480.0 / 40.0
TEXTBOOK = "textbook"
_RADARS = {
    **RADARS,
    TEXTBOOK: RadarModel(
        static_per_frame=STATIC_PER_FRAME, false_doppler_share=FALSE_DOPPLER_SHARE
    ),
}
# 48 people of whom a radar sees some at every moment
_PEOPLE = People(walkers=40, cyclists=8)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What a bench simulates with.

    Parameters
    ----------
    radar, drivers : str
        Names of presets; combinations draw theirs themselves where it is ``textbook``.
    people : People
        Who walks and cycles.
    kinds : tuple of VehicleKind
        What drives.
    demand : float
        How much of it, as a share of what a place has.
    """

    radar: str = TEXTBOOK
    drivers: str = TEXTBOOK
    people: People = field(default_factory=People)
    kinds: tuple[VehicleKind, ...] = KINDS
    demand: float = 1.0

    @property
    def model(self) -> RadarModel:
        """The radar."""
        return _RADARS[self.radar]

    @property
    def keeping(self) -> LaneKeeping:
        """Where in their lanes drivers keep."""
        return DRIVERS[self.drivers]

    def manners(self, per_hour: float) -> Manners:
        """Return so many vehicles an hour that drive so."""
        return Manners(
            per_hour=per_hour, kinds=self.kinds, keeping=self.keeping, people=self.people
        )


AS_RECORDED = Conditions(
    radar="as recorded", drivers="as recorded", people=_PEOPLE, kinds=ALL_KINDS
)
_DRIVERS = Conditions(drivers="as recorded", kinds=ALL_KINDS)
CONDITIONS = {
    TEXTBOOK: Conditions(),
    "radar as recorded, walkers": Conditions(radar="as recorded", people=_PEOPLE),
    "drivers as recorded": _DRIVERS,
    "light": replace(_DRIVERS, demand=1.0 / 3.0),
    "as recorded": AS_RECORDED,
    "harsh": replace(AS_RECORDED, radar="harsh"),
}

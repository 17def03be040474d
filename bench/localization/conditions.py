"""Conditions of a simulation by name: radar, drivers, walkers and cyclists, kinds of vehicles.

Streets and poses are the same under all conditions; demand is less under `light` alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from places import TrafficSettings

from simulation.demand import ALL_KINDS, KINDS, VehicleKind
from simulation.driving import LaneKeeping
from simulation.people import People
from simulation.presets import DRIVERS, RADARS
from simulation.radar import RadarModel

# Localization uses moving detections only. So 40 fixed ones a frame do in place of the 480 of the
# textbook's radar, with as many wrong range rates among them (share 0.0015 of 480).
STATIC_PER_FRAME, FALSE_DOPPLER_SHARE = 40.0, 0.0015 * 480.0 / 40.0
TEXTBOOK = "textbook"
_RADARS = {
    **RADARS,
    TEXTBOOK: RadarModel(
        static_per_frame=STATIC_PER_FRAME, false_doppler_share=FALSE_DOPPLER_SHARE
    ),
}
# 48 people: at every moment some are in view of a radar
_PEOPLE = People(walkers=40, cyclists=8)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions of a simulation.

    Parameters
    ----------
    radar, drivers : str
        Names of presets; random places draw their own drivers where it is ``textbook``.
    people : People
        Walkers and cyclists.
    kinds : tuple of VehicleKind
        Kinds of vehicles.
    demand : float
        Demand as a share of a place's usual one.
    """

    radar: str = TEXTBOOK
    drivers: str = TEXTBOOK
    people: People = field(default_factory=People)
    kinds: tuple[VehicleKind, ...] = KINDS
    demand: float = 1.0

    @property
    def model(self) -> RadarModel:
        """Model of the radar."""
        return _RADARS[self.radar]

    @property
    def keeping(self) -> LaneKeeping:
        """How drivers keep their lanes."""
        return DRIVERS[self.drivers]

    def traffic(self, per_hour: float) -> TrafficSettings:
        """Return the settings of traffic of so many vehicles an hour."""
        return TrafficSettings(
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

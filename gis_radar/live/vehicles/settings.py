"""Settings of following vehicles live, with unit and reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gis_radar.tracking.settings import DEFAULTS as OF_RECORDINGS
from gis_radar.tracking.settings import BlockSettings, VehicleSettings


@dataclass(frozen=True, kw_only=True)
class FollowSettings:
    """Constants of following vehicles from what sensors send.

    Parameters
    ----------
    steps, margin_steps : int
        Steps of a block, at whole multiples, and before and after it those that help to know its
        vehicles. In a jam half a minute around it costs a tenth of the occupancy, a minute nothing;
        blocks of five minutes, as of recordings, take two thirds of the time and come late.
    late_s : float
        A block is followed once frames are so far beyond its margin, seconds: sensors do not
        deliver alike.
    silent_s : float
        Once nothing came for so long, what there is is followed, seconds.
    behind_steps : int
        Where following takes longer than the traffic, what is older is left out.
    give_up_s : float
        An hour that cannot be written is tried again for so long, seconds: an outage of a day
        survives, as at the sensors; then its vehicles are dropped, 100 MB of a busy hour.
    now_s, reorder_s : float
        How often the vehicles of now are told, and how long frames wait for those of other
        sensors, seconds.
    sure_hits : int
        A vehicle of now has so many detections: with fewer the filter follows it for a moment only.
    held_s : float
        One that stood when the filter lost it is shown for so long without a block, seconds.
    gone_mps : float
        Who was faster when it was lost has left, m/s.
    same_m : float
        What is nearer to where one stood is the same, metres.
    rcs_kept, judged : int
        Cross sections kept of a vehicle, and vehicles by which walkers are told.
    """

    steps: int = 1200
    margin_steps: int = 1200
    late_s: float = 2.0
    silent_s: float = 30.0
    behind_steps: int = 12_000
    give_up_s: float = 86_400.0
    now_s: float = 0.5
    reorder_s: float = 0.3
    sure_hits: int = 6
    held_s: float = 180.0
    gone_mps: float = 0.7
    same_m: float = 2.5
    rcs_kept: int = 40
    judged: int = 400

    def tracker(self) -> VehicleSettings:
        """Return the settings of the tracker: those of recordings, in these blocks."""
        blocks = BlockSettings(steps=self.steps, margin_steps=self.margin_steps)
        return replace(OF_RECORDINGS, blocks=blocks)


DEFAULTS = FollowSettings()

"""The measures that are compared, and the verdicts on their differences."""

from __future__ import annotations

from typing import NamedTuple

from gis_radar.base import Text

MORE, LESS, NOT_TOLD = "more", "less", "not told"


class Compared(NamedTuple):
    """A measure that is compared.

    Parameters
    ----------
    title : Text
        Name with unit.
    less, more : Text
        Words for a decrease and an increase.
    better : int
        1 where more is better, -1 where less is, 0 where neither.
    resolution : float
        Resolution of the measurement: smaller differences are not told, however significant.
    digits : int
        Digits after the point that are shown.
    """

    title: Text
    less: Text
    more: Text
    better: int
    resolution: float
    digits: int


COMPARED = {
    "volume_veh_h": Compared(
        Text("Volume [veh/h]"), Text("fewer vehicles"), Text("more vehicles"), 0, 1.0, 0
    ),
    "speed_kmh": Compared(
        Text("Mean speed on the lane [km/h]"), Text("slower"), Text("faster"), 0, 0.1, 1
    ),
    "occupancy": Compared(
        Text("Occupancy [0-1]"), Text("less occupied"), Text("more occupied"), -1, 0.001, 3
    ),
    "delay_s": Compared(Text("Delay [s]"), Text("less delay"), Text("more delay"), -1, 0.1, 1),
    "queue_max_m": Compared(
        Text("Longest queue [m]"), Text("shorter queue"), Text("longer queue"), -1, 0.5, 1
    ),
    "queue_mean_m": Compared(
        Text("Mean queue [m]"), Text("shorter queue"), Text("longer queue"), -1, 0.5, 1
    ),
}

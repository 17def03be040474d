"""The evidence of a heat map: in how many steps each tile was occupied and observed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from gis_radar.arrays import Floats, Integers
from gis_radar.clock import STEPS_PER_SECOND, iso_from_step
from gis_radar.heatmap.timeline import Timeline

MOST_COLUMNS = 500
DEFINITIONS = {
    "occupied_s": (
        "seconds in which the tile was occupied: 0.05 s for each step of 50 ms in which at least "
        "one kept detection of any sensor fell in it while it was observed (hit occupancy)"
    ),
    "observed_s": (
        "seconds in which the tile was observed: 0.05 s for each step of 50 ms in which a sensor "
        "that sees the tile's centre delivered a frame; overlapping views count once"
    ),
    "occupancy": "occupied_s / observed_s, 0 to 1; no data where not observed",
}


class Shares(NamedTuple):
    """One value a tile, in the order of the tiles.

    Parameters
    ----------
    occupied_s, observed_s : (n,) float64 arrays
        Seconds; occupied is NaN where not observed, observed is 0 there.
    occupancy : (n,) float64 array
        Their quotient, NaN where not observed.
    """

    occupied_s: Floats
    observed_s: Floats
    occupancy: Floats


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Tally:
    """Steps in which tiles were occupied and observed.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles, by ascending `tile_id`, in the map's coordinate system.
    fingerprint : str
        Theirs.
    sensors : tuple of str
        The sensors that delivered frames.
    whole : Timeline
        The whole time, as one interval: from the first to the last step with a frame.
    timeline : Timeline
        The intervals; `whole` where none were asked for.
    seen : (k,) int64 array
        Positions of the tiles that some view sees.
    group : (k,) int64 array
        For each of them its column in `observed`: tiles that the same views see share one.
    occupied : (intervals, k) uint32 array
        Steps in which a tile was occupied.
    observed : (intervals, groups) int64 array
        Steps in which a group of tiles was observed.
    """

    tiles: gpd.GeoDataFrame
    fingerprint: str
    sensors: tuple[str, ...]
    whole: Timeline
    timeline: Timeline
    seen: Integers
    group: Integers
    occupied: NDArray[np.uint32]
    observed: Integers

    @property
    def crs(self) -> CRS:
        """The map's coordinate system."""
        return CRS.from_user_input(self.tiles.crs)

    @property
    def columns(self) -> range:
        """The intervals that become columns and bands: none where there are too many."""
        if self.timeline is self.whole or len(self.timeline) > MOST_COLUMNS:
            return range(0)
        return range(len(self.timeline))

    def shares(self, interval: int | None = None) -> Shares:
        """Return seconds and occupancy of all tiles.

        Parameters
        ----------
        interval : int, optional
            Which interval; without it, the whole time.
        """
        occupied, observed = self.steps(interval)
        occupied_s = np.full(len(self.tiles), np.nan)
        observed_s = np.zeros(len(self.tiles))
        known = observed > 0
        occupied_s[self.seen[known]] = occupied[known] / STEPS_PER_SECOND
        observed_s[self.seen] = observed / STEPS_PER_SECOND
        share = np.full(len(self.tiles), np.nan)
        share[self.seen[known]] = occupied[known] / observed[known]
        return Shares(occupied_s, observed_s, share)

    def steps(self, interval: int | None = None) -> tuple[Integers, Integers]:
        """Return the steps in which each of the `seen` tiles was occupied and observed."""
        if interval is None:
            occupied = self.occupied.sum(axis=0, dtype=np.int64)
            return occupied, self.observed.sum(axis=0)[self.group]
        return self.occupied[interval].astype(np.int64), self.observed[interval][self.group]

    @property
    def metadata(self) -> dict[str, Any]:
        """What files of a heat map say of the whole, beside their tables."""
        begin, end = (iso_from_step(int(step[0])) for step in (self.whole.begin, self.whole.end))
        return {
            "fingerprint": self.fingerprint,
            "sensors": list(self.sensors),
            "begin": begin,
            "end": end,
            "definitions": DEFINITIONS,
        }

    def figures(self) -> dict[str, Any]:
        """Return a few figures worth a look: the time, and how much was observed and hit."""
        occupied, observed = self.steps()
        begin, end = (iso_from_step(int(step[0])) for step in (self.whole.begin, self.whole.end))
        figures: dict[str, Any] = {
            "begin": begin,
            "end": end,
            "intervals": len(self.timeline),
            "tiles_observed": int(np.count_nonzero(observed)),
            "tiles_hit": int(np.count_nonzero(occupied)),
        }
        if not occupied.any():
            return figures
        share = occupied / np.maximum(observed, 1)
        top = int(share.argmax())
        return figures | {
            "busiest_tile": int(self.tiles["tile_id"].iloc[int(self.seen[top])]),
            "busiest_occupied_s": float(occupied[top] / STEPS_PER_SECOND),
            "busiest_observed_s": float(observed[top] / STEPS_PER_SECOND),
            "busiest_occupancy": float(share[top]),
        }

    def __repr__(self) -> str:
        known = self.figures()
        text = (
            f"{type(self).__name__}({known['begin']} to {known['end']}, "
            f"{known['intervals']} interval(s), {known['tiles_observed']} of "
            f"{len(self.tiles)} tiles observed, {known['tiles_hit']} hit"
        )
        if "busiest_tile" not in known:
            return text + ")"
        return (
            f"{text}; busiest tile {known['busiest_tile']}: {known['busiest_occupied_s']:g} of "
            f"{known['busiest_observed_s']:g} s, {known['busiest_occupancy']:.1%})"
        )

"""Count in how many steps each tile was hit, observed, occupied and visible, by interval.

Intervals of whole quarters of an hour are sums of the dataset's tile counts; finer ones are counted
from its exact tables, an hour at a time.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from gis_radar.base import (
    QUIET,
    STEP_US,
    Booleans,
    Clock,
    Floats,
    InputError,
    Integers,
    Reporter,
    UsageError,
    iso_from_step,
    zone_of,
)
from gis_radar.dataset import Dataset, shifts_of
from gis_radar.hdmap import own_columns
from gis_radar.products.heatmap.intervals import MOST_BANDS, MapLabels, Timeline, When, intervals_at
from gis_radar.products.heatmap.occupancy import (
    OCCUPANCY_DEFINITIONS,
    Occupancy,
    OccupancyShares,
    mean_occupancy,
    occupancy_of,
    shares_of_tiles,
    summed,
)
from gis_radar.products.heatmap.sums import sums_by_interval, sums_of_month

DEFINITIONS = {
    "hit_s": (
        "seconds in which the tile was hit: 0.05 s for each step of 50 ms in which a frame with a "
        "detection in it that counts is valid, while it was observed"
    ),
    "observed_s": (
        "seconds in which the tile was observed: 0.05 s for each step of 50 ms in which a frame of "
        "a sensor that has it in sight is valid; overlapping views count once"
    ),
    "hit_share": "hit_s / observed_s, 0 to 1; no data where not observed",
}

Counts = NDArray[np.uint32]
_NO_LABELS = MapLabels()


class Shares(NamedTuple):
    """Hit share of each tile, in the order of the tiles.

    Parameters
    ----------
    hit_s, observed_s : (n,) float64 arrays
        Seconds; where a tile was not observed, `hit_s` is NaN and `observed_s` 0.
    hit_share : (n,) float64 array
        Their quotient, NaN where not observed.
    """

    hit_s: Floats
    observed_s: Floats
    hit_share: Floats


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Tally:
    """Steps in which tiles were hit and observed.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles, by ascending `tile_id`, in the map's coordinate system.
    fingerprint : str
        Fingerprint of the tiles.
    sensors : tuple of str
        The sensors that delivered frames.
    whole : Timeline
        The whole time, as one interval: from the first to the last step with a frame.
    timeline : Timeline
        The intervals; `whole` where none were asked for.
    seen : (k,) int64 array
        Positions of the tiles that are in sight from some pose.
    hit, observed : (intervals, k) uint32 arrays
        Steps in which these tiles were both hit and observed, and in which they were observed.
    occupancy : Occupancy, optional
        Steps in which they were visible and occupied, where vehicles are known.
    labels : MapLabels
        Labels of pictures and reports.
    """

    tiles: gpd.GeoDataFrame
    fingerprint: str
    sensors: tuple[str, ...]
    whole: Timeline
    timeline: Timeline
    seen: Integers
    hit: Counts
    observed: Counts
    occupancy: Occupancy | None = None
    labels: MapLabels = _NO_LABELS

    @property
    def measure(self) -> str:
        """Measure that maps show: `occupancy` where vehicles are known, else `hit_share`."""
        return "hit_share" if self.occupancy is None else "occupancy"

    @property
    def definitions(self) -> dict[str, str]:
        """Meaning of its columns."""
        return DEFINITIONS | ({} if self.occupancy is None else OCCUPANCY_DEFINITIONS)

    @property
    def crs(self) -> CRS:
        """The map's coordinate system."""
        return CRS.from_user_input(self.tiles.crs)

    @property
    def columns(self) -> range:
        """The intervals that become columns and bands: none where there are too many."""
        if self.timeline is self.whole or len(self.timeline) > MOST_BANDS:
            return range(0)
        return range(len(self.timeline))

    @classmethod
    def count(
        cls, dataset: Dataset, whole: Timeline, timeline: Timeline, *,
        labels: MapLabels | None = None, month: str | None = None,
        reporter: Reporter = QUIET,
    ) -> Self:  # fmt: skip
        """Count the steps in which tiles were hit, observed, occupied and visible.

        Parameters
        ----------
        dataset : Dataset
            The dataset.
        whole, timeline : Timeline
            The whole time, and the intervals.
        labels : MapLabels, optional
            Labels of pictures and reports.
        month : str, optional
            The month that the whole time is, whose roll-up is taken.
        reporter : Reporter
            Receives progress.

        Raises
        ------
        InputError
            If no tile is in sight, or a part of the dataset is damaged.
        """
        tiles = own_tiles(dataset)
        ids = tiles["tile_id"].to_numpy(np.int64)
        seen = positions(ids, np.unique(dataset.sights()["tile_id"].to_numpy(np.int64)))
        if not len(seen):
            raise InputError(
                "no sensor sees any of the tiles", hint="do the poses belong to this place?"
            )
        if month is None:
            sums, whole_sums = sums_by_interval(dataset, ids[seen], whole, timeline, reporter)
        else:
            sums = whole_sums = sums_of_month(dataset, ids[seen], month)
        shifts = None
        if dataset.has_vehicles:
            shifts = shifts_of(dataset.poses(), dataset.sights(), tiles)
        if not sums["hit_steps"].any():
            reporter.warn("no tile was hit while it was observed: the map shows zeros")
        return cls(
            tiles=tiles,
            fingerprint=dataset.manifest.fingerprint,
            sensors=tuple(dataset.sensors),
            whole=whole,
            timeline=timeline,
            seen=seen,
            hit=sums["hit_steps"].astype(np.uint32),
            observed=sums["observed_steps"].astype(np.uint32),
            occupancy=None
            if shifts is None
            else occupancy_of(sums, whole_sums, tiles, seen, shifts),
            labels=labels or _NO_LABELS,
        )

    def chosen(
        self, interval: When = None, *, begin: Any = None, end: Any = None
    ) -> int | slice | None:
        """Return the number of the interval at a time, or the numbers between two times.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            Its number, or a time in it, such as `2025-06-12 07:30`. Times without an offset are by
            the clocks of the site, whose zone the labels name.
        begin, end : str or datetime, optional
            Times between which all intervals are taken, in place of `interval`.

        Raises
        ------
        UsageError
            If there is no such interval.
        """
        return intervals_at(self.timeline, self.zone, interval, begin, end)

    @property
    def zone(self) -> ZoneInfo:
        """The site's time zone."""
        return zone_of(self.labels.timezone)

    @property
    def times(self) -> pd.DatetimeIndex:
        """Begins of the intervals, by the clocks of the site."""
        steps = pd.to_datetime(self.timeline.begin * (STEP_US // 1000), unit="ms", utc=True)
        return steps.tz_convert(self.zone).rename("begin")

    def shares(self, interval: When = None) -> Shares:
        """Return seconds and hit share of all tiles.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            Number of the interval, from 0 or negative from the end, a slice of intervals that are
            taken together, or a time in it, as for :meth:`chosen`; by default the whole time.

        Raises
        ------
        UsageError
            If there is no such interval.
        """
        return Shares(*shares_of_tiles(self.seen, len(self.tiles), *self.steps(interval)))

    def occupancy_shares(self, interval: When = None) -> OccupancyShares | None:
        """Return visible and occupied seconds and occupancy of all tiles, where vehicles are known.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        """
        part = self.chosen(interval)
        if self.occupancy is None:
            return None
        return self.occupancy.shares(self.seen, len(self.tiles), part)

    def shown(self, interval: When = None, measure: str | None = None) -> Floats:
        """Return the measure of all tiles that a map shows, 0 to 1; NaN where it is not known.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        measure : str, optional
            `occupancy` or `hit_share`; without it, :attr:`measure`.

        Raises
        ------
        UsageError
            If it was not counted.
        """
        measure = measure or self.measure
        if measure == "hit_share":
            return self.shares(interval).hit_share
        known = self.occupancy_shares(interval)
        if measure == "occupancy" and known is not None:
            return known.occupancy
        raise UsageError("the heat map has no {}", measure)

    def least_visible_s(self, interval: When = None) -> float:
        """Return the visible time, seconds, below which a tile's occupancy is uncertain."""
        part = self.chosen(interval)
        return 0.0 if self.occupancy is None else self.occupancy.least_visible_s(part)

    def uncertain(self, interval: When = None) -> Booleans:
        """Return for all tiles whether their occupancy is uncertain; maps hatch those.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        """
        known = self.occupancy_shares(interval)
        if known is None:
            return np.zeros(len(self.tiles), np.bool_)
        return known.uncertain(self.least_visible_s(interval))

    def steps(self, interval: When = None) -> tuple[Integers, Integers]:
        """Return the steps in which each of the `seen` tiles was hit and observed."""
        chosen = self.chosen(interval)
        return summed(self.hit, chosen), summed(self.observed, chosen)

    @property
    def whole_iso(self) -> tuple[str, str]:
        """Begin and end of the whole time, ISO 8601, UTC."""
        return iso_from_step(int(self.whole.begin[0])), iso_from_step(int(self.whole.end[0]))

    @property
    def metadata(self) -> dict[str, Any]:
        """Sensors, times and definitions that the files of a heat map carry beside their tables."""
        begin, end = self.whole_iso
        return {
            "fingerprint": self.fingerprint,
            "sensors": list(self.sensors),
            "begin": begin,
            "end": end,
            "definitions": self.definitions,
            "labels": asdict(self.labels),
        }

    def figures(self) -> dict[str, Any]:
        """Return key figures: the time, numbers of tiles observed and hit, mean occupancy."""
        hit, observed = self.steps()
        begin, end = self.whole_iso
        figures: dict[str, Any] = {
            "begin": begin,
            "end": end,
            "intervals": len(self.timeline),
            "tiles_observed": int(np.count_nonzero(observed)),
            "tiles_hit": int(np.count_nonzero(hit)),
        }
        shares = self.occupancy_shares()
        if shares is not None:
            figures["tiles_visible"] = int(np.count_nonzero(shares.visible_s))
            figures["occupied_s"] = float(np.nansum(shares.occupied_s))
            figures["mean_occupancy"], figures["mean_occupancy_se"] = mean_occupancy(
                self.tiles, shares
            )
        return figures

    @property
    def local_span(self) -> dict[str, str]:
        """Begin and end of the whole time by the clocks of the site, and the name of its zone."""
        begin, end = self.whole.span()
        clock = Clock(zone=self.zone, first=begin, last=end)
        return {"begin": clock.iso(begin), "end": clock.iso(end), "timezone": str(self.zone)}

    def __repr__(self) -> str:
        figures, span = self.figures(), self.local_span
        intervals = figures["intervals"]
        text = (
            f"{type(self).__name__}({span['begin']} to {span['end']} ({span['timezone']}), "
            f"{intervals} interval{'s' if intervals != 1 else ''}, "
            f"{figures['tiles_observed']} of {len(self.tiles)} tiles observed, "
        )
        if "tiles_visible" not in figures:
            return f"{text}{figures['tiles_hit']} hit)"
        mean, error = figures["mean_occupancy"], figures["mean_occupancy_se"]
        return (
            f"{text}{figures['tiles_visible']} visible; mean occupancy {mean:.4f}, se {error:.4f})"
        )


def own_tiles(dataset: Dataset) -> gpd.GeoDataFrame:
    """Return the tiles of a dataset by id, with their own columns only."""
    tiles = dataset.tiles().sort_values("tile_id", ignore_index=True)
    return gpd.GeoDataFrame(tiles[[*own_columns(tiles), "geometry"]], crs=tiles.crs)


def positions(tile_ids: Integers, wanted: Integers) -> Integers:
    """Return the position of each wanted tile among the ascending `tile_ids`.

    Raises
    ------
    InputError
        If one is missing.
    """
    position = np.searchsorted(tile_ids, wanted)
    known = position < len(tile_ids)
    known[known] = tile_ids[position[known]] == wanted[known]
    if not known.all():
        raise InputError("the dataset names tile {}, which its tiles lack", wanted[~known][0])
    return position

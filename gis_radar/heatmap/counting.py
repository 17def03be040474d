"""Count in how many steps each tile was observed and occupied, interval by interval.

Occupied(tile, interval) is the number of steps that frames with a hit in the tile cover,
observed(tile, interval) that of the steps that frames of any sensor cover whose view sees the tile:
a union over the sensors, so that overlapping views never count twice (the paper's section
"Global Occupancy Heat Map"). A hit counts only where the tile was observed in that step: a
detection on the corner of a tile whose centre lies outside the view is left out, and occupied
never exceeds observed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.errors import InputError
from gis_radar.heatmap.covering import (
    COVERAGE_DEFINITIONS,
    Coverage,
    CoverageShares,
    count_coverage,
    mean_coverage,
)
from gis_radar.heatmap.intervals import SETTINGS, MapLabels, Timeline, When, intervals_at
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.frame_steps import Runs, common_steps, steps_in, union
from gis_radar.occupancy.hits import Rows
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US, STEPS_PER_SECOND, Clock, iso_from_step, zone_of
from gis_radar.vehicles import Vehicles

DEFINITIONS = {
    "occupied_s": (
        "seconds in which the tile was occupied: 0.05 s for each step of 50 ms that a frame of any "
        "sensor with a kept detection in it covers, while it was observed (hit occupancy)"
    ),
    "observed_s": (
        "seconds in which the tile was observed: 0.05 s for each step of 50 ms that a frame of a "
        "sensor that sees the tile's centre covers; overlapping views count once"
    ),
    "occupancy": "occupied_s / observed_s, 0 to 1; no data where not observed",
}

Counts = NDArray[np.uint32]
LEAST_COUNTED = 0.5  # of hits on tiles that a sensor sees; what does not count is at edges of views
NO_LABELS = MapLabels()


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
    coverage : Coverage, optional
        Steps in which they were visible and covered, where vehicles are known.
    labels : MapLabels
        What stands beside its numbers.
    """

    tiles: gpd.GeoDataFrame
    fingerprint: str
    sensors: tuple[str, ...]
    whole: Timeline
    timeline: Timeline
    seen: Integers
    group: Integers
    occupied: Counts
    observed: Integers
    coverage: Coverage | None = None
    labels: MapLabels = NO_LABELS

    @property
    def measure(self) -> str:
        """What maps of it show: `coverage` where vehicles are known, else `occupancy`."""
        return "occupancy" if self.coverage is None else "coverage"

    @property
    def definitions(self) -> dict[str, str]:
        """What its columns mean."""
        return DEFINITIONS | ({} if self.coverage is None else COVERAGE_DEFINITIONS)

    @property
    def crs(self) -> CRS:
        """The map's coordinate system."""
        return CRS.from_user_input(self.tiles.crs)

    @property
    def columns(self) -> range:
        """The intervals that become columns and bands: none where there are too many."""
        if self.timeline is self.whole or len(self.timeline) > SETTINGS.most_columns:
            return range(0)
        return range(len(self.timeline))

    @classmethod
    def count(
        cls,
        occupancy: Occupancy,
        tiles: gpd.GeoDataFrame,
        whole: Timeline,
        timeline: Timeline,
        *,
        chosen: Integers | None = None,
        vehicles: Vehicles | None = None,
        labels: MapLabels | None = None,
        reporter: Reporter = QUIET,
    ) -> Self:
        """Count the steps in which tiles were observed, and occupied while they were.

        Parameters
        ----------
        occupancy : Occupancy
            Its hits are read once, chunk by chunk.
        tiles : GeoDataFrame
            All of its tiles, from :func:`checked`.
        whole, timeline : Timeline
            The whole time, and the intervals.
        chosen : (k,) int64 array, optional
            Positions of the tiles to count, ascending; without it, all.
        vehicles : Vehicles, optional
            Of the same tiles, sensors, poses and sight; only steps that both hold count.
        labels : MapLabels, optional
            What stands beside its numbers.
        reporter : Reporter
            Where progress goes.

        Raises
        ------
        InputError
            If no view sees any tile, or a view or a hit names a tile that is not there.
        """
        tile_ids = tiles["tile_id"].to_numpy(np.int64)
        seen, group, runs = _observe(occupancy, tile_ids)
        if vehicles is not None:
            both = vehicles.covered_frames()
            runs = tuple(common_steps(each, both) for each in runs)
        if chosen is not None:
            wanted = np.isin(seen, chosen)
            seen, group = seen[wanted], group[wanted]
        column = np.full(len(tile_ids), -1)
        column[seen] = np.arange(len(seen))
        observed, shift = _runs_of_groups(runs, timeline)
        occupied = np.zeros((len(timeline), len(seen)), np.uint32)
        done = found = counted = 0
        outside: list[int] = []
        for step, tile_id in _hits_within(occupancy.held_hits(), timeline, whole, outside):
            place, row = column[positions(tile_ids, tile_id)], timeline.find(step)
            kept = np.flatnonzero((place >= 0) & (row >= 0))
            found += len(kept)
            kept = kept[observed.find(step[kept] + shift[group[place[kept]]]) >= 0]
            np.add.at(occupied.reshape(-1), row[kept] * len(seen) + place[kept], 1)
            counted += len(kept)
            done += len(step)
            reporter.progress("counting hits", done, None)
        found += sum(outside) if vehicles is None else 0
        if chosen is None and (doubt := _doubt(found, counted)):
            reporter.log(doubt, "warning")
        coverage = None
        if vehicles is not None:
            either = steps_in(occupancy.covered_frames())
            steps = common_steps(either, both)
            coverage = count_coverage(vehicles, tiles, seen, timeline, steps, reporter)
        return cls(
            tiles=tiles if chosen is None else tiles.iloc[chosen].reset_index(drop=True),
            fingerprint=occupancy.fingerprint,
            sensors=tuple(sorted(map(str, occupancy.frames["sensor"].unique()))),
            whole=whole,
            timeline=timeline,
            seen=seen if chosen is None else np.searchsorted(chosen, seen),
            group=group,
            occupied=occupied,
            observed=np.stack([timeline.counts(each) for each in runs], axis=1),
            coverage=coverage,
            labels=labels or NO_LABELS,
        )

    def chosen(
        self, interval: When = None, *, begin: Any = None, end: Any = None
    ) -> int | slice | None:
        """Return the number of an interval, or those of several, that are asked for by time.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            Its number, or a time in it, such as `2025-06-12 07:30`. Times without an offset are by
            the clocks of the site, whose zone the labels name.
        begin, end : str or datetime, optional
            In place of one: all between these times.

        Raises
        ------
        UsageError
            If there is none such.
        """
        return intervals_at(self.timeline, self.zone, interval, begin, end)

    @property
    def zone(self) -> ZoneInfo:
        """The site's time zone."""
        return zone_of(self.labels.timezone)

    @property
    def times(self) -> pd.DatetimeIndex:
        """When the intervals begin, by the clocks of the site."""
        steps = pd.to_datetime(self.timeline.begin * (STEP_US // 1000), unit="ms", utc=True)
        return steps.tz_convert(self.zone).rename("begin")

    def shares(self, interval: When = None) -> Shares:
        """Return seconds and occupancy of all tiles.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            Which interval, from 0, negative from the end, or which together, or a time in it, as
            for :meth:`chosen`; without it, the whole time.

        Raises
        ------
        UsageError
            If there is no such interval.
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

    def coverage_shares(self, interval: When = None) -> CoverageShares | None:
        """Return visible and covered seconds and coverage of all tiles, where vehicles are known.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        """
        part = self.chosen(interval)
        if self.coverage is None:
            return None
        return self.coverage.shares(self.seen, len(self.tiles), part)

    def shown(self, interval: When = None) -> Floats:
        """Return for all tiles what maps show: coverage where vehicles are known, else occupancy.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        """
        known = self.coverage_shares(interval)
        return self.shares(interval).occupancy if known is None else known.coverage

    def least_visible_s(self, interval: When = None) -> float:
        """Return the seconds below which a tile was visible for too short to be certain of it."""
        part = self.chosen(interval)
        return 0.0 if self.coverage is None else self.coverage.least_visible_s(part)

    def uncertain(self, interval: When = None) -> Booleans:
        """Return for all tiles whether their coverage is uncertain; maps hatch those.

        Parameters
        ----------
        interval : int, slice, str or datetime, optional
            As for :meth:`shares`.
        """
        known = self.coverage_shares(interval)
        if known is None:
            return np.zeros(len(self.tiles), np.bool_)
        return known.uncertain(self.least_visible_s(interval))

    def steps(self, interval: When = None) -> tuple[Integers, Integers]:
        """Return the steps in which each of the `seen` tiles was occupied and observed."""
        chosen = self.chosen(interval)
        part = slice(None) if chosen is None else chosen
        if isinstance(part, int):
            return self.occupied[part].astype(np.int64), self.observed[part][self.group]
        occupied = self.occupied[part].sum(axis=0, dtype=np.int64)
        return occupied, self.observed[part].sum(axis=0)[self.group]

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
        """Return a few figures worth a look: the time, and how much was observed and hit."""
        occupied, observed = self.steps()
        begin, end = self.whole_iso
        figures: dict[str, Any] = {
            "begin": begin,
            "end": end,
            "intervals": len(self.timeline),
            "tiles_observed": int(np.count_nonzero(observed)),
            "tiles_hit": int(np.count_nonzero(occupied)),
        }
        known = self.coverage_shares()
        if known is not None:
            figures["tiles_visible"] = int(np.count_nonzero(known.visible_s))
            figures["covered_s"] = float(np.nansum(known.covered_s))
            figures["mean_coverage"], figures["mean_coverage_se"] = mean_coverage(self.tiles, known)
        return figures

    @property
    def local_span(self) -> dict[str, str]:
        """Begin and end of the whole time by the clocks of the site, and the name of its zone."""
        begin, end = self.whole.span()
        clock = Clock(zone=self.zone, first=begin, last=end)
        return {"begin": clock.iso(begin), "end": clock.iso(end), "timezone": str(self.zone)}

    def __repr__(self) -> str:
        known, span = self.figures(), self.local_span
        intervals = known["intervals"]
        text = (
            f"{type(self).__name__}({span['begin']} to {span['end']} ({span['timezone']}), "
            f"{intervals} interval{'s' if intervals != 1 else ''}, "
            f"{known['tiles_observed']} of {len(self.tiles)} tiles observed, "
        )
        if "tiles_visible" not in known:
            return f"{text}{known['tiles_hit']} hit)"
        mean, error = known["mean_coverage"], known["mean_coverage_se"]
        return f"{text}{known['tiles_visible']} visible; mean coverage {mean:.4f}, se {error:.4f})"


def _doubt(found: int, counted: int) -> str:
    """Return what to say where hits and observation do not fit each other, or nothing."""
    if found == 0:
        return "no tile was hit while it was observed: the map shows zeros"
    lost = f"{found - counted} of {found} hits are in steps in which no frame observes their tile"
    return f"{lost}, and do not count" if counted < LEAST_COUNTED * found else ""


def _observe(
    occupancy: Occupancy, tile_ids: Integers
) -> tuple[Integers, Integers, tuple[Runs, ...]]:
    """Return the positions of the tiles in view, the group of each, and each group's steps."""
    frames, views = occupancy.covered_frames(), occupancy.views
    if views.empty:
        raise InputError(
            "no sensor sees any of the tiles", hint="do the poses belong to this place?"
        )
    codes, tiles = _view_codes(frames, views)
    position = positions(tile_ids, views["tile_id"].to_numpy(np.int64))
    seen, group, members = _group(position, tiles)
    of_view: dict[Any, Runs] = {code: steps_in(rows) for code, rows in frames.groupby(codes)}
    runs = tuple(union([of_view.get(code, _NO_RUNS) for code in each]) for each in members)
    return seen, group, runs


def positions(tile_ids: Integers, wanted: Integers) -> Integers:
    """Return where each wanted tile stands among the ascending `tile_ids`.

    Raises
    ------
    InputError
        If one is not there.
    """
    position = np.searchsorted(tile_ids, wanted)
    known = position < len(tile_ids)
    known[known] = tile_ids[position[known]] == wanted[known]
    if not known.all():
        raise InputError(f"the occupancy names tile {wanted[~known][0]}, which the tiles lack")
    return position


def _hits_within(
    hits: Iterator[Rows], timeline: Timeline, whole: Timeline, outside: list[int]
) -> Iterator[Rows]:
    """Yield the hits in a span of time, count those beyond all frames; later ones are not read."""
    first, after = int(timeline.begin[0]), int(timeline.end[-1])
    for step, tile in hits:
        begin, end = np.searchsorted(step, [whole.begin[0], whole.end[-1]])
        outside.append(int(len(step) - (end - begin)))
        if len(step) == 0 or step[-1] < first:
            continue
        low, high = np.searchsorted(step, [first, after])
        yield step[low:high], tile[low:high]
        if high < len(step):
            return


def _runs_of_groups(runs: Sequence[Runs], timeline: Timeline) -> tuple[Timeline, Integers]:
    """Return the runs of all groups in one ascending list, and what each group's are shifted by."""
    first, after = int(timeline.begin[0]), int(timeline.end[-1])
    parts = [each.within(first, after - 1) for each in runs]
    shift = np.arange(len(parts)) * (after - first) - first
    shifts = np.repeat(shift, [len(each) for each in parts])
    begin = np.concatenate([each.first for each in parts]) + shifts
    return Timeline(
        begin=begin, end=np.concatenate([each.last for each in parts]) + 1 + shifts
    ), shift


_NO_RUNS = Runs(first=np.empty(0, np.int64), last=np.empty(0, np.int64))


def _view_codes(frames: pd.DataFrame, views: pd.DataFrame) -> tuple[Integers, Integers]:
    """Return a number for the view of each row of `frames` and of each row of `views`."""
    columns = ["sensor", "view"]
    both = pd.concat([frames[columns], views[columns]], ignore_index=True).astype(str)
    codes = np.asarray(both.groupby(columns, sort=False).ngroup(), dtype=np.int64)
    return codes[: len(frames)], codes[len(frames) :]


def _group(position: Integers, code: Integers) -> tuple[Integers, Integers, list[list[int]]]:
    """Group tiles by the set of views that see them.

    Returns
    -------
    seen, group : (k,) int64 arrays
        Position and group of each tile that is seen.
    members : list of lists of int
        The views of each group.
    """
    views = code.max() + 1
    tile, codes = np.divmod(np.unique(position * views + code), views)
    seen, start = np.unique(tile, return_index=True)
    stop = np.append(start[1:], len(tile))
    numbers: dict[bytes, int] = {}
    group = np.array(
        [
            numbers.setdefault(codes[low:high].tobytes(), len(numbers))
            for low, high in zip(start.tolist(), stop.tolist(), strict=True)
        ],
        dtype=np.int64,
    )
    members = [np.frombuffer(text, np.int64).tolist() for text in numbers]
    return seen, group, members

"""Occupancy over tiles and time as a labelled cube for xarray."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import ArrayLike

from gis_radar.arrays import Integers
from gis_radar.crs import name_of
from gis_radar.errors import NOTEBOOKS, InputError, UsageError
from gis_radar.heatmap.counting import (
    DEFINITIONS,
    Observation,
    Tally,
    checked,
    count_hits,
    frame_runs,
    observe,
    positions,
)
from gis_radar.heatmap.intervals import Timeline, intervals_of, intervals_with, moment_of
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.hits import Hits
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US, interval_steps, step_of, zone_of

if TYPE_CHECKING:
    import xarray

MOST_MIB = 1024.0
_BYTES = 3 * 4 + 4  # of a tile and interval: three numbers, and the count they come from
_UNITS = {"occupied_s": "s", "observed_s": "s", "occupancy": "1"}
_OF_TILES = {
    "lanelet_id": ("lanelet of the tile", ""),
    "s_m": ("start of the tile along its lanelet", "m"),
}


def require_xarray() -> Any:
    """Return the module xarray.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import xarray  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError("a Dataset needs xarray, which is missing", hint=NOTEBOOKS) from error
    return xarray


def require_room(tiles: int, intervals: int, most_mib: float) -> None:
    """Refuse a cube that would take more memory than it may, before it is made.

    Raises
    ------
    UsageError
        If it would.
    """
    mib = tiles * intervals * _BYTES / 2**20
    if mib > most_mib:
        raise UsageError(
            f"{tiles} tiles in {intervals} intervals take {mib:.0f} MiB, over {most_mib:g} MiB",
            hint="take a longer interval, fewer tiles (tile_ids), a part of the time (within), "
            "or raise most_mib",
        )


def dataset(tally: Tally, *, most_mib: float = MOST_MIB) -> xarray.Dataset:
    """Return a heat map as a Dataset over (tile, time).

    `occupied_s`, `observed_s` and `occupancy` are float32; where a tile was not observed,
    `observed_s` is 0 and the others are NaN. Coordinates of a tile: `tile_id` (an index, so that
    `sel(tile_id=7)` works), `lanelet_id`, `s_m`, `easting`, `northing` (of its centre, m); of a
    time: `time` and `begin`, `end` (exclusive), datetime64 in UTC.

    Parameters
    ----------
    tally : Tally
        What to show.
    most_mib : float
        The memory that it may take, MiB.

    Raises
    ------
    UsageError
        If it would take more.
    InputError
        If xarray is not installed.
    """
    xr = require_xarray()
    require_room(len(tally.tiles), len(tally.timeline), most_mib)
    about = {name: {"long_name": DEFINITIONS[name], "units": unit} for name, unit in _UNITS.items()}
    values = {
        name: (("tile", "time"), value, about[name]) for name, value in _values(tally).items()
    }
    attributes = {
        "title": "Occupancy of lane tiles",
        "crs": name_of(tally.crs),
        "fingerprint": tally.fingerprint,
        "sensors": ", ".join(tally.sensors),
    }
    cube: xarray.Dataset = xr.Dataset(values, coords=_coordinates(tally), attrs=attributes)
    return cube.set_xindex("tile_id")


def _values(tally: Tally) -> dict[str, Any]:
    """Return the three numbers of all tiles and intervals, float32."""
    shape = (len(tally.tiles), len(tally.timeline))
    values = {name: np.full(shape, np.nan, np.float32) for name in _UNITS}
    for column in range(shape[1]):
        for name, value in tally.shares(column)._asdict().items():
            values[name][:, column] = value
    return values


def _coordinates(tally: Tally) -> dict[str, Any]:
    tiles = tally.tiles
    middle = shapely.get_coordinates(shapely.centroid(tiles.geometry.array))
    begin, end = _utc(tally.timeline.begin), _utc(tally.timeline.end)
    return {
        "tile_id": ("tile", tiles["tile_id"].to_numpy(np.int64)),
        **{
            name: ("tile", tiles[name].to_numpy(), {"long_name": text} | _unit(unit))
            for name, (text, unit) in _OF_TILES.items()
        },
        **{
            name: ("tile", middle[:, axis], {"long_name": name} | _unit("m"))
            for axis, name in enumerate(("easting", "northing"))
        },
        "time": ("time", begin, {"long_name": "begin of the interval, UTC"}),
        "begin": ("time", begin, {"long_name": "begin of the interval, UTC"}),
        "end": ("time", end, {"long_name": "end of the interval, exclusive, UTC"}),
    }


def _unit(unit: str) -> dict[str, str]:
    return {"units": unit} if unit else {}


def _utc(step: Integers) -> Any:
    return (step * (STEP_US // 1000)).astype("datetime64[ms]").astype("datetime64[ns]")


if TYPE_CHECKING:
    import xarray


def to_xarray(
    occupancy: Occupancy,
    tiles: gpd.GeoDataFrame,
    *,
    interval: str,
    within: tuple[str, str] | None = None,
    tile_ids: ArrayLike | None = None,
    timezone: str | None = None,
    most_mib: float = MOST_MIB,
    reporter: Reporter = QUIET,
) -> xarray.Dataset:
    """Return occupancy over (tile, time) as an xarray Dataset.

    The hits are read once, piece by piece: memory is that of the result and of one piece, however
    long the occupancy is. For more than fits, go through the time part by part with `within`.

    Parameters
    ----------
    occupancy : Occupancy
        Hits, frames and views.
    tiles : GeoDataFrame
        All tiles that the occupancy was made with.
    interval : str
        Length of the intervals such as `1min`; `50ms` gives every step.
    within : (begin, end), optional
        ISO 8601 times with their zone; the end is exclusive. Intervals are cut at both.
    tile_ids : array of int, optional
        Which tiles; without it, all.
    timezone : str, optional
        Whose hours and days intervals follow, as for :func:`gis_radar.make_heatmap`.
    most_mib : float
        The memory that the result may take, MiB.
    reporter : Reporter
        Where progress goes.

    Returns
    -------
    xarray.Dataset
        As :meth:`gis_radar.HeatMap.to_xarray` gives.

    Raises
    ------
    UsageError
        If it would take more memory than it may; if `interval`, `within` or `timezone` is none.
    InputError
        If there is no frame in that time, the tiles are not those of the occupancy, a tile is
        not there, or xarray is not installed.
    """
    require_xarray()
    tiles = checked(tiles, occupancy.fingerprint)
    all_ids = tiles["tile_id"].to_numpy(np.int64)
    chosen = _chosen(all_ids, tile_ids)
    runs = frame_runs(occupancy)
    if within is not None:
        first, after = _steps(within)
        runs = runs.within(first, after - 1)
        if len(runs) == 0:
            raise InputError(f"no sensor delivered a frame from {within[0]} to {within[1]}")
    require_room(len(chosen), intervals_with(runs, interval_steps(interval)), most_mib)
    zone = None if timezone is None else zone_of(timezone)
    timeline = intervals_of(runs, interval, zone, len(chosen), QUIET)
    if within is not None:
        timeline = _clipped(timeline, first, after)
    require_room(len(chosen), len(timeline), most_mib)
    first, after = int(timeline.begin[0]), int(timeline.end[-1])
    part = replace(occupancy, hits=lambda: _between(occupancy.hits(), first, after))
    observation = _only(observe(occupancy, all_ids), chosen)
    tally = Tally(
        tiles=tiles.iloc[chosen].reset_index(drop=True),
        fingerprint=occupancy.fingerprint,
        sensors=tuple(occupancy.sensors),
        whole=timeline,
        timeline=timeline,
        seen=np.searchsorted(chosen, observation.seen),
        group=observation.group,
        occupied=count_hits(part, observation, timeline, all_ids, reporter),
        observed=np.stack([timeline.counts(each) for each in observation.runs], axis=1),
    )
    return dataset(tally, most_mib=most_mib)


def _chosen(all_ids: Integers, tile_ids: ArrayLike | None) -> Integers:
    """Return the positions of the chosen tiles, ascending."""
    if tile_ids is None:
        return np.arange(len(all_ids))
    wanted = np.unique(np.asarray(tile_ids, dtype=np.int64))
    if len(wanted) == 0:
        raise UsageError("tile_ids names no tile")
    if unknown := np.setdiff1d(wanted, all_ids).tolist():
        raise InputError(f"tile_ids names tile {unknown[0]}, which the tiles lack")
    return positions(all_ids, wanted)


def _steps(within: tuple[str, str]) -> tuple[int, int]:
    begin, end = (moment_of(str(time), "within") for time in within)
    if not begin < end:
        raise UsageError(f"within goes from {within[0]} to {within[1]}, expected ascending times")
    first, last = step_of(np.array([begin, end - 1e-6])).tolist()
    return first, last + 1


def _clipped(timeline: Timeline, first: int, after: int) -> Timeline:
    return Timeline(begin=np.maximum(timeline.begin, first), end=np.minimum(timeline.end, after))


def _between(hits: Iterator[Hits], first: int, after: int) -> Iterator[Hits]:
    """Yield the hits from step `first` to before `after`; what comes later is not read."""
    for step, tile in hits:
        if len(step) == 0 or step[-1] < first:
            continue
        low, high = np.searchsorted(step, [first, after])
        yield step[low:high], tile[low:high]
        if high < len(step):
            return


def _only(observation: Observation, chosen: Integers) -> Observation:
    kept = np.isin(observation.seen, chosen)
    return Observation(
        seen=observation.seen[kept], group=observation.group[kept], runs=observation.runs
    )

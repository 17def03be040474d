"""Export tracks of vehicles as points, and to MovingPandas, which writes Moving Features."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    INSTALL_TRAJECTORIES,
    STEP_US,
    InputError,
    UsageError,
    interval_steps,
    step_at,
    zone_of,
)
from gis_radar.dataset import Dataset, Span, no_states, states_of
from gis_radar.products.footprints import require_vehicles

if TYPE_CHECKING:
    import movingpandas

EVERY = "500ms"  # at 50 km/h 7 m apart; between them vehicles move smoothly
_OF_VEHICLE = ("length_m", "width_m", "p_heavy")
_FAR = 2**60  # steps, after all times


def track_points(
    dataset: Dataset, *, every: str = EVERY, begin: Any = None, end: Any = None,
    timezone: str = "UTC",
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the states of vehicles as points, a row for each vehicle and moment.

    They are tracks of single vehicles: for analysis, not to be published.

    Parameters
    ----------
    dataset : Dataset
        A dataset with vehicles, from :func:`gis_radar.open_dataset`.
    every : str
        Time between states, such as `500ms`; `50ms` gives every state.
    begin, end : str or datetime, optional
        Times between which states are given; without an offset they are by `timezone`.
    timezone : str
        Time zone of the site, such as Europe/Berlin.

    Returns
    -------
    GeoDataFrame
        By `time` (UTC) and vehicle: `vehicle`, `speed` (m/s), `heading` (degrees counter-clockwise
        from grid east), `lanelet_id`, `s_m`, `d_m`, `seen`, and `length_m`, `width_m`, `p_heavy` of
        the vehicle; the middle of its footprint as geometry, in the map's coordinate system.

    Raises
    ------
    UsageError
        If a time or `every` is invalid, or the times do not ascend.
    """
    require_vehicles(dataset)
    apart, span = interval_steps(every), _span(begin, end, timezone)
    hours = [*states_of(dataset, every=apart, span=span)] or [no_states()]
    table = pd.concat(
        [
            states.join(vehicles.set_index("vehicle")[list(_OF_VEHICLE)], on="vehicle")
            for vehicles, states in hours
        ],
        ignore_index=True,
    )
    time = pd.to_datetime(table["step"].to_numpy(np.int64) * (STEP_US // 1000), unit="ms", utc=True)
    table = table.set_index(pd.DatetimeIndex(time, name="time"))
    shape = gpd.points_from_xy(table["easting"], table["northing"])
    shown = table.drop(columns=["step", "easting", "northing"])
    return gpd.GeoDataFrame(shown, geometry=shape, crs=dataset.crs)


def _span(begin: Any, end: Any, timezone: str) -> Span | None:
    """Return the first and last step between two times, None where neither is given."""
    zone = zone_of(timezone)
    if begin is None and end is None:
        return None
    low = -_FAR if begin is None else step_at(begin, zone, what="begin")
    after = _FAR if end is None else step_at(end, zone, what="end")
    if not low < after:
        raise UsageError("begin and end are {} and {}, expected ascending times", begin, end)
    return low, after - 1


def to_trajectories(dataset: Dataset, **options: Any) -> movingpandas.TrajectoryCollection:
    """Return vehicles as a MovingPandas TrajectoryCollection (extra `trajectories`).

    Times are in UTC without a zone, as MovingPandas keeps them; a vehicle with a single state in
    that time is left out.

    Parameters
    ----------
    dataset : Dataset
        With vehicles, from :func:`gis_radar.open_dataset`.
    **options
        As for :func:`track_points`.

    Raises
    ------
    InputError
        If MovingPandas is not installed, or there is no state in that time.
    """
    try:
        with warnings.catch_warnings():  # of extras of its own, which nobody needs here
            warnings.simplefilter("ignore", UserWarning)
            import movingpandas as mpd  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "trajectories need movingpandas, which is missing", hint=INSTALL_TRAJECTORIES
        ) from error
    points = track_points(dataset, **options)
    if points.empty:
        raise InputError("{}: there is no vehicle in that time", dataset.folder)
    points.index = pd.DatetimeIndex(points.index).tz_localize(None).rename("t")
    return mpd.TrajectoryCollection(points, traj_id_col="vehicle")

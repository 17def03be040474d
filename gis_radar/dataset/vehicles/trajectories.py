"""Single vehicles as points, and as trajectories of MovingPandas: methods of a dataset."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import INSTALL_TRAJECTORIES, STEP_US, InputError, interval_steps
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.vehicles.states import no_states, states_of

if TYPE_CHECKING:
    import movingpandas

EVERY = "500ms"  # at 50 km/h 7 m apart; between them vehicles move smoothly
_OF_VEHICLE = ("length_m", "width_m", "p_heavy")


def track_points(
    dataset: DatasetFiles, *, every: str = EVERY, begin: Moment = None, end: Moment = None
) -> gpd.GeoDataFrame:
    """Return the states of vehicles as points, a row for each vehicle and moment.

    Parameters
    ----------
    every : str
        Time between states, such as `500ms`; `50ms` gives every state.
    begin, end : str, datetime or step, optional
        Times between which states are given; without an offset they are by the clocks of the
        site.

    Returns
    -------
    GeoDataFrame
        By `time` (UTC) and vehicle: `vehicle`, `speed` (m/s), `heading` (degrees
        counter-clockwise from grid east), `lanelet_id`, `s_m`, `d_m`, `seen`, and `length_m`,
        `width_m`, `p_heavy` of the vehicle; the middle of its footprint as geometry, in the
        map's coordinate system.

    Raises
    ------
    UsageError
        If a time or `every` is invalid, or the times do not ascend.
    InputError
        If vehicles were not looked for.
    """
    require_vehicles(dataset)
    hours = [*states_of(dataset, every=interval_steps(every), span=dataset.span(begin, end))]
    table = pd.concat(
        [
            states.join(vehicles.set_index("vehicle")[list(_OF_VEHICLE)], on="vehicle")
            for vehicles, states in hours or [no_states()]
        ],
        ignore_index=True,
    )
    time = pd.to_datetime(table["step"].to_numpy(np.int64) * (STEP_US // 1000), unit="ms", utc=True)
    table = table.set_index(pd.DatetimeIndex(time, name="time"))
    shape = gpd.points_from_xy(table["easting"], table["northing"])
    shown = table.drop(columns=["step", "easting", "northing"])
    return gpd.GeoDataFrame(shown, geometry=shape, crs=dataset.crs)


def to_trajectories(
    dataset: DatasetFiles, *, every: str = EVERY, begin: Moment = None, end: Moment = None
) -> movingpandas.TrajectoryCollection:
    """Return vehicles as a MovingPandas TrajectoryCollection (extra `trajectories`).

    Times are in UTC without a zone, as MovingPandas keeps them; a vehicle with a single state
    in that time is left out.

    Parameters
    ----------
    every, begin, end
        As for :meth:`track_points`.

    Raises
    ------
    InputError
        If MovingPandas is not installed, vehicles were not looked for, or there is no state in
        that time.
    """
    try:
        with warnings.catch_warnings():  # of extras of its own, which nobody needs here
            warnings.simplefilter("ignore", UserWarning)
            import movingpandas as mpd  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError(
            "trajectories need movingpandas, which is missing", hint=INSTALL_TRAJECTORIES
        ) from error
    points = track_points(dataset, every=every, begin=begin, end=end)
    if points.empty:
        raise InputError("{}: there is no vehicle in that time", dataset.folder)
    points.index = pd.DatetimeIndex(points.index).tz_localize(None).rename("t")
    return mpd.TrajectoryCollection(points, traj_id_col="vehicle")

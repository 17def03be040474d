"""States of vehicles at any step, interpolated between those of the tracks; trajectories."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import (
    INSTALL_TRAJECTORIES,
    STEP_US,
    TRACK_EVERY_STEPS,
    Floats,
    InputError,
    Integers,
    interval_steps,
    ranges,
)
from gis_radar.dataset.files.frame_times import recorded_span
from gis_radar.dataset.files.records import Span
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.files.tables import TRACKS, VEHICLES

if TYPE_CHECKING:
    import movingpandas

_CM = 0.01  # metres
VehicleStates = tuple[pd.DataFrame, pd.DataFrame]
"""The vehicles of an hour, and their states."""


def states_of(
    dataset: DatasetFiles, *, every: int = 1, span: Span | None = None
) -> Iterator[VehicleStates]:
    """Yield the vehicles of each hour with their states at regular steps.

    Between the states that are stored, a fifth of a second apart, places, speeds and headings are
    interpolated; lanelet and `seen` are those of the state before.

    Parameters
    ----------
    dataset : Dataset
        A dataset with vehicles.
    every : int
        States are given at the multiples of this number of steps.
    span : (int, int), optional
        First and last step of the states.

    Yields
    ------
    vehicles : DataFrame
        The columns of `vehicles`, by number. A vehicle that is there in several hours keeps its
        first number.
    states : DataFrame
        `vehicle, step, easting, northing` (m, the middle of the footprint), `heading` (degrees),
        `speed` (m/s), `lanelet_id, s_m, d_m` (null off the lanes), `seen`; by step and vehicle.
    """
    # Read one state beyond each end, to interpolate.
    wide = None if span is None else (span[0] - TRACK_EVERY_STEPS, span[1] + TRACK_EVERY_STEPS)
    tables = (dataset.batches(table, wide) for table in (TRACKS, VEHICLES))
    ahead = dict(dataset.continued().astype(np.int64).itertuples(index=False, name=None))
    first = first_numbers(ahead)
    for tracks, vehicles in zip(*tables, strict=True):
        known, states = vehicles.to_pandas(), _states(tracks, dataset.manifest.origin, every, span)
        for table in (known, states):
            table["vehicle"] = table["vehicle"].map(lambda each: first.get(each, each))
        yield (
            known.sort_values("vehicle", ignore_index=True),
            states.sort_values(["step", "vehicle"], ignore_index=True),
        )


def first_numbers(ahead: Mapping[int, int]) -> dict[int, int]:
    """Return, by each later number of a vehicle that is there in several hours, its first number.

    Parameters
    ----------
    ahead : mapping
        By the earlier number the later one, as in `continued`, hours ascending.
    """
    first: dict[int, int] = {}
    for earlier, later in ahead.items():
        first[later] = first.get(earlier, earlier)
    return first


def no_states() -> VehicleStates:
    """Return the tables of :func:`states_of` without rows."""
    return VEHICLES.empty().to_pandas(), _states(TRACKS.empty(), (0, 0), 1, None)


def _states(
    tracks: pa.Table, origin: tuple[int, int], every: int, span: Span | None
) -> pd.DataFrame:
    rows = tracks.to_pandas(types_mapper={pa.int64(): pd.Int64Dtype()}.get)
    vehicle, step = (rows[name].to_numpy(np.int64) for name in ("vehicle", "step"))
    begins = np.flatnonzero(np.diff(vehicle, prepend=-1))
    ends = np.append(begins[1:], len(rows)) - 1 if len(rows) else begins
    first, last = step[begins], step[ends]
    if span is not None:
        first, last = np.maximum(first, span[0]), np.minimum(last, span[1])
    low = -(-first // every)
    count = np.maximum(last // every - low + 1, 0)
    wanted = ranges(low, count) * every
    number = np.repeat(np.arange(len(begins)), count)
    before, share = _rows_and_shares(step, begins, ends, number, wanted)
    after = np.minimum(before + 1, np.repeat(ends, count))
    states = pd.DataFrame({"vehicle": np.repeat(vehicle[begins], count), "step": wanted})
    for name, column, unit, zero in (
        ("easting", "x_cm", _CM, origin[0]), ("northing", "y_cm", _CM, origin[1]),
        ("speed", "speed_cms", _CM, 0),
    ):  # fmt: skip
        values = rows[column].to_numpy(np.float64) * unit + zero
        states[name] = values[before] + share * (values[after] - values[before])
    heading = rows["heading_cdeg"].to_numpy(np.float64) * _CM
    turn = (heading[after] - heading[before] + 180.0) % 360.0 - 180.0
    states["heading"] = (heading[before] + share * turn + 180.0) % 360.0 - 180.0
    lanelet = rows["lanelet_id"]
    same = (lanelet.iloc[before].to_numpy() == lanelet.iloc[after].to_numpy()).astype(np.float64)
    states["lanelet_id"] = lanelet.iloc[before].array
    for name, column in (("s_m", "s_cm"), ("d_m", "d_cm")):
        values = rows[column].to_numpy(np.float64, na_value=np.nan) * _CM
        change = np.nan_to_num(values[after] - values[before])
        states[name] = values[before] + share * np.nan_to_num(same) * change
    states["seen"] = rows["seen"].to_numpy(np.bool_)[before]
    return states


def _rows_and_shares(
    step: Integers, begins: Integers, ends: Integers, number: Integers, wanted: Integers
) -> tuple[Integers, Floats]:
    """Return the row at or before each wanted step, and the step's share of the way to the next."""
    if not len(step):
        return wanted, np.empty(0)
    base, size = int(step.min()), int(step.max() - step.min()) + 1
    of_row = np.repeat(np.arange(len(begins)), ends - begins + 1)
    before = (
        np.searchsorted(of_row * size + step - base, number * size + wanted - base, "right") - 1
    )
    after = np.minimum(before + 1, ends[number])
    gap = np.maximum(step[after] - step[before], 1)
    return before, (wanted - step[before]) / gap


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
        If vehicles were not looked for, or nothing was measured from begin to end.
    """
    require_vehicles(dataset)
    span = recorded_span(dataset, begin, end)
    hours = [*states_of(dataset, every=interval_steps(every), span=span)]
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

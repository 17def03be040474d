"""Single vehicles: their states at any step, trajectories, and footprints that move in QGIS."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import shapely

from gis_radar.base import (
    INSTALL_TRAJECTORIES,
    QUIET,
    STEP_S,
    STEP_US,
    TRACK_EVERY_STEPS,
    Floats,
    InputError,
    Integers,
    Reporter,
    UsageError,
    atomic_write,
    copy_saved_styles,
    interval_steps,
    ranges,
    style_layers,
    write_stream,
)
from gis_radar.dataset.files.frame_times import recorded_span
from gis_radar.dataset.files.records import Span
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.files.tables import TRACKS, VEHICLES
from gis_radar.tracking import HEAVY, Footprints, PathBook, footprints_of

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


FOOTPRINTS = "footprints"
_SCHEMA = pa.schema([
    ("vehicle", pa.int64()),
    ("begin", pa.timestamp("ms", tz="UTC")),
    ("end", pa.timestamp("ms", tz="UTC")),
    ("kind", pa.string()),
    ("state", pa.string()),
    ("speed_kmh", pa.float64()),
    ("heading", pa.float64()),
    ("length_m", pa.float64()),
    ("width_m", pa.float64()),
    ("lanelet_id", pa.int64()),
    ("seen", pa.bool_()),
    ("geometry", pa.binary()),
])  # fmt: skip

# A vehicle has a row at the steps of absolute time that are multiples of this: half a second, in
# which a car at 50 km/h moves 7 m, one and a half of its lengths. All steps would be ten times as
# many rows.
EVERY_STEPS = 10
SHOWN_S = EVERY_STEPS * STEP_S  # how long a row is shown
_STANDING_KMH = 5.0  # a slower vehicle is standing: as traffic engineering counts stops


def write_footprints(dataset: DatasetFiles, path: str | Path, *, reporter: Reporter = QUIET) -> int:
    """Write the footprints of vehicles as a layer, a row for each vehicle and half second.

    Memory holds one hour.

    Parameters
    ----------
    path : str or Path
        The GeoPackage, layer `footprints`; it appears whole or not at all. QGIS loads its style
        by itself, in which its temporal controller moves the vehicles.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`.
    InputError
        If vehicles were not looked for.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: footprints are written as GeoPackage", path, hint="end it in .gpkg")
    require_vehicles(dataset)
    rows = _Rows(dataset, reporter)
    with atomic_write(path) as part:
        write_stream(
            rows, _SCHEMA, part, layer=FOOTPRINTS, geometry_name="geometry",
            geometry_type="Polygon", crs=dataset.crs,
        )  # fmt: skip
        styles = {FOOTPRINTS: footprint_style()}
        style_layers(part, styles, name="vehicles", about="vehicles, moved by the time")
        copy_saved_styles(part, earlier=path)
    return rows.count


def footprint_style() -> str:
    """Return the QGIS style of the layer as QML."""
    return (files(__package__) / "footprints.qml").read_text(encoding="utf-8")


class _Rows:
    """Rows of the layer in batches, made while the tracks are read; iterable once."""

    def __init__(self, dataset: DatasetFiles, reporter: Reporter) -> None:
        self._dataset, self._reporter = dataset, reporter
        self.count = 0

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        hours = len(self._dataset.records())
        book = PathBook()
        every = math.gcd(TRACK_EVERY_STEPS, EVERY_STEPS)  # steps of rows and of paths' points
        states_by_hour = states_of(self._dataset, every=every)
        for done, (table, states) in enumerate(states_by_hour, start=1):
            level_m = np.full(len(states), np.nan)  # shapes need no heights
            prints = footprints_of(states, table, level_m, np.zeros(2), book)
            shown = np.flatnonzero(prints.step % EVERY_STEPS == 0)
            row = np.searchsorted(table["vehicle"], states["vehicle"].iloc[shown])
            self.count += len(shown)
            yield self._batch(
                states.iloc[shown], table.iloc[row], shapely.to_wkb(_shapes(prints, shown))
            )
            self._reporter.progress("writing footprints", done, hours)

    def _batch(
        self, states: pd.DataFrame, vehicles: pd.DataFrame, shapes: np.ndarray
    ) -> pa.RecordBatch:
        begin_ms = states["step"].to_numpy(np.int64) * (STEP_US // 1000)
        end_ms = begin_ms + EVERY_STEPS * (STEP_US // 1000)
        speed_kmh = states["speed"].to_numpy(float) * 3.6
        heavy = vehicles["p_heavy"].to_numpy(float) >= HEAVY
        standing = np.abs(speed_kmh) < _STANDING_KMH
        columns = [
            states["vehicle"].to_numpy(np.int64),
            begin_ms,
            end_ms,
            np.where(heavy, "heavy", "light").astype(object),
            np.where(standing, "standing", "moving").astype(object),
            speed_kmh.round(1),
            states["heading"].to_numpy(float),
            vehicles["length_m"].to_numpy(float),
            vehicles["width_m"].to_numpy(float),
            states["lanelet_id"].astype(object).where(states["lanelet_id"].notna(), None).tolist(),
            states["seen"].to_numpy(np.bool_),
            shapes,
        ]
        arrays = [
            pa.array(column, field.type) for column, field in zip(columns, _SCHEMA, strict=True)
        ]
        return pa.RecordBatch.from_arrays(arrays, schema=_SCHEMA)


def _shapes(prints: Footprints, rows: Integers) -> np.ndarray:
    """Return the polygons of some footprints: from the rear's right corner, counter-clockwise."""
    middle, ahead = prints.boxes[rows, :2], prints.boxes[rows, 2:4]
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along, across = ahead * prints.boxes[rows, 4:5], left * prints.boxes[rows, 5:6]
    corners = [-along - across, along - across, along + across, -along + across]
    shapes = np.asarray(shapely.polygons(middle[:, None] + np.stack(corners, axis=1)))
    for place in np.flatnonzero(prints.path[rows] >= 0):
        shapes[place] = _strip(prints, int(rows[place]))
    return shapes


def _strip(prints: Footprints, row: int) -> Any:
    """Return the strip of a long vehicle along the path that its front took."""
    x, y, ahead_x, ahead_y, half_length, half_width = prints.boxes[row]
    line: list[Floats] = [np.array([x + half_length * ahead_x, y + half_length * ahead_y])]
    backward, left_m, point = (
        np.array([-ahead_x, -ahead_y]),
        2.0 * half_length,
        int(prints.path[row]),
    )
    while left_m > 0.0:
        to_point = prints.points[point] - line[-1]
        whole_m = float(np.hypot(*to_point))
        backward = to_point / whole_m if whole_m > 0.0 else backward
        # before its first point the path is taken as straight
        part_m = left_m if prints.begins[point] else min(whole_m, left_m)
        line.append(line[-1] + part_m * backward)
        if prints.begins[point]:
            break
        left_m, point = left_m - part_m, point - 1
    strip = shapely.LineString(line).buffer(half_width, cap_style="flat", join_style="round")
    return max(shapely.get_parts(strip).tolist(), key=lambda part: part.area)

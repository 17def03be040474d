"""Tracks of vehicles for other programs: MovingPandas, and OGC Moving Features JSON."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
from pyproj import CRS, Transformer

from gis_radar.arrays import Floats
from gis_radar.crs import transformer
from gis_radar.errors import TRAJECTORIES, InputError, UsageError
from gis_radar.files import whole_file
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US, interval_steps, step_at, zone_of
from gis_radar.vehicles.folder import Span, Vehicles
from gis_radar.vehicles.tables import TRACKS

if TYPE_CHECKING:
    import movingpandas

EVERY = "500ms"  # at 50 km/h 7 m apart; between them vehicles move smoothly
_STATE = ("step", "easting", "northing", "speed", "heading")
_OF_VEHICLE = ("length_m", "width_m", "p_heavy")
_FAR = 2**60  # steps, after all times
_DEGREES = 8  # digits after the point: 1 mm
_CRS84 = "urn:ogc:def:crs:OGC:1.3:CRS84"
_ISO_TIME = "urn:ogc:data:time:iso8601"


def track_points(
    vehicles: Vehicles, *, every: str = EVERY, begin: Any = None, end: Any = None,
    timezone: str = "UTC",
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the states of vehicles as points, a row a vehicle and moment.

    They are tracks of single vehicles: for analysis, not to be published.

    Parameters
    ----------
    vehicles : Vehicles
        From :func:`gis_radar.read_vehicles`.
    every : str
        How far apart in time, such as `500ms`; `50ms` gives every state.
    begin, end : str or datetime, optional
        Only what is between these times; without an offset they are by the clocks of `timezone`.
    timezone : str
        The site's, such as Europe/Berlin.

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
    apart, span = interval_steps(every), _span(begin, end, timezone)
    parts = (rows[rows["step"] % apart == 0] for rows in vehicles.tracks(span))
    table = pd.concat([TRACKS.empty(), *(rows for rows in parts if len(rows))])
    about = vehicles.vehicles.set_index("vehicle")[list(_OF_VEHICLE)]
    time = pd.to_datetime(table["step"].to_numpy(np.int64) * (STEP_US // 1000), unit="ms", utc=True)
    table = table.join(about, on="vehicle").set_index(pd.DatetimeIndex(time, name="time"))
    shape = gpd.points_from_xy(table["easting"], table["northing"])
    shown = table.drop(columns=["step", "easting", "northing"])
    return gpd.GeoDataFrame(shown, geometry=shape, crs=vehicles.provenance.map["crs"])


def _span(begin: Any, end: Any, timezone: str) -> Span:
    """Return the first and last step between two times, None where neither is given."""
    zone = zone_of(timezone)
    if begin is None and end is None:
        return None
    low = -_FAR if begin is None else step_at(begin, zone, what="begin")
    after = _FAR if end is None else step_at(end, zone, what="end")
    if not low < after:
        raise UsageError(f"begin and end are {begin} and {end}, expected ascending times")
    return low, after - 1


def to_trajectories(vehicles: Vehicles, **options: Any) -> movingpandas.TrajectoryCollection:
    """Return vehicles as a MovingPandas TrajectoryCollection (extra `trajectories`).

    Times are in UTC without a zone, as MovingPandas keeps them; a vehicle with a single state in
    that time is left out.

    Parameters
    ----------
    vehicles : Vehicles
        From :func:`gis_radar.read_vehicles`.
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
            "trajectories need movingpandas, which is missing", hint=TRAJECTORIES
        ) from error
    points = track_points(vehicles, **options)
    if points.empty:
        raise InputError(f"{vehicles.place}: there is no vehicle in that time")
    points.index = pd.DatetimeIndex(points.index).tz_localize(None).rename("t")
    return mpd.TrajectoryCollection(points, traj_id_col="vehicle")


def write_trajectories(
    vehicles: Vehicles, path: str | Path, *, every: str = EVERY, begin: Any = None,
    end: Any = None, timezone: str = "UTC", reporter: Reporter = QUIET,
) -> int:  # fmt: skip
    """Write tracks as OGC Moving Features JSON (19-045r3): a moving point for each vehicle.

    Places are longitude and latitude, times UTC; vehicles follow each other as they end, and memory
    is that of those on the road at a time. It holds tracks of single vehicles, as their folder
    does: a working file, not to be published.

    Parameters
    ----------
    vehicles : Vehicles
        From :func:`gis_radar.read_vehicles`.
    path : str or Path
        The file, ending in `.json` or `.mfjson`; it appears whole or not at all.
    every, begin, end, timezone
        As for :func:`track_points`.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    int
        How many vehicles were written.

    Raises
    ------
    UsageError
        If the name ends in anything else, a time or `every` is invalid, or the times do not ascend.
    InputError
        If the folder's tables do not fit together.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in {".json", ".mfjson"}:
        raise UsageError(f"{path}: Moving Features are written as JSON", hint="end it in .json")
    apart, span = interval_steps(every), _span(begin, end, timezone)
    about = vehicles.vehicles.set_index("vehicle")
    low, high = span or (-_FAR, _FAR)
    latest = about["last_step"].clip(upper=high) // apart * apart
    total, count = int((latest >= about["first_step"].clip(lower=low)).sum()), 0
    known: dict[int, Any] = dict(
        zip(about.index, about[[*_OF_VEHICLE]].round(3).to_dict("records"), strict=True)
    )
    named = {"crs": _CRS84, "trs": _ISO_TIME}
    head = {key: {"type": "Name", "properties": {"name": name}} for key, name in named.items()}
    to_degrees = transformer(
        CRS.from_user_input(vehicles.provenance.map["crs"]), CRS.from_user_input("OGC:CRS84")
    )
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="\n") as file:
        opening = json.dumps({"type": "FeatureCollection", **head, "features": []})
        file.write(opening.removesuffix("]}"))
        for vehicle, states in _ended(vehicles, apart, span):
            feature = _feature({"vehicle": vehicle} | known[vehicle], states, to_degrees)
            file.write(f"{',' if count else ''}\n{json.dumps(feature, allow_nan=False)}")
            count += 1
            reporter.progress("writing trajectories", count, total)
        file.write("\n]}\n")
    return count


def _ended(vehicles: Vehicles, apart: int, span: Span) -> Iterator[tuple[int, Floats]]:
    """Yield each vehicle with its states (n, 5), `_STATE`, by its last step in the span."""
    table = vehicles.vehicles
    ends = dict(zip(table["vehicle"].tolist(), table["last_step"].tolist(), strict=True))
    waiting: dict[int, list[Floats]] = {}

    def ended_before(step: int) -> Iterator[tuple[int, Floats]]:
        for _, vehicle in sorted((ends[each], each) for each in waiting if ends[each] < step):
            yield vehicle, np.concatenate(waiting.pop(vehicle))

    if span is not None:
        ends = {vehicle: min(end, span[1]) for vehicle, end in ends.items()}
    for rows in vehicles.tracks(span):
        for number, states in _by_vehicle(rows[rows["step"] % apart == 0]):
            if states[-1, 0] > ends.get(number, -_FAR):
                raise InputError(
                    f"{vehicles.place}: the tracks of vehicle {number} go on after its end"
                )
            waiting.setdefault(number, []).append(states)
        if len(rows):
            yield from ended_before(int(rows["step"].max()))
    yield from ended_before(_FAR)


def _by_vehicle(rows: pd.DataFrame) -> Iterator[tuple[int, Floats]]:
    """Yield each vehicle of a piece with its states, by step."""
    order = np.argsort(rows["vehicle"].to_numpy(np.int64), kind="stable")
    numbers, firsts = np.unique(rows["vehicle"].to_numpy(np.int64)[order], return_index=True)
    states = rows[[*_STATE]].to_numpy(np.float64)[order]
    parts = np.split(states, firsts[1:]) if len(rows) else []
    for number, part in zip(numbers.tolist(), parts, strict=True):
        yield number, part.copy()  # a view would keep the whole piece


def _feature(known: dict[str, Any], states: Floats, to_degrees: Transformer) -> dict[str, Any]:
    """Return a vehicle with its states as a feature of Moving Features JSON."""
    step, easting, northing, speed, heading = states.T
    lon, lat = to_degrees.transform(easting, northing)
    moments = (step.astype(np.int64) * (STEP_US // 1000)).astype("datetime64[ms]")
    times = [f"{moment}Z" for moment in moments.astype(str)]
    return {
        "type": "Feature",
        "properties": known,
        "temporalGeometry": {
            "type": "MovingPoint",
            "datetimes": times,
            "coordinates": np.column_stack([lon, lat]).round(_DEGREES).tolist(),
            "interpolation": "Linear",
        },
        "temporalProperties": [
            {
                "datetimes": times,
                "speed": _measure(speed, "m/s"),
                "heading": _measure(heading, "deg"),
            }
        ],
    }


def _measure(values: Floats, unit: str) -> dict[str, Any]:
    shown = values.round(2).tolist()
    return {"type": "Measure", "form": unit, "values": shown, "interpolation": "Linear"}

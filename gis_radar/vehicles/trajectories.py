"""Tracks of vehicles for other programs: MovingPandas, and OGC Moving Features JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
from pyproj import CRS

from gis_radar.crs import transformer
from gis_radar.errors import TRAJECTORIES, InputError, UsageError
from gis_radar.files import whole_file
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US, interval_steps, moment_in, zone_of
from gis_radar.vehicles.folder import Vehicles
from gis_radar.vehicles.tables import TRACKS

if TYPE_CHECKING:
    import movingpandas

EVERY = "500ms"  # at 50 km/h 7 m apart; between them vehicles move smoothly
_OF_VEHICLE = ("length_m", "width_m", "p_heavy")
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
        If a time or `every` is invalid.
    """
    apart, zone = interval_steps(every), zone_of(timezone)
    span = None
    if begin is not None or end is not None:
        low = -(2**60) if begin is None else _step_at(begin, zone, "begin")
        span = low, (2**60 if end is None else _step_at(end, zone, "end")) - 1
    parts = (rows[rows["step"] % apart == 0] for rows in vehicles.tracks(span))
    table = pd.concat([TRACKS.empty(), *(rows for rows in parts if len(rows))])
    about = vehicles.vehicles.set_index("vehicle")[list(_OF_VEHICLE)]
    time = pd.to_datetime(table["step"].to_numpy(np.int64) * (STEP_US // 1000), unit="ms", utc=True)
    table = table.join(about, on="vehicle").set_index(pd.DatetimeIndex(time, name="time"))
    shape = gpd.points_from_xy(table["easting"], table["northing"])
    shown = table.drop(columns=["step", "easting", "northing"])
    return gpd.GeoDataFrame(shown, geometry=shape, crs=vehicles.provenance.map["crs"])


def _step_at(time: Any, zone: Any, what: str) -> int:
    """Return the step that begins at a time, or next after it."""
    return -(round(-moment_in(time, zone, what=what).timestamp() * 1e6) // STEP_US)


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
    vehicles: Vehicles, path: str | Path, *, reporter: Reporter = QUIET, **options: Any
) -> int:
    """Write tracks as OGC Moving Features JSON (19-045r3): a moving point for each vehicle.

    Places are longitude and latitude, times UTC. It holds tracks of single vehicles, as their
    folder does: a working file, not to be published.

    Parameters
    ----------
    vehicles : Vehicles
        From :func:`gis_radar.read_vehicles`.
    path : str or Path
        The file, ending in `.json` or `.mfjson`; it appears whole or not at all.
    reporter : Reporter
        Receives progress.
    **options
        As for :func:`track_points`.

    Returns
    -------
    int
        How many vehicles were written.

    Raises
    ------
    UsageError
        If the name ends in anything else.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in {".json", ".mfjson"}:
        raise UsageError(f"{path}: Moving Features are written as JSON", hint="end it in .json")
    points = track_points(vehicles, **options)
    total, count = points["vehicle"].nunique(), 0
    named = {"crs": _CRS84, "trs": _ISO_TIME}
    head = {key: {"type": "Name", "properties": {"name": name}} for key, name in named.items()}
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="\n") as file:
        opening = json.dumps({"type": "FeatureCollection", **head, "features": []})
        file.write(opening.removesuffix("]}"))
        for feature in _features(points):
            file.write(f"{',' if count else ''}\n{json.dumps(feature, allow_nan=False)}")
            count += 1
            reporter.progress("writing trajectories", count, total)
        file.write("\n]}\n")
    return count


def _features(points: gpd.GeoDataFrame) -> Iterator[dict[str, Any]]:
    """Yield each vehicle as a feature of Moving Features JSON."""
    to_degrees = transformer(CRS.from_user_input(points.crs), CRS.from_user_input("OGC:CRS84"))
    for vehicle, rows in points.groupby("vehicle", sort=True):
        lon, lat = to_degrees.transform(rows.geometry.x.to_numpy(), rows.geometry.y.to_numpy())
        moments = rows.index.tz_convert(None).to_numpy().astype("datetime64[ms]")
        times = [f"{moment}Z" for moment in moments.astype(str)]
        first = rows.iloc[0]
        yield {
            "type": "Feature",
            "properties": {
                "vehicle": int(vehicle),
                **{name: round(float(first[name]), 3) for name in _OF_VEHICLE},
            },
            "temporalGeometry": {
                "type": "MovingPoint",
                "datetimes": times,
                "coordinates": np.column_stack([lon, lat]).round(_DEGREES).tolist(),
                "interpolation": "Linear",
            },
            "temporalProperties": [
                {
                    "datetimes": times,
                    "speed": _measure(rows["speed"], "m/s"),
                    "heading": _measure(rows["heading"], "deg"),
                }
            ],
        }


def _measure(values: pd.Series, unit: str) -> dict[str, Any]:
    shown = values.to_numpy(np.float64).round(2).tolist()
    return {"type": "Measure", "form": unit, "values": shown, "interpolation": "Linear"}

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

from gis_radar.base import (
    INSTALL_TRAJECTORIES,
    QUIET,
    STEP_US,
    Floats,
    InputError,
    Reporter,
    UsageError,
    atomic_write,
    interval_steps,
    step_at,
    transformer,
    zone_of,
)
from gis_radar.dataset import Dataset, Span, no_states, states_of
from gis_radar.products.footprints import require_vehicles

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
    dataset: Dataset, *, every: str = EVERY, begin: Any = None, end: Any = None,
    timezone: str = "UTC",
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the states of vehicles as points, a row a vehicle and moment.

    They are tracks of single vehicles: for analysis, not to be published.

    Parameters
    ----------
    dataset : Dataset
        With vehicles, from :func:`gis_radar.open_dataset`.
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


def write_trajectories(
    dataset: Dataset, path: str | Path, *, every: str = EVERY, begin: Any = None,
    end: Any = None, timezone: str = "UTC", reporter: Reporter = QUIET,
) -> int:  # fmt: skip
    """Write tracks as OGC Moving Features JSON (19-045r3): a moving point for each vehicle.

    Places are longitude and latitude, times UTC; vehicles follow each other as they end in each
    hour, and memory is that of an hour. It holds tracks of single vehicles, as the dataset does: a
    working file, not to be published.

    Parameters
    ----------
    dataset : Dataset
        With vehicles, from :func:`gis_radar.open_dataset`.
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
        If vehicles were not looked for.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in {".json", ".mfjson"}:
        raise UsageError("{}: Moving Features are written as JSON", path, hint="end it in .json")
    require_vehicles(dataset)
    apart, span, count = interval_steps(every), _span(begin, end, timezone), 0
    named = {"crs": _CRS84, "trs": _ISO_TIME}
    head = {key: {"type": "Name", "properties": {"name": name}} for key, name in named.items()}
    to_degrees = transformer(CRS.from_user_input(dataset.crs), CRS.from_user_input("OGC:CRS84"))
    hours, waiting = len(dataset.records(span)), dict[int, tuple[dict[str, Any], Floats]]()
    with atomic_write(path) as part, part.open("w", encoding="utf-8", newline="\n") as file:
        opening = json.dumps({"type": "FeatureCollection", **head, "features": []})
        file.write(opening.removesuffix("]}"))
        for done, hour in enumerate(states_of(dataset, every=apart, span=span), start=1):
            for known, states in _by_vehicle(*hour, waiting, last=done == hours):
                feature = _feature(known, states, to_degrees)
                file.write(f"{',' if count else ''}\n{json.dumps(feature, allow_nan=False)}")
                count += 1
            reporter.progress("writing trajectories", done, hours)
        file.write("\n]}\n")
    return count


def _by_vehicle(
    vehicles: pd.DataFrame, states: pd.DataFrame, waiting: dict[int, tuple[dict[str, Any], Floats]],
    *, last: bool,
) -> Iterator[tuple[dict[str, Any], Floats]]:  # fmt: skip
    """Yield each vehicle that ends in an hour with its states (n, 5), `_STATE`, by its last step.

    Those that go on in the next hour wait for it; in the last hour none does.
    """
    about = vehicles.set_index("vehicle")[[*_OF_VEHICLE]].astype(np.float64).round(3)
    known = dict(zip(about.index.tolist(), about.to_dict("records"), strict=True))
    for number, part in ((int(str(key)), part) for key, part in states.groupby("vehicle")):
        own = {"vehicle": number} | known[number], part[[*_STATE]].to_numpy(np.float64)
        about, before = waiting.get(number, own)
        waiting[number] = about, own[1] if before is own[1] else np.concatenate([before, own[1]])
    going = set() if last else set(vehicles.loc[vehicles["goes_on"], "vehicle"])
    ended = sorted((rows[-1, 0], n) for n, (_, rows) in waiting.items() if n not in going)
    for _, number in ended:
        yield waiting.pop(number)


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

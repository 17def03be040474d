"""Questions over months, methods of a dataset: roll-ups, profiles of streets, a month's map."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from gis_radar.base import (
    Floats,
    Integers,
    Text,
    UsageError,
    current_language,
    in_language,
    street_label,
)
from gis_radar.dataset.days.asked_time import (
    DAY_NAMES,
    QUARTER_S,
    QUARTERS_PER_DAY,
    AskedTime,
    Holidays,
    day_numbers,
    month_edges,
)
from gis_radar.dataset.days.lane_sums import measures_of
from gis_radar.dataset.days.rollups import RollUps, with_month
from gis_radar.dataset.days.tables import QUARTERS
from gis_radar.dataset.files.records import Span, hour_bounds
from gis_radar.dataset.files.schema import TableSchema
from gis_radar.dataset.files.source import (
    DatasetFiles,
    Moment,
    NotMeasuredError,
    require_measured,
    require_vehicles,
)
from gis_radar.dataset.files.tables import LANE_MONTHS, TILE_MONTHS
from gis_radar.dataset.files.units import convert_units
from gis_radar.dataset.traffic.shifts import lanes_beside
from gis_radar.hdmap import LANES_LAYER, TILES_LAYER
from gis_radar.measures import LaneNetwork, lane_directions

By: TypeAlias = Literal["hour", "weekday", "month"]
_OVER_LANES = (  # columns that lanes add to without a weight: they hold the lengths already
    "visible_km_h", "occupied_km_h", "occupied_variance", "vehicle_km", "vehicle_h",
)  # fmt: skip
_SUMMED = (
    "quarters", "visible_s", "counted", "volume", "volume_variance", "heavy", *_OVER_LANES,
)  # fmt: skip
_MOST_LANES = 8  # side by side in one direction


class UnknownStreetError(UsageError):
    """A street on which no lane of a dataset is."""


class StreetLanes(NamedTuple):
    """Lanes of streets, without connectors in junctions.

    Parameters
    ----------
    lane : (n,) int64 array
        Their numbers, ascending.
    direction : (n,) list of str
        Street and direction of each.
    length_m : (n,) array
        Their lengths.
    road_m : (n,) array
        Their parts of the length of the street: where two lanes lie side by side, a half of each.
    """

    lane: Integers
    direction: list[str]
    length_m: Floats
    road_m: Floats

    @classmethod
    def of(
        cls, lanes: gpd.GeoDataFrame, tiles: gpd.GeoDataFrame, network: LaneNetwork,
        street: str | None = None,
    ) -> StreetLanes:  # fmt: skip
        """Return the lanes of a street, or of all.

        Parameters
        ----------
        lanes, tiles : GeoDataFrame
            Layers of a dataset.
        network : LaneNetwork
            Their network.
        street : str, optional
            Name of the street, in small or capital letters.

        Raises
        ------
        UnknownStreetError
            If no lane is on a street of that name.
        """
        direction = np.array(lane_directions(lanes, network), object)
        layer = lanes.set_index("lane").loc[network.lane.tolist()]
        chosen = direction != ""
        if street is not None:
            parts = layer["street_part"] if "street_part" in layer else [None] * len(layer)
            labels = [street_label(*each) for each in zip(layer["street"], parts, strict=True)]
            names = [
                {str(each).casefold() for each in pair}
                for pair in zip(layer["street"], labels, strict=True)
            ]
            chosen &= np.array([street.casefold() in each for each in names])
            if not chosen.any():
                known_names = ", ".join(sorted({*labels} - {""})) or Text("none")
                raise UnknownStreetError(
                    "there is no street {}",
                    repr(street),
                    hint=Text("streets here: {}", known_names),
                )
        road_m = _road_metres(tiles, network, direction)
        rows = np.flatnonzero(chosen)
        return cls(
            network.lane[rows], direction[rows].tolist(), network.length_m[rows], road_m[rows]
        )


def _road_metres(tiles: gpd.GeoDataFrame, network: LaneNetwork, direction: Any) -> Floats:
    """Return the part of each lane in the length of its street: tiles side by side share theirs."""
    ids = tiles["tile_id"].to_numpy(np.int64)
    row_of_tile = np.searchsorted(ids, network.tile_id)
    lane = np.full(len(ids) + 1, -1)
    lane[row_of_tile] = network.tile_lane
    group = np.append(np.unique(direction, return_inverse=True)[1], -1)[lane]
    abreast = np.ones(len(ids))
    for side in lanes_beside(tiles):
        neighbour = np.arange(len(ids))
        for _ in range(_MOST_LANES):
            neighbour = np.append(side, -1)[neighbour]
            neighbour[group[neighbour] != group[:-1]] = -1
            abreast += neighbour >= 0
    metres = network.tile_length_m / abreast[row_of_tile]
    return np.asarray(np.bincount(network.tile_lane, metres, len(network.lane)), np.float64)


def street_profile(
    sums: pd.DataFrame, time: AskedTime, street: StreetLanes, by: By
) -> pd.DataFrame:
    """Return a row for each direction and cell; see :meth:`gis_radar.Dataset.profile`.

    Parameters
    ----------
    sums : DataFrame
        Sums of lanes by `month`, `weekday` and `hour`, with the columns `_SUMMED`.
    time : AskedTime
        The time that they are of.
    street : StreetLanes
        The lanes.
    by : {"hour", "weekday", "month"}
        Whether cells are hours of the day, days of the week or months.
    """
    sums = sums[sums["lane"].isin(street.lane)].groupby(["lane", by])[list(_SUMMED)].sum()
    sums = sums.reset_index()
    row = np.searchsorted(street.lane, sums["lane"].to_numpy(np.int64))
    length, road = street.length_m[row], street.road_m[row]
    of_lanes = sums[["counted", "heavy", *_OVER_LANES]].assign(
        direction=np.array(street.direction, object)[row], cell=sums[by],
        days=sums["quarters"] / (QUARTERS if by == "hour" else QUARTERS_PER_DAY),
        vehicles_m=sums["volume"] * length, hours_m=sums["quarters"] / QUARTERS * road,
        variance=sums["volume_variance"] * length**2, visible_s_m=sums["visible_s"] * road,
    )  # fmt: skip
    asked_s = QUARTER_S * pd.Series(_cells(time, by)).value_counts().sort_index()
    cells = pd.MultiIndex.from_product(
        [sorted(set(street.direction)), asked_s.index], names=["direction", "cell"]
    )
    groups = of_lanes.groupby(["direction", "cell"])
    totals = groups.sum().reindex(cells, fill_value=0.0)
    measures = measures_of({name: totals[name] for name in _OVER_LANES})
    observed = street.road_m * np.isin(street.lane, sums["lane"])
    road_m = pd.Series(observed).groupby(np.array(street.direction, object)).sum()
    s_m = np.multiply.outer(road_m.to_numpy(), asked_s.to_numpy()).ravel()
    profile = pd.DataFrame(
        {
            "volume_veh_h": _quotient(totals["vehicles_m"], totals["hours_m"]),
            "volume_se": _quotient(np.sqrt(totals["variance"]), totals["hours_m"]),
            "heavy_share": _quotient(totals["heavy"], totals["counted"]),
            **{name: measures[name] for name in ("speed_kmh", "occupancy", "occupancy_se")},
            "days": groups["days"].max().reindex(cells, fill_value=0.0),
            "visible_share": (totals["visible_s_m"] / s_m).fillna(0.0),
        }
    ).reset_index()
    if by == "weekday":
        profile["cell"] = [DAY_NAMES[number] for number in profile["cell"]]
    return profile.rename(columns={"cell": by})


def _quotient(part: pd.Series, whole: pd.Series) -> pd.Series:
    return part / whole.where(whole > 0.0)


def _cells(time: AskedTime, by: By) -> Integers | list[str]:
    """Return the cell of each asked quarter."""
    if by == "month":
        return [f"{each // 12}-{each % 12 + 1:02d}" for each in time.month[time.asked].tolist()]
    return (time.hour if by == "hour" else time.weekday)[time.asked]


def lane_months(dataset: DatasetFiles, *, month: str | None = None) -> pd.DataFrame:
    """Read the sums of lane measures by month, weekday and hour, by the clocks of the site.

    Parameters
    ----------
    month : str, optional
        Such as `2026-10`; by default all.

    Returns
    -------
    DataFrame
        `month`, and the columns of the files.
    """
    return _read_months(dataset, LANE_MONTHS, month)


def tile_months(dataset: DatasetFiles, *, month: str | None = None) -> pd.DataFrame:
    """Read the sums of tile counts by month and hour of the day; as :meth:`lane_months`."""
    return _read_months(dataset, TILE_MONTHS, month)


def profile(
    dataset: DatasetFiles, street: str | None = None, *, by: By = "hour", days: str | None = None,
    begin: Moment = None, end: Moment = None, month: str | None = None,
    without: Holidays = None, language: str | None = None,
) -> pd.DataFrame:  # fmt: skip
    """Return the usual traffic of streets by direction: means over the days of a time.

    Parameters
    ----------
    street : str, optional
        Name of a street; by default all.
    by : {"hour", "weekday", "month"}
        A row for each hour of the day, day of the week, or month, by the clocks of the site.
    days : str, optional
        Days of the week that count, such as `Mo-Fr` or `Sa,Su`; by default all.
    begin, end : str, datetime or step, optional
        Times between which quarters of an hour count; by default all that was measured.
    month : str, optional
        A month in place of these, such as `2026-10`.
    without : str, Path or sequence, optional
        Holidays that do not count: dates such as `2026-10-03`, periods such as
        `2026-10-12/2026-10-23` with both their ends, or a CSV file with a column `date`, or
        columns `begin` and `end`.
    language : str, optional
        Language of the directions; by default the current one.

    Returns
    -------
    DataFrame
        `direction` (street and direction, as in names of lanes), the hour, day or month;
        `volume_veh_h` (vehicles an hour over all lanes, mean along the street) with its
        standard error `volume_se`, poses as given; `heavy_share`; `speed_kmh` (space mean);
        `occupancy`, `occupancy_se`; `days` (counted, of the lane counted most; a day of which a
        half was counted is 0.5), `visible_share` (of the time asked for, mean of the lanes that
        were observed). Null where nothing is visible. Junctions are left out.

    Raises
    ------
    UsageError
        If there is no such street, day, date or month, or an end lies within a quarter of an
        hour.
    InputError
        If vehicles were not looked for, nothing was measured in that time, or holidays and days
        of the week leave nothing of it.
    """
    require_vehicles(dataset)
    if by not in get_args(By):
        raise UsageError("by is {}, expected hour, weekday or month", repr(by))
    span, measured = _asked_span(dataset, begin, end, month)
    asked = AskedTime.of(span, dataset.timezone, days, without, measured)
    if not (asked.asked & asked.measured).any():
        raise NotMeasuredError(
            "{}: no day is left of those that were measured", dataset.folder,
            hint="holidays (without) and days of the week leave none",
        )  # fmt: skip
    columns = ["lane", "weekday", "hour", *_SUMMED]
    rolled = roll_ups(dataset)
    lanes = _street_lanes(dataset, rolled, street, language)
    wanted = pa.array(lanes.lane), pa.array(sorted(day_numbers(days)), pa.int32())
    parts = [with_month(LANE_MONTHS.empty().select(columns), "")]
    for each, rows in rolled.sums_of(LANE_MONTHS, asked, columns):
        kept = pc.and_(pc.is_in(rows["lane"], wanted[0]), pc.is_in(rows["weekday"], wanted[1]))
        parts.append(with_month(rows.filter(kept), each))
    return street_profile(pa.concat_tables(parts).to_pandas(), asked, lanes, by)


def _street_lanes(
    dataset: DatasetFiles, rolled: RollUps, street: str | None, language: str | None
) -> StreetLanes:
    """Return the lanes of a street, which are found once."""
    key = ("street", street, language or current_language())
    if key not in dataset.cache:
        layers = dataset.layer(LANES_LAYER), dataset.layer(TILES_LAYER)
        with in_language(language):
            dataset.cache[key] = StreetLanes.of(*layers, rolled.traffic.network, street)
    lanes: StreetLanes = dataset.cache[key]
    return lanes


def _asked_span(
    dataset: DatasetFiles, begin: Moment, end: Moment, month: str | None
) -> tuple[Span, Span]:
    """Return the first and the last step of a time, and of all that was measured.

    An end that is not stated is that of what was measured.
    """
    if month is not None:
        if (begin, end) != (None, None):
            raise UsageError("month and begin, end do not go together", hint="give one of them")
        begin, end = month_edges(month, dataset.timezone)
    span = dataset.span(begin, end)
    require_measured(dataset, span)
    first, last = measured = require_measured(dataset, None)
    if span is not None:
        first = first if begin is None else span[0]
        last = last if end is None else span[1]
    return (first, last), measured


def measured_span(dataset: DatasetFiles, month: str) -> Span:
    """Return the first and the last step of a month in complete hours.

    Raises
    ------
    UsageError
        If it is no month.
    InputError
        If nothing was measured in it.
    """
    span = dataset.span(*month_edges(month, dataset.timezone))
    measured = require_measured(dataset, span)
    return (max(measured[0], span[0]), min(measured[1], span[1])) if span else measured


def roll_ups(dataset: DatasetFiles) -> RollUps:
    """Return the maker and reader of the roll-ups of a dataset."""
    return RollUps(
        folder=dataset.folder, fingerprint=dataset.manifest.fingerprint, timezone=dataset.timezone,
        checked=dataset.cache.setdefault("months", {}),
    )  # fmt: skip


def _read_months(dataset: DatasetFiles, table: TableSchema, month: str | None) -> pd.DataFrame:
    rolled, bounds = roll_ups(dataset), hour_bounds(dataset.folder)
    asked = [] if bounds is None else rolled.months(range(bounds[0], bounds[1] + 1))
    if month is not None:
        month_edges(month, dataset.timezone)  # refuses a text that is no month
        asked = [month]
    parts = [rolled.read(table, each) for each in asked]
    rows = pa.concat_tables([table.empty(), *parts])
    converted = convert_units(rows, dataset.manifest.origin)
    lengths = [len(each) for each in parts]
    converted.insert(0, "month", pd.Series(asked, dtype=object).repeat(lengths).to_list())
    return converted

"""A site's month for the page of its city: its lanes with errors, its profile, what changed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from pyproj import CRS

from gis_radar.base import Floats, InputError, NoAnswerError, metric_crs, transformer
from gis_radar.city.city import RESULTS
from gis_radar.city.month import CityMonth
from gis_radar.city.odd_times import OddTime, odd_times
from gis_radar.dataset import Dataset, LaneTraffic, TrafficReader
from gis_radar.hdmap import LANES_LAYER
from gis_radar.measures import LaneNetwork
from gis_radar.products import PAGE, compare, read_run, service_levels

_LEAST_DAYS = 3  # of the error of a mean over days
_QUARTERS_PER_HOUR = 4
_WEEKEND = 5  # Saturday, Monday as 0
_GEOGRAPHIC = CRS.from_epsg(4326)


@dataclass(frozen=True, kw_only=True, eq=False)
class SiteMonth:
    """A site's month.

    Parameters
    ----------
    name, title : str
        Its name in the city, and that of its site file, else the same.
    link : str
        Its report, from the folder of the page; empty where there is none.
    lines : sequence of (n, 2) arrays
        Its lanes, degrees east and north.
    hours : int
        Complete hours in the month.
    lanes : DataFrame or None
        Its lanes over the month, from :meth:`gis_radar.Dataset.traffic`, with `delay_se`,
        `queue_se` (from day to day), `worst_hour` and `worst_delay_s`, `level`, `length_m`,
        `is_inside` (a turn in the junction) and `is_entry` (where the site's vehicles are
        counted, once each); None where nothing is known.
    profile : DataFrame or None
        By `is_weekend` and `hour` of the site's clocks: `volume` and `volume_se` of an hour over
        all entries; null where one is not known.
    changes : DataFrame or None
        Against the month before, as :attr:`gis_radar.products.Comparison.table`; None where
        nothing compares.
    not_alike : int
        Lanes that were not seen alike in both months.
    odd_times : sequence of OddTime
        Hours in which far more time was lost than usual.
    remark : str
        What its dataset states of hours that were not measured; empty where all were.
    """

    name: str
    title: str
    link: str
    lines: Sequence[Floats]
    hours: int
    lanes: pd.DataFrame | None = None
    profile: pd.DataFrame | None = None
    changes: pd.DataFrame | None = None
    not_alike: int = 0
    odd_times: Sequence[OddTime] = ()
    remark: str = ""

    @property
    def place(self) -> Floats:
        """Middle of the site, degrees east and north."""
        return np.asarray(np.concatenate(self.lines).mean(axis=0), np.float64)

    @property
    def occupancy(self) -> tuple[float, float]:
        """Mean occupancy of its lanes by the time and length visible, and the standard error."""
        return (np.nan, np.nan) if self.lanes is None else occupancy_of_lanes(self.lanes)

    @property
    def volume(self) -> tuple[float, float]:
        """Vehicles an hour over the time with data at all known entries, and standard error."""
        if self.lanes is None:
            return np.nan, np.nan
        known = self.lanes[self.lanes["is_entry"]].dropna(subset=["volume_veh_h"])
        if known.empty:
            return np.nan, np.nan
        hours = known["volume"] / known["volume_veh_h"].where(known["volume"] > 0.0)
        error = (known["volume_se"] / hours.fillna(hours.median())).to_numpy(np.float64)
        return float(known["volume_veh_h"].sum()), float(np.sqrt(np.nansum(error**2)))

    def day_volume(self, *, is_weekend: bool) -> tuple[float, float]:
        """Vehicles a day, and the standard error; NaN where an hour of the day is not known."""
        if self.profile is None:
            return np.nan, np.nan
        mine = self.profile[self.profile["is_weekend"] == is_weekend]
        if mine["volume"].notna().sum() < 24:
            return np.nan, np.nan
        return float(mine["volume"].sum()), float(np.sqrt((mine["volume_se"] ** 2).sum()))


def occupancy_of_lanes(lanes: pd.DataFrame) -> tuple[float, float]:
    """Return the mean occupancy of lanes by the time and length visible, and its error."""
    known = lanes.dropna(subset=["occupancy"])
    weight = (known["length_m"] * known["visible_share"]).to_numpy(np.float64)
    if not weight.sum() > 0.0:
        return np.nan, np.nan
    share, error = (known[n].to_numpy(np.float64) for n in ("occupancy", "occupancy_se"))
    mean = float((weight * share).sum() / weight.sum())
    return mean, float(np.sqrt(np.nansum((weight * error) ** 2)) / weight.sum())


def site_month(month: CityMonth, name: str, folder: Path) -> SiteMonth:
    """Gather a site's month.

    Parameters
    ----------
    month : CityMonth
        The month.
    name : str
        The site.
    folder : Path
        Where the page goes, from which its links lead.
    """
    opened, place = month.city.sites[name], month.city.root / RESULTS / name
    # The layers that it reads go with it: those of hundreds of sites would fill the memory.
    dataset = Dataset(folder=opened.folder, manifest=opened.manifest)
    site = read_run(place).get("site") or {}
    fields: dict[str, Any] = {
        "name": name, "title": str(site.get("title") or name), "lines": _lane_lines(dataset),
        "link": _link(place / PAGE, folder), "hours": len(month.hours[name].get(month.month, [])),
        "remark": dataset.manifest.not_measured,
    }  # fmt: skip
    if not (dataset.has_vehicles and month.has_data(name)):
        return SiteMonth(**fields)
    network = LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint).network
    lanes = _lanes(dataset, month, network)
    if lanes.empty:
        return SiteMonth(**fields)
    sums = dataset.lane_months(month=month.month)
    lanes = lanes.join(worst_hours(sums), on="lane")
    changes, not_alike = _changes(dataset, name, month)
    return SiteMonth(
        **fields, lanes=lanes, profile=_profile(sums, lanes), changes=changes,
        not_alike=not_alike, odd_times=odd_times(dataset, month.span(dataset)),
    )  # fmt: skip


def _link(page: Path, folder: Path) -> str:
    if not page.is_file():
        return ""
    try:
        return Path(os.path.relpath(page, folder)).as_posix()
    except ValueError:  # on another drive
        return page.resolve().as_uri()


def _lane_lines(dataset: Dataset) -> list[Floats]:
    """Return the lanes, degrees; of datasets without lanes the tiles' box."""
    if dataset.has_vehicles:
        lines = list(dataset.layer(LANES_LAYER).geometry)
    else:
        lines = [shapely.box(*dataset.tiles().total_bounds).exterior]
    there = transformer(metric_crs(dataset.crs, what="CRS of a dataset"), _GEOGRAPHIC)
    return [np.column_stack(there.transform(*shapely.get_coordinates(each).T)) for each in lines]


def _lanes(dataset: Dataset, month: CityMonth, network: LaneNetwork) -> pd.DataFrame:
    """Return the lanes over the month, with the errors of delays and queues from day to day."""
    reader = TrafficReader(dataset=dataset, span=month.span(dataset))
    lanes = replace(reader, whole=True).lanes()
    days = replace(reader, interval="24h").lanes().groupby("lane")
    at = np.searchsorted(network.lane, lanes["lane"].to_numpy(np.int64))
    is_first = np.array([not each for each in network.before], np.bool_)
    entry = network.has_stop_line if network.has_stop_line.any() else is_first
    found: gpd.GeoDataFrame = lanes.assign(
        level=service_levels(lanes, "hcm"), length_m=network.length_m[at],
        is_inside=network.connector[at], is_entry=entry[at],
        **{name: lanes["lane"].map(_error_over_days(days[of]))
           for name, of in (("delay_se", "delay_s"), ("queue_se", "queue_mean_m"))},
    )  # fmt: skip
    return pd.DataFrame(found.drop(columns="geometry"))


def _error_over_days(days: Any) -> pd.Series:
    """Return the standard error of a mean over days, by lane; null of too few."""
    count = days.count()
    error: pd.Series = (days.std() / np.sqrt(count)).where(count >= _LEAST_DAYS)
    return error


def _profile(sums: pd.DataFrame, lanes: pd.DataFrame) -> pd.DataFrame:
    """Return the mean volume of an hour at all entries, by weekdays and weekends and by hour.

    Weekdays that are seen more often count no more than others.
    """
    entries = lanes.loc[lanes["is_entry"] & lanes["volume"].notna(), "lane"]
    known = sums[sums["lane"].isin(entries) & (sums["quarters"] > 0)]
    hours = known["quarters"] / _QUARTERS_PER_HOUR
    known = known.assign(
        is_weekend=known["weekday"] >= _WEEKEND, volume=known["volume"] / hours,
        variance=known["volume_variance"] / hours**2,
    )  # fmt: skip
    by_lane = known.groupby(["is_weekend", "hour", "lane"]).agg(
        volume=("volume", "mean"), variance=("variance", "sum"), days=("volume", "size")
    )
    by_lane["variance"] /= by_lane["days"] ** 2
    groups = by_lane.groupby(level=[0, 1])
    profile = groups[["volume", "variance"]].sum().assign(known=groups.size() == len(entries))
    index = pd.MultiIndex.from_product([[False, True], range(24)], names=["is_weekend", "hour"])
    profile = profile[profile["known"]].reindex(index)
    return profile.assign(volume_se=np.sqrt(profile["variance"].astype(np.float64))).reset_index()


def worst_hours(sums: pd.DataFrame) -> pd.DataFrame:
    """Return by lane the hour of Monday to Friday in which most time is lost, and its mean delay.

    Parameters
    ----------
    sums : pd.DataFrame
        A row a lane, day of the week and hour of the day, as of `Dataset.lane_months`.

    Returns
    -------
    pd.DataFrame
        `worst_hour`, and `worst_delay_s` a vehicle, by `lane`; none of lanes without delay.
    """
    week = (
        sums[sums["weekday"] < _WEEKEND]
        .groupby(["lane", "hour"], as_index=False)[["delay_h", "volume", "quarters"]]
        .sum()
    )
    week = week[week["delay_h"] > 0.0]
    # Not the longest delay: a few vehicles at night may wait longest.
    most = week.loc[(week["delay_h"] / week["quarters"]).groupby(week["lane"]).idxmax()]
    delay_s = most["delay_h"] / most["volume"] * 3600.0
    most = most.assign(worst_delay_s=delay_s).set_index("lane")
    return most[["hour", "worst_delay_s"]].rename(columns={"hour": "worst_hour"})


def _changes(dataset: Dataset, name: str, month: CityMonth) -> tuple[pd.DataFrame | None, int]:
    """Compare with the month before what the same sensors saw alike in both."""
    if not month.before.has_data(name):
        return None, 0
    try:
        comparison = compare(dataset, before=month.before.period, after=month.period)
    except (InputError, NoAnswerError):  # of other methods, or nothing was seen alike
        return None, 0
    table = pd.DataFrame(comparison.table.drop(columns="geometry")).assign(site=name)
    return table, len(comparison.left_out)

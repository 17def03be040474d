"""Hours of a site's month in which far more time was lost than is usual at that time of the day."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.base import STEP_US, zone_of
from gis_radar.dataset import Dataset, LaneTraffic
from gis_radar.hdmap import LANES_LAYER

_MEASURES = LaneTraffic.tables[0]
_COLUMNS = ("lane", "density", "flow", "first_step")
_HOUR = pd.Timedelta(hours=1)
_LEAST_DAYS = 4  # with an hour of the day: what is usual is not known from fewer
# What an odd hour is beyond the usual, at least; hours beside it belong to it from half of that.
_LEAST_LOST_H = 1.0  # vehicle hours
_LEAST_SHARE = 0.5  # of the usual
_SPREADS = 6.0  # standard deviations of such hours
_SIGMA_OF_MAD = 1.4826  # of Gaussian numbers, by their median absolute deviation
_WEEKEND = 5  # Saturday, Monday as 0


class OddTime(NamedTuple):
    """Hours, one after the other, in which far more time was lost than usual.

    Parameters
    ----------
    begin, end : Timestamp
        By the clocks of the site.
    lost_h, usual_h : float
        Vehicle hours lost on the visible lanes, and the median of such hours in the month.
    lane : int
        The lane on which most was lost beyond the usual.
    """

    begin: pd.Timestamp
    end: pd.Timestamp
    lost_h: float
    usual_h: float
    lane: int

    @property
    def beyond_h(self) -> float:
        """Vehicle hours beyond the usual."""
        return self.lost_h - self.usual_h


def odd_times(dataset: Dataset, span: tuple[int, int]) -> list[OddTime]:
    """Return the hours of a month in which far more time was lost than usual, in their order.

    Parameters
    ----------
    dataset : Dataset
        The dataset, with vehicles.
    span : (int, int)
        First and last step of the month.
    """
    return odd_times_of(_lost_by_lane(dataset, span))


def odd_times_of(lost: pd.DataFrame) -> list[OddTime]:
    """Return the hours in which far more was lost than usual.

    Usual is the median over Mondays to Fridays, or over weekends, at that hour of the day.

    Parameters
    ----------
    lost : DataFrame
        Vehicle hours lost: a row an hour, by its begin at the clocks of the site, and a column a
        lane; null where a lane was not visible.
    """
    usual_of_lane, _ = _usual(lost)
    total = lost.sum(axis=1).to_frame()
    usual, spread = (each[0] for each in _usual(total))
    least = np.maximum(np.maximum(_LEAST_LOST_H, _LEAST_SHARE * usual), _SPREADS * spread)
    beyond = total[0] - usual
    is_raised = (beyond > 0.5 * least).to_numpy(np.bool_)
    hours = pd.DatetimeIndex(lost.index[is_raised])
    is_odd = (beyond > least).to_numpy(np.bool_)[is_raised]
    run = np.cumsum(np.diff(hours.to_numpy(), prepend=hours[:1].to_numpy()) != _HOUR)
    found = []
    for number in np.unique(run[is_odd]):
        mine = hours[run == number]
        by_lane = (lost.loc[mine] - usual_of_lane.loc[mine]).sum()
        found.append(
            OddTime(
                begin=mine[0], end=mine[-1] + _HOUR, lost_h=float(total.loc[mine, 0].sum()),
                usual_h=float(usual[mine].sum()), lane=int(by_lane.idxmax()),
            )
        )  # fmt: skip
    return found


def _lost_by_lane(dataset: Dataset, span: tuple[int, int]) -> pd.DataFrame:
    """Return the vehicle hours lost against the free speed, a row an hour and a column a lane.

    Lanes without a free speed, by the map or as stated, are left out. The hours follow from
    densities, so that vehicles count that wait and never reach a stop line.
    """
    traffic = LaneTraffic.of(dataset)
    parts = traffic.read(_MEASURES, dataset.records(span), span, _COLUMNS)
    rows = pa.concat_tables(parts).to_pandas()
    layer = dataset.layer(LANES_LAYER).set_index("lane")
    free_kmh = rows["lane"].map(layer["speed_limit_kmh"].astype(np.float64))
    length = pd.Series(traffic.network.length_m / 1000.0, traffic.network.lane)
    lost = (rows["density"] - rows["flow"] / free_kmh).clip(lower=0.0) * rows["lane"].map(length)
    begin = pd.to_datetime(rows["first_step"] * STEP_US, unit="us", utc=True)
    by_hour = rows.assign(lost=lost, hour=begin.dt.floor("h")).dropna(subset=["lost"])
    table: pd.DataFrame = by_hour.pivot_table("lost", "hour", "lane")
    return table.tz_convert(zone_of(dataset.timezone))


def _usual(table: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return median and spread of each column over hours alike, for each row of a table."""
    begin = pd.DatetimeIndex(table.index)
    kinds = [begin.day_of_week >= _WEEKEND, begin.hour]
    groups = table.groupby(kinds)
    median = groups.transform("median").where(groups.transform("count") >= _LEAST_DAYS)
    spread = (table - median).abs().groupby(kinds).transform("median") * _SIGMA_OF_MAD
    return median, spread

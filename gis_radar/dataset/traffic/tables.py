"""Traffic of a dataset by lane, turn and queue: methods of :class:`gis_radar.Dataset`."""

from __future__ import annotations

import geopandas as gpd

from gis_radar.base import UsageError
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.traffic.headways_cycles import add_headways
from gis_radar.dataset.traffic.reader import TrafficReader


def traffic(
    dataset: DatasetFiles, interval: str = "15min", *, begin: Moment = None, end: Moment = None,
    language: str | None = None, whole: bool = False, headways: bool = False,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the traffic of lanes, a row for each lane and interval.

    Parameters
    ----------
    interval : str
        Length of the intervals, such as `15min` or `1h`: a multiple of 15 min that divides a
        day, or a divisor of 15 min from 1 min on. Intervals follow the clocks of the site.
    begin, end : str, datetime or step, optional
        Times between which the intervals begin.
    language : str, optional
        Language of the lanes' names, `en` or `de`; by default the current one, else English.
    whole : bool
        One row a lane, of all intervals together that were measured: from the begin of the
        first to the end of the last, `volume` without the time between. Intervals count by the
        share of them that was visible, so that those in which a recording begins or ends count
        less. They are of 15 min, or of `interval` where that is less: give `1min` for a recording
        of some minutes, as a volume is null where under a fifth of these intervals was visible.
    headways : bool
        Add headways and gaps, which are measured from exact tables.

    Returns
    -------
    GeoDataFrame
        By lane and time: `lane` (its number), `name`; `begin`, `end` in the site's zone;
        `visible_share`, `counted`, `volume` (vehicles in the interval), `volume_se`,
        `volume_veh_h`, `heavy`; `speed_kmh` (space mean), `speed_time_mean_kmh`,
        `speed_85_kmh`; `occupancy`, `occupancy_se`, `density_veh_km`, `flow_veh_h`,
        `travel_time_s`, `delay_s`, `queue_max_m`, `queue_mean_m`, `sight_m`, `stops`; the
        lane's line. Null where nothing is visible. Lanes that no sensor observes have no rows.
        With headways `headways` (number of pairs of consecutive vehicles at the counting line,
        between which it was visible throughout), `headway_mean_s` (front to front),
        `headway_se_s`, `headway_median_s`, `gap_mean_s` (rear to front), `gap_se_s`. Null where
        the line was not visible, means without a pair, errors with less than two.

    Raises
    ------
    UsageError
        If there is no such interval, or headways are asked of the whole time.
    InputError
        If vehicles were not looked for, or the interval is under 15 min, or headways are asked,
        and exact tables were deleted.
    """
    if headways and whole:
        raise UsageError("headways are of intervals, not of the whole time")
    lanes = _reader(dataset, interval, begin, end, language, whole=whole).lanes()
    return add_headways(dataset, lanes, interval, dataset.span(begin, end)) if headways else lanes


def turns(
    dataset: DatasetFiles, interval: str = "15min", *, begin: Moment = None, end: Moment = None,
    language: str | None = None, whole: bool = False,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the volumes of turns, a row for each turn and interval; as :meth:`traffic`.

    Returns
    -------
    GeoDataFrame
        `from_lane`, `to_lane`, `from_name`, `to_name`, `turn` (`left`, `straight`, `right` or
        `back`), `begin`, `end`, `visible_share`, `volume`, `volume_se`, `volume_veh_h`; the way
        from the stop line to the exit.
    """
    return _reader(dataset, interval, begin, end, language, whole=whole).turns()


def queues(
    dataset: DatasetFiles, interval: str = "15min", *, begin: Moment = None, end: Moment = None,
    language: str | None = None,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the queues at stop lines: rows of :meth:`traffic` in which a stop line is visible.

    There are none where the map has no stop lines.

    Returns
    -------
    GeoDataFrame
        `lane`, `name`, `begin`, `end`, `visible_share`, `queue_max_m`, `queue_mean_m`,
        `sight_m` (how far before the stop line the lane is in sight: a queue that reaches as
        far may be longer), `stops`, `delay_s`; the lane's line.
    """
    lanes = _reader(dataset, interval, begin, end, language).lanes()
    lanes = lanes[lanes["queue_max_m"].notna()].reset_index(drop=True)
    return lanes[
        ["lane", "name", "begin", "end", "visible_share", "queue_max_m", "queue_mean_m",
         "sight_m", "stops", "delay_s", "geometry"]
    ]  # fmt: skip


def _reader(
    dataset: DatasetFiles, interval: str, begin: Moment, end: Moment, language: str | None, *,
    whole: bool = False,
) -> TrafficReader:  # fmt: skip
    require_vehicles(dataset)
    return TrafficReader(
        dataset=dataset, interval=interval, span=dataset.span(begin, end), language=language,
        whole=whole,
    )  # fmt: skip

"""Traffic of a dataset by lane, turn and queue: methods of :class:`gis_radar.Dataset`."""

from __future__ import annotations

import geopandas as gpd
import numpy as np

from gis_radar.base import STEP_S, UsageError, interval_steps
from gis_radar.dataset.days.tables import STEPS_PER_QUARTER
from gis_radar.dataset.files.frame_times import recorded_span, recording_steps
from gis_radar.dataset.files.source import DatasetFiles, Moment, require_vehicles
from gis_radar.dataset.traffic.headways_cycles import add_headways
from gis_radar.dataset.traffic.reader import TrafficReader

_USUAL = "15min"
# Lengths of intervals, each with the longest time (s) that it is used for: some 30 of a recording,
# then 96 a day.
_INTERVALS = (("1min", 1800.0), ("5min", 10_800.0), (_USUAL, np.inf))


def suited_interval(
    dataset: DatasetFiles, begin: Moment = None, end: Moment = None
) -> tuple[str, int | None]:
    """Return the length of intervals that suits a time, and the step in which the first begins.

    Parameters
    ----------
    dataset : DatasetFiles
        The dataset.
    begin, end : str, datetime or step, optional
        The time, of which that in recordings counts.
    """
    span = dataset.span(begin, end)
    recorded = recording_steps(dataset)
    recorded = recorded if span is None else recorded.within(*span)
    length_s = np.ptp(np.append(recorded.first, recorded.last)) * STEP_S if len(recorded) else 0.0
    interval = next(name for name, most_s in _INTERVALS if length_s <= most_s)
    if interval != _USUAL and any(each.dropped for each in dataset.records(span).values()):
        interval = _USUAL
    steps = interval_steps(interval)
    return interval, None if span is None or begin is None else span[0] // steps * steps


def traffic(
    dataset: DatasetFiles, interval: str | None = None, *, begin: Moment = None,
    end: Moment = None, language: str | None = None, whole: bool = False, headways: bool = False,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the traffic of lanes, a row for each lane and interval.

    Parameters
    ----------
    interval : str, optional
        Length of the intervals, such as `1h`: a multiple of 15 min that divides a day, or a
        divisor of 15 min from 1 min on; by default `15min`. Intervals follow the clocks of the
        site.
    begin, end : str, datetime or step, optional
        Times between which the intervals begin.
    language : str, optional
        Language of the lanes' names, `en` or `de`; by default the current one, else English.
    whole : bool
        One row a lane, of all intervals together that were measured: from the begin of the
        first to the end of the last, `volume` without the time between. Intervals count by the
        share of them that was visible, so that those in which a recording begins or ends count
        less. They are of 15 min, or of `interval` where that is less. By default they suit the
        time, as in the report: `1min` up to half an hour, `5min` up to three hours, and from the
        one on in which it begins.
    headways : bool
        Add headways and gaps, which are measured from exact tables.

    Returns
    -------
    GeoDataFrame
        By lane and time: `lane` (its number), `name`; `begin`, `end` in the site's zone;
        `visible_share`, `counted`, `volume` (vehicles in the interval), `volume_se`,
        `volume_veh_h`, `heavy`; `speed_kmh` (space mean), `speed_time_mean_kmh`,
        `speed_85_kmh`; `occupancy`, `occupancy_se`, `density_veh_km`, `flow_veh_h`,
        `travel_time_s`, `delay_s`, `queue_max_m`, `queue_mean_m`, `sight_m`, `stop_line`
        (`drawn` in the map, or `presumed`), `stops`; the lane's line. Null where nothing is
        visible. Lanes that no sensor observes have no rows. With headways `headways` (number of
        pairs of consecutive vehicles at the counting line, between which it was visible
        throughout), `headway_mean_s` (front to front), `headway_se_s`, `headway_median_s`,
        `gap_mean_s` (rear to front), `gap_se_s`. Null where the line was not visible, means
        without a pair, errors with less than two.

    Raises
    ------
    UsageError
        If there is no such interval, or headways are asked of the whole time.
    InputError
        If vehicles were not looked for, or nothing was measured from begin to end; or if the
        interval is under 15 min, or headways are asked, and exact tables were deleted.
    """
    if headways and whole:
        raise UsageError("headways are of intervals, not of the whole time")
    lanes = _reader(dataset, interval, begin, end, language, whole=whole).lanes()
    if headways:
        return add_headways(dataset, lanes, interval or _USUAL, dataset.span(begin, end))
    return lanes


def turns(
    dataset: DatasetFiles, interval: str | None = None, *, begin: Moment = None,
    end: Moment = None, language: str | None = None, whole: bool = False,
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
    dataset: DatasetFiles, interval: str = _USUAL, *, begin: Moment = None, end: Moment = None,
    language: str | None = None,
) -> gpd.GeoDataFrame:  # fmt: skip
    """Return the queues at stop lines: rows of :meth:`traffic` in which a stop line is visible.

    Before a junction for which the map draws none, a stop line is presumed.

    Returns
    -------
    GeoDataFrame
        `lane`, `name`, `begin`, `end`, `visible_share`, `queue_max_m`, `queue_mean_m`,
        `sight_m` (how far before the stop line the lane is in sight: a queue that reaches as
        far may be longer), `stop_line` (`drawn` in the map, or `presumed`), `stops`, `delay_s`;
        the lane's line.
    """
    lanes = _reader(dataset, interval, begin, end, language).lanes()
    lanes = lanes[lanes["queue_max_m"].notna()].reset_index(drop=True)
    return lanes[
        ["lane", "name", "begin", "end", "visible_share", "queue_max_m", "queue_mean_m",
         "sight_m", "stop_line", "stops", "delay_s", "geometry"]
    ]  # fmt: skip


def _reader(
    dataset: DatasetFiles, interval: str | None, begin: Moment, end: Moment, language: str | None,
    *, whole: bool = False,
) -> TrafficReader:  # fmt: skip
    require_vehicles(dataset)
    if interval is None and whole:
        interval, begin = suited_interval(dataset, begin, end)
    interval = interval or _USUAL
    steps = min(interval_steps(interval), STEPS_PER_QUARTER)
    return TrafficReader(
        dataset=dataset, interval=interval, span=recorded_span(dataset, begin, end, steps),
        language=language, whole=whole,
    )  # fmt: skip

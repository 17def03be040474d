"""Count frames by sensor and hour, from the table of frames of a dataset."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base import LONGEST_CYCLE_S, Integers, Reporter
from gis_radar.dataset import FRAMES, Dataset, read_rows
from gis_radar.measures import FrameTimes

HOUR_S = 3600
HIGH = 0.7  # share of the seen tiles hit above which a frame is high
QUARTER_S = 900  # zones differ from UTC by whole quarters of an hour


def hour_begins(time_us: Integers, zone: ZoneInfo) -> Integers:
    """Return for each time the UNIX second in which its hour of local time began.

    Parameters
    ----------
    time_us : (n,) int64 array
        Microseconds since the UNIX epoch.
    zone : ZoneInfo
        Time zone of the hours. Where clocks are set back, the hour that occurs twice is two hours.
    """
    quarter, place = np.unique(time_us // (QUARTER_S * 1_000_000), return_inverse=True)
    local = pd.to_datetime(quarter * QUARTER_S, unit="s", utc=True).tz_convert(zone)
    into_hour = local.minute.to_numpy(np.int64) * 60 + local.second.to_numpy(np.int64)
    return np.asarray((quarter * QUARTER_S - into_hour)[place])


STAGE = "data quality"
Columns = dict[str, Integers]


COLUMNS = (
    "time_us", "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum", "shift_us",
)  # fmt: skip


_AGGREGATES = {
    **dict.fromkeys(
        ("frames", "doubled", "repeated", "high", "detections", "moving", "wild", "hits", "share",
         "shift_us"), "sum",
    ),
    "fewest": "min", "most": "max", "seen": "max",
}  # fmt: skip
_REDUCE = {"sum": np.add, "min": np.minimum, "max": np.maximum}


def _sums(rows: Columns, number: int, hours: Integers) -> pd.DataFrame:
    """Return the aggregates of the frames of a sensor by hour."""
    hit, seen = rows["tiles_hit"], rows["tiles_seen"]
    share = hit / np.maximum(seen, 1)
    high = (share > HIGH).astype(np.int64)
    of_frames = rows | {"hits": hit, "fewest": hit, "most": hit, "share": share, "high": high,
                        "seen": seen, "frames": np.ones(len(hit), np.int64)}  # fmt: skip
    starts = np.flatnonzero(np.diff(hours, prepend=-1))
    sums = {
        name: _REDUCE[how].reduceat(of_frames[name], starts) for name, how in _AGGREGATES.items()
    }
    return pd.DataFrame({"number": number, "hour": hours[starts], **sums})


def _frames(dataset: Dataset) -> Iterator[tuple[int, Columns]]:
    """Yield the frames hour by hour and sensor by sensor, with the sensor's number."""
    numbers = {name: number for number, name in enumerate(dataset.sensors)}
    records = {hour: each for hour, each in dataset.records().items() if each.has(FRAMES)}
    for rows in read_rows(dataset.folder, FRAMES, records, columns=["sensor", *COLUMNS]):
        sensors = rows["sensor"].to_pandas()
        for name, places in sensors.groupby(sensors, sort=True).indices.items():
            part = slice(int(places[0]), int(places[-1]) + 1)
            columns = {each: rows[each].to_numpy().astype(np.int64)[part] for each in COLUMNS}
            yield numbers[str(name)], columns


def frame_times(dataset: Dataset) -> dict[int, FrameTimes]:
    """Return the times of frames, by the sensor's number among `dataset.sensors`."""
    found: dict[int, FrameTimes] = defaultdict(FrameTimes)
    for number, columns in _frames(dataset):
        found[number].add(columns["time_us"])
    return dict(found)


Gap = tuple[int, int, int]  # the sensor's number, and when the gap begins and ends, us


def count_frames(
    dataset: Dataset, times: dict[int, FrameTimes], zone: ZoneInfo,
    reporter: Reporter,
) -> pd.DataFrame:  # fmt: skip
    """Count by sensor (its number) and hour (the UTC second of its begin).

    Only hours in which some sensor has a frame count. In them frames are missing where a sensor's
    next frame comes over 1.5 cycles later, and before its first and after its last frame, within
    the time from the first to the last frame of all sensors.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    times : dict
        Times of frames, from :func:`frame_times`.
    zone : ZoneInfo
        Time zone of the hours.
    reporter : Reporter
        Receives the progress.

    Returns
    -------
    DataFrame
        By `number` and `hour`, for all hours in which any sensor has a frame: `frames` received;
        `dropped`, missing between them; `doubled`, less than half a cycle after the one before;
        `repeated`, equal to the one before; `high`, with a high share of the seen tiles hit. Of
        them `detections`, `moving` ones, `wild` ones: too fast for any vehicle. `hits`, the sum of
        the tiles hit, the `fewest` and the `most` in a frame; `share`, the sum of the shares of the
        seen tiles that were hit; `seen`, the most tiles seen; `shift_us`, the sum of the
        corrections of the clock.
    """
    parts = []
    begin_us = min(each.first_us for each in times.values())
    end_us = max(each.last_us for each in times.values())
    before: dict[int, Columns] = {}
    done = 0
    gaps: list[Gap] = []
    for number, frames in _frames(dataset):
        gaps += _mark_and_find_gaps(
            frames, before.get(number, frames), number, times[number].cycle_us
        )
        before[number] = {name: column[-1:] for name, column in frames.items()}
        parts.append(_sums(frames, number, hour_begins(frames["time_us"], zone)))
        done += len(frames["time_us"])
        reporter.progress(STAGE, done, None)
    for number, each in times.items():
        # As if a frame came just beyond both ends, so that frames missing up to there count, too.
        room_us = min(0.55 * each.cycle_us, LONGEST_CYCLE_S * 1e6)
        gaps.append((number, int(begin_us - room_us), each.first_us))
        gaps.append((number, each.last_us, int(end_us + room_us)))
    parts_joined = pd.concat(parts)
    hours = np.unique(parts_joined["hour"].to_numpy(np.int64))
    all_pairs = [(number, hour) for number in sorted(times) for hour in hours.tolist()]
    dropped = _dropped(hours, gaps, times)
    totals = (
        parts_joined.groupby(["number", "hour"]).agg(_AGGREGATES).reindex(all_pairs, fill_value=0)
    )
    return totals.assign(dropped=[dropped.get(each, 0) for each in all_pairs]).reset_index()


def _mark_and_find_gaps(
    frames: Columns, before: Columns, number: int, cycle_us: float
) -> list[Gap]:
    """Mark frames that are doubled or repeated; return the gaps in which frames are missing.

    The first frame is compared with the row `before`, which may be itself: then it is neither.
    """
    gap, checksum_change, count_change = (
        np.diff(frames[name], prepend=before[name][:1])
        for name in ("time_us", "checksum", "detections")
    )
    has_previous = np.ones(len(gap), np.bool_)
    has_previous[0] = before is not frames
    is_equal = (checksum_change == 0) & (count_change == 0) & (frames["detections"] > 0)
    frames["repeated"] = (has_previous & is_equal).astype(np.int64)
    frames["doubled"] = (has_previous & (gap < cycle_us / 2)).astype(np.int64)
    after_gap = np.flatnonzero(gap > 1.5 * cycle_us)
    time = frames["time_us"]
    return [(number, int(time[i] - gap[i]), int(time[i])) for i in after_gap]


def _dropped(
    hours: Integers, gaps: list[Gap], times: dict[int, FrameTimes]
) -> dict[tuple[int, int], int]:
    """Count the frames missing in gaps, by sensor and hour, of hours in which any has a frame."""
    counts: dict[tuple[int, int], int] = defaultdict(int)
    for number, begin_us, end_us in gaps:
        cycle_us = times[number].cycle_us
        missing = round((end_us - begin_us) / cycle_us) - 1
        if missing < 1 or not np.isfinite(cycle_us):
            continue
        low = np.searchsorted(hours, begin_us // 1_000_000 - HOUR_S)
        for hour in hours[low : np.searchsorted(hours, end_us // 1_000_000 + 1)].tolist():
            first = max(np.ceil((hour * 1e6 - begin_us) / cycle_us), 1)
            last = min(np.ceil(((hour + HOUR_S) * 1e6 - begin_us) / cycle_us) - 1, missing)
            if last >= first:
                counts[number, hour] += int(last - first + 1)
    return counts

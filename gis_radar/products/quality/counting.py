"""Count frames by sensor and hour, from the table of frames of a dataset."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd

from gis_radar.base import LONGEST_CYCLE_S, Integers, Reporter
from gis_radar.dataset import FRAMES, Dataset, read_rows
from gis_radar.measures import FrameTimes

HOUR_S = 3600
HIGH = 0.7  # share of the seen tiles hit above which a frame is high
_NEXT_FILE_US = 60_000_000  # loggers take seconds to begin another file
_QUARTER_S = 900  # zones differ from UTC by whole quarters of an hour


def hour_begins(time_us: Integers, zone: ZoneInfo) -> Integers:
    """Return for each time the UNIX second in which its hour of local time began.

    Parameters
    ----------
    time_us : (n,) int64 array
        Microseconds since the UNIX epoch.
    zone : ZoneInfo
        Time zone of the hours. Where clocks are set back, the hour that occurs twice is two hours.
    """
    quarter, place = np.unique(time_us // (_QUARTER_S * 1_000_000), return_inverse=True)
    local = pd.to_datetime(quarter * _QUARTER_S, unit="s", utc=True).tz_convert(zone)
    into_hour = local.minute.to_numpy(np.int64) * 60 + local.second.to_numpy(np.int64)
    return np.asarray((quarter * _QUARTER_S - into_hour)[place])


_STAGE = "data quality"
_COLUMNS = (
    "time_us", "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum", "shift_us",
)  # fmt: skip
_AGGREGATES = {
    **dict.fromkeys(
        ("frames", "doubled", "repeated", "high", "detections", "moving", "wild", "hits", "share",
         "shift_us"), "sum",
    ),
    "fewest": "min", "most": "max", "seen": "max",
}  # fmt: skip
Gap = tuple[str, int, int]  # the sensor, and when the gap begins and ends, us


def _frames(dataset: Dataset) -> Iterator[pd.DataFrame]:
    """Yield the frames hour by hour, those of a sensor by their time."""
    records = {hour: each for hour, each in dataset.records().items() if each.has(FRAMES)}
    for rows in read_rows(dataset.folder, FRAMES, records, columns=["sensor", *_COLUMNS]):
        yield rows.to_pandas().astype(dict.fromkeys(_COLUMNS, np.int64))


def frame_times(dataset: Dataset) -> dict[str, FrameTimes]:
    """Return the times of frames, by sensor."""
    found: dict[str, FrameTimes] = defaultdict(FrameTimes)
    for frames in _frames(dataset):
        for sensor, times in frames.groupby("sensor")["time_us"]:
            found[str(sensor)].add(times.to_numpy())
    return dict(found)


def count_frames(
    dataset: Dataset, times: dict[str, FrameTimes], zone: ZoneInfo,
    reporter: Reporter,
) -> pd.DataFrame:  # fmt: skip
    """Count by sensor and hour (the UTC second of its begin).

    Only hours in which some sensor has a frame count. In them frames are missing where a sensor's
    next frame comes over 1.5 cycles later, and before its first and after its last frame, while a
    recording of any sensor goes on, at a live site always.

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
        By `sensor` and `hour`, for all hours in which any sensor has a frame: `frames` received;
        `dropped`, missing between them; `doubled`, less than half a cycle after the one before;
        `repeated`, equal to the one before; `high`, with a high share of the seen tiles hit. Of
        them `detections`, `moving` ones, `wild` ones: too fast for any vehicle. `hits`, the sum of
        the tiles hit, the `fewest` and the `most` in a frame; `share`, the sum of the shares of the
        seen tiles that were hit; `seen`, the most tiles seen; `shift_us`, the sum of the
        corrections of the clock.
    """
    recorded = _recorded_us(dataset, times)
    cycles_us = {sensor: each.cycle_us for sensor, each in times.items()}
    parts, gaps, done = list[pd.DataFrame](), list[Gap](), 0
    last = list[pd.DataFrame]()  # the last frame of each sensor so far
    for frames in _frames(dataset):
        followed = pd.concat([*last, frames], ignore_index=True)
        marked = _marked(followed, cycles_us, zone).iloc[len(followed) - len(frames) :]
        after_gap = marked.loc[marked["is_after_gap"], ["sensor", "before_us", "time_us"]]
        gaps += after_gap.astype({"before_us": np.int64}).itertuples(index=False, name=None)
        parts.append(marked.groupby(["sensor", "hour"]).agg(_AGGREGATES))
        last = [followed.groupby("sensor").tail(1)]
        done += len(frames)
        reporter.progress(_STAGE, done, None)
    for sensor, each in times.items():
        gaps.append((sensor, int(recorded[0, 0]) - HOUR_S * 1_000_000, each.first_us))
        gaps.append((sensor, each.last_us, int(recorded[-1, 1]) + HOUR_S * 1_000_000))
    gaps = [part for gap in gaps for part in _parts_in(recorded, gap, cycles_us[gap[0]])]
    joined = pd.concat(parts)
    hours = np.unique(joined.index.get_level_values("hour").to_numpy(np.int64))
    all_pairs = [(sensor, hour) for sensor in sorted(times) for hour in hours.tolist()]
    dropped = _dropped(hours, gaps, times)
    totals = joined.groupby(["sensor", "hour"]).agg(_AGGREGATES).reindex(all_pairs, fill_value=0)
    return totals.assign(dropped=[dropped.get(each, 0) for each in all_pairs]).reset_index()


def _recorded_us(dataset: Dataset, times: Mapping[str, FrameTimes]) -> Integers:
    """Return first and last time of each recording with a frame, joined where they follow soon.

    A live site is on from its first to its last frame.
    """
    table = dataset.recordings().sort_values("begin")
    begin, end = (table[name].dt.as_unit("us").to_numpy(np.int64) for name in ("begin", "end"))
    first = min(each.first_us for each in times.values())  # earlier frames may be deleted
    begin_us, end_us = np.maximum(begin, first), np.maximum.accumulate(np.maximum(end, first))
    apart_us = np.inf if dataset.manifest.live else _NEXT_FILE_US
    after = np.flatnonzero(begin_us[1:] > end_us[:-1] + apart_us) + 1
    return np.column_stack([begin_us[[0, *after]], end_us[[*(after - 1), -1]]])


def _parts_in(recorded: Integers, gap: Gap, cycle_us: float) -> Iterator[Gap]:
    """Yield the parts of a gap in what was recorded."""
    sensor, begin_us, end_us = gap
    # As if a frame came just beyond both ends, so that frames missing up to there count, too.
    room_us = int(min(0.55 * cycle_us, LONGEST_CYCLE_S * 1e6))
    first = np.searchsorted(recorded[:, 1], begin_us)
    last = np.searchsorted(recorded[:, 0], end_us, side="right")
    for begin, end in recorded[first:last].tolist():
        yield sensor, max(begin_us, begin - room_us), min(end_us, end + room_us)


def _marked(frames: pd.DataFrame, cycles_us: Mapping[str, float], zone: ZoneInfo) -> pd.DataFrame:
    """Return frames with what is summed, each judged by its sensor's frame before."""
    change = frames.groupby("sensor")[["time_us", "checksum", "detections"]].diff()
    cycle_us, hit = frames["sensor"].map(cycles_us), frames["tiles_hit"]
    is_equal = change[["checksum", "detections"]].eq(0.0).all(axis=1) & (frames["detections"] > 0)
    share = hit / frames["tiles_seen"].clip(lower=1)
    return frames.assign(
        hour=hour_begins(frames["time_us"].to_numpy(), zone), frames=1, share=share, hits=hit,
        fewest=hit, most=hit, seen=frames["tiles_seen"], high=share > HIGH, repeated=is_equal,
        doubled=change["time_us"] < cycle_us / 2, is_after_gap=change["time_us"] > 1.5 * cycle_us,
        before_us=frames["time_us"] - change["time_us"],
    )  # fmt: skip


def _dropped(
    hours: Integers, gaps: list[Gap], times: dict[str, FrameTimes]
) -> dict[tuple[str, int], int]:
    """Count the frames missing in gaps, by sensor and hour, of hours in which any has a frame."""
    counts: dict[tuple[str, int], int] = defaultdict(int)
    for sensor, begin_us, end_us in gaps:
        cycle_us = times[sensor].cycle_us
        missing = round((end_us - begin_us) / cycle_us) - 1
        if missing < 1 or not np.isfinite(cycle_us):
            continue
        low = np.searchsorted(hours, begin_us // 1_000_000 - HOUR_S)
        for hour in hours[low : np.searchsorted(hours, end_us // 1_000_000 + 1)].tolist():
            first = max(np.ceil((hour * 1e6 - begin_us) / cycle_us), 1)
            last = min(np.ceil(((hour + HOUR_S) * 1e6 - begin_us) / cycle_us) - 1, missing)
            if last >= first:
                counts[sensor, hour] += int(last - first + 1)
    return counts

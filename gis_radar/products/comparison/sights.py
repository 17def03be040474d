"""Find the comparable intervals of a lane: those that the same sensors saw alike.

A second radar sees past what hides vehicles from the first one, so it finds more of them, which
must not look like more traffic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from gis_radar.base import Booleans, Floats
from gis_radar.dataset import Dataset, LaneTraffic

ACTIVE_SHARE = 0.9  # least recorded share of an interval of a sensor that counts as present
BETWEEN = "\x1f"  # separator of sensors' names, which may hold a comma
ALIKE_SHARE = 0.9  # least share, of the lane's tiles seen in either period, that is seen in both


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneSights:
    """Sensors that see lanes in the intervals of a period.

    Parameters
    ----------
    rows : DataFrame
        A row for each lane and interval, with `lane`, `begin`, `end` and `watchers`: the joined
        names of the sensors that see a part of the lane; null where one of them recorded only a
        part of the interval.
    tiles : dict
        By sensor and lane, the ids of the lane's tiles in the sensor's sight in the period.
    """

    rows: pd.DataFrame
    tiles: dict[tuple[str, int], frozenset[int]]

    def of_lane(self, lane: int) -> pd.DataFrame:
        """Return the rows of a lane that can be compared."""
        mine = self.rows[self.rows["lane"] == lane]
        return mine[mine["watchers"].notna()]


def lane_sights(dataset: Dataset, rows: pd.DataFrame) -> LaneSights:
    """Find the sensors that see the lanes of a table of traffic.

    Parameters
    ----------
    dataset : Dataset
        The dataset, with recordings, poses and sights.
    rows : DataFrame
        As from :meth:`gis_radar.Dataset.traffic`.
    """
    spans = rows[["begin", "end"]].drop_duplicates().sort_values("begin")
    begin, end = (_seconds(spans[name]) for name in ("begin", "end"))
    recordings, poses = dataset.recordings(), dataset.poses()
    recorded = [_seconds(recordings[name]) for name in ("begin", "end")]
    used = recordings[(recorded[0] < end.max()) & (recorded[1] > begin.min())]
    sensors = sorted(set(used["sensor"]))
    tiles = _tiles_by_lane(dataset, used, poses)
    lanes = np.unique(rows["lane"].to_numpy(np.int64))
    sees = np.array([[(each, int(lane)) in tiles for each in sensors] for lane in lanes])
    active, partly = _activity(used, sensors, begin, end)
    at = np.searchsorted(lanes, rows["lane"].to_numpy(np.int64))
    when = np.searchsorted(begin, _seconds(rows["begin"]))
    there = sees[at].reshape(len(rows), -1)
    watching, doubtful = there & active[when], (there & partly[when]).any(axis=1)
    names = [_joined(sensors, row) for row in watching]
    watchers = pd.Series(names, rows.index, dtype=object).mask(np.asarray(doubtful))
    return LaneSights(rows=rows.assign(watchers=watchers), tiles=tiles)


def _seconds(times: pd.Series) -> Floats:
    """Return times as UNIX seconds."""
    since = times.dt.tz_convert("UTC") - pd.Timestamp(0, tz="UTC")
    return np.asarray(since.dt.total_seconds(), np.float64)


def _joined(sensors: Sequence[str], row: Booleans) -> str | None:
    return (
        BETWEEN.join(name for name, is_there in zip(sensors, row, strict=True) if is_there) or None
    )


def _activity(
    recordings: pd.DataFrame, sensors: Sequence[str], begin: Floats, end: Floats
) -> tuple[Booleans, Booleans]:
    """Return by interval and sensor whether it recorded all of it, and whether only a part."""
    seconds = np.zeros((len(begin), len(sensors)))
    times = (_seconds(recordings[name]) for name in ("begin", "end"))
    for sensor, first, last in zip(recordings["sensor"], *times, strict=True):
        overlap = np.minimum(end, last) - np.maximum(begin, first)
        seconds[:, sensors.index(sensor)] += np.maximum(overlap, 0.0)
    share = seconds / (end - begin)[:, None]
    active = share >= ACTIVE_SHARE
    return active, (share > 1.0 - ACTIVE_SHARE) & ~active


def _tiles_by_lane(
    dataset: Dataset, recordings: pd.DataFrame, poses: pd.DataFrame
) -> dict[tuple[str, int], frozenset[int]]:
    """Return by sensor and lane the tiles in sight of the poses of its recordings."""
    network = LaneTraffic.of(dataset).network
    lane_of = pd.Series(network.lane[network.tile_lane], network.tile_id)
    heads = poses.loc[poses["track"].isin(recordings["pose"]), ["sensor", "sight"]]
    sights = dataset.sights().merge(heads.drop_duplicates(), left_on="pose", right_on="sight")
    pairs = sights[["sensor", "tile_id"]].drop_duplicates()
    lanes = lane_of.reindex(pairs["tile_id"].to_numpy(np.int64)).to_numpy()
    known = pairs.assign(lane=lanes).dropna()
    groups = known.astype({"lane": np.int64}).groupby(["sensor", "lane"])["tile_id"]
    return {key: frozenset(ids.tolist()) for key, ids in groups}  # type: ignore[misc]


def shown_names(watchers: str) -> str:
    """Return the joined names of sensors separated by commas, for texts."""
    return ", ".join(watchers.split(BETWEEN))


def seen_alike(before: LaneSights, after: LaneSights, lane: int) -> tuple[str | None, str]:
    """Return the sensors by which a lane can be compared, or None, and the reason if it cannot.

    Of several groups of sensors that see it in both periods, the one with most intervals is taken.
    """
    counts = [each.of_lane(lane)["watchers"].value_counts() for each in (before, after)]
    both = counts[0].index.intersection(counts[1].index)
    if not len(both):
        seen = (shown_names(next(iter(count.index), "-")) for count in counts)
        return None, " / ".join(seen)
    watchers = str(max(sorted(both), key=lambda name: min(count[name] for count in counts)))
    for sensor in watchers.split(BETWEEN):
        first, second = (each.tiles[sensor, lane] for each in (before, after))
        if len(first & second) < ALIKE_SHARE * len(first | second):
            return None, f"{sensor}: {len(first)} / {len(second)}"
    return watchers, ""

"""Measured parts of half a minute by level of demand, and quarters of an hour as sums of these.

Sums and means are those by which the package rolls quarters of an hour up to hours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from gis_radar.base import STEPS_PER_SECOND, Floats, Integers
from gis_radar.dataset import (
    STEPS_PER_QUARTER,
    TILE_COUNTS,
    Dataset,
    LaneTraffic,
    count_spans,
)
from gis_radar.dataset.files.tables import LANE_MEASURES, TURNS
from gis_radar.measures import LEAST_VISIBLE_SHARE

PART_S = 30
PART_STEPS = PART_S * STEPS_PER_SECOND
PARTS = STEPS_PER_QUARTER // PART_STEPS  # of a quarter of an hour
_KM_H = "visible_km_h"
# Columns that are means, with the column of their weights.
_WEIGHTS = {
    "occupancy": _KM_H, "density": _KM_H, "flow": _KM_H, "speed_time_mean": "counted",
    "queue_mean_m": "visible_share",
}  # fmt: skip
_SUMS = ("counted", "heavy", "stops")
_COUNTS = [name for name in TILE_COUNTS.names if name not in {"tile_id", "interval"}]

Values: TypeAlias = dict[str, Floats]  # by column, (parts, tiles, lanes or turns)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredParts:
    """Measures of the parts of a site.

    Parameters
    ----------
    level : (n,) int array
        Index of the level of demand of each part, ascending.
    tile_id : (t,) array
        Tiles that were observed.
    tiles : dict
        Columns of `tile_counts`, each (n, t).
    lane : (k,) array
        Lanes that were observed.
    lanes : dict
        Columns of `lane_measures`, each (n, k), `speed_counts` (n, k, classes); NaN where null.
    length_m, free_s : (k,) array
        Lengths of the lanes, and times over them at free speed.
    turn : (m, 2) array
        Pairs of lanes.
    turns : dict
        Columns of `turns`, each (n, m).
    """

    level: Integers
    tile_id: Integers
    tiles: Values
    lane: Integers
    lanes: Values
    length_m: Floats
    free_s: Floats
    turn: Integers
    turns: Values

    @classmethod
    def of(cls, dataset: Dataset, begins: Sequence[float], parts: int) -> MeasuredParts:
        """Return the parts of each level of demand.

        Parameters
        ----------
        dataset : Dataset
            A dataset with exact tables.
        begins : sequence of float
            Begin of each level, UNIX seconds, whole parts from an hour's begin.
        parts : int
            Number of parts of each level, all in its hour.
        """
        traffic = LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)
        known = dataset.records()
        records = [known[int(begin) // 3600] for begin in begins]
        firsts = [int(begin) % 3600 // PART_S for begin in begins]
        counted, tables = [], []
        for record, first in zip(records, firsts, strict=True):
            steps = (first + np.arange(parts, dtype=np.int64)) * PART_STEPS
            last = steps + PART_STEPS - 1
            counted.append(count_spans(dataset.folder, record, steps, last))
            tables.append(traffic.finer(record, PART_STEPS))
        tile_id = np.unique(np.concatenate([tiles for tiles, _ in counted]))
        lane_tables, turn_tables = zip(*tables, strict=True)
        lanes, lane = _stacked(lane_tables, ["lane"], LANE_MEASURES.names, firsts, parts)
        keys = ["from_lane", "to_lane"]
        turns, turn = _stacked(turn_tables, keys, TURNS.names, firsts, parts)
        at = np.searchsorted(traffic.network.lane, lane[:, 0])
        length_m = traffic.network.length_m[at]
        return cls(
            level=np.repeat(np.arange(len(begins)), parts), tile_id=tile_id,
            tiles=_counts(counted, tile_id, parts), lane=lane[:, 0], lanes=lanes,
            length_m=length_m, free_s=length_m / traffic.network.free_speed[at], turn=turn,
            turns=turns,
        )  # fmt: skip

    def rows(self, times: Floats, interval: Integers) -> tuple[pa.Table, pa.Table, pa.Table]:
        """Return rows of `tile_counts`, `lane_measures` and `turns` for quarters of an hour.

        Parameters
        ----------
        times : (q, n) array
            How often each part is in each quarter.
        interval : (q,) array
            Column `interval` of the quarters.
        """
        return (
            self._tile_rows(times, interval), self._lane_rows(times, interval),
            self._turn_rows(times, interval),
        )  # fmt: skip

    def _tile_rows(self, times: Floats, interval: Integers) -> pa.Table:
        sums = {name: (times @ values).T for name, values in self.tiles.items()}
        tile, quarter = np.nonzero(sums["observed_steps"])
        keys = {"tile_id": self.tile_id[tile], "interval": interval[quarter]}
        found = {name: each[tile, quarter] for name, each in sums.items()}
        return TILE_COUNTS.to_arrow(keys | found)

    def _lane_rows(self, times: Floats, interval: Integers) -> pa.Table:
        of = self.lanes
        found = _volumes(times, of)
        found |= {name: _total(times, of[name]) for name in _SUMS}
        with np.errstate(invalid="ignore"):  # nothing known, with a weight of 0
            found |= {
                name: _total(times, of[name] * of[by]) / _total(times, _where(of[by], of[name]))
                for name, by in _WEIGHTS.items()
            }
        found[_KM_H] = times @ of[_KM_H]
        spread, known = of["occupancy_se"] * of[_KM_H], _where(of[_KM_H], of["occupancy_se"])
        found["occupancy_se"] = np.sqrt(_total(times, spread**2)) / _total(times, known)
        chosen = np.where(times[:, :, None] > 0, _where(of["queue_max_m"])[None], -np.inf)
        longest = chosen.max(axis=1)
        found["queue_max_m"] = np.where(longest >= 0.0, longest, np.nan)
        speed = found["flow"] / np.where(found["density"] > 0.0, found["density"], np.nan) / 3.6
        travel_s = self.length_m / np.where(speed > 0.0, speed, np.nan)
        enough = found[_KM_H] >= LEAST_VISIBLE_SHARE * self.length_m / 4000.0
        found["speed_mean"] = speed
        found["travel_time_s"] = np.where(enough, travel_s, np.nan)
        found["delay_s"] = np.maximum(found["travel_time_s"] - self.free_s, 0.0)
        rows = _rows(found, {"lane": self.lane}, interval)
        classes = np.tensordot(times, np.nan_to_num(of["speed_counts"]), 1)
        rows["speed_counts"] = _lists(np.moveaxis(classes, 1, 0)[rows.pop("seen")], rows["counted"])
        return LANE_MEASURES.to_arrow(rows)

    def _turn_rows(self, times: Floats, interval: Integers) -> pa.Table:
        keys = {"from_lane": self.turn[:, 0], "to_lane": self.turn[:, 1]}
        rows = _rows(_volumes(times, self.turns), keys, interval)
        rows.pop("seen")
        return TURNS.to_arrow(rows)


def _counts(
    counted: Sequence[tuple[Integers, Mapping[str, Floats]]], tile_id: Integers, parts: int
) -> Values:
    found = {name: np.zeros((len(counted) * parts, len(tile_id))) for name in _COUNTS}
    for k, (tiles, sums) in enumerate(counted):
        at = np.searchsorted(tile_id, tiles)
        for name in _COUNTS:
            found[name][k * parts : (k + 1) * parts, at] = sums[name].reshape(len(tiles), parts).T
    return found


def _stacked(
    tables: Sequence[pa.Table],
    keys: Sequence[str],
    names: Sequence[str],
    firsts: Sequence[int],
    parts: int,
) -> tuple[Values, Integers]:
    """Return columns by part and object (lane, turn), and the objects' keys, (objects, keys).

    Of each table (an hour), `parts` rows of an object count, from its value in `firsts` on.
    """
    known = [np.column_stack([each[key].to_numpy() for key in keys]) for each in tables]
    objects, place = np.unique(np.concatenate(known), axis=0, return_inverse=True)
    whole = pa.concat_tables(tables)
    hour = np.repeat(np.arange(len(tables)), [len(each) for each in tables])
    interval = whole["interval"].to_numpy() - np.array(firsts)[hour]
    inside = (interval >= 0) & (interval < parts)
    at = (hour * parts + interval)[inside], place.reshape(-1)[inside]
    found = dict[str, Floats]()
    for name in names:
        if name in {*keys, "interval"}:
            continue
        column = whole[name].combine_chunks()
        values: Any = column.to_pandas().to_numpy()
        if pa.types.is_list(column.type):
            most = max((len(each) for each in values if each is not None), default=1)
            none = np.full(most, np.nan)
            values = np.array([none if each is None else each for each in values], np.float64)
        fill = 0.0 if name in {"visible_share", _KM_H} else np.nan
        shape = (len(tables) * parts, len(objects), *values.shape[1:])
        found[name] = np.full(shape, fill)
        found[name][at] = values[inside]
    return found, objects.astype(np.int64)


def _total(times: Floats, values: Floats) -> Floats:
    """Return sums over parts of the known values; NaN where none is known."""
    known = np.isfinite(values)
    summed = times @ np.where(known, values, 0.0)
    return np.where(times @ known.astype(np.float64) > 0.0, summed, np.nan)


def _where(values: Floats, known: Floats | None = None) -> Floats:
    """Return values with NaN where `known` is NaN; without it, with -inf in place of NaN."""
    if known is None:
        return np.where(np.isfinite(values), values, -np.inf)
    return np.where(np.isfinite(known), values, np.nan)


def _volumes(times: Floats, of: Values) -> Values:
    """Return the volumes of quarters; parts that are not known count as the mean of the others."""
    known = times @ np.isfinite(of["volume"]).astype(np.float64)
    more = PARTS / np.maximum(known, 1e-9)
    volume = _total(times, of["volume"]) * more
    share = times @ of["visible_share"] / PARTS
    variance = more**2 * _total(times, of["volume_se"] ** 2)
    error = np.sqrt(variance + (volume / more + 0.5) * (more**2 - more))
    enough = (known > 0.0) & (share >= LEAST_VISIBLE_SHARE)
    return {
        "visible_share": share,
        "volume": np.where(enough, volume, np.nan),
        "volume_se": np.where(enough, error, np.nan),
    }


def _rows(found: Values, keys: Mapping[str, Integers], interval: Integers) -> dict[str, Any]:
    """Return rows of observed objects by object and quarter; `seen` (objects, quarters): which."""
    by_object = {name: values.T for name, values in found.items()}
    seen = (by_object["visible_share"] > 0.0) | (by_object.get(_KM_H, np.zeros(1)) > 0.0)
    number, quarter = np.nonzero(seen)
    rows: dict[str, Any] = {name: ids[number] for name, ids in keys.items()}
    rows["interval"] = interval[quarter]
    for name, values in by_object.items():
        mine = values[number, quarter]
        if name in {"counted", "stops"}:
            whole = np.rint(np.nan_to_num(mine)).astype(np.int32)
            rows[name] = pa.array(whole, mask=np.isnan(mine))
        else:
            rows[name] = np.ma.masked_invalid(mine)
    return rows | {"seen": seen}


def _lists(classes: Floats, counted: pa.Array) -> pa.Array:
    """Return the speed counts of rows as lists; null where nothing could be counted."""
    whole = np.rint(classes).astype(np.int32)
    lists = whole.tolist()
    known = counted.is_valid().to_pylist()
    return pa.array([a if b else None for a, b in zip(lists, known, strict=True)])

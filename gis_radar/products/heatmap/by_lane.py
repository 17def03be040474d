"""Sum a heat map by lane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import Floats, Integers, quotient
from gis_radar.hdmap import LANE_COLUMN, Lane, lanes_of
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.intervals import When

BEGIN = "begin"


def lanes_with_tiles(tiles: gpd.GeoDataFrame) -> tuple[Sequence[Lane], Integers]:
    """Return the lanes of tiles, and for each tile the position of its lane among them."""
    lanes = lanes_of(tiles)
    lane_of_tile = np.empty(len(tiles), np.int64)
    for i, lane in enumerate(lanes):
        lane_of_tile[lane.rows] = i
    return lanes, lane_of_tile


def lane_totals(values: Floats, lane_of_tile: Integers, size: int) -> Floats:
    """Return the sum of a value over each lane's tiles."""
    return np.asarray(np.bincount(lane_of_tile, values, size), np.float64)


def table_by_lane(
    tally: Tally,
    interval: When = None,
    *,
    begin: Any = None,
    end: Any = None,
    each: bool = False,
    lanes: gpd.GeoDataFrame | None = None,
) -> pd.DataFrame | gpd.GeoDataFrame:
    """Return occupancy and hit share of each lane.

    Parameters
    ----------
    interval : int, slice, str or datetime, optional
        The interval, as for :meth:`shares`; by default the whole time.
    begin, end : str or datetime, optional
        The intervals between these times, in place of one.
    each : bool
        Whether each interval has its own rows; else all intervals are taken together.
    lanes : GeoDataFrame, optional
        From :meth:`gis_radar.LaneletMap.lanes`: its columns and lines are added.

    Returns
    -------
    DataFrame, or GeoDataFrame with lanes
        By `lane`, its number; with `each` by `begin` (the interval's, in the site's time zone) and
        `lane`. `length_m` of its tiles; `seen_m`, of those with a share. Where vehicles are known
        `visible_s` and `occupied_s`, seconds, the mean of its tiles; `occupancy`, their quotient,
        NaN where not visible, and its standard error `occupancy_se`: the mean of its tiles', by
        visible time, as a missed or false vehicle affects all tiles of a lane alike.
        `observed_s`, `hit_s` and `hit_share`: the same of hits, for which no error is known.
    """
    tiled, lane_of_tile = lanes_with_tiles(tally.tiles)
    index = pd.Index([lane.number for lane in tiled], name=LANE_COLUMN)
    chosen = tally.chosen(interval, begin=begin, end=end)
    if not each:
        table = _table_of_interval(tally, chosen, lane_of_tile, index)
    else:
        picked = slice(None) if chosen is None else chosen
        rows = range(len(tally.timeline))[picked] if isinstance(picked, slice) else [picked]
        shown = list(rows) or [0]  # without intervals, an empty table with the columns
        table = pd.concat(
            [_table_of_interval(tally, row, lane_of_tile, index) for row in shown],
            keys=tally.times[shown],
            names=[BEGIN],
        ).iloc[: len(rows) * len(index)]
    if lanes is None:
        return table
    further = lanes.set_index(LANE_COLUMN)
    further = further[[name for name in further.columns if name not in table.columns]]
    return gpd.GeoDataFrame(
        table.join(further, on=LANE_COLUMN), geometry=further.geometry.name, crs=lanes.crs
    )


def _table_of_interval(
    tally: Tally, interval: int | slice | None, lane_of_tile: Integers, index: pd.Index
) -> pd.DataFrame:
    """Return one row for each lane."""

    def total(values: Floats) -> Floats:
        return lane_totals(np.nan_to_num(values), lane_of_tile, len(index))

    count = total(np.ones(len(lane_of_tile)))
    length_m = tally.tiles["length_m"].to_numpy(np.float64)
    hits, known = tally.shares(interval), tally.occupancy_shares(interval)
    shown_s = hits.observed_s if known is None else known.visible_s
    columns = {"length_m": total(length_m), "seen_m": total(np.where(shown_s > 0, length_m, 0.0))}
    if known is not None:
        visible_s, occupied_s = total(known.visible_s), total(known.occupied_s)
        error_s = total(known.occupancy_se * known.visible_s)
        columns |= {
            "visible_s": visible_s / count,
            "occupied_s": np.where(visible_s > 0, occupied_s / count, np.nan),
            "occupancy": quotient(occupied_s, visible_s),
            "occupancy_se": quotient(error_s, visible_s),
        }
    observed_s, hit_s = total(hits.observed_s), total(hits.hit_s)
    columns |= {
        "observed_s": observed_s / count,
        "hit_s": np.where(observed_s > 0, hit_s / count, np.nan),
        "hit_share": quotient(hit_s, observed_s),
    }
    return pd.DataFrame(columns, index=index)

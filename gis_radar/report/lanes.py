"""Lanes: chains of lanelets, and how busy each of them is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from gis_radar.arrays import Floats, Integers
from gis_radar.report.traffic import Seconds, Traffic
from gis_radar.tiles import quads

TOUCH_M = 0.05
BUSY = 0.2  # a class break of all heat maps


@dataclass(frozen=True, kw_only=True)
class Lane:
    """A chain of lanelets, each the only successor of the last and following nothing else.

    Parameters
    ----------
    number : int
        From 1, in the order of the smallest lanelet id: the same for the same map.
    lanelets : tuple of int
        In driving direction.
    rows : (n,) int64 array
        Positions of its tiles, in driving direction.
    """

    number: int
    lanelets: tuple[int, ...]
    rows: Integers


def lanes_of(tiles: gpd.GeoDataFrame) -> list[Lane]:
    """Chain lanelets to lanes, by where the tiles of one end and those of another begin.

    Parameters
    ----------
    tiles : GeoDataFrame
        With `lanelet_id`, `index` and the four-vertex polygons of :func:`gis_radar.make_tiles`.
    """
    ordered = tiles.reset_index(drop=True).sort_values(["lanelet_id", "index"])
    rows = {
        key: part.to_numpy(np.int64) for key, part in ordered.groupby("lanelet_id").groups.items()
    }
    ids = list(rows)
    corners = quads(tiles) - quads(tiles).min(axis=(0, 1))
    starts = np.array([corners[rows[each][0]][[0, 3]].ravel() for each in ids])
    ends = np.array([corners[rows[each][-1]][[1, 2]].ravel() for each in ids])
    following = cKDTree(ends).query_ball_tree(cKDTree(starts), TOUCH_M)
    after = {i: [k for k in found if k != i] for i, found in enumerate(following)}
    before: dict[int, list[int]] = {i: [] for i in after}
    for i, found in after.items():
        for k in found:
            before[k].append(i)
    only = {i: k[0] for i, k in after.items() if len(k) == 1 and len(before[k[0]]) == 1}
    chains = sorted(_chains(only, len(ids)), key=lambda chain: min(ids[i] for i in chain))
    return [
        Lane(
            number=number,
            lanelets=tuple(int(ids[i]) for i in chain),
            rows=np.concatenate([rows[ids[i]] for i in chain]),
        )
        for number, chain in enumerate(chains, start=1)
    ]


def _chains(only: dict[int, int], total: int) -> list[list[int]]:
    """Follow the links from where a chain begins; a ring begins at its first lanelet."""
    led_to = set(only.values())
    chains, seen = [], set[int]()
    for first in [*(i for i in range(total) if i not in led_to), *range(total)]:
        chain, at = [], first
        while at not in seen:
            seen.add(at)
            chain.append(at)
            at = only.get(at, at)
        if chain:
            chains.append(chain)
    return chains


@dataclass(kw_only=True)
class LaneTally:
    """Sums of tiles by lane, over the whole time and by interval.

    Parameters
    ----------
    lanes : sequence of Lane
        Which.
    lane_of_tile : (tiles,) int64 array
        Position of each tile's lane in `lanes`.
    occupied, observed : list of (lanes,) float64 arrays
        Tile-seconds of each interval so far.
    """

    lanes: Sequence[Lane]
    lane_of_tile: Integers
    occupied: list[Floats] = field(default_factory=list)
    observed: list[Floats] = field(default_factory=list)

    def add(self, seconds: Seconds) -> None:
        """Add an interval."""
        occupied, observed = self.sums(seconds)
        self.occupied.append(occupied)
        self.observed.append(observed)

    def sums(self, seconds: Seconds) -> tuple[Floats, Floats]:
        """Return tile-seconds by lane, occupied and observed."""
        size = len(self.lanes)
        occupied, observed = (np.bincount(self.lane_of_tile, part, size) for part in seconds)
        return np.asarray(occupied, np.float64), np.asarray(observed, np.float64)


def lane_tally(tiles: gpd.GeoDataFrame) -> LaneTally:
    """Return the lanes of tiles, with nothing counted yet."""
    lanes = lanes_of(tiles)
    lane_of_tile = np.empty(len(tiles), np.int64)
    for i, lane in enumerate(lanes):
        lane_of_tile[lane.rows] = i
    return LaneTally(lanes=lanes, lane_of_tile=lane_of_tile)


def lane_table(traffic: Traffic, tally: LaneTally) -> pd.DataFrame:
    """Return one row a lane, busiest first, those that were not observed last.

    Returns
    -------
    DataFrame
        `lane`, `lanelets`, `subtype`, `east_m` and `north_m` from begin to end, `length_m`;
        `observed_m`, the length of its observed tiles; `occupied_s`, `observed_s`, tile-seconds;
        `occupancy`, their quotient, NaN where not observed; `busiest_spot`, the highest occupancy
        of a tile, and `busiest_spot_m`, where along the lane; `busy_m`, the length of tiles with
        an occupancy of 20 % or more; `busiest_begin`, `busiest_end`, `busiest_occupancy` of the
        busiest interval, of those with at least half as much observed as in the best observed.
    """
    share = traffic.overall.occupancy
    occupied, observed = tally.sums(traffic.overall)
    tiles = traffic.tiles
    length = tiles["length_m"].to_numpy(np.float64)
    centre = quads(tiles).mean(axis=1)
    rows = []
    for i, lane in enumerate(tally.lanes):
        mine, long = share[lane.rows], length[lane.rows]
        seen = np.isfinite(mine)
        top = int(np.nanargmax(mine)) if seen.any() else -1
        east, north = centre[lane.rows[-1]] - centre[lane.rows[0]]
        rows.append(
            {
                "lane": lane.number,
                "lanelets": lane.lanelets,
                "subtype": str(tiles["subtype"].iloc[lane.rows[0]]),
                "east_m": float(east),
                "north_m": float(north),
                "length_m": float(long.sum()),
                "observed_m": float(long[seen].sum()),
                "occupied_s": float(occupied[i]) if seen.any() else np.nan,
                "observed_s": float(observed[i]),
                "occupancy": occupied[i] / observed[i] if seen.any() else np.nan,
                "busiest_spot": float(mine[top]) if seen.any() else np.nan,
                "busiest_spot_m": float(long[: top + 1].sum() - long[top] / 2)
                if seen.any()
                else np.nan,
                "busy_m": float(long[mine >= BUSY].sum()) if seen.any() else np.nan,
                **_busiest(traffic, tally, i),
            }
        )
    table = pd.DataFrame(rows)
    return table.sort_values(
        ["occupancy", "lane"], ascending=[False, True], na_position="last", ignore_index=True
    )


def _busiest(traffic: Traffic, tally: LaneTally, lane: int) -> dict[str, object]:
    """Return the busiest interval of a lane; nothing where there is but one, or no hit."""
    occupied = np.array([each[lane] for each in tally.occupied])
    observed = np.array([each[lane] for each in tally.observed])
    fair = (observed > 0) & (observed >= 0.5 * observed.max(initial=0.0))
    if len(traffic.intervals) < 2 or not occupied[fair].any():
        return {"busiest_begin": pd.NaT, "busiest_end": pd.NaT, "busiest_occupancy": np.nan}
    share = np.divide(occupied, observed, out=np.full(len(fair), -1.0), where=fair)
    best = int(share.argmax())
    begin, end = traffic.intervals[best]
    return {
        "busiest_begin": pd.Timestamp(begin),
        "busiest_end": pd.Timestamp(end),
        "busiest_occupancy": float(share[best]),
    }

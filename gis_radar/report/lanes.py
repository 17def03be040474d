"""Lanes: chains of lanelets, and how busy each of them is."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
from pyproj import CRS
from scipy.spatial import cKDTree

from gis_radar.arrays import Floats, Integers
from gis_radar.crs import metric_crs
from gis_radar.errors import InputError
from gis_radar.heatmap.layers import LONG, WIDE
from gis_radar.tiles.tiles import quads

PACKAGE = "heatmap.gpkg"
COLUMNS = (
    "tile_id", "lanelet_id", "index", "s_m", "length_m", "subtype",
    "occupied_s", "observed_s", "occupancy",
)  # fmt: skip
# From one begin to the next by their index: a look at all rows would take seconds.
_TIMES = f"""
    WITH RECURSIVE times(moment) AS (
        SELECT min("begin") FROM "{LONG}"
        UNION ALL
        SELECT (SELECT min("begin") FROM "{LONG}" WHERE "begin" > moment)
        FROM times WHERE moment IS NOT NULL
    )
    SELECT moment, (SELECT "end" FROM "{LONG}" WHERE "begin" = moment LIMIT 1)
    FROM times WHERE moment IS NOT NULL
"""  # noqa: S608 - our own name
_HINT = "make it again with: gis-radar heatmap"

Span = tuple[datetime, datetime]


class Seconds(NamedTuple):
    """How long tiles were occupied and observed, in the order of the tiles.

    Parameters
    ----------
    occupied, observed : (n,) float64 arrays
        Seconds; both 0 where not observed.
    """

    occupied: Floats
    observed: Floats

    @property
    def occupancy(self) -> Floats:
        """The share, NaN where not observed."""
        known = self.observed > 0
        share = np.full(len(known), np.nan)
        share[known] = self.occupied[known] / self.observed[known]
        return share


@dataclass(frozen=True, kw_only=True, eq=False)
class Traffic:
    """A heat map as its files hold it.

    Parameters
    ----------
    folder : Path
        Of the heat map.
    tiles : GeoDataFrame
        All tiles by ascending `tile_id`, with `COLUMNS` over the whole time.
    crs : CRS
        Theirs.
    fingerprint : str
        Of the tiles; empty where the file does not say.
    whole : (datetime, datetime)
        Begin and end of all data, UTC.
    intervals : sequence of (datetime, datetime)
        Of the heat map, ascending; one where none were asked for.
    """

    folder: Path
    tiles: gpd.GeoDataFrame
    crs: CRS
    fingerprint: str
    whole: Span
    intervals: Sequence[Span]

    @property
    def overall(self) -> Seconds:
        """The seconds of the whole time."""
        observed = self.tiles["observed_s"].fillna(0.0).to_numpy(np.float64)
        return Seconds(self.tiles["occupied_s"].fillna(0.0).to_numpy(np.float64), observed)

    def by_interval(self) -> Iterator[Seconds]:
        """Read the seconds of each interval, one after the other."""
        ids = self.tiles["tile_id"].to_numpy(np.int64)
        occupied, observed = np.zeros(len(ids)), np.zeros(len(ids))
        filled = 0
        with pyogrio.open_arrow(
            self.folder / PACKAGE, layer=LONG, use_pyarrow=True, read_geometry=False,
            columns=["tile_id", "occupied_s", "observed_s"],
        ) as (_, reader):  # fmt: skip
            for batch in reader:
                rows = [
                    np.nan_to_num(batch.column(name).to_numpy(zero_copy_only=False))
                    for name in ("tile_id", "occupied_s", "observed_s")
                ]
                start = 0
                while start < len(rows[0]):
                    stop = min(start + len(ids) - filled, len(rows[0]))
                    place = slice(filled, filled + stop - start)
                    self._require(np.array_equal(rows[0][start:stop], ids[place]))
                    occupied[place], observed[place] = (each[start:stop] for each in rows[1:])
                    filled, start = filled + stop - start, stop
                    if filled == len(ids):
                        yield Seconds(occupied.copy(), observed.copy())
                        filled = 0
        self._require(filled == 0)

    def _require(self, fits: bool) -> None:  # noqa: FBT001 - a test, not an option
        if not fits:
            raise InputError(
                f"{self.folder / PACKAGE}: layer {LONG} does not hold each tile once an interval",
                hint=_HINT,
            )


def read_traffic(folder: Path) -> Traffic:
    """Read a heat map; its intervals are read later, one by one.

    Raises
    ------
    InputError
        If the folder holds no heat map, or a damaged one.
    """
    package = folder / PACKAGE
    try:
        tiles = pyogrio.read_dataframe(package, layer=WIDE, columns=list(COLUMNS), use_arrow=True)
        notes = pyogrio.read_info(package, layer=WIDE)["layer_metadata"] or {}
        with closing(sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)) as base:
            times = base.execute(_TIMES).fetchall()
    except (
        pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, sqlite3.Error, OSError,
    ) as error:  # fmt: skip
        reason = str(error).splitlines()[0]
        raise InputError(f"{package}: not a heat map: {reason}", hint=_HINT) from error
    missing = [name for name in COLUMNS if name not in tiles]
    if missing or tiles.empty or not times:
        lacks = f"the column {missing[0]}" if missing else "any row"
        raise InputError(f"{package}: not a heat map: it lacks {lacks}", hint=_HINT)
    crs = metric_crs(tiles.crs, what=str(package))
    intervals = [(datetime.fromisoformat(a), datetime.fromisoformat(b)) for a, b in times]
    return Traffic(
        folder=folder,
        tiles=tiles.sort_values("tile_id", ignore_index=True),
        crs=crs,
        fingerprint=str(notes.get("fingerprint", "")),
        whole=_whole(notes) or (intervals[0][0], intervals[-1][1]),
        intervals=intervals,
    )


def _whole(notes: Mapping[str, str]) -> Span | None:
    """Return the time from the first to the last frame, as the layer says it."""
    try:
        return datetime.fromisoformat(notes["begin"]), datetime.fromisoformat(notes["end"])
    except (KeyError, ValueError):
        return None


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

"""Lanes: chains of lanelets, and how busy each of them is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from gis_radar.base import NO_FIGURE, Clock, Floats, Integers, wind_of, write_csv
from gis_radar.dataset import Dataset
from gis_radar.hdmap import LANE_EXIT_M, Lane, quads
from gis_radar.products.heatmap.by_lane import lane_totals, lanes_with_tiles
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.heatmap.occupancy import surest
from gis_radar.products.report.content import utc

BUSY = 0.2  # a class break of all heat maps
# Compared with each other are lanes that are known well enough.
LEAST_TRACKS = 10  # of vehicles that followed it: of ten, chance alone moves a share by a third
LEAST_SEEN = 0.5  # share of its length: less may be its queue alone, or all but its queue
MOST_ERROR = 0.5  # standard error, as a share of the occupancy: beyond, 0 is within two of them


class TileShares(NamedTuple):
    """What a report shows of tiles: occupancy where vehicles are known, else hits.

    Parameters
    ----------
    part_s, base_s, share : (tiles,) float64 arrays
        Seconds occupied (or hit), seconds visible (or observed), and their quotient: NaN where the
        seconds below are 0.
    error : (tiles,) float64 array
        Standard error of the quotient, NaN of hits.
    """

    part_s: Floats
    base_s: Floats
    share: Floats
    error: Floats


def shown_of(heat: HeatMap, interval: int | slice | None = None) -> TileShares:
    """Return what a report shows of the whole time, or of intervals."""
    known = heat.occupancy_shares(interval)
    if known is None:
        return hits_of(heat, interval)
    return TileShares(known.occupied_s, known.visible_s, known.occupancy, known.occupancy_se)


def hits_of(heat: HeatMap, interval: int | slice | None = None) -> TileShares:
    """Return the hit share of the whole time, or of intervals."""
    return TileShares(*heat.shares(interval), np.full(len(heat.tiles), np.nan))


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneSums:
    """Sums of tiles by lane and interval.

    Parameters
    ----------
    lanes : sequence of Lane
        Which.
    lane_of_tile : (tiles,) int64 array
        Position of each tile's lane in `lanes`.
    part_s, base_s : (intervals, lanes) float64 arrays
        Tile-seconds: occupied and visible, of hits hit and observed.
    error_s : (intervals, lanes) float64 array
        Standard error of `part_s`, tile-seconds; NaN of hits. The errors of a lane's tiles are
        taken as one: a vehicle that was missed, or is none, is so all along the lane.
    """

    lanes: Sequence[Lane]
    lane_of_tile: Integers
    part_s: Floats
    base_s: Floats
    error_s: Floats

    def of(self, shares: TileShares) -> tuple[Floats, Floats, Floats]:
        """Return the tile-seconds of each lane and their error, of other tiles' shares."""
        return _by_lane(shares, self.lane_of_tile, len(self.lanes))


def sum_by_lane(heat: HeatMap) -> LaneSums:
    """Sum the tiles of each lane, interval by interval."""
    lanes, lane_of_tile = lanes_with_tiles(heat.tiles)
    sums = [
        _by_lane(shown_of(heat, i), lane_of_tile, len(lanes)) for i in range(len(heat.timeline))
    ]
    part_s, base_s, error_s = np.stack(sums, axis=1)
    return LaneSums(
        lanes=lanes, lane_of_tile=lane_of_tile, part_s=part_s, base_s=base_s, error_s=error_s
    )


def _by_lane(
    shares: TileShares, lane_of_tile: Integers, size: int
) -> tuple[Floats, Floats, Floats]:
    seen = shares.base_s > 0
    error_s = np.where(seen, shares.error * shares.base_s, 0.0)
    part, base, error = (
        lane_totals(seconds, lane_of_tile, size)
        for seconds in (np.nan_to_num(shares.part_s), shares.base_s, error_s)
    )
    return part, base, error


def tracks_of(dataset: Dataset | None, lanes: Sequence[Lane]) -> Integers | None:
    """Return how many tracks of vehicles followed each lane; None where that is not known."""
    if dataset is None or not dataset.has_vehicles:
        return None
    lane_of = {lanelet: i for i, lane in enumerate(lanes) for lanelet in lane.lanelets}
    counts = np.zeros(len(lanes), np.int64)
    for lanelets in dataset.vehicles()["lanelets"]:
        for i in {lane_of[int(each)] for each in lanelets if int(each) in lane_of}:
            counts[i] += 1
    return counts


def lane_table(heat: HeatMap, sums: LaneSums, tracks: Integers | None = None) -> pd.DataFrame:
    """Return one row a lane: those that are ranked by their occupancy, then the others.

    Hits are not ranked: their lanes stay in the order of their numbers. What was not visible
    (observed) comes last.

    Returns
    -------
    DataFrame
        `lane`, `lanelets`, `subtype`, `east_m` and `north_m` along its last metres, `length_m`;
        `base_m`, the length of its tiles with a share; `part_s`, `base_s`, tile-seconds occupied
        and visible, of hits hit and observed; `share`, their quotient, NaN where there is none,
        and its standard error `share_se`, NaN for hits;
        `busiest_spot`, the share of the tile of :func:`surest`, its standard error
        `busiest_spot_se` (NaN for hits), and `busiest_spot_m`, where along the lane; `busy_m`, the
        length of tiles with a share of 20 % or more; `busiest_begin`, `busiest_end`,
        `busiest_share`, `busiest_share_se` of the busiest interval, of those with at least half as
        much seen as in the best seen; `hit_s`, `observed_s`, `hit_share`: its hits; `tracks`
        of vehicles, -1 where not known; `rank`, from 1, 0 of those that are not ranked, and `why`.
    """
    whole, tiles, known = shown_of(heat), heat.tiles, heat.occupancy_shares()
    error = np.full(len(tiles), np.nan) if known is None else known.occupancy_se
    part, base, off = sums.of(whole)
    hit, observed, _ = sums.of(hits_of(heat))
    length = tiles["length_m"].to_numpy(np.float64)
    centre = quads(tiles).mean(axis=1)
    rows = []
    for i, lane in enumerate(sums.lanes):
        mine, long = whole.share[lane.rows], length[lane.rows]
        seen = np.isfinite(mine)
        top = surest(mine, error[lane.rows]) if seen.any() else -1
        before = int(np.searchsorted(np.cumsum(long[::-1]), LANE_EXIT_M))
        east, north = centre[lane.rows[-1]] - centre[lane.rows[max(len(long) - 1 - before, 0)]]
        rows.append(
            {
                "lane": lane.number,
                "lanelets": lane.lanelets,
                "subtype": str(tiles["subtype"].iloc[lane.rows[0]]),
                "east_m": float(east),
                "north_m": float(north),
                "length_m": float(long.sum()),
                "base_m": float(long[seen].sum()),
                "part_s": float(part[i]) if seen.any() else np.nan,
                "base_s": float(base[i]),
                "share": part[i] / base[i] if seen.any() else np.nan,
                "share_se": off[i] / base[i] if seen.any() else np.nan,
                "hit_s": float(hit[i]) if observed[i] else np.nan,
                "observed_s": float(observed[i]),
                "hit_share": hit[i] / observed[i] if observed[i] else np.nan,
                "busiest_spot": float(mine[top]) if seen.any() else np.nan,
                "busiest_spot_se": float(error[lane.rows[top]]) if seen.any() else np.nan,
                "busiest_spot_m": float(long[: top + 1].sum() - long[top] / 2)
                if seen.any()
                else np.nan,
                "busy_m": float(long[mine >= BUSY].sum()) if seen.any() else np.nan,
                **_busiest(heat, sums, i),
                "tracks": -1 if tracks is None else int(tracks[i]),
            }
        )
    return _in_order(pd.DataFrame(rows), heat.measure)


def _in_order(table: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the lanes in the order in which they are read, with their ranks."""
    table = table.assign(why=[_why_not(row, measure) for _, row in table.iterrows()])
    table["place"] = table["share"].isna() * 2 + table["why"].ne("")
    by_share = measure == "occupancy"
    table = table.sort_values(
        ["place", "share", "lane"] if by_share else ["place", "lane"],
        ascending=[True, False, True] if by_share else True, ignore_index=True,
    )  # fmt: skip
    rank = np.where(table["why"].eq(""), np.arange(1, len(table) + 1), 0)
    return table.assign(rank=rank).drop(columns="place")


WHY_NOT = {
    "hits": "",
    "unseen": "not visible",
    "tracks": "too few tracks",
    "length": "too little of it visible",
    "error": "too uncertain",
}


def _why_not(row: pd.Series, measure: str) -> str:
    """Return why a lane is not ranked, a key of `WHY_NOT`; nothing where it is."""
    if measure != "occupancy":
        return "hits"
    reasons = {
        "unseen": np.isnan(row["share"]),
        "length": row["base_m"] < LEAST_SEEN * row["length_m"],
        "tracks": row["tracks"] < LEAST_TRACKS,
        "error": not row["share_se"] <= MOST_ERROR * row["share"],
    }
    return next((name for name, applies in reasons.items() if applies), "")


def _busiest(heat: HeatMap, sums: LaneSums, lane: int) -> dict[str, object]:
    """Return the busiest interval of a lane; nothing where there is but one, or nothing in any."""
    part, base = sums.part_s[:, lane], sums.base_s[:, lane]
    fair = (base > 0) & (base >= 0.5 * base.max(initial=0.0))
    if len(heat.timeline) < 2 or not part[fair].any():
        none = dict.fromkeys(("busiest_share", "busiest_share_se"), np.nan)
        return {"busiest_begin": pd.NaT, "busiest_end": pd.NaT, **none}
    share = np.divide(part, base, out=np.full(len(fair), -1.0), where=fair)
    best = int(share.argmax())
    begin, end = heat.timeline.span(best)
    return {
        "busiest_begin": pd.Timestamp(begin),
        "busiest_end": pd.Timestamp(end),
        "busiest_share": float(share[best]),
        "busiest_share_se": float(sums.error_s[best, lane] / base[best]),
    }


# The tables: of occupancy, with hits as the last columns; of hits where no vehicles are known.

_HITS = ("hit_tile_s", "observed_tile_s", "hit_share")
_OCCUPIED = ("occupied_tile_s", "visible_tile_s", "occupancy", "occupancy_se")


def write_lanes(path: Path, table: pd.DataFrame, clock: Clock, measure: str) -> None:
    """Write all lanes: one row each, shares from 0 to 1, empty where there is none."""
    occupied = measure == "occupancy"
    header = (
        "lane", *(("rank", "tracks") if occupied else ()),
        "lanelets", "subtype", "street", "street_part", "leads_to", "length_m",
        "visible_m" if occupied else "observed_m", *(_OCCUPIED if occupied else _HITS),
        "busiest_spot", *(("busiest_spot_se",) if occupied else ()), "busiest_spot_m",
        "over_20_percent_m", "busiest_begin_utc", "busiest_begin_local", "busiest_end_utc",
        f"busiest_{measure}", *(("busiest_occupancy_se", *_HITS) if occupied else ()),
    )  # fmt: skip
    digits = {
        "length_m": 2, "base_m": 2, "part_s": 2, "base_s": 2, "share": 6,
        **({"share_se": 6} if occupied else {}), "busiest_spot": 6,
        **({"busiest_spot_se": 6} if occupied else {}), "busiest_spot_m": 2, "busy_m": 2,
    }  # fmt: skip
    busiest = ("busiest_share", *(("busiest_share_se",) if occupied else ()))
    hits = {"hit_s": 2, "observed_s": 2, "hit_share": 6} if occupied else {}
    rows = []
    for _, row in table.iterrows():
        begin, end, lanelets = row["busiest_begin"], row["busiest_end"], row["lanelets"]
        times = ("", "", "") if pd.isna(begin) else (utc(begin), clock.iso(begin), utc(end))
        rows.append(
            (
                int(row["lane"]),
                *(
                    (row["rank"] or "", row["tracks"] if row["tracks"] >= 0 else "")
                    if occupied
                    else ()
                ),
                lanelets[0] if len(lanelets) == 1 else " ".join(map(str, lanelets)),
                row["subtype"],
                row.get("street", ""),
                row.get("street_part", ""),
                wind_of(row["east_m"], row["north_m"]) or NO_FIGURE,
                *(round(float(row[name]), number) for name, number in digits.items()),
                *times,
                *(round(float(row[name]), 6) for name in busiest),
                *(round(float(row[name]), number) for name, number in hits.items()),
            )
        )
    write_csv(path, header, rows)


def write_lane_intervals(path: Path, heat: HeatMap, sums: LaneSums, clock: Clock) -> None:
    """Write one row a lane and interval, also where nothing was hit or seen."""
    occupied = heat.measure == "occupancy"
    header = (
        "lane", "begin_utc", "end_utc", "begin_local",
        *(_OCCUPIED if occupied else ()), *_HITS,
    )  # fmt: skip
    rows = (
        (
            lane.number,
            *times,
            *(cell for part in parts for cell in _cells(*(each[k] for each in part))),
        )
        for i, (begin, end) in enumerate(heat.timeline.spans())
        for times in [(utc(begin), utc(end), clock.iso(begin))]
        for shown in [(sums.part_s[i], sums.base_s[i], *((sums.error_s[i],) if occupied else ()))]
        for parts in [(shown, sums.of(hits_of(heat, i))[:2]) if occupied else (shown,)]
        for k, lane in enumerate(sums.lanes)
    )
    write_csv(path, header, rows)


def _cells(part_s: float, base_s: float, *error_s: float) -> tuple[float | str, ...]:
    """Return seconds and share, and the error of the share where it is given."""
    if not base_s:
        return "", 0.0, "", *("" for _ in error_s)
    shares = (round(float(each / base_s), 6) for each in (part_s, *error_s))
    return round(float(part_s), 2), round(float(base_s), 2), *shares

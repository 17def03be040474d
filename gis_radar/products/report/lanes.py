"""Lanes: chains of lanelets, and how busy each of them is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import NO_FIGURE, Clock, Floats, Integers, wind_of, write_csv
from gis_radar.dataset import Dataset
from gis_radar.hdmap import LANE_COLUMN, LANE_EXIT_M, Lane, lanes_of, quads
from gis_radar.measures import LaneNetwork
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.heatmap.intervals import When
from gis_radar.products.heatmap.occupancy import surest
from gis_radar.products.report.content import utc

BUSY = 0.2  # least share of a busy tile; a class break of all heat maps
# Compared with each other are lanes that are known well enough.
LEAST_FOLLOWED = 10  # of vehicles that followed it: of ten, chance alone moves a share by a third
LEAST_SEEN = 0.5  # share of its length: less may be its queue alone, or all but its queue
MOST_ERROR = 0.5  # standard error, as a share of the occupancy: beyond, 0 is within two of them
FAR_M = 100.0  # distance from every sensor, beyond which the accuracy of volumes is not measured


def part_and_base(heat: HeatMap, interval: When = None) -> tuple[Floats, Floats]:
    """Return the two times whose quotient is the share of each tile, seconds.

    They are occupied and visible, or hit and observed where no vehicles are known.

    Parameters
    ----------
    heat : HeatMap
        The heat map.
    interval : optional
        The interval, as for :meth:`HeatMap.shares`.
    """
    known = heat.occupancy_shares(interval)
    if known is None:
        hits = heat.shares(interval)
        return hits.hit_s, hits.observed_s
    return known.occupied_s, known.visible_s


# The columns by which lanes are compared, as `HeatMap.by_lane` has them, and as `lane_table` does.
_SHARES = {
    "occupancy": ("occupied_s", "visible_s", "occupancy", "occupancy_se"),
    "hit_share": ("hit_s", "observed_s", "hit_share"),
}
_NAMES = ("part_s", "base_s", "share", "share_se")


def sums_of(heat: HeatMap, *, each: bool = False) -> pd.DataFrame:
    """Return the sums of each lane over the whole time, or of each lane in each interval.

    Parameters
    ----------
    heat : HeatMap
        The heat map.
    each : bool
        Whether each interval has its own rows, as for :meth:`HeatMap.by_lane`.

    Returns
    -------
    DataFrame
        The table of :meth:`HeatMap.by_lane`, with seconds summed over the tiles of a lane: `part_s`
        and `base_s`, occupied and visible (hit and observed without vehicles); `share`, their
        quotient, NaN where there is none, and its standard error `share_se`, NaN for hits; `hit_s`,
        `observed_s`, `hit_share`.
    """
    table = heat.by_lane(each=each)
    tiles = {lane.number: len(lane.rows) for lane in lanes_of(heat.tiles)}
    count = table.index.get_level_values(LANE_COLUMN).map(tiles).to_numpy()
    table = table.assign(**{str(n): table[n] * count for n in table if str(n).endswith("_s")})
    shown = zip(_NAMES, _SHARES[heat.measure], strict=False)
    return table.assign(**{"share_se": np.nan} | {name: table[of] for name, of in shown})


def tracks_of(dataset: Dataset, lanes: Sequence[Lane]) -> Integers | None:
    """Return how many tracks of vehicles followed each lane; None where that is not known."""
    if not dataset.has_vehicles:
        return None
    lane_of = {lanelet: i for i, lane in enumerate(lanes) for lanelet in lane.lanelets}
    counts = np.zeros(len(lanes), np.int64)
    for lanelets in dataset.vehicles()["lanelets"]:
        for i in {lane_of[int(each)] for each in lanelets if int(each) in lane_of}:
            counts[i] += 1
    return counts


def lane_table(
    heat: HeatMap, by_interval: pd.DataFrame, tracks: Integers | None = None
) -> pd.DataFrame:
    """Return one row a lane: those that are ranked by their occupancy, then the others.

    Hits are not ranked: their lanes stay in the order of their numbers. What was not visible
    (observed) comes last.

    Parameters
    ----------
    heat : HeatMap
        The heat map.
    by_interval : DataFrame
        Its sums by lane and interval, from :func:`sums_of`.
    tracks : array, optional
        Number of tracks that followed each lane, from :func:`tracks_of`.

    Returns
    -------
    DataFrame
        `lane` and the columns of :func:`sums_of`; `lanelets`, `subtype`, `east_m` and `north_m`
        along its last metres, `length_m`; `base_m`, the length of its tiles with a share;
        `busiest_spot`, the share of the tile of :func:`surest`, its standard error
        `busiest_spot_se` (NaN for hits), and `busiest_spot_m`, where along the lane; `busy_m`, the
        length of tiles with a share of 20 % or more; `busiest_begin`, `busiest_end`,
        `busiest_share`, `busiest_share_se` of the busiest interval, of those with at least half as
        much seen as in the best seen; `tracks` of vehicles, -1 where not known; `rank`, from 1, 0
        of those that are not ranked, and `why`.
    """
    tiles, shares, known = heat.tiles, heat.shown(), heat.occupancy_shares()
    error = np.full(len(tiles), np.nan) if known is None else known.occupancy_se
    length, centre = tiles["length_m"].to_numpy(np.float64), quads(tiles).mean(axis=1)
    by_lane = {int(str(lane)): rows for lane, rows in by_interval.groupby(level=LANE_COLUMN)}
    rows = []
    for i, lane in enumerate(lanes_of(tiles)):
        shares_of_lane, lengths = shares[lane.rows], length[lane.rows]
        seen = np.isfinite(shares_of_lane)
        top = surest(shares_of_lane, error[lane.rows]) if seen.any() else 0
        before = int(np.searchsorted(np.cumsum(lengths[::-1]), LANE_EXIT_M))
        east, north = centre[lane.rows[-1]] - centre[lane.rows[max(len(lengths) - 1 - before, 0)]]
        top_m = lengths[: top + 1].sum() - lengths[top] / 2
        rows.append(
            {
                "lanelets": lane.lanelets,
                "subtype": str(tiles["subtype"].iloc[lane.rows[0]]),
                "east_m": float(east),
                "north_m": float(north),
                "busiest_spot": shares_of_lane[top],
                "busiest_spot_se": error[lane.rows[top]] if seen.any() else np.nan,
                "busiest_spot_m": top_m if seen.any() else np.nan,
                "busy_m": lengths[shares_of_lane >= BUSY].sum() if seen.any() else np.nan,
                "tracks": -1 if tracks is None else int(tracks[i]),
                **_busiest(heat, by_lane[lane.number]),
            }
        )
    sums = sums_of(heat).reset_index().rename(columns={"seen_m": "base_m"})
    return _in_order(pd.concat([sums, pd.DataFrame(rows)], axis=1), heat.measure)


def _in_order(table: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the lanes in the order of the report's table, with their ranks."""
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
        "tracks": row["tracks"] < LEAST_FOLLOWED,
        "error": not row["share_se"] <= MOST_ERROR * row["share"],
    }
    return next((name for name, applies in reasons.items() if applies), "")


def _busiest(heat: HeatMap, rows: pd.DataFrame) -> dict[str, object]:
    """Return the busiest interval of a lane; missing values for a single one, or shares of 0."""
    base = rows["base_s"].to_numpy(np.float64)
    is_fair = (base > 0) & (base >= 0.5 * base.max(initial=0.0))
    share = np.where(is_fair, rows["share"], -1.0)
    if len(rows) < 2 or not share.max() > 0.0:
        none = dict.fromkeys(("busiest_share", "busiest_share_se"), np.nan)
        return {"busiest_begin": pd.NaT, "busiest_end": pd.NaT, **none}
    best = int(share.argmax())
    begin, end = heat.timeline.span(best)
    return {
        "busiest_begin": pd.Timestamp(begin),
        "busiest_end": pd.Timestamp(end),
        "busiest_share": share[best],
        "busiest_share_se": rows["share_se"].iloc[best],
    }


def far_lanes(rows: gpd.GeoDataFrame, network: LaneNetwork, poses: gpd.GeoDataFrame) -> list[int]:
    """Return the counted lanes whose line lies over `FAR_M` from every sensor.

    Parameters
    ----------
    rows : GeoDataFrame
        Rows of :meth:`gis_radar.Dataset.traffic`.
    network : LaneNetwork
        The lanes.
    poses : GeoDataFrame
        The sensors.
    """
    counted = rows[rows["counted"].notna()]
    at = np.searchsorted(network.lane, counted["lane"].to_numpy(np.int64))
    line = counted.geometry.interpolate(network.line_m[at] / network.length_m[at], normalized=True)
    far = [poses.distance(place).min() > FAR_M for place in line]
    return [int(lane) for lane in counted.loc[far, "lane"]]


# The tables: of occupancy, with hits as the last columns; of hits where no vehicles are known.
# Each column of a file by its name, and its digits.

_HITS = {"hit_s": ("hit_tile_s", 2), "observed_s": ("observed_tile_s", 2), "hit_share": ("", 6)}
_OCCUPIED = {
    "part_s": ("occupied_tile_s", 2), "base_s": ("visible_tile_s", 2),
    "share": ("occupancy", 6), "share_se": ("occupancy_se", 6),
}  # fmt: skip
_LANE = {"lane": ("", 0), "name": ("", 0), "rank": ("", 0), "tracks": ("", 0), "lanelets": ("", 0),
         "subtype": ("", 0), "street": ("", 0), "street_part": ("", 0), "leads_to": ("", 0),
         "length_m": ("", 2)}  # fmt: skip
_BUSIEST = {
    "busiest_spot": ("", 6), "busiest_spot_se": ("", 6), "busiest_spot_m": ("", 2),
    "busy_m": ("over_20_percent_m", 2), "busiest_begin_utc": ("", 0),
    "busiest_begin_local": ("", 0), "busiest_end_utc": ("", 0),
}  # fmt: skip
_OF_VEHICLES = {"rank", "tracks", "busiest_spot_se"}


def write_lanes(path: Path, table: pd.DataFrame, clock: Clock, measure: str) -> None:
    """Write all lanes: one row each, shares from 0 to 1, empty where there is none."""
    highest = {"busiest_share": (f"busiest_{measure}", 6)}
    if measure == "occupancy":
        highest |= {"busiest_share_se": ("busiest_occupancy_se", 6)}
        columns = {**_LANE, "base_m": ("visible_m", 2), **_OCCUPIED, **_BUSIEST, **highest, **_HITS}
    else:
        columns = {**_LANE, "base_m": ("observed_m", 2), **_HITS, **_BUSIEST, **highest}
        columns = {name: column for name, column in columns.items() if name not in _OF_VEHICLES}
    begins, ends = table["busiest_begin"], table["busiest_end"]
    towards = zip(table["east_m"], table["north_m"], strict=True)
    shown = table.assign(
        rank=table["rank"].astype(object).where(table["rank"] > 0),
        tracks=table["tracks"].astype(object).where(table["tracks"] >= 0),
        lanelets=[each[0] if len(each) == 1 else " ".join(map(str, each))
                  for each in table["lanelets"]],
        **{name: table.get(name, "") for name in ("name", "street", "street_part")},
        leads_to=[wind_of(*each) or NO_FIGURE for each in towards],
        busiest_begin_utc=["" if pd.isna(each) else utc(each) for each in begins],
        busiest_begin_local=["" if pd.isna(each) else clock.iso(each) for each in begins],
        busiest_end_utc=["" if pd.isna(each) else utc(each) for each in ends],
    )  # fmt: skip
    _write(path, shown, columns)


def write_lane_intervals(
    path: Path, heat: HeatMap, by_interval: pd.DataFrame, clock: Clock
) -> None:
    """Write one row a lane and interval, also where nothing was hit or seen."""
    rows = by_interval.reset_index()
    times = [(utc(begin), utc(end), clock.iso(begin)) for begin, end in heat.timeline.spans()]
    lanes = len(rows) // len(times)
    for k, name in enumerate(("begin_utc", "end_utc", "begin_local")):
        rows[name] = np.repeat([each[k] for each in times], lanes)
    named = dict.fromkeys(("lane", "begin_utc", "end_utc", "begin_local"), ("", 0))
    _write(path, rows, {**named, **(_OCCUPIED if heat.measure == "occupancy" else {}), **_HITS})


def _write(path: Path, table: pd.DataFrame, columns: Mapping[str, tuple[str, int]]) -> None:
    """Write columns of a table under their names, rounded."""
    digits = {name: number for name, (_, number) in columns.items() if number}
    names = [name or of for of, (name, _) in columns.items()]
    write_csv(path, table[[*columns]].round(digits).set_axis(names, axis=1))

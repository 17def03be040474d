"""Match the lanes of an old map to those of a new one, so that time series can be continued."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely
from scipy.spatial import cKDTree

from gis_radar.base import Floats, InputError, Integers, atomic_write, opened_package, write_csv
from gis_radar.dataset.dataset import Dataset, open_dataset
from gis_radar.hdmap import LANES_LAYER

_SPACING_M = 0.5  # distance between the points at which lanes are compared
_MOST_OFFSET_M = 1.5  # maps are drawn anew to some decimetres, lanes are 2.5 m and wider
_MOST_TURN_RAD = math.radians(30.0)  # largest angle between two lanes
_SAME_SHARE = 0.9  # least share of both lanes that follows the other where they are the same
_LEAST_SHARE = 0.1  # least share of either lane for a row of the table
_COLUMNS = ("old_lane", "new_lane", "share_of_old", "share_of_new", "offset_m", "same")


class _Points(NamedTuple):
    """Points along lanes, every `_SPACING_M`.

    Parameters
    ----------
    lane : (n,) int64 array
        Position of the lane.
    xy, along : (n, 2) float64 arrays
        Place, metres, and direction of the lane there, of length 1.
    """

    lane: Integers
    xy: Floats
    along: Floats

    @classmethod
    def of(cls, lanes: gpd.GeoDataFrame) -> _Points:
        lines = np.asarray(lanes.geometry.force_2d())
        count = np.maximum(np.ceil(shapely.length(lines) / _SPACING_M).astype(np.int64), 1)
        lane = np.repeat(np.arange(len(lines)), count)
        number = np.arange(len(lane)) - np.repeat(np.cumsum(count) - count, count)
        share = (number + 0.5) / count[lane]
        half = 0.5 / count[lane]
        place, before, after = (
            shapely.get_coordinates(
                shapely.line_interpolate_point(lines[lane], at, normalized=True)
            )
            for at in (share, share - half, share + half)
        )
        along = after - before
        length = np.maximum(np.hypot(*along.T), 1e-9)
        return cls(lane=lane, xy=place, along=along / length[:, None])


def match_lanes(
    old: Dataset | gpd.GeoDataFrame | str | Path, new: Dataset | gpd.GeoDataFrame | str | Path
) -> pd.DataFrame:
    """Match the lanes of an old map to those of a new one, by where they lie and lead.

    Two lanes follow each other where they lie within 1.5 m and lead the same way, to 30 degrees.
    They are the same where 90 % of both do; each lane is the same as one at most. A lane without
    such a partner has a row for each lane with which it shares a tenth or more: its parts, where it
    was split, or the lane that it was merged into.

    Parameters
    ----------
    old, new : Dataset, GeoDataFrame, str or Path
        A dataset or its folder, a file of tiles with the layer `lanes`, or such a layer.

    Returns
    -------
    DataFrame
        `old_lane`, null for a new lane that follows none; `new_lane`, null for a lane that is gone;
        `share_of_old`, `share_of_new`, how much of each follows the other; `offset_m`, the mean
        distance there; `same`.

    Raises
    ------
    InputError
        If there are no lanes.

    Examples
    --------
    >>> import gis_radar as gr
    >>> lanes = gr.read_map(gr.sample_folder() / "junction.osm").lanes()
    >>> bool(gr.match_lanes(lanes, lanes)["same"].all())
    True
    """
    before, after = _lanes(old), _lanes(new)
    if before.crs != after.crs:
        after = after.to_crs(before.crs)
    pairs = _near_pairs(_Points.of(before), _Points.of(after), len(before), len(after))
    numbers = [np.asarray(each["lane"], np.int64) for each in (before, after)]
    identical = _identical_lanes(pairs, *numbers)
    matched = pairs[identical]
    is_free = ~(pairs["old"].isin(matched["old"]) | pairs["new"].isin(matched["new"]))
    is_worth = pairs[["share_of_old", "share_of_new"]].max(axis=1) >= _LEAST_SHARE
    rows = pairs.assign(same=identical)[identical | (is_free & is_worth)]
    unmatched = [
        pd.DataFrame({side: np.setdiff1d(np.arange(len(ids)), rows[side])})
        for side, ids in zip(("old", "new"), numbers, strict=True)
    ]
    rows = pd.concat([rows, *unmatched], ignore_index=True).sort_values(["old", "new"])
    for side, ids in zip(("old", "new"), numbers, strict=True):
        at = rows[side].astype("Int64")
        rows[f"{side}_lane"] = at.map(dict(enumerate(ids.tolist()))).astype("Int64")
    rows = rows.assign(same=rows["same"].eq(True))
    shares = ["share_of_old", "share_of_new"]
    rows[shares] = rows[shares].fillna(0.0).round(3)
    rows["offset_m"] = rows["offset_m"].round(2)
    return rows.reset_index(drop=True)[[*_COLUMNS]]


def write_lane_matches(table: pd.DataFrame, path: Path) -> None:
    """Write the table of :func:`match_lanes` as CSV."""
    with atomic_write(path) as part:
        write_csv(part, table)


def _lanes(source: Any) -> gpd.GeoDataFrame:
    try:
        if isinstance(source, gpd.GeoDataFrame):
            lanes = source
        elif isinstance(source, Dataset) or Path(source).is_dir():
            lanes = open_dataset(source).lanes()
        else:
            with opened_package(source, what="tiles with their lanes") as place:
                lanes = pyogrio.read_dataframe(place, layer=LANES_LAYER, use_arrow=True)
    except InputError as error:
        if LANES_LAYER not in str(error.message):
            raise
        lanes = gpd.GeoDataFrame()
    if "lane" not in lanes.columns or not len(lanes):
        named = "GeoDataFrame" if isinstance(source, gpd.GeoDataFrame) else source
        named = source.folder if isinstance(source, Dataset) else named
        raise InputError("{}: holds no lanes", named, hint="it was measured without a map")
    return lanes


def _near_pairs(old: _Points, new: _Points, olds: int, news: int) -> pd.DataFrame:
    """Return, for all pairs of lanes near each other, the share of each that follows the other."""
    reach = math.hypot(_MOST_OFFSET_M, _SPACING_M)
    near = cKDTree(old.xy).sparse_distance_matrix(cKDTree(new.xy), reach, output_type="ndarray")
    old_point, new_point = near["i"], near["j"]
    along = np.einsum("ij,ij->i", old.along[old_point], new.along[new_point])
    across = new.xy[new_point] - old.xy[old_point]
    offset = np.abs(across[:, 0] * old.along[old_point, 1] - across[:, 1] * old.along[old_point, 0])
    follows = (along >= math.cos(_MOST_TURN_RAD)) & (offset <= _MOST_OFFSET_M)
    old_point, new_point, offset = old_point[follows], new_point[follows], offset[follows]
    pair_key = old.lane[old_point] * news + new.lane[new_point]
    groups = pd.DataFrame(
        {"pair": pair_key, "i": old_point, "j": new_point, "offset_m": offset}
    ).groupby("pair")
    rows = groups.agg(i=("i", "nunique"), j=("j", "nunique"), offset_m=("offset_m", "mean"))
    rows = rows.reset_index()
    rows["old"], rows["new"] = rows["pair"] // news, rows["pair"] % news
    rows["share_of_old"] = rows["i"] / np.bincount(old.lane, minlength=olds)[rows["old"]]
    rows["share_of_new"] = rows["j"] / np.bincount(new.lane, minlength=news)[rows["new"]]
    return rows


def _identical_lanes(pairs: pd.DataFrame, old: Integers, new: Integers) -> pd.Series:
    """Return which pairs are the same lane: nearest pairs first, each lane in one at most."""
    alike = pairs[pairs[["share_of_old", "share_of_new"]].min(axis=1) >= _SAME_SHARE]
    # of two lanes at one place, that with the same number comes first
    other_number = old[alike["old"]] != new[alike["new"]]
    order = alike.assign(offset=alike["offset_m"].round(1), other=other_number)
    order = order.sort_values(["offset", "other", "old", "new"])
    matched: tuple[set[int], set[int]] = (set(), set())
    identical = pd.Series(False, pairs.index)
    for row, before, after in order[["old", "new"]].itertuples():
        if before not in matched[0] and after not in matched[1]:
            matched[0].add(before)
            matched[1].add(after)
            identical[row] = True
    return identical

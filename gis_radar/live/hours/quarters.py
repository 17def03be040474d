"""Measures by quarter of an hour: of tiles in the last one, of lanes over the last day.

They are read from the dataset or, while the hour is not over, from provisional quarters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import STEP_S, Floats, Integers, quotient, step_begin
from gis_radar.dataset import STEPS_PER_QUARTER, TILE_COUNTS, Dataset, TrafficReader
from gis_radar.products import lane_totals, lanes_with_tiles

QUARTERS_KEPT = 96  # a day
TRAFFIC_FIELDS = (
    "visible_share", "counted", "volume", "volume_se", "speed_kmh", "occupancy", "queue_max_m",
)  # fmt: skip
"""Columns of the traffic of a lane, as in :meth:`gis_radar.Dataset.traffic`."""


@dataclass(frozen=True, kw_only=True)
class QuarterMeasures:
    """Measures of tiles and lanes in one quarter of an hour.

    Parameters
    ----------
    until_step : int
        Its last step.
    visible, occupied : (n,) int64 arrays
        Steps in which each tile was visible, and occupied while visible, by position.
    lanes : DataFrame
        `lane, hit_s, observed_s` (means of its tiles); with vehicles also
        `TRAFFIC_FIELDS`.
    """

    until_step: int
    visible: Integers
    occupied: Integers
    lanes: pd.DataFrame

    def occupancy(self) -> Floats:
        """Return the occupancy of each tile, NaN where it was not visible."""
        return quotient(self.occupied, self.visible)


class Quarters:
    """The quarters of the last day; safe to read from another thread."""

    def __init__(self) -> None:
        self.measured: list[QuarterMeasures] = []  # in order

    def add(self, found: Iterable[QuarterMeasures]) -> None:
        """Add quarters; they replace earlier measures of the same ones."""
        known = {each.until_step: each for each in (*self.measured, *found)}
        self.measured = [known[step] for step in sorted(known)[-QUARTERS_KEPT:]]

    def newest(self) -> QuarterMeasures | None:
        """Return the newest quarter with vehicles; None where there is none."""
        return next((each for each in reversed(self.measured) if "volume" in each.lanes), None)

    def intervals(self) -> pd.DataFrame:
        """Return the lanes of all quarters, with `begin` and `end`."""
        tables = [
            each.lanes.assign(
                begin=step_begin(each.until_step + 1 - STEPS_PER_QUARTER),
                end=step_begin(each.until_step + 1),
            )
            for each in self.measured
        ]
        return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def read_quarters(
    dataset: Dataset, tiles: gpd.GeoDataFrame, quarters: Sequence[int]
) -> list[QuarterMeasures]:
    """Read the measures of quarters, of those that the dataset has.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    tiles : GeoDataFrame
        Its tiles.
    quarters : sequence of int
        Quarters since 1970, ascending.
    """
    if not quarters:
        return []
    span = (quarters[0] * STEPS_PER_QUARTER, (quarters[-1] + 1) * STEPS_PER_QUARTER - 1)
    parts: list[pd.DataFrame] = [part.to_pandas() for part in dataset.batches(TILE_COUNTS, span)]
    if not parts:
        return []
    counts = pd.concat(parts, ignore_index=True)
    traffic = None
    if dataset.has_vehicles:
        traffic = TrafficReader(dataset=dataset, span=span).lanes()
    measures = []
    for quarter in quarters:
        begin = quarter * STEPS_PER_QUARTER
        of_quarter = counts[counts["first_step"] == begin]
        if len(of_quarter):
            traffic_of_quarter = (
                None if traffic is None else traffic[traffic["begin"] == step_begin(begin)]
            )
            measures.append(_quarter_measures(begin, of_quarter, traffic_of_quarter, tiles))
    return measures


def _quarter_measures(
    begin: int, counts: pd.DataFrame, traffic: pd.DataFrame | None, tiles: gpd.GeoDataFrame
) -> QuarterMeasures:
    """Return the measures of a quarter from its counts by tile and its traffic by lane."""
    ids = tiles["tile_id"].to_numpy(np.int64)
    place = np.searchsorted(ids, counts["tile_id"].to_numpy(np.int64))
    lanes, lane_of_tile = lanes_with_tiles(tiles)
    number_of_tiles = np.maximum(np.bincount(lane_of_tile, minlength=len(lanes)), 1)
    steps: dict[str, Integers] = {}
    for name in ("hit", "observed", "occupied", "visible"):
        steps[name] = np.zeros(len(ids), np.int64)
        steps[name][place] = counts[f"{name}_steps"].fillna(0).to_numpy(np.int64)
    table = pd.DataFrame({"lane": [lane.number for lane in lanes]})
    for name in ("hit", "observed"):
        total = lane_totals(steps[name].astype(float), lane_of_tile, len(lanes))
        table[f"{name}_s"] = total / number_of_tiles * STEP_S
    if traffic is not None:
        table = table.join(traffic.set_index("lane")[[*TRAFFIC_FIELDS]].astype(float), on="lane")
    return QuarterMeasures(
        until_step=begin + STEPS_PER_QUARTER - 1, visible=steps["visible"],
        occupied=steps["occupied"], lanes=table,
    )  # fmt: skip

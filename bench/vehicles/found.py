"""Found vehicles with their passages and occupancy: those of a dataset, or of a peer.

A peer finds states alone. The tiles that these occupy and the lanelets that they pass follow by the
same code as the truth's, over the steps that are truly visible: only the vehicles differ.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import geopandas as gpd
import numpy as np
import pandas as pd
from passages import lanes_of, true_passages
from scenes import SceneFiles
from tracks import COLUMNS
from true_occupancy import TrueOccupancy, occupied_steps
from true_traffic import TrueTraffic

import gis_radar as gr
from gis_radar.base import Booleans
from gis_radar.dataset import PASSAGES, states_of
from gis_radar.dataset.files.tables import CONTINUED

ESTIMATES = ["tile_id", "occupied_s", "visible_s", "occupancy", "occupancy_se"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Found vehicles, their passages and occupancy.

    Parameters
    ----------
    states : DataFrame
        `tracks.COLUMNS` at each step.
    passages : DataFrame
        `lanelet_id step`.
    occupancy : DataFrame
        `tile_id occupied_s visible_s occupancy` of the visible tiles; of a dataset `occupancy_se`,
        too.
    """

    states: pd.DataFrame = field(repr=False)
    passages: pd.DataFrame = field(repr=False)
    occupancy: pd.DataFrame = field(repr=False)


def found_in(dataset: gr.Dataset) -> Found:
    """Return the vehicles of a dataset."""
    passages = pd.concat(each.to_pandas() for each in dataset.batches(PASSAGES))
    return Found(
        states=estimated_states(dataset), passages=passages[["lanelet_id", "step"]],
        occupancy=estimated_occupancy(dataset),
    )  # fmt: skip


def estimated_states(dataset: gr.Dataset) -> pd.DataFrame:
    """Return the states of a dataset's vehicles at each step; numbers go on over the hours."""
    parts = []
    for vehicles, states in states_of(dataset):
        length = states["vehicle"].map(vehicles.set_index("vehicle")["length_m"])
        parts.append(states.assign(length=length, heading=np.radians(states["heading"])))
    table = pd.concat(parts, ignore_index=True)[list(COLUMNS)]
    joined: dict[int, int] = {}
    for rows in dataset.batches(CONTINUED):
        pairs = zip(rows["vehicle"].to_pylist(), rows["next"].to_pylist(), strict=True)
        joined |= {later: joined.get(one, one) for one, later in pairs}
    return table.assign(vehicle=table["vehicle"].replace(joined))


def estimated_occupancy(dataset: gr.Dataset) -> pd.DataFrame:
    """Return `ESTIMATES` of the tiles that were visible, as a heat map states them."""
    wide = gr.make_heatmap(dataset).wide()
    return pd.DataFrame(wide.loc[wide["visible_s"] > 0.0, ESTIMATES])


def found_by_peer(site: SceneFiles, states: pd.DataFrame) -> Found:
    """Return the vehicles of a peer on a scene, from its states: `COLUMNS` and `width`."""
    lanes = lanes_of(site.tiles(), gr.read_map(site.map))
    traffic, truth = traffic_of_states(states), site.truth()
    occupied = occupied_by(traffic, site.tiles(), truth)
    table = replace(truth, occupied=occupied).table()
    return Found(
        states=states[list(COLUMNS)],
        passages=true_passages(lanes, traffic, truth)[["lanelet_id", "step"]],
        occupancy=table[table["visible_s"] > 0.0],
    )  # fmt: skip


def traffic_of_states(states: pd.DataFrame) -> TrueTraffic:
    """Return states as traffic without heights, so that they occupy tiles of every level."""
    reach, heading = states["length"] / 2.0, states["heading"]
    table = states.assign(
        front_e=states["easting"] + reach * np.cos(heading),
        front_n=states["northing"] + reach * np.sin(heading), height=np.nan,
    ).sort_values(["vehicle", "step"], ignore_index=True)  # fmt: skip
    return TrueTraffic(states=table, bodies=table, kinds={})


def occupied_by(traffic: TrueTraffic, tiles: gpd.GeoDataFrame, truth: TrueOccupancy) -> Booleans:
    """Return (tiles, steps) as in the truth: which tiles traffic occupies."""
    count = truth.occupied.shape[1]
    inside = traffic.within(truth.first_step, truth.first_step + count - 1)
    seen = tiles[tiles["tile_id"].isin(truth.tile_id)]
    return occupied_steps(seen, inside, truth.first_step, count)

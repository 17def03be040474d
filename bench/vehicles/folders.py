"""Folders of vehicles from states: what a peer found, or the true traffic itself.

The package's own engine makes covered and visible tiles and passages of them, with sight from the
scene's scan, as it does of the package's own vehicles: what differs is the vehicles alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
from passages import Lanes, followed, lanes_of
from scenes import SceneFiles
from scipy.spatial import cKDTree
from true_traffic import HEAVY_M

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.sight import SightScan, SightTiles, describe_sight, find_sight
from gis_radar.steps import step_of
from gis_radar.tiles import fingerprint
from gis_radar.vehicles.folder import VehiclePiece, write_vehicles
from gis_radar.vehicles.map_check import describe_map
from gis_radar.vehicles.provenance import Provenance
from gis_radar.vehicles.visibility import SensorView

HOLD_S = 0.1
VIEW = "bench"
NEAR_M = 12.0  # states farther from all tiles are left out


@dataclass(frozen=True, kw_only=True)
class Ground:
    """What folders of a scene have in common.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    lanes : Lanes
        The lanelets as tiles.
    views : list of SensorView
        Where sensors stand, and what they have in sight by the scan.
    frames : DataFrame
        `sensor view first_step last_step`.
    provenance : Provenance
        Of the folder.
    """

    tiles: gpd.GeoDataFrame
    lanes: Lanes
    views: list[SensorView]
    frames: pd.DataFrame
    provenance: Provenance


def ground_of(site: SceneFiles, poses: Sequence[gr.Pose]) -> Ground:
    """Return what all folders of a scene share, with sensors at some poses."""
    tiles, roads = site.tiles(), gr.read_map(site.map)
    road = SightTiles.of(tiles)
    scan = SightScan([site.scan], road)
    views, frames, sources = [], [], []
    for pose, path in zip(poses, site.recordings, strict=True):
        seen = find_sight(pose, road, scan).seen
        views.append(
            SensorView(sensor=pose.sensor, view=VIEW, tile_id=seen, position=pose.position)
        )
        frames.append(_runs(pose.sensor, path))
        sources.append({"recording": path.name, "sensor": pose.sensor, "poses": [pose.as_dict()]})
    provenance = Provenance(
        fingerprint=fingerprint(tiles),
        map=describe_map(site.map, roads, tiles),
        sight=describe_sight(scan),
        hold_s=dict.fromkeys((pose.sensor for pose in poses), HOLD_S),
        sources=sources,
    )
    lanes = lanes_of(tiles, roads)
    return Ground(
        tiles=tiles, lanes=lanes, views=views, frames=pd.concat(frames, ignore_index=True),
        provenance=provenance,
    )  # fmt: skip


def _runs(sensor: str, path: Path) -> pd.DataFrame:
    """Return the runs of steps with a frame."""
    step = np.unique(step_of(np.unique(pd.read_parquet(path, columns=["time"])["time"])))
    begins = np.flatnonzero(np.diff(step, prepend=step[0] - 2) > 1)
    last = step[np.append(begins[1:], len(step)) - 1]
    return pd.DataFrame(
        {"sensor": sensor, "view": VIEW, "first_step": step[begins], "last_step": last}
    )


def write_states(ground: Ground, states: pd.DataFrame, folder: Path) -> Path:
    """Write a folder of vehicles from their states.

    Parameters
    ----------
    ground : Ground
        Of the scene.
    states : DataFrame
        ``vehicle step easting northing heading`` (rad) ``speed length width seen``; after steps
        left out, a vehicle is another one.
    folder : Path
        Where.
    """
    first = int(ground.frames["first_step"].min())
    last = int(ground.frames["last_step"].max())
    inside = states[states["step"].between(first, last)]
    tracks = on_lanes(ground, whole(inside))
    by_vehicle = tracks.groupby("vehicle")
    size = by_vehicle[["length", "width"]].first()
    vehicles = pd.DataFrame(
        {
            "vehicle": size.index, "first_step": by_vehicle["step"].min(),
            "last_step": by_vehicle["step"].max(), "length_m": size["length"],
            "width_m": size["width"], "length_sigma_m": 0.5,
            "p_heavy": (size["length"] > HEAVY_M).astype(float),
            "lanelets": by_vehicle["lanelet_id"].agg(lambda c: c.dropna().unique().tolist()),
            "continues": False,
        }
    ).reset_index(drop=True)  # fmt: skip
    tracks = tracks.assign(heading=np.degrees(tracks["heading"]))
    piece = VehiclePiece(
        first_step=first, last_step=last, vehicles=vehicles, frames=ground.frames,
        tracks=tracks.sort_values(["step", "vehicle"], ignore_index=True),
    )  # fmt: skip
    with write_vehicles(
        folder, tiles=ground.tiles, views=ground.views, provenance=ground.provenance
    ) as writer:
        writer.add(piece)
    return folder


def whole(states: pd.DataFrame) -> pd.DataFrame:
    """Return states by vehicle and step, with new numbers: one for each run of steps."""
    states = states.sort_values(["vehicle", "step"], ignore_index=True)
    begins = (states["vehicle"].diff() != 0) | (states["step"].diff() != 1)
    return states.assign(vehicle=begins.cumsum().to_numpy(np.int64) - 1)


def on_lanes(ground: Ground, states: pd.DataFrame) -> pd.DataFrame:
    """Return states with ``lanelet_id s_m d_m``, those far from all lanes left out.

    Only from a vehicle's first to its last state near a lane.
    """
    tree = cKDTree(ground.lanes.middle)
    ahead = np.column_stack([np.cos(states["heading"]), np.sin(states["heading"])])
    front = states[["easting", "northing"]].to_numpy() + ahead * (
        states["length"].to_numpy()[:, None] / 2.0
    )
    near = np.isfinite(tree.query(front, distance_upper_bound=NEAR_M)[0])
    parts = []
    for known in states.groupby("vehicle").indices.values():
        close = np.flatnonzero(near[known])
        if len(close) == 0:
            continue
        rows = known[close[0] : close[-1] + 1]
        lanelet, s_m, d_m = _placed(ground, tree, front[rows], states["heading"].to_numpy()[rows])
        part = states.iloc[rows]
        parts.append(part.assign(lanelet_id=lanelet, s_m=s_m, d_m=d_m))
    empty = states.iloc[:0].assign(lanelet_id=pd.array([], "Int64"), s_m=0.0, d_m=0.0)
    return pd.concat(parts or [empty], ignore_index=True)


def _placed(
    ground: Ground, tree: cKDTree, front: Floats, heading: Floats
) -> tuple[pd.arrays.IntegerArray, Floats, Floats]:
    """Return lanelet, s and d of fronts along the likeliest way of one vehicle."""
    lanes, count = ground.lanes, len(front)
    looks, chain = followed(lanes, tree, front, heading)
    lanelet = pd.array([None] * count, dtype="Int64")
    s_m, d_m = np.full(count, np.nan), np.full(count, np.nan)
    if len(chain) == 0:
        return lanelet, s_m, d_m
    which = np.clip(np.searchsorted(looks, np.arange(count), side="right") - 1, 0, None)
    for name in {lane for lane, _ in chain}:
        rows = np.flatnonzero(np.array([chain[k][0] == name for k in which]))
        tile, middles = lanes.of_lanelet[name]
        away, index = middles.query(front[rows])
        at = tile[index]
        apart = front[rows] - lanes.middle[at]
        cos, sin = np.cos(lanes.heading[at]), np.sin(lanes.heading[at])
        lanelet[rows] = name
        s_m[rows] = lanes.s_m[at] + cos * apart[:, 0] + sin * apart[:, 1]
        d_m[rows] = cos * apart[:, 1] - sin * apart[:, 0]
        lanelet[rows[away > NEAR_M]] = None
    return lanelet, s_m, d_m


def true_folder(site: SceneFiles) -> Path:
    """Return a folder of the true vehicles, kept: the best that sight and engine allow."""
    folder = site.kept / "true-vehicles"
    if not (folder / "manifest.json").exists():
        states = site.traffic().states.assign(seen=True)
        write_states(ground_of(site, site.poses), states, folder)
    return folder

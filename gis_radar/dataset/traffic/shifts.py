"""Errors that no time averages out: of poses and map, and of a sensor's place beside a lane.

An error of a pose shifts all vehicles of its sensor alike in every step, so that no time averages
it out: an error of yaw across the line of sight, a scale of range along it.

On a simulated motorway with poses drawn from their sigmas of 0.5 m (1 m), as `bench/pose_errors.py`
does, 93 % (85 %) of the tiles lie within two standard errors of the truth where the poses state no
sigmas, so that `POSE_M` is taken, and 96 % (96 %) where they state theirs. Shifts end with the
lanelet.

Vehicles that an error of a pose puts on another lane are counted there: :class:`OtherLanes`. Where
every sensor looks straight across a lane, many are missed: :func:`lanes_across`.
"""

from __future__ import annotations

import json
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import scipy
import shapely

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.hdmap import quads
from gis_radar.measures import LaneNetwork
from gis_radar.poses import Pose, pose_from_dict

# 1 sigma, along and across, of a pose that states none, and, along, of the map: together 0.3 m.
POSE_M = 0.14
MAP_M = float(np.sqrt(0.3**2 - POSE_M**2))
_ALIKE = 0.9  # least cosine between lanes of one direction: 26 degrees
_BESIDE_M = 1.0  # distance beyond a lane's edge of the point that is in the next lane
_MOST_SCALE = 0.01  # largest error of a scale of range that passes a localization
# Cosine between lane and line of sight up to which a sensor looks straight across: a vehicle that
# sets off at 1.5 m/s then has a range rate under 0.15 m/s, like one that stands.
_ACROSS = 0.1
# Share of the vehicles that are missed where all sensors look straight across: 30 of 90 on three
# simulated sites.
MISSED_ACROSS = 0.33


class Shifts(NamedTuple):
    """Common shifts of all vehicles on each tile, 1 sigma, metres.

    Parameters
    ----------
    along, across : (n,) arrays
        Along the lane by map and poses; across it by poses alone, as vehicles keep to the lanes.
    """

    along: Floats
    across: Floats


class OtherLanes(NamedTuple):
    """Lanes on which vehicles are counted if an error of a pose moves them off theirs.

    Parameters
    ----------
    chance : (n,) array
        Probability of that, by position of the lane, at its counting line.
    beside : (2, n) int64 array
        Positions of the lanes to its left and right there; -1 where there is none.
    """

    chance: Floats
    beside: Integers

    @classmethod
    def of(cls, shifts: Shifts, tiles: gpd.GeoDataFrame, network: LaneNetwork) -> OtherLanes:
        """Return the other lanes of a network.

        Parameters
        ----------
        shifts : Shifts
            Shifts of the tiles.
        tiles : GeoDataFrame
            All tiles of the network, by ascending `tile_id`.
        network : LaneNetwork
            The lanes.
        """
        lane, ids = np.full(len(tiles) + 1, -1), tiles["tile_id"].to_numpy(np.int64)
        row = np.searchsorted(ids, network.tile_id)
        lane[row] = network.tile_lane
        line = row[network.tile_at(np.arange(len(network.lane)), network.line_m)]
        return cls(chance_of_others(shifts, tiles)[line], lane[lanes_beside(tiles)[:, line]])

    def variance(self, values: Floats) -> Floats:
        """Return the variance that these lanes add to a measure.

        Parameters
        ----------
        values : (n, ...) array
            The measure, by position of the lane; NaN of a lane beside counts as 0.
        """
        beside_values = np.concatenate([np.nan_to_num(values), np.zeros_like(values[:1])])[
            self.beside
        ]
        spread = ((beside_values - values) ** 2).mean(axis=0)
        return np.asarray((self.chance * spread.T).T)


def shifts_of(poses: pd.DataFrame, sights: pd.DataFrame, tiles: gpd.GeoDataFrame) -> Shifts:
    """Return the shifts by the errors of poses and map.

    Sensors that see a tile weigh the same, with independent errors; poses of a track share theirs.

    Parameters
    ----------
    poses, sights : DataFrame
        Tables of a dataset.
    tiles : GeoDataFrame
        All its tiles, by ascending `tile_id`.
    """
    ids = tiles["tile_id"].to_numpy(np.int64)
    centre, direction = _centres_and_directions(quads(tiles))
    total, sensors = np.zeros((len(ids), 2)), np.zeros(len(ids))
    tiles_of_pose = dict(iter(sights.groupby("pose")["tile_id"]))
    for _, track in poses[poses["pose"].isin(tiles_of_pose.keys())].groupby("sensor"):
        of_sensor, poses_on_tile = np.zeros_like(total), np.zeros(len(ids))
        for name, document in zip(track["pose"], track["document"], strict=True):
            at = np.searchsorted(ids, tiles_of_pose[name].to_numpy(np.int64))
            pose = pose_from_dict(json.loads(document), what=name)
            of_sensor[at] += _variances(pose, centre[at], direction[at])
            poses_on_tile[at] += 1.0
        total += of_sensor / np.maximum(poses_on_tile, 1.0)[:, None]
        sensors += poses_on_tile > 0.0
    counts = np.maximum(sensors, 1.0)[:, None]
    along, across = np.where(sensors[:, None] > 0.0, total / counts**2, POSE_M**2).T
    return Shifts(along=np.sqrt(along + MAP_M**2), across=np.sqrt(across))


def lanes_across(
    poses: pd.DataFrame, sights: pd.DataFrame, tiles: gpd.GeoDataFrame, network: LaneNetwork
) -> Booleans:
    """Return of which lanes all sensors that see the counting line look straight across at it.

    Parameters
    ----------
    poses, sights : DataFrame
        Tables of a dataset.
    tiles : GeoDataFrame
        All its tiles, by ascending `tile_id`.
    network : LaneNetwork
        The lanes.
    """
    ids = tiles["tile_id"].to_numpy(np.int64)
    line = network.tile_id[network.tile_at(np.arange(len(network.lane)), network.line_m)]
    at = np.searchsorted(ids, line)
    centre, direction = (each[at] for each in _centres_and_directions(quads(tiles)))
    largest = np.full(len(line), -1.0)  # largest cosine; -1 where no sensor sees the line
    tiles_of_pose = dict(iter(sights.groupby("pose")["tile_id"]))
    for name, document in zip(poses["pose"], poses["document"], strict=True):
        in_sight = (
            np.isin(line, tiles_of_pose[name])
            if name in tiles_of_pose
            else np.zeros(len(line), np.bool_)
        )
        arm = centre[in_sight] - pose_from_dict(json.loads(document), what=name).position[:2]
        cosine = np.abs((arm * direction[in_sight]).sum(axis=1)) / np.maximum(
            np.hypot(*arm.T), 1e-9
        )
        largest[in_sight] = np.maximum(largest[in_sight], cosine)
    return np.asarray((largest >= 0.0) & (largest < _ACROSS))


def chance_of_others(shifts: Shifts, tiles: gpd.GeoDataFrame) -> Floats:
    """Return for each tile the probability that a pose is off by more than half of its width."""
    half_m = tiles["width_m"].to_numpy(float) / 2
    return np.asarray(2.0 * scipy.special.ndtr(-half_m / np.maximum(shifts.across, 1e-6)))


def lanes_beside(tiles: gpd.GeoDataFrame) -> Integers:
    """Return for each tile the next tiles of the same direction to the left and to the right.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles of a site.

    Returns
    -------
    (2, n) int64 array
        Positions of tiles; -1 where there is none.
    """
    corners, neighbours = quads(tiles), np.full((2, len(tiles)), -1)
    centre, direction = _centres_and_directions(corners)
    aside_m = tiles["width_m"].to_numpy(float) / 2 + _BESIDE_M
    left = aside_m[:, None] * np.column_stack([-direction[:, 1], direction[:, 0]])
    # No tile grid, whose compiled code loads for a second.
    tree = shapely.STRtree(np.asarray(shapely.polygons(corners)))
    for side, beside in zip((left, -left), neighbours, strict=True):
        found = tree.query(shapely.points(centre + side), predicate="intersects")
        tile, other = found[:, np.lexsort(found[::-1])]
        alike = (direction[tile] * direction[other]).sum(axis=1) > _ALIKE
        beside[tile[alike]] = other[alike]
    return neighbours


def _centres_and_directions(corners: Floats) -> tuple[Floats, Floats]:
    """Return the middles of tiles and their directions of travel, (n, 2) each."""
    direction = corners[:, 1:3].sum(axis=1) - corners[:, [0, 3]].sum(axis=1)
    return corners.mean(axis=1), direction / np.linalg.norm(direction, axis=1)[:, None]


def _variances(pose: Pose, centre: Floats, direction: Floats) -> Floats:
    """Return the variances (m^2) along and across at some places seen from a pose, (n, 2)."""
    evidence = pose.parsed_evidence()
    if evidence.covariance is not None:
        covariance = evidence.covariance[np.ix_([0, 1, 5], [0, 1, 5])]
    else:
        sigma = [evidence.sigma.get(name, POSE_M) for name in ("easting", "northing")]
        covariance = np.diag([*sigma, np.radians(evidence.sigma.get("yaw", 0.0))]) ** 2
    arm, variances = centre - pose.position[:2], []
    for side in (direction, np.column_stack([-direction[:, 1], direction[:, 0]])):
        turned = side[:, 1] * arm[:, 0] - side[:, 0] * arm[:, 1]
        moves = np.column_stack([side, turned])
        longer = min(evidence.range_scale_sigma, _MOST_SCALE) * (side * arm).sum(axis=1)
        variances.append(np.einsum("ni,ij,nj->n", moves, covariance, moves) + longer**2)
    return np.column_stack(variances)

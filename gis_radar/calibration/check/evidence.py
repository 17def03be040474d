"""Evidence: how well a sensor's traffic fits the lanes of the map."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Self

import geopandas as gpd
import numpy as np
import scipy

from gis_radar.base import Booleans, Floats, NoAnswerError
from gis_radar.calibration.check.excerpt import Excerpt
from gis_radar.calibration.registration.certainty import z_score
from gis_radar.calibration.registration.lanes import LANE_STEP_M, MARGIN_M, Lanes, sample_lanes
from gis_radar.calibration.registration.matches import match_along
from gis_radar.poses import Pose
from gis_radar.scans import SightTiles

# Mixture of the likelihood. On a lane: uniform over its width, with edges blurred by the errors of
# poses, maps and bearings (1 sigma: metres, and share of the range).
_EDGE_M, _EDGE_SHARE = 0.5, 0.01
OTHERS = 0.1  # share of detections that are of anything else than vehicles on lanes
_AREA_M = 8.0  # width and height over which those are uniform
# Height over the road of reflections: mean, 1 sigma, 1 sigma of elevation as a share of the range.
MEAN_REFLECTION_M, _HEIGHT_M, _HEIGHT_SHARE = 0.7, 1.0, 0.012
_SAME_M = 0.3  # poses so near to each other, as those of a pose track, share sampled lanes
_MOST_CACHED = 4  # places whose lanes are held in memory, 25 MB each


@dataclass(frozen=True, kw_only=True)
class Score:
    """Score of how well a sensor's traffic fits the lanes.

    Parameters
    ----------
    log_likelihood : (v,) array
        Mean log likelihood of the detections of each vehicle.
    on_lane : (v,) array
        Share of each vehicle's detections that are likelier on a lane than elsewhere.
    height_over_m : (n,) array
        Height of each detection over its lane, metres; NaN off the lanes or without elevation.
    """

    log_likelihood: Floats
    on_lane: Floats
    height_over_m: Floats

    @property
    def driving(self) -> Booleans:
        """Which vehicles drive along lanes: with most of their detections on them."""
        return self.on_lane > 0.5

    @property
    def share(self) -> float:
        """Share of the vehicles that drive along lanes."""
        return float(self.driving.mean()) if len(self.on_lane) else 0.0

    def z_score_over(self, other: Score) -> float:
        """Return the z score of the vehicles' log likelihoods, this score less the other."""
        return z_score(self.log_likelihood - other.log_likelihood)


@dataclass(frozen=True, kw_only=True)
class LaneMap:
    """Lanes of a site, sampled around a sensor on first use and cached.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.hdmap.LaneletMap`.
    road : (n, 3) array
        Points of the road's surface in the map's CRS, metres, for the heights of lanes.
    """

    lanelets: gpd.GeoDataFrame
    road: Floats
    _cache: dict[tuple[float, float, float], Lanes | None] = field(default_factory=dict, init=False)

    @classmethod
    def of_tiles(cls, lanelets: gpd.GeoDataFrame, tiles: SightTiles) -> Self:
        """Return the lanes of lanelets with the road heights of tiles, as far as they have any."""
        return cls(lanelets=lanelets, road=tiles.centres[np.isfinite(tiles.centres[:, 2])])

    def around(self, pose: Pose, reach_m: float) -> Lanes | None:
        """Return the lanes that detections within reach (m) of a pose need; None if there is none.

        The reach is rounded up to 10 m.
        """
        reach_m = float(np.ceil((reach_m + MARGIN_M) / 10.0) * 10.0)
        key = pose.easting, pose.northing, reach_m
        for east, north, reach in self._cache:
            if reach == reach_m and np.hypot(east - key[0], north - key[1]) < _SAME_M:
                key = east, north, reach
        if key not in self._cache:
            while len(self._cache) >= _MOST_CACHED:
                del self._cache[next(iter(self._cache))]
            self._cache[key] = None
            with suppress(NoAnswerError):
                self._cache[key] = sample_lanes(
                    self.lanelets, self.road, place=pose.position[:2], reach_m=reach_m
                )
        return self._cache[key]


def score(
    excerpt: Excerpt, lanes: LaneMap, *, heights: bool = True, signless: bool = False
) -> Score:
    """Score how well the traffic fits the lanes.

    The likelihood of a detection is a mixture: of a vehicle that moves along a lane, in its
    direction and below its top speed, and of anything else. Each vehicle counts once.

    Parameters
    ----------
    excerpt : Excerpt
        The sensor's traffic.
    lanes : LaneMap
        The map.
    heights : bool
        Whether the likelihood uses heights over the road.
    signless : bool
        Whether range rates have lost their sign, so that each may have either.
    """
    points, rates = excerpt.points, excerpt.range_rate
    log_likelihood = np.full(len(points), np.log(OTHERS / _AREA_M**2))
    on_lane, height_over_m = np.zeros(len(points), dtype=bool), np.full(len(points), np.nan)
    for index, pose in enumerate(excerpt.poses):
        rows, near = np.flatnonzero(excerpt.pose == index), lanes.around(pose, excerpt.reach_m)
        if near is None or len(rows) == 0:
            continue
        for rate in (rates, -rates) if signless else (rates,):
            tried = _lane_likelihoods(points[rows], rate[rows], pose, near, heights=heights)
            better = tried[0] > log_likelihood[rows]
            for values, value in zip((log_likelihood, on_lane, height_over_m), tried, strict=True):
                values[rows[better]] = value[better]
    number = np.unique(excerpt.vehicle, return_inverse=True)[1]
    count = np.bincount(number)
    return Score(
        log_likelihood=np.bincount(number, log_likelihood) / count,
        on_lane=np.bincount(number, on_lane) / count,
        height_over_m=height_over_m,
    )


def _lane_likelihoods(
    points: Floats, rate: Floats, pose: Pose, lanes: Lanes, *, heights: bool
) -> tuple[Floats, Booleans, Floats]:
    """Return each detection's log likelihood, whether it is on a lane, and its height over it."""
    local = pose.to_map(points) - [*lanes.origin, 0.0]
    offset = local - (pose.position - [*lanes.origin, 0.0])
    reach, flat = np.linalg.norm(offset, axis=1), np.hypot(*offset[:, :2].T)
    level = np.isnan(points[:, 2]) | (not heights)
    matched = local.copy()
    matched[level, 2] = np.nan
    direction = offset[:, :2] / np.maximum(flat, 1e-9)[:, None]
    matches = match_along(lanes, matched, direction, rate, reach)
    ahead, left, height_over_m = lanes.beside(matches.lane, local)
    half, edge = lanes.width_m[matches.lane] / 2.0, np.hypot(_EDGE_M, _EDGE_SHARE * reach)
    beyond = np.maximum(np.abs(ahead) - 1.5 * LANE_STEP_M, 0.0) / edge
    across = [scipy.special.ndtr((side * left + half) / edge) for side in (1.0, -1.0)]
    lane_density = (across[0] + across[1] - 1.0) / (2.0 * half) * np.exp(-0.5 * beyond**2)
    height_over_m[np.isnan(points[:, 2])] = np.nan
    spread = np.hypot(_HEIGHT_M, _HEIGHT_SHARE * reach)
    normal = np.exp(-0.5 * ((height_over_m - MEAN_REFLECTION_M) / spread) ** 2)
    normal /= np.sqrt(2.0 * np.pi) * spread
    height_density = np.where(np.isnan(height_over_m) | (not heights), 1.0 / _AREA_M, normal)
    lane = matches.found * (1.0 - OTHERS) * lane_density * height_density
    elsewhere = OTHERS / _AREA_M**2
    on_lane = lane > elsewhere
    return np.log(lane + elsewhere), on_lane, np.where(on_lane, height_over_m, np.nan)

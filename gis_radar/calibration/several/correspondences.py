"""Correspondences: vehicles that two radars see at the same time, which relate their poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
import scipy

from gis_radar.base import Booleans, Floats, Integers
from gis_radar.calibration.registration.lanes import Lanes, place
from gis_radar.calibration.registration.matches import match
from gis_radar.calibration.registration.model import MODEL
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import NONE, Moving, Samples

MOMENT_S = 0.2  # length of a moment: two or more frames of each radar; a vehicle moves 2 to 3 m
_LEAST_MOMENTS = 5  # least number of common moments of a pair of tracks: one second
# Least cosine between line of sight and lane at which the Doppler gives the speed (70 degrees).
_LEAST_DOPPLER_COSINE = math.cos(math.radians(70.0))
# Least length of the mean unit vector of travel of a moment; shorter if detections are on several
# lanes.
_LEAST_STRAIGHT = 0.95
_LONGEST_M = 7.0  # largest extent of a moment along the lane: longer ones are several vehicles
# Least cosine between the directions of travel of a pair (30 degrees: a bend, and a guess's yaw).
_LEAST_AGREEMENT = math.cos(math.radians(30.0))
_SPEED_MPS = 2.5  # largest difference of speeds: wheels, noise of the Doppler over the cosine
_LEVEL_M = 3.0  # largest difference of heights: bridges are higher
# Least share of two tracks' common moments in which speed, direction and height agree.
_LEAST_AGREEING_SHARE = 0.7
FARTHEST_TRACK_M = 60.0  # tracks farther apart are not compared: no pose is that far off
# Distance from the middle of a vehicle to the reflections at its ends, and 1 sigma among vehicles:
# half of 4.5 m, less 0.1 to 0.35 m, as wheels and the underbody reflect from behind a face (1.9 and
# 2.0 m at the true poses of two simulators).
HALF_LENGTH_M = 2.05
_HALF_LENGTH_SPREAD_M = 0.6
# 1 sigma, along and across, of a vehicle's constant offset between two radars, which see different
# parts of it: mirrors, wheels, rounded corners.
_SPOT_M = (0.7, 0.35)
_STRETCH_M = 30.0  # length of a stretch of a lane, on which all vehicles share an offset
# 1 sigma of one moment without its faces: error of range, and of the time within the moment.
_MOMENT_SIGMA_M = 0.3
# Time within which the errors of moments are correlated, as reflecting parts change
_MEMORY_S = 1.0
SHARE = min(MOMENT_S / _MEMORY_S, 1.0)  # weight of a moment by that correlation
LEAST_PAIRS = 4  # fewer pairs neither place a sensor nor contradict a pose

PLANAR = 3  # number of unknowns of a pose in the plane: easting, northing, yaw
Names = tuple[str, str]  # of two sensors
_FLAT = slice(0, 2)  # easting and northing
FACES = 3  # number of face constants: half length, half width, logarithm of the side strength


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Vehicles on lanes as one sensor sees them: a row for each track and moment.

    Parameters
    ----------
    track : (m,) array
        Number of the track.
    moment : (m,) array
        Number of the moment, UNIX time over `MOMENT_S`, the same for all sensors.
    arm : (m, 3) array
        Vector from the sensor to the mean detection, in the map's axes, metres.
    place : (3,) array
        The sensor's position, local coordinates, metres.
    along : (m, 2) array
        Unit vectors in the direction of travel.
    speed : (m,) array
        Speed in that direction, m/s.
    count : (m,) array
        Number of detections in the moment.
    """

    track: Integers
    moment: Integers
    arm: Floats
    place: Floats
    along: Floats
    speed: Floats
    count: Integers

    def __len__(self) -> int:
        return len(self.track)

    @property
    def points(self) -> Floats:
        """Mean detections, (m, 3), local coordinates, metres."""
        return np.asarray(self.arm + self.place)

    def delayed(self, moments: int) -> Moments:
        """Return the same rows with `moments` added to the number of the moment."""
        return replace(self, moment=self.moment + moments)


def read_moments(moving: Moving, tracks: Integers, state: State, lanes: Lanes) -> Moments:
    """Place the tracks of a recording on lanes of the map, and average them by moments.

    Parameters
    ----------
    moving : Moving
        Moving detections.
    tracks : (n,) array
        As from :func:`gis_radar.calibration.registration.traces.link_tracks`.
    state : State
        Assumed state of the sensor, in the lanes' local coordinates.
    lanes : Lanes
        The map; it gives the directions of travel.
    """
    linked = tracks != NONE
    samples = Samples(
        points=moving.points[linked], range_rate=moving.range_rate[linked], track=tracks[linked],
        tracks=int(tracks.max(initial=NONE)) + 1, elevation=np.pi / 2,
    )  # fmt: skip
    placed = place(samples, state)
    matches = match(lanes, placed)
    along = lanes.along[matches.lane]
    cosine = np.sum(along * placed.sight, axis=1)
    clear = np.abs(cosine) > _LEAST_DOPPLER_COSINE
    speed = np.divide(samples.range_rate, cosine, out=np.full(len(samples), np.nan), where=clear)
    moment = np.floor(moving.time[linked] / MOMENT_S).astype(np.int64)
    columns = {
        "track": samples.track, "moment": moment, "speed": speed,
        "late": moving.time[linked] - (moment + 0.5) * MOMENT_S,
        **dict(zip("xyz", placed.arms.T, strict=True)), "e": along[:, 0], "n": along[:, 1],
        "s": np.sum(along * placed.arms[:, _FLAT], axis=1),
    }  # fmt: skip
    table = pd.DataFrame(columns)[matches.found]
    typical = table.groupby("track")["speed"].median()
    groups = table.groupby(["track", "moment"], sort=True)
    means, count = groups.mean(), groups.size().to_numpy()
    extent = (groups["s"].max() - groups["s"].min()).to_numpy()
    number = means.index.get_level_values("track").to_numpy()
    pace = groups["speed"].median().to_numpy()
    pace = np.where(np.isnan(pace), typical.reindex(number).to_numpy(), pace)
    direction = means[["e", "n"]].to_numpy()
    straight = np.hypot(*direction.T)
    # leave out means over several vehicles: a queue linked to one track, or crossing lanes
    good = (extent < _LONGEST_M) & np.isfinite(pace) & (straight > _LEAST_STRAIGHT)
    direction = direction / np.maximum(straight, _LEAST_STRAIGHT)[:, None]
    arm = means[list("xyz")].to_numpy(copy=True)
    arm[:, _FLAT] -= direction * (pace * means["late"].to_numpy())[:, None]
    return Moments(
        track=number[good], moment=means.index.get_level_values("moment").to_numpy()[good],
        arm=arm[good], place=state.position, along=direction[good], speed=pace[good],
        count=count[good],
    )  # fmt: skip


def faces(moments: Moments) -> tuple[Floats, Floats, Floats]:
    """Return which faces of vehicles a sensor sees, and the share of the side.

    Returns
    -------
    (m,), (m,) array
        Sign of the line of sight along the lane (1: the rear is seen) and to its left.
    (m,) array
        Share of detections on the side, 0 to 1; the others are on front or rear.
    """
    sight = moments.arm[:, _FLAT] / np.maximum(np.hypot(*moments.arm[:, _FLAT].T), 1e-9)[:, None]
    cosine = np.sum(sight * moments.along, axis=1)
    sine = sight[:, 1] * moments.along[:, 0] - sight[:, 0] * moments.along[:, 1]
    side_weight = MODEL.side_strength * np.abs(sine)
    return np.sign(cosine), np.sign(sine), side_weight / (side_weight + np.abs(cosine))


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Gaps between two sensors' positions of a vehicle's middle, along and across its lane.

    Parameters
    ----------
    pair : (r,) array
        Number of the pair of tracks, ascending.
    tracks : (pairs, 2) array
        Numbers of the tracks, of the first and of the second sensor.
    gap : (r, 2) array
        Position by the first sensor less that by the second, metres.
    poses : (r, 2, 6) array
        Derivative of the gap by easting, northing, yaw of the first and of the second sensor.
    constants : (r, 2, 3) array
        Derivative by the half length, half width, and the logarithm of the side strength.
    clocks : (r, 2, 2) array
        Derivative by the clock offset of the first and of the second, m/s.
    bearings : (r, 2, 2) array
        Derivative by an error of azimuth of the first and of the second, m/rad.
    variance : (r, 2) array
        Variance of the gap that is independent in each moment, m^2.
    place : (r, 2) array
        Position of the vehicle, local coordinates, metres.
    """

    pair: Integers
    tracks: Integers
    gap: Floats
    poses: Floats
    constants: Floats
    clocks: Floats
    bearings: Floats
    variance: Floats
    place: Floats

    @cached_property
    def first(self) -> Integers:
        """Index of the first row of each pair."""
        return np.flatnonzero(np.diff(self.pair, prepend=-1))

    def means(self, values: Floats) -> Floats:
        """Return the mean over the rows of each pair."""
        number = np.diff(np.append(self.first, len(self.pair)))
        total = np.add.reduceat(values, self.first, axis=0) if len(values) else values
        return np.asarray(total / number.reshape(-1, *[1] * (values.ndim - 1)))

    def only(self, pairs: Booleans) -> Rows:
        """Return the rows of the pairs for which `pairs` is true, numbered anew."""
        keep = pairs[self.pair]
        cut = {
            name: getattr(self, name)[keep]
            for name in ("gap", "poses", "constants", "clocks", "bearings", "variance", "place")
        }
        number = (np.cumsum(pairs) - 1)[self.pair[keep]]
        return Rows(pair=number, tracks=self.tracks[pairs], **cut)


def compare_moments(one: Moments, other: Moments) -> Rows:
    """Return the gaps of all pairs of tracks of two sensors that may be of one vehicle.

    These have common moments in which direction, speed and height agree.

    Parameters
    ----------
    one, other : Moments
        Vehicles of two sensors.
    """
    a, b = np.empty((2, 0), np.int64)
    if _in_reach(one, other):  # sensors of a large site may never meet
        a, b = _pairs_of_moments(one.moment, other.moment)
    table = pd.DataFrame({"one": one.track[a], "other": other.track[b]})
    cosine = np.sum(one.along[a] * other.along[b], axis=1)
    rise = np.abs(one.points[a, 2] - other.points[b, 2])
    agree = (
        (cosine > _LEAST_AGREEMENT)
        & (np.abs(one.speed[a] - other.speed[b]) < _SPEED_MPS)
        & (rise < _LEVEL_M)
    )
    near = np.hypot(*(one.points[a] - other.points[b])[:, _FLAT].T) < FARTHEST_TRACK_M
    pairs = table.groupby(["one", "other"], sort=True)
    number = pairs.ngroup().to_numpy()
    share = np.bincount(number, weights=agree) / np.maximum(np.bincount(number), 1)
    keep = agree & near & (share[number] > _LEAST_AGREEING_SHARE)
    enough = np.bincount(number[keep], minlength=len(share)) >= _LEAST_MOMENTS
    keep &= enough[number]
    order = np.flatnonzero(keep)[np.argsort(number[keep], kind="stable")]
    _, pair = np.unique(number[order], return_inverse=True)
    tracks = table.iloc[order].groupby(pair).first().to_numpy().reshape(-1, 2)
    return _gap_rows(one, other, a[order], b[order], pair, tracks)


def _in_reach(one: Moments, other: Moments) -> bool:
    """Return whether the bounding boxes of two sensors' vehicles come within `FARTHEST_TRACK_M`."""
    if not len(one) or not len(other):
        return False
    a, b = one.points[:, _FLAT], other.points[:, _FLAT]
    apart_m = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))
    return bool((apart_m < FARTHEST_TRACK_M).all())


def _pairs_of_moments(one: Integers, other: Integers) -> tuple[Integers, Integers]:
    """Return the indices of all pairs of equal moments."""
    left = pd.DataFrame({"at": one, "a": np.arange(len(one))})
    right = pd.DataFrame({"at": other, "b": np.arange(len(other))})
    joined = left.merge(right, on="at")
    return joined["a"].to_numpy(np.int64), joined["b"].to_numpy(np.int64)


def _gap_rows(
    one: Moments, other: Moments, a: Integers, b: Integers, pair: Integers, tracks: Integers
) -> Rows:
    """Return gaps and derivatives of rows `a` of one sensor less rows `b` of the other."""
    along = one.along[a]
    axes = np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], axis=1)
    half = np.array([HALF_LENGTH_M, MODEL.half_width])
    gap = np.einsum("rij,rj->ri", axes, (one.points[a] - other.points[b])[:, _FLAT])
    poses, constants = np.zeros((len(a), 2, 2 * PLANAR)), np.zeros((len(a), 2, FACES))
    clocks, bearings = np.zeros((len(a), 2, 2)), np.zeros((len(a), 2, 2))
    variance = np.full((len(a), 2), _MOMENT_SIGMA_M**2)
    for k, (moments, rows, sign) in enumerate(((one, a, 1.0), (other, b, -1.0))):
        ahead, left, side = (each[rows] for each in faces(moments))
        arm, ends, sides = moments.arm[rows, :2], (1.0 - side) * ahead, side * left
        reflecting, mixed = np.column_stack([ends, sides]), side * (1.0 - side)
        gap += sign * reflecting * half
        turn = np.einsum("rij,rj->ri", axes, np.column_stack([-arm[:, 1], arm[:, 0]]))
        poses[:, :, PLANAR * k : PLANAR * k + 2] = sign * axes
        poses[:, :, PLANAR * k + 2] = sign * turn
        bearings[:, :, k] = sign * turn
        constants[:, 0, 0] += sign * ends
        constants[:, 1, 1] += sign * sides
        constants[:, 0, 2] -= sign * mixed * ahead * half[0]
        constants[:, 1, 2] += sign * mixed * left * half[1]
        clocks[:, 0, k] = sign * moments.speed[rows]
        # variance of detections that are uniform along a side, and across an end
        share = np.column_stack([side, 1.0 - side])
        variance += half**2 * (share / 3.0 + mixed[:, None]) / moments.count[rows][:, None]
    return Rows(
        pair=pair, tracks=tracks, gap=gap, poses=poses, constants=constants, clocks=clocks,
        bearings=bearings, variance=variance, place=one.points[a][:, _FLAT],
    )  # fmt: skip


def stretches(rows: Rows) -> Integers:
    """Return for each pair the number of its stretch of road and direction of travel."""
    place = np.floor(rows.means(rows.place) / _STRETCH_M)
    along = rows.means(rows.poses[:, 0, _FLAT])
    quarter = np.round(np.arctan2(along[:, 1], along[:, 0]) / (np.pi / 2.0)) % 4
    labels = np.column_stack([place, quarter])
    return np.asarray(np.unique(labels, axis=0, return_inverse=True)[1].ravel())


def effects(rows: Rows) -> tuple[Floats, Floats]:
    """Return the random effects of a pair: (r, 2, 5) derivatives and (5,) variances.

    The effects are a constant offset along and across, the half length, both errors of azimuth.
    """
    spots = np.broadcast_to(np.eye(2), (len(rows.gap), 2, 2))
    derivatives = np.concatenate([spots, rows.constants[:, :, :1], rows.bearings], axis=2)
    spread = [*_SPOT_M, _HALF_LENGTH_SPREAD_M, MODEL.bearing, MODEL.bearing]
    return derivatives, np.square(spread)


def mean_gaps(rows: Rows, covariance: Floats) -> tuple[Floats, Floats]:
    """Return each pair's mean gap, (pairs, 2) in m, and its covariance, (pairs, 2, 2) in m^2.

    Parameters
    ----------
    rows : Rows
        From :func:`compare_moments`.
    covariance : (6, 6) array
        Covariance of both sensors' easting, northing, yaw.
    """
    derivatives, variances = effects(rows)
    by_effect, by_pose = rows.means(derivatives), rows.means(rows.poses)
    number = np.diff(np.append(rows.first, len(rows.pair)))
    own = rows.means(rows.variance) / np.maximum(number * SHARE, 1.0)[:, None]
    covariances = (
        np.einsum("pik,k,pjk->pij", by_effect, variances, by_effect)
        + np.einsum("pik,kl,pjl->pij", by_pose, covariance, by_pose)
        + own[:, :, None] * np.eye(2)
    )
    return rows.means(rows.gap), covariances


def assign(chi2: Floats, tracks: Integers, most: float) -> Integers:
    """Return the indices of the pairs of least total chi-square, each track in at most one.

    Parameters
    ----------
    chi2 : (pairs,) array
        Chi-square of each pair.
    tracks : (pairs, 2) array
        The tracks of each pair.
    most : float
        Chi-square from which on a track is left without a pair.
    """
    near = np.flatnonzero(chi2 < most)
    if not len(near):
        return near
    (_, a), (_, b) = (np.unique(tracks[near, side], return_inverse=True) for side in (0, 1))
    cost = np.full((a.max() + 1, b.max() + 1), most)
    index = np.full(cost.shape, -1)
    cost[a, b], index[a, b] = chi2[near], near
    chosen = index[scipy.optimize.linear_sum_assignment(cost)]
    return np.asarray(np.sort(chosen[chosen >= 0]))

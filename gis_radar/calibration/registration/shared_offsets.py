"""Uncertainty by offsets that all vehicles of a street section or a lane share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gis_radar.base import Floats, Integers
from gis_radar.calibration.registration.lanes import (
    LANE_BINS,
    STREET_SIGMA_M,
    Lanes,
    Scene,
    direction_bin,
)
from gis_radar.calibration.registration.matches import Matches
from gis_radar.calibration.registration.residuals import sums
from gis_radar.calibration.registration.traces import Samples

# The group of each track, and one standard deviation (m) of the offset of each group; of street
# sections, then of lanes.
Groups = list[tuple[Integers, Floats]]

STREET_M = 60.0  # length of a street section, over which the error of the map is constant


def biases_of(scene: Scene, matches: Matches, offsets: Sequence[Floats]) -> tuple[Groups, Floats]:
    """Return the groups of tracks with common offsets, and the biases of the state by them.

    A bias is the change of the state by one standard deviation of an offset (:class:`Fit`).

    Parameters
    ----------
    scene : Scene
        The map and the traces.
    matches : Matches
        The lane of each sample.
    offsets : (tracks, 7) arrays
        As in :class:`gis_radar.calibration.registration.residuals.Normal`.
    """
    lanes, (across, up) = scene.lanes, offsets
    sample = matches.lane[matches.found]
    map_sigma_m, scan_sigma_m = STREET_SIGMA_M
    street, count = _commonest_key(scene.samples, matches, _street_sections(lanes, sample))
    biases = [map_sigma_m * sums(street, across, count), scan_sigma_m * sums(street, up, count)]
    lane, count = _commonest_key(scene.samples, matches, lanes.lane[sample])
    _, first = np.unique(lanes.lane[sample], return_index=True)
    straight_m, bend_m = scene.lane_sigma_m
    lane_sigma_m = np.append(np.where(lanes.bends[sample[first]], bend_m, straight_m), 0.0)
    biases.append(lane_sigma_m[:, None] * sums(lane, across, count))
    groups = [(street, np.full(int(street.max()) + 1, map_sigma_m)), (lane, lane_sigma_m)]
    return groups, np.vstack(biases)


def _street_sections(lanes: Lanes, sample: Integers) -> Integers:
    """Return for samples of lanes the number of their street section and direction."""
    direction = direction_bin(lanes.along[sample], LANE_BINS) // 2
    cell = np.floor(lanes.points[sample, :2] / STREET_M).astype(np.int64)
    low = cell.min(axis=0, initial=0)
    span = cell.max(axis=0, initial=0) - low + 1
    return np.ravel_multi_index((*(cell - low).T, direction), (*span, LANE_BINS))


def _commonest_key(samples: Samples, matches: Matches, keys: Integers) -> tuple[Integers, int]:
    """Return for each track the number of its samples' commonest key, and the count of numbers."""
    numbers, number = np.unique(keys, return_inverse=True)
    count = len(numbers) + 1
    votes = np.bincount(
        samples.track[matches.found] * count + number, minlength=samples.tracks * count
    )
    return votes.reshape(samples.tracks, count).argmax(axis=1), count


def habits_of(by_offset: Floats, stiff: Floats, variance: Floats, street: Integers) -> float:
    """Return the variance of the cost by an offset that the drivers of a street section share.

    With the vehicles' random effects at their optimum, the cost changes with the offset c of a
    section by `c sum b_k / tau^2 + c^2 / 2 sum 1 / (tau^2 + 1 / P_k)`; c is normal.

    Parameters
    ----------
    by_offset : (tracks,) array
        Derivative of each vehicle's cost by a common offset of drivers across their lane, 1/m.
    stiff, variance : (tracks,) arrays
        Inverse variance of a vehicle's own offset by the prior (1/m^2), and its posterior variance
        (m^2).
    street : (tracks,) int array
        Street section of each vehicle.
    """
    sigma_m = STREET_SIGMA_M[0]
    linear = np.bincount(street, weights=by_offset)
    square = np.bincount(street, weights=(1.0 - variance * stiff) * stiff)
    return float(np.sum((sigma_m * linear) ** 2 + 0.5 * (sigma_m**2 * square) ** 2))


def shared_variance(groups: Groups, by_offset: Floats) -> float:
    """Return the variance of a difference of costs by the offsets that vehicles share.

    Parameters
    ----------
    groups : Groups
        The groups of vehicles, with the standard deviations of their offsets.
    by_offset : (tracks,) array
        Derivative of each vehicle's difference of costs by such an offset, 1/m.
    """
    return sum(
        float(np.square(sigma_m * np.bincount(group, by_offset, len(sigma_m))).sum())
        for group, sigma_m in groups
    )

"""Duplicate tracks: vehicles found twice, or in two parts side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.management_settings import TallSettings, TrackManagementSettings
from gis_radar.tracking.motion import HALF_STEPS, Motion
from gis_radar.tracking.settings import VehicleSettings
from gis_radar.tracking.size import LONGEST_M
from gis_radar.tracking.stationary import StationaryTarget
from gis_radar.tracking.tall import one_tall_odds, tall_odds

BESIDE_M = 1.5  # less than the width of two cars: middles are not so near


def join_tall(
    targets: Sequence[StationaryTarget], detections: MapDetections, settings: TallSettings
) -> list[StationaryTarget]:
    """Return the stationary targets, with neighbours that are both of one tall vehicle as one.

    Parameters
    ----------
    targets : sequence of StationaryTarget
        In any order.
    detections : MapDetections
        All detections.
    settings : TallSettings
        Constants.
    """
    order = sorted(targets, key=lambda each: (each.strip, each.rear_m))
    odds = [_odds(each.rows, detections, settings) for each in order]
    joined: list[StationaryTarget] = []
    gone: set[int] = set()
    for k, one in enumerate(order):
        if k in gone:
            continue
        best, total = -1, settings.least_odds
        for j in range(k + 1, len(order)):
            other = order[j]
            if other.strip != one.strip or other.rear_m > one.front_m + settings.gap_m:
                break
            both = one_tall_odds((odds[k], odds[j]), settings)
            if j not in gone and _may_be_one(one, other, settings) and both > total:
                best, total = j, both
        if best < 0:
            joined.append(one)
            continue
        gone.add(best)
        other = order[best]
        joined.append(
            replace(
                one, front_m=max(one.front_m, other.front_m), begin=min(one.begin, other.begin),
                end=max(one.end, other.end), rows=np.union1d(one.rows, other.rows),
            )
        )  # fmt: skip
    return joined


def _odds(rows: Integers, detections: MapDetections, settings: TallSettings) -> float:
    return tall_odds(detections.height_m[rows], detections.range_m[rows], settings)


def _may_be_one(one: StationaryTarget, other: StationaryTarget, settings: TallSettings) -> bool:
    """Return whether two targets overlap in time and are together no longer than a vehicle."""
    both = min(one.end, other.end) - max(one.begin, other.begin)
    least = settings.both_share * max(one.end - one.begin, other.end - other.begin)
    return both > least and other.front_m - one.rear_m < LONGEST_M


def distinct_targets(
    targets: Sequence[StationaryTarget],
    places: Sequence[tuple[Floats, float]],
    motions: Sequence[Motion],
    settings: TrackManagementSettings,
) -> list[int]:
    """Return the targets that overlap no better supported one and no motion at rest."""
    begin, end = np.array([x.begin for x in targets]), np.array([x.end for x in targets])
    place = np.array([each for each, _ in places]).reshape(-1, 2)
    half = np.array([0.5 * (x.front_m - x.rear_m) for x in targets])
    weight = np.array([len(x.rows) for x in targets])
    alive = np.ones(len(targets), np.bool_)
    for motion in motions:
        slow = np.flatnonzero(motion.speed < settings.slow_mps)
        if len(slow) < STEPS_PER_SECOND:
            continue
        middle, heading = motion.places
        when = (motion.first_step + slow) / STEPS_PER_SECOND
        for k in np.flatnonzero((begin < when[-1]) & (end > when[0]) & alive).tolist():
            both = slow[(when >= begin[k]) & (when <= end[k])]
            if len(both) < 0.5 * (end[k] - begin[k]) * STEPS_PER_SECOND or len(both) == 0:
                continue
            j, reach = both[len(both) // 2], 0.5 * motion.length_m
            if np.hypot(*(place[k] - middle[j])) > settings.near_m:
                continue
            share = _inside(place[k], places[k][1], half[k], middle[j], heading[j], reach)
            alive[k] = share <= settings.same_share
    for k in np.argsort(-weight, kind="stable").tolist():
        if not alive[k]:
            continue
        near = alive & (np.hypot(*(place - place[k]).T) < settings.near_m) & (weight <= weight[k])
        near &= np.minimum(end, end[k]) - np.maximum(begin, begin[k]) > 0.5 * (end - begin)
        near[k] = False
        for j in np.flatnonzero(near).tolist():
            share = _inside(place[j], places[j][1], half[j], place[k], places[k][1], half[k])
            alive[j] = share <= settings.same_share
    return np.flatnonzero(alive).tolist()


def _inside(
    place: Floats, heading: float, half: float, other: Floats, turned: float, reach: float
) -> float:
    """Return the share of the middle line of one body within another, widened one."""
    way = np.array([np.cos(heading), np.sin(heading)])
    apart = place + np.linspace(-1.0, 1.0, 9)[:, None] * max(half - 0.3, 0.1) * way - other
    c, s = np.cos(turned), np.sin(turned)
    along, left = apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s
    return float(((np.abs(along) < reach) & (np.abs(left) < 1.2)).mean())


def without_duplicates(
    motions: Sequence[Motion], detections: MapDetections, settings: VehicleSettings
) -> list[Motion]:
    """Return the motions without those that overlap better supported ones.

    Two vehicles are never in one place; one that two sensors see, or whose ends are seen apart, may
    be followed twice. One that lies on others for most of its track goes; of another its begin or
    end, if that does.

    Parameters
    ----------
    motions : sequence of Motion
        In any order.
    detections : MapDetections
        All detections.
    settings : VehicleSettings
        Of track management, and how few detections are none.
    """
    limits = settings.management
    order = sorted(range(len(motions)), key=lambda k: -len(motions[k].rows))
    samples = [each.halves() for each in motions]
    steps = [set(each[0].tolist()) for each in samples]
    boxes = [np.stack([each[1].min(axis=0), each[1].max(axis=0)]) for each in samples]
    kept: list[tuple[int, Motion]] = []
    own: dict[int, Booleans] = {}  # of those before: in which half seconds they lie on none
    for k in order:
        on = np.zeros(len(samples[k][0]), np.bool_)
        for other, left in own.items():
            apart = np.maximum(boxes[k][0] - boxes[other][1], boxes[other][0] - boxes[k][1])
            if (apart > limits.near_m).any() or steps[k].isdisjoint(steps[other]):
                continue
            theirs = (samples[other][0][left], samples[other][1][left], samples[other][2][left])
            on |= _lies_on(motions[k], samples[k], motions[other], theirs)
        if on.mean() >= limits.duplicate_share:
            continue
        first, last = _alone(on, limits.duplicate_halves)
        half, part = samples[k][0], motions[k]
        if first > 0 or last < len(half) - 1:
            begin = half[first] * HALF_STEPS if first > 0 else part.first_step
            end = (half[last] + 1) * HALF_STEPS - 1 if last < len(half) - 1 else part.last_step
            cut = part.between(int(begin), min(int(end), part.last_step), detections.time)
            if cut is None or len(cut.rows) < settings.bodies.least_rows:
                continue
            part = cut
        own[k] = (half >= half[first]) & (half <= half[last])
        kept.append((k, part))
    return [each for _, each in sorted(kept, key=lambda pair: pair[0])]


def _alone(on: Booleans, least: int) -> tuple[int, int]:
    """Return the first and last element outside of long runs at either end."""
    off = np.flatnonzero(~on)
    first, last = int(off[0]), int(off[-1])
    return first if first >= least else 0, last if len(on) - 1 - last >= least else len(on) - 1


def _lies_on(
    motion: Motion, mine: tuple[Integers, Floats, Floats],
    other: Motion, others: tuple[Integers, Floats, Floats],
) -> Booleans:  # fmt: skip
    """Return in which half seconds the middle of a vehicle lies on another vehicle."""
    _, own, theirs = np.intersect1d(mine[0], others[0], return_indices=True)
    apart = mine[1][own] - others[1][theirs]
    c, s = np.cos(others[2][theirs]), np.sin(others[2][theirs])
    along, left = apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s
    reach = 0.5 * other.length_m + 0.25 * motion.length_m
    found = np.zeros(len(mine[0]), np.bool_)
    found[own] = (np.abs(along) < reach) & (np.abs(left) < BESIDE_M)
    return found

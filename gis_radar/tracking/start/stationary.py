"""Stationary vehicles on lanes, distinguished from fixed objects beside and above them.

Stationary vehicles give detections like moving ones, but so do fixed objects. Kerbs, parked cars
and signs lie at the edge of a lane, gantries and mast arms hang above it, a vehicle fills its
middle. So still detections well inside a lane are of vehicles. Their places along it, with the end
that each sensor sees, show where one vehicle ends and the next begins. Where a vehicle drives over
a place, no other one stands there any more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter, uniform_filter1d

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.tracking.columns import NONE
from gis_radar.tracking.detections import MapDetections
from gis_radar.tracking.motion import Motion
from gis_radar.tracking.size import LONGEST_M, length_prior
from gis_radar.tracking.start.passes import MOST_CELLS, PAIR_M, Passes

_FRONT_SEEN, _REAR_SEEN, _SIDE_SEEN = range(3)  # what a sensor sees of a vehicle
_SQUARE_COS = 0.5  # least cosine of the aspect at which an end is seen: 60 degrees
_BIN_S = 0.5  # time bin of the counts by which fixed objects are found
_CHANGE_M = 1.5  # largest apparent move of a vehicle's ends from second to second
_INSIDE_M = 0.5  # least distance from the lane's edge: kerbs and parked cars lie nearer to it
_HIGH_M = 3.2  # a scatterer whose median height over the road is larger hangs above the lane
STRIP_CELL_M = 0.5 * PAIR_M  # length of a cell of a strip: the spread of a scatterer's detections
# Longest gap between the detections of a scatterer; after a longer one it counts as a new one. (A
# stationary vehicle is undetected for 9 to 25 s in one case of ten.) One first detected within this
# time of the first of all detections stood there from the begin, likewise at the end.
SILENCE_S = 10.0
SLICE_S = 1.0  # step of time in which stationary vehicles are found and associated
# Between these times before and after a vehicle drives over a place fast, no vehicle stands there.
_NEAR_S, _FAR_S = 0.7, 2.5
# Where detections occur in these times at _LEAST_FIXED passes or more, and at FIXED_SHARE of them,
# they are of fixed objects; except while their count over _CAR_M of the lane exceeds that at passes
# by _MORE_SIGMAS.
_LEAST_FIXED, FIXED_SHARE, _MORE_SIGMAS, _CAR_M = 2, 0.5, 3.0, 4.5
# Least gap in a queue; gap below which there is a cost, as drivers keep more; that cost, nats/m2.
_GAP_M, _EASY_GAP_M, _TIGHT_COST = 1.0, 2.0, 8.0
_SHORTEST_M = 3.4  # anything shorter cannot be distinguished from a sign
_POWER = 0.5  # weight of a scatterer: its number of detections to this power
_WINDOW_M, _MOST_WEIGHT = 5.0, 24.0  # length of a window of the lane, and the most weight in it
_VEHICLE_COST = 7.0  # cost of a vehicle: prior log odds against one
_STAY_GAIN = 12.0  # gain of a vehicle that stood in the same place one SLICE_S before, nats
_LOG_CLUTTER = math.log(0.02)  # log density of detections of no vehicle, 1/m
_END_M, _END_SHARE = 0.35, 0.6  # sigma of an end's detections, and their share if seen squarely
# Least detections and duration of a vehicle, and its least rate of detections as a share of that of
# vehicles in the same recordings at that range.
_LEAST_DETECTIONS, _LEAST_S, RATE_SHARE = 6, 2.0, 0.1


@dataclass(frozen=True, kw_only=True)
class StationaryTarget:
    """A stationary vehicle.

    Parameters
    ----------
    strip : int
        Number of the strip.
    rear_m, front_m : float
        Places of rear and front along the strip.
    begin, end : float
        Times of the first and the last detection, UNIX seconds.
    rows : int64 array
        Its detections, in the order of time.
    """

    strip: int
    rear_m: float
    front_m: float
    begin: float
    end: float
    rows: Integers = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, kw_only=True)
class _StillDetections:
    """Still detections inside of lanes, in the order of time, an entry for each."""

    row: Integers  # among all detections
    strip: Integers
    s_m: Floats  # along the strip
    time: Floats  # UNIX seconds
    end_seen: Integers  # what the sensor sees of a vehicle there: FRONT, REAR or SIDE
    episode: Integers  # detections at one place without a long gap or a pass between them

    def take(self, keep: Booleans) -> _StillDetections:
        """Return some of them."""
        names = self.__dataclass_fields__
        return _StillDetections(**{name: getattr(self, name)[keep] for name in names})


def find_stationary(
    detections: MapDetections, free: Booleans, motions: Sequence[Motion], passes: Passes
) -> list[StationaryTarget]:
    """Find the stationary vehicles that explain the still detections on lanes.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    free : (n,) bool array
        Which are still, and of no moving vehicle.
    motions : sequence of Motion
        Moving vehicles, whose detection rate is that expected of a stationary one.
    passes : Passes
        Times at which they drove over places.
    """
    still = _still_inside(detections, free, passes)
    if len(still.row) == 0:
        return []
    count = int(still.episode.max()) + 1
    begin, end = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(begin, still.episode, still.time)
    np.maximum.at(end, still.episode, still.time)
    # detections of one sensor in one cell and episode are of one scatterer
    cell = (still.s_m / STRIP_CELL_M).astype(np.int64)
    sensor = detections.sensor[still.row]
    key = np.column_stack([still.episode, cell, still.end_seen, sensor])
    groups, first, numbers = np.unique(key, axis=0, return_index=True, return_counts=True)
    weight = numbers.astype(np.float64) ** _POWER
    strip = still.strip[first]
    targets: list[StationaryTarget] = []
    for line in np.unique(strip).tolist():
        own = np.flatnonzero(strip == line)
        episode = groups[own, 0]
        targets += _on_strip(
            line, begin[episode], end[episode], groups[own, 1], groups[own, 2], weight[own]
        )
    typical = _typical_rate(motions, detections)
    return [
        part
        for each in _with_rows(targets, still)
        for part in detected_parts(each, detections, typical)
    ]


def _still_inside(detections: MapDetections, free: Booleans, passes: Passes) -> _StillDetections:
    """Return the still detections inside of lanes, grouped to episodes, without those above."""
    rows = np.flatnonzero(free)
    at = passes.strips.project(detections.points[rows])
    inside = at.edge_m > _INSIDE_M
    row, heading = rows[at.row[inside]], at.heading[inside]
    order = np.argsort(detections.time[row], kind="stable")
    row, heading = row[order], heading[order]
    cos = np.cos(heading) * detections.sight[row, 0] + np.sin(heading) * detections.sight[row, 1]
    square = np.abs(cos) >= _SQUARE_COS
    strip, s_m = at.strip[inside][order], at.s_m[inside][order]
    place = strip * MOST_CELLS + ((s_m / STRIP_CELL_M).astype(np.int64) // 2)
    still = _StillDetections(
        row=row, strip=strip, s_m=s_m, time=detections.time[row],
        end_seen=np.where(square, np.where(cos < 0.0, _FRONT_SEEN, _REAR_SEEN), _SIDE_SEEN),
        episode=_episodes(place, detections.time[row], passes.times),
    )  # fmt: skip
    if len(row) == 0:
        return still
    # things above the lane, by the median height of each episode, are no vehicles
    height = np.nan_to_num(detections.height_m[row])
    rank = np.lexsort((height, still.episode))
    bounds = np.searchsorted(still.episode[rank], np.arange(still.episode.max() + 2))
    median = height[rank][(bounds[:-1] + bounds[1:]) // 2]
    return still.take(median[still.episode] < _HIGH_M)


def without_fixed(detections: MapDetections, free: Booleans, passes: Passes) -> Booleans:
    """Return which unassigned still detections are not of fixed objects.

    Parameters
    ----------
    detections : MapDetections
        All detections.
    free : (n,) bool array
        Which are still, and of no moving vehicle.
    passes : Passes
        Times at which vehicles drove over places.
    """
    rows = np.flatnonzero(free)
    on_strips = passes.strips.project(detections.points[rows])
    row = rows[on_strips.row]
    place = on_strips.strip * MOST_CELLS + ((on_strips.s_m / STRIP_CELL_M).astype(np.int64) // 2)
    order = np.argsort(detections.time[row], kind="stable")
    row, place = row[order], place[order]
    fixed = _is_fixed(place, detections.sensor[row], detections.time[row], passes.fast)
    kept = free.copy()
    kept[row[fixed]] = False
    return kept


def _is_fixed(place: Integers, sensor: Integers, time: Floats, fast: dict[int, Floats]) -> Booleans:
    """Return which detections are of fixed objects: those that also occur next to fast passes.

    While there are clearly more of them, over a car's length, than at passes, they are not. `place`
    is the number of each detection's cell, `fast` as in :class:`Passes`.
    """
    fixed = np.zeros(len(place), np.bool_)
    if len(place) == 0:
        return fixed
    half = 0.5 * (_FAR_S - _NEAR_S)
    time_bin = ((time - time.min()) / _BIN_S).astype(np.int64)
    line = place // MOST_CELLS * 64 + sensor
    order = np.lexsort((time, place, line))
    for rows in np.split(order, np.flatnonzero(np.diff(line[order])) + 1):
        count = _counts(place[rows], time_bin[rows], int(time_bin.max()) + 1)
        lowest = place[rows[0]]
        for part in np.split(rows, np.flatnonzero(np.diff(place[rows])) + 1):
            passed = fast.get(int(place[part[0]]))
            if passed is None:
                continue
            passed = passed[np.concatenate([[True], np.diff(passed) > _FAR_S])]
            windows = np.stack([passed - half - _NEAR_S, passed + half + _NEAR_S])
            low, high = (np.searchsorted(time[part], windows + way * half) for way in (-1.0, 1.0))
            seen = (high > low).any(axis=0)
            if seen.sum() >= _LEAST_FIXED and seen.mean() >= FIXED_SHARE:
                counts = count[place[part[0]] - lowest]
                when = np.floor((windows - time.min()) / _BIN_S).astype(np.int64)
                counts_then = counts[when[(when >= 0) & (when < len(counts))]]
                at_passes = float(np.median(counts_then)) if len(counts_then) else 0.0
                # the sigma of small counts is at least that of one
                tolerance = _MORE_SIGMAS * np.sqrt(max(at_passes, 1.0))
                fixed[part] = counts[time_bin[part]] <= at_passes + tolerance
    return fixed


def _counts(place: Integers, time_bin: Integers, bins: int) -> Floats:
    """Return the number of detections within a car's length and 2.5 s, by cell and time bin."""
    cells = place - place.min()
    count = np.zeros((int(cells.max()) + 1, bins))
    np.add.at(count, (cells, time_bin), 1.0)
    size = (int(_CAR_M / STRIP_CELL_M) // 2, 5)
    # not by a running sum, which accumulates rounding errors
    counted = size[0] * size[1] * uniform_filter(count, size, mode="constant")
    return np.asarray(np.maximum(np.round(counted), 0.0))


def _episodes(place: Integers, time: Floats, passes: dict[int, Floats]) -> Integers:
    """Return the number of each detection's episode: at one place, until a gap or a pass."""
    if len(place) == 0:
        return np.zeros(0, np.int64)
    order = np.lexsort((time, place))
    place, time = place[order], time[order]
    moved = np.concatenate([[True], np.diff(place) != 0])
    new = moved | np.concatenate([[True], np.diff(time) > SILENCE_S])
    passed = np.zeros(len(time), np.int64)
    for a, b in pairwise(np.append(np.flatnonzero(moved), len(place)).tolist()):
        known = passes.get(int(place[a]))
        if known is not None:
            passed[a:b] = np.searchsorted(known, time[a:b])
    new |= np.concatenate([[True], np.diff(passed) != 0])
    number = np.empty(len(time), np.int64)
    number[order] = np.cumsum(new) - 1
    return number


def _on_strip(
    strip: int, begin: Floats, end: Floats, cell: Integers, end_seen: Integers, weight: Floats
) -> list[StationaryTarget]:
    """Return the stationary vehicles of a strip, found and associated second by second.

    The arrays have an entry for each scatterer: begin and end of its episode, cell along the strip,
    what the sensor sees, and weight.
    """
    half, low = 0.5 * SLICE_S, int(cell.min()) - 8
    count = int(cell.max()) + 9 - low
    window = int(_WINDOW_M / STRIP_CELL_M)
    rear_before = np.full(count + 1, NONE, np.int64)
    vehicles: Floats = np.zeros((0, 2))
    previous = np.zeros(0, np.bool_)
    associator = _Associator(strip, half)
    for now in np.arange(begin.min(), end.max() + SLICE_S, SLICE_S).tolist():
        active = (begin <= now + half) & (end >= now - half)
        if not np.array_equal(active, previous):
            weights = np.zeros((3, count))
            np.add.at(weights, (end_seen[active], cell[active] - low), weight[active])
            local = window * uniform_filter1d(weights.sum(axis=0), window, mode="constant")
            share = np.minimum(1.0, _MOST_WEIGHT / np.maximum(local, 1e-9))
            cells = pack(weights * share, rear_before)
            vehicles = np.asarray((cells + low) * STRIP_CELL_M, np.float64)
            previous = active
            rear_before[:] = NONE
            rear_before[cells[:, 1]] = cells[:, 0]
        associator.follow(vehicles, now)
    return associator.targets()


class _Associator:
    """Association of the stationary vehicles of a strip from second to second."""

    def __init__(self, line: int, half_s: float) -> None:
        self._line, self._half = line, half_s
        self._standing: list[tuple[list[Floats], float]] = []
        self._ended: list[StationaryTarget] = []
        self._now = 0.0

    def follow(self, spans_now: Floats, now: float) -> None:
        """Associate the vehicles (rear, front) of the next second with those of the last."""
        left = list(range(len(spans_now)))
        stay: list[tuple[list[Floats], float]] = []
        for spans, begin in self._standing:
            rear, front = spans[-1]
            apart = {
                k: min(
                    0.5 * (abs(spans_now[k, 0] - rear) + abs(spans_now[k, 1] - front)),
                    abs(0.5 * (spans_now[k].sum() - rear - front)),
                )
                for k in left
            }
            best = min(apart, key=lambda k: apart[k], default=NONE)
            if best == NONE or apart[best] >= _CHANGE_M:
                self._end(spans, begin)
                continue
            left.remove(best)
            spans.append(spans_now[best])
            stay.append((spans, begin))
        self._standing = stay + [([spans_now[k]], now) for k in left]
        self._now = now

    def _end(self, spans: list[Floats], begin: float) -> None:
        """End a vehicle at the median of its (rear, front)."""
        rear, front = np.median(np.array(spans), axis=0)
        self._ended.append(
            StationaryTarget(
                strip=self._line, rear_m=float(rear), front_m=float(front),
                begin=begin - self._half, end=self._now + self._half,
            )
        )  # fmt: skip

    def targets(self) -> list[StationaryTarget]:
        """Return all stationary vehicles of the strip."""
        for spans, begin in self._standing:
            self._end(spans, begin)
        self._standing = []
        return self._ended


def pack(weights: Floats, rear_before: Integers) -> Integers:
    """Return the vehicles (rear, front) along a strip under which the detections are likeliest.

    A dynamic program over the cells of their fronts: each vehicle has a prior cost, also by its
    length, a gain by the detections on it, and a cost of a short gap to the one behind.

    Parameters
    ----------
    weights : (3, n) array
        Weights of the detections by cell, of sensors that see a front, a rear, a side.
    rear_before : (n + 1,) int64 array
        By front, the rear of a vehicle that stood there one slice before, or `NONE`.
    """
    metres = np.arange(int(LONGEST_M / STRIP_CELL_M) + 1, dtype=np.float64) * STRIP_CELL_M
    prior = np.where(metres < _SHORTEST_M, -np.inf, length_prior(metres))
    return _pack(weights, _gains(weights), prior, rear_before)


@compiled
def _gains(weights: Floats) -> Floats:  # pragma: no cover - compiled
    """Return the gain, nats, of a front and of a rear at each boundary of cells, (2, n + 1)."""
    count = weights.shape[1]
    reach = int(4.0 * _END_M / STRIP_CELL_M)
    body = np.log((1.0 - _END_SHARE) / 5.0)
    inside, outside = np.empty(2 * reach), np.empty(2 * reach)  # by cell, from -reach on
    for j in range(2 * reach):
        off = (j - reach + 0.5) * STRIP_CELL_M
        peak = _END_SHARE * np.exp(-0.5 * (off / _END_M) ** 2) / (_END_M * 2.5066)
        inside[j] = np.log(peak + (1.0 - _END_SHARE) / 5.0) - body
        outside[j] = max(np.log(peak + 1e-9) - _LOG_CLUTTER, 0.0)
    gains = np.zeros((2, count + 1))
    for k in range(count + 1):
        for j in range(max(k - reach, 0), min(k + reach, count)):
            at = j - k + reach
            gains[0, k] += weights[0, j] * (inside[at] if j < k else outside[at])
            gains[1, k] += weights[1, j] * (inside[at] if j >= k else outside[at])
    return gains


@compiled
def _pack(
    weights: Floats, gains: Floats, prior: Floats, rear_before: Integers
) -> Integers:  # pragma: no cover - compiled
    """Return what `pack` does, with the gains of ends and the log priors of lengths in cells."""
    count = weights.shape[1]
    end_gain = np.log((1.0 - _END_SHARE) / 5.0) - _LOG_CLUTTER
    side_gain = np.log(0.2) - _LOG_CLUTTER
    ends, sides = np.zeros(count + 1), np.zeros(count + 1)
    for k in range(count):
        ends[k + 1] = ends[k] + weights[0, k] + weights[1, k]
        sides[k + 1] = sides[k] + weights[2, k]
    least_gap = int(np.ceil(_GAP_M / STRIP_CELL_M))
    easy_gap = int(np.ceil(_EASY_GAP_M / STRIP_CELL_M))
    best, rear_of = np.zeros(count + 1), np.full(count + 1, -1)
    behind, front_behind = np.zeros(count + 1), np.zeros(count + 1, np.int64)
    for f in range(1, count + 1):
        best[f] = best[f - 1]
        for r in range(max(f - len(prior) + 1, 0), f):
            if prior[f - r] < -50.0:
                continue
            score = (ends[f] - ends[r]) * end_gain + (sides[f] - sides[r]) * side_gain
            score += gains[0, f] + gains[1, r]
            if score <= 0.0:
                continue
            stays = _STAY_GAIN if rear_before[f] == r else 0.0
            score += prior[f - r] - _VEHICLE_COST + behind[r] + stays
            if score > best[f] + 1e-9:
                best[f], rear_of[f] = score, r
        behind[f], front_behind[f] = _best_behind(best, f, least_gap, easy_gap)
    return _traced(rear_of, front_behind)


@compiled
def _best_behind(
    best: Floats, rear: int, least_gap: int, easy_gap: int
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Return the best score behind a rear, less the cost of a short gap, and the front there."""
    top, place = -1e9, 0
    for gap in range(least_gap, easy_gap + 1):
        value = 0.0
        if rear > gap:
            value = best[rear - gap] - _TIGHT_COST * ((easy_gap - gap) * STRIP_CELL_M) ** 2
        if value > top:
            top, place = value, max(rear - gap, 0)
    return top, place


@compiled
def _traced(rear_of: Integers, front_behind: Integers) -> Integers:  # pragma: no cover - compiled
    """Return the vehicles (rear, front) of the best solution, traced back from the last cell."""
    count = len(rear_of) - 1
    vehicles = np.empty((count // 4 + 1, 2), np.int64)
    found, f = 0, count
    while f > 0:
        if rear_of[f] < 0:
            f -= 1
            continue
        vehicles[found, 0], vehicles[found, 1] = rear_of[f], f
        found += 1
        f = front_behind[rear_of[f]]
    return vehicles[:found]


def _with_rows(targets: list[StationaryTarget], still: _StillDetections) -> list[StationaryTarget]:
    """Return the stationary targets with their detections."""
    order = np.lexsort((still.s_m, still.strip))
    along = still.strip[order] * 1e5 + still.s_m[order]
    found = []
    for each in targets:
        ends = each.strip * 1e5 + np.array([each.rear_m - 0.6, each.front_m + 0.6])
        low, high = np.searchsorted(along, ends)
        k = order[low:high]
        k = np.sort(k[(still.time[k] >= each.begin) & (still.time[k] <= each.end)])
        found.append(replace(each, rows=still.row[k]))
    return found


def _typical_rate(motions: Sequence[Motion], detections: MapDetections) -> float:
    """Return the median of the vehicles' detection rate times the square of range, m2/s."""
    rates = []
    for motion in motions:
        lapse = float(np.ptp(detections.time[motion.rows]))
        if len(motion.rows) > 9 and lapse > 1.0:
            range_m = float(np.median(detections.range_m[motion.rows]))
            rates.append(len(motion.rows) / lapse * range_m**2)
    return float(np.median(rates)) if rates else 0.0


def detected_parts(
    target: StationaryTarget, detections: MapDetections, typical: float
) -> list[StationaryTarget]:
    """Split a stationary target at gaps; keep the parts that are detected often enough.

    Parameters
    ----------
    target : StationaryTarget
        A target with the rows of its detections, by time.
    detections : MapDetections
        The detections to which the rows refer.
    typical : float
        Typical detection rate times the square of range, m2/s; if it is 0, no part is kept.

    Returns
    -------
    list of StationaryTarget
        The parts, by time.
    """
    if typical <= 0.0:
        return []
    cuts = np.flatnonzero(np.diff(detections.time[target.rows]) > SILENCE_S) + 1
    found = []
    for rows in np.split(target.rows, cuts):
        if len(rows) < _LEAST_DETECTIONS:
            continue
        begin, end = (float(detections.time[rows[k]]) for k in (0, -1))
        expected = typical / float(np.median(detections.range_m[rows])) ** 2 * (end - begin)
        if end - begin >= _LEAST_S and len(rows) >= RATE_SHARE * expected:
            found.append(replace(target, begin=begin, end=end, rows=rows))
    return found

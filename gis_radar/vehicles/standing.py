"""Standing vehicles: what stands on a lane, told from what is built beside it.

Radars get returns of standing vehicles as of moving ones; what makes them hard is all else that
stands. Kerbs, parked cars and signs lie at the edge of a lane, a vehicle fills its middle; gantries
and mast arms hang above it. So still detections well inside of a lane are of vehicles, and how they
lie along it, with the end that each sensor looks at, tells where one vehicle ends and the next
begins. Where a vehicle drives over a place, what stood there is gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter, uniform_filter1d

from gis_radar.arrays import Booleans, Floats, Integers, compiled
from gis_radar.vehicles.columns import NONE
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.life_settings import StandingSettings
from gis_radar.vehicles.motion import Motion
from gis_radar.vehicles.size import LONGEST_M, length_prior
from gis_radar.vehicles.sweeps import CELLS, Sweeps

FRONT, REAR, SIDE = range(3)  # what of a vehicle a sensor looks at
SQUARE_COS = 0.5  # within 60 degrees of it
SLOT_S = 0.5  # of counts of what is built
CHANGE_M = 1.5  # by how much the ends of one vehicle may seem to move from second to second


@dataclass(frozen=True, kw_only=True)
class Stand:
    """A vehicle that stands.

    Parameters
    ----------
    strip : int
        On which strip.
    rear_m, front_m : float
        Along the strip.
    begin, end : float
        UNIX seconds, of the first and the last detection.
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
class _Still:
    """Still detections inside of lanes, in the order of time."""

    row: Integers
    strip: Integers
    s_m: Floats
    time: Floats
    kind: Integers  # FRONT, REAR or SIDE
    episode: Integers

    def take(self, keep: Booleans) -> _Still:
        return _Still(**{name: getattr(self, name)[keep] for name in self.__dataclass_fields__})


def find_stands(
    echoes: Echoes,
    free: Booleans,
    motions: Sequence[Motion],
    sweeps: Sweeps,
    settings: StandingSettings,
) -> list[Stand]:
    """Return the vehicles that stand, as far as still detections of nothing else tell.

    Parameters
    ----------
    echoes : Echoes
        All detections.
    free : (n,) bool array
        Which are still, and of no moving vehicle.
    motions : sequence of Motion
        Vehicles that move: how often they are seen says how often a standing one would be.
    sweeps : Sweeps
        Where they drove.
    settings : StandingSettings
        Constants.
    """
    still = _still_inside(echoes, free, sweeps, settings)
    if len(still.row) == 0:
        return []
    count = int(still.episode.max()) + 1
    begin, end = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(begin, still.episode, still.time)
    np.maximum.at(end, still.episode, still.time)
    # what one sensor sees of one cell in one episode: a scatterer that lasts
    cell = (still.s_m / settings.cell_m).astype(np.int64)
    sensor = echoes.sensor[still.row]
    key = np.column_stack([still.episode, cell, still.kind, sensor])
    groups, first, seen = np.unique(key, axis=0, return_index=True, return_counts=True)
    weight = seen.astype(np.float64) ** settings.power
    strip = still.strip[first]
    stands: list[Stand] = []
    for line in np.unique(strip).tolist():
        mine = np.flatnonzero(strip == line)
        episode = groups[mine, 0]
        stands += _on_strip(
            line, begin[episode], end[episode], groups[mine, 1], groups[mine, 2], weight[mine],
            settings,
        )  # fmt: skip
    usual = _usual_rate(motions, echoes)
    return [
        part
        for each in _with_rows(stands, still)
        for part in _heard_parts(each, echoes, usual, settings)
    ]


def _still_inside(
    echoes: Echoes, free: Booleans, sweeps: Sweeps, settings: StandingSettings
) -> _Still:
    """Return the still detections inside of lanes, with what lasts in a cell as one episode."""
    rows = np.flatnonzero(free)
    at = sweeps.strips.lay(echoes.points[rows])
    inside = at.edge_m > settings.inside_m
    row, heading = rows[at.row[inside]], at.heading[inside]
    order = np.argsort(echoes.time[row], kind="stable")
    row, heading = row[order], heading[order]
    cos = np.cos(heading) * echoes.sight[row, 0] + np.sin(heading) * echoes.sight[row, 1]
    square = np.abs(cos) >= SQUARE_COS
    strip, s_m = at.strip[inside][order], at.s_m[inside][order]
    place = strip * CELLS + ((s_m / settings.cell_m).astype(np.int64) // 2)
    found = _Still(
        row=row, strip=strip, s_m=s_m, time=echoes.time[row],
        kind=np.where(square, np.where(cos < 0.0, FRONT, REAR), SIDE),
        episode=_episodes(place, echoes.time[row], sweeps.times, settings.silence_s),
    )  # fmt: skip
    if len(row) == 0:
        return found
    # what hangs above the lane is no vehicle: by the median height of each episode
    height = np.nan_to_num(echoes.height_m[row])
    rank = np.lexsort((height, found.episode))
    bounds = np.searchsorted(found.episode[rank], np.arange(found.episode.max() + 2))
    median = height[rank][(bounds[:-1] + bounds[1:]) // 2]
    return found.take(median[found.episode] < settings.high_m)


def not_built(
    echoes: Echoes, free: Booleans, sweeps: Sweeps, settings: StandingSettings
) -> Booleans:
    """Return which still detections are free and of nothing that is part of the road.

    Parameters
    ----------
    echoes : Echoes
        All detections.
    free : (n,) bool array
        Which are still, and of no moving vehicle.
    sweeps : Sweeps
        Where vehicles drove, and when.
    settings : StandingSettings
        Constants.
    """
    rows = np.flatnonzero(free)
    at = sweeps.strips.lay(echoes.points[rows])
    row = rows[at.row]
    place = at.strip * CELLS + ((at.s_m / settings.cell_m).astype(np.int64) // 2)
    order = np.argsort(echoes.time[row], kind="stable")
    row, place = row[order], place[order]
    built = _built(place, echoes.sensor[row], echoes.time[row], sweeps.fast, settings)
    left = free.copy()
    left[row[built]] = False
    return left


def _built(
    place: Integers, sensor: Integers, time: Floats, fast: dict[int, Floats],
    settings: StandingSettings,
) -> Booleans:  # fmt: skip
    """Tell what is part of the road: seen a moment before or after vehicles drive over it fast.

    What comes clearly more often than usual then, from as much road as a car takes, is not.
    """
    built = np.zeros(len(place), np.bool_)
    if len(place) == 0:
        return built
    near, far = settings.after_s
    half = 0.5 * (far - near)
    slot = ((time - time.min()) / SLOT_S).astype(np.int64)
    line = place // CELLS * 64 + sensor
    order = np.lexsort((time, place, line))
    for rows in np.split(order, np.flatnonzero(np.diff(line[order])) + 1):
        count = _counts(place[rows], slot[rows], int(slot.max()) + 1, settings)
        lowest = place[rows[0]]
        for part in np.split(rows, np.flatnonzero(np.diff(place[rows])) + 1):
            over = fast.get(int(place[part[0]]))
            if over is None:
                continue
            over = over[np.concatenate([[True], np.diff(over) > far])]
            empty = np.stack([over - half - near, over + half + near])
            low, high = (np.searchsorted(time[part], empty + way * half) for way in (-1.0, 1.0))
            seen = (high > low).any(axis=0)
            if seen.sum() >= settings.least_built and seen.mean() >= settings.built_share:
                here = count[place[part[0]] - lowest]
                when = np.floor((empty - time.min()) / SLOT_S).astype(np.int64)
                then = here[when[(when >= 0) & (when < len(here))]]
                usual = float(np.median(then)) if len(then) else 0.0
                # of few counts the sigma is that of one
                more = settings.more_sigmas * np.sqrt(max(usual, 1.0))
                built[part] = here[slot[part]] <= usual + more
    return built


def _counts(place: Integers, slot: Integers, slots: int, settings: StandingSettings) -> Floats:
    """Return by cell and half second how many lie within a car's length, in 2.5 seconds."""
    cells = place - place.min()
    count = np.zeros((int(cells.max()) + 1, slots))
    np.add.at(count, (cells, slot), 1.0)
    size = (int(settings.car_m / settings.cell_m) // 2, 5)
    # a running sum leaves traces of what has left it
    counted = size[0] * size[1] * uniform_filter(count, size, mode="constant")
    return np.asarray(np.maximum(np.round(counted), 0.0))


def _episodes(
    place: Integers, time: Floats, sweeps: dict[int, Floats], silence_s: float
) -> Integers:
    """Return a number for what comes from each place until it is silent or driven over."""
    if len(place) == 0:
        return np.zeros(0, np.int64)
    order = np.lexsort((time, place))
    place, time = place[order], time[order]
    moved = np.concatenate([[True], np.diff(place) != 0])
    new = moved | np.concatenate([[True], np.diff(time) > silence_s])
    swept = np.zeros(len(time), np.int64)
    for a, b in pairwise(np.append(np.flatnonzero(moved), len(place)).tolist()):
        known = sweeps.get(int(place[a]))
        if known is not None:
            swept[a:b] = np.searchsorted(known, time[a:b])
    new |= np.concatenate([[True], np.diff(swept) != 0])
    number = np.empty(len(time), np.int64)
    number[order] = np.cumsum(new) - 1
    return number


def _on_strip(
    line: int, begin: Floats, end: Floats, cell: Integers, kind: Integers, weight: Floats,
    settings: StandingSettings,
) -> list[Stand]:  # fmt: skip
    """Return the vehicles that stand on a strip, followed from second to second."""
    half, low = 0.5 * settings.slice_s, int(cell.min()) - 8
    count = int(cell.max()) + 9 - low
    window = int(settings.window_m / settings.cell_m)
    held = np.full(count + 1, NONE, np.int64)
    found: Floats = np.zeros((0, 2))
    previous = np.zeros(0, np.bool_)
    book = _Followed(line, half)
    for now in np.arange(begin.min(), end.max() + settings.slice_s, settings.slice_s).tolist():
        active = (begin <= now + half) & (end >= now - half)
        if not np.array_equal(active, previous):
            weights = np.zeros((3, count))
            np.add.at(weights, (kind[active], cell[active] - low), weight[active])
            local = window * uniform_filter1d(weights.sum(axis=0), window, mode="constant")
            share = np.minimum(1.0, settings.most_weight / np.maximum(local, 1e-9))
            cells = pack(weights * share, held, settings)
            found = np.asarray((cells + low) * settings.cell_m, np.float64)
            previous = active
            held[:] = NONE
            held[cells[:, 1]] = cells[:, 0]
        book.follow(found, now)
    return book.stands()


class _Followed:
    """Vehicles of a strip from second to second: which of now is which of before."""

    def __init__(self, line: int, half_s: float) -> None:
        self._line, self._half = line, half_s
        self._open: list[tuple[list[Floats], float]] = []
        self._done: list[Stand] = []
        self._now = 0.0

    def follow(self, found: Floats, now: float) -> None:
        """Take the (rear, front) of all vehicles now."""
        left = list(range(len(found)))
        stay: list[tuple[list[Floats], float]] = []
        for spans, begin in self._open:
            rear, front = spans[-1]
            apart = {
                k: min(
                    0.5 * (abs(found[k, 0] - rear) + abs(found[k, 1] - front)),
                    abs(0.5 * (found[k].sum() - rear - front)),
                )
                for k in left
            }
            best = min(apart, key=lambda k: apart[k], default=NONE)
            if best == NONE or apart[best] >= CHANGE_M:
                self._end(spans, begin)
                continue
            left.remove(best)
            spans.append(found[best])
            stay.append((spans, begin))
        self._open = stay + [([found[k]], now) for k in left]
        self._now = now

    def _end(self, spans: list[Floats], begin: float) -> None:
        rear, front = np.median(np.array(spans), axis=0)
        self._done.append(
            Stand(
                strip=self._line, rear_m=float(rear), front_m=float(front),
                begin=begin - self._half, end=self._now + self._half,
            )
        )  # fmt: skip

    def stands(self) -> list[Stand]:
        """Return all of them."""
        for spans, begin in self._open:
            self._end(spans, begin)
        self._open = []
        return self._done


def pack(weights: Floats, held: Integers, settings: StandingSettings) -> Integers:
    """Return the vehicles along a strip that explain detections best, a row (rear, front) each.

    A dynamic program over the cells of their fronts: each pays for being there and for its length,
    gains by the detections that it explains, and leaves room to the one ahead.

    Parameters
    ----------
    weights : (3, n) array
        By cell, of detections by sensors that look at a front, a rear, a side.
    held : (n + 1,) int64 array
        By front, the rear of a vehicle that stood so before, or `NONE`.
    settings : StandingSettings
        Constants.
    """
    metres = np.arange(int(LONGEST_M / settings.cell_m) + 1, dtype=np.float64) * settings.cell_m
    prior = np.where(metres < settings.shortest_m, -np.inf, length_prior(metres))
    gains = _gains(
        weights, settings.cell_m, settings.end_m, settings.end_share, np.log(settings.clutter)
    )
    limits = np.array(
        [
            settings.cell_m, settings.stick, settings.gap_m, settings.easy_m, settings.tight,
            np.log(settings.clutter), settings.end_share, settings.new_cost,
        ]
    )  # fmt: skip
    return _pack(weights, gains, prior, held, limits)


@compiled
def _gains(
    weights: Floats, cell_m: float, end_m: float, end_share: float, log_clutter: float
) -> Floats:  # pragma: no cover - compiled
    """Return by boundary of cells what a front and what a rear there gains over a mere body."""
    count = weights.shape[1]
    reach = int(4.0 * end_m / cell_m)
    body = np.log((1.0 - end_share) / 5.0)
    gains = np.zeros((2, count + 1))
    for k in range(count + 1):
        for j in range(max(k - reach, 0), min(k + reach, count)):
            off = (j + 0.5 - k) * cell_m
            peak = end_share * np.exp(-0.5 * (off / end_m) ** 2) / (end_m * 2.5066)
            inside = np.log(peak + (1.0 - end_share) / 5.0) - body
            outside = max(np.log(peak + 1e-9) - log_clutter, 0.0)
            gains[0, k] += weights[0, j] * (inside if off < 0.0 else outside)
            gains[1, k] += weights[1, j] * (inside if off > 0.0 else outside)
    return gains


@compiled
def _pack(
    weights: Floats, gains: Floats, prior: Floats, held: Integers, limits: Floats
) -> Integers:  # pragma: no cover - compiled
    cell_m, stick, gap_m, easy_m, tight, log_clutter, end_share, cost = limits
    count = weights.shape[1]
    end_gain, side_gain = np.log((1.0 - end_share) / 5.0) - log_clutter, np.log(0.2) - log_clutter
    ends, sides = np.zeros(count + 1), np.zeros(count + 1)
    for k in range(count):
        ends[k + 1] = ends[k] + weights[0, k] + weights[1, k]
        sides[k + 1] = sides[k] + weights[2, k]
    room, wide = int(np.ceil(gap_m / cell_m)), int(np.ceil(easy_m / cell_m))
    best, back = np.zeros(count + 1), np.full(count + 1, -1)
    ahead, before = np.zeros(count + 1), np.zeros(count + 1, np.int64)
    for f in range(1, count + 1):
        best[f] = best[f - 1]
        for r in range(max(f - len(prior) + 1, 0), f):
            if prior[f - r] < -50.0:
                continue
            score = (ends[f] - ends[r]) * end_gain + (sides[f] - sides[r]) * side_gain
            score += gains[0, f] + gains[1, r]
            if score <= 0.0:
                continue
            score += prior[f - r] - cost + ahead[r] + (stick if held[f] == r else 0.0)
            if score > best[f] + 1e-9:
                best[f], back[f] = score, r
        ahead[f], before[f] = _room_before(best, f, room, wide, tight, cell_m)
    return _traced(back, before)


@compiled
def _room_before(
    best: Floats, rear: int, room: int, wide: int, tight: float, cell_m: float
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Return the best of all before a rear, and where it ends: drivers leave 2 m, seldom less."""
    top, place = -1e9, 0
    for more in range(room, wide + 1):
        value = 0.0
        if rear > more:
            value = best[rear - more] - tight * ((wide - more) * cell_m) ** 2
        if value > top:
            top, place = value, max(rear - more, 0)
    return top, place


@compiled
def _traced(back: Integers, before: Integers) -> Integers:  # pragma: no cover - compiled
    """Return the vehicles (rear, front) of the best way back from the last cell."""
    count = len(back) - 1
    out = np.empty((count // 4 + 1, 2), np.int64)
    found, f = 0, count
    while f > 0:
        if back[f] < 0:
            f -= 1
            continue
        out[found, 0], out[found, 1] = back[f], f
        found += 1
        f = before[back[f]]
    return out[:found]


def _with_rows(stands: list[Stand], still: _Still) -> list[Stand]:
    """Return the stands with their detections."""
    order = np.lexsort((still.s_m, still.strip))
    along = still.strip[order] * 1e5 + still.s_m[order]
    found = []
    for each in stands:
        ends = each.strip * 1e5 + np.array([each.rear_m - 0.6, each.front_m + 0.6])
        low, high = np.searchsorted(along, ends)
        k = order[low:high]
        k = np.sort(k[(still.time[k] >= each.begin) & (still.time[k] <= each.end)])
        found.append(replace(each, rows=still.row[k]))
    return found


def _usual_rate(motions: Sequence[Motion], echoes: Echoes) -> float:
    """Return how often vehicles are seen: detections a second, times the square of the range."""
    rates = []
    for motion in motions:
        lapse = float(np.ptp(echoes.time[motion.rows]))
        if len(motion.rows) > 9 and lapse > 1.0:
            range_m = float(np.median(echoes.range_m[motion.rows]))
            rates.append(len(motion.rows) / lapse * range_m**2)
    return float(np.median(rates)) if rates else 0.0


def _heard_parts(
    stand: Stand, echoes: Echoes, usual: float, settings: StandingSettings
) -> list[Stand]:
    """Split a stand at silences; keep what is seen often enough, none where that is unknown."""
    if usual <= 0.0:
        return []
    cuts = np.flatnonzero(np.diff(echoes.time[stand.rows]) > settings.silence_s) + 1
    found = []
    for rows in np.split(stand.rows, cuts):
        if len(rows) < settings.least_echoes:
            continue
        begin, end = (float(echoes.time[rows[k]]) for k in (0, -1))
        expected = usual / float(np.median(echoes.range_m[rows])) ** 2 * (end - begin)
        if end - begin >= settings.least_s and len(rows) >= settings.rate_share * expected:
            found.append(replace(stand, begin=begin, end=end, rows=rows))
    return found

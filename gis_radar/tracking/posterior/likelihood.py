"""Detections of a vehicle: where on it, how fast, how many, and how much others hide."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.tracking.size import LONG_M

ON_FACES = 0.75  # share of detections of the faces that are seen; others are of all the body
FACE_M, FACE_RAD = 0.35, 0.004  # standard deviation across a face: its depth, and of the azimuth
RATE_MPS, RATE_SHARE = 0.25, 0.02  # standard deviation of the range rate of a body
WHEELS, TURNS = 0.13, 2.1  # share of detections of wheels, and up to how often the body's speed
REACH_M = 2.0  # farther from the body no detection is of it
CLEAR_M = 0.3  # between the sides of two vehicles abreast, at least
THROUGH = 0.3  # share that a vehicle returns of what another one hides
MAST_M, LOOK_M = 6.0, 0.6  # heights over the road: of a sensor, and of what is seen of a vehicle
CAR_M, LORRY_M, BOTTOM_M = 1.5, 3.2, 0.2  # heights of bodies, and where they begin
HEIGHT_M, HEIGHT_RAD = 0.2, 0.0185  # standard deviation of a height over the road
STANDS_MPS = 0.5
STRAIGHT = 0.003  # curvature, 1 / m, by which a lorry bends by a hand's breadth
CELL_M = 4.0  # in a cell a sensor sees all vehicles alike
FAR_M, ASPECTS = 10.0, (0.5, 0.87)  # kinds of states: by range, and by the cosine of the aspect
KINDS = (21, 3, 2, 2)  # ranges, aspects, long or not, standing or not

Rates: TypeAlias = tuple[Floats, Floats, Floats, Floats, Integers]  # eyes table factor corner size
Seen: TypeAlias = tuple[Integers, Floats, Floats, Floats, Floats, Floats, Floats]
# first points sight range rate height total


@compiled
def _blurred(x: float, half: float, sigma: float) -> float:
    """Return the density of a uniform distribution on +-half, blurred."""
    root = sigma * 1.4142135623730951
    return 0.25 * (math.erf((x + half) / root) - math.erf((x - half) / root)) / half


@compiled
def _normal(x: float, sigma: float) -> float:
    z = x / sigma
    return 0.3989422804014327 / sigma * math.exp(-0.5 * z * z)


@compiled
def place_density(
    along: float, left: float, cos: float, sin: float, length: float, width: float, away: float
) -> float:
    """Return the density of a place on a body, 1 / m2.

    `cos` and `sin` are of the angle from the heading to the line of sight.
    """
    sigma, by_width, of_flank = density_across(left, cos, sin, width, away)
    return density_along(along, cos, sin, length, width, sigma, by_width, of_flank)


@compiled
def density_across(
    left: float, cos: float, sin: float, width: float, away: float
) -> tuple[float, float, float]:
    """Return what of the density of a place does not depend on the length of the body.

    Returns
    -------
    sigma : float
        Standard deviation along the body, m.
    by_width, of_flank : float
        Density across the whole body, and across the flank that is seen, 1 / m.
    """
    left_sigma = math.hypot(FACE_M, FACE_RAD * away * cos)
    side = 0.5 * width
    flank = -side if sin > 0.0 else side
    by_width = _blurred(left, side, left_sigma)
    return math.hypot(FACE_M, FACE_RAD * away * sin), by_width, _normal(left - flank, left_sigma)


@compiled
def density_along(
    along: float, cos: float, sin: float, length: float, width: float,
    sigma: float, by_width: float, of_flank: float,
) -> float:  # fmt: skip
    """Return the density of a place on a body, 1 / m2, by what `density_across` returns."""
    ends = width * abs(cos)
    share = ends / (ends + length * abs(sin) + 1e-9)
    half = 0.5 * length
    end = -half if cos > 0.0 else half
    by_length = _blurred(along, half, sigma)
    faces = share * (_normal(along - end, sigma) * by_width)
    faces += (1.0 - share) * (of_flank * by_length)
    return ON_FACES * faces + (1.0 - ON_FACES) * by_length * by_width


@compiled
def rate_density(rate: float, radial: float) -> float:
    """Return the density of a range rate of a body that moves so along the line of sight, s / m."""
    found = (1.0 - WHEELS) * _normal(rate - radial, RATE_MPS + RATE_SHARE * abs(radial))
    top = max(TURNS * abs(radial), 2.0 * RATE_MPS)
    turned = rate if radial >= 0.0 else -rate
    if -RATE_MPS < turned < top:
        found += WHEELS / (top + RATE_MPS)
    return found


@compiled
def taller(height: float, away: float) -> float:
    """Return how much denser a height is for a lorry or bus than for a car; 1 where unknown."""
    if not math.isfinite(height):
        return 1.0
    sigma = HEIGHT_M + HEIGHT_RAD * away
    tall, low = 0.5 * (LORRY_M - BOTTOM_M), 0.5 * (CAR_M - BOTTOM_M)
    of_lorry = _blurred(height - BOTTOM_M - tall, tall, sigma)
    of_car = _blurred(height - BOTTOM_M - low, low, sigma)
    return min(max(of_lorry / max(of_car, 1e-9), 0.2), 5.0)  # heights of one body are off alike


@compiled
def kind_and_cell(shape: Floats, sensor: int, rates: Rates) -> tuple[int, int]:
    """Return the kind of a state, as a position in the table of rates, and its cell."""
    eyes, _, _, corner, size = rates
    x, y, speed, length = shape[0], shape[1], shape[4], shape[5]
    dx, dy = x - eyes[sensor, 0], y - eyes[sensor, 1]
    far = math.sqrt(dx * dx + dy * dy)  # a third of the time of hypot
    facing = abs(dx * shape[2] + dy * shape[3]) / max(far, 1e-6)
    aspect = 0 if facing < ASPECTS[0] else (1 if facing < ASPECTS[1] else 2)
    kind = (min(int(far / FAR_M), KINDS[0] - 1) * KINDS[1] + aspect) * 2
    kind = (kind + (1 if length > LONG_M else 0)) * 2 + (1 if speed < STANDS_MPS else 0)
    i = min(max(int((x - corner[0]) / CELL_M), 0), size[0] - 1)
    j = min(max(int((y - corner[1]) / CELL_M), 0), size[1] - 1)
    return kind, (sensor * size[0] + i) * size[1] + j


@compiled
def kinds_and_cells(shape: Floats, sensor: Integers, rates: Rates) -> Integers:
    """Return (n, 2) the kind and the cell of each state."""
    found = np.empty((len(shape), 2), np.int64)
    for e in range(len(shape)):
        found[e, 0], found[e, 1] = kind_and_cell(shape[e], sensor[e], rates)
    return found


@compiled
def on_body(shape: Floats, dx: float, dy: float) -> tuple[float, float, float]:
    """Return how far a place is along a body from its middle and left of it, and its turn there.

    A body bends with its path, ahead and behind by an arc each.
    """
    along, left = dx * shape[2] + dy * shape[3], dy * shape[2] - dx * shape[3]
    bend = shape[8] if along > 0.0 else shape[7]
    if abs(bend) < STRAIGHT:
        return along, left, 0.0
    across = 1.0 - bend * left
    turn = math.atan2(bend * along, across)
    return turn / bend, (1.0 - math.hypot(bend * along, across)) / bend, turn


@compiled
def _near(along: float, left: float, length: float, width: float) -> bool:
    return abs(along) < 0.5 * length + REACH_M and abs(left) < 0.5 * width + REACH_M


@compiled
def _reach(length: float, width: float) -> float:
    """Return a distance from the middle of a body beyond which nothing is near it."""
    return 0.5 * (length + width) + 2.0 * REACH_M


@compiled
def aspect(c: float, s: float, turn: float, sight: Floats) -> tuple[float, float]:
    """Return cosine and sine of the angle from the heading, turned, to the line of sight."""
    cos, sin = c * sight[0] + s * sight[1], c * sight[1] - s * sight[0]
    if turn == 0.0:
        return cos, sin
    a, b = math.cos(turn), math.sin(turn)
    return cos * a + sin * b, sin * a - cos * b


@compiled
def densities(shape: Floats, frame: int, seen: Seen, room: Floats, row: Integers, n: int) -> int:
    """Fill in the detections that a state may explain, and how dense each is, from place n on.

    Returns
    -------
    int
        The place after the last; what finds no room is left out.
    """
    first, points, sight, away, rate, height, _ = seen
    # one by one: to unpack an array takes five times as long
    x, y, c, s, speed = shape[0], shape[1], shape[2], shape[3], shape[4]
    length, width = shape[5], shape[6]
    reach = _reach(length, width)
    for d in range(first[frame], first[frame + 1]):
        dx, dy = points[d, 0] - x, points[d, 1] - y
        if (abs(dx) > reach) | (abs(dy) > reach):  # one jump: few are near
            continue
        along, left, turn = on_body(shape, dx, dy)
        if not _near(along, left, length, width) or n >= len(room):
            continue
        cos, sin = aspect(c, s, turn, sight[d])
        found = place_density(along, left, cos, sin, length, width, away[d])
        found *= rate_density(rate[d], speed * cos)
        if length > LONG_M:
            found *= taller(height[d], away[d])
        room[n, 0], row[n] = found, d
        n += 1
    return n


@compiled
def gain_of(room: Floats, count: int, due: float, alpha: float) -> tuple[float, float]:
    """Return by how much the log-probability is higher with a vehicle, and its brightness.

    Parameters
    ----------
    room : (n, 2) array
        Of each detection its rate by the vehicle and by all else.
    count : int
        How many there are.
    due : float
        Expected number of detections.
    alpha : float
        Shape of the gamma distribution of brightness, whose mean is 1. Brightness is integrated
        out: exactly where no detection is of the vehicle (0 where none is due), and where all are.
    """
    n, bright = 0.0, 1.0
    for _ in range(5 if count > 0 else 1):
        n = 0.0
        for q in range(count):
            lit = room[q, 0] * bright
            n += lit / (room[q, 1] + lit)
        bright = (alpha + n) / (alpha + due)
    gain = alpha * math.log(alpha * bright) - (alpha + n) * math.log(alpha + n)
    if n > 0.0:
        gain += math.lgamma(alpha + n) - math.lgamma(alpha)
    for q in range(count):
        gain += math.log(1.0 + room[q, 0] * bright / room[q, 1])
    return gain, bright


@compiled
def runs_in(group: Integers) -> int:
    """Return the number of runs of equal numbers."""
    count = min(len(group), 1)
    for e in range(1, len(group)):
        count += group[e] != group[e - 1]
    return count


@compiled
def evaluate(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, frame: Integers, sensor: Integers, shape: Floats, open_share: Floats,
    rates: Rates, seen: Seen, alpha: Floats, add: bool,  # noqa: FBT001
) -> Floats:  # fmt: skip
    """Return (groups, 2) the gain of a vehicle over all else in each group, and what is due.

    With `add` its rates are added to the total of `seen`.
    """
    found = np.zeros((runs_in(group), 2))
    room, row = np.empty((4096, 2)), np.empty(4096, np.int64)
    total, e = seen[6], 0
    for g in range(len(found)):
        n, due, stands = 0, 0.0, 1 if shape[e, 4] < STANDS_MPS else 0
        mine = group[e]
        while e < len(group) and group[e] == mine:
            kind, cell = kind_and_cell(shape[e], sensor[e], rates)
            mu = rates[1][kind] * rates[2][cell] * open_share[e]
            begin, n = n, densities(shape[e], frame[e], seen, room, row, n)
            for q in range(begin, n):
                room[q, 0], room[q, 1] = room[q, 0] * mu, total[row[q]]
            due += mu
            e += 1
        found[g, 0], bright = gain_of(room, n, due, alpha[stands])
        found[g, 1] = due
        for q in range(n if add else 0):
            total[row[q]] += room[q, 0] * bright
    return found


@compiled
def evaluate_pairs(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, shape: Floats, due: Floats, begin: Integers, density: Floats, row: Integers,
    rate: Floats, total: Floats, alpha: Floats,
) -> Floats:  # fmt: skip
    """Return what `evaluate` does for a vehicle that is part of the total, at this rate.

    The detections of each state are those from `begin` on.
    """
    found, room = np.zeros((runs_in(group), 2)), np.empty((len(row), 2))
    e = 0
    for g in range(len(found)):
        n, stands = 0, 1 if shape[e, 4] < STANDS_MPS else 0
        mine = group[e]
        while e < len(group) and group[e] == mine:
            for q in range(begin[e], begin[e + 1]):
                room[n, 0], room[n, 1] = density[q] * due[e], total[row[q]] - rate[q]
                n += 1
            found[g, 1] += due[e]
            e += 1
        found[g, 0], _ = gain_of(room, n, found[g, 1], alpha[stands])
    return found


@compiled
def _half_across(shape: Floats, x: float, y: float, far: float) -> float:
    """Return half the width of a body as seen along a direction (x, y) of length far."""
    c, s = shape[2], shape[3]
    across = shape[5] * abs(c * y - s * x) + shape[6] * abs(c * x + s * y)
    return float(0.5 * across / far)


@compiled
def hide(
    order: Integers, first: Integers, sensor: Integers, shape: Floats, eyes: Floats,
    open_share: Floats,
) -> None:  # fmt: skip
    """Fill in which share of each state others do not hide; `order` sorts them by frame."""
    place = np.empty((int(np.diff(first).max()), 3))  # from the eye, and how wide at most
    for f in range(len(first) - 1):
        ex, ey = eyes[sensor[f], 0], eyes[sensor[f], 1]
        here = order[first[f] : first[f + 1]]
        for a in range(len(here)):
            place[a, 0], place[a, 1] = shape[here[a], 0] - ex, shape[here[a], 1] - ey
            place[a, 2] = 0.5 * (shape[here[a], 5] + shape[here[a], 6])
        for a in range(len(here)):
            i, x, y = here[a], place[a, 0], place[a, 1]
            far = max(math.hypot(x, y), 1.0)
            half = _half_across(shape[i], x, y, far)
            for b in range(len(here)):
                ahead = place[b, 0] * x + place[b, 1] * y  # times far, as aside
                aside = place[b, 0] * y - place[b, 1] * x
                beside = abs(aside) * far > half * ahead + place[b, 2] * far * far
                if (ahead <= far) | (ahead >= far * far) | beside or a == b:  # hides nothing
                    continue
                near, aside = ahead / far, aside / far
                over = LOOK_M + (MAST_M - LOOK_M) * (1.0 - near / far)  # of the ray over the road
                if over > (LORRY_M if shape[here[b], 5] > LONG_M else CAR_M):
                    continue
                mine, other = half * near / far, _half_across(shape[here[b]], x, y, far)
                both = min(mine, aside + other) - max(-mine, aside - other)
                open_share[i] *= 1.0 - (1.0 - THROUGH) * max(both, 0.0) / (2.0 * mine + 1e-9)


@compiled
def overlap(
    rows: Integers, frame: Integers, shape: Floats, alive: Booleans, order: Integers,
    first: Integers,
) -> Floats:  # fmt: skip
    """Return which share of the shorter of two lies on another vehicle, for states of one."""
    share = np.zeros(len(rows))
    for k in range(len(rows)):
        e = rows[k]
        x, y, c, s = shape[e, 0], shape[e, 1], shape[e, 2], shape[e, 3]
        length, width = shape[e, 5], shape[e, 6]
        for a in range(first[frame[e]], first[frame[e] + 1]):
            o = order[a]
            dx, dy = shape[o, 0] - x, shape[o, 1] - y
            apart = 0.5 * (length + shape[o, 5] + width + shape[o, 6]) + CLEAR_M
            if (abs(dx) > apart) | (abs(dy) > apart):  # one jump: few are near
                continue
            if rows[0] <= o <= rows[-1] or not alive[o]:
                continue
            along, aside, turn = on_body(shape[e], dx, dy)
            if abs(aside) > 0.5 * (width + shape[o, 6]) + CLEAR_M:
                continue
            if abs(aspect(c, s, turn, shape[o, 2:4])[0]) < 0.8:
                continue
            least = min(length, shape[o, 5])
            both = 0.5 * (length + shape[o, 5]) - abs(along)
            share[k] = max(share[k], min(both, least) / least)
    return share


@compiled
def find_pairs(shape: Floats, frame: Integers, seen: Seen) -> tuple[Integers, Floats, Integers]:
    """Return the detections that each state may explain.

    Returns
    -------
    begin : (states + 1,) int64 array
        Where those of each state begin.
    density, row : (n,) arrays
        How dense the state makes them, and which they are.
    """
    first, most = seen[0], 0
    for e in range(len(frame)):
        most += first[frame[e] + 1] - first[frame[e]]
    begin, room, row = (
        np.zeros(len(frame) + 1, np.int64),
        np.empty((most, 2)),
        np.empty(most, np.int64),
    )
    for e in range(len(frame)):
        begin[e + 1] = densities(shape[e], frame[e], seen, room, row, begin[e])
    return begin, room[: begin[-1], 0].copy(), row[: begin[-1]].copy()

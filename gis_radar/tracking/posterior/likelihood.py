"""Likelihood of the detections of a vehicle: place on the body, range rate, number, occlusion."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from gis_radar.base import Booleans, Floats, Integers, compiled
from gis_radar.tracking.detections import AZIMUTH_RAD
from gis_radar.tracking.size import LONG_M

_ON_FACES = 0.75  # share of detections of the faces that the sensor sees; others: of all the body
_FACE_M = 0.35  # sigma of the depth of a face
# Sigma of the range rate of a body, and per m/s of it.
_BODY_RATE_SIGMA_MPS, _RATE_SHARE = 0.25, 0.02
# Share of detections of wheels, and their largest range rate as a multiple of the body's: the rim
# of a wheel moves at up to twice its speed.
_WHEELS, _MOST_TURNS = 0.13, 2.1
REACH_M = 2.0  # largest distance of a vehicle's detections from its body
_ABREAST_M = 0.3  # least distance between the sides of two vehicles abreast
_SHARE_BEHIND = 0.3  # share of its detections that a vehicle gives where another one hides it
# Heights over the road: of a sensor, and of a vehicle's scatterers.
_SENSOR_M, _SCATTERER_M = 6.0, 0.6
_CAR_M, _LORRY_M, _BOTTOM_M = 1.5, 3.2, 0.2  # heights over the road: of tops, and of undersides
_HEIGHT_M, _HEIGHT_RAD = 0.2, 0.0185  # sigma of a height over the road: fixed, and of the elevation
STANDS_MPS = 0.5  # slower vehicles count as standing
STRAIGHT = 0.003  # curvature, 1/m, below which a body counts as straight: a lorry is 0.1 m off
RATE_CELL_M = 4.0  # side of the map cells in which factors on the detection rate are learned
# Classes of states: width of a bin of range, bounds of the cosine of the aspect; and the numbers of
# ranges, aspects, lengths (up to LONG_M, over it) and motions (moving, standing).
_RANGE_BIN_M, _ASPECTS = 10.0, (0.5, 0.87)
CLASSES = (21, 3, 2, 2)

# Positions of sensors, expected detections by class, factors by cell, corner and size of the cells.
RateModel: TypeAlias = tuple[Floats, Floats, Floats, Floats, Integers]
# First detection of each frame; points, sight, range, range rate, height, total rate of detections.
DetectionArrays: TypeAlias = tuple[Integers, Floats, Floats, Floats, Floats, Floats, Floats]


@compiled
def _blurred(x: float, half: float, sigma: float) -> float:
    """Return the density of a uniform variable on +-half with normal noise of that sigma."""
    root = sigma * 1.4142135623730951
    return 0.25 * (math.erf((x + half) / root) - math.erf((x - half) / root)) / half


@compiled
def _normal(x: float, sigma: float) -> float:
    """Return the density of a normal variable of mean 0."""
    z = x / sigma
    return 0.3989422804014327 / sigma * math.exp(-0.5 * z * z)


@compiled
def place_density(
    along: float, left: float, cos: float, sin: float, length: float, width: float, range_m: float
) -> float:
    """Return the density of a detection's place on a body, 1/m2.

    Parameters
    ----------
    along, left : float
        Place ahead of the middle, and left of it, metres.
    cos, sin : float
        Of the angle from the heading to the line of sight.
    length, width, range_m : float
        Size of the body, and its distance from the sensor, metres.
    """
    sigma, by_width, of_flank = density_across(left, cos, sin, width, range_m)
    return density_along(along, cos, sin, length, width, sigma, by_width, of_flank)


@compiled
def density_across(
    left: float, cos: float, sin: float, width: float, range_m: float
) -> tuple[float, float, float]:
    """Return the factors of a place's density that do not depend on the length of the body.

    Returns
    -------
    sigma : float
        Standard deviation along the body, m.
    by_width, of_flank : float
        Density across the whole body, and across the flank that is seen, 1 / m.
    """
    left_sigma = math.hypot(_FACE_M, AZIMUTH_RAD * range_m * cos)
    side = 0.5 * width
    flank = -side if sin > 0.0 else side
    by_width = _blurred(left, side, left_sigma)
    sigma = math.hypot(_FACE_M, AZIMUTH_RAD * range_m * sin)
    return sigma, by_width, _normal(left - flank, left_sigma)


@compiled
def density_along(
    along: float, cos: float, sin: float, length: float, width: float,
    sigma: float, by_width: float, of_flank: float,
) -> float:  # fmt: skip
    """Return the density of a place on a body, 1/m2, from the factors of `density_across`."""
    ends = width * abs(cos)
    share = ends / (ends + length * abs(sin) + 1e-9)
    half = 0.5 * length
    end = -half if cos > 0.0 else half
    by_length = _blurred(along, half, sigma)
    faces = share * (_normal(along - end, sigma) * by_width)
    faces += (1.0 - share) * (of_flank * by_length)
    return _ON_FACES * faces + (1.0 - _ON_FACES) * by_length * by_width


@compiled
def rate_density(rate: float, radial: float) -> float:
    """Return the density of a range rate, s/m, of a body with the radial speed `radial`, m/s."""
    density = (1.0 - _WHEELS) * _normal(
        rate - radial, _BODY_RATE_SIGMA_MPS + _RATE_SHARE * abs(radial)
    )
    top = max(_MOST_TURNS * abs(radial), 2.0 * _BODY_RATE_SIGMA_MPS)
    turned = rate if radial >= 0.0 else -rate
    if -_BODY_RATE_SIGMA_MPS < turned < top:
        density += _WHEELS / (top + _BODY_RATE_SIGMA_MPS)
    return density


@compiled
def height_ratio(height: float, range_m: float) -> float:
    """Return the likelihood ratio of a height for a lorry or bus over a car; 1 where unknown."""
    if not math.isfinite(height):
        return 1.0
    sigma = _HEIGHT_M + _HEIGHT_RAD * range_m
    tall, low = 0.5 * (_LORRY_M - _BOTTOM_M), 0.5 * (_CAR_M - _BOTTOM_M)
    of_lorry = _blurred(height - _BOTTOM_M - tall, tall, sigma)
    of_car = _blurred(height - _BOTTOM_M - low, low, sigma)
    # bounded, as the errors of one body's heights are correlated
    return min(max(of_lorry / max(of_car, 1e-9), 0.2), 5.0)


@compiled
def class_and_cell(shape: Floats, sensor: int, model: RateModel) -> tuple[int, int]:
    """Return the index of a state's class, and that of its cell with its sensor."""
    sensor_xy, _, _, corner, size = model
    x, y, speed, length = shape[0], shape[1], shape[4], shape[5]
    dx, dy = x - sensor_xy[sensor, 0], y - sensor_xy[sensor, 1]
    range_m = math.sqrt(dx * dx + dy * dy)  # a third of the time of hypot
    facing = abs(dx * shape[2] + dy * shape[3]) / max(range_m, 1e-6)
    aspect = 0 if facing < _ASPECTS[0] else (1 if facing < _ASPECTS[1] else 2)
    rate_class = (min(int(range_m / _RANGE_BIN_M), CLASSES[0] - 1) * CLASSES[1] + aspect) * 2
    rate_class = (rate_class + (1 if length > LONG_M else 0)) * 2 + (1 if speed < STANDS_MPS else 0)
    i = min(max(int((x - corner[0]) / RATE_CELL_M), 0), size[0] - 1)
    j = min(max(int((y - corner[1]) / RATE_CELL_M), 0), size[1] - 1)
    return rate_class, (sensor * size[0] + i) * size[1] + j


@compiled
def classes_and_cells(shape: Floats, sensor: Integers, model: RateModel) -> Integers:
    """Return the class and the cell of each state, (n, 2)."""
    found = np.empty((len(shape), 2), np.int64)
    for e in range(len(shape)):
        found[e, 0], found[e, 1] = class_and_cell(shape[e], sensor[e], model)
    return found


@compiled
def body_coordinates(shape: Floats, dx: float, dy: float) -> tuple[float, float, float]:
    """Return a place in body coordinates: ahead of the middle, left of it, and the body's turn.

    A body bends with its path, along an arc ahead of its middle and another one behind it; the turn
    is the change of heading from the middle to the place, radians.

    Parameters
    ----------
    shape : (9,) array
        The body, as of :class:`States`.
    dx, dy : float
        East and north of its middle, metres.
    """
    along, left = dx * shape[2] + dy * shape[3], dy * shape[2] - dx * shape[3]
    bend = shape[8] if along > 0.0 else shape[7]
    if abs(bend) < STRAIGHT:
        return along, left, 0.0
    across = 1.0 - bend * left
    turn = math.atan2(bend * along, across)
    return turn / bend, (1.0 - math.hypot(bend * along, across)) / bend, turn


@compiled
def _is_near(along: float, left: float, length: float, width: float) -> bool:
    """Return whether a place in body coordinates is so near that its detection may be of it."""
    return abs(along) < 0.5 * length + REACH_M and abs(left) < 0.5 * width + REACH_M


@compiled
def _reach(length: float, width: float) -> float:
    """Return the largest distance from the middle of a body at which a place can be near it."""
    return 0.5 * (length + width) + 2.0 * REACH_M


@compiled
def aspect(c: float, s: float, turn: float, sight: Floats) -> tuple[float, float]:
    """Return cosine and sine of the aspect: from the heading (c, s) and a turn to the sight."""
    cos, sin = c * sight[0] + s * sight[1], c * sight[1] - s * sight[0]
    if turn == 0.0:
        return cos, sin
    a, b = math.cos(turn), math.sin(turn)
    return cos * a + sin * b, sin * a - cos * b


@compiled
def fill_densities(
    shape: Floats, frame: int, arrays: DetectionArrays, work: Floats, row: Integers, n: int
) -> int:
    """Write the pairs of a state to working memory: densities to `work[:, 0]`, rows to `row`.

    Returns
    -------
    int
        Number of pairs, `n` before included; those beyond the memory's length are left out.
    """
    first, points, sight, range_m, rate, height, _ = arrays
    # one by one: to unpack an array takes five times as long
    x, y, c, s, speed = shape[0], shape[1], shape[2], shape[3], shape[4]
    length, width = shape[5], shape[6]
    reach = _reach(length, width)
    for d in range(first[frame], first[frame + 1]):
        dx, dy = points[d, 0] - x, points[d, 1] - y
        if (abs(dx) > reach) | (abs(dy) > reach):  # one jump: few are near
            continue
        along, left, turn = body_coordinates(shape, dx, dy)
        if not _is_near(along, left, length, width) or n >= len(work):
            continue
        cos, sin = aspect(c, s, turn, sight[d])
        density = place_density(along, left, cos, sin, length, width, range_m[d])
        density *= rate_density(rate[d], speed * cos)
        if length > LONG_M:
            density *= height_ratio(height[d], range_m[d])
        work[n, 0], row[n] = density, d
        n += 1
    return n


@compiled
def log_likelihood_ratio(
    rates: Floats, count: int, expected: float, alpha: float
) -> tuple[float, float]:
    """Return the log likelihood ratio of detections with a vehicle, nats, and its brightness.

    Brightness is integrated out: exactly where no detection is of the vehicle, and where all are.

    Parameters
    ----------
    rates : (n, 2) array
        Rate of each detection by the vehicle at brightness 1, and by all else.
    count : int
        Number of rows that count.
    expected : float
        Expected number of detections; if it is 0, the ratio without detections is 0.
    alpha : float
        Shape of the gamma distribution of brightness, whose mean is 1.
    """
    n, bright = 0.0, 1.0
    for _ in range(5 if count > 0 else 1):
        n = 0.0
        for q in range(count):
            lit = rates[q, 0] * bright
            n += lit / (rates[q, 1] + lit)
        bright = (alpha + n) / (alpha + expected)
    gain = alpha * math.log(alpha * bright) - (alpha + n) * math.log(alpha + n)
    if n > 0.0:
        gain += math.lgamma(alpha + n) - math.lgamma(alpha)
    for q in range(count):
        gain += math.log(1.0 + rates[q, 0] * bright / rates[q, 1])
    return gain, bright


@compiled
def count_runs(group: Integers) -> int:
    """Return the number of runs of equal numbers."""
    count = min(len(group), 1)
    for e in range(1, len(group)):
        count += group[e] != group[e - 1]
    return count


@compiled
def window_gains(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, frame: Integers, sensor: Integers, shape: Floats, visible_share: Floats,
    model: RateModel, arrays: DetectionArrays, alpha: Floats, add: bool,  # noqa: FBT001
) -> Floats:  # fmt: skip
    """Return the gain of a hypothetical vehicle and its expected detections, (groups, 2).

    With `add` its rates are added to the total rates of `arrays`.
    """
    gains = np.zeros((count_runs(group), 2))
    work, row = np.empty((4096, 2)), np.empty(4096, np.int64)
    total, e = arrays[6], 0
    for g in range(len(gains)):
        n, expected, stands = 0, 0.0, 1 if shape[e, 4] < STANDS_MPS else 0
        this = group[e]
        while e < len(group) and group[e] == this:
            rate_class, cell = class_and_cell(shape[e], sensor[e], model)
            mu = model[1][rate_class] * model[2][cell] * visible_share[e]
            begin, n = n, fill_densities(shape[e], frame[e], arrays, work, row, n)
            for q in range(begin, n):
                work[q, 0], work[q, 1] = work[q, 0] * mu, total[row[q]]
            expected += mu
            e += 1
        gains[g, 0], bright = log_likelihood_ratio(work, n, expected, alpha[stands])
        gains[g, 1] = expected
        for q in range(n if add else 0):
            total[row[q]] += work[q, 0] * bright
    return gains


@compiled
def placed_gains(  # noqa: PLR0917 - numba takes plain arrays
    group: Integers, shape: Floats, expected: Floats, begin: Integers, density: Floats,
    row: Integers, rate: Floats, total: Floats, alpha: Floats,
) -> Floats:  # fmt: skip
    """Return what `window_gains` does, for a vehicle whose rates are part of the total rates.

    The pairs of each state are those from `begin` on, with their density, row and rate.
    """
    gains, work = np.zeros((count_runs(group), 2)), np.empty((len(row), 2))
    e = 0
    for g in range(len(gains)):
        n, stands = 0, 1 if shape[e, 4] < STANDS_MPS else 0
        this = group[e]
        while e < len(group) and group[e] == this:
            for q in range(begin[e], begin[e + 1]):
                work[n, 0], work[n, 1] = density[q] * expected[e], total[row[q]] - rate[q]
                n += 1
            gains[g, 1] += expected[e]
            e += 1
        gains[g, 0], _ = log_likelihood_ratio(work, n, gains[g, 1], alpha[stands])
    return gains


@compiled
def _half_across(shape: Floats, x: float, y: float, far: float) -> float:
    """Return half the extent of a body across a direction (x, y), whose length is `far`."""
    c, s = shape[2], shape[3]
    across = shape[5] * abs(c * y - s * x) + shape[6] * abs(c * x + s * y)
    return float(0.5 * across / far)


@compiled
def fill_visible_share(
    order: Integers, first: Integers, sensor: Integers, shape: Floats, sensor_xy: Floats,
    visible_share: Floats,
) -> None:  # fmt: skip
    """Multiply `visible_share` by the share of each state that no other one hides from the sensor.

    `order` sorts the states by frame; `first` is the index of each frame's first in it.
    """
    place = np.empty((int(np.diff(first).max()), 3))  # from the sensor; half of the extent at most
    for f in range(len(first) - 1):
        ex, ey = sensor_xy[sensor[f], 0], sensor_xy[sensor[f], 1]
        states = order[first[f] : first[f + 1]]
        for a in range(len(states)):
            place[a, 0], place[a, 1] = shape[states[a], 0] - ex, shape[states[a], 1] - ey
            place[a, 2] = 0.5 * (shape[states[a], 5] + shape[states[a], 6])
        for a in range(len(states)):
            i, x, y = states[a], place[a, 0], place[a, 1]
            far = max(math.hypot(x, y), 1.0)
            half = _half_across(shape[i], x, y, far)
            for b in range(len(states)):
                ahead = place[b, 0] * x + place[b, 1] * y  # times the range, as aside
                aside = place[b, 0] * y - place[b, 1] * x
                beside = abs(aside) * far > half * ahead + place[b, 2] * far * far
                if (ahead <= far) | (ahead >= far * far) | beside or a == b:  # hides nothing
                    continue
                near, aside = ahead / far, aside / far
                # height over the road of the line of sight
                over = _SCATTERER_M + (_SENSOR_M - _SCATTERER_M) * (1.0 - near / far)
                if over > (_LORRY_M if shape[states[b], 5] > LONG_M else _CAR_M):
                    continue
                own, other = half * near / far, _half_across(shape[states[b]], x, y, far)
                both = min(own, aside + other) - max(-own, aside - other)
                lost = (1.0 - _SHARE_BEHIND) * max(both, 0.0)
                visible_share[i] *= 1.0 - lost / (2.0 * own + 1e-9)


@compiled
def overlap(
    rows: Integers, frame: Integers, shape: Floats, alive: Booleans, order: Integers,
    first: Integers,
) -> Floats:  # fmt: skip
    """Return the largest share of the shorter body that overlaps, for states of one vehicle.

    `order` and `first` give the states of all vehicles by frame; those not `alive` are ignored.
    """
    share = np.zeros(len(rows))
    for k in range(len(rows)):
        e = rows[k]
        x, y, c, s = shape[e, 0], shape[e, 1], shape[e, 2], shape[e, 3]
        length, width = shape[e, 5], shape[e, 6]
        for a in range(first[frame[e]], first[frame[e] + 1]):
            o = order[a]
            dx, dy = shape[o, 0] - x, shape[o, 1] - y
            apart = 0.5 * (length + shape[o, 5] + width + shape[o, 6]) + _ABREAST_M
            if (abs(dx) > apart) | (abs(dy) > apart):  # one jump: few are near
                continue
            if rows[0] <= o <= rows[-1] or not alive[o]:
                continue
            along, aside, turn = body_coordinates(shape[e], dx, dy)
            if abs(aside) > 0.5 * (width + shape[o, 6]) + _ABREAST_M:
                continue
            if abs(aspect(c, s, turn, shape[o, 2:4])[0]) < 0.8:
                continue
            least = min(length, shape[o, 5])
            both = 0.5 * (length + shape[o, 5]) - abs(along)
            share[k] = max(share[k], min(both, least) / least)
    return share


@compiled
def find_pairs(
    shape: Floats, frame: Integers, arrays: DetectionArrays
) -> tuple[Integers, Floats, Integers]:
    """Return the pairs of states and detections near them.

    Returns
    -------
    begin : (states + 1,) int64 array
        Index of the first pair of each state.
    density, row : (n,) arrays
        Density of the detection, given the state, and its row.
    """
    first, most = arrays[0], 0
    for e in range(len(frame)):
        most += first[frame[e] + 1] - first[frame[e]]
    begin, work, row = (
        np.zeros(len(frame) + 1, np.int64),
        np.empty((most, 2)),
        np.empty(most, np.int64),
    )
    for e in range(len(frame)):
        begin[e + 1] = fill_densities(shape[e], frame[e], arrays, work, row, begin[e])
    return begin, work[: begin[-1], 0].copy(), row[: begin[-1]].copy()

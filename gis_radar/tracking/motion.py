"""Motion of a vehicle: its path, its place and speed along it by step, and its size.

The motion is estimated from all detections of the complete track together (fixed-interval
smoothing, Rauch, Tung and Striebel 1965). In the frame that moves along with the vehicle,
detections of its body stay where they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gis_radar.base import STEP_S, STEPS_PER_SECOND, Floats, Integers, compiled
from gis_radar.tracking.detections import AZIMUTH_RAD, MapDetections
from gis_radar.tracking.paths import DIRECTION_RAD, Path, path_through
from gis_radar.tracking.size import END_SHARE, Size, size_of

HALF_STEPS = STEPS_PER_SECOND // 2
# Median time gap that drivers keep, and sigma of its logarithm (Treiber and Kesting, Traffic Flow
# Dynamics, ch. 4).
GAP_S, GAP_SPREAD = 1.8, 0.6
# Prior variances of place, m2, and speed, m2/s2.
_UNKNOWN_S, _UNKNOWN_V = 25.0, 9.0
_MOST_MISSES = 6  # places in a row outside the gate after which the filter starts again
_STILL_COS = 0.05  # least cosine of the aspect; below it, a range rate is no evidence of the speed
_SPACING_M = 1.0  # distance along the road of the points through which a path is fitted
_ALONG_M = 0.3  # sigma of a detection along the road
_RANGE_RATE_MPS = 0.4  # sigma of a range rate, including what wheels and turning add
_ACCEL_VAR = 2.0  # variance that a driver's choice adds to the speed per second, m2/s3
_REPEAT_FACTOR = 4.0  # factor on the sigma of places, as a scatterer lasts for several frames
_MOST_WEIGHT = 8.0  # most weight sideways of the detections in two metres of a path, 1/m2
# Weight for the length of detections of a slower vehicle: some may be of objects beside it.
_DRIVING_MPS, _STILL_TRUST = 1.0, 0.3
# A detection whose range rate differs from the motion's by more than both this and this share of
# the speed does not count for the length, as it may be of a wheel or in a turn.
_LEAST_OFF_MPS, _OFF_SHARE = 0.4, 0.05


@dataclass(kw_only=True, eq=False)
class Motion:
    """A vehicle from its first to its last step.

    Parameters
    ----------
    rows : (k,) int64 array
        Its detections, in the order of time.
    path : Path
        Path of its middle.
    first_step : int
        First step of the states.
    s_m, speed : (n,) arrays
        Distance of its middle along the path, metres, and its speed, m/s, at each step.
    var_s : (n,) array
        Variance of `s_m`, m2.
    length_m, width_m, length_sigma_m, p_heavy : float
        Its size, and the probability that it is longer than 7 m.
    along_m, left_m : (k,) arrays
        Place of each detection on the body: from the middle forward, from the path to the left.
    p_exists : float
        The probability that it exists; NaN while that is not known.
    """

    rows: Integers
    path: Path
    first_step: int
    s_m: Floats
    speed: Floats
    var_s: Floats
    length_m: float
    width_m: float
    length_sigma_m: float
    p_heavy: float
    along_m: Floats
    left_m: Floats
    p_exists: float = math.nan

    @property
    def last_step(self) -> int:
        """Last step of the states."""
        return self.first_step + len(self.s_m) - 1

    @cached_property
    def places(self) -> tuple[Floats, Floats]:
        """Middle (n, 2), metres, and heading (n,), radians, at each step."""
        return self.path.at(self.s_m)

    def at(self, time: Floats) -> tuple[Floats, Floats]:
        """Return distance (m) along the path and speed (m/s) at times; constant beyond its ends."""
        place = time * STEPS_PER_SECOND - self.first_step
        inside = np.clip(place, 0.0, len(self.s_m) - 1.0)
        steps = np.arange(len(self.s_m))
        speed = np.interp(inside, steps, self.speed)
        return np.interp(inside, steps, self.s_m) + (place - inside) * STEP_S * speed, speed

    def halves(self) -> tuple[Integers, Floats, Floats]:
        """Return (number of the half second, place, heading) at the begin of each half second."""
        place, heading = self.places
        every = np.arange(-self.first_step % HALF_STEPS, len(heading), HALF_STEPS)
        every = every if len(every) else np.zeros(1, np.int64)
        return (self.first_step + every) // HALF_STEPS, place[every], heading[every]

    def between(self, first: int, last: int, time: Floats) -> Motion | None:
        """Return the motion between two steps; None where it has no detections there.

        Parameters
        ----------
        first, last : int
            Steps.
        time : (n,) array
            UNIX seconds of all detections.
        """
        step = time[self.rows] * STEPS_PER_SECOND
        mine = (step >= first - 0.5) & (step < last + 0.5)
        if not mine.any():
            return None
        span = slice(max(first - self.first_step, 0), last + 1 - self.first_step)
        return replace(
            self, rows=self.rows[mine], first_step=max(first, self.first_step),
            s_m=self.s_m[span], speed=self.speed[span], var_s=self.var_s[span],
            along_m=self.along_m[mine], left_m=self.left_m[mine],
        )  # fmt: skip

    def frame(
        self, detections: MapDetections, rows: Integers
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return detections in the frame that moves along with the vehicle.

        Returns
        -------
        along_m, left_m : (k,) arrays
            From the middle of the vehicle forward, from its path to the left.
        rate_mps : (k,) array
            Range rate of the detection less that of the vehicle.
        speed_mps : (k,) array
            Speed of the vehicle.
        """
        s, speed = self.at(detections.time[rows])
        along, left = self.path.project(detections.points[rows], s, 25.0)
        heading = self.path.heading_at(along)
        cos = (
            np.cos(heading) * detections.sight[rows, 0]
            + np.sin(heading) * detections.sight[rows, 1]
        )
        return along - s, left, detections.range_rate[rows] - speed * cos, speed


def fit_motion(detections: MapDetections, rows: Integers, states: Floats) -> Motion:
    """Estimate the motion and size of a vehicle from all its detections (smoothing).

    Parameters
    ----------
    detections : MapDetections
        All detections.
    rows : (k,) int64 array
        Rows of those of the vehicle.
    states : (n, 6) array
        State of the forward filter at each of all detections.
    """
    rows = rows[np.argsort(detections.time[rows], kind="stable")]
    path, guess = _fitted_path(detections, rows, states[rows])
    s, left = path.project(detections.points[rows], guess, 30.0)
    time = detections.time[rows]
    first = int(np.floor(time[0] * STEPS_PER_SECOND))
    count = int(np.ceil(time[-1] * STEPS_PER_SECOND)) - first + 1
    step = np.clip(np.round(time * STEPS_PER_SECOND).astype(np.int64) - first, 0, count - 1)
    heading = path.heading_at(s)
    sight = detections.sight[rows]
    cos = np.cos(heading) * sight[:, 0] + np.sin(heading) * sight[:, 1]
    sin = np.abs(np.cos(heading) * sight[:, 1] - np.sin(heading) * sight[:, 0])
    noise = np.hypot(_ALONG_M, AZIMUTH_RAD * detections.range_m[rows] * sin)
    rate = detections.range_rate[rows] / np.where(np.abs(cos) < _STILL_COS, _STILL_COS, cos)
    rate_var = (_RANGE_RATE_MPS / np.maximum(np.abs(cos), _STILL_COS)) ** 2
    same_step = np.bincount(step, minlength=count)[step]
    # The error of a direction lasts about a second: all range rates of that time share it.
    across = states[rows, 3] * sin / np.maximum(np.abs(cos), _STILL_COS)
    rate_var += (DIRECTION_RAD * across) ** 2 * STEPS_PER_SECOND * same_step
    ends = np.column_stack([-np.sign(cos), np.abs(cos), sin])  # the end that is seen, and how much
    size, shift = Size(), 0.0
    for _ in range(2):
        share = END_SHARE * size.width_m * ends[:, 1]
        share /= size.width_m * ends[:, 1] + size.length_m * sin + 1e-9
        half = 0.5 * size.length_m
        variance = noise**2 + (1.0 - share) * half**2 / 3.0 + share * (1.0 - share) * half**2
        # scatterers last: what one frame shows the next shows again
        variance *= _REPEAT_FACTOR * np.sqrt(same_step)
        middle = s - ends[:, 0] * share * half
        smoothed = _smooth(
            count, step, rate, rate_var, middle, variance, float(middle[:5].mean()),
            max(float(states[rows[0], 3]), 0.0),
        )  # fmt: skip
        place = time * STEPS_PER_SECOND - first
        along = s - np.interp(place, np.arange(count), smoothed[0])
        speed = np.interp(place, np.arange(count), smoothed[1])
        rate_error = np.abs(rate - speed) * np.maximum(np.abs(cos), _STILL_COS)
        fits = rate_error < _LEAST_OFF_MPS + _OFF_SHARE * speed
        # a standing vehicle may seem as long as all still things there
        trust = np.where(speed > _DRIVING_MPS, 1.0, _STILL_TRUST) * fits
        size, shift = size_of(along, ends, noise, time, trust)
    return Motion(
        rows=rows, path=path, first_step=first,
        s_m=non_decreasing(smoothed[0] + shift), speed=np.maximum(smoothed[1], 0.0),
        var_s=smoothed[2], length_m=size.length_m, width_m=size.width_m,
        length_sigma_m=size.sigma_m, p_heavy=size.p_heavy, along_m=along - shift, left_m=left,
    )  # fmt: skip


def non_decreasing(s_m: Floats) -> Floats:
    """Return places without backward motion: the highest so far, or the lowest from then on.

    Parameters
    ----------
    s_m : (n,) array
        Places along a path by time, metres.

    Returns
    -------
    (n,) array
        That of the two which changes the places less, metres.
    """
    highest, lowest = np.maximum.accumulate(s_m), np.minimum.accumulate(s_m[::-1])[::-1]
    return np.asarray(min(highest, lowest, key=lambda each: float(np.abs(each - s_m).sum())))


def side_seen(path: Path, s_m: Floats, sight: Floats) -> Floats:
    """Return the mean offset of detections left of a car's axis: they lie towards the sensor.

    Parameters
    ----------
    path : Path
        Path of the car's middle.
    s_m : (k,) array
        Distance of the detections along it, metres.
    sight : (k, 2) array
        Unit vectors from the sensor.
    """
    heading = path.heading_at(s_m)
    cos = np.cos(heading) * sight[:, 0] + np.sin(heading) * sight[:, 1]
    sin = np.cos(heading) * sight[:, 1] - np.sin(heading) * sight[:, 0]
    car = Size()
    side = car.length_m * np.abs(sin)
    share = side / (side + car.width_m * np.abs(cos) + 1e-9)
    return np.asarray(-np.sign(sin) * share * 0.5 * car.width_m)


def _fitted_path(detections: MapDetections, rows: Integers, states: Floats) -> tuple[Path, Floats]:
    """Return the path through states, shifted sideways to the detections, and places along it."""
    when = detections.time[rows, None]
    path, way = path_through(np.hstack([states[:, :3], when]), _SPACING_M)
    guess, _ = path.project(states[:, :2], way, 25.0)
    s, left = path.project(detections.points[rows], guess, 30.0)
    left = left - side_seen(path, s, detections.sight[rows])
    weight = 1.0 / (0.5**2 + (AZIMUTH_RAD * detections.range_m[rows]) ** 2)
    cell = np.clip((s / 2.0).astype(np.int64), 0, int(path.s_m[-1] / 2.0))
    count = int(path.s_m[-1] / 2.0) + 1
    total = np.bincount(cell, weight, count)
    offset = np.bincount(cell, weight * np.clip(left, -2.0, 2.0), count)
    # repeated detections of a lasting scatterer do not reduce its bias
    factor = np.minimum(total, _MOST_WEIGHT) / np.maximum(total, 1e-9)
    kernel = np.exp(-0.5 * (np.arange(-10, 11) / 4.0) ** 2)
    weight_near = np.convolve(total * factor, kernel, "full")[10:-10]
    shift = np.convolve(offset * factor, kernel, "full")[10:-10] / (weight_near + 1.0)
    left_of = np.interp(path.s_m, 1.0 + 2.0 * np.arange(count), shift)
    heading = path.heading_at(path.s_m)
    moved = path.points + left_of[:, None] * np.column_stack([-np.sin(heading), np.cos(heading)])
    better = Path(moved)
    guess, _ = better.project(states[:, :2], guess, 15.0)
    return better, guess


@compiled
def _smooth(  # pragma: no cover - compiled
    count: int,
    step: Integers,
    rate: Floats,
    rate_var: Floats,
    middle: Floats,
    middle_var: Floats,
    s: float,
    v: float,
) -> tuple[Floats, Floats, Floats]:
    """Smooth place and speed over steps (Rauch, Tung, Striebel).

    Measurements, in the order of time, are the speed (`rate`) and the place (`middle`), each with
    its variance; `s`, `v` are the first place and speed. Returns place, speed, variance of place.
    """
    dt = 1.0 / 20.0
    q_ss, q_sv, q_vv = _ACCEL_VAR * dt**3 / 3.0, _ACCEL_VAR * dt**2 / 2.0, _ACCEL_VAR * dt
    mean, cov = np.empty((count, 2)), np.empty((count, 3))
    predicted, predicted_cov = np.empty((count, 2)), np.empty((count, 3))
    a, b, c = _UNKNOWN_S, 0.0, _UNKNOWN_V
    k, misses, fitted = 0, 0, 0
    for i in range(count):
        if i > 0:
            s += v * dt
            a += 2.0 * dt * b + dt * dt * c + q_ss
            b += dt * c + q_sv
            c += q_vv
        if misses >= max(_MOST_MISSES, fitted):  # the track so far was of something else
            a, c, misses, fitted = a + _UNKNOWN_S, c + _UNKNOWN_V, 0, 0
        predicted[i, 0], predicted[i, 1] = s, v
        predicted_cov[i, 0], predicted_cov[i, 1], predicted_cov[i, 2] = a, b, c
        while k < len(step) and step[k] == i:
            misses += 1
            gap, total = rate[k] - v, c + rate_var[k]
            if gap * gap < 16.0 * total:
                s += b / total * gap
                v += c / total * gap
                a -= b * b / total
                b -= b * c / total
                c -= c * c / total
            gap, total = middle[k] - s, a + middle_var[k]
            if gap * gap < 25.0 * total:
                misses, fitted = 0, fitted + 1
                s += a / total * gap
                v += b / total * gap
                c -= b * b / total
                b -= a * b / total
                a -= a * a / total
            k += 1
        if v < 0.0:
            total = c + 0.01
            s -= b / total * v
            a -= b * b / total
            v -= c / total * v
            b -= b * c / total
            c -= c * c / total
        mean[i, 0], mean[i, 1] = s, v
        cov[i, 0], cov[i, 1], cov[i, 2] = a, b, c
    _smooth_backward(mean, cov, predicted, predicted_cov)
    return mean[:, 0].copy(), mean[:, 1].copy(), cov[:, 0].copy()


@compiled
def _smooth_backward(
    mean: Floats, cov: Floats, predicted: Floats, predicted_cov: Floats
) -> None:  # pragma: no cover - compiled
    """Smooth filtered states (s, v) and covariances (ss, sv, vv), given the predictions."""
    dt = 1.0 / 20.0
    for i in range(len(mean) - 2, -1, -1):
        a, b, c = cov[i]
        pa, pb, pc = predicted_cov[i + 1]
        det = pa * pc - pb * pb
        # covariance with the state ahead: P F^T
        f00, f01, f10, f11 = a + dt * b, b, b + dt * c, c
        g00, g01 = (f00 * pc - f01 * pb) / det, (f01 * pa - f00 * pb) / det
        g10, g11 = (f10 * pc - f11 * pb) / det, (f11 * pa - f10 * pb) / det
        ds, dv = mean[i + 1, 0] - predicted[i + 1, 0], mean[i + 1, 1] - predicted[i + 1, 1]
        mean[i, 0] += g00 * ds + g01 * dv
        mean[i, 1] += g10 * ds + g11 * dv
        da, db, dc = cov[i + 1, 0] - pa, cov[i + 1, 1] - pb, cov[i + 1, 2] - pc
        cov[i, 0] = a + g00 * (g00 * da + g01 * db) + g01 * (g00 * db + g01 * dc)
        cov[i, 1] = b + g10 * (g00 * da + g01 * db) + g11 * (g00 * db + g01 * dc)
        cov[i, 2] = c + g10 * (g10 * da + g11 * db) + g11 * (g10 * db + g11 * dc)

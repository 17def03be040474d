"""Test whether a sensor has moved, when, and whether the change lasts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from gis_radar.base import Floats
from gis_radar.calibration.monitoring.kalman_filter import (
    CYCLE_S,
    HOUR_S,
    KNOCK,
    Estimate,
    Innovation,
    innovation,
    likeliest_move,
)
from gis_radar.calibration.monitoring.windows import WindowFit, WindowFitter, WindowTraffic
from gis_radar.calibration.registration.certainty import z_score
from gis_radar.calibration.registration.solver import FAR, Fit
from gis_radar.calibration.registration.state import POSE_PART, State

# Lengths of the newest parts of the window that are tested for a move: the short one shows a blow
# early, but holds few vehicles; the long one shows a shift of some decimetres.
LENGTHS_S: tuple[float, ...] = (20.0, 60.0)
# Expected number of false moves an hour, if all tests were independent.
FALSE_ALARMS = 0.01
# Least z score of a move, over vehicles. Measured where both other criteria are met: at rest in
# light traffic 0.1 to 1.5, within 25 s of a turn by a degree 1.9 to 2.2, after a shift of half a
# metre 2.6 to 3.3.
AGREEMENT = 1.65


def chi2_quantile(level: float) -> float:
    """Return a quantile of chi-square with six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * scipy.special.gammaincinv(3.0, level))


# Chi-square with six degrees of freedom: threshold of a certain move; of a suspected one, which
# widens the pose's sigma; median.
MOVE_GATE = chi2_quantile(1.0 - FALSE_ALARMS / (HOUR_S / CYCLE_S * len(LENGTHS_S)))
SUSPECT = chi2_quantile(0.95)
_MEDIAN = chi2_quantile(0.5)
# Number of the last tests from which the ratio of chi-square to its expectation is measured at a
# sensor, and number of assumed tests with a ratio of 1. With simulated drivers it is 2 to 3; if it
# is ignored, there is a false move in some minutes.
_SCATTER_TESTS = 60
_ASSUMED_TESTS = 4
_NEWEST_VEHICLES = 8  # least vehicles in a tested part; it grows until it holds them
_LEAST_BEFORE_S = 30.0  # seconds of data before a tested part from which the pose is known
_SETTLED_S = 15.0  # a shorter deviation is a shake
_LATEST_S = 8.0  # newest seconds in which the new pose must still be the better one
SLICE_S = 1.0  # resolution of the time of a move: half a second to either side
# How far back a move is looked for: within the window of 100 s, less _LEAST_BEFORE_S
_BACK_S = 75.0
_CHANGE_ROUNDS = 2  # rounds in which time and pose of a move are estimated alternately
FAR_WINDOW = replace(FAR, rounds=12)  # fit after a suspected move


@dataclass(frozen=True, kw_only=True)
class Change:
    """Lasting change of a sensor's pose.

    Parameters
    ----------
    time : float
        UNIX seconds of the move.
    fit : WindowFit
        The pose since then.
    chi2 : float
        Chi-square of this pose less the pose before, six degrees of freedom.
    """

    time: float
    fit: WindowFit
    chi2: float


@dataclass(frozen=True, kw_only=True)
class SuspectedMove:
    """Move that the newest part of a window suggests.

    Parameters
    ----------
    certain : bool
        Whether the data contradict the pose significantly.
    move : (6,) array
        The likeliest move, metres and a turn about the map's axes in radians; zeros where no pose
        fits the data.
    change : Change or None
        The change of the pose, if it already lasts.
    """

    certain: bool
    move: Floats
    change: Change | None = None


def score(gap: Innovation, window_fit: WindowFit) -> float:
    """Return the chi-square of an innovation, reduced for the heavy tail of few vehicles.

    The noise along the innovation is estimated from vehicles, the other part of its variance is
    known: together they have the degrees of freedom of Welch and Satterthwaite.

    Parameters
    ----------
    gap : Innovation
        Innovation of the fit and the expected pose.
    window_fit : WindowFit
        The fit.
    """
    chi2, along = gap.chi2, np.linalg.solve(gap.covariance, gap.gap)
    influence = (
        window_fit.fit.scores @ np.linalg.inv(window_fit.fit.information)[:, POSE_PART] @ along
    )
    squares = np.square(influence)
    if chi2 <= 0.0 or not squares.any():
        return chi2
    variance = float(along @ window_fit.measurement.noise @ along) * squares / squares.sum()
    freedom = chi2**2 / float(np.square(variance).sum())
    return freedom * float(np.log1p(chi2 / freedom))


def agreement(rest: Fit, moved: Fit) -> float:
    """Return the z score of `moved` over `rest`, by the costs of vehicles (Vuong 1989).

    It is the mean gain of vehicles over its standard error: a move of the sensor gives most of them
    a gain, a single odd vehicle does not.

    Parameters
    ----------
    rest, moved : Fit
        Two fits to the same samples.
    """
    gain = (rest.costs - moved.costs)[(rest.costs != 0.0) | (moved.costs != 0.0)]
    return z_score(gain) if len(gain) > 1 else 0.0


class Scatter:
    """Ratio of the variance between parts of traffic to their covariances, at one sensor.

    Without a move, chi-square is larger than expected, as tracks that are cut count as independent,
    and offsets of drivers last for some hundred metres. The ratio is that of the medians.
    """

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=_SCATTER_TESTS)

    def add(self, chi2: float) -> None:
        """Add the chi-square of a test."""
        self._last.append(chi2)

    @property
    def ratio(self) -> float:
        """Ratio of variances, at least 1."""
        return max(float(np.median([_MEDIAN] * _ASSUMED_TESTS + [*self._last])) / _MEDIAN, 1.0)


@dataclass(frozen=True, kw_only=True)
class MoveTest:
    """Test of a window of traffic for a move of its sensor.

    A move is significant by three criteria: the innovation of the newest part's pose against the
    pose before, whose covariance excludes the common error; the log likelihood ratio of both; and
    the z score of the vehicles. The innovation alone does not suffice, as some seconds of traffic
    leave directions in which a fit may be metres away without a higher likelihood.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    traffic : WindowTraffic
        The window.
    now : float
        End of the window, UNIX seconds.
    expected : callable
        Function of a time that predicts the pose at `now` from data before that time.
    scatter : Scatter
        Scatter of earlier tests, to which the results of this one are added.
    """

    fitter: WindowFitter
    traffic: WindowTraffic
    now: float
    expected: Callable[[float], Estimate]
    scatter: Scatter

    def suspected(self, reflection_m: float) -> SuspectedMove | None:
        """Return the move that the newest parts of the window suggest, or None.

        Parameters
        ----------
        reflection_m : float
            Current mean height of reflections, metres.
        """
        suspected, ratio = None, self.scatter.ratio
        for length_s in LENGTHS_S:
            newest_part = self.newest(length_s)
            if newest_part.moving.begin - self.traffic.moving.begin < _LEAST_BEFORE_S:
                break  # too little data for the pose before
            expected = self.expected(newest_part.moving.begin)
            fit = self.fitter.fit(
                newest_part, expected, reflection_m, near=KNOCK, schedule=FAR_WINDOW
            )
            if fit is None:
                continue
            if not fit.trusted:
                searched = self.fitter.find(newest_part, expected, reflection_m, near=KNOCK)
                if searched is None and fit.on_lanes:
                    continue  # a fit that did not converge is no contradiction
                if searched is None:
                    return SuspectedMove(certain=True, move=np.zeros(6))
                fit = searched
            gap = innovation(expected, fit.measurement)
            score_of_fit = score(gap, fit)
            self.scatter.add(score_of_fit)
            if score_of_fit < ratio * SUSPECT:
                continue
            gain, agree = self._likelihood_gain(newest_part, expected, fit)
            score_of_fit = min(score_of_fit, gain)
            if score_of_fit < ratio * SUSPECT:
                continue
            suspected = SuspectedMove(
                certain=score_of_fit >= ratio * MOVE_GATE and agree >= AGREEMENT,
                move=likeliest_move(gap),
                change=self.lasting_change(expected, fit),
            )
            if suspected.change is not None or suspected.certain:
                return suspected
        return suspected

    def newest(self, length_s: float) -> WindowTraffic:
        """Return the newest part of the traffic, longer where there are few vehicles.

        Parameters
        ----------
        length_s : float
            Least length in seconds; it grows until the part holds `_NEWEST_VEHICLES`.
        """
        part = self.traffic.between(self.now - length_s, np.inf)
        least = _NEWEST_VEHICLES
        while part.vehicles < least and self.now - length_s > self.traffic.moving.begin:
            length_s *= 1.5
            part = self.traffic.between(self.now - length_s, np.inf)
        return part

    def lasting_change(self, expected: Estimate, fit: WindowFit) -> Change | None:
        """Return the change of the pose, if it lasts for `_SETTLED_S` and is significant.

        Parameters
        ----------
        expected : Estimate
            The pose at `now`, predicted from data before the newest part.
        fit : WindowFit
            Fit of the newest part.
        """
        fitter, traffic = self.fitter, self.traffic
        for _ in range(_CHANGE_ROUNDS):
            new = fit.fit.state
            old = expected.state(new.reflection)
            since = self.change_time(old, new)
            part = traffic.between(since, np.inf)
            expected = self.expected(since)  # without the data of the new pose
            refitted = fitter.fit(part, expected, new.reflection, near=KNOCK, start=new)
            if self.now - since < _SETTLED_S or refitted is None or not refitted.trusted:
                return None
            fit = refitted
        latest = traffic.between(self.now - _LATEST_S, np.inf).samples()
        if len(latest) and fitter.cost(latest, fit.fit.state) > fitter.cost(latest, old):
            return None
        gap = innovation(expected, fit.measurement)
        gain, agree = self._likelihood_gain(part, expected, fit)
        contradiction = min(score(gap, fit), gain)
        if contradiction < self.scatter.ratio * MOVE_GATE or agree < AGREEMENT:
            return None
        return Change(time=since, fit=fit, chi2=contradiction)

    def _likelihood_gain(
        self, part: WindowTraffic, expected: Estimate, fit: WindowFit
    ) -> tuple[float, float]:
        """Return twice the log likelihood ratio and the z score of a fit over that without a move.

        The z score counts vehicles: a lorry has as many detections as ten cars.
        """
        sigma = np.sqrt(np.diag(expected.covariance))
        reflection_m = fit.fit.state.reflection
        rest = self.fitter.fit(part, expected, reflection_m, near=sigma, schedule=FAR_WINDOW)
        if rest is None:
            return np.inf, np.inf
        return 2.0 * (rest.fit.cost - fit.fit.cost), agreement(rest.fit, fit.fit)

    def change_time(self, old: State, new: State) -> float:
        """Return the likeliest time (UNIX s) of a change from an old to a new pose.

        It maximises the cost of the old pose less that of the new one, summed over all later slices
        of time; of equal times the latest one is returned.

        Parameters
        ----------
        old, new : State
            The two poses.
        """
        slice_s, fitter = SLICE_S, self.fitter
        begin = max(self.now - _BACK_S, self.traffic.moving.begin)
        edges = begin + slice_s * np.arange(max(int(np.ceil((self.now - begin) / slice_s)), 1))
        gains = np.zeros(len(edges))
        for i, edge in enumerate(edges):
            samples = self.traffic.between(edge, edge + slice_s).samples()
            if len(samples):
                gains[i] = fitter.cost(samples, old) - fitter.cost(samples, new)
        later = np.cumsum(gains[::-1])[::-1]
        return float(edges[len(later) - 1 - int(np.argmax(later[::-1]))])

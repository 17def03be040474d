"""Test whether a sensor has moved, since when, and whether it only shook."""

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
from gis_radar.calibration.registration.state import POSE, State

# Lengths of the newest parts of the window that are tested for a move: a short one shows a blow
# early, but holds few vehicles; a long one shows a shift of some decimetres.
LENGTHS_S: tuple[float, ...] = (20.0, 60.0)
# Largest number of false moves an hour, as if all tests were independent.
FALSE_ALARMS = 0.01
# Standard errors by which the vehicles, each counting once, must prefer the move. Measured where
# both other criteria are met: at rest in light traffic 0.1 to 1.5, within 25 s of a turn by a
# degree 1.9 to 2.2, after a shift of half a metre 2.6 to 3.3.
AGREEMENT = 1.65


def chi2_quantile(level: float) -> float:
    """Return a quantile of chi2 with six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * scipy.special.gammaincinv(3.0, level))


# Chi2 with six degrees of freedom: the largest by chance; that from which on a move is looked for
# and the pose's sigma widened; the median.
GATE = chi2_quantile(1.0 - FALSE_ALARMS / (HOUR_S / CYCLE_S * len(LENGTHS_S)))
SUSPECT = chi2_quantile(0.95)
USUAL = chi2_quantile(0.5)
# Number of the last tests that measure by how much chi2 is larger at this sensor than it should be,
# and number of assumed tests in which it is as it should be. Simulated drivers as recorded: 2 to 3
# times, and one false move in some minutes without it.
SCATTER_TESTS = 60
ASSUMED_TESTS = 4
NEWEST_VEHICLES = 8  # least vehicles in a tested part; it grows until it holds them
MATURE_S = 30.0  # seconds of data before a tested part from which the pose is known
SETTLED_S = 15.0  # a shorter deviation is a shake
LATEST_S = 8.0  # newest seconds in which the new pose must still be the better one
SLICE_S = 1.0  # resolution of the time of a move: half a second to either side
BACK_S = 75.0  # how far back a move is looked for: within the window of 100 s, less MATURE_S
CHANGE_ROUNDS = 2  # rounds in which time and pose of a move are estimated alternately
FAR_WINDOW = replace(FAR, rounds=12)  # fit after a suspected move


@dataclass(frozen=True, kw_only=True)
class Change:
    """A sensor that has moved.

    Parameters
    ----------
    time : float
        UNIX seconds of the move.
    found : WindowFit
        The pose since then.
    chi2 : float
        Misfit of this pose and the pose before, six degrees of freedom.
    """

    time: float
    found: WindowFit
    chi2: float


@dataclass(frozen=True, kw_only=True)
class SuspectedMove:
    """A move that the newest part of a window suggests.

    Parameters
    ----------
    certain : bool
        Whether the data contradict the pose beyond chance.
    move : (6,) array
        The likeliest move, metres and a turn about the map's axes in radians; zeros where the data
        fit no pose.
    change : Change or None
        The lasting change of the pose, where there is one already.
    """

    certain: bool
    move: Floats
    change: Change | None = None


def score(gap: Innovation, seen: WindowFit) -> float:
    """Return the chi2 of a fit's gap, reduced for the heavy tail of few vehicles.

    The noise of the fit along the gap is estimated from the vehicles that share it, the rest of the
    variance is known (Welch and Satterthwaite's degrees of freedom).

    Parameters
    ----------
    gap : Innovation
        Innovation of the fit and a pose.
    seen : WindowFit
        The fit.
    """
    chi2, along = gap.chi2, np.linalg.solve(gap.covariance, gap.gap)
    influence = seen.fit.scores @ np.linalg.inv(seen.fit.information)[:, POSE] @ along
    squares = np.square(influence)
    if chi2 <= 0.0 or not squares.any():
        return chi2
    variance = float(along @ seen.measurement.noise @ along) * squares / squares.sum()
    freedom = chi2**2 / float(np.square(variance).sum())
    return freedom * float(np.log1p(chi2 / freedom))


def agreement(rest: Fit, moved: Fit) -> float:
    """Return by how many standard errors vehicles, each counting once, prefer `moved` to `rest`.

    The result is the mean gain of a vehicle over its standard error (Vuong 1989 with the vehicles
    as clusters): a move of the sensor gives all of them a gain, an odd vehicle gives it to itself
    only.

    Parameters
    ----------
    rest, moved : Fit
        Two fits to the same samples.
    """
    gain = (rest.costs - moved.costs)[(rest.costs != 0.0) | (moved.costs != 0.0)]
    return z_score(gain) if len(gain) > 1 else 0.0


class Scatter:
    """Ratio by which parts of traffic differ more than their covariances state, at one sensor.

    Tracks are cut into pieces that count as independent, and drivers keep aside for some hundred
    metres: so chi2 is too large where nothing moves. Its median shows by how much.
    """

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=SCATTER_TESTS)

    def add(self, chi2: float) -> None:
        """Add the result of a test."""
        self._last.append(chi2)

    @property
    def ratio(self) -> float:
        """Ratio of variances, at least 1."""
        return max(float(np.median([USUAL] * ASSUMED_TESTS + [*self._last])) / USUAL, 1.0)


@dataclass(frozen=True, kw_only=True)
class MoveTest:
    """Test of a window of traffic for a move of its sensor.

    The error common to all windows is the same before and after a move, which is therefore compared
    with the noise of the vehicles alone (`innovation` of the Kalman filter).
    It must be beyond chance in three ways: the distance of the newest data's pose from the pose
    before, the likelihood that the data gain there, and the agreement of the vehicles in that gain.
    Some seconds of traffic do not fix all directions: along such a one a fit may be metres away
    without being any likelier.

    Parameters
    ----------
    fitter : WindowFitter
        The lanes.
    traffic : WindowTraffic
        The window.
    now : float
        UNIX seconds at which it ends.
    expected : callable
        Returns the pose now, predicted from data before a time.
    scatter : Scatter
        Scatter of earlier tests, to which the results of this one are added.
    """

    fitter: WindowFitter
    traffic: WindowTraffic
    now: float
    expected: Callable[[float], Estimate]
    scatter: Scatter

    def suspected(self, reflection_m: float) -> SuspectedMove | None:
        """Test whether the newest data contradict the pose, and estimate the change behind it.

        Parameters
        ----------
        reflection_m : float
            Height of the vehicles' reflections so far, metres.
        """
        suspected, ratio = None, self.scatter.ratio
        for length_s in LENGTHS_S:
            part = self.newest(length_s)
            if part.moving.begin - self.traffic.moving.begin < MATURE_S:
                break  # a pose from so little data is corrected by the next windows anyway
            held = self.expected(part.moving.begin)
            seen = self.fitter.fit(part, held, reflection_m, near=KNOCK, schedule=FAR_WINDOW)
            if seen is None:
                continue
            if not seen.trusted:
                found = self.fitter.find(part, held, reflection_m, near=KNOCK)
                if found is None and seen.on_lanes:
                    continue  # a fit of few vehicles that did not converge contradicts nothing
                if found is None:
                    return SuspectedMove(certain=True, move=np.zeros(6))
                seen = found
            gap = innovation(held, seen.measurement)
            beyond = score(gap, seen)
            self.scatter.add(beyond)
            if beyond < ratio * SUSPECT:
                continue
            likelier, agreed = self._likelier(part, held, seen)
            beyond = min(beyond, likelier)
            if beyond < ratio * SUSPECT:
                continue
            suspected = SuspectedMove(
                certain=beyond >= ratio * GATE and agreed >= AGREEMENT,
                move=likeliest_move(gap),
                change=self.lasting_change(held, seen),
            )
            if suspected.change is not None or suspected.certain:
                return suspected
        return suspected

    def newest(self, length_s: float) -> WindowTraffic:
        """Return the newest part of the traffic, longer where there are few vehicles.

        Parameters
        ----------
        length_s : float
            Least length in seconds; it grows until the part holds `NEWEST_VEHICLES`.
        """
        part = self.traffic.between(self.now - length_s, np.inf)
        least = NEWEST_VEHICLES
        while part.vehicles < least and self.now - length_s > self.traffic.moving.begin:
            length_s *= 1.5
            part = self.traffic.between(self.now - length_s, np.inf)
        return part

    def lasting_change(self, held: Estimate, seen: WindowFit) -> Change | None:
        """Return the change that the newest data show, if it lasts and is certain.

        Parameters
        ----------
        held : Estimate
            The pose now, predicted from data before.
        seen : WindowFit
            Fit of the newest data alone.
        """
        fitter, traffic = self.fitter, self.traffic
        for _ in range(CHANGE_ROUNDS):
            new = seen.fit.state
            old = held.state(new.reflection)
            since = self.change_time(old, new)
            part = traffic.between(since, np.inf)
            held = self.expected(since)  # without the data of the new pose
            again = fitter.fit(part, held, new.reflection, near=KNOCK, start=new)
            if self.now - since < SETTLED_S or again is None or not again.trusted:
                return None
            seen = again
        latest = traffic.between(self.now - LATEST_S, np.inf).samples()
        if len(latest) and fitter.cost(latest, seen.fit.state) > fitter.cost(latest, old):
            return None
        gap = innovation(held, seen.measurement)
        likelier, agreed = self._likelier(part, held, seen)
        contradiction = min(score(gap, seen), likelier)
        if contradiction < self.scatter.ratio * GATE or agreed < AGREEMENT:
            return None
        return Change(time=since, found=seen, chi2=contradiction)

    def _likelier(
        self, part: WindowTraffic, held: Estimate, seen: WindowFit
    ) -> tuple[float, float]:
        """Return twice the log likelihood ratio of a fit to the best one near rest, and agreement.

        Agreement counts vehicles: a bus or a lorry gives as many detections as ten cars.
        """
        near = np.sqrt(np.diag(held.covariance))
        reflection_m = seen.fit.state.reflection
        rest = self.fitter.fit(part, held, reflection_m, near=near, schedule=FAR_WINDOW)
        if rest is None:
            return np.inf, np.inf
        return 2.0 * (rest.fit.cost - seen.fit.cost), agreement(rest.fit, seen.fit)

    def change_time(self, old: State, new: State) -> float:
        """Estimate the time (UNIX s) from which on the new pose explains the data better.

        This is the likeliest time of one change: the excess of the old pose's cost over the new
        one's, summed over all later slices of time, is greatest there. Between vehicles the latest
        such time is taken.

        Parameters
        ----------
        old, new : State
            The two poses.
        """
        slice_s, fitter = SLICE_S, self.fitter
        begin = max(self.now - BACK_S, self.traffic.moving.begin)
        edges = begin + slice_s * np.arange(max(int(np.ceil((self.now - begin) / slice_s)), 1))
        gains = np.zeros(len(edges))
        for i, edge in enumerate(edges):
            samples = self.traffic.between(edge, edge + slice_s).samples()
            if len(samples):
                gains[i] = fitter.cost(samples, old) - fitter.cost(samples, new)
        later = np.cumsum(gains[::-1])[::-1]
        return float(edges[len(later) - 1 - int(np.argmax(later[::-1]))])

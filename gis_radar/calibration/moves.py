"""Changes: whether a sensor has moved, since when, and whether it only shook."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from gis_radar.base import Floats
from gis_radar.calibration.certainty import z_score
from gis_radar.calibration.kalman_filter import (
    CYCLE_S,
    HOUR_S,
    KNOCK,
    Estimate,
    Innovation,
    innovation,
    likeliest_move,
)
from gis_radar.calibration.solver import FAR, Fit
from gis_radar.calibration.state import POSE, State
from gis_radar.calibration.windows import WindowFit, WindowFitter, WindowTraffic

# Newest parts of the window that are tested for a move, seconds: a short one soon shows a blow, but
# holds few vehicles; a long one shows a shift of some decimetres.
LENGTHS_S: tuple[float, ...] = (20.0, 60.0)
# Moves reported an hour where none was; at most, as if all tests were independent.
FALSE_ALARMS = 0.01
# Standard errors by which its vehicles must prefer the move, each counting as one. Measured where
# both other figures are beyond chance: at rest in light traffic 0.1 to 1.5, within 25 s of a turn
# by a degree 1.9 to 2.2, after a shift of half a metre 2.6 to 3.3.
AGREEMENT = 1.65


def chi2_quantile(level: float) -> float:
    """Return the quantile of chi2 of six degrees of freedom, without loading scipy.stats."""
    return float(2.0 * scipy.special.gammaincinv(3.0, level))


# Chi2 of six degrees of freedom: the largest that is chance; from where on a move is looked for and
# the pose's sigma widened; the median.
GATE = chi2_quantile(1.0 - FALSE_ALARMS / (HOUR_S / CYCLE_S * len(LENGTHS_S)))
SUSPECT = chi2_quantile(0.95)
USUAL = chi2_quantile(0.5)
# So many of the last tests measure by how much chi2 is larger here than it should be, with so
# many assumed as it should be. Simulated drivers as recorded: 2 to 3 times, and one false move in
# some minutes without it.
SCATTER_TESTS = 60
ASSUMED_TESTS = 4
NEWEST_VEHICLES = 8  # least vehicles in a tested part; it grows until it holds them
MATURE_S = 30.0  # seconds of data before a tested part from which the pose is known
SETTLED_S = 15.0  # a deviation that does not last so long is a shake, seconds
LATEST_S = 8.0  # newest seconds in which the new pose must still be the better one
SLICE_S = 1.0  # resolution of the time of a move, seconds: half a second to either side
# How long ago a move is looked for, seconds: within the window of 100 s, less MATURE_S.
BACK_S = 75.0
CHANGE_ROUNDS = 2  # time and pose of a move are estimated in turn so often
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
        By how much it contradicts the pose before.
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
        Whether it contradicts the pose beyond chance.
    move : (6,) array
        The likeliest move behind it, metres and a turn about the map's axes in radians; zeros
        where the data fit no pose.
    change : Change or None
        The lasting change behind it, where there is one already.
    """

    certain: bool
    move: Floats
    change: Change | None = None


def score(gap: Innovation, seen: WindowFit) -> float:
    """Return how far a fit is beyond chance: chi2 with the tail of few vehicles taken off.

    Along the gap the noise of a fit is known from as many vehicles as share it; the rest of its
    variance is no estimate (Welch and Satterthwaite's degrees of freedom).

    Parameters
    ----------
    gap : Innovation
        Of the fit and a pose.
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
    """Return by how many standard errors vehicles prefer `moved` to `rest`, each counting as one.

    The mean over its standard error of what each gains (Vuong 1989 with the vehicles as clusters):
    a sensor that has moved has done so for all of them, what one vehicle does otherwise only that
    one gains.

    Parameters
    ----------
    rest, moved : Fit
        Of the same samples.
    """
    gain = (rest.costs - moved.costs)[(rest.costs != 0.0) | (moved.costs != 0.0)]
    return z_score(gain) if len(gain) > 1 else 0.0


class Scatter:
    """By how much pieces of traffic differ more than their covariances state, at this sensor.

    Tracks are cut in pieces that count as independent, and drivers keep aside for some hundred
    metres: chi2 is larger than it should be where nothing moves. Its median shows by how much.
    """

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=SCATTER_TESTS)

    def add(self, chi2: float) -> None:
        """Take the result of a test."""
        self._last.append(chi2)

    @property
    def ratio(self) -> float:
        """Of variances, at least one."""
        return max(float(np.median([USUAL] * ASSUMED_TESTS + [*self._last])) / USUAL, 1.0)


@dataclass(frozen=True, kw_only=True)
class MoveTest:
    """A window of traffic, tested for a move of its sensor.

    What all windows have in common is the same before and after: a move is held against the noise
    of the vehicles alone (:func:`~gis_radar.calibration.kalman_filter.innovation`). It must be
    beyond chance in three ways: by how far the pose of the newest data is from the one before, by
    how much likelier they are there, and by how well the vehicles agree in that. In some seconds
    traffic fixes not all directions: a fit that is not quite right in one of them is carried metres
    away, without being any likelier.

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
        Of earlier tests; takes the results of this one.
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
            How high vehicles reflected so far.
        """
        suspected, ratio = None, self.scatter.ratio
        for length_s in LENGTHS_S:
            part = self.newest(length_s)
            if part.moving.begin - self.traffic.moving.begin < MATURE_S:
                break  # what is known from so little data is corrected by the next windows anyway
            held = self.expected(part.moving.begin)
            seen = self.fitter.fit(part, held, reflection_m, near=KNOCK, schedule=FAR_WINDOW)
            if seen is None:
                continue
            if not seen.trusted:
                found = self.fitter.find(part, held, reflection_m, near=KNOCK)
                if found is None and seen.on_lanes:
                    continue  # a fit of few vehicles that came to no rest contradicts nothing
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
        """Return the newest part of the traffic; a longer one where there is little traffic.

        Parameters
        ----------
        length_s : float
            How much, seconds; more until it holds the least number of vehicles.
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
            Of the newest data alone.
        """
        fitter, traffic = self.fitter, self.traffic
        for _ in range(CHANGE_ROUNDS):
            new = seen.fit.state
            old = held.state(new.reflection)
            since = self.change_time(old, new)
            part = traffic.between(since, np.inf)
            held = self.expected(since)  # all data since then are of the new pose
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
        """Return twice the log likelihood ratio of a fit to the best one as good as at rest.

        And by how far the vehicles agree: a bus or a lorry gives as many detections as ten cars.
        """
        near = np.sqrt(np.diag(held.covariance))
        reflection_m = seen.fit.state.reflection
        rest = self.fitter.fit(part, held, reflection_m, near=near, schedule=FAR_WINDOW)
        if rest is None:
            return np.inf, np.inf
        return 2.0 * (rest.fit.cost - seen.fit.cost), agreement(rest.fit, seen.fit)

    def change_time(self, old: State, new: State) -> float:
        """Estimate since when the new pose explains the data better than the old one.

        The likeliest time of one change: the sum over all later slices of time of what the old
        pose costs more than the new one is greatest there. Between vehicles it is the latest such
        time.

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

"""Forward filter: follows moving vehicles detection by detection, and starts new ones.

A vehicle is a body on the plane: a point of it, its heading, its speed, and how far it reaches to
the front and to the rear. Where it is on a lane its heading turns as the lane does; where lanes
fork, a branch of it follows each of them until detections tell which one it took. A detection
belongs to the body that it lies in and whose motion its range rate fits; it corrects the speed by
its range rate and the position only as far as it lies outside the body, since a radar hits a
vehicle anywhere. What stands is left to `standing`: here it would draw bodies to kerbs and signs.
"""

from __future__ import annotations

from dataclasses import astuple

import numpy as np

from gis_radar.arrays import Floats, Integers, compiled
from gis_radar.lanelets.graph import FieldArrays, LaneGraph, lanes_at
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.settings import EchoSettings, ForwardSettings

NONE = -1
CAPACITY = 1024  # vehicles at a time
WAITING = 2048  # detections at a time that no vehicle claims

# Columns of a body.
X, Y, HEADING, SPEED, FRONT, REAR = range(6)
VAR_S, COV_SV, VAR_V, VAR_D, LAST, TIME, NUMBER, HITS, FOLLOWED, MISFIT, COLUMNS = range(6, 17)
# Columns of a waiting detection: place, speed along a lane, its heading, time, row.
WAIT_SPEED, WAIT_HEADING, WAIT_TIME, WAIT_ROW, WAIT_COLUMNS = range(2, 7)
# Columns of what lanes_at finds.
LANE, ALONG_LANE, LEFT, TOWARDS, HALF = range(5)
# Of the settings as an array: moving_mps, then the fields of ForwardSettings in their order.
(
    MOVING, ACCEL, SIDEWAYS, RATE, LEAST_COS, ALONG, ACROSS, AZIMUTH, BIRTH_S, BIRTHS, COAST_S,
    STAND_S, STANDING, CAR_M,
) = range(14)  # fmt: skip

MOST_M = 30.0  # from the point of a body to any part of it, and what it may be off
LONGEST_M = 18.75  # a truck with trailer (EU directive 96/53)
FASTEST_MPS = 60.0
WIDE_M = 1.0  # half a vehicle
FORK_M = 3.0  # from the begin of a lane: those that begin here are branches of a fork
MOST_MISFIT = 6.0  # by which a branch may fit worse than another, as a logarithm of odds


class ForwardFilter:
    """Vehicles followed through a stream of detections.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    settings : ForwardSettings
        Of motion, association, births and deaths.
    moving_mps : float
        Least absolute range rate of a moving detection.
    """

    def __init__(
        self,
        graph: LaneGraph,
        settings: ForwardSettings,
        *,
        moving_mps: float = EchoSettings.moving_mps,
    ) -> None:
        self._field = graph.field.arrays
        self._limits = np.array([moving_mps, *map(float, astuple(settings))])
        self._bodies = np.zeros((CAPACITY, COLUMNS))
        self._waiting = np.zeros((WAITING, WAIT_COLUMNS))
        self._counts = np.zeros(4, np.int64)  # alive, waiting, begun, detections so far

    def push(self, echoes: Echoes) -> tuple[Integers, Floats]:
        """Take the next detections; return the vehicle of each and its state then.

        Parameters
        ----------
        echoes : Echoes
            In the order of time, after all so far.

        Returns
        -------
        number : (n,) int64 array
            From 0 in the order in which vehicles begin, `NONE` for what is of none. Detections
            that a vehicle began with carry its number where they are among these.
        state : (n, 6) array
            East, north, heading, speed, and the reach to front and rear of that vehicle, corrected
            by this detection.
        """
        number, state = np.full(len(echoes), NONE, np.int64), np.zeros((len(echoes), 6))
        seen = np.column_stack(
            [echoes.points, echoes.range_rate, echoes.sight, echoes.range_m, echoes.time]
        )
        _follow(
            seen, self._limits, self._bodies, self._waiting, self._counts, number, state,
            self._field,
        )  # fmt: skip
        self._counts[3] += len(echoes)
        return number, state

    @property
    def bodies(self) -> Floats:
        """States of the vehicles that are followed now, a row each: of branches the best."""
        alive = self._bodies[: int(self._counts[0])]
        alive = alive[np.lexsort((alive[:, MISFIT], alive[:, NUMBER]))]
        _, best = np.unique(alive[:, NUMBER], return_index=True)
        return np.asarray(alive[best, : REAR + 1])


def follow_both_ways(
    echoes: Echoes, graph: LaneGraph, settings: ForwardSettings, moving_mps: float
) -> tuple[tuple[Integers, Integers], tuple[Floats, Floats]]:
    """Follow vehicles as time runs and against it; return the numbers and states of both."""
    number, state = ForwardFilter(graph, settings, moving_mps=moving_mps).push(echoes)
    back = ForwardFilter(graph.reversed(), settings, moving_mps=moving_mps)
    against, state_against = back.push(echoes.reversed())
    against, state_against = against[::-1].copy(), state_against[::-1].copy()
    state_against[:, HEADING] += np.pi
    state_against[:, [FRONT, REAR]] = state_against[:, [REAR, FRONT]]
    return (number, against), (state, state_against)


@compiled
def _follow(
    seen: Floats,
    limits: Floats,
    bodies: Floats,
    waiting: Floats,
    counts: Integers,
    number: Integers,
    state: Floats,
    field: FieldArrays,
) -> None:
    """Go through detections (x, y, range rate, sight, range, time), frame by frame."""
    lanes, born = np.empty((8, 6)), np.empty(len(waiting), np.int64)
    for i in range(len(seen)):
        now = seen[i, 6]
        if i == 0 or now > seen[i - 1, 6]:
            _go_on(bodies, counts, now, limits, lanes, field)
        chosen = _choose(seen[i], bodies, counts[0], limits)
        if chosen >= 0:
            number[i] = int(bodies[chosen, NUMBER])
            state[i] = _correct_branches(chosen, bodies, counts[0], seen[i], limits)
        elif abs(seen[i, 2]) >= limits[MOVING]:
            before = counts[0]
            begun = _begin(i, seen[i], limits, bodies, waiting, counts, born, lanes, field)
            if begun == 0:
                continue
            body = bodies[before]
            for k in range(begun):
                row = born[k]
                lapse = now - seen[row, 6]
                number[row] = int(body[NUMBER])
                state[row] = body[: REAR + 1]
                state[row, X] -= body[SPEED] * lapse * np.cos(body[HEADING])
                state[row, Y] -= body[SPEED] * lapse * np.sin(body[HEADING])


@compiled
def _go_on(
    bodies: Floats, counts: Integers, now: float, limits: Floats, lanes: Floats, field: FieldArrays
) -> None:
    """Move all bodies on to a time; forget those not seen for too long."""
    k = 0
    while k < counts[0]:
        body = bodies[k]
        patience = limits[STAND_S] if body[SPEED] < limits[STANDING] else limits[COAST_S]
        if now - body[LAST] > (limits[BIRTH_S] if body[HITS] < 6.0 else patience):
            counts[0] -= 1
            bodies[k] = bodies[counts[0]]
            continue
        found = _predict(body, now, limits, lanes, field)
        _fork(k, bodies, counts, lanes, found)
        k += 1
    _forget_branches(bodies, counts)


@compiled
def _fork(
    k: int, bodies: Floats, counts: Integers, lanes: Floats, found: int
) -> None:  # pragma: no cover - compiled
    """Let a branch of a body follow each other lane that begins where it comes to its own."""
    body = bodies[k]
    for j in range(found):
        if lanes[j, LANE] == body[FOLLOWED] or lanes[j, ALONG_LANE] > FORK_M:
            continue
        if (
            abs(lanes[j, LEFT]) > lanes[j, HALF]
            or abs(_turn(lanes[j, TOWARDS], body[HEADING])) > 0.5
        ):
            continue
        known = counts[0] >= len(bodies)
        for other in range(counts[0]):
            same = bodies[other, NUMBER] == body[NUMBER]
            known = known or (same and bodies[other, FOLLOWED] == lanes[j, LANE])
        if not known:
            bodies[counts[0]] = body
            bodies[counts[0], FOLLOWED] = lanes[j, LANE]
            counts[0] += 1


@compiled
def _forget_branches(bodies: Floats, counts: Integers) -> None:  # pragma: no cover - compiled
    """Forget branches that fit much worse than another one, or are on its lane again."""
    k = 0
    while k < counts[0]:
        worse = False
        for other in range(counts[0]):
            if other == k or bodies[other, NUMBER] != bodies[k, NUMBER]:
                continue
            more = bodies[k, MISFIT] - bodies[other, MISFIT]
            same = bodies[k, FOLLOWED] == bodies[other, FOLLOWED]
            worse = (
                worse
                or more > MOST_MISFIT
                or (same and (more > 0.0 or (more == 0.0 and k > other)))
            )
        if worse:
            counts[0] -= 1
            bodies[k] = bodies[counts[0]]
        else:
            k += 1


@compiled
def _predict(
    body: Floats, time: float, limits: Floats, lanes: Floats, field: FieldArrays
) -> int:  # pragma: no cover - compiled
    """Move a body on to a time, turning as its lane; return how many lanes it comes to."""
    lapse = time - body[TIME]
    if lapse <= 0.0:
        return 0
    body[TIME] = time
    step = body[SPEED] * lapse
    here, way, _ = _lane_of(body[X], body[Y], body[HEADING], body[FOLLOWED], lanes, field)
    body[X] += step * np.cos(body[HEADING])
    body[Y] += step * np.sin(body[HEADING])
    new = 0
    if here >= 0.0 and abs(step) > 0.0:
        there, ahead, found = _lane_of(body[X], body[Y], way, here, lanes, field)
        if there >= 0.0:
            body[HEADING] += _turn(ahead, way)
            # towards the lane's direction, within the way in which a driver straightens up
            body[HEADING] += _turn(ahead, body[HEADING]) * min(abs(step) / 15.0, 1.0)
        new = found if there >= 0.0 and there != body[FOLLOWED] else 0
        body[FOLLOWED] = there
    accel = limits[ACCEL]
    body[VAR_S] += 2.0 * lapse * body[COV_SV] + lapse**2 * body[VAR_V] + accel**2 * lapse**4 / 4.0
    body[COV_SV] += lapse * body[VAR_V] + accel**2 * lapse**3 / 2.0
    body[VAR_V] += accel**2 * lapse
    drift = limits[SIDEWAYS] * min(abs(body[SPEED]) / 3.0, 1.0)
    body[VAR_D] += (drift**2 + 0.01) * lapse
    return new


@compiled
def _turn(to: float, since: float) -> float:  # pragma: no cover - compiled
    """Return a turn between two headings, within half a circle."""
    return (to - since + np.pi) % (2.0 * np.pi) - np.pi


@compiled
def _lane_of(
    x: float, y: float, heading: float, before: float, lanes: Floats, field: FieldArrays
) -> tuple[float, float, int]:
    """Return the lane at a point most like a heading, best the one before; its own; how many."""
    best, lane, towards = 1e9, -1.0, heading
    found = lanes_at(x, y, field, lanes)
    for k in range(found):
        turn = abs(_turn(lanes[k, TOWARDS], heading))
        cost = turn / 0.25 + abs(lanes[k, LEFT]) / 1.5
        if lanes[k, LANE] == before:
            cost -= 2.0
        if turn < 0.8 and cost < best:
            best, lane, towards = cost, lanes[k, LANE], lanes[k, TOWARDS]
    return lane, towards, found


@compiled
def _choose(
    echo: Floats, bodies: Floats, alive: int, limits: Floats
) -> int:  # pragma: no cover - compiled
    """Return which body a detection belongs to, or -1."""
    best, chosen = 1e9, -1
    for k in range(alive):
        cost = _misfit(echo, bodies[k], limits)
        if cost < best:
            best, chosen = cost, k
    return chosen


@compiled
def _misfit(echo: Floats, body: Floats, limits: Floats) -> float:  # pragma: no cover - compiled
    """Return how badly a detection fits a body; without bounds if it cannot be of it."""
    dx, dy = echo[0] - body[X], echo[1] - body[Y]
    if abs(dx) + abs(dy) > MOST_M:
        return np.inf
    rate = echo[2]
    c, s = np.cos(body[HEADING]), np.sin(body[HEADING])
    u, w = dx * c + dy * s, dy * c - dx * s
    beyond = max(u - body[FRONT], -body[REAR] - u, 0.0)
    beside = max(abs(w) - WIDE_M, 0.0)
    cos = c * echo[3] + s * echo[4]
    expected = body[SPEED] * cos
    if abs(rate) < limits[MOVING] and (body[SPEED] < 1.5 or abs(expected) > 0.6):
        return np.inf
    gap = abs(rate - expected)
    noise = np.sqrt(limits[RATE] ** 2 + body[VAR_V] * cos * cos)
    side = limits[ACROSS] + limits[AZIMUTH] * echo[5] + np.sqrt(min(body[VAR_D], 1.0))
    ahead = min(limits[ALONG], 0.5 + 0.2 * abs(body[SPEED]))
    ahead += 2.0 * np.sqrt(min(body[VAR_S], 1.0))
    if gap < 3.0 * noise:
        # one that drives as fast and so near is the same: drivers keep a second apart
        ahead += 0.5 * min(body[SPEED], 6.0)
    elif beyond > limits[ALONG]:
        return np.inf
    # the rim of a wheel moves at 0 to 2 v
    if beyond > ahead or beside > side or gap > abs(expected) + 1.0 + 2.0 * noise:
        return np.inf
    cost = (beyond / 0.5) ** 2 + (beside / 0.5) ** 2 + (w / 1.5) ** 2
    return float(cost + min((gap / noise) ** 2, 9.0 + gap))


@compiled
def _correct_branches(
    chosen: int, bodies: Floats, alive: int, echo: Floats, limits: Floats
) -> Floats:  # pragma: no cover - compiled
    """Correct all branches of a body that a detection fits; return the state of the best."""
    best = chosen
    for k in range(alive):
        if bodies[k, NUMBER] != bodies[chosen, NUMBER]:
            continue
        cost = _misfit(echo, bodies[k], limits)
        bodies[k, MISFIT] += 0.5 * min(cost, 9.0)
        if cost < np.inf:
            _correct(bodies[k], echo, limits)
            if bodies[k, MISFIT] < bodies[best, MISFIT]:
                best = k
    return bodies[best, : REAR + 1].copy()


@compiled
def _correct(body: Floats, echo: Floats, limits: Floats) -> None:  # pragma: no cover - compiled
    """Correct a body by a detection on it."""
    c, s = np.cos(body[HEADING]), np.sin(body[HEADING])
    dx, dy = echo[0] - body[X], echo[1] - body[Y]
    u, w = dx * c + dy * s, dy * c - dx * s
    cos = c * echo[3] + s * echo[4]
    gap = echo[2] - body[SPEED] * cos
    noise = limits[RATE] ** 2 + body[VAR_V] * cos * cos
    told = gap * gap < 9.0 * noise
    if told and abs(cos) >= limits[LEAST_COS]:
        gain_v, gain_s = body[VAR_V] * cos / noise, body[COV_SV] * cos / noise
        body[SPEED] += gain_v * gap
        body[X] += gain_s * gap * c
        body[Y] += gain_s * gap * s
        u -= gain_s * gap
        body[VAR_S] -= gain_s * cos * body[COV_SV]
        body[COV_SV] -= gain_v * cos * body[COV_SV]
        body[VAR_V] -= gain_v * cos * body[VAR_V]
    body[SPEED] = max(body[SPEED], -0.5)
    out = max(u - body[FRONT], 0.0) + min(u + body[REAR], 0.0)
    if out != 0.0:
        # Young bodies move to their detections; old ones grow, since their position is known.
        total = body[VAR_S] + 0.3
        gain = body[VAR_S] / total
        body[X] += gain * out * c
        body[Y] += gain * out * s
        body[SPEED] += body[COV_SV] / total * out
        body[VAR_V] -= body[COV_SV] ** 2 / total
        body[COV_SV] *= 1.0 - gain
        body[VAR_S] *= 1.0 - gain
        if told and body[SPEED] > 4.0 and body[FRONT] + body[REAR] < LONGEST_M:
            grown = 0.2 * (1.0 - gain) * out
            body[FRONT] += max(grown, 0.0)
            body[REAR] -= min(grown, 0.0)
    gain = body[VAR_D] / (body[VAR_D] + 0.6 + (limits[AZIMUTH] * echo[5]) ** 2)
    body[X] -= gain * w * s
    body[Y] += gain * w * c
    body[VAR_D] *= 1.0 - gain
    if body[SPEED] > 1.0:
        body[HEADING] += 0.02 * gain * w
    body[LAST] = body[TIME]
    body[HITS] += 1.0


@compiled
def _begin(  # noqa: PLR0917 - numba takes plain arrays  # pragma: no cover - compiled
    row: int,
    echo: Floats,
    limits: Floats,
    bodies: Floats,
    waiting: Floats,
    counts: Integers,
    born: Integers,
    lanes: Floats,
    field: FieldArrays,
) -> int:
    """Let a moving detection wait, or begin a body where several agree; return of how many rows."""
    kept = 0
    for k in range(counts[1]):
        if echo[6] - waiting[k, WAIT_TIME] <= limits[BIRTH_S]:
            waiting[kept] = waiting[k]
            kept += 1
    counts[1] = kept
    found = lanes_at(echo[0], echo[1], field, lanes)
    first = counts[0]
    for k in range(found):
        cos = np.cos(lanes[k, TOWARDS]) * echo[3] + np.sin(lanes[k, TOWARDS]) * echo[4]
        speed = echo[2] / cos if abs(cos) >= limits[LEAST_COS] else -1.0
        if not 0.3 <= speed <= FASTEST_MPS or abs(lanes[k, LEFT]) > lanes[k, HALF] + 0.5:
            continue
        matches, moments = _agreeing(echo, speed, lanes[k, TOWARDS], waiting, counts[1])
        if matches >= limits[BIRTHS] and moments >= 2 and counts[0] < len(bodies):
            body = bodies[counts[0]]
            body[:] = 0.0
            body[X], body[Y], body[HEADING], body[SPEED] = (
                echo[0],
                echo[1],
                lanes[k, TOWARDS],
                speed,
            )
            body[FRONT] = body[REAR] = 0.5 * limits[CAR_M]
            body[VAR_S], body[VAR_V], body[VAR_D] = 2.0, 1.0, 0.5
            body[LAST] = body[TIME] = echo[6]
            body[NUMBER], body[HITS], body[FOLLOWED] = counts[2], matches, lanes[k, LANE]
            body[MISFIT] = (lanes[k, LEFT] / lanes[k, HALF]) ** 2 - matches
            counts[0] += 1
    if counts[0] > first:
        counts[2] += 1
        return _claim(row, echo, bodies[first : counts[0]], waiting, counts, born)
    for k in range(found):
        cos = np.cos(lanes[k, TOWARDS]) * echo[3] + np.sin(lanes[k, TOWARDS]) * echo[4]
        speed = echo[2] / cos if abs(cos) >= limits[LEAST_COS] else -1.0
        if 0.3 <= speed <= FASTEST_MPS and counts[1] < len(waiting):
            wait = waiting[counts[1]]
            wait[X], wait[Y], wait[WAIT_SPEED] = echo[0], echo[1], speed
            wait[WAIT_HEADING], wait[WAIT_TIME] = lanes[k, TOWARDS], echo[6]
            wait[WAIT_ROW] = row + counts[3]
            counts[1] += 1
    return 0


@compiled
def _agreeing(
    echo: Floats, speed: float, heading: float, waiting: Floats, count: int
) -> tuple[int, int]:  # pragma: no cover - compiled
    """Return how many detections agree with one that drives so, itself included; and moments."""
    matches, moments, last, counted = 1, 1, echo[6], -1.0
    c, s = np.cos(heading), np.sin(heading)
    for j in range(count - 1, -1, -1):
        wait = waiting[j]
        turned = abs(_turn(wait[WAIT_HEADING], heading)) > 0.5
        if turned or abs(wait[WAIT_SPEED] - speed) > 1.0 + 0.08 * speed:
            continue
        dx, dy = echo[0] - wait[X], echo[1] - wait[Y]
        way = 0.5 * (wait[WAIT_SPEED] + speed) * (echo[6] - wait[WAIT_TIME])
        if abs(dx * c + dy * s - way) > 3.0 or abs(dy * c - dx * s) > 1.8:
            continue
        if wait[WAIT_ROW] != counted:  # it waits once a lane
            matches += 1
            counted = wait[WAIT_ROW]
        if wait[WAIT_TIME] < last:
            moments += 1
            last = wait[WAIT_TIME]
    return matches, moments


@compiled
def _claim(
    row: int, echo: Floats, begun: Floats, waiting: Floats, counts: Integers, born: Integers
) -> int:
    """Take what waits and agrees with a new body out; return how many rows are of it now."""
    born[0], taken, kept = row, 1, 0
    for j in range(counts[1]):
        wait = waiting[j]
        agrees = False
        for k in range(len(begun)):
            c, s = np.cos(begun[k, HEADING]), np.sin(begun[k, HEADING])
            way = begun[k, SPEED] * (echo[6] - wait[WAIT_TIME])
            dx, dy = echo[0] - wait[X], echo[1] - wait[Y]
            agrees = agrees or (abs(dx * c + dy * s - way) <= 3.0 and abs(dy * c - dx * s) <= 1.8)
        old = int(wait[WAIT_ROW] - counts[3])
        if agrees and old >= 0 and taken < len(born):
            born[taken] = old
            taken += 1
        elif not agrees:
            waiting[kept] = wait
            kept += 1
    counts[1] = kept
    return taken

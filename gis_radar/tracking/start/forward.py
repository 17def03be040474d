"""Forward filter: a Kalman filter that follows moving vehicles detection by detection.

A vehicle is a body on the plane: a point of it, its heading, its speed, and its reach ahead and
behind. On a lane its heading turns as the lane does; where lanes fork, each is a branch (a
hypothesis), until detections decide which one it took. A detection is associated with the body that
it lies on and whose speed its range rate fits. Its range rate corrects the speed; its place, the
position, only if it lies outside the body, since a vehicle has scatterers anywhere. Still
detections are left to `stationary`: here they would pull bodies to kerbs and signs.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from gis_radar.base import Floats, Integers, compiled, heading_difference
from gis_radar.hdmap import FieldArrays, LaneGraph, lanes_at
from gis_radar.tracking.columns import (  # fmt: skip
    ALIVE,
    ALONG_LANE,
    BASE,
    BEGUN,
    BODY_COLUMNS,
    BRANCH,
    BRANCHES,
    COUNT_ENTRIES,
    COV_SV,
    DETECTION_COUNT,
    FOLLOWED,
    FRONT,
    HALF,
    HEADING,
    KEPT,
    LANE,
    LAST_TIME,
    LEFT,
    MISFIT,
    NONE,
    NUMBER,
    PASSED,
    REAR,
    SINCE_M,
    SPEED,
    TIME,
    TOWARDS,
    VAR_D,
    VAR_S,
    VAR_V,
    WAIT_COLUMNS,
    X,
    Y,
)
from gis_radar.tracking.detections import AZIMUTH_RAD, MOVING_MPS, MapDetections
from gis_radar.tracking.size import LONGEST_M
from gis_radar.tracking.start.births import _LEAST_LANE_COS, BIRTH_S, begin

_CAPACITY = 1024  # most vehicles at a time
_WAITING = 2048  # most detections at a time that are of no vehicle yet
_SPARE = 1024  # room for branches beyond the number of detections
_REACH_M = 30.0  # largest distance from the point of a body to its detections
_HALF_WIDTH_M = 1.0  # half the width of a vehicle
_FORK_M = 3.0  # lanes that begin within this of a place are branches of one fork
_SINCE_FORK_M, _NEAR_M = 30.0, 1.0  # branches so near each other so far beyond the fork are one
# Largest difference of the misfits of two branches of a vehicle, and largest misfit by one
# detection, both in squared sigmas: so six outliers do not end a branch.
_MOST_MISFIT, _MOST_COST = 24.0, 4.0
_ACCEL_MPS2 = 1.5  # sigma of the acceleration that drivers choose
_SIDEWAYS_MPS = 0.3  # sigma of the drift across the lane
_RATE_SIGMA_MPS = 0.25  # sigma of a range rate, including what a turning body adds
_ALONG_M, _ACROSS_M = 1.2, 0.7  # how far outside of the body a detection may lie
# Longest time without a detection that a track is continued, after which it may be 3 m off; and at
# rest, as still detections are not used. With under six detections it is dropped after BIRTH_S.
_COAST_S, STAND_S = 2.0, 20.0
STANDING_MPS = 0.7  # below it a vehicle may stand


# Branch of each detection; (parent, detection at the fork) of each branch; rows (detection, branch,
# state) where a vehicle has several branches.
BranchLog: TypeAlias = tuple[Integers, Integers, Floats]


class ForwardFilter:
    """Filter that follows vehicles through a stream of detections.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.
    """

    def __init__(self, graph: LaneGraph) -> None:
        self._field = graph.field.arrays
        self._bodies = np.zeros((_CAPACITY, BODY_COLUMNS))
        self._waiting = np.zeros((_WAITING, WAIT_COLUMNS))
        self._counts = np.zeros(COUNT_ENTRIES, np.int64)

    def push(self, detections: MapDetections) -> tuple[Integers, Floats]:
        """Process the next detections; return the vehicle of each and its state.

        Parameters
        ----------
        detections : MapDetections
            In the order of time, after all so far.

        Returns
        -------
        number : (n,) int64 array
            From 0 in the order in which vehicles begin, `NONE` for detections of none. Detections
            with which a vehicle began have its number if they are among these.
        state : (n, 6) array
            East, north, heading, speed, and the reach to front and rear of that vehicle, corrected
            by this detection, by the branch that it had taken at the end of these detections.
        """
        number, state = np.full(len(detections), NONE, np.int64), np.zeros((len(detections), 6))
        # Of a frame without moving detections one row is kept, for its time.
        taken = np.flatnonzero(
            (np.abs(detections.range_rate) >= MOVING_MPS)
            | (np.diff(detections.time, prepend=-np.inf) > 0.0)
        )
        number[taken], state[taken] = self._push(detections.take(taken))
        return number, state

    def _push(self, detections: MapDetections) -> tuple[Integers, Floats]:
        """Process the selected detections, as `push`."""
        number, state = np.full(len(detections), NONE, np.int64), np.zeros((len(detections), 6))
        columns = ("points", "range_rate", "sight", "range_m", "time")
        rows = np.column_stack([getattr(detections, name) for name in columns])
        count = len(detections) + _SPARE
        log = (np.full(count, NONE), np.full((count, 2), NONE), np.zeros((4 * count, 8)))
        self._counts[BASE], self._counts[KEPT] = self._counts[BRANCHES], 0
        _follow(
            rows, self._bodies, self._waiting, self._counts, (number, state), log,
            self._field,
        )  # fmt: skip
        _use_final_branches(number, state, log, self._counts)
        self._counts[PASSED] += len(detections)
        return number, state

    @property
    def branches(self) -> int:
        """Number of branches of all vehicles."""
        return int(self._counts[ALIVE])

    @property
    def bodies(self) -> Floats:
        """Vehicles followed now, a row each by the best branch; `columns` names the columns."""
        alive = self._bodies[: int(self._counts[ALIVE])]
        alive = alive[np.lexsort((alive[:, MISFIT], alive[:, NUMBER]))]
        _, best = np.unique(alive[:, NUMBER], return_index=True)
        return np.asarray(alive[best])


def follow_both_ways(
    detections: MapDetections, graph: LaneGraph
) -> tuple[tuple[Integers, Integers], tuple[Floats, Floats]]:
    """Follow vehicles forward and backward in time.

    Returns
    -------
    numbers, states : (forward, backward)
        As `ForwardFilter.push` returns them, for each direction.
    """
    number, state = ForwardFilter(graph).push(detections)
    backward = ForwardFilter(graph.reversed)
    number_back, state_back = backward.push(detections.reversed())
    number_back, state_back = number_back[::-1].copy(), state_back[::-1].copy()
    state_back[:, HEADING] += np.pi
    state_back[:, [FRONT, REAR]] = state_back[:, [REAR, FRONT]]
    return (number, number_back), (state, state_back)


@compiled
def _follow(
    detections: Floats,
    bodies: Floats,
    waiting: Floats,
    counts: Integers,
    out: tuple[Integers, Floats],
    log: BranchLog,
    field: FieldArrays,
) -> None:
    """Process detections (x, y, range rate, sight, range, time); write number and state of each."""
    lanes, members = np.empty((8, 6)), np.empty(len(waiting), np.int64)
    number, state = out
    branch, _, branch_states = log
    for i in range(len(detections)):
        now = detections[i, 6]
        if i == 0 or now > detections[i - 1, 6]:
            _predict_all(i, log, bodies, counts, now, lanes, field)
        if abs(detections[i, 2]) < MOVING_MPS:
            continue
        chosen = _associate(detections[i], bodies, counts[ALIVE])
        if chosen >= 0:
            number[i] = int(bodies[chosen, NUMBER])
            best = _correct_branches(i, chosen, bodies, counts, detections[i], branch_states)
            state[i], branch[i] = bodies[best, : REAR + 1], int(bodies[best, BRANCH])
        else:
            before = counts[ALIVE]
            count = begin(i, detections[i], bodies, waiting, counts, members, lanes, field)
            if count == 0:
                continue
            branches = bodies[before : counts[ALIVE]]
            body = branches[np.argmin(branches[:, MISFIT])]
            for k in range(count):
                row = members[k]
                lapse = now - detections[row, 6]
                number[row], branch[row] = int(body[NUMBER]), int(body[BRANCH])
                state[row] = body[: REAR + 1]
                state[row, X] -= body[SPEED] * lapse * np.cos(body[HEADING])
                state[row, Y] -= body[SPEED] * lapse * np.sin(body[HEADING])


@compiled
def _predict_all(
    row: int,
    log: BranchLog,
    bodies: Floats,
    counts: Integers,
    now: float,
    lanes: Floats,
    field: FieldArrays,
) -> None:
    """Predict all bodies to a time, drop those undetected for too long, fork and prune branches."""
    k = 0
    while k < counts[ALIVE]:
        body = bodies[k]
        longest_s = STAND_S if body[SPEED] < STANDING_MPS else _COAST_S
        if now - body[LAST_TIME] > (BIRTH_S if body[DETECTION_COUNT] < 6.0 else longest_s):
            counts[ALIVE] -= 1
            bodies[k] = bodies[counts[ALIVE]]
            continue
        lane_count = _predict(body, now, lanes, field)
        _fork(k, row, log[1], bodies, counts, lanes, lane_count)
        k += 1
    _prune_branches(bodies, counts)


@compiled
def _fork(
    k: int, row: int, lineage: Integers, bodies: Floats, counts: Integers, lanes: Floats, found: int
) -> None:  # pragma: no cover - compiled
    """Add a branch of body `k` for each other lane that begins where its own lane does."""
    body = bodies[k]
    for j in range(found):
        if lanes[j, LANE] == body[FOLLOWED] or lanes[j, ALONG_LANE] > _FORK_M:
            continue
        if (
            abs(lanes[j, LEFT]) > lanes[j, HALF]
            or abs(heading_difference(lanes[j, TOWARDS], body[HEADING])) > 0.5
        ):
            continue
        new = counts[BRANCHES] - counts[BASE]
        exists = counts[ALIVE] >= len(bodies) or new >= len(lineage)
        for other in range(counts[ALIVE]):
            same = bodies[other, NUMBER] == body[NUMBER]
            exists = exists or (same and bodies[other, FOLLOWED] == lanes[j, LANE])
        if not exists:
            bodies[counts[ALIVE]] = body
            bodies[counts[ALIVE], FOLLOWED] = lanes[j, LANE]
            bodies[counts[ALIVE], BRANCH] = counts[BRANCHES]
            lineage[new, 0], lineage[new, 1] = int(body[BRANCH]), row
            body[SINCE_M] = bodies[counts[ALIVE], SINCE_M] = 0.0
            counts[BRANCHES] += 1
            counts[ALIVE] += 1


@compiled
def _prune_branches(bodies: Floats, counts: Integers) -> None:  # pragma: no cover - compiled
    """Drop branches that fit much worse than another one of the vehicle, or follow its lane."""
    k = 0
    while k < counts[ALIVE]:
        worse = False
        for other in range(counts[ALIVE]):
            if other == k or bodies[other, NUMBER] != bodies[k, NUMBER]:
                continue
            more = bodies[k, MISFIT] - bodies[other, MISFIT]
            same = bodies[k, FOLLOWED] >= 0.0 and bodies[k, FOLLOWED] == bodies[other, FOLLOWED]
            same = same or _have_rejoined(bodies[k], bodies[other])
            worse = (
                worse
                or more > _MOST_MISFIT
                or (same and (more > 0.0 or (more == 0.0 and k > other)))
            )
        if worse:
            counts[ALIVE] -= 1
            bodies[k] = bodies[counts[ALIVE]]
        else:
            k += 1


@compiled
def _have_rejoined(one: Floats, other: Floats) -> bool:  # pragma: no cover - compiled
    """Return whether two branches are at the same place again, far beyond their fork."""
    apart = np.hypot(one[X] - other[X], one[Y] - other[Y])
    return bool(min(one[SINCE_M], other[SINCE_M]) > _SINCE_FORK_M and apart < _NEAR_M)


@compiled
def _predict(
    body: Floats, time: float, lanes: Floats, field: FieldArrays
) -> int:  # pragma: no cover - compiled
    """Predict a body to a time along its lane; return the number of lanes there if it is new."""
    lapse = time - body[TIME]
    if lapse <= 0.0:
        return 0
    body[TIME] = time
    step = body[SPEED] * lapse
    body[SINCE_M] += abs(step)
    here, towards, _ = _lane_of(body[X], body[Y], body[HEADING], body[FOLLOWED], lanes, field)
    body[X] += step * np.cos(body[HEADING])
    body[Y] += step * np.sin(body[HEADING])
    new_lanes = 0
    if here >= 0.0 and abs(step) > 0.0:
        there, towards_after, count = _lane_of(body[X], body[Y], towards, here, lanes, field)
        if there >= 0.0:
            body[HEADING] += heading_difference(towards_after, towards)
            # towards the lane's direction, within the way in which a driver straightens up
            body[HEADING] += heading_difference(towards_after, body[HEADING]) * min(
                abs(step) / 15.0, 1.0
            )
        new_lanes = count if there >= 0.0 and there != body[FOLLOWED] else 0
        body[FOLLOWED] = there
    accel_var = _ACCEL_MPS2**2
    body[VAR_S] += 2.0 * lapse * body[COV_SV] + lapse**2 * body[VAR_V] + accel_var * lapse**4 / 4.0
    body[COV_SV] += lapse * body[VAR_V] + accel_var * lapse**3 / 2.0
    body[VAR_V] += accel_var * lapse
    drift = _SIDEWAYS_MPS * min(abs(body[SPEED]) / 3.0, 1.0)
    body[VAR_D] += (drift**2 + 0.01) * lapse
    return new_lanes


@compiled
def _lane_of(
    x: float, y: float, heading: float, before: float, lanes: Floats, field: FieldArrays
) -> tuple[float, float, int]:
    """Return the likeliest lane at a point, its direction (rad), and the number of lanes there."""
    best, lane, towards = 1e9, -1.0, heading
    found = lanes_at(x, y, field, lanes)
    for k in range(found):
        turn = abs(heading_difference(lanes[k, TOWARDS], heading))
        cost = turn / 0.25 + abs(lanes[k, LEFT]) / 1.5
        if lanes[k, LANE] == before:
            cost -= 2.0
        if turn < 0.8 and cost < best:
            best, lane, towards = cost, lanes[k, LANE], lanes[k, TOWARDS]
    return lane, towards, found


@compiled
def _associate(detection: Floats, bodies: Floats, alive: int) -> int:  # pragma: no cover - compiled
    """Return the body with the least cost of association with a detection, -1 without any."""
    best, chosen = 1e9, -1
    for k in range(alive):
        cost = _association_cost(detection, bodies[k])
        if cost < best:
            best, chosen = cost, k
    return chosen


@compiled
def _association_cost(detection: Floats, body: Floats) -> float:  # pragma: no cover - compiled
    """Return the cost of associating a detection with a body; infinite outside of the gate."""
    dx, dy = detection[0] - body[X], detection[1] - body[Y]
    if abs(dx) + abs(dy) > _REACH_M:
        return np.inf
    rate = detection[2]
    c, s = np.cos(body[HEADING]), np.sin(body[HEADING])
    along, left = dx * c + dy * s, dy * c - dx * s
    beyond = max(along - body[FRONT], -body[REAR] - along, 0.0)
    beside = max(abs(left) - _HALF_WIDTH_M, 0.0)
    cos = c * detection[3] + s * detection[4]
    expected = body[SPEED] * cos
    innovation = abs(rate - expected)
    noise = np.sqrt(_RATE_SIGMA_MPS**2 + body[VAR_V] * cos * cos)
    side = _ACROSS_M + AZIMUTH_RAD * detection[5] + np.sqrt(min(body[VAR_D], 1.0))
    ahead = min(_ALONG_M, 0.5 + 0.2 * abs(body[SPEED]))
    ahead += 2.0 * np.sqrt(min(body[VAR_S], 1.0))
    if innovation < 3.0 * noise:
        # a detection so near at the same speed is of this body: drivers keep a second apart
        ahead += 0.5 * min(body[SPEED], 6.0)
    elif beyond > _ALONG_M:
        return np.inf
    # the rim of a wheel moves at 0 to 2 v
    if beyond > ahead or beside > side or innovation > abs(expected) + 1.0 + 2.0 * noise:
        return np.inf
    cost = (beyond / 0.5) ** 2 + (beside / 0.5) ** 2 + (left / 1.5) ** 2
    return float(cost + min((innovation / noise) ** 2, 9.0 + innovation))


@compiled
def _correct_branches(
    row: int, chosen: int, bodies: Floats, counts: Integers, detection: Floats,
    branch_states: Floats,
) -> int:  # fmt: skip  # pragma: no cover - compiled
    """Correct the branches of a vehicle by a detection, log their states; return the best one."""
    best, least, first = chosen, np.inf, counts[KEPT]
    for k in range(counts[ALIVE]):
        if bodies[k, NUMBER] != bodies[chosen, NUMBER]:
            continue
        cost = _association_cost(detection, bodies[k])
        bodies[k, MISFIT] += min(cost, _MOST_COST)
        if cost < np.inf:
            _correct(bodies[k], detection)
            if bodies[k, MISFIT] < least:
                best, least = k, bodies[k, MISFIT]
        if counts[KEPT] < len(branch_states):
            branch_states[counts[KEPT], 0], branch_states[counts[KEPT], 1] = row, bodies[k, BRANCH]
            branch_states[counts[KEPT], 2:] = bodies[k, : REAR + 1]
            counts[KEPT] += 1
    if counts[KEPT] == first + 1:
        counts[KEPT] = first  # with one branch only, its state need not be stored
    return best


@compiled
def _use_final_branches(
    number: Integers, state: Floats, log: BranchLog, counts: Integers
) -> None:  # pragma: no cover - compiled
    """Set the state of each detection to that of the branch that its vehicle finally took."""
    branch, lineage, branch_states = log
    last = np.full(counts[BEGUN], NONE)
    k, base = counts[KEPT] - 1, counts[BASE]
    for i in range(len(number) - 1, -1, -1):
        if number[i] == NONE:
            continue
        taken = branch[i] if last[number[i]] == NONE else last[number[i]]
        while base <= taken < base + len(lineage) and lineage[taken - base, 1] > i:
            taken = lineage[taken - base, 0]
        last[number[i]] = taken
        while k >= 0 and branch_states[k, 0] > i:
            k -= 1
        j = k
        while j >= 0 and branch_states[j, 0] == i:
            if int(branch_states[j, 1]) == taken:
                state[i] = branch_states[j, 2:]
            j -= 1


@compiled
def _correct(body: Floats, detection: Floats) -> None:  # pragma: no cover - compiled
    """Correct a body by a detection: a Kalman update of speed, position, reach and heading."""
    c, s = np.cos(body[HEADING]), np.sin(body[HEADING])
    dx, dy = detection[0] - body[X], detection[1] - body[Y]
    ahead, left = dx * c + dy * s, dy * c - dx * s
    cos = c * detection[3] + s * detection[4]
    innovation = detection[2] - body[SPEED] * cos
    noise = _RATE_SIGMA_MPS**2 + body[VAR_V] * cos * cos
    rate_fits = innovation * innovation < 9.0 * noise
    if rate_fits and abs(cos) >= _LEAST_LANE_COS:
        gain_v, gain_s = body[VAR_V] * cos / noise, body[COV_SV] * cos / noise
        body[SPEED] += gain_v * innovation
        body[X] += gain_s * innovation * c
        body[Y] += gain_s * innovation * s
        ahead -= gain_s * innovation
        body[VAR_S] -= gain_s * cos * body[COV_SV]
        body[COV_SV] -= gain_v * cos * body[COV_SV]
        body[VAR_V] -= gain_v * cos * body[VAR_V]
    body[SPEED] = max(body[SPEED], -0.5)
    outside = max(ahead - body[FRONT], 0.0) + min(ahead + body[REAR], 0.0)
    if outside != 0.0:
        # Young bodies move to their detections; old ones grow, since their position is known.
        total = body[VAR_S] + 0.3
        gain = body[VAR_S] / total
        body[X] += gain * outside * c
        body[Y] += gain * outside * s
        body[SPEED] += body[COV_SV] / total * outside
        body[VAR_V] -= body[COV_SV] ** 2 / total
        body[COV_SV] *= 1.0 - gain
        body[VAR_S] *= 1.0 - gain
        if rate_fits and body[SPEED] > 4.0 and body[FRONT] + body[REAR] < LONGEST_M:
            grown = 0.2 * (1.0 - gain) * outside
            body[FRONT] += max(grown, 0.0)
            body[REAR] -= min(grown, 0.0)
    gain = body[VAR_D] / (body[VAR_D] + 0.6 + (AZIMUTH_RAD * detection[5]) ** 2)
    body[X] -= gain * left * s
    body[Y] += gain * left * c
    body[VAR_D] *= 1.0 - gain
    if body[SPEED] > 1.0:
        body[HEADING] += 0.02 * gain * left
    body[LAST_TIME] = body[TIME]
    body[DETECTION_COUNT] += 1.0

"""Follow the vehicles of now as detections come; no later data correct what was shown.

The tracker's forward filter follows moving vehicles. A vehicle that stands for so long that the
filter loses it is still shown at its place, until a vehicle drives there, at most three minutes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from gis_radar.base import Floats
from gis_radar.hdmap import LaneGraph
from gis_radar.tracking import (
    MOVING_MPS,
    STAND_S,
    ForwardFilter,
    MapDetections,
    are_persons,
    columns,
    usual_rcs,
)

HEAVY_M = 7.0  # longer vehicles count as heavy (contract)
_LENGTHS_M, _HEAVY_WIDTH_M, _WIDTH_M = (4.6, 18.75), 2.5, 1.85
_SURE_HITS = 6  # least detections of a shown vehicle
_FOLLOWED_S = 60.0  # longest time after its last detection that a vehicle is shown as followed
STANDING_S = 180.0  # time that a vehicle which stood when the filter lost it is still shown
_LEAVING_MPS = 0.7  # a vehicle that was faster when it was lost has left
_SAME_M = 2.5  # a vehicle found nearer than this to the place of a standing one is the same
# Cross sections kept of a vehicle, and vehicles kept to distinguish walkers from.
_RCS_KEPT, _VEHICLES_KEPT = 40, 400


@dataclass(frozen=True, kw_only=True)
class VehiclesNow:
    """Vehicles of a moment.

    Parameters
    ----------
    time : float
        UNIX seconds.
    vehicle : (n,) int64 array
        Numbers of the vehicles, which no table shares.
    place : (n, 2) array
        Easting and northing of the middle, metres.
    heading, speed, length_m, width_m : (n,) arrays
        Yaw in degrees, m/s, metres.
    """

    time: float
    vehicle: np.ndarray
    place: Floats
    heading: Floats
    speed: Floats
    length_m: Floats
    width_m: Floats

    def __len__(self) -> int:
        return len(self.vehicle)

    @property
    def heavy(self) -> np.ndarray:
        """Whether each vehicle is heavy: longer than 7 m."""
        return np.asarray(self.length_m > HEAVY_M)

    @classmethod
    def of(cls, time: float, rows: Floats) -> VehiclesNow:
        """Return the vehicles of rows (number, easting, northing, heading, speed, length)."""
        length = np.clip(rows[:, 5], *_LENGTHS_M)
        return cls(
            time=time, vehicle=rows[:, 0].astype(np.int64), place=rows[:, 1:3],
            heading=np.degrees(np.angle(np.exp(1j * rows[:, 3]))), speed=rows[:, 4],
            length_m=length, width_m=np.where(length > HEAVY_M, _HEAVY_WIDTH_M, _WIDTH_M),
        )  # fmt: skip

    @classmethod
    def none(cls) -> VehiclesNow:
        """Return no vehicles."""
        return cls.of(float("nan"), np.zeros((0, 6)))


@dataclass(kw_only=True)
class _Learned:
    """Cross sections and speeds learned of a vehicle that the filter follows."""

    rcs: deque[float]
    max_speed: float = 0.0


@dataclass(kw_only=True)
class NowFilter:
    """Filter that follows vehicles as detections come; no later data correct its result.

    Parameters
    ----------
    graph : LaneGraph
        The lanes.

    Attributes
    ----------
    late : int
        Number of frames whose detections came too late.
    """

    graph: LaneGraph
    late: int = 0
    _waiting: list[MapDetections] = field(default_factory=list)
    _known: dict[int, _Learned] = field(default_factory=dict)
    # Vehicles that the filter lost while they stood, by number: row of `_shown`, and time.
    _standing: dict[int, Floats] = field(default_factory=dict)
    # Vehicles of the filter by number: easting, northing, heading, speed, length.
    _shown: dict[int, Floats] = field(default_factory=dict)
    _shown_as: dict[int, int] = field(default_factory=dict)
    _reached: float = -np.inf
    _still_rcs: float = np.nan

    def __post_init__(self) -> None:
        self._filter = ForwardFilter(self.graph)

    def take(self, detections: MapDetections) -> None:
        """Add the detections of a frame, unless it is older than the last published time."""
        fresh = detections.take(detections.time > self._reached)
        self.late += len(fresh) < len(detections)
        self._waiting.append(fresh)

    def advance(self, until: float) -> None:
        """Filter the detections up to a time (UNIX seconds)."""
        waiting = MapDetections.join(self._waiting)
        ready = waiting.time <= until
        self._waiting = [waiting.take(~ready)]
        if until > self._reached + STAND_S:  # no detections for long
            self._standing, self._shown = {}, {}
        self._reached = max(self._reached, until)
        detections = waiting.take(ready)
        if len(detections):
            number, states = self._filter.push(detections)
            self._learn(detections, number, states)
        self._show()

    def _learn(self, detections: MapDetections, number: np.ndarray, states: Floats) -> None:
        """Record cross sections and speeds, by which persons are distinguished from vehicles."""
        still = np.abs(detections.range_rate) < MOVING_MPS
        known = usual_rcs(detections.rcs[still])
        self._still_rcs = known if np.isnan(self._still_rcs) else self._still_rcs
        if not np.isnan(known):
            self._still_rcs += 0.05 * (known - self._still_rcs)
        for each in np.unique(number[number >= 0]).tolist():
            rows = number == each
            found = self._known.pop(each, None) or _Learned(rcs=deque(maxlen=_RCS_KEPT))
            found.rcs.extend(detections.rcs[rows].tolist())
            found.max_speed = max(found.max_speed, float(states[rows, columns.SPEED].max()))
            self._known[each] = found  # the latest is last
        while len(self._known) > _VEHICLES_KEPT:
            del self._known[next(iter(self._known))]

    def _persons(self) -> set[int]:
        """Return the numbers of bodies that are persons, by cross sections and greatest speeds."""
        numbers = [*self._known]
        rcs = np.array([usual_rcs(np.array(each.rcs)) for each in self._known.values()])
        max_speed = np.array([each.max_speed for each in self._known.values()])
        person = are_persons(
            rcs, max_speed, np.full(len(rcs), np.nan), np.ones(len(rcs), np.bool_), self._still_rcs,
        )  # fmt: skip
        return {numbers[k] for k in np.flatnonzero(person).tolist()}

    def _show(self) -> None:
        """Update the shown vehicles by the filter's bodies, and hold those that it has lost."""
        bodies = self._filter.bodies
        recent = bodies[:, columns.LAST_TIME] > self._reached - _FOLLOWED_S
        sure = (bodies[:, columns.DETECTION_COUNT] >= _SURE_HITS) & recent
        persons = self._persons() if len(bodies) else set()
        alive: dict[int, Floats] = {}
        for body in bodies[sure]:
            if (number := int(body[columns.NUMBER])) not in persons:
                front, rear, heading = body[[columns.FRONT, columns.REAR, columns.HEADING]]
                direction = np.array([np.cos(heading), np.sin(heading)])
                centre = body[[columns.X, columns.Y]] + 0.5 * (front - rear) * direction
                alive[number] = np.array([*centre, heading, body[columns.SPEED], front + rear])
        places = np.array([each[:2] for each in alive.values()]).reshape(-1, 2)
        for number, row in self._shown.items():
            if number not in alive and row[3] < _LEAVING_MPS:
                self._standing[number] = np.array([*row, self._reached])
        for number in [*self._standing]:
            near = self._near(self._standing[number][:2], places)
            if near is not None:  # the vehicle drives on, or another one is at its place
                new = [*alive][near]
                self._shown_as.setdefault(new, self._shown_as.get(number, number))
            is_over = self._reached - self._standing[number][5] > STANDING_S
            if near is not None or is_over:
                del self._standing[number]
        self._shown_as = {
            k: v for k, v in self._shown_as.items() if k in alive or k in self._standing
        }
        self._shown = alive

    def _near(self, place: Floats, places: Floats) -> int | None:
        distance_m = np.hypot(*(places - place).T) if len(places) else np.zeros(0)
        nearest = int(distance_m.argmin()) if len(distance_m) else -1
        return nearest if len(distance_m) and distance_m[nearest] < _SAME_M else None

    def now(self) -> VehiclesNow:
        """Return the vehicles of the last moment."""
        rows_by_number = {**{k: row[:5] for k, row in self._standing.items()}, **self._shown}
        rows, used = [], {*rows_by_number}
        for number, row in rows_by_number.items():
            earlier = self._shown_as.get(number, number)
            shown = number if earlier in used else earlier
            used.add(shown)
            rows.append((shown, *row))
        table = np.array(rows, np.float64).reshape(-1, 6)
        table[:, 1:3] += self.graph.origin
        return VehiclesNow.of(self._reached, table)

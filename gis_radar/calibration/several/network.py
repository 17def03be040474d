"""Network of sensors, whose poses correspondences confirm, contradict or choose, and adjust."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gis_radar.base import Floats, Integers, NoAnswerError, Text
from gis_radar.calibration.registration.certainty import longest_m
from gis_radar.calibration.registration.lanes import Lanes
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import NONE, link_tracks
from gis_radar.calibration.several.adjustment import (
    CLOCK_S,
    FREE_CLOCK_S,
    Adjusted,
    Correspondences,
    adjust,
    moved,
    planar_covariance,
    shared_covariance,
    sum_correspondences,
    with_gain,
)
from gis_radar.calibration.several.correspondences import (
    LEAST_PAIRS,
    MOMENT_S,
    PLANAR,
    Moments,
    Names,
    Rows,
    assign,
    compare_moments,
    mean_gaps,
    read_moments,
)
from gis_radar.calibration.several.placing import (
    CONTRADICTION_CHI2,
    GATE_CHI2,
    GRID_YAW,
    LAG_CLEAR,
    REACH_S,
    STEP_M,
    Choice,
    Placing,
    Station,
    clash_text,
    contradiction_text,
    find_place,
    preference,
)
from gis_radar.calibration.single.moving import RIGHT
from gis_radar.calibration.timing.clock_offsets import ODD_DRIFT, measured_offset
from gis_radar.calibration.timing.clocks import SensorClock, adjust_network, reached
from gis_radar.calibration.timing.lane_detections import lane_detections
from gis_radar.poses import Pose

# Largest and least clock offset that is looked for: with larger ones, radars have no common time;
# smaller ones are left to the adjustment of the poses.
MOST_LAG_S = 10.0
LEAST_LAG_S = 0.25
CLOCK_SIGMAS = 4.0  # standard deviations beyond which a clock's offset is remarked upon
# Fewer pairs do not move a pose that is certain by itself: a cluster-robust covariance needs 20 to
# 50 clusters (Cameron, Miller 2015), and few vehicles may all be on one lane.
FIRM_PAIRS = 20
FIXED_M = 1.0  # where 1 sigma along its weakest direction is larger, a pose is searched along it
PAIRING_ROUNDS = 6  # rounds of pairing and fitting; two or three are enough
AT_REST = 1e-4  # a smaller step ends the adjustment, metres and radians
CLASH_HINT = Text("check both guesses, and the clocks of both sensors: gis-radar clocks")


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Result of a joint calibration.

    Parameters
    ----------
    poses : dict of str to Pose
        By sensor; sensors without correspondences keep their own poses.
    chosen : dict of str to int
        By sensor: index of the chosen pose in those of its own localization.
    refused : dict of str to str
        By sensor without a trustworthy pose: the reason, where it is the network's.
    pairs : dict
        By two sensors' names: number of vehicles that both see.
    unmatched : dict of str to str
        By sensor without correspondences: the reason.
    remarks : tuple of str
        Remarks for the user.
    """

    poses: dict[str, Pose]
    chosen: dict[str, int]
    refused: dict[str, str]
    pairs: dict[Names, int]
    unmatched: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def solve_network(stations: Sequence[Station], lanes: Lanes) -> Solved:
    """Adjust the poses of several sensors by the vehicles that they see at the same time.

    Parameters
    ----------
    stations : sequence of Station
        The sensors; those with one pose fix those with several.
    lanes : Lanes
        The map around all of them.
    """
    network = _Network(stations, lanes)
    network.place_all()
    while True:
        network.refuse_clashes()
        adjusted, matched = network.adjusted()
        if network.free_clock(matched):
            continue
        found = network.misfits(adjusted, matched)
        if not found:
            break
        network.clashes |= found
    return network.solved(adjusted, matched)


@dataclass
class _Member:
    """A sensor on its way to a pose."""

    station: Station
    tracks: Integers
    choice: int = 0
    start: Floats = field(default_factory=lambda: np.zeros(PLANAR))  # step from its own answer
    away: Floats = field(default_factory=lambda: np.zeros(PLANAR))
    loose: bool = False  # its own answer did not fix the place: correspondences chose the start
    clock: SensorClock = RIGHT  # its assumed clock
    free: bool = False  # its clock, off or not measured, is estimated with the poses

    @property
    def pose(self) -> Pose:
        return self.station.poses[self.choice]


class _Network:
    """Sensors with their places, and the pairs of them that agree or contradict each other."""

    def __init__(self, stations: Sequence[Station], lanes: Lanes) -> None:
        self.lanes = lanes
        self.all = {each.name: _Member(each, link_tracks(each.moving)) for each in stations}
        self.placed: dict[str, Choice] = {}
        self.clashes: dict[Names, str] = {}
        self.agreeing: set[Names] = set()
        self.refused: dict[str, str] = {}
        self.unclear: dict[str, str] = {}  # sensors whose vehicles fit at several places, and why

    def seen(self, member: _Member, choice: int, away: Floats) -> Moments:
        """Return a sensor's vehicles, placed by a step from one of its own poses."""
        state, moving = self._state(member, choice, away), member.station.moving
        moving = replace(moving, time=member.clock.corrected(moving.time))
        return read_moments(moving, member.tracks, state, self.lanes)

    def _state(self, member: _Member, choice: int, away: Floats) -> State:
        """Return the state at a step from one of a sensor's own poses, in local coordinates."""
        pose = moved(member.station.poses[choice], away)
        return State(
            position=pose.position - [*self.lanes.origin, 0.0],
            R_map_sensor=pose.R_map_sensor,
            reflection=0.0,
        )

    def choice(self, member: _Member, number: int, away: Floats, covariance: Floats) -> Choice:
        """Return a step from one of a sensor's own poses as a choice, with its covariance."""
        state, on = self._state(member, number, away), member.tracks != NONE
        moving = member.station.moving
        driven = lane_detections(
            self.lanes, member.clock.corrected(moving.time[on]), state.to_map(moving.points[on]),
            moving.range_rate[on], state.position,
        )  # fmt: skip
        return Choice(
            seen=self.seen(member, number, away), driven=driven, covariance=covariance,
            yaw=math.radians(member.station.poses[number].yaw),
        )  # fmt: skip

    def choices(self, member: _Member) -> list[Choice]:
        """Return all poses that a sensor may have by itself."""
        return [
            self.choice(member, i, np.zeros(PLANAR), planar_covariance(pose))
            for i, pose in enumerate(member.station.poses)
        ]

    def place_all(self) -> None:
        """Fix the sensors with a certain pose, compare these, and place the others by them."""
        longest = {
            name: longest_m(planar_covariance(member.pose))
            for name, member in self.all.items()
            if len(member.station.poses) == 1
        }
        firm = sorted(longest, key=lambda name: longest[name])
        fixed = [name for name in firm if longest[name] < FIXED_M] or firm[:1]
        for name in fixed:
            (choice,), _ = self._located(self.all[name])
            for other, at in self.placed.items():
                self._compare_certain(name, choice, other, at)
            self.placed[name] = choice
        waiting = [name for name in dict.fromkeys((*firm, *self.all)) if name not in self.placed]
        while any(self._place(name) for name in waiting if name not in self.placed):
            pass  # a sensor that has just been placed may place another

    def _located(self, member: _Member) -> tuple[list[Choice], Placing]:
        """Place a sensor relative to those that are placed.

        Where its vehicles clearly agree better at another time, its clock is off by that time.
        """
        member.clock, member.free = RIGHT, False
        choices, found = self._among_placed(member)
        clock = next(filter(None, map(self._clock_of, choices)), None)
        if clock is not None:
            member.clock = clock
            then, there = self._among_placed(member)
            # a certain pose explains no wrong rate, which shows little in a short recording
            is_rate = abs(clock.drift_ppm) > 1e6 * ODD_DRIFT and not self._open(member)
            least = -np.inf if is_rate else LAG_CLEAR
            if there.inside is None or preference(there.inside.scores, found.in_time) < least:
                member.clock = RIGHT
            else:
                member.free, choices, found = True, then, there
        if found.inside is not None and found.inside.ahead:
            ahead_s = member.clock.offset_s + found.inside.ahead * MOMENT_S
            member.free, member.clock = True, replace(member.clock, offset_s=ahead_s)
            choices, found = self._among_placed(member)
            if found.inside is not None and found.inside.ahead:  # now another clock fits better
                found = replace(found, clock_z=0.0)
        return choices, found

    def _among_placed(self, member: _Member) -> tuple[list[Choice], Placing]:
        """Return all poses that a sensor may have, and how they agree with the placed sensors.

        Where its place is open and its clock was not measured, places are compared at all offsets
        of the clock.
        """
        choices = self.choices(member)
        reach_s = REACH_S if self._open(member) and member.station.clock_s is None else 0.0
        return choices, find_place(choices, self.placed, reach_s=reach_s)

    def _open(self, member: _Member) -> bool:
        """Return whether a sensor's own answer leaves its place open."""
        poses = member.station.poses
        return len(poses) > 1 or longest_m(planar_covariance(poses[0])) >= FIXED_M

    def _clock_of(self, choice: Choice) -> SensorClock | None:
        """Return a sensor's clock where it clearly differs from those of the placed sensors."""
        for name, other in self.placed.items():
            try:
                offset = measured_offset(other.driven, choice.driven, max_offset_s=MOST_LAG_S)
            except NoAnswerError:
                continue
            clock = adjust_network({(name, ""): offset}, name)[0][""]
            return clock if abs(clock.offset_s) > LEAST_LAG_S or clock.drift_ppm else None
        return None

    def _compare_certain(self, name: str, choice: Choice, other: str, at: Choice) -> None:
        """Record whether two sensors with certain poses agree or contradict each other."""
        found = find_place([choice], {other: at})
        if found.beyond is not None:
            pair = self._pair(other, name)
            self.clashes[pair] = clash_text(pair, found.beyond)
        elif found.inside is not None:
            self.agreeing.add(self._pair(other, name))

    def _pair(self, *names: str) -> Names:
        """Return two sensors in the order in which they were given."""
        one, other = (name for name in self.all if name in names)
        return one, other

    def _place(self, name: str) -> bool:
        """Place a sensor by those that have a place; return whether it could be."""
        member = self.all[name]
        choices, found = self._located(member)
        if found.beyond is not None:
            most = max(found.beyond.pairs.items(), key=lambda pair: pair[1])[0]
            self.clashes[self._pair(most, name)] = clash_text(self._pair(most, name), found.beyond)
            return False
        if found.inside is None or found.doubt is not None:
            self.unclear |= {} if found.doubt is None else {name: found.doubt}
            return False
        member.free |= member.station.clock_s is None  # its place rests on its clock
        member.choice, member.start, member.loose = found.inside.choice, found.inside.step, True
        covariance = choices[member.choice].covariance
        loose = self._loose(covariance)
        self.placed[name] = self.choice(member, member.choice, member.start, loose)
        self.agreeing |= {self._pair(other, name) for other, n in found.inside.pairs.items() if n}
        return True

    def _loose(self, covariance: Floats) -> Floats:
        """Return the covariance of a sensor that the grid search has placed."""
        grid = np.array([STEP_M, STEP_M, GRID_YAW]) ** -2.0
        return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + np.diag(grid)))

    def refuse_clashes(self) -> None:
        """Refuse, of two sensors that contradict each other, the one that fewer others confirm."""
        for (one, other), why in self.clashes.items():
            if self.refused.keys() & {one, other}:
                continue
            mine, theirs = len(self._confirming(one)), len(self._confirming(other))
            if mine <= theirs:
                self.refused[one] = why
            if theirs <= mine:
                self.refused[other] = why
        left = self.placed.keys() - self.refused.keys()
        self.placed = {name: self.placed[name] for name in self.all if name in left}

    def _confirming(self, name: str) -> set[str]:
        """Return all sensors linked with one by pairs that agree, itself included."""
        good = self.agreeing - self.clashes.keys()
        return set(reached(dict.fromkeys(good, 0.0), name))

    def adjusted(self) -> tuple[Adjusted, dict[Names, Correspondences]]:
        """Pair and adjust alternately until neither changes."""
        names = list(self.placed)
        for name in names:
            self.all[name].away = self.all[name].start
        covariances = [planar_covariance(self.all[name].pose) for name in names]
        gates = [self._loose(c) if self.all[n].loose else c
                 for n, c in zip(names, covariances, strict=True)]  # fmt: skip
        within = shared_covariance(gates)
        result = adjust({}, np.zeros((len(names), PLANAR)), covariances)
        correspondences: dict[Names, Correspondences] = {}
        for _ in range(PAIRING_ROUNDS):
            at = {n: self.seen(self.all[n], self.all[n].choice, self.all[n].away) for n in names}
            correspondences = self._correspondences(names, at, within)
            if not correspondences:
                break
            index = {
                (names.index(a), names.index(b)): matched
                for (a, b), matched in correspondences.items()
            }
            held = {(names.index(a), names.index(b)) for a, b in self._held(correspondences)}
            away = np.array([self.all[name].away for name in names])
            clocks = [self._clock_s(self.all[name]) for name in names]
            result = adjust(index, away, covariances, clocks_s=clocks, held=held)
            for name, step in zip(names, result.step, strict=True):
                self.all[name].away = self.all[name].away + step
            within = result.covariance
            if np.abs(result.step).max() < AT_REST:
                break
        return result, correspondences

    def _correspondences(
        self, names: Sequence[str], at: Mapping[str, Moments], covariance: Floats
    ) -> dict[Names, Correspondences]:
        """Pair the tracks of all sensors, each with at most one of another sensor."""
        correspondences = {}
        for j, other in enumerate(names):
            for i, one in enumerate(names[:j]):
                if (one, other) not in self.agreeing:
                    continue
                rows = compare_moments(at[one], at[other])
                if len(rows.tracks) < LEAST_PAIRS:
                    continue
                own = [PLANAR * k + m for k in (i, j) for m in range(PLANAR)]
                rows = self._paired(rows, covariance[np.ix_(own, own)])
                if len(rows.tracks) >= LEAST_PAIRS:
                    correspondences[one, other] = sum_correspondences(rows)
        return correspondences

    def _held(self, correspondences: Mapping[Names, Correspondences]) -> set[Names]:
        """Return the pairs of sensors with too few vehicles to move poses certain by themselves."""
        return {
            pair
            for pair, matched in correspondences.items()
            if len(matched.gap) < FIRM_PAIRS and not any(self.all[name].loose for name in pair)
        }

    def _paired(self, rows: Rows, covariance: Floats) -> Rows:
        gap, known = mean_gaps(rows, covariance)
        chi2 = np.einsum("pi,pij,pj->p", gap, np.linalg.inv(known), gap)
        keep = np.zeros(len(chi2), dtype=bool)
        keep[assign(chi2, rows.tracks, GATE_CHI2)] = True
        return rows.only(keep)

    def misfits(
        self, adjusted: Adjusted, correspondences: Mapping[Names, Correspondences]
    ) -> dict[Names, str]:
        """Return the pairs of sensors whose own poses the correspondences contradict."""
        names, found = list(self.placed), {}
        for (i, j), chi2 in adjusted.misfit.items():
            if chi2 <= CONTRADICTION_CHI2:
                continue
            pair = names[i], names[j]
            own = np.array([self.all[name].away for name in pair])
            matched = correspondences[pair]
            gap = matched.gap - matched.slope[:, :, : 2 * PLANAR] @ own.ravel()
            apart_m = float(np.median(np.hypot(*gap.T)))
            found[pair] = contradiction_text(pair, len(gap), apart_m)
        return found

    def _clock_s(self, member: _Member) -> float:
        """Return the standard deviation of a sensor's clock, seconds."""
        if member.free:
            return FREE_CLOCK_S
        known = member.station.clock_s
        return CLOCK_S if known is None else max(known, CLOCK_S)

    def _clock_gap(self, pair: Names, matched: Correspondences) -> tuple[float, float]:
        """Return how many seconds the second clock is ahead by free clocks, and 1 sigma."""
        away = np.array([self.all[name].away for name in pair])
        known = [planar_covariance(self.all[name].pose) for name in pair]
        free = adjust({(0, 1): matched}, away, known, clocks_s=[FREE_CLOCK_S] * 2)
        return free.clock_gap

    def free_clock(self, correspondences: Mapping[Names, Correspondences]) -> bool:
        """Free the clock that most correspondences show to be off; return whether there was one."""
        off: dict[Names, float] = {}
        for pair, matched in correspondences.items():
            ahead_s, sigma_s = self._clock_gap(pair, matched)
            known_s = [self._clock_s(self.all[name]) for name in pair]
            if abs(ahead_s) > CLOCK_SIGMAS * math.hypot(*known_s, sigma_s):
                off[pair] = ahead_s
        if not off:
            return False
        named = [name for pair in off for name in reversed(pair) if not self.all[name].free]
        if not named:
            return False
        name = max(named, key=named.count)
        pair = next(pair for pair in off if name in pair)
        member, sign = self.all[name], 1.0 if name == pair[1] else -1.0
        ahead_s = member.clock.offset_s + sign * off[pair]
        member.free, member.clock = True, replace(member.clock, offset_s=ahead_s)
        return True

    def clock_remarks(self, correspondences: Mapping[Names, Correspondences]) -> list[str]:
        """Return remarks on clocks farther apart than the correspondences assume."""
        remarks: list[str] = []
        for pair, matched in correspondences.items():
            one, other = (self.all[name] for name in pair)
            if not (one.free or other.free):
                continue
            gap_s, sigma_s = self._clock_gap(pair, matched)
            ahead_s = other.clock.offset_s - one.clock.offset_s + gap_s
            fast = (other.clock.drift_ppm - one.clock.drift_ppm) * 1e-6
            if not fast and abs(ahead_s) < CLOCK_SIGMAS * math.hypot(CLOCK_S, CLOCK_S, sigma_s):
                continue
            how = Text("fast") if fast > 0.0 else Text("slow")
            runs = Text(", and runs {:.1%} {}", abs(fast), how) if fast else ""
            remarks.append(
                Text(
                    "the clock of {} is {:.2f} s {} that of {}{}: the poses allow for it, "
                    "gis-radar clocks measures it",
                    pair[1],
                    abs(ahead_s),
                    Text("ahead of") if ahead_s > 0.0 else Text("behind"),
                    pair[0],
                    runs,
                )
            )
        return remarks

    def unmatched(self, pairs: Mapping[Names, int], held: Mapping[Names, int]) -> dict[str, str]:
        """Return the sensors without correspondences, each with the reason."""
        matched = {name for pair in pairs for name in pair}
        left = [name for name in self.all if name not in matched and name not in self.refused]
        return {name: self._why_unmatched(name, held) for name in left}

    def _why_unmatched(self, name: str, held: Mapping[Names, int]) -> str:
        mine = {pair: number for pair, number in held.items() if name in pair}
        if mine:
            pair = max(mine, key=lambda each: mine[each])
            other, shared = pair[1] if name == pair[0] else pair[0], mine[pair]
            text = "{} vehicles shared with {} confirm its pose, too few to move it"
            return Text(text, shared, other)
        if name in self.unclear and name not in self.placed:
            return self.unclear[name]
        return Text("no other sensor sees enough of the same vehicles")

    def solved(
        self, adjusted: Adjusted, correspondences: Mapping[Names, Correspondences]
    ) -> Solved:
        """Return poses, pairs and refusals."""
        poses = {n: m.pose for n, m in self.all.items() if len(m.station.poses) == 1}
        shared = {pair: len(matched.gap) for pair, matched in correspondences.items()}
        held = {pair: shared[pair] for pair in self._held(correspondences)}
        pairs = {pair: number for pair, number in shared.items() if pair not in held}
        for number, name in enumerate(self.placed):
            own = slice(PLANAR * number, PLANAR * number + PLANAR)
            mine = {pair: n for pair, n in pairs.items() if name in pair}
            if mine:
                member = self.all[name]
                poses[name] = with_gain(
                    moved(member.pose, member.away), adjusted.covariance[own, own], name, mine,
                )  # fmt: skip
        poses = {name: pose for name, pose in poses.items() if name not in self.refused}
        return Solved(
            poses=poses,
            chosen={name: self.all[name].choice for name in poses},
            refused=self.refused,
            pairs=pairs,
            unmatched=self.unmatched(pairs, held),
            remarks=tuple(self.clock_remarks(correspondences)),
        )

"""Network of sensors: correspondences choose, confirm or contradict poses, and adjust them."""

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
    CLOCK_SIGMA_S,
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
    OFFSET_Z,
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
from gis_radar.calibration.single.moving import NO_OFFSET
from gis_radar.calibration.timing.clock_offsets import ODD_DRIFT, measured_offset
from gis_radar.calibration.timing.clocks import SensorClock, adjust_network, sum_offsets
from gis_radar.calibration.timing.lane_detections import lane_detections
from gis_radar.poses import Pose

# Largest and least clock offset that is searched: with larger ones radars have no common time,
# smaller ones are estimated in the adjustment of the poses.
_MOST_OFFSET_S = 10.0
_LEAST_OFFSET_S = 0.25
_CLOCK_SIGMAS = 4.0  # least offset of a clock that is reported, in standard deviations
# Least number of pairs that moves a pose certain by itself: a cluster-robust covariance needs 20 to
# 50 clusters (Cameron, Miller 2015), and few vehicles may all be on one lane.
FIRM_PAIRS = 20
_FIXED_M = 1.0  # largest 1 sigma, in any direction, of a pose that counts as fixed
_PAIRING_ROUNDS = 6  # rounds of pairing and adjustment; two or three are enough
_CONVERGED = 1e-4  # a smaller step ends the adjustment, metres and radians
CLASH_HINT = Text("check both guesses, and the clocks of both sensors: gis-radar clocks")


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Poses of a network of sensors, adjusted by correspondences.

    Parameters
    ----------
    poses : dict of str to Pose
        By sensor; sensors without correspondences keep the pose of single localization.
    chosen : dict of str to int
        By sensor: index of the chosen pose among those of single localization.
    refused : dict of str to str
        By sensor refused because of contradictions: the reason.
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
        The sensors; at least one with a single pose.
    lanes : Lanes
        The map around all of them.
    """
    network = _Network(stations, lanes)
    network.place_all()
    while True:
        network.refuse_clashes()
        adjusted, matched = network.adjust()
        if network.free_clock(matched):
            continue
        contradictions = network.contradictions(adjusted, matched)
        if not contradictions:
            break
        network.clashes |= contradictions
    return network.result(adjusted, matched)


@dataclass
class _Member:
    """A sensor of the network with its assumed pose and clock."""

    station: Station
    tracks: Integers
    choice: int = 0
    start: Floats = field(default_factory=lambda: np.zeros(PLANAR))  # step of the grid search
    away: Floats = field(default_factory=lambda: np.zeros(PLANAR))  # current step
    loose: bool = False  # single localization did not fix the pose: the grid search did
    clock: SensorClock = NO_OFFSET  # its assumed clock
    free: bool = False  # whether its clock, off or not measured, is estimated with the poses

    @property
    def pose(self) -> Pose:
        """The chosen pose of single localization."""
        return self.station.poses[self.choice]

    @property
    def fixed(self) -> bool:
        """Whether single localization fixes the pose."""
        poses = self.station.poses
        return len(poses) == 1 and longest_m(planar_covariance(poses[0])) < _FIXED_M


class _Network:
    """Sensors with their assumed poses, and the pairs that agree or contradict each other."""

    def __init__(self, stations: Sequence[Station], lanes: Lanes) -> None:
        self.lanes = lanes
        self.all = {each.name: _Member(each, link_tracks(each.moving)) for each in stations}
        self.placed: dict[str, Choice] = {}
        self.clashes: dict[Names, str] = {}
        self.agreeing: set[Names] = set()
        self.refused: dict[str, str] = {}
        self.unclear: dict[str, str] = {}  # ambiguous sensors, with the reason

    def seen(self, member: _Member, choice: int, away: Floats) -> Moments:
        """Return a sensor's vehicles, placed by a step `away` from one of its poses."""
        state, moving = self._state(member, choice, away), member.station.moving
        moving = replace(moving, time=member.clock.corrected(moving.time))
        return read_moments(moving, member.tracks, state, self.lanes)

    def _state(self, member: _Member, choice: int, away: Floats) -> State:
        """Return the state at a step `away` from one of a sensor's poses, local coordinates."""
        pose = moved(member.station.poses[choice], away)
        return State(
            position=pose.position - [*self.lanes.origin, 0.0],
            R_map_sensor=pose.R_map_sensor,
            reflection=0.0,
        )

    def choice(self, member: _Member, number: int, away: Floats, covariance: Floats) -> Choice:
        """Return the choice at a step `away` from one of a sensor's poses."""
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
        """Return the poses of a sensor's single localization as choices."""
        return [
            self.choice(member, i, np.zeros(PLANAR), planar_covariance(pose))
            for i, pose in enumerate(member.station.poses)
        ]

    def place_all(self) -> None:
        """Place the sensors with a fixed pose, compare these, and place the others by them."""
        longest = {
            name: longest_m(planar_covariance(member.pose))
            for name, member in self.all.items()
            if len(member.station.poses) == 1
        }
        firm = sorted(longest, key=lambda name: longest[name])
        fixed = [name for name in firm if longest[name] < _FIXED_M] or firm[:1]
        for name in fixed:
            (choice,), _ = self._locate(self.all[name])
            for other, at in self.placed.items():
                self._compare_certain(name, choice, other, at)
            self.placed[name] = choice
        waiting = [name for name in dict.fromkeys((*firm, *self.all)) if name not in self.placed]
        while any(self._place(name) for name in waiting if name not in self.placed):
            pass  # each new one may place others

    def _locate(self, member: _Member) -> tuple[list[Choice], Placing]:
        """Return a sensor's choices and its placing by the placed sensors, after its clock is set.

        An offset needs a z score of `OFFSET_Z`, a wrong rate of a fixed pose one over minus that.
        """
        member.clock, member.free = NO_OFFSET, False
        choices, placing = self._compare_with_placed(member)
        clock = next(filter(None, map(self._measured_clock, choices)), None)
        if clock is not None:
            member.clock = clock
            shifted_choices, shifted = self._compare_with_placed(member)
            # a fixed pose explains no wrong rate, which shows little in a short recording
            is_rate = abs(clock.drift_ppm) > 1e6 * ODD_DRIFT and member.fixed
            least, now = -OFFSET_Z if is_rate else OFFSET_Z, placing.scores_in_time
            if shifted.inside is not None and preference(shifted.inside.scores, now) >= least:
                member.free, choices, placing = True, shifted_choices, shifted
            else:
                member.clock = NO_OFFSET
        if placing.inside is not None and placing.inside.ahead:
            ahead_s = member.clock.offset_s + placing.inside.ahead * MOMENT_S
            member.free, member.clock = True, replace(member.clock, offset_s=ahead_s)
            choices, placing = self._compare_with_placed(member)
            if placing.inside is not None and placing.inside.ahead:  # now another clock fits better
                placing = replace(placing, clock_z=0.0)
        return choices, placing

    def _compare_with_placed(self, member: _Member) -> tuple[list[Choice], Placing]:
        """Return a sensor's choices and its placing by the placed sensors.

        All clock offsets are tried where its pose is not fixed and its clock was not measured.
        """
        choices = self.choices(member)
        reach_s = 0.0 if member.fixed or member.station.clock_s is not None else REACH_S
        return choices, find_place(choices, self.placed, reach_s=reach_s)

    def _measured_clock(self, choice: Choice) -> SensorClock | None:
        """Return a sensor's clock measured against a placed one; None where it does not differ."""
        for name, other in self.placed.items():
            try:
                offset = measured_offset(other.driven, choice.driven, max_offset_s=_MOST_OFFSET_S)
            except NoAnswerError:
                continue
            clock = adjust_network({(name, ""): offset}, name)[0][""]
            return clock if abs(clock.offset_s) > _LEAST_OFFSET_S or clock.drift_ppm else None
        return None

    def _compare_certain(self, name: str, choice: Choice, other: str, at: Choice) -> None:
        """Record whether two sensors with fixed poses agree or contradict each other."""
        placing = find_place([choice], {other: at})
        if placing.beyond is not None:
            pair = self._pair(other, name)
            self.clashes[pair] = clash_text(pair, placing.beyond)
        elif placing.inside is not None:
            self.agreeing.add(self._pair(other, name))

    def _pair(self, *names: str) -> Names:
        """Return two sensors in the order of the stations."""
        one, other = (name for name in self.all if name in names)
        return one, other

    def _place(self, name: str) -> bool:
        """Place a sensor by the placed ones; return whether this succeeded."""
        member = self.all[name]
        choices, placing = self._locate(member)
        if placing.beyond is not None:
            contradicted = max(placing.beyond.pairs.items(), key=lambda pair: pair[1])[0]
            pair = self._pair(contradicted, name)
            self.clashes[pair] = clash_text(pair, placing.beyond)
            return False
        if placing.inside is None or placing.doubt is not None:
            self.unclear |= {} if placing.doubt is None else {name: placing.doubt}
            return False
        member.free |= member.station.clock_s is None  # its place depends on its clock
        member.choice, member.start, member.loose = placing.inside.choice, placing.inside.step, True
        covariance = self._grid_covariance(choices[member.choice].covariance)
        self.placed[name] = self.choice(member, member.choice, member.start, covariance)
        self.agreeing |= {self._pair(other, name) for other, n in placing.inside.pairs.items() if n}
        return True

    def _grid_covariance(self, covariance: Floats) -> Floats:
        """Return the covariance of a sensor after the grid search."""
        grid = np.array([STEP_M, STEP_M, GRID_YAW]) ** -2.0
        return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + np.diag(grid)))

    def refuse_clashes(self) -> None:
        """Refuse of two contradicting sensors the one with fewer agreeing sensors, or both."""
        for (one, other), why in self.clashes.items():
            if self.refused.keys() & {one, other}:
                continue
            of_one, of_other = len(self._confirmed_group(one)), len(self._confirmed_group(other))
            if of_one <= of_other:
                self.refused[one] = why
            if of_other <= of_one:
                self.refused[other] = why
        remaining = self.placed.keys() - self.refused.keys()
        self.placed = {name: self.placed[name] for name in self.all if name in remaining}

    def _confirmed_group(self, name: str) -> set[str]:
        """Return the sensors linked with one by agreeing pairs, itself included."""
        agreeing = self.agreeing - self.clashes.keys()
        return set(sum_offsets(dict.fromkeys(agreeing, 0.0), name))

    def adjust(self) -> tuple[Adjusted, dict[Names, Correspondences]]:
        """Pair tracks and adjust poses in turn until they converge; set `away` of all sensors."""
        names = list(self.placed)
        for name in names:
            self.all[name].away = self.all[name].start
        covariances = [planar_covariance(self.all[name].pose) for name in names]
        gates = [self._grid_covariance(c) if self.all[n].loose else c
                 for n, c in zip(names, covariances, strict=True)]  # fmt: skip
        gate = shared_covariance(gates)
        result = adjust({}, np.zeros((len(names), PLANAR)), covariances)
        correspondences: dict[Names, Correspondences] = {}
        for _ in range(_PAIRING_ROUNDS):
            seen = {n: self.seen(self.all[n], self.all[n].choice, self.all[n].away) for n in names}
            correspondences = self._correspondences(names, seen, gate)
            if not correspondences:
                break
            edges = {pair: (names.index(pair[0]), names.index(pair[1])) for pair in correspondences}
            index = {edges[pair]: matched for pair, matched in correspondences.items()}
            unused = {edges[pair] for pair in self._comparison_only(correspondences)}
            away = np.array([self.all[name].away for name in names])
            clocks = [self._clock_sigma_s(self.all[name]) for name in names]
            result = adjust(index, away, covariances, clocks_s=clocks, comparison_only=unused)
            for name, step in zip(names, result.step, strict=True):
                self.all[name].away = self.all[name].away + step
            gate = result.covariance
            if np.abs(result.step).max() < _CONVERGED:
                break
        return result, correspondences

    def _correspondences(
        self, names: Sequence[str], moments: Mapping[str, Moments], covariance: Floats
    ) -> dict[Names, Correspondences]:
        """Return the correspondences of all agreeing pairs of sensors."""
        correspondences = {}
        for j, other in enumerate(names):
            for i, one in enumerate(names[:j]):
                if (one, other) not in self.agreeing:
                    continue
                rows = compare_moments(moments[one], moments[other])
                if len(rows.tracks) < LEAST_PAIRS:
                    continue
                unknowns = [PLANAR * k + m for k in (i, j) for m in range(PLANAR)]
                rows = self._keep_assigned(rows, covariance[np.ix_(unknowns, unknowns)])
                if len(rows.tracks) >= LEAST_PAIRS:
                    correspondences[one, other] = sum_correspondences(rows)
        return correspondences

    def _comparison_only(self, correspondences: Mapping[Names, Correspondences]) -> set[Names]:
        """Return the pairs of sensors whose poses are fixed and whose vehicles are too few."""
        return {
            pair
            for pair, matched in correspondences.items()
            if len(matched.gap) < FIRM_PAIRS and not any(self.all[name].loose for name in pair)
        }

    def _keep_assigned(self, rows: Rows, covariance: Floats) -> Rows:
        """Return the rows of the optimal assignment of tracks."""
        gap, covariances = mean_gaps(rows, covariance)
        chi2 = np.einsum("pi,pij,pj->p", gap, np.linalg.inv(covariances), gap)
        assigned = np.zeros(len(chi2), dtype=bool)
        assigned[assign(chi2, rows.tracks, GATE_CHI2)] = True
        return rows.only(assigned)

    def contradictions(
        self, adjusted: Adjusted, correspondences: Mapping[Names, Correspondences]
    ) -> dict[Names, str]:
        """Return the pairs of sensors whose poses contradict their correspondences, with texts."""
        names, texts = list(self.placed), {}
        for (i, j), chi2 in adjusted.misfit.items():
            if chi2 <= CONTRADICTION_CHI2:
                continue
            pair = names[i], names[j]
            steps = np.array([self.all[name].away for name in pair])
            matched = correspondences[pair]
            gap = matched.gap - matched.slope[:, :, : 2 * PLANAR] @ steps.ravel()
            apart_m = float(np.median(np.hypot(*gap.T)))
            texts[pair] = contradiction_text(pair, len(gap), apart_m)
        return texts

    def _clock_sigma_s(self, member: _Member) -> float:
        """Return the prior standard deviation of a sensor's clock, seconds."""
        if member.free:
            return FREE_CLOCK_S
        measured_s = member.station.clock_s
        return CLOCK_SIGMA_S if measured_s is None else max(measured_s, CLOCK_SIGMA_S)

    def _clock_gap(self, pair: Names, matched: Correspondences) -> tuple[float, float]:
        """Return the offset of the second clock less the first, and 1 sigma, seconds."""
        away = np.array([self.all[name].away for name in pair])
        covariances = [planar_covariance(self.all[name].pose) for name in pair]
        adjusted = adjust({(0, 1): matched}, away, covariances, clocks_s=[FREE_CLOCK_S] * 2)
        return adjusted.clock_gap

    def free_clock(self, correspondences: Mapping[Names, Correspondences]) -> bool:
        """Free the clock that most pairs of sensors show to be off; return whether there is one."""
        offsets: dict[Names, float] = {}
        for pair, matched in correspondences.items():
            ahead_s, sigma_s = self._clock_gap(pair, matched)
            sigmas_s = [self._clock_sigma_s(self.all[name]) for name in pair]
            if abs(ahead_s) > _CLOCK_SIGMAS * math.hypot(*sigmas_s, sigma_s):
                offsets[pair] = ahead_s
        named = [name for pair in offsets for name in reversed(pair) if not self.all[name].free]
        if not named:
            return False
        name = max(named, key=named.count)
        pair = next(pair for pair in offsets if name in pair)
        member, sign = self.all[name], 1.0 if name == pair[1] else -1.0
        ahead_s = member.clock.offset_s + sign * offsets[pair]
        member.free, member.clock = True, replace(member.clock, offset_s=ahead_s)
        return True

    def clock_remarks(self, correspondences: Mapping[Names, Correspondences]) -> list[str]:
        """Return remarks on free clocks that are off by more than `_CLOCK_SIGMAS`, or drift."""
        remarks: list[str] = []
        for pair, matched in correspondences.items():
            one, other = (self.all[name] for name in pair)
            if not (one.free or other.free):
                continue
            gap_s, sigma_s = self._clock_gap(pair, matched)
            ahead_s = other.clock.offset_s - one.clock.offset_s + gap_s
            rate = (other.clock.drift_ppm - one.clock.drift_ppm) * 1e-6
            least_s = _CLOCK_SIGMAS * math.hypot(CLOCK_SIGMA_S, CLOCK_SIGMA_S, sigma_s)
            if not rate and abs(ahead_s) < least_s:
                continue
            faster = Text("fast") if rate > 0.0 else Text("slow")
            rate_text = Text(", and runs {:.1%} {}", abs(rate), faster) if rate else ""
            remarks.append(
                Text(
                    "the clock of {} is {:.2f} s {} that of {}{}: the poses allow for it, "
                    "gis-radar clocks measures it",
                    pair[1],
                    abs(ahead_s),
                    Text("ahead of") if ahead_s > 0.0 else Text("behind"),
                    pair[0],
                    rate_text,
                )
            )
        return remarks

    def unmatched(self, pairs: Mapping[Names, int], others: Mapping[Names, int]) -> dict[str, str]:
        """Return the sensors not in `pairs`, each with the reason; `others` only compare."""
        known = {name for pair in pairs for name in pair} | self.refused.keys()
        return {name: self._why_unmatched(name, others) for name in self.all if name not in known}

    def _why_unmatched(self, name: str, compared: Mapping[Names, int]) -> str:
        own = {pair: number for pair, number in compared.items() if name in pair}
        if own:
            pair = max(own, key=lambda each: own[each])
            other, shared = pair[1] if name == pair[0] else pair[0], own[pair]
            text = "{} vehicles shared with {} confirm its pose, too few to move it"
            return Text(text, shared, other)
        if name in self.unclear and name not in self.placed:
            return self.unclear[name]
        return Text("no other sensor sees enough of the same vehicles")

    def result(
        self, adjusted: Adjusted, correspondences: Mapping[Names, Correspondences]
    ) -> Solved:
        """Return poses with their new covariance, pairs, refusals and remarks."""
        poses = {n: m.pose for n, m in self.all.items() if len(m.station.poses) == 1}
        shared = {pair: len(matched.gap) for pair, matched in correspondences.items()}
        compared = {pair: shared[pair] for pair in self._comparison_only(correspondences)}
        pairs = {pair: number for pair, number in shared.items() if pair not in compared}
        for number, name in enumerate(self.placed):
            own = slice(PLANAR * number, PLANAR * number + PLANAR)
            of_sensor = {pair: n for pair, n in pairs.items() if name in pair}
            if of_sensor:
                member = self.all[name]
                poses[name] = with_gain(
                    moved(member.pose, member.away), adjusted.covariance[own, own], name, of_sensor,
                )  # fmt: skip
        poses = {name: pose for name, pose in poses.items() if name not in self.refused}
        return Solved(
            poses=poses,
            chosen={name: self.all[name].choice for name in poses},
            refused=self.refused,
            pairs=pairs,
            unmatched=self.unmatched(pairs, compared),
            remarks=tuple(self.clock_remarks(correspondences)),
        )

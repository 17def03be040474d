"""A network of sensors: which poses the ties confirm, contradict or choose, and the adjustment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gis_radar.arrays import Floats, Integers
from gis_radar.errors import NoAnswerError
from gis_radar.localization.certainty import PLANE as IN_POSE
from gis_radar.localization.certainty import is_fixed
from gis_radar.localization.lanes import Lanes
from gis_radar.localization.settings import DEFAULTS, AnswerSettings, LocalizationSettings
from gis_radar.localization.state import State
from gis_radar.localization.traces import Moving, link_tracks
from gis_radar.network.adjustment import (
    Adjusted,
    Tied,
    adjust,
    clock_gap,
    shared_covariance,
    tie,
)
from gis_radar.network.placing import GRID_YAW, Choice, Shift, find_place
from gis_radar.network.settings import TIES, TieSettings
from gis_radar.network.ties import (
    PLANE,
    Moments,
    Rows,
    assign,
    compare,
    mean_gaps,
    read_moments,
)
from gis_radar.poses.pose import COMPONENTS, Pose

AT_REST = 1e-4  # a step of the adjustment, metres and radians
Names = tuple[str, str]
CLASH_HINT = "check both guesses, and the clocks of both sensors: gis-radar clocks"


@dataclass(frozen=True, kw_only=True)
class Station:
    """A sensor of a network.

    Parameters
    ----------
    name : str
        Of the sensor.
    moving : Moving
        What it saw while the others recorded, too.
    poses : tuple of Pose
        The poses that it may have by itself: its answer, or several that it cannot tell apart.
    """

    name: str
    moving: Moving
    poses: tuple[Pose, ...]


@dataclass(frozen=True, kw_only=True)
class Solved:
    """What a network says.

    Parameters
    ----------
    poses : dict of str to Pose
        By sensor; those that nothing ties are as they were.
    chosen : dict of str to int
        Which of the poses that it may have by itself it was.
    refused : dict of str to str
        Sensors without a trustworthy pose, and why, where that is the network's finding.
    pairs : dict
        How many vehicles tie two sensors, by their names.
    remarks : tuple of str
        What the user should know.
    """

    poses: dict[str, Pose]
    chosen: dict[str, int]
    refused: dict[str, str]
    pairs: dict[Names, int]
    remarks: tuple[str, ...] = ()


def solve_network(
    stations: Sequence[Station],
    lanes: Lanes,
    settings: LocalizationSettings = DEFAULTS,
    ties: TieSettings = TIES,
) -> Solved:
    """Adjust the poses of several sensors by the vehicles that they see at the same time.

    Parameters
    ----------
    stations : sequence of Station
        The sensors; those with one pose tie, those with several are tied.
    lanes : Lanes
        The map around all of them.
    settings, ties : LocalizationSettings, TieSettings
        Of tracks and ties.

    Raises
    ------
    NoAnswerError
        If the poses contradict each other so that none can be trusted.
    """
    network = _Network(stations, lanes, settings, ties)
    network.place_all()
    while True:
        network.refuse_clashes()
        adjusted, tied = network.adjusted()
        found = network.misfits(adjusted, tied)
        if not found:
            break
        network.clashes |= found
    return network.solved(adjusted, tied)


@dataclass
class _Member:
    """A sensor on its way to a pose."""

    station: Station
    tracks: Integers
    choice: int = 0
    start: Floats = field(default_factory=lambda: np.zeros(PLANE))  # from its own answer
    away: Floats = field(default_factory=lambda: np.zeros(PLANE))
    loose: bool = False  # its own answer was no place: ties have chosen the start

    @property
    def pose(self) -> Pose:
        return self.station.poses[self.choice]


class _Network:
    """The sensors with their places, what agrees and what contradicts."""

    def __init__(
        self, stations: Sequence[Station], lanes: Lanes, settings: LocalizationSettings,
        ties: TieSettings,
    ) -> None:  # fmt: skip
        self.lanes, self.settings, self.answer = lanes, ties, settings.answer
        self.all = {
            each.name: _Member(each, link_tracks(each.moving, settings.traces)) for each in stations
        }
        self.placed: dict[str, Choice] = {}
        self.clashes: dict[Names, str] = {}
        self.agreeing: set[Names] = set()
        self.refused: dict[str, str] = {}

    def seen(self, member: _Member, choice: int, away: Floats) -> Moments:
        """Return a sensor's vehicles at a step from one of its own poses."""
        pose = moved(member.station.poses[choice], away)
        state = State(
            position=pose.position - [*self.lanes.origin, 0.0],
            R_map_sensor=pose.R_map_sensor,
            reflection=0.0,
        )
        return read_moments(
            member.station.moving, member.tracks, state, self.lanes, self.settings
        )  # fmt: skip

    def choices(self, member: _Member) -> list[Choice]:
        """Return all poses that a sensor may have by itself."""
        return [
            Choice(
                seen=self.seen(member, i, np.zeros(PLANE)),
                covariance=plane_covariance(pose),
                yaw=math.radians(pose.yaw),
            )
            for i, pose in enumerate(member.station.poses)
        ]

    def place_all(self) -> None:
        """Take the sensors that stand fast, hold them against each other, and place the rest."""
        longest = {
            name: float(_longest(plane_covariance(member.pose)))
            for name, member in self.all.items()
            if len(member.station.poses) == 1
        }
        firm = sorted(longest, key=lambda name: longest[name])
        fixed = [name for name in firm if longest[name] < self.settings.fixed_m] or firm[:1]
        for name in fixed:
            (choice,) = self.choices(self.all[name])
            for other, at in self.placed.items():
                self._hold_against(name, choice, other, at)
            self.placed[name] = choice
        waiting = [name for name in dict.fromkeys((*firm, *self.all)) if name not in self.placed]
        while any(self._place(name) for name in waiting if name not in self.placed):
            pass  # who has just been placed may place another

    def _hold_against(self, name: str, choice: Choice, other: str, at: Choice) -> None:
        """Note whether two sensors that stand fast agree, or contradict each other."""
        found = find_place([choice], {other: at}, self.settings)
        if found.beyond is not None:
            self.clashes[self._pair(other, name)] = _clash(self._pair(other, name), found.beyond)
        elif found.inside is not None:
            self.agreeing.add(self._pair(other, name))

    def _pair(self, *names: str) -> Names:
        """Return two sensors in the order in which they were given."""
        one, other = (name for name in self.all if name in names)
        return one, other

    def _place(self, name: str) -> bool:
        """Place a sensor by those that have a place; return whether it could be."""
        member, choices = self.all[name], self.choices(self.all[name])
        found = find_place(choices, self.placed, self.settings)
        if found.beyond is not None:
            most = max(found.beyond.pairs.items(), key=lambda pair: pair[1])[0]
            self.clashes[self._pair(most, name)] = _clash(self._pair(most, name), found.beyond)
            return False
        if found.inside is None or found.lead < self.settings.clear:
            return False
        member.choice, member.start, member.loose = found.inside.choice, found.inside.step, True
        covariance = choices[member.choice].covariance
        seen = self.seen(member, member.choice, member.start)
        self.placed[name] = Choice(seen=seen, covariance=self._loose(covariance))
        self.agreeing |= {self._pair(other, name) for other, n in found.inside.pairs.items() if n}
        return True

    def _loose(self, covariance: Floats) -> Floats:
        """Return the covariance of a sensor that the grid has placed."""
        grid = np.array([self.settings.step_m, self.settings.step_m, GRID_YAW]) ** -2.0
        return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + np.diag(grid)))

    def refuse_clashes(self) -> None:
        """Refuse of sensors that contradict each other those that fewer others confirm."""
        for (one, other), why in self.clashes.items():
            if self.refused.keys() & {one, other}:
                continue
            mine, theirs = len(self._friends(one)), len(self._friends(other))
            if mine <= theirs:
                self.refused[one] = why
            if theirs <= mine:
                self.refused[other] = why
        left = self.placed.keys() - self.refused.keys()
        self.placed = {name: self.placed[name] for name in self.all if name in left}
        if not self.placed:
            raise NoAnswerError(next(iter(self.clashes.values())), hint=CLASH_HINT)

    def _friends(self, name: str) -> set[str]:
        """Return the sensors that agree with one, or with one that does, itself included."""
        good = self.agreeing - self.clashes.keys()
        known, fresh = {name}, {name}
        while fresh:
            fresh = {b for pair in good for a, b in (pair, pair[::-1]) if a in fresh} - known
            known |= fresh
        return known

    def adjusted(self) -> tuple[Adjusted, dict[Names, Tied]]:
        """Pair and adjust in turn until neither changes."""
        names = list(self.placed)
        for name in names:
            self.all[name].away = self.all[name].start
        covariances = [plane_covariance(self.all[name].pose) for name in names]
        gates = [self._loose(c) if self.all[n].loose else c
                 for n, c in zip(names, covariances, strict=True)]  # fmt: skip
        within = shared_covariance(gates)
        result = Adjusted(
            step=np.zeros((len(names), PLANE)), covariance=shared_covariance(covariances), misfit={}
        )
        ties: dict[Names, Tied] = {}
        for _ in range(self.settings.rounds):
            at = {n: self.seen(self.all[n], self.all[n].choice, self.all[n].away) for n in names}
            ties = self._ties(names, at, within)
            if not ties:
                break
            index = {(names.index(a), names.index(b)): tied for (a, b), tied in ties.items()}
            away = np.array([self.all[name].away for name in names])
            result = adjust(index, away, covariances, self.settings)
            for name, step in zip(names, result.step, strict=True):
                self.all[name].away = self.all[name].away + step
            within = result.covariance
            if np.abs(result.step).max() < AT_REST:
                break
        return result, ties

    def _ties(
        self, names: Sequence[str], at: Mapping[str, Moments], covariance: Floats
    ) -> dict[Names, Tied]:
        """Pair the tracks of all sensors, each with at most one of another sensor."""
        ties = {}
        for j, other in enumerate(names):
            for i, one in enumerate(names[:j]):
                if (one, other) not in self.agreeing:
                    continue
                rows = compare(at[one], at[other], self.settings)
                if len(rows.tracks) < self.settings.least_pairs:
                    continue
                own = [*range(PLANE * i, PLANE * i + PLANE), *range(PLANE * j, PLANE * j + PLANE)]
                rows = self._paired(rows, covariance[np.ix_(own, own)])
                if len(rows.tracks) >= self.settings.least_pairs:
                    ties[one, other] = tie(rows, self.settings)
        return ties

    def _paired(self, rows: Rows, covariance: Floats) -> Rows:
        gap, known = mean_gaps(rows, covariance, self.settings)
        chi2 = np.einsum("pi,pij,pj->p", gap, np.linalg.inv(known), gap)
        keep = np.zeros(len(chi2), dtype=bool)
        keep[assign(chi2, rows.tracks, self.settings.gate_chi2)] = True
        return rows.only(keep)

    def misfits(self, adjusted: Adjusted, ties: Mapping[Names, Tied]) -> dict[Names, str]:
        """Return the pairs of sensors whose own poses the ties contradict."""
        names, found = list(self.placed), {}
        for (i, j), chi2 in adjusted.misfit.items():
            if chi2 <= self.settings.contradiction_chi2:
                continue
            pair = names[i], names[j]
            own = np.array([self.all[name].away for name in pair])
            tied = ties[pair]
            gap = tied.gap - tied.slope[:, :, : 2 * PLANE] @ own.ravel()
            apart_m = float(np.median(np.hypot(*gap.T)))
            found[pair] = _contradiction(pair, len(gap), apart_m)
        return found

    def clock_remarks(self, ties: Mapping[Names, Tied]) -> list[str]:
        """Return which clocks are apart by more than the ties take for granted."""
        remarks, most = [], self.settings.clock_s * math.sqrt(2.0)
        for pair, tied in ties.items():
            away = np.array([self.all[name].away for name in pair])
            known = [plane_covariance(self.all[name].pose) for name in pair]
            ahead_s, sigma_s = clock_gap(tied, away, known, self.settings)
            if abs(ahead_s) > self.settings.clock_sigmas * math.hypot(most, sigma_s):
                remarks.append(
                    f"the clock of {pair[1]} is {abs(ahead_s):.2f} s "
                    f"{'ahead of' if ahead_s > 0.0 else 'behind'} that of {pair[0]}: "
                    "gis-radar clocks measures it"
                )
        return remarks

    def solved(self, adjusted: Adjusted, ties: Mapping[Names, Tied]) -> Solved:
        """Return poses, pairs and refusals."""
        poses = {n: m.pose for n, m in self.all.items() if len(m.station.poses) == 1}
        pairs = {pair: len(tied.gap) for pair, tied in ties.items()}
        for number, name in enumerate(self.placed):
            own = slice(PLANE * number, PLANE * number + PLANE)
            mine = {pair: n for pair, n in pairs.items() if name in pair}
            if mine:
                member = self.all[name]
                poses[name] = _with_gain(
                    moved(member.pose, member.away), adjusted.covariance[own, own], name, mine,
                    self.answer,
                )  # fmt: skip
        poses = {name: pose for name, pose in poses.items() if name not in self.refused}
        return Solved(
            poses=poses,
            chosen={name: self.all[name].choice for name in poses},
            refused=self.refused,
            pairs=pairs,
            remarks=tuple(self.clock_remarks(ties)),
        )


def _contradiction(names: Names, vehicles: int, gap_m: float) -> str:
    return (
        f"{names[0]} and {names[1]}: their poses contradict each other: {vehicles} vehicles "
        f"that both see lie {gap_m:.1f} m apart"
    )


def _clash(names: Names, shift: Shift) -> str:
    return _contradiction(names, sum(shift.pairs.values()), float(np.hypot(*shift.step[:2])))


def plane_covariance(pose: Pose) -> Floats:
    """Return the covariance of easting, northing (m) and yaw (radians), (3, 3)."""
    return stated_covariance(pose)[np.ix_(IN_POSE, IN_POSE)]


def stated_covariance(pose: Pose) -> Floats:
    """Return the (6, 6) covariance that a pose states.

    Raises
    ------
    NoAnswerError
        If it states none.
    """
    covariance = pose.parsed_evidence().covariance
    if covariance is None:
        raise NoAnswerError(
            f"{pose.sensor}: its pose states no covariance", hint="localize it with --method lane"
        )
    return covariance


def _longest(covariance: Floats) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


def moved(pose: Pose, step: Floats) -> Pose:
    """Return a pose after a step of easting, northing, yaw; the rest follows its covariance."""
    covariance = stated_covariance(pose)
    known = covariance[np.ix_(IN_POSE, IN_POSE)]
    whole = covariance[:, IN_POSE] @ np.linalg.solve(known, step)
    whole[IN_POSE] = step
    east, north, up, roll, pitch, yaw = (float(v) for v in whole)
    turned = pose.yaw + math.degrees(yaw)
    return replace(
        pose,
        easting=pose.easting + east,
        northing=pose.northing + north,
        height=pose.height + up,
        roll=pose.roll + math.degrees(roll),
        pitch=pose.pitch + math.degrees(pitch),
        yaw=(turned + 180.0) % 360.0 - 180.0,
    )


def _with_gain(
    pose: Pose, plane: Floats, name: str, pairs: Mapping[Names, int], settings: AnswerSettings
) -> Pose:
    """Return a pose with its new covariance, and what it gained by whom."""
    before = stated_covariance(pose)
    known = before[np.ix_(IN_POSE, IN_POSE)]
    share = before[:, IN_POSE] @ np.linalg.inv(known)
    after = before + share @ (plane - known) @ share.T
    after = (after + after.T) / 2.0
    units = np.array([1.0] * 3 + [math.degrees(1.0)] * 3)
    old, new = (np.sqrt(np.diag(each)) * units for each in (before, after))
    others = sorted({each for pair in pairs for each in pair} - {name})
    gained = {COMPONENTS[i]: {"before": float(old[i]), "after": float(new[i])} for i in IN_POSE}
    evidence = {
        **pose.evidence,
        "sigma": {each: float(value) for each, value in zip(COMPONENTS, new, strict=True)},
        "covariance": after.tolist(),
        "observable": is_fixed(after, settings),
        "together": {"sensors": others, "pairs": sum(pairs.values()), "gained": gained},
    }
    return replace(pose, evidence=evidence)

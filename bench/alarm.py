"""The alarm of `track`: how often it is false, and whether it notices a small move in ten minutes.

Minutes of the sample junction are simulated detection by detection, with radars and drivers as
recorded, walkers and cyclists.

- Moved: the sensor is moved by 0.3 m in eight directions or turned by half a degree, at the begin
  of each batch of ten minutes after the first three. Counted is how often that is noticed.
- At rest: whole days are drawn from those minutes (`alarm_hours.py`) with what changes in a day.
  The rate of false alarms comes from a generalised Pareto distribution, fitted to the largest
  scores of half an hour.

Example: ``python bench/alarm.py --into docs/limits.md`` puts the tables between the page's marks.
"""

from __future__ import annotations

import argparse
import copy
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pages
from alarm_hours import CHANGING, DrawnHours, Minute, fit_false_alarms
from figures import ROOT, SHARE_CHANCE, TARGET, Figure, report, table
from scipy.spatial.transform import Rotation

from gis_radar.base import Floats
from gis_radar.calibration.monitoring.stationary_targets import (
    BLOCK_S,
    LEAST_MOVE_SCORE,
    SEARCH_BLOCKS,
    StationaryTargets,
)
from gis_radar.calibration.registration.state import State
from simulation.demand import ALL_KINDS, Flow
from simulation.driving import DrivenRoads, LaneKeeping
from simulation.network import RoadNetwork, build_network, read_network
from simulation.people import simulate_people
from simulation.presets import DRIVERS_AS_RECORDED, RADARS
from simulation.radar import place_radar
from simulation.recording import frame_times, simulate_recording
from simulation.roadside import furnish
from simulation.traffic import simulate_traffic

sys.path.insert(0, str(ROOT / "sample_maps"))
import make_samples
import street_plan

OUT = ROOT / "out" / "bench-alarm"
MINUTES = 10  # of a batch, which is simulated at once
STREETS_SEED = 77  # of where drivers keep in each lane: the same in all batches
FIRST_MOVED = 3  # batches before the first move, in which targets are learned

TRAFFIC = {"ordinary": "2600 vehicles an hour", "light": "650 vehicles an hour"}
SIZES = {
    "0.3": "0.3 m, any direction",
    "yaw": "yaw by 0.5 degrees",
    "tilt": "pitch or roll by 0.5 degrees",
}
# By kind of move: the trials, and how many of them were noticed in ten minutes.
Noticed = dict[str, tuple[int, int]]
# Largest score of each minute, as a share of the gate: over 1 is an alarm.
Scores = list[float]


class SameStreets(LaneKeeping):
    """Lane keeping as recorded; where all drivers keep does not depend on the traffic's seed."""

    def on(self, network: RoadNetwork, *, seed: int) -> DrivenRoads:
        """Return the roads with where drivers keep, drawn from `STREETS_SEED`."""
        del seed
        return super().on(network, seed=STREETS_SEED)


def main() -> None:
    """Simulate, measure, print and keep the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ordinary", type=int, default=5, help="batches of ten minutes")
    parser.add_argument("--light", type=int, default=4, help="batches with a quarter of it")
    parser.add_argument("--days", type=int, default=5, help="of each sensor")
    parser.add_argument("--seed", type=int, default=2, help="of the days; the gate was set with 1")
    parser.add_argument("--into", type=Path, metavar="MD", help="put the tables into this page")
    arguments = parser.parse_args()
    moved: dict[str, Noticed] = {}
    days: list[Scores] = []
    for name, first, share, masts in (("ordinary", 0, 1.0, (0, 1)), ("light", 100, 0.25, (0,))):
        for mast in masts:
            numbers = range(first, first + getattr(arguments, name))
            made = [_batch(name, number, share, mast) for number in numbers]
            sensor = Sensor.of(mast)
            print(f"{name}, {sensor.name}: {len(made) * MINUTES} minutes", flush=True)
            _add(moved.setdefault(name, {}), noticed(sensor, made))
            if name == "ordinary":
                days += rest(sensor, made, arguments.days, arguments.seed)
    tail = fit_false_alarms(days)
    text = "\n\n".join([_noticed_table(moved), _false_table(tail)])
    print(text)
    if arguments.into is not None:
        pages.put(arguments.into, {"alarm": text})
    what = "false alarms of a sensor at rest, a month, 95 % below"
    most = tail.get("monthly_95", (0.0, 0.0))[1]
    report("alarm", [Figure(what=what, ours=most, peer=1.0, peer_name=TARGET, chance=SHARE_CHANCE,
                            least=0.1)])  # fmt: skip


def _batch(name: str, number: int, share: float, mast: int) -> Path:
    """Return the file with the detections of a batch, which is simulated where it is missing."""
    sensor = make_samples.MASTS[mast].sensor
    path = OUT / name / f"{sensor}_{number:03d}_all.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        begin = time.process_time()
        site = _site(number, 60.0 * MINUTES, share)
        stand, model = make_samples.MASTS[mast], RADARS[make_samples.MASTS[mast].radar]
        place = np.random.default_rng([make_samples.SEED, mast]).spawn(1)[0]
        moments, noise = np.random.default_rng([number, mast]).spawn(2)
        radar = place_radar(stand.pose(), site.scene, rng=place, model=model)
        begin_s = _begin(number)
        frames = frame_times(
            begin_s, 60.0 * MINUTES, rng=moments, cycle_s=model.cycle_s, jitter_s=model.jitter_s
        )
        table = simulate_recording(radar, site.traffic, frames, rng=noise)
        np.savez_compressed(
            path, time=table["time"] - begin_s, xyz=table[["x", "y", "z"]],
            rate=table["range_rate"],
        )  # fmt: skip
        spent = (time.process_time() - begin) / MINUTES
        print(f"{path.name}: {spent:.1f} s of processor a minute", flush=True)
    return path


def _begin(number: int) -> float:
    """Return when a batch begins, UNIX seconds: slow errors differ from batch to batch."""
    return make_samples.START + 60.0 * MINUTES * number


def _site(seed: int, duration_s: float, share: float) -> make_samples.Site:
    """Return the sample site with other traffic on the same streets."""
    keeping = SameStreets(
        **{f.name: getattr(DRIVERS_AS_RECORDED, f.name) for f in fields(LaneKeeping)}
    )
    plan = street_plan.nodes_xml(), street_plan.edges_xml(), street_plan.connections_xml()
    with tempfile.TemporaryDirectory() as folder:
        net = Path(folder) / "junction.net.xml"
        build_network(*plan, net, cycle_s=make_samples.CYCLE_S)
        network = read_network(net, origin=make_samples.ORIGIN)
        flows = [
            Flow(source=f"{way[0]}_far", sink=f"{way[1]}_out", per_hour=share * count)
            for way, count in make_samples.PER_HOUR.items()
        ]
        traffic = simulate_traffic(
            net, network, flows=flows, kinds=ALL_KINDS, start=_begin(seed),
            duration_s=duration_s, warm_up_s=100.0, seed=seed, keeping=keeping,
        )  # fmt: skip
    furniture = np.random.default_rng(make_samples.SEED)
    scene = furnish(network, make_samples.TERRAIN, rng=furniture)
    people = simulate_people(network, scene.road, traffic, make_samples.PEOPLE, seed=seed)
    return make_samples.Site(network=network, scene=scene, traffic=traffic.joined(people))


@dataclass(frozen=True, kw_only=True)
class Detected:
    """Detections: time since the batch's begin (s), points (m, sensor frame), range rate (m/s)."""

    time: Floats
    points: Floats
    rate: Floats

    def between(self, begin: float, end: float) -> Detected:
        """Return the detections from `begin` to before `end`."""
        low, high = np.searchsorted(self.time, [begin, end])
        return Detected(
            time=self.time[low:high], points=self.points[low:high], rate=self.rate[low:high]
        )


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Radar of the sample with its true pose."""

    name: str
    state: State

    @classmethod
    def of(cls, mast: int) -> Sensor:
        """Return the radar on a mast, given by its number."""
        pose = make_samples.MASTS[mast].pose()
        turn = Rotation.from_quat(pose.quaternion).as_matrix()
        place = np.array([0.0, 0.0, pose.height])
        state = State(position=place, R_map_sensor=turn, reflection=0.5)
        return cls(name=pose.sensor, state=state)

    def load(self, path: Path) -> Detected:
        """Return a batch."""
        with np.load(path) as file:
            return Detected(
                time=file["time"], points=np.asarray(file["xyz"], dtype=np.float64),
                rate=np.asarray(file["rate"], dtype=np.float64),
            )  # fmt: skip

    def moved(self, batch: Detected, step: Floats) -> Detected:
        """Return a batch as the sensor would measure it after a move (3 m, 3 rad) in the map."""
        moved = self.state.moved(np.append(step, 0.0))
        points = (self.state.to_map(batch.points) - moved.position) @ moved.R_map_sensor
        return replace(batch, points=points)


class Detector:
    """The change detector of a sensor, asked as `track` asks it.

    Parameters
    ----------
    known : (StationaryTargets, array of int) or None
        Stationary targets, and the rows of those to use; no others are searched then.
    """

    def __init__(self, known: tuple[StationaryTargets, np.ndarray] | None = None) -> None:
        self.still = StationaryTargets(search_blocks=SEARCH_BLOCKS if known is None else 2**62)
        if known is not None:
            self.still.set_targets(known[0].place[known[1]], known[0].rate[known[1]])

    def batch(self, batch: Detected) -> Scores:
        """Process a batch; return the scores minute by minute."""
        return [self.minute(self.summaries(batch, minute)) for minute in range(MINUTES)]

    def summaries(self, batch: Detected, minute: int) -> Iterator[Floats]:
        """Yield where stationary targets are, block by block of a minute.

        Each block must be processed before the next is asked for.
        """
        for begin in 60.0 * minute + np.arange(0.0, 60.0, BLOCK_S):
            part = batch.between(begin, begin + BLOCK_S)
            self.still.push(part.time, part.points, part.rate)
            yield self.still.summary()

    def minute(self, blocks: Iterable[Floats]) -> float:
        """Process the blocks of a minute; return the largest score, divided by the gate."""
        largest = 0.0
        for block in blocks:
            self.still.process(block)
            tested = self.still.tested
            largest = max(
                [largest, *(each.displacement.score / LEAST_MOVE_SCORE for each in tested)]
            )
        return largest


def moves() -> dict[str, Floats]:
    """Return moves by 0.3 m and by half a degree: translation (m) and rotation (rad) by name."""
    found = {}
    for degrees in range(0, 360, 45):
        way = np.radians(degrees)
        found[f"0.3 m to {degrees}"] = np.array([0.3 * np.cos(way), 0.3 * np.sin(way), 0, 0, 0, 0])
    half = np.radians(0.5)
    for sign in (1.0, -1.0):
        found[f"yaw {0.5 * sign:+.1f}"] = np.array([0, 0, 0, 0, 0, sign * half])
        found[f"tilt {0.5 * sign:+.1f} about east"] = np.array([0, 0, 0, sign * half, 0, 0])
        found[f"tilt {0.5 * sign:+.1f} about north"] = np.array([0, 0, 0, 0, sign * half, 0])
    return found


def noticed(sensor: Sensor, batches: Sequence[Path]) -> Noticed:
    """Count which moves at the begin of each later batch are noticed."""
    settled, found = Detector(), Noticed()
    for number, path in enumerate(batches):
        batch = sensor.load(path)
        for name, step in moves().items() if number >= FIRST_MOVED else ():
            scores = copy.deepcopy(settled).batch(sensor.moved(batch, step))
            _add(found, {name.split(" ")[0]: (1, int(max(scores) > 1.0))})
        settled.batch(batch)
    return found


def _add(counts: Noticed, more: Noticed) -> None:
    """Add counts to others."""
    for name, (trials, seen) in more.items():
        before = counts.get(name, (0, 0))
        counts[name] = (before[0] + trials, before[1] + seen)


def rest(sensor: Sensor, batches: Sequence[Path], days: int, seed: int) -> list[Scores]:
    """Draw days in which the sensor stays where it is; return the scores of their minutes."""
    first, parts = Detector(), [sensor.load(path) for path in batches]
    for batch in parts:
        first.batch(batch)
    targets, every = first.still, np.arange(len(first.still))
    again = Detector((targets, every))
    minutes: list[Minute] = [
        list(again.summaries(batch, minute)) for batch in parts for minute in range(MINUTES)
    ]
    hours, passed = DrawnHours(minutes, sensor.state.R_map_sensor, seed), []
    for _ in range(days):
        detector = Detector((targets, every))
        passed.append([detector.minute(each) for each in hours.drawn(24.0, CHANGING)])
    return passed


def _noticed_table(moved: Mapping[str, Noticed]) -> str:
    rows = [
        [f"{size}; {about}", "{1} of {0}".format(*moved[traffic][move])]
        for traffic, about in TRAFFIC.items()
        for move, size in SIZES.items()
        if move in moved.get(traffic, {})
    ]
    return table(["move within ten minutes", "noticed"], rows)


def _false_table(tail: Mapping[str, Any]) -> str:
    row = [f"{tail['hours']:.0f}", str(tail["alarms"]), f"{tail['largest']:.2f}", _monthly(tail)]
    heads = ["hours at rest", "false alarms", "largest score of the gate", "a month (95 %)"]
    return table(heads, [row])


def _monthly(figures: Mapping[str, Any]) -> str:
    """Return the rate a month with its 95 % interval as text."""
    if "monthly_95" not in figures:
        return "-"
    rate, low, high = (
        "under 0.01" if value < 0.01 else f"{value:.2g}" if value < 10 else f"{value:.0f}"
        for value in (figures["monthly"], *figures["monthly_95"])
    )
    return f"{rate} ({low} to {high})"


if __name__ == "__main__":
    main()

"""The alarm of `track`: how often it is false, and how soon it notices a small move.

Minutes of the sample junction are simulated detection by detection, with radars and drivers as
recorded, walkers and cyclists. From these:

- *noticed*: the same detections as a sensor gives them that was moved by 0.3 m in eight directions
  or turned by half a degree, after what there is of an hour: how often within ten minutes, by which
  of both change detectors;
- *rest*: hours drawn anew from those minutes (`alarm_hours.py`). `day` adds what changes: traffic
  from night to rush hour, habits by stretch, of all drivers and of trucks, obstacles that all go
  round, still targets that wander for hours, parked cars that leave, rain, a mast that drifts as
  far as the settings allow and sways in the wind. The rate of false alarms comes from a generalised
  Pareto tail of the largest score of each half an hour. `steady` has none of that and is compared
  with the detections' own scores. In hours of either kind the sensor is moved, too, with all of its
  still targets and with few of them;
- *knocks*: what the test of the newest 20 and 60 s reports in the same detections at rest.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from alarm_hours import APART, CHANGING, STEADY, Day, Hours, Minute, halves, tail
from figures import ROOT
from scipy.spatial.transform import Rotation

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.calibration import MONITOR
from gis_radar.calibration.alarm import Alarm, ChangeDetector, detectors
from gis_radar.calibration.lane_places import Cells, LanePlaces, cells_along, lane_places
from gis_radar.calibration.lanes import sample_lanes
from gis_radar.calibration.state import State
from gis_radar.calibration.stationary_targets import StillTargets, by_move
from gis_radar.calibration.traces import Moving
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
MINUTES = 10  # a piece of simulation; streets hold the same habits in all of them
STREETS_SEED = 77
WINDOW_S = 100.0
FIRST_MOVED = 3  # pieces before the first move
FEW = (24, 12)  # still targets
ALARM, STILL, TRACES = MONITOR.alarm, MONITOR.still, MONITOR.localization.traces


NOBODY = LanePlaces(
    vehicle=np.empty(0, dtype=np.int64), cell=np.empty(0, dtype=np.int64), across_m=np.empty(0),
    over_m=np.empty(0), count=np.empty(0, dtype=np.int64),
)  # fmt: skip


class SameStreets(LaneKeeping):
    """Drivers as recorded, whose habits by lane are the same whatever the traffic's seed."""

    def on(self, network: RoadNetwork, *, seed: int) -> DrivenRoads:
        """Return the roads with the habits of one seed."""
        del seed
        return super().on(network, seed=STREETS_SEED)


def main() -> None:
    """Simulate, measure, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pieces", type=int, default=5, help="of ten minutes, ordinary traffic")
    parser.add_argument("--light", type=int, default=4, help="of ten minutes, a quarter of it")
    parser.add_argument("--days", type=int, default=5, help="of each sensor and kind")
    parser.add_argument("--still", action="store_true", help="vehicles are not asked: faster")
    parser.add_argument("--seed", type=int, default=2, help="of the days; the gate is from 1")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-alarm.json")
    arguments = parser.parse_args()
    Both.asks_vehicles = not arguments.still
    report: dict[str, object] = {"gate": ALARM.gate, "still_gate": STILL.gate}
    days: dict[str, list[Floats]] = {}
    for name, first, count, share, masts in (
        ("ordinary", 0, arguments.pieces, 1.0, (0, 1)),
        ("light", 100, arguments.light, 0.25, (0,)),
    ):
        for mast in masts:
            made = [_piece(name, first + number, share, mast) for number in range(count)]
            sensor = Sensor.of(mast)
            print(f"{name}, {sensor.name}: {count * MINUTES} minutes", flush=True)
            report[f"{name}, {sensor.name}, noticed"] = noticed(sensor, made)
            if name == "ordinary":
                figures, largest = rest(sensor, made, arguments.days, arguments.seed)
                report[f"{sensor.name}, rest"] = figures
                for who, parts in largest.items():
                    days.setdefault(who, []).append(parts)
    for who, every in days.items():
        report[f"false, all, {who}"] = tail(np.concatenate(every))
        print(f"all sensors, day, {who}: {json.dumps(report[f'false, all, {who}'])}", flush=True)
    report["processor minutes"] = time.process_time() / 60.0
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")


# detections


def _piece(name: str, number: int, share: float, mast: int) -> Path:
    """Return the detections of ten minutes, simulated once and kept."""
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
    """Return when a piece begins, so that each sees other moments of what wanders."""
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
    """Detections in the sensor's frame."""

    time: Floats
    points: Floats
    rate: Floats

    def between(self, begin: float, end: float) -> Detected:
        """Return those of a time, its end not included."""
        low, high = np.searchsorted(self.time, [begin, end])
        return Detected(
            time=self.time[low:high], points=self.points[low:high], rate=self.rate[low:high]
        )


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The largest scores of a minute, in parts of their gates; whether still targets see."""

    still: float
    vehicles: float
    sees: bool

    @property
    def whole(self) -> float:
        """What the alarm goes by, as :func:`gis_radar.calibration.watch.decided`."""
        return self.still if self.sees else max(self.still, self.vehicles)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A radar of the sample, with the lanes around it."""

    name: str
    cells: Cells
    state: State

    @classmethod
    def of(cls, mast: int) -> Sensor:
        """Return a radar where it truly stands."""
        folder = gr.sample_folder()
        pose = make_samples.MASTS[mast].pose()
        mask = gr.mask_road(
            [folder / "scan.laz"], gr.read_roads(folder / "junction.osm"), engine="laspy"
        )
        lanes = sample_lanes(
            gr.read_map(folder / "junction.osm").lanelets, mask.points, place=pose.position[:2],
            reach_m=200.0,
        )  # fmt: skip
        turn = Rotation.from_quat(pose.quaternion).as_matrix()
        place = np.array([0.0, 0.0, pose.height])
        state = State(position=place, R_map_sensor=turn, reflection=0.5)
        return cls(name=pose.sensor, cells=cells_along(lanes), state=state)

    def load(self, path: Path) -> Detected:
        """Return a piece."""
        with np.load(path) as file:
            return Detected(
                time=file["time"], points=np.asarray(file["xyz"], dtype=np.float64),
                rate=np.asarray(file["rate"], dtype=np.float64),
            )  # fmt: skip

    def moved(self, piece: Detected, step: Floats) -> Detected:
        """Return a piece as the sensor gives it that was moved, and is not known to be."""
        moved = self.state.moved(np.append(step, 0.0))
        points = (self.state.to_map(piece.points) - moved.position) @ moved.R_map_sensor
        return replace(piece, points=points)

    def driven(self, piece: Detected, minute: int) -> LanePlaces:
        """Return where vehicles drove in a minute of a piece."""
        now = 60.0 * (minute + 1)
        window = piece.between(now - WINDOW_S, now)
        drives = np.abs(window.rate) > TRACES.min_speed_mps
        moving = Moving(
            time=window.time[drives], points=window.points[drives], range_rate=window.rate[drives],
            frames=2000, detections=len(drives), begin=now - WINDOW_S, end=now,
        )  # fmt: skip
        since, until = now - 60.0 - ALARM.settle_s, now - ALARM.settle_s
        return lane_places(moving, self.cells, self.state, since=since, until=until, traces=TRACES)

    def detectors(self) -> tuple[ChangeDetector, ChangeDetector]:
        """Return how vehicles show moves."""
        return detectors(self.cells, self.state.position[:2], ALARM)


class Both:
    """Both change detectors of a sensor, asked as the track asks them.

    Parameters
    ----------
    sensor : Sensor
        Whose.
    known : (StillTargets, array of int) or None
        Of which still targets these are taken as they are, and no others looked for.
    """

    asks_vehicles = True

    def __init__(
        self, sensor: Sensor, known: tuple[StillTargets, np.ndarray] | None = None
    ) -> None:
        self.vehicles = Alarm(sensor.cells, sensor.state.position[:2])
        fixed = replace(MONITOR, still=replace(STILL, search_blocks=2**62))
        self.still = StillTargets(MONITOR if known is None else fixed)
        if known is not None:
            self.still.know(known[0].place[known[1]], known[0].rate[known[1]])

    def piece(self, sensor: Sensor, piece: Detected, clock: float) -> list[Scores]:
        """Take a piece of detections; return the scores minute by minute."""
        scores = []
        for minute in range(MINUTES):
            places = sensor.driven(piece, minute) if self.asks_vehicles else None
            seen = self.summaries(piece, minute)
            scores.append(self.minute(places, seen, clock + 60.0 * (minute + 1)))
        return scores

    def summaries(self, piece: Detected, minute: int) -> Iterator[Floats]:
        """Yield where still targets are in the blocks of a minute; to be taken one by one."""
        for begin in 60.0 * minute + np.arange(0.0, 60.0, STILL.block_s):
            part = piece.between(begin, begin + STILL.block_s)
            self.still.push(part.time, part.points, part.rate)
            yield self.still.summary()

    def minute(self, places: LanePlaces | None, still: Iterable[Floats], now: float) -> Scores:
        """Take a minute; return the largest scores in it, in parts of their gates."""
        largest, sees = 0.0, False
        for part in still:
            self.still.take(part)
            told = self.still.tested
            sees = any(each.sees for each in told)
            largest = max([largest, *(each.found.score / STILL.gate for each in told)])
        driven = None
        if places is not None and self.asks_vehicles:
            driven = self.vehicles.push(places, now)
        by_vehicles = 0.0 if driven is None else driven.score / ALARM.gate
        return Scores(still=largest, vehicles=by_vehicles, sees=sees)


def moves() -> dict[str, Floats]:
    """Return moves by 0.3 m and by half a degree, by name."""
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


def noticed(sensor: Sensor, pieces: Sequence[Path]) -> dict[str, object]:
    """Move the sensor at the begin of each later piece: how often is it noticed, and when?"""
    taught, found = Both(sensor), dict[str, list[list[Scores]]]()
    for number, path in enumerate(pieces):
        piece, clock = sensor.load(path), 60.0 * MINUTES * number
        for name, step in moves().items() if number >= FIRST_MOVED else ():
            scores = copy.deepcopy(taught).piece(sensor, sensor.moved(piece, step), clock)
            found.setdefault(name.split(" ")[0], []).append(scores)
        rest = taught.piece(sensor, piece, clock)
        found.setdefault("rest", []).append(rest)
    report = {name: summary(trials) for name, trials in found.items()}
    for name, figures in report.items():
        print(f"  {name:6s} {json.dumps(figures)}", flush=True)
    return dict(report)


def summary(trials: Sequence[Sequence[Scores]]) -> dict[str, object]:
    """Return how many trials were noticed within the minutes of a piece, by whom, and when."""
    figures: dict[str, object] = {"trials": len(trials)}
    for name in ("whole", "still", "vehicles"):
        scores = np.array([[getattr(each, name) for each in trial] for trial in trials])
        delay = np.where((scores > 1.0).any(axis=1), np.argmax(scores > 1.0, axis=1) + 1.0, np.inf)
        largest = scores.max(axis=1)
        figures[name] = {
            "noticed": int(np.isfinite(delay).sum()), "minutes": float(np.median(delay)),
            "score_median": float(np.median(largest)), "score_least": float(largest.min()),
            "score_most": float(largest.max()),
        }  # fmt: skip
    return figures


def learnt(sensor: Sensor, pieces: Sequence[Path]) -> tuple[StillTargets, list[Minute]]:
    """Return the still targets of all pieces, and what both change detectors see in each minute."""
    first, parts = Both(sensor), [sensor.load(path) for path in pieces]
    for piece in parts:
        for minute in range(MINUTES):
            for seen in first.summaries(piece, minute):
                first.still.take(seen)
    again = Both(sensor, (first.still, np.arange(len(first.still))))
    minutes = [
        Minute(
            places=sensor.driven(piece, minute) if Both.asks_vehicles else NOBODY,
            still=list(again.summaries(piece, minute)),
        )
        for piece in parts
        for minute in range(MINUTES)
    ]
    return first.still, minutes


def rest(
    sensor: Sensor, pieces: Sequence[Path], days: int, seed: int
) -> tuple[dict[str, object], dict[str, Floats]]:
    """Let days pass in which the sensor stands still; and move it in them, with fewer targets."""
    targets, minutes = learnt(sensor, pieces)
    hours = Hours(minutes, sensor.detectors(), sensor.state.R_map_sensor, seed)
    every = np.arange(len(targets))
    report: dict[str, object] = {"targets": len(targets)}
    kept: dict[str, Floats] = {}
    for name, day, count in (("day", CHANGING, days), ("steady", STEADY, 1)):
        largest: dict[str, list[Floats]] = {"whole": [], "still": [], "vehicles": []}
        sees: list[bool] = []
        for _ in range(count):
            both = Both(sensor, (targets, every))
            drawn = [
                both.minute(each.places, each.still, 60.0 * k)
                for k, (each, _) in enumerate(hours.drawn(24.0, day))
            ]
            for who, parts in largest.items():
                parts.append(halves([getattr(each, who) for each in drawn]))
            sees += [each.sees for each in drawn[APART:]]
        joined = {who: np.concatenate(parts) for who, parts in largest.items()}
        kept = kept or joined  # of the changing days
        report[name] = {
            "sees": float(np.mean(sees)),
            **{who: tail(parts) for who, parts in joined.items()},
        }  # fmt: skip
        print(f"  {name:10s} {json.dumps(report[name])}", flush=True)
    for day, count in ((STEADY, len(every)), *((CHANGING, n) for n in (len(every), *FEW))):
        chosen = hours.rng.permutation(every)[:count]
        name = f"{'steady' if day is STEADY else 'changing'}, {count} targets"
        report[name] = moved_by_day(sensor, hours, targets, chosen, day)
        print(f"  {name}: {json.dumps(report[name])}", flush=True)
    return report, kept


def moved_by_day(
    sensor: Sensor, hours: Hours, targets: StillTargets, chosen: np.ndarray, day: Day
) -> dict[str, object]:
    """Move a sensor on a day, on and on, with a part of its still targets: how often is it seen?"""
    both, found = Both(sensor, (targets, chosen)), dict[str, list[list[Scores]]]()
    minutes = [each for each, _ in hours.drawn(12.0, day)]
    turn, design = np.kron(np.eye(2), sensor.state.R_map_sensor.T), by_move(hours.middle)
    every = list(moves().items())
    for k, minute in enumerate(minutes):
        if k >= 60 and k % 30 == 0 and k + MINUTES <= len(minutes):
            for pick in hours.rng.permutation(len(every))[:4]:
                name, step = every[pick]
                shift, other = design @ (turn @ step), copy.deepcopy(both)
                scores = [
                    other.minute(None, [(part + shift)[chosen] for part in each.still], 0.0)
                    for each in minutes[k : k + MINUTES]
                ]
                found.setdefault(name.split(" ")[0], []).append(scores)
        both.minute(None, [part[chosen] for part in minute.still], 0.0)
    return {
        name: {"trials": len(trials), **summary(trials)["still"]}  # type: ignore[dict-item]
        for name, trials in sorted(found.items())
    }


if __name__ == "__main__":
    main()

"""The alarm of `track`: how often it is false, and how soon it notices a small move.

Minutes of the sample junction are simulated detection by detection, with radars and drivers as
recorded, walkers and cyclists. From these:

- *noticed*: the same detections as a sensor gives them that was moved by 0.3 m in eight directions
  or turned by half a degree, after what there is of an hour: how often within ten minutes;
- *false*: hours at the level of tracks. Runs of minutes are drawn anew from those simulated; what
  each vehicle does in its lane about the mean of all is mirrored at random, a run as a whole (a
  wild cluster bootstrap: spread, correlation along a track, broken tracks and platoons stay as they
  are). `day` adds what changes: traffic from night to rush hour, habits by stretch, of all drivers
  and of trucks, obstacles that all go round, and a mast that drifts as far as the settings allow.
  The rate of false alarms comes from a generalised Pareto tail of the largest score of each half
  an hour. `steady` has none of that and is compared with the detections' own scores.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import genpareto
from simulated import ROOT

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.localization.lanes import sample_lanes
from gis_radar.localization.state import State
from gis_radar.localization.traces import Moving
from gis_radar.tracking.alarm import Alarm, Displacement, Witness, witnesses
from gis_radar.tracking.lane_places import Cells, LanePlaces, cells_along, lane_places
from gis_radar.tracking.settings import DEFAULTS, HOUR_S
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
ALARM = DEFAULTS.alarm
RUN = 3  # minutes that stay together
MONTH_H = 720.0
APART = 30  # minutes between independent exceedances: the longest part that is tested
SHARES = (  # of the traffic by day, hour by hour
    0.06, 0.04, 0.04, 0.05, 0.1, 0.3, 0.7, 1.0, 1.0, 0.8, 0.7, 0.7,
    0.75, 0.75, 0.8, 0.9, 1.0, 1.0, 0.85, 0.6, 0.45, 0.3, 0.2, 0.1,
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
    parser.add_argument("--pieces", type=int, default=7, help="of ten minutes, ordinary traffic")
    parser.add_argument("--light", type=int, default=9, help="of ten minutes, a quarter of it")
    parser.add_argument("--days", type=int, default=5, help="of each sensor and kind")
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-alarm.json")
    arguments = parser.parse_args()
    report: dict[str, object] = {"gate": ALARM.gate}
    still: list[Floats] = []
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
                report[f"{sensor.name}, false"], largest = false_alarms(
                    sensor, made, arguments.days
                )
                still.append(largest)
    report["false, all"] = tail(np.concatenate(still))
    print(f"all sensors, day: {json.dumps(report['false, all'])}", flush=True)
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")


# detections


def _piece(name: str, number: int, share: float, mast: int) -> Path:
    """Return the moving detections of ten minutes, simulated once and kept."""
    sensor = make_samples.MASTS[mast].sensor
    path = OUT / name / f"{sensor}_{number:03d}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        begin = time.process_time()
        site = _site(number, 60.0 * MINUTES, share)
        stand, model = make_samples.MASTS[mast], RADARS[make_samples.MASTS[mast].radar]
        place = np.random.default_rng([make_samples.SEED, mast]).spawn(1)[0]
        moments, noise = np.random.default_rng([number, mast]).spawn(2)
        # what stands still is of no use here
        few = replace(model, static_per_frame=2.0)
        radar = place_radar(stand.pose(), site.scene, rng=place, model=few)
        frames = frame_times(
            make_samples.START, 60.0 * MINUTES, rng=moments, cycle_s=model.cycle_s,
            jitter_s=model.jitter_s,
        )  # fmt: skip
        table = simulate_recording(radar, site.traffic, frames, rng=noise)
        table = table[table["range_rate"].abs() > DEFAULTS.localization.traces.min_speed_mps]
        np.savez_compressed(
            path, time=table["time"] - make_samples.START, xyz=table[["x", "y", "z"]],
            rate=table["range_rate"],
        )  # fmt: skip
        spent = (time.process_time() - begin) / MINUTES
        print(f"{path.name}: {spent:.1f} s of processor a minute", flush=True)
    return path


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
            net, network, flows=flows, kinds=ALL_KINDS, start=make_samples.START,
            duration_s=duration_s, warm_up_s=100.0, seed=seed, keeping=keeping,
        )  # fmt: skip
    furniture = np.random.default_rng(make_samples.SEED)
    scene = furnish(network, make_samples.TERRAIN, rng=furniture)
    people = simulate_people(network, scene.road, traffic, make_samples.PEOPLE, seed=seed)
    return make_samples.Site(network=network, scene=scene, traffic=traffic.joined(people))


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

    def minutes(self, path: Path, step: Floats | None = None) -> list[LanePlaces]:
        """Return where vehicles drove in a piece, by minute, if the sensor was moved before it."""
        with np.load(path) as file:
            when, rate = file["time"], np.asarray(file["rate"], dtype=np.float64)
            xyz = np.asarray(file["xyz"], dtype=np.float64)
        if step is not None:
            moved = self.state.moved(np.append(step, 0.0))
            xyz = (self.state.to_map(xyz) - moved.position) @ moved.R_map_sensor
        found = []
        for now in 60.0 * np.arange(1, MINUTES + 1):
            low, high = np.searchsorted(when, [now - WINDOW_S, now])
            window = Moving(
                time=when[low:high], points=xyz[low:high], range_rate=rate[low:high],
                frames=2000, detections=high - low, begin=now - WINDOW_S, end=now,
            )  # fmt: skip
            since, until = now - 60.0 - ALARM.settle_s, now - ALARM.settle_s
            found.append(
                lane_places(window, self.cells, self.state, since=since, until=until,
                         traces=DEFAULTS.localization.traces)
            )  # fmt: skip
        return found

    def alarm(self) -> Alarm:
        """Return an alarm that has seen nothing."""
        return Alarm(self.cells, self.state.position[:2])


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
    taught, clock = sensor.alarm(), 0.0
    found: dict[str, list[tuple[float, float]]] = {}
    for number, piece in enumerate(pieces):
        for name, step in moves().items() if number >= FIRST_MOVED else ():
            alarm = copy.deepcopy(taught)
            scores = [
                _score(alarm.push(seen, clock + 60.0 * (k + 1)))
                for k, seen in enumerate(sensor.minutes(piece, step))
            ]
            late = np.flatnonzero(np.array(scores) > ALARM.gate)
            delay = float(late[0] + 1) if len(late) else np.inf
            found.setdefault(name.split(" ")[0], []).append((max(scores), delay))
        for seen in sensor.minutes(piece):
            clock += 60.0
            taught.push(seen, clock)
    report: dict[str, object] = {}
    for name, results in found.items():
        scores, delays = np.array(results).T
        report[name] = {
            "trials": len(results), "noticed": float((delays <= MINUTES).mean()),
            "minutes": float(np.median(delays)), "score_median": float(np.median(scores)),
            "score_low": float(np.quantile(scores, 0.1)),
            "scores": np.sort(scores).round(1).tolist(),
        }  # fmt: skip
        print(f"  {name:6s} {json.dumps(report[name])}", flush=True)
    return report


def _score(found: Displacement | None) -> float:
    return 0.0 if found is None else found.score


# tracks


@dataclass(frozen=True, kw_only=True)
class Day:
    """What changes in a day; standard deviations, as slow random processes of some hours.

    Parameters
    ----------
    shares : tuple of float
        Of the traffic, hour by hour.
    stretch_m, common_m, breadth_m : float
        Habits by stretch, of all drivers, and where vehicles reflect.
    obstacles : float
        An hour: on a stretch all keep aside by 0.3 to 1 m, for 5 to 60 minutes.
    drift : float
        Of the mast, times what the settings allow.
    """

    shares: tuple[float, ...] = (1.0,)
    stretch_m: float = 0.0
    common_m: float = 0.0
    breadth_m: float = 0.0
    obstacles: float = 0.0
    drift: float = 0.0


STEADY = Day()
CHANGING = Day(
    shares=SHARES, stretch_m=0.05, common_m=0.03, breadth_m=0.02, obstacles=0.5, drift=1.0
)
SLOW_H = 2.0


class Tracks:
    """Traffic at the level of tracks, from minutes of simulated detections."""

    def __init__(self, sensor: Sensor, minutes: Sequence[LanePlaces], seed: int) -> None:
        self.sensor, self.minutes = sensor, minutes
        self.rng = np.random.default_rng(seed)
        self.witnesses = witnesses(sensor.cells, sensor.state.position[:2], ALARM)
        self.mean = [_means([(m.cell, _values(m)[k]) for m in minutes], len(sensor.cells))
                     for k in range(2)]  # fmt: skip

    def hours(self, hours: float, day: Day) -> Iterator[LanePlaces]:
        """Yield where vehicles drive in each minute."""
        rng, count = self.rng, round(60.0 * hours)
        begin = int(rng.integers(24 * 60))
        across, over = self.witnesses
        slow = _Slow(rng, day, across)
        place, signs = 0, np.ones(2)
        used: list[int] = []
        for minute in range(count):
            if minute % RUN == 0:
                place = self._draw(used)
                used = [*used, place][-APART // RUN :]
                signs = rng.choice([-1.0, 1.0], 2)
            seen = self.minutes[place + minute % RUN]
            share = day.shares[(begin + minute) // 60 % len(day.shares)]
            kept = rng.random(seen.vehicles)[seen.vehicle] < share
            slow.step()
            values = []
            for k, (witness, value) in enumerate(zip((across, over), _values(seen), strict=True)):
                mean = self.mean[k]
                own = signs[k] * (value - mean[seen.cell])
                values.append((mean + slow.change(witness))[seen.cell] + own)
            kept &= np.abs(values[0]) < ALARM.within_m
            yield LanePlaces(
                vehicle=np.unique(seen.vehicle[kept], return_inverse=True)[1],
                cell=seen.cell[kept], across_m=values[0][kept], over_m=values[1][kept],
                count=seen.count[kept],
            )  # fmt: skip

    def _draw(self, used: Sequence[int]) -> int:
        """Return where a run begins: no minute comes twice in half an hour, as none ever does."""
        places = np.arange(len(self.minutes) - RUN + 1)
        free = [k for k in places if all(abs(k - other) >= RUN for other in used)]
        return int(self.rng.choice(free or places))


def _values(seen: LanePlaces) -> tuple[Floats, Floats]:
    return seen.across_m, seen.over_m


def _means(parts: Sequence[tuple[np.ndarray, Floats]], cells: int) -> Floats:
    cell, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    count = np.bincount(cell, minlength=cells)
    return np.asarray(np.bincount(cell, value, minlength=cells) / np.maximum(count, 1))


class _Slow:
    """What changes slowly, minute by minute."""

    def __init__(self, rng: np.random.Generator, day: Day, across: Witness) -> None:
        self._rng, self._day = rng, day
        self._stretches = int(across.stretch.max()) + 1
        sigma = np.full(self._stretches + 2, day.stretch_m)
        sigma[-2:] = day.common_m, day.breadth_m
        self._sigma, self._habits = sigma, sigma * rng.normal(size=len(sigma))
        self._drift = np.zeros(6)
        self._obstacles: list[tuple[int, float, int]] = []

    def step(self) -> None:
        """Go on by a minute."""
        rng, keep = self._rng, np.exp(-1.0 / 60.0 / SLOW_H)
        noise = np.sqrt(1.0 - keep**2) * rng.normal(size=len(self._sigma))
        self._habits = keep * self._habits + self._sigma * noise
        hourly = self._day.drift * np.array(DEFAULTS.drift)
        self._drift = self._drift + hourly * rng.normal(size=6) * np.sqrt(60.0 / HOUR_S)
        self._obstacles = [(s, by, left - 1) for s, by, left in self._obstacles if left > 1]
        if rng.random() < self._day.obstacles / 60.0:
            by = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0))
            stretch, lasts = int(rng.integers(self._stretches)), int(rng.integers(5, 61))
            self._obstacles.append((stretch, by, lasts))

    def change(self, witness: Witness) -> Floats:
        """Return how far the mean of each cell is changed."""
        changed = witness.by_move @ self._drift[list(witness.moved)]
        if len(witness.moved) == 2:  # heights: habits of the same size, and no obstacles
            return np.asarray(changed + self._habits[witness.stretch] + self._habits[-2])
        changed = changed + self._habits[witness.stretch] + witness.by_habit @ self._habits[-2:]
        for stretch, by, _ in self._obstacles:
            changed = changed + by * (witness.stretch == stretch)
        return np.asarray(changed)


def false_alarms(
    sensor: Sensor, pieces: Sequence[Path], days: int
) -> tuple[dict[str, object], Floats]:
    """Let days pass in which the sensor stands still; return figures, and half-hourly maxima."""
    minutes = [each for path in pieces for each in sensor.minutes(path)]
    own = sensor.alarm()
    detections = [_score(own.push(each, 60.0 * k)) for k, each in enumerate(minutes)]
    whole = np.array(detections[3 * ALARM.warm_up :])
    report: dict[str, object] = {"detections": _quantiles(whole)}
    tracks = Tracks(sensor, minutes, seed=len(minutes))
    largest: dict[str, Floats] = {}
    for name, day, count in (("day", CHANGING, days), ("steady", STEADY, (days + 1) // 2)):
        halves: list[float] = []
        every: list[float] = []
        for _ in range(count):
            alarm = sensor.alarm()
            scores = [
                _score(alarm.push(each, 60.0 * k)) for k, each in enumerate(tracks.hours(24.0, day))
            ]
            every += scores[3 * ALARM.warm_up : len(minutes)] if name == "steady" else scores
            halves += np.array(scores).reshape(-1, APART).max(axis=1).tolist()
        largest[name] = np.array(halves)
        report[name] = {**_quantiles(np.array(every)), **tail(largest[name])}
        print(f"  {name:10s} {json.dumps(report[name])}", flush=True)
    print(f"  detections {json.dumps(report['detections'])}", flush=True)
    return report, largest["day"]


def _quantiles(scores: Floats) -> dict[str, float]:
    return {f"q{q}": float(np.quantile(scores, q / 100.0)) for q in (50, 75, 90, 95, 99)}


def tail(halves: Floats, *, seed: int = 0) -> dict[str, object]:
    """Return the false alarms a month at the gate, by the tail of half-hourly maxima.

    Neighbouring half hours share tested blocks: of neighbours above the threshold the largest
    counts. The interval is that of 500 draws of the exceedances with replacement.
    """
    level = float(np.quantile(halves, 0.9))
    above = halves > level
    groups = np.cumsum(np.append(True, ~above[:-1]))[above]
    peaks = np.array([halves[above][groups == g].max() for g in np.unique(groups)])
    excess, hours = peaks - level, len(halves) * APART / 60.0
    rng = np.random.default_rng(seed)

    def monthly(sample: Floats) -> float:
        shape, _, scale = genpareto.fit(sample, floc=0.0)
        rate = len(sample) / hours * MONTH_H
        return float(rate * genpareto.sf(ALARM.gate - level, shape, scale=scale))

    draws = [monthly(rng.choice(excess, max(int(rng.poisson(len(excess))), 5))) for _ in range(500)]
    low, high = np.quantile(draws, [0.025, 0.975])
    return {
        "hours": hours, "largest": float(halves.max()), "alarms": int((peaks > ALARM.gate).sum()),
        "monthly": monthly(excess), "monthly_95": [float(low), float(high)],
        "tail": [level, len(excess), *map(float, genpareto.fit(excess, floc=0.0))],
    }  # fmt: skip


if __name__ == "__main__":
    main()

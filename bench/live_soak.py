"""Soak of the live system: simulated sensors, a real broker, fusion; losses, delay, CPU, memory.

    python bench/live_soak.py [--minutes 15] [--sensors 100] [--processes 4]

Each sensor sends 20 frames a second of the sample's detections through the outbox of `edge`, and
keeps them until they are acknowledged. For each frame fusion measures the time until the map has
it; one that is too late for its window counts as never. Senders run on other cores than fusion and
broker where there are two or more. With `--vehicles` vehicles are followed, and quarters and hours
are measured meanwhile. `--kill MINUTE NAME ...` kills `fusion`, `broker` or the `worker` at that
time; the first two start again at once. `--go-on` continues in the folder of an earlier soak, as
after an outage; its figures count both. Figures go to `out/bench-live-soak.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq

import gis_radar as gr
from gis_radar.base import STEP_S, STEP_US, Integers, WarningList, stopped_by_signals
from gis_radar.live import (
    BrokerAddress,
    DetectionSelector,
    DiskBuffer,
    Fusion,
    Link,
    Outbox,
    PoseContent,
    SensorTopics,
    frames_of_recording,
    key_of_pose,
    pack_detections,
    read_live_site,
    write_broker_files,
)
from gis_radar.live.now.map_of_now import SensorReport
from gis_radar.live.wire.buffer import Waiting
from gis_radar.live.wire.payload import POSE_BYTES, varint
from gis_radar.measures import road_near
from gis_radar.scans import SightTiles, find_sight

SAMPLE, OUT = gr.sample_folder(), Path("out/bench-live-soak.json")
SITE = "soak"
LOOK_S = 10.0  # between two samples of memory and CPU time
PATIENCE_S = 120.0  # for the last frames to be acknowledged
Figures = dict[str, Any]
FRAMES = 2000  # of the sample, which are sent again and again
MOST_MS = 10_000  # delays over this are counted as this


class MemoryBuffer:
    """Buffer in memory in place of `DiskBuffer`: a sensor's disk is not measured here."""

    def __init__(self, stream: bytes) -> None:
        self.stream, self.last, self.stored, self.bytes_used = stream, 0, 0, 0
        self._rows: deque[Waiting] = deque()
        self._pose = b""

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, content: bytes) -> int:
        self.last += 1
        self._rows.append(Waiting(self.last, self.last == self.stored + 1, content))
        return self.last

    def add_pose(self, message: bytes) -> None:
        self._pose = message

    def pose_of(self, _number: int) -> bytes:
        return self._pose

    def read_after(self, number: int, most: int) -> Iterator[Waiting]:
        begin = max(number + 1 - self._rows[0].number, 0) if self._rows else 0
        yield from list(islice(self._rows, begin, begin + most))

    def acknowledge(self, number: int) -> None:
        self.stored = number
        while self._rows and self._rows[0].number <= number:
            self._rows.popleft()


class Sensor:
    """A simulated sensor.

    Parameters
    ----------
    name : str
        Its name; its number decides when in a step its frames are sent.
    address : BrokerAddress
        The broker.
    frames : list of bytes
        What follows the time in the message of each frame.
    fingerprint : str
        Of the tiles.
    """

    def __init__(
        self, name: str, address: BrokerAddress, frames: list[bytes], fingerprint: str,
    ) -> None:  # fmt: skip
        topics = SensorTopics(SITE, name)
        self.sent = 0
        self.delays: list[float] = []
        self._frames = frames
        self._buffer = MemoryBuffer(os.urandom(4))
        self.link = Link(address, name=f"{SITE}-{name}", topics=(topics.of("ack"),))
        self.outbox = Outbox(cast("DiskBuffer", self._buffer), self.link, topics, figures=dict)
        pose = gr.read_pose(SAMPLE / "R1.json").as_dict() | {"sensor": name}
        content = PoseContent(pose=pose, fingerprint=fingerprint).pack()
        self.outbox.put_pose(content)
        self._head = key_of_pose(content) + varint(1)
        self.link.open()

    def frame(self, time_us: int) -> None:
        """Put the next frame into the outbox, as measured at a time (UNIX microseconds)."""
        self.delays.append(time.time() - time_us / 1e6)
        frame = self._frames[self.sent % len(self._frames)]
        self.outbox.put(self._head + varint(time_us) + frame)
        self.sent += 1


def phase_us(name: str, sensors: int) -> int:
    """Return when in a step a sensor's frames are; those of all sensors are spread over it."""
    return STEP_US * int(name[1:]) // sensors


def send(folder: Path, names: list[str], sensors: int, seconds: float) -> None:
    """Run some of the sensors for a time; write their figures."""
    site = read_live_site(folder / "SITE.toml")
    tiles = gr.read_tiles(site.live.tiles)
    road = SightTiles.of(tiles)
    pose, selector = gr.read_pose(SAMPLE / "R1.json"), DetectionSelector(road)
    height = road_near(find_sight(pose, road), road)
    recorded = islice(frames_of_recording(SAMPLE / "R1.parquet"), FRAMES)
    found = [selector.find(each, pose, road_m=height) for each in recorded]
    # packed once: a sensor's computer packs the frames of one sensor, this process those of many
    begin = POSE_BYTES + len(varint(1)) + len(varint(found[0].time_us))
    made = []
    for name in names:
        # moved by centimetres: equal frames of two sensors are refused where hours are measured
        aside = np.array([int(name[1:]), 0, 0])
        own = [replace(each, points=each.points + aside) for each in found]
        frames = [pack_detections([each], pose=bytes(POSE_BYTES))[begin:] for each in own]
        secret = (folder / "broker" / f"password_of_{name}").read_text().strip()
        address = BrokerAddress.of(site.live.broker.address, user=name, password=secret)
        made.append(Sensor(name, address, frames, road.fingerprint))
    while not all(each.link.connected for each in made):
        time.sleep(0.1)
    phases = [phase_us(name, sensors) for name in names]
    step = int(time.time() * 1e6) // STEP_US + 20
    last = step + int(seconds * 20.0)
    while step < last:
        for each, phase in zip(made, phases, strict=True):
            time_us = step * STEP_US + phase
            time.sleep(max(time_us / 1e6 - time.time(), 0.0))
            each.frame(time_us)
            each.outbox.pump()
        step += 1
    end = time.monotonic() + PATIENCE_S
    while not all(each.outbox.empty for each in made) and time.monotonic() < end:
        for each in made:
            each.outbox.pump()
        time.sleep(0.02)
    delays = 1000.0 * np.array([each.delays for each in made])
    looks = range(0, delays.shape[1], round(LOOK_S / STEP_S))
    figures = {
        "sent": sum(each.sent for each in made),
        "unacknowledged": sum(not each.outbox.empty for each in made),
        "delay_p99_ms": float(np.percentile(delays, 99)),
        "delay_by_10_s_ms": [float(delays[:, k : k + looks.step].max()) for k in looks],
    }
    (folder / f"sent-{last}-{names[0]}.json").write_text(json.dumps(figures))
    for each in made:
        each.link.close()


class TimedFusion(Fusion):
    """Fusion that counts the frames by their age when the map has them."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.finish_s, self.finishing = 0.0, threading.Event()
        self.shown: dict[str, float] = {}
        self.ages = np.zeros(MOST_MS + 1, np.int64)  # by milliseconds
        super().__init__(*args, **options)

    def _finish(self) -> None:
        begin = time.monotonic()
        self.finishing.set()
        self.shown = self._jobs.figures() | (self.vehicles.figures() if self.vehicles else {})
        super()._finish()
        self.finish_s = time.monotonic() - begin

    def _count(self, step: int, frames: dict[str, SensorReport]) -> None:
        super()._count(step, frames)
        now_us = time.time() * 1e6
        begin_us = step * STEP_US
        for name in frames:
            phase = phase_us(name, len(self.sensors))
            age_ms = int((now_us - begin_us - phase) / 1e3)
            self.ages[min(max(age_ms, 0), MOST_MS)] += 1


def fuse(folder: Path) -> None:
    """Run fusion until it is stopped; write its figures every 10 s and at the end."""
    warnings = WarningList()
    begin = time.monotonic()
    fusion = TimedFusion(read_live_site(folder / "SITE.toml"), reporter=warnings)
    start_s = time.monotonic() - begin
    fusion.ages[:] = 0
    rows: list[dict[str, float]] = []

    def look() -> None:
        before = fusion.ages.copy()
        while not fusion.finishing.wait(LOOK_S):  # what is written at the end takes more memory
            write()
            ages, before = fusion.ages - before, fusion.ages.copy()
            counts = [each.health.counts for each in fusion.sensors.values()]
            row = {
                "time": time.time(),
                "frames": sum(each["frames"] for each in counts),
                "late": sum(each["late_frames"] for each in counts),
                "memory_mb": resident_mb(os.getpid()),
            }
            rows.append(row | {"p50_ms": percentile(ages, 0.5), "p99_ms": percentile(ages, 0.99)})

    def write() -> None:
        counts: dict[str, int] = {}
        for each in fusion.sensors.values():
            for name, count in each.health.counts.items():
                counts[name] = counts.get(name, 0) + count
        ages = fusion.ages.copy()
        ages[MOST_MS] += counts.get("late_frames", 0)
        figures = {
            "counts": counts, "rows": rows, "start_s": start_s, "finish_s": fusion.finish_s,
            "told": warnings.warnings[-20:], "figures": fusion.shown, "ages": ages.tolist(),
        }  # fmt: skip
        fresh = folder / f"fused-{begin:.0f}.new"  # a process killed meanwhile leaves no half file
        fresh.write_text(json.dumps(figures))
        fresh.replace(fresh.with_suffix(".json"))

    threading.Thread(target=look, daemon=True).start()
    with stopped_by_signals() as stop:
        fusion.run(stop)
    write()


def percentile(ages: Integers, share: float) -> float:
    """Return a percentile, milliseconds, of ages counted by milliseconds."""
    total = ages.sum()
    return float(np.searchsorted(np.cumsum(ages), share * total)) if total else float("nan")


def resident_mb(pid: int) -> float:
    """Return the memory that a process holds now, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process so far, seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def write_site(folder: Path, names: list[str], port: int, *, vehicles: bool) -> None:
    """Write tiles, `SITE.toml` and the broker's files into a new folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    roads = gr.read_map(SAMPLE / "junction.osm")
    gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
    sensors = "".join(f'[[sensor]]\nname = "{name}"\n' for name in names)
    text = f"""
title = "Soak"
[map]
file = "{(SAMPLE / "junction.osm").resolve()}"
[live]
site = "{SITE}"
tiles = "tiles.gpkg"
lateness = "50ms"
vehicles = {str(vehicles).lower()}
[live.broker]
address = "mqtt://127.0.0.1:{port}"
"""
    site = folder / "SITE.toml"
    site.write_text(text + sensors)
    write_broker_files(site, folder / "broker")
    site.write_text(f'{text}password_file = "broker/password_of_fusion"\n{sensors}')
    if os.geteuid() == 0:  # else it would become another user
        with (folder / "broker" / "mosquitto.conf").open("a") as config:
            config.write("user root\n")


def cores_apart() -> tuple[list[int], list[int]]:
    """Return the cores of fusion and broker, and those of the senders; empty: any."""
    if not hasattr(os, "sched_getaffinity"):
        return [], []
    cores = sorted(os.sched_getaffinity(0))
    half = len(cores) // 2
    return cores[:half] or cores, cores[half:]


def start_program(words: list[str], cores: list[int], **options: Any) -> subprocess.Popen[bytes]:
    """Start a program on some cores; on any where none are given."""
    program = subprocess.Popen(words, **options)
    if cores:
        os.sched_setaffinity(program.pid, cores)  # it has no other threads yet
    return program


class Centre:
    """Broker and fusion as processes, which can be killed and start again.

    Parameters
    ----------
    folder : Path
        Folder of the site's files.
    cores : list of int
        Cores that they run on; empty: any.
    """

    def __init__(self, folder: Path, cores: list[int]) -> None:
        self._folder, self._cores = folder, cores
        self._log = (folder / "mosquitto.log").open("ab")
        self._ended_cpu_s = {"broker": 0.0, "fusion": 0.0}
        self.broker = self._started("broker")
        time.sleep(1.0)
        self.fusion = self._started("fusion")

    def _started(self, name: str) -> subprocess.Popen[bytes]:
        if name == "fusion":
            return start_program(
                [sys.executable, __file__, "--fuse", str(self._folder)], self._cores
            )
        words = [mosquitto_here(), "-c", "broker/mosquitto.conf"]
        return start_program(
            words, self._cores, cwd=self._folder, stdout=self._log, stderr=self._log
        )

    def kill(self, name: str) -> None:
        """Kill the broker, fusion, or the worker beside it; start the first two again."""
        if name == "worker":
            pid = self.fusion.pid
            for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
                os.kill(int(each), signal.SIGKILL)
            return
        program: subprocess.Popen[bytes] = getattr(self, name)
        self._ended_cpu_s[name] += cpu_s(program.pid)
        program.kill()
        program.wait()
        setattr(self, name, self._started(name))

    def cpu_s(self, name: str) -> float:
        """Return the CPU time of broker or fusion, with that of killed processes."""
        return self._ended_cpu_s[name] + cpu_s(getattr(self, name).pid)

    def end(self) -> None:
        """Stop both and wait for them, fusion first."""
        for each in (self.fusion, self.broker):
            each.terminate()
            each.wait()
        self._log.close()


def mosquitto_here() -> str:
    """Return the path of Mosquitto, the broker; exit where it is not installed."""
    mosquitto = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if mosquitto is None:
        sys.exit("Mosquitto is not installed: sh tools/get_mosquitto.sh, as root")
    return mosquitto


def soak(
    folder: Path, *, sensors: int, processes: int, seconds: float, vehicles: bool, go_on: bool,
    kills: list[tuple[float, str]],
) -> Figures:  # fmt: skip
    """Run all programs and return the figures; `kills` are times (s) and names of processes."""
    names = [f"S{k:04d}" for k in range(sensors)]
    if not go_on:
        write_site(folder, names, free_port(), vehicles=vehicles)
    load, (own, others) = os.getloadavg(), cores_apart()
    centre, senders = Centre(folder, own), list[subprocess.Popen[bytes]]()
    try:
        time.sleep(5.0)
        shares = [names[k::processes] for k in range(processes)]
        senders += [
            start_program([sys.executable, __file__, "--send", str(folder), "--names", *share,
                     "--sensors", str(sensors), "--seconds", str(seconds)], others)
            for share in shares
        ]  # fmt: skip
        time.sleep(5.0)

        def used_s() -> dict[str, float]:
            of_centre = {name: centre.cpu_s(name) for name in ("broker", "fusion")}
            return of_centre | {f"sender {k}": cpu_s(each.pid) for k, each in enumerate(senders)}

        before, begin, memory, due = used_s(), time.monotonic(), [], sorted(kills)
        while time.monotonic() - begin < seconds - 15.0:
            time.sleep(min(LOOK_S, seconds / 10.0))
            memory.append(resident_mb(centre.broker.pid))
            while due and time.monotonic() - begin >= due[0][0]:
                centre.kill(due.pop(0)[1])
        passed = time.monotonic() - begin
        cores = {name: (value - before[name]) / passed for name, value in used_s().items()}
        for each in senders:
            each.wait()
    finally:
        for each in senders:
            if each.poll() is None:
                each.terminate()
                each.wait()
        centre.end()
    return gather_figures(folder, cores, memory, load) | {
        "sensors": sensors, "seconds": seconds, "processes": processes,
        "cores_of_fusion_and_broker": own, "cores_of_senders": others, "kills": kills,
    }  # fmt: skip


def gather_figures(
    folder: Path, cores: dict[str, float], memory: list[float], load: tuple[float, float, float]
) -> Figures:
    """Return the figures of all programs, read from their files."""
    sent = [json.loads(each.read_text()) for each in sorted(folder.glob("sent-*.json"))]
    runs = [json.loads(each.read_text()) for each in sorted(folder.glob("fused-*.json"))]
    ages = np.sum([each["ages"] for each in runs], axis=0)
    fused = runs[-1]
    recorded = [*folder.glob("live/parts/*/*.parquet"), *folder.glob("live/recordings/*/*.parquet")]
    times = [pq.read_table(each, columns=["time"])["time"].to_numpy() for each in recorded]
    stored = sum(len(np.unique(each)) for each in times)
    rows = [row for each in runs for row in each["rows"]]
    size = sum(each.stat().st_size for each in folder.rglob("*.parquet"))
    return {
        "sent": sum(each["sent"] for each in sent),
        "lost": sum(each["sent"] for each in sent) - stored,
        "stored": stored,
        "frame_to_map_p50_ms": percentile(ages, 0.5),
        "frame_to_map_p99_ms": percentile(ages, 0.99),
        "in_150_ms": float(ages[:151].sum() / ages.sum()),
        "sender_delay_p99_ms": max(each["delay_p99_ms"] for each in sent),
        # senders are late because this machine stands for a hundred sensors' computers
        "sender_delay_by_10_s_ms": [
            round(max(row), 1)
            for row in zip(*(each["delay_by_10_s_ms"] for each in sent), strict=True)
        ],
        "late": sum(each["counts"].get("late_frames", 0) for each in runs),
        "duplicates": sum(each["counts"].get("duplicates", 0) for each in runs),
        "gaps": sum(each["counts"].get("gaps", 0) for each in runs),
        "cores_fusion": cores["fusion"],
        "cores_broker": cores["broker"],
        "cores_senders": sum(value for name, value in cores.items() if "sender" in name),
        "memory_fusion_mb": [round(row["memory_mb"], 1) for row in rows],
        "memory_broker_mb": [round(each, 1) for each in memory],
        "p99_by_10_s_ms": [round(row.get("p99_ms", float("nan")), 1) for row in rows],
        "written_bytes": size,
        "finish_s": fused["finish_s"],
        "start_s": fused["start_s"],
        "figures": fused["figures"],
        "told": fused["told"],
        "load_before": load,
        "cores": os.cpu_count(),
    }


def free_port() -> int:
    """Return a TCP port that no program uses."""
    with socket.socket() as each:
        each.bind(("127.0.0.1", 0))
        return int(each.getsockname()[1])


def main() -> None:
    """Run the soak, or one of its programs (`--send`, `--fuse`)."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--minutes", type=float, default=15.0)
    words.add_argument("--sensors", type=int, default=100)
    words.add_argument("--processes", type=int, default=4)
    words.add_argument("--vehicles", action="store_true")
    words.add_argument("--go-on", action="store_true")
    words.add_argument("--kill", nargs="*", default=[], metavar="MINUTE NAME")
    words.add_argument("--folder", type=Path, default=Path("out/soak"))
    words.add_argument("--out", type=Path, default=OUT)
    for name in ("--send", "--fuse"):
        words.add_argument(name, type=Path, help=argparse.SUPPRESS)
    words.add_argument("--names", nargs="*", help=argparse.SUPPRESS)
    words.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    given = words.parse_args()
    if given.fuse:
        fuse(given.fuse)
    elif given.send:
        send(given.send, given.names, given.sensors, given.seconds)
    else:
        found = soak(
            given.folder, sensors=given.sensors, processes=given.processes,
            seconds=given.seconds or 60.0 * given.minutes, vehicles=given.vehicles,
            go_on=given.go_on,
            kills=[(60.0 * float(at), name) for at, name in
                   zip(given.kill[::2], given.kill[1::2], strict=True)],
        )  # fmt: skip
        given.out.parent.mkdir(exist_ok=True)
        given.out.write_text(json.dumps(found, indent=1))
        sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()

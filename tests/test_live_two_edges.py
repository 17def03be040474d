"""Live over two edges of hours, killed again and again: nothing that was stored is lost.

Frames keep the times of a recording, so two edges of hours pass in minutes. Each piece of it is
sent once: what a sensor had not stored when it was killed never comes again.
"""

import itertools
import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from live_programs import (
    Program,
    assert_equal_to_batch,
    frames_on_disk,
    frames_that_wait,
    takes_long,
)
from live_site import OF_THE_SAMPLE, SAMPLE, LiveSite, needs_mosquitto, wait_for

from gis_radar.dataset import read_hours
from gis_radar.live import HOUR_US

NAMES = ("R1", "R2")
EDGES_US = [(486_112 + k) * HOUR_US for k in range(2)]  # 2025-06-15T16Z and an hour later
PIECES, PIECE_S = 4, 25.0  # of a sample of 100 s, whose middle is at the edge
SPEED = 2.5
pytestmark = [needs_mosquitto, takes_long]


@pytest.fixture
def site(tmp_path, once):
    """Give the sample's junction with vehicles, its broker running."""
    made = LiveSite(tmp_path, once, names=NAMES, vehicles="true",
                    of_live=OF_THE_SAMPLE + '\nevery = "1s"')  # fmt: skip
    made.broker.start()
    yield made
    made.broker.kill()


def pieces_of(folder, name):
    """Write the sample in pieces, its middle at one edge of hours and the next; return them."""
    rows = pd.read_parquet(SAMPLE / f"{name}.parquet")
    first = min(pd.read_parquet(SAMPLE / f"{each}.parquet")["time"].iloc[0] for each in NAMES)
    paths = []
    for edge_us, piece in itertools.product(EDGES_US, range(PIECES)):
        since = rows["time"] - first
        mine = rows[(since >= piece * PIECE_S) & (since < (piece + 1) * PIECE_S)]
        begin_s = edge_us / 1e6 - PIECES * PIECE_S / 2
        paths.append(folder / f"{name}-{len(paths)}.parquet")
        mine.assign(time=(since + begin_s)[mine.index]).to_parquet(paths[-1], index=False)
    return paths


def kill_workers(program):
    """Kill the processes of fusion that measure and follow vehicles; return their number."""
    killed = 0
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = path.joinpath("stat").read_text().rpartition(")")[2].split()[1]
            words = path.joinpath("cmdline").read_bytes()
        except OSError:
            continue
        if int(parent) == program.process.pid and b"spawn_main" in words:
            os.kill(int(path.name), signal.SIGKILL)
            killed += 1
    return killed


class Killed:
    """Fusion and two sensors as programs; what each had stored when it was killed."""

    def __init__(self, site):
        self.site, self.rng = site, np.random.default_rng(5)
        self.pieces = {name: pieces_of(site.folder, name) for name in NAMES}
        self.stored = {name: set() for name in NAMES}
        self.kills = dict.fromkeys(("edge", "fusion", "broker", "job"), 0)
        self.edges = {}
        self.start_fusion()

    def start_fusion(self):
        self.fusion = Program(self.site.folder, "live", self.site.file)
        wait_for(lambda: self.fusion.told("linked"))

    def play(self, piece):
        """Let the sensors send a piece; those that sent one before are over or were killed."""
        for name in NAMES:
            source = f'recording = "{self.pieces[name][piece]}"\nspeed = {SPEED}'
            self.edges[name] = Program(
                self.site.folder, "edge", self.site.edge(name, source=source)
            )
        for each in self.edges.values():
            wait_for(lambda each=each: each.told("linked"))

    def kill(self, what):
        """Kill in the midst of a piece, and note what is stored."""
        time.sleep(self.rng.uniform(1.0, 5.0))
        self.kills[what] += 1
        if what == "edge":
            for name, each in self.edges.items():
                each.kill()
                self.stored[name] |= frames_that_wait(self.site.folder / f"{name}.buffer")
        elif what == "fusion":
            self.fusion.kill()
            for name in NAMES:
                self.stored[name] |= frames_on_disk(self.site.folder, name)
            self.start_fusion()
        elif what == "broker":
            self.site.broker.kill()
            time.sleep(1.0)
            self.site.broker.start()
        else:
            wait_for(lambda: kill_workers(self.fusion))


def test_two_edges_of_hours_with_kills_lose_nothing_and_equal_the_batch(site):
    system = Killed(site)
    kinds = ("fusion", "job", "edge", "broker", "fusion", "job", "edge", "broker")
    for piece, kind in enumerate(kinds):
        system.play(piece)
        system.kill(kind)
        if kind != "edge":
            for each in system.edges.values():
                each.wait()  # until all it has is acknowledged
        for name in NAMES:
            system.stored[name] |= frames_on_disk(site.folder, name)
    hours = [edge // HOUR_US - 1 for edge in EDGES_US] + [EDGES_US[-1] // HOUR_US]
    wait_for(lambda: sorted(read_hours(site.folder / "live" / "dataset")) == hours)
    system.kill("job")
    last = {name: frames_that_wait(site.folder / f"{name}.buffer") for name in NAMES}
    system.fusion.end()
    found = {name: frames_on_disk(site.folder, name) for name in NAMES}
    lost = {name: len(system.stored[name] - found[name] - last[name]) for name in NAMES}
    waits = {name: len(last[name]) for name in NAMES}
    frames = {name: len(found[name]) for name in NAMES}
    print(json.dumps({"kills": system.kills, "lost": lost, "waits": waits, "frames": frames}))  # noqa: T201
    assert not any(lost.values())
    assert all(len(each) > 2500 for each in found.values())
    assert_equal_to_batch(site, NAMES, hits_only=False)

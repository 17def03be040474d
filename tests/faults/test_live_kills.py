"""`kill -9` of a sensor's program and of fusion at random: nothing is lost, or counts twice.

With a real broker; a minute of work, which only `make faults` does.
"""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from live_programs import assert_all_recorded, assert_equal_to_batch
from live_site import SAMPLE, LiveSite, needs_mosquitto

from faults.conftest import ROOT
from faults.test_faults import ALL

KILLS = 10
LONGEST_S = 900.0
pytestmark = [needs_mosquitto, pytest.mark.skipif(not ALL, reason="make faults")]


class Program:
    """A command that runs until it is killed, and begins again."""

    def __init__(self, *words):
        self.words, self.killed = [sys.executable, "-m", "gis_radar", *map(str, words)], 0
        self.begin()

    def begin(self):
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            self.words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def kill(self):
        if self.process.poll() is None:
            self.process.kill()
            self.killed += 1
        self.process.wait()
        self.begin()


@pytest.mark.parametrize("seed", [1, 2])
def test_hours_equal_the_batch_whatever_is_killed(tmp_path, once, seed):
    site = LiveSite(tmp_path, once, recordings=SAMPLE)
    site.broker.start()
    fusion = Program("live", site.file)
    edge = Program("edge", site.edge("R1", source="speed = 5.0"))
    try:
        chance = random.Random(seed)  # noqa: S311 - moments
        for _ in range(KILLS):
            time.sleep(chance.uniform(0.0, 8.0))
            chance.choice((fusion, edge)).kill()
        assert edge.process.wait(LONGEST_S) == 0  # it ends once fusion has stored all
        fusion.process.send_signal(signal.SIGTERM)
        fusion.process.wait(LONGEST_S)
    finally:
        for each in (fusion, edge):
            each.process.kill()
            each.process.wait()
        site.broker.kill()
    sys.stderr.write(f"kill: live: {fusion.killed} of fusion, {edge.killed} of the edge\n")
    assert_all_recorded(site, ["R1"])
    assert_equal_to_batch(site, ["R1"])

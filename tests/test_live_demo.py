"""`make live-demo`: all its programs run, and none is left behind by a stop."""

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from live_programs import takes_long
from live_site import LONGEST_S, needs_mosquitto, wait_for

ROOT = Path(__file__).parents[1]


def is_open(port):
    with socket.socket() as each:
        return each.connect_ex(("127.0.0.1", port)) == 0


@takes_long
@needs_mosquitto
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_ends_all_programs_and_writes_the_hour(tmp_path, number):
    words = [sys.executable, ROOT / "tools" / "live_demo.py", tmp_path / "live-demo"]
    said = tmp_path / "said"
    with said.open("wb") as out:
        demo = subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT)
    try:
        wait_for(lambda: re.search(r'frames_total{sensor="R1"} [1-9]', said.read_text()))
        ports = [int(each) for each in re.findall(r"127\.0\.0\.1:(\d+)", said.read_text())]
        assert all(map(is_open, ports))
        demo.send_signal(number)
        assert demo.wait(LONGEST_S) == 0, said.read_text()
    finally:
        demo.kill()
        demo.wait()
    assert "stopping; the hour is being written" in said.read_text()
    assert not any(map(is_open, ports))
    assert list((tmp_path / "live-demo" / "live").rglob("*.parquet"))

"""`make live-demo`: all its programs run, and none is left behind by a stop."""

import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from live_programs import takes_long
from live_site import LONGEST_S, needs_mosquitto

ROOT = Path(__file__).parents[1]


def is_open(port):
    with socket.socket() as each:
        return each.connect_ex(("127.0.0.1", port)) == 0


@takes_long
@needs_mosquitto
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_ends_all_programs_and_writes_the_hour(tmp_path, number):
    words = [sys.executable, ROOT / "tools" / "live_demo.py", tmp_path / "live-demo"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
    ) as demo:
        said = []
        for line in demo.stdout:
            said.append(line)
            if re.search(r'frames_total{sensor="R1"} [1-9]', line):
                break
        ports = [int(each) for each in re.findall(r"127\.0\.0\.1:(\d+)", "".join(said))]
        assert all(map(is_open, ports))
        demo.send_signal(number)
        rest, _ = demo.communicate(timeout=LONGEST_S)
        assert demo.returncode == 0, "".join(said) + rest
    assert "stopping; the hour is written" in rest
    assert not any(map(is_open, ports))
    assert list((tmp_path / "live-demo" / "live").rglob("*.parquet"))

"""`make live-demo`: all its programs run, and none is left behind by a stop."""

import importlib.util
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from live_programs import takes_long
from live_site import LONGEST_S, is_open, needs_mosquitto, wait_for

from gis_radar.live import read_edge_file, read_live_site

ROOT = Path(__file__).parents[1]


def test_its_files_have_the_keys_that_the_programs_read(tmp_path):
    spec = importlib.util.spec_from_file_location("live_demo", ROOT / "tools" / "live_demo.py")
    demo = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(demo)
    demo.write_files(tmp_path, 1883, 8080)
    assert read_live_site(tmp_path / "SITE.toml").live.site == "junction"
    for name in demo.SENSORS:
        assert read_edge_file(tmp_path / f"{name}.toml").sensor == name


@takes_long
@needs_mosquitto
@pytest.mark.parametrize(
    ("number", "times"), [(signal.SIGINT, 1), (signal.SIGTERM, 1), (signal.SIGINT, 2)]
)
def test_a_stop_ends_all_programs_and_records_what_came(tmp_path, number, times):
    """The first stop has it recorded, the second waits for nothing; both leave no program."""
    words = [sys.executable, ROOT / "tools" / "live_demo.py", tmp_path / "live-demo"]
    said = tmp_path / "said"
    with said.open("wb") as out:
        demo = subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT)
    try:
        wait_for(lambda: re.search(r'frames_total{sensor="R1"} [1-9]', said.read_text()))
        ports = [int(each) for each in re.findall(r"127\.0\.0\.1:(\d+)", said.read_text())]
        assert all(map(is_open, ports))
        demo.send_signal(number)
        if times > 1:
            wait_for(lambda: "stopping" in said.read_text())
            demo.send_signal(number)
        assert demo.wait(LONGEST_S) == 0, said.read_text()
    finally:
        demo.kill()
        demo.wait()
    assert "stopping; what came is being recorded" in said.read_text()
    assert "Traceback" not in said.read_text()
    assert not any(map(is_open, ports))
    assert times > 1 or list((tmp_path / "live-demo" / "live").rglob("*.parquet"))

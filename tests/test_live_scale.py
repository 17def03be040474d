"""A hundred sensors for a minute, as `make soak` runs them for longer: nothing is lost."""

import json
import subprocess
import sys
from pathlib import Path

from live_programs import takes_long
from live_site import needs_mosquitto

ROOT = Path(__file__).parents[1]


@needs_mosquitto
@takes_long
def test_a_hundred_sensors_for_a_minute_lose_nothing(tmp_path):
    """Clients spread over processes; times are told, not judged: the machine may be busy."""
    out = tmp_path / "soak.json"
    words = ["--seconds", "60", "--folder", tmp_path / "soak", "--out", out]
    subprocess.run(
        [sys.executable, ROOT / "bench" / "live_soak.py", *map(str, words)], check=True,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    found = json.loads(out.read_text())
    assert (found["sent"], found["lost"]) == (100 * 60 * 20, 0)
    assert found["cores_fusion"] < 0.9
    memory = found["memory_fusion_mb"]
    assert memory[-1] <= 1.1 * memory[len(memory) // 2]

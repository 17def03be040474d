"""One runner of commands and one set of inputs for all faults."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SECONDS, BYTES = 60.0, 4 << 30  # of the processor
WHOLE_S = 600.0  # of the clock, for what hangs and does nothing


class Runner:
    """Runs commands in processes with limits, one after the other."""

    def __init__(self):
        environment = dict(os.environ) | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        environment |= {"OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg", "COLUMNS": "200"}
        environment["PYTHONPATH"] = str(ROOT)
        self.process = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("runner.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment,
        )  # fmt: skip

    def run(self, folder, words, **limits):
        """Run a command in a folder; return its code, seconds and what it printed."""
        place = folder / "printed"
        place.mkdir(exist_ok=True)
        case = {"words": words, "seconds": WHOLE_S, "processor_s": SECONDS, "bytes": BYTES}
        case |= limits
        case |= {name: str(place / name) for name in ("out", "err")}
        for name in ("out", "err"):  # killed before it opens them, it has printed nothing
            (place / name).write_bytes(b"")
        self.process.stdin.write(json.dumps(case) + "\n")
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        texts = {name: (place / name).read_text(errors="replace") for name in ("out", "err")}
        return answer | texts

    def close(self):
        self.process.stdin.close()
        self.process.wait(timeout=300)
        self.process.stdout.close()


@pytest.fixture(scope="session")
def runner():
    runner = Runner()
    yield runner
    runner.close()


@pytest.fixture(scope="session")
def inputs(sound_inputs):
    return sound_inputs

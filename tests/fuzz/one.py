"""Fuzz one target in this process: ``python -m fuzz.one NAME FOLDER SECONDS``.

The folder holds the sound inputs, the corpus and the findings of all targets. An exception is kept
and the search goes on; what ends the process (an abort, no memory, a minute without an end) leaves
its bytes to who started it.
"""

from __future__ import annotations

import logging
import os
import pkgutil
import resource
import shutil
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import atheris

BYTES = 4 << 30  # of address space
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - files there cost no disk
WHOLE_S = 1800  # of the clock: as the machine may be busy, the processor's seconds count, see Bench
SLOWEST = 100  # times longer than its processor's seconds that a target may take by the clock


def main() -> None:
    """Fuzz the target that the words name."""
    name, folder, seconds = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    os.environ["NUMBA_DISABLE_JIT"] = "1"  # compiled code has no coverage
    with atheris.instrument_imports(include=["gis_radar", "rosbags", "laspy"]):
        targets = import_module("fuzz.targets")
        import gis_radar

        for module in pkgutil.iter_modules(gis_radar.__path__, "gis_radar."):
            if module.name not in {"gis_radar.__main__", "gis_radar.cli"}:
                import_module(module.name)
        with _copied(folder / "inputs") as inputs:
            fuzz(targets.TARGETS[name], inputs, folder, seconds)


def _copied(inputs: Path) -> Any:
    where = SHARED_MEMORY if SHARED_MEMORY.is_dir() else None
    place = tempfile.TemporaryDirectory(dir=where, prefix="gis_radar_fuzz_")
    shutil.copytree(inputs, place.name, dirs_exist_ok=True)
    return place


def fuzz(target: Any, inputs: Path, folder: Path, seconds: int) -> None:
    """Fuzz a target; this does not return, and ends with a line `ran` and how many files.

    Parameters
    ----------
    target : Target
        The target.
    inputs : str
        A folder of sound inputs that is the target's own.
    folder : Path
        Where corpus and findings are kept, and their files.
    seconds : int
        Of the processor's time.
    """
    from fuzz.targets import Bench
    from gis_radar.base import go_offline

    go_offline()
    logging.disable()
    corpus, found = (folder / what / target.name.replace(" ", "-") for what in ("corpus", "found"))
    for place in (corpus, found):
        place.mkdir(parents=True, exist_ok=True)
    bench = Bench(target, Path(inputs))
    for number, seed in enumerate(target.seeds(Path(inputs))):
        (corpus / f"seed-{number}").write_bytes(seed)
        bench.run(seed)  # what is imported late is instrumented, too

    ran, end = 0, time.process_time() + seconds

    def once(data: bytes) -> None:
        nonlocal ran
        ran += 1
        finding = bench.run(data)
        if finding and not (found / finding.name).exists():
            (found / finding.name).write_bytes(data)
            (found / f"{finding.name}.txt").write_text(finding.text, errors="replace")
        if time.process_time() > end:
            if SHARED_MEMORY in Path(inputs).parents:
                shutil.rmtree(inputs)
            sys.stderr.write(f"\nran {ran}\n")
            sys.stderr.flush()
            os._exit(0)

    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    words = [f"-max_total_time={SLOWEST * seconds}", f"-timeout={WHOLE_S}", "-rss_limit_mb=4096",
             f"-artifact_prefix={found}/", "-report_slow_units=60", str(corpus)]  # fmt: skip
    atheris.Setup([sys.argv[0], *words], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()

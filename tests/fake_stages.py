"""Stages of fake work, and their execution; run as a program for tests that kill it."""

from __future__ import annotations

import json
import queue
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import fake_work

from gis_radar.base import QUIET, Reporter, only_writer
from gis_radar.site import Pool, RunState, Stage, process_pool
from gis_radar.site.execution import Execution


def stage(root, name, inputs=(), *, work="join", parts=(), sensor="", **options):
    """A stage that makes root/name from files, or from the outputs of other stages."""
    return Stage(
        name=name,
        work=getattr(fake_work, work),
        inputs={"first": tuple(Path(root) / each for each in inputs)},
        parts={"second": tuple(Path(root) / each for each in parts)} if parts else {},
        options={"text": name, **options},
        outputs=(Path(root) / name,),
        sensor=sensor,
    )


def diamond(root, source, **options):
    """A road, two sensors on it, and what is made of both."""
    return [
        stage(root, "road", [source], **options),
        stage(root, "a1", ["road"], sensor="a", **options),
        stage(root, "b1", ["road"], sensor="b", **options),
        stage(root, "a2", ["a1"], sensor="a", **options),
        stage(root, "b2", ["b1"], sensor="b", **options),
        stage(root, "map", ["road"], parts=["a2", "b2"], **options),
    ]


@contextmanager
def threads(most, _scratch):
    """The same as `process_pool` in this process: any executor does."""
    events = queue.SimpleQueue()
    with ThreadPoolExecutor(most) as executor:
        yield Pool(executor=executor, send=events.put, events=events)


def execute(stages, root, *, most=1, reporter=QUIET, pool=threads, site=None):
    """Execute stages in a folder; return how each ended, by name."""
    folder = Path(root) / ".gis-radar"
    (folder / "scratch").mkdir(parents=True, exist_ok=True)
    state = RunState(folder / "state.json", Path(root))
    with (
        only_writer(Path(root), lock=folder / "lock", reporter=reporter),
        pool(most, folder / "scratch") as workers,
    ):
        run = Execution(stages=stages, state=state, pool=workers, reporter=reporter, folder=site)
        return {outcome.stage.name: outcome for outcome in run.run()}


class Printing(Reporter):
    """Prints progress, so that a test knows when to kill."""

    def progress(self, stage, done, total):
        sys.stdout.write(json.dumps([stage, done, total]) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    made = diamond(sys.argv[1], Path(sys.argv[2]), wait_s=float(sys.argv[3]))
    execute(made, sys.argv[1], most=2, reporter=Printing(), pool=process_pool)

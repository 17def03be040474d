"""Stages of fake work, and their execution; run as a program for tests that kill it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from gis_radar.files import only_writer
from gis_radar.progress import QUIET, Reporter
from gis_radar.site.contents import Contents
from gis_radar.site.execution import Execution
from gis_radar.site.records import Records
from gis_radar.site.stage import Stage
from gis_radar.site.workers import Workers


def stage(root, name, inputs=(), *, work="join", parts=(), sensor="", **options):
    """A stage that makes root/name from files, or from the outputs of other stages."""
    return Stage(
        name=name,
        work=work,
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


def execute(stages, root, *, most=1, reporter=QUIET):
    """Execute stages in a folder; return how each ended, by name."""
    state = Path(root) / ".gis-radar"
    (state / "stages").mkdir(parents=True, exist_ok=True)
    (state / "scratch").mkdir(exist_ok=True)
    contents = Contents(state / "contents.json")
    with only_writer(Path(root), lock=state / "lock", reporter=reporter):
        outcomes = Execution(
            stages=stages,
            root=Path(root),
            records=Records(state / "stages", Path(root)),
            contents=contents,
            workers=Workers(most, state / "scratch", works="fake_work"),
            reporter=reporter,
        ).run()
    return {outcome.stage.name: outcome for outcome in outcomes}


class Teller(Reporter):
    """Prints progress, so that a test knows when to kill."""

    def progress(self, stage, done, total):
        sys.stdout.write(json.dumps([stage, done, total]) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    made = diamond(sys.argv[1], Path(sys.argv[2]), wait_s=float(sys.argv[3]))
    execute(made, sys.argv[1], most=2, reporter=Teller())

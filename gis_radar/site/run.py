"""A run of a site: the whole way from its raw data to heat maps, taken up where one ended."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.errors import GisRadarError, InputError, NoAnswerError, OutputError, UsageError
from gis_radar.files import only_writer, refuse_inputs
from gis_radar.notebooks import card
from gis_radar.progress import QUIET, Reporter
from gis_radar.site.execution import Execution, discard
from gis_radar.site.plan import OWNED, Outcome, Stage, report_of, stages_of
from gis_radar.site.settings import Site, read_site
from gis_radar.site.state import RunState
from gis_radar.site.summary import run_figures, write_summary
from gis_radar.site.worker import process_pool

STATE = ".gis-radar"
_MEMORY_EACH = 1 << 30  # bytes for one worker: what localizing a sensor takes, rounded up


@dataclass(frozen=True, kw_only=True)
class SiteRun:
    """Results of a run of a site.

    Parameters
    ----------
    site : Site
        The site.
    folder : Path
        Where the results are.
    outcomes : sequence of Outcome
        How each stage ended.
    """

    site: Site
    folder: Path
    outcomes: Sequence[Outcome]

    @property
    def outputs(self) -> list[Path]:
        """What is there now, as paths below `folder`."""
        root = self.folder.resolve()
        made = [p for each in self.outcomes if each.has_result for p in each.stage.outputs]
        made = [self.folder / p.resolve().relative_to(root) for p in made]
        return [*made, self.folder / "run.json", self.folder / "summary.md"]

    @property
    def missing(self) -> dict[str, GisRadarError]:
        """The sensors without a result, and why."""
        return {
            each.stage.sensor: each.error
            for each in reversed(self.outcomes)
            if each.stage.sensor and each.error is not None
        }

    @property
    def failure(self) -> GisRadarError | None:
        """What a program should know if not every sensor has a result; else None.

        An :class:`InputError` where data were bad, a :class:`NoAnswerError` where no trustworthy
        answer was found.
        """
        missing = self.missing
        if not missing:
            return None
        made_of = [each.name for each in self.site.sensor if each.name not in missing]
        bad = [name for name, error in missing.items() if not isinstance(error, NoAnswerError)]
        first = (bad or list(missing))[0]
        rest = (
            f"the heat maps show {', '.join(made_of)} only" if made_of else "there is no heat map"
        )
        kind = InputError if bad else NoAnswerError
        lost = ", ".join(sorted(missing))
        reason = missing[first].message.removeprefix(f"{first}: ")
        return kind(
            f"no result for {lost}; {rest}; {first}: {reason}",
            hint=missing[first].hint,
        )

    def figures(self) -> Mapping[str, Any]:
        """Return figures worth a look, by name."""
        return run_figures(self.outcomes, self.site)

    def __repr__(self) -> str:
        lost = [f"; no result for {name}: {why.message}" for name, why in self.missing.items()]
        return f"SiteRun({self.site!r}, {len(self.outcomes)} stages, {self.folder}{''.join(lost)})"

    def _repr_html_(self) -> str:
        return card(f"Run of {self.site.title or self.site.path}", self.figures())


def run_site(
    path: str | Path,
    folder: str | Path,
    *,
    jobs: int | None = None,
    fresh: bool = False,
    reporter: Reporter = QUIET,
) -> SiteRun:
    """Go the whole way for all sensors of a site: road, tiles, poses, occupancy, heat maps.

    Stages that an earlier run into the same folder has done are not done again, unless what they
    read, their settings or the software changed. A sensor without a trustworthy answer, or with bad
    data, does not stop the others.

    Parameters
    ----------
    path : str or Path
        The site file, see :func:`read_site`.
    folder : str or Path
        Where the results go.
    jobs : int, optional
        How many stages at once; by default as many as the machine has cores and memory for.
    fresh : bool
        Do all again, whatever is there.
    reporter : Reporter
        Shows how far the work is.

    Returns
    -------
    SiteRun
        Its `failure` is set where a sensor has no result.

    Raises
    ------
    InputError
        If the site file, a scan or the map is bad.
    OutputError
        If the folder cannot be written, holds other files, or another run works in it.
    UsageError
        If `jobs` is less than 1.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs is {jobs}, expected 1 or more")
    site, root = read_site(path), Path(folder).absolute()
    refuse_inputs(root, site.path, *site.inputs)
    stages, last = stages_of(site, root), report_of(site, root)
    state = _prepared(root)
    with ExitStack() as stack:
        stack.enter_context(only_writer(Path(folder), lock=state / "lock", reporter=reporter))
        scratch = _cleared(root, state)
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        kept = RunState(state / "state.json", root)
        _forget(kept, [*stages, last], fresh=fresh, reporter=reporter)
        _hash_inputs(site, kept, reporter)
        write_summary(site, root, (), kept)
        pool = stack.enter_context(process_pool(jobs or workers_here(), scratch))
        try:
            first = Execution(stages=stages, state=kept, pool=pool, reporter=reporter)
            outcomes = first.run()
            write_summary(site, root, outcomes, kept)
            # The report describes the other stages, so it is made once they have ended.
            second = Execution(stages=[*stages, last], state=kept, pool=pool, reporter=reporter)
            outcomes = second.run(outcomes)
        except KeyboardInterrupt:
            reporter.log("stopped; what is done stays done: the same call goes on from there")
            raise
        kept.save()
    return SiteRun(site=site, folder=Path(folder), outcomes=outcomes)


def _prepared(root: Path) -> Path:
    """Make the folders of a run; refuse a folder that holds something else."""
    state = root / STATE
    try:
        if root.is_dir() and not state.is_dir():
            foreign = [p.name for p in sorted(root.iterdir()) if not p.name.startswith(OWNED)]
            if foreign:
                raise OutputError(
                    f"{root}: holds {foreign[0]!r}, which is not part of a run",
                    hint="name a new or an empty folder",
                )
        state.mkdir(parents=True, exist_ok=True)
        (state / ".gitignore").write_text("*\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{root}: cannot be written: {error.strerror or error}") from error
    return state


def _cleared(root: Path, state: Path) -> Path:
    """Remove what a killed run left half-made; return an empty folder for temporary files."""
    halves = [each for pattern in (".*.part", ".*.before") for each in root.rglob(pattern)]
    for leftover in (*halves, state / "stages"):  # the latter of version 0.1
        shutil.rmtree(leftover, ignore_errors=True)
    (state / "contents.json").unlink(missing_ok=True)
    scratch = state / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    return scratch


def _forget(state: RunState, stages: Sequence[Stage], *, fresh: bool, reporter: Reporter) -> None:
    """Forget stages that are no more, with their results; all of them where all is done again."""
    names = {stage.name for stage in stages}
    made = {path for stage in stages for path in stage.outputs}
    for name in sorted(state.records):
        if name not in names or fresh:
            outputs = [path for path in state.forget(name) if path not in made]
            discard(outputs)
            if name not in names and outputs:
                reporter.log(f"{name}: no longer part of the site, its results were removed")


def _hash_inputs(site: Site, state: RunState, reporter: Reporter) -> None:
    """Hash what the run reads; what was read before and has not changed takes no time."""
    files = list(dict.fromkeys(site.inputs))
    total, done = sum(path.stat().st_size for path in files), 0

    def count(size: int) -> None:
        nonlocal done
        done += size
        reporter.progress("looking at the inputs", done, total)

    for path in files:
        state.hash_of(path, count)
    reporter.progress("looking at the inputs", total, total)


def workers_here() -> int:
    """Return how many workers this machine has cores and memory for."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    memory = _free_memory()
    return cores if memory is None else max(1, min(cores, memory // _MEMORY_EACH))


def _free_memory() -> int | None:
    """Return the bytes that new processes may use; None where the system does not state it."""
    group = Path("/sys/fs/cgroup")
    found = []
    with suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        named = dict(line.split(":", 1) for line in lines)
        found.append(int(named["MemAvailable"].split()[0]) * 1024)
    with suppress(OSError, ValueError):
        most = int((group / "memory.max").read_text(encoding="ascii"))
        found.append(most - int((group / "memory.current").read_text(encoding="ascii")))
    return min(found, default=None)

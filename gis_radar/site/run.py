"""A run of a site: the whole way from its raw data to heat maps, taken up where one ended."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gis_radar.errors import GisRadarError, InputError, NoAnswerError, OutputError, UsageError
from gis_radar.files import only_writer, refuse_inputs
from gis_radar.notebooks import card
from gis_radar.progress import QUIET, Reporter
from gis_radar.site.contents import Contents
from gis_radar.site.execution import Execution, discard
from gis_radar.site.plan import OWNED, report_of, stages_of
from gis_radar.site.records import Records
from gis_radar.site.site import Site, read_site
from gis_radar.site.stage import Outcome, Stage
from gis_radar.site.summary import figures_of, write_summary
from gis_radar.site.workers import Workers, workers_here

STATE = ".gis-radar"


@dataclass(frozen=True, kw_only=True)
class SiteRun:
    """What a run made of a site.

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
        return figures_of(self.outcomes, self.site)

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
        Hears how far the work is.

    Returns
    -------
    SiteRun
        Its `failure` says whether any sensor has no result.

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
        contents = Contents(state / "contents.json")
        records = Records(state / "stages", root)
        _forget(records, [*stages, last], fresh=fresh, reporter=reporter)
        _look_at(site, contents, reporter)
        write_summary(site, root, (), contents)
        executions = (
            Execution(
                stages=some,
                root=root,
                records=records,
                contents=contents,
                workers=Workers(jobs or workers_here(), scratch),
                reporter=reporter,
            )
            for some in (stages, [*stages, last])
        )
        try:
            outcomes = next(executions).run()
            write_summary(site, root, outcomes, contents)
            # The report tells of the other stages, so it comes once they are all told of.
            outcomes = next(executions).run(outcomes)
        except KeyboardInterrupt:
            reporter.log("stopped; what is done stays done: the same call goes on from there")
            raise
        contents.save()
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
        (state / "stages").mkdir(parents=True, exist_ok=True)
        (state / ".gitignore").write_text("*\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{root}: cannot be written: {error.strerror or error}") from error
    return state


def _cleared(root: Path, state: Path) -> Path:
    """Remove what a killed run left half-made; return an empty folder for temporary files."""
    for pattern in (".*.part", ".*.before"):
        for leftover in [*root.rglob(pattern)]:
            shutil.rmtree(leftover, ignore_errors=True)
    scratch = state / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    return scratch


def _forget(records: Records, stages: Sequence[Stage], *, fresh: bool, reporter: Reporter) -> None:
    """Forget stages that are no more, with their results; all of them where all is done again."""
    kept = {path for stage in stages for path in stage.outputs}
    for name in records.names():
        gone = name not in {stage.name for stage in stages}
        if gone or fresh:
            outputs = [path for path in records.forget(name) if path not in kept]
            discard(outputs)
            if gone and outputs:
                reporter.log(f"{name}: no longer part of the site, its results were removed")


def _look_at(site: Site, contents: Contents, reporter: Reporter) -> None:
    """Hash what the run reads; what was read before and has not changed takes no time."""
    files = list(dict.fromkeys(site.inputs))
    total, done = sum(path.stat().st_size for path in files), 0

    def count(size: int) -> None:
        nonlocal done
        done += size
        reporter.progress("looking at the inputs", done, total)

    for path in files:
        contents.of(path, count)
    reporter.progress("looking at the inputs", total, total)

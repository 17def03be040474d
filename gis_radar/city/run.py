"""Run a city: make what is missing or out of date of all its sites, on one machine or a cluster.

A run has three steps, each of independent tasks: new recordings are registered, hours are made,
oldest first, and tables of dates and reports are updated. What fails stops no other site.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    Reporter,
    Text,
    card,
    only_writer,
    output_errors,
    refuse_foreign,
    with_texts,
    write_json,
    zone_of,
)
from gis_radar.city.executors import Workers, workers_of
from gis_radar.city.month_page import MONTH_PAGE, write_month_page
from gis_radar.city.settings import CityFile, read_city_file
from gis_radar.city.tasks import (
    Failure,
    SiteTask,
    add_recordings,
    is_older,
    make_site_hour,
    update_site,
)
from gis_radar.dataset import (
    Manifest,
    OpenHours,
    hour_begin,
    hour_text,
    listed_hours,
    open_hours,
    site_folders,
)
from gis_radar.site import STATE, software

_OWNED = (STATE, "site=", "results", "poses", "recordings", "run.json", MONTH_PAGE)
_REGISTRY_EVERY_S = 10.0  # seconds between writes of a site's registry
_HOURS = Text("hours")


@dataclass(kw_only=True)
class SiteOutcome:
    """Outcome of a site of a city.

    Parameters
    ----------
    hours : int
        Number of hours made.
    failures : list of Failure
        Names of what has no result, with the errors.
    warnings : list of str
        Warnings.
    """

    hours: int = 0
    failures: list[Failure] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class CityRun:
    """Results of a run of a city.

    Parameters
    ----------
    city : CityFile
        The city.
    root : Path
        Folder of its datasets.
    sites : mapping
        Outcome of each site.
    """

    city: CityFile
    root: Path
    sites: Mapping[str, SiteOutcome]

    @property
    def outputs(self) -> list[Path]:
        """Datasets and results that exist now."""
        tasks = [_task(self.root, self.city, each.name) for each in self.city.site]
        made = [each.dataset for each in tasks if Manifest.is_there(each.dataset)]
        made += [path for path in [self.root / MONTH_PAGE] if path.exists()]
        return [*made, self.root / "run.json"]

    @property
    def failure(self) -> GisRadarError | None:
        """Error about the sites that lack a result; None if there are none."""
        lacking = {name: each.failures for name, each in self.sites.items() if each.failures}
        if not lacking:
            return None
        errors = [error for failures in lacking.values() for _, error in failures]
        kind = NoAnswerError if all(isinstance(e, NoAnswerError) for e in errors) else InputError
        parts = [
            kind("{}", _line(name, failure), hint=failure[1].hint)
            for name, failures in lacking.items() for failure in failures
        ]  # fmt: skip
        return kind(
            "{} of {} sites lack a result: {}", len(lacking), len(self.sites), parts[0].message,
            hint=parts[0].hint, parts=parts if len(parts) > 1 else (),
        )  # fmt: skip

    def figures(self) -> Mapping[str, Any]:
        """Return key figures by name."""
        return {
            "title": self.city.title,
            "sites": len(self.sites),
            "hours_made": sum(each.hours for each in self.sites.values()),
            "failed": [
                _line(name, failure)
                for name, each in self.sites.items() for failure in each.failures
            ],
            "warnings": sum(len(each.warnings) for each in self.sites.values()),
        }  # fmt: skip

    def __repr__(self) -> str:
        return f"CityRun({self.city.title!r}, {len(self.sites)} sites, {self.root})"

    def _repr_html_(self) -> str:
        return card(f"Run of {self.city.title}", self.figures())


def run_city(
    path: str | Path,
    root: str | Path,
    *,
    jobs: int | None = None,
    executor: str | None = None,
    reporter: Reporter = QUIET,
) -> CityRun:
    """Make what is missing or out of date of the sites of a city.

    Parameters
    ----------
    path : str or Path
        The city file, see :func:`read_city_file`.
    root : str or Path
        Folder of the datasets, `ROOT/site=NAME/`; all workers see it under the same name.
    jobs : int, optional
        Number of processes; by default as many as the machine has cores and memory for.
    executor : str, optional
        Address of a Dask scheduler whose workers do the work instead.
    reporter : Reporter
        Receives progress, remarks, and each failure as it comes.

    Returns
    -------
    CityRun
        Its `failure` is set where a site lacks a result.

    Raises
    ------
    InputError
        If the city file is bad, or a worker has other packages than this one.
    OutputError
        If results cannot be written, another run works in the folder, or workers are lost again and
        again. What was done stays done: the same call goes on from there.
    UsageError
        If `jobs` or `executor` do not fit.
    """
    city, root = read_city_file(path), Path(root).absolute()
    state = root / STATE
    with output_errors(root):
        if root.exists() and not site_folders(root):
            refuse_foreign(root, _OWNED)  # such as the results of one site, whose record is alike
        state.mkdir(parents=True, exist_ok=True)
    sites = {each.name: SiteOutcome() for each in city.site}
    with (
        only_writer(root, lock=state / "lock", reporter=reporter),
        workers_of(executor, jobs, reporter) as workers,
    ):
        run = CitySteps(city=city, root=root, sites=sites, workers=workers, reporter=reporter)
        run.update(run.make_hours(run.register()))
        _write_record(run)
        run.write_page()  # last: it states failures from the record
    return CityRun(city=city, root=root, sites=sites)


def _line(name: str, failure: Failure) -> Text:
    """Return a failure of a site in one line."""
    what, error = failure
    if what == name:
        return Text("{}: {}", name, error.message)
    return Text("{}: {}: {}", name, what, error.message.without(what))


def _task(root: Path, city: CityFile, name: str) -> SiteTask:
    file = next(each.file for each in city.site if each.name == name)
    return SiteTask(root=root, name=name, file=file.absolute())


@dataclass(frozen=True, kw_only=True)
class CitySteps(CityRun):
    """A run at work."""

    workers: Workers
    reporter: Reporter

    def register(self) -> list[str]:
        """Register the new recordings of all sites; return the sites with a dataset."""
        tasks = {name: (add_recordings, _task(self.root, self.city, name)) for name in self.sites}
        self._carry_out(tasks, Text("registering recordings"))
        there = [name for name in self.sites if Manifest.is_there(self._dataset(name))]
        for name in self.sites.keys() - {*there}:
            if not self.sites[name].failures:
                self._fail(name, name, InputError("{}: has no recording with a pose", name))
        return sorted(there)

    def make_hours(self, names: Sequence[str]) -> list[str]:
        """Make the hours of sites, oldest first; return the sites whose datasets can be written."""
        with ExitStack() as stack:
            opened: dict[str, OpenHours] = {}
            for name in names:
                try:
                    opened[name] = stack.enter_context(
                        open_hours(self._dataset(name), self.reporter)
                    )
                except GisRadarError as error:
                    self._fail(name, name, error)
            for name, hours in opened.items():
                for hour, reason in hours.refused.items():
                    self._fail(name, hour_text(hour), reason)
            order = [(h // 24, name, h) for name, each in opened.items() for h in each.missing]
            share = self.workers.share(len(order))
            calls = {
                (name, hour): (make_site_hour, self._dataset(name), hour, share)
                for _, name, hour in sorted(order)
            }
            written_at = dict.fromkeys(opened, time.monotonic())
            try:  # which hours are made is recorded from time to time, and at the end
                for name, hour in self._make_hours(calls):
                    opened[name].made.append(hour)
                    self.sites[name].hours += 1
                    if time.monotonic() - written_at[name] > _REGISTRY_EVERY_S:
                        opened[name].note()
                        written_at[name] = time.monotonic()
            finally:  # also after an error
                for each in opened.values():
                    if each.made:
                        each.note()
        return [*opened]

    def update(self, names: Sequence[str]) -> None:
        """Bring tables of dates, heat maps and reports of sites up to date."""
        tasks = {
            name: (update_site, _task(self.root, self.city, name), self.city) for name in names
        }
        self._carry_out(tasks, Text("updating tables and reports"))

    def write_page(self) -> None:
        """Write the page of the city's last month with measured hours."""
        datasets = [self._dataset(name) for name in self.sites]
        there = [each for each in datasets if Manifest.is_there(each)]
        last = max((hour for each in there for hour in listed_hours(each)[-1:]), default=None)
        if last is None or not any(is_older(self.root / MONTH_PAGE, each) for each in there):
            return
        begin = hour_begin(last).astimezone(zone_of(self.city.timezone))
        try:
            write_month_page(
                self.root, f"{begin:%Y-%m}", title=self.city.title, timezone=self.city.timezone,
                language=self.city.language, workers=self.workers, reporter=self.reporter,
            )  # fmt: skip
        except (InputError, NoAnswerError) as error:  # the error of its site was reported
            self.reporter.warn("there is no page of the month: {}", error.message)

    def _dataset(self, name: str) -> Path:
        return _task(self.root, self.city, name).dataset

    def _carry_out(self, tasks: Mapping[str, Sequence[Any]], stage: Text) -> None:
        """Carry out a task a site, and keep what it says."""
        self.reporter.progress(stage, 0, len(tasks))
        for done, (name, found) in enumerate(self.workers.results(tasks), start=1):
            if isinstance(found, GisRadarError):
                self._fail(name, name, found)
            else:
                for what, error in found.failures:
                    self._fail(name, what, error)
                for message in found.warnings:
                    self.sites[name].warnings.append(message)
                    self.reporter.warn("{}: {}", name, message)
            self.reporter.progress(stage, done, len(tasks))

    def _make_hours(
        self, calls: Mapping[tuple[str, int], Sequence[Any]]
    ) -> Iterator[tuple[str, int]]:
        self.reporter.progress(_HOURS, 0, len(calls))
        for done, ((name, hour), found) in enumerate(self.workers.results(calls), start=1):
            if isinstance(found, OutputError):
                raise found  # no other hour could be written either
            if isinstance(found, GisRadarError):
                self._fail(name, hour_text(hour), found)
            else:
                yield name, hour
            self.reporter.progress(_HOURS, done, len(calls))

    def _fail(self, name: str, what: str, error: GisRadarError) -> None:
        """Keep a failure and warn of it once, though a broken file stops several steps."""
        if any(known.message == error.message for _, known in self.sites[name].failures):
            return
        self.sites[name].failures.append((what, error))
        self.reporter.warn("{}", _line(name, (what, error)))


def _write_record(run: CitySteps) -> None:
    """Write `run.json`; it holds no times, so that a resumed run writes the same as any other."""
    document = {
        "title": run.city.title,
        "timezone": run.city.timezone,
        "language": run.city.language,
        "software": software(),
        "sites": {
            name: {
                "failures": [
                    {"what": what, "message": error.message, "hint": error.hint}
                    for what, error in each.failures
                ],
                "warnings": each.warnings,
            }
            for name, each in sorted(run.sites.items())
        },
    }
    write_json(run.root / "run.json", with_texts(document))

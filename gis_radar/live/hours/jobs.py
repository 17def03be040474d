"""Jobs of measuring hours and quarters, which a worker process does beside fusion.

The worker runs at low priority, on the cores that fusion leaves, one job at a time: fusion and its
map never wait for it. The log reports the backlog.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    Reporter,
    Text,
    WorkerPool,
    restored,
    watch_parent,
    with_texts,
)
from gis_radar.dataset import hour_text
from gis_radar.live.hours.hour_work import (
    LOOKAHEAD_US,
    QUARTER_US,
    JobResult,
    MeasuredSite,
    make_hours,
    make_quarter,
    make_recordings,
    resume_hours,
)
from gis_radar.live.hours.quarters import Quarters
from gis_radar.live.hours.recordings import end_of_hour_s
from gis_radar.live.state_file import StateFile

SETTLE_S = 30.0  # longest wait for frames of all sensors, and the time after a late frame
RETRY_S = 60.0  # time after which a job that failed is tried again
NICE = 15  # niceness of the worker: the map has priority
_BACKLOG_S = 900.0  # backlog of hours from which on it is logged, and at each doubling
_POLL_S = 0.1  # between two looks whether the last job has ended
DOUBTS_FILE = "doubts.json"
_MOST_LOGGED = 1_000  # most warnings remembered, which are not logged again

Work = Callable[[MeasuredSite, Sequence[Path]], JobResult]


def _process() -> WorkerPool:
    """Start a worker: it is nice before it imports gis_radar, as that takes seconds of a core."""
    nice = partial(os.nice, NICE) if hasattr(os, "nice") else None
    pool = WorkerPool(1, context=multiprocessing.get_context("spawn"), initializer=nice)
    pool.submit(watch_parent)
    return pool


@dataclass(frozen=True, kw_only=True)
class _Unmeasured:
    """An hour that could not be measured.

    Parameters
    ----------
    why : str
        The reason.
    tried_in, quarters_to_wait : int
        Quarter since 1970 in which it was tried, and number of quarters until the next try.
    """

    why: str
    tried_in: int
    quarters_to_wait: int


class HourJobs:
    """Jobs of a site: hours and quarters are measured once they are over.

    Parameters
    ----------
    site : MeasuredSite
        The site.
    quarters : Quarters
        Receives the measured quarters.
    process : callable
        Starts the worker process.
    reporter : Reporter
        Receives warnings of the jobs.

    Attributes
    ----------
    touched : dict
        Hours with new frames, whose recordings have to be made, each with the arrival of its last
        frame (monotonic seconds).
    doubts : dict
        By sensor, the check's doubt of its pose and recording; None once they were found to fit.
    wanted : bool
        Whether a job waits for the spool to be closed.
    """

    def __init__(
        self, site: MeasuredSite, quarters: Quarters, *,
        process: Callable[[], WorkerPool] = _process, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.touched: dict[int, float] = {}
        self._doubts_file = StateFile(site.folder / DOUBTS_FILE, reporter=reporter)
        self.doubts, self._unchecked = self._doubts_file.read(
            {"doubts": {}, "unchecked": []}, _doubts_in
        )
        self.behind_s = self.quarters_left_out = 0.0
        self._site, self._quarters = site, quarters
        self._reporter = reporter
        self._pool: WorkerPool | None = None
        self._process = process
        self._running: Future[JobResult] | None = None
        self._next: Work | None = None
        self._hours: dict[int, float | None] = {}  # hours being made, as in `touched` at the start
        self._unmeasured: dict[int, _Unmeasured] = {}
        self._is_resumed = True  # whether the hours that an earlier run left are known
        self._running_quarter = 0  # quarter since 1970 at the last call of `poll`
        self._measured_quarter = 0  # the last measured one
        self._logged: set[str] = set()
        self._retry_at, self._warned_s = 0.0, _BACKLOG_S

    def resume(self, spooled: Sequence[Path]) -> None:
        """Start with the hours that an earlier run left to be made."""
        self._is_resumed = False
        self._submit(resume_hours, spooled)

    @property
    def wanted(self) -> bool:
        """Whether a job waits until the spool continues in another file."""
        return self._next is not None and self._running is None

    def poll(self, now_s: float, newest: Mapping[str, float], *, full: bool = False) -> None:
        """Process the result of a job that has ended, and choose the next one.

        Parameters
        ----------
        now_s : float
            UNIX seconds.
        newest : mapping
            By sensor, the time of its last frame.
        full : bool
            Whether the open file of the spool is long.
        """
        self._take_result()
        if self._running is None and self._next is None and time.monotonic() >= self._retry_at:
            self._choose(now_s, newest, full=full)

    def _choose(self, now_s: float, newest: Mapping[str, float], *, full: bool) -> None:
        """Choose the next job: first a quarter that is due, then hours, then recordings alone."""
        if not self._is_resumed:  # the first job failed
            self._next = resume_hours
            return
        due = sorted(hour for hour in self.touched if self._is_due(hour, now_s, newest))
        self._log_backlog(now_s, due)
        quarter = self._due_quarter(now_s, newest)
        self._running_quarter = int(now_s * 1e6) // QUARTER_US
        now = self._running_quarter
        failed = self._unmeasured.items()
        to_retry = (h for h, each in failed if now >= each.tried_in + each.quarters_to_wait)
        hours = sorted({*due, *to_retry})
        if quarter is not None and self.behind_s < _BACKLOG_S:  # first, as the page shows it
            left_out = quarter - self._measured_quarter - 1 if self._measured_quarter else 0
            self.quarters_left_out += max(left_out, 0)
            self._measured_quarter = quarter
            self._next = partial(make_quarter, quarter=quarter)
        elif hours:
            self._hours = {hour: self.touched.get(hour) for hour in hours}
            self._next = partial(make_hours, hours=hours)
        elif full:
            self._next = make_recordings

    def _is_due(self, hour: int, now_s: float, newest: Mapping[str, float]) -> bool:
        """Return whether all frames of an hour are there, or the wait for them is over."""
        end_s = end_of_hour_s(hour)
        if now_s < end_s:
            return False
        settled = time.monotonic() - self.touched[hour] >= SETTLE_S
        is_complete = all(each >= end_s for each in newest.values())
        return is_complete or (settled and now_s >= end_s + SETTLE_S)

    def _due_quarter(self, now_s: float, newest: Mapping[str, float]) -> int | None:
        """Return the newest quarter that is over, if it has frames and was not measured yet."""
        after_s = LOOKAHEAD_US / 1e6
        quarter = int((now_s - after_s) * 1e6) // QUARTER_US - 1
        end_s = (quarter + 1) * QUARTER_US / 1e6 + after_s
        is_complete = all(each >= end_s for each in newest.values())
        if quarter <= self._measured_quarter or not (is_complete or now_s >= end_s + SETTLE_S):
            return None
        begin_s = quarter * QUARTER_US / 1e6
        return quarter if any(each >= begin_s for each in newest.values()) else None

    def _log_backlog(self, now_s: float, due: Sequence[int]) -> None:
        """Log the backlog of hours at each doubling, and its end."""
        self.behind_s = now_s - end_of_hour_s(due[0]) if due else 0.0
        if self.behind_s >= self._warned_s:
            self._warned_s = 2.0 * self.behind_s
            self._reporter.warn(
                "measuring is behind: {} waits for {:.0f} min: the machine has too few "
                "cores for its sensors",
                hour_text(due[0]),
                self.behind_s / 60,
            )
        elif not due:
            self._warned_s = _BACKLOG_S

    def begin(self, spooled: Sequence[Path]) -> None:
        """Start the waiting job, now that the spool is closed up to here."""
        work, self._next = self._next, None
        if work is not None:
            self._submit(work, spooled)

    def _submit(self, work: Work, spooled: Sequence[Path]) -> None:
        """Submit work to the worker process, which is started where there is none alive."""
        try:
            self._pool = self._pool or self._process()
            self._running = self._pool.submit(work, self._site, list(spooled))
        except BrokenExecutor:  # killed while it had nothing to do
            self.stop()
            self._pool = self._process()
            self._running = self._pool.submit(work, self._site, list(spooled))

    def _take_result(self) -> None:
        """Process the result of the job; hours that failed are tried again later."""
        if self._running is None or not self._running.done():
            return
        work, self._running = self._running, None
        hours, self._hours = self._hours, {}
        try:
            done = work.result()
        except Exception as error:  # noqa: BLE001 - whatever it is, fusion goes on
            self._retry_at = time.monotonic() + RETRY_S
            reason = error.message if isinstance(error, GisRadarError) else (
                f"{type(error).__name__}: {error}"
            )  # fmt: skip
            self._log_new([f"measuring failed and is tried again: {reason}"])
            self.stop()
            return
        self._is_resumed = True  # as that job is always the first
        for hour, touched in hours.items():
            if self.touched.get(hour) == touched:  # else frames came meanwhile: make it again
                self.touched.pop(hour, None)
            if hour not in done.not_measured:
                self._unmeasured.pop(hour, None)
        self.touch(done.hours)
        self._quarters.add(done.quarters)
        self._record_doubts(done)
        self._log_new(done.warnings)
        for hour, why in done.not_measured.items():
            self._plan_retry(hour, why)

    def _record_doubts(self, done: JobResult) -> None:
        """Record the findings of the check, and store them for a restart of fusion.

        Too little traffic for a verdict ends no doubt; the first such hour is added to its text.
        """
        if not done.doubts and not done.unchecked:
            return
        self.doubts |= done.doubts
        self._unchecked -= done.doubts.keys()
        for name, hour in done.unchecked.items():
            doubt = self.doubts.get(name)
            if doubt and name not in self._unchecked:
                again = "{}; since {} too little traffic to check it again"
                self.doubts[name] = Text(again, doubt, hour_text(hour))
                self._unchecked.add(name)
        stored = {"doubts": self.doubts, "unchecked": sorted(self._unchecked)}
        self._doubts_file.write(with_texts(stored))

    def _plan_retry(self, hour: int, why: str) -> None:
        """Log an hour that failed; try it again after one quarter, then two, four, ..."""
        known = self._unmeasured.get(hour)
        if known is None or known.why != why:
            self._reporter.warn("{} is not measured: {}", hour_text(hour), why)
        quarters_to_wait = 1 if known is None else 2 * known.quarters_to_wait
        self._unmeasured[hour] = _Unmeasured(
            why=why, tried_in=self._running_quarter, quarters_to_wait=quarters_to_wait
        )

    def touch(self, hours: Iterable[int]) -> None:
        """Add hours with new frames to those to be made."""
        self.touched |= dict.fromkeys(hours, time.monotonic())

    def _log_new(self, lines: Iterable[str]) -> None:
        """Log warnings that were not logged before."""
        for line in lines:  # numbers and times do not make a warning a new one
            words = " ".join(word for word in line.split() if not word[0].isdigit())
            if words not in self._logged:
                self._logged = (
                    {words} if len(self._logged) >= _MOST_LOGGED else self._logged | {words}
                )
                self._reporter.warn(line)

    def finish(self, spooled: Sequence[Path]) -> None:
        """Make recordings of what is there, and measure the hours that are over."""
        self.stop()
        self._hours, self._next = {}, partial(_make_all, touched=list(self.touched))
        self.begin(spooled)
        while self._running is not None:
            time.sleep(_POLL_S)
            self._take_result()
        self.stop()

    def stop(self) -> None:
        """End the process."""
        if self._pool is not None:
            self._pool.stop()
        self._pool, self._running, self._next = None, None, None

    def figures(self) -> dict[str, float]:
        """Return the progress of the jobs, by name, for Prometheus."""
        return {
            "hours_waiting": float(len(self.touched)),
            "hours_behind_seconds": self.behind_s,
            "hours_not_measured": float(len(self._unmeasured)),
            "quarters_left_out": self.quarters_left_out,
        }


def _doubts_in(stored: Any) -> tuple[dict[str, str | None], set[str]]:
    """Return the doubts of an earlier run of fusion, of the content of their file."""
    found = restored(stored)
    doubts = dict(found["doubts"])
    "".join(each for each in doubts.values() if each is not None)  # TypeError if one is no text
    return doubts, {name for name in found["unchecked"] if name in doubts}


def _make_all(site: MeasuredSite, spooled: Sequence[Path], touched: Sequence[int]) -> JobResult:
    """Make recordings from all frames received, and measure the hours that are over."""
    done = resume_hours(site, spooled)
    hours = sorted({*touched, *done.hours})  # touched hours may be partly made
    over = [hour for hour in hours if end_of_hour_s(hour) <= time.time()]
    if not over:
        return done
    made = make_hours(site, [], over)
    made.warnings = [*done.warnings, *made.warnings]
    return made

"""Which hours and quarters are to be measured, and the worker that does it beside fusion.

At low priority, on the cores that fusion leaves, one piece of work at a time: fusion and its map
never wait for it. The log reports the backlog.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gis_radar.base import (
    QUIET,
    GisRadarError,
    Reporter,
    Text,
    atomic_write,
    json_text,
    read_json,
    restored,
    stop_pool,
    watch_parent,
    with_texts,
)
from gis_radar.dataset import hour_text
from gis_radar.live.hour_work import (
    AFTER_US,
    QUARTER_US,
    Done,
    MeasuredSite,
    make_hours,
    make_quarter,
    make_recordings,
    take_up,
)
from gis_radar.live.quarters import Quarters
from gis_radar.live.recordings import end_of_hour_s
from gis_radar.live.settings import DEFAULTS, LiveSettings

NICE = 15  # the map goes first
BEHIND_S = 900.0  # from which on it is told how far hours are behind, and at each doubling
LOOK_S = 0.1
DOUBTS = "doubts.json"
MOST_SAID = 1_000  # warnings that are known, and not told again

Work = Callable[[MeasuredSite, Sequence[Path]], Done]


def _begin() -> None:
    if hasattr(os, "nice"):
        os.nice(NICE)
    watch_parent()


def _process() -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_begin)


@dataclass(frozen=True, kw_only=True)
class _Unmeasured:
    """An hour that could not be measured.

    Parameters
    ----------
    why : str
        What keeps it from that.
    tried, waits : int
        The quarter in which it was tried, and after how many it is tried again.
    """

    why: str
    tried: int
    waits: int


class HourJobs:
    """Has hours and quarters measured once they are over.

    Parameters
    ----------
    site : MeasuredSite
        The site.
    quarters : Quarters
        Takes in what was measured.
    settings : LiveSettings
        How long it is waited for frames.
    process : callable
        Starts the process that works.
    reporter : Reporter
        Receives warnings of the work.

    Attributes
    ----------
    touched : dict
        Hours of recordings that are to be made, and when a frame of each came last (monotonic
        seconds).
    wanted : bool
        Whether work waits for the spool to be closed.
    """

    def __init__(
        self, site: MeasuredSite, quarters: Quarters, *, settings: LiveSettings = DEFAULTS,
        process: Callable[[], ProcessPoolExecutor] = _process, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self.touched: dict[int, float] = {}
        self._doubts, self._untold = _kept_doubts(site.folder / DOUBTS, reporter)
        self.behind_s = self.quarters_left_out = 0.0
        self._site, self._quarters = site, quarters
        self._settings, self._reporter = settings, reporter
        self._pool: ProcessPoolExecutor | None = None
        self._process = process
        self._running: Future[Done] | None = None
        self._next: Work | None = None
        self._hours: dict[int, float | None] = {}  # that are being made, and when they were touched
        self._unmeasured: dict[int, _Unmeasured] = {}
        self._now = 0  # the quarter that runs
        self._quarter = 0  # that was measured last
        self._said: set[str] = set()
        self._again_at, self._told_s = 0.0, BEHIND_S

    def take_up(self, spooled: Sequence[Path]) -> None:
        """Begin with what an earlier run left."""
        self._submit(take_up, spooled)

    @property
    def wanted(self) -> bool:
        """Whether work waits until the spool goes on in another file."""
        return self._next is not None and self._running is None

    def turn(self, now_s: float, newest: Mapping[str, float], *, full: bool = False) -> None:
        """Take in what was done, and choose what is next.

        Parameters
        ----------
        now_s : float
            UNIX seconds.
        newest : mapping
            By sensor, the time of its last frame.
        full : bool
            Whether the open file of the spool is long.
        """
        self._take()
        if self._running is None and self._next is None and time.monotonic() >= self._again_at:
            self._choose(now_s, newest, full=full)

    def _choose(self, now_s: float, newest: Mapping[str, float], *, full: bool) -> None:
        due = sorted(hour for hour in self.touched if self._is_due(hour, now_s, newest))
        self._look_behind(now_s, due)
        quarter = self._due_quarter(now_s, newest)
        self._now = int(now_s * 1e6) // QUARTER_US
        again = (h for h, each in self._unmeasured.items() if self._now >= each.tried + each.waits)
        hours = sorted({*due, *again})
        if quarter is not None and self.behind_s < BEHIND_S:  # the page waits for it
            left = quarter - self._quarter - 1 if self._quarter else 0
            self.quarters_left_out += max(left, 0)
            self._quarter = quarter
            self._next = partial(make_quarter, quarter=quarter)
        elif hours:
            self._hours = {hour: self.touched.get(hour) for hour in hours}
            self._next = partial(make_hours, hours=hours)
        elif full:
            self._next = make_recordings

    def _is_due(self, hour: int, now_s: float, newest: Mapping[str, float]) -> bool:
        """Return whether all frames of an hour are there, or none came for long."""
        end_s = end_of_hour_s(hour)
        if now_s < end_s:
            return False
        settled = time.monotonic() - self.touched[hour] >= self._settings.settle_s
        all_there = all(each >= end_s for each in newest.values())
        return all_there or (settled and now_s >= end_s + self._settings.settle_s)

    def _due_quarter(self, now_s: float, newest: Mapping[str, float]) -> int | None:
        """Return the newest quarter that is over, if it was not measured and frames came of it."""
        after_s = AFTER_US / 1e6
        quarter = int((now_s - after_s) * 1e6) // QUARTER_US - 1
        end_s = (quarter + 1) * QUARTER_US / 1e6 + after_s
        there = all(each >= end_s for each in newest.values())
        if quarter <= self._quarter or not (there or now_s >= end_s + self._settings.settle_s):
            return None
        begin_s = quarter * QUARTER_US / 1e6
        return quarter if any(each >= begin_s for each in newest.values()) else None

    def _look_behind(self, now_s: float, due: Sequence[int]) -> None:
        """Tell how far hours are behind, at each doubling; and once they no longer are."""
        self.behind_s = now_s - end_of_hour_s(due[0]) if due else 0.0
        if self.behind_s >= self._told_s:
            self._told_s = 2.0 * self.behind_s
            self._reporter.warn(
                "measuring is behind: {} waits for {:.0f} min: the machine has too few "
                "cores for its sensors",
                hour_text(due[0]),
                self.behind_s / 60,
            )
        elif not due:
            self._told_s = BEHIND_S

    def begin(self, spooled: Sequence[Path]) -> None:
        """Begin what is wanted, now that the spool is closed up to here."""
        work, self._next = self._next, None
        if work is not None:
            self._submit(work, spooled)

    def _submit(self, work: Work, spooled: Sequence[Path]) -> None:
        """Hand work to the process, which is started where there is none, or no longer one."""
        try:
            self._pool = self._pool or self._process()
            self._running = self._pool.submit(work, self._site, list(spooled))
        except BrokenExecutor:  # it was killed while it had nothing to do
            self.stop()
            self._pool = self._process()
            self._running = self._pool.submit(work, self._site, list(spooled))

    def _take(self) -> None:
        """Take in what was done; what failed is tried again later."""
        if self._running is None or not self._running.done():
            return
        work, self._running = self._running, None
        hours, self._hours = self._hours, {}
        try:
            done = work.result()
        except Exception as error:  # noqa: BLE001 - whatever it is, fusion goes on
            self._again_at = time.monotonic() + self._settings.again_s
            reason = error.message if isinstance(error, GisRadarError) else (
                f"{type(error).__name__}: {error}"
            )  # fmt: skip
            self._say([f"measuring failed and is tried again: {reason}"])
            self.stop()
            return
        for hour, touched in hours.items():
            if self.touched.get(hour) == touched:  # else frames came meanwhile: once more
                self.touched.pop(hour, None)
            if hour not in done.not_measured:
                self._unmeasured.pop(hour, None)
        self.touch(done.hours)
        self._quarters.add(done.quarters)
        self._doubt(done)
        self._say(done.said)
        for hour, why in done.not_measured.items():
            self._wait(hour, why)

    @property
    def doubts(self) -> dict[str, str | None]:
        """By sensor, what the check doubts of its pose and recording; None once it found they fit.

        With the hour from which on there was too little traffic to tell: that ends no doubt.
        """
        again = "{}; since {} too little traffic to check it again"
        return {
            name: Text(again, doubt, hour_text(self._untold[name]))
            if doubt and name in self._untold else doubt
            for name, doubt in self._doubts.items()
        }  # fmt: skip

    def _doubt(self, done: Done) -> None:
        """Take in what the check found, and keep it for a fusion that begins anew."""
        if not done.doubts and not done.untold:
            return
        self._doubts |= done.doubts
        self._untold = {
            name: hour
            for name, hour in (done.untold | self._untold).items()
            if name not in done.doubts
        }
        path = self._site.folder / DOUBTS
        document = with_texts({"doubts": self._doubts, "untold": self._untold})
        try:
            with atomic_write(path) as part:
                part.write_text(json_text(document, indent=1) + "\n", encoding="utf-8")
        except GisRadarError as error:  # alarms stand all the same
            self._say([error.message])

    def _wait(self, hour: int, why: str) -> None:
        """Name an hour that is not measured; try it again after a quarter, then twice that, ..."""
        known = self._unmeasured.get(hour)
        if known is None or known.why != why:
            self._reporter.warn("{} is not measured: {}", hour_text(hour), why)
        waits = 1 if known is None else 2 * known.waits
        self._unmeasured[hour] = _Unmeasured(why=why, tried=self._now, waits=waits)

    def touch(self, hours: Iterable[int]) -> None:
        """Take note of hours of which frames came."""
        self.touched |= dict.fromkeys(hours, time.monotonic())

    def _say(self, lines: Iterable[str]) -> None:
        for line in lines:  # once, of whatever hour
            words = " ".join(word for word in line.split() if not word[0].isdigit())
            if words not in self._said:
                self._said = {words} if len(self._said) >= MOST_SAID else self._said | {words}
                self._reporter.warn(line)

    def finish(self, spooled: Sequence[Path]) -> None:
        """Make recordings of what is there, and measure the hours that are over."""
        self.stop()
        self._hours, self._next = {}, partial(_make_all, touched=list(self.touched))
        self.begin(spooled)
        while self._running is not None:
            time.sleep(LOOK_S)
            self._take()
        self.stop()

    def stop(self) -> None:
        """End the process."""
        if self._pool is not None:
            stop_pool(self._pool)
        self._pool, self._running, self._next = None, None, None

    def figures(self) -> dict[str, float]:
        """Return how far the work is, by name, for Prometheus."""
        return {
            "hours_waiting": float(len(self.touched)),
            "hours_behind_seconds": self.behind_s,
            "hours_not_measured": float(len(self._unmeasured)),
            "quarters_left_out": self.quarters_left_out,
        }


def _kept_doubts(path: Path, reporter: Reporter) -> tuple[dict[str, str | None], dict[str, int]]:
    """Return what an earlier fusion doubted; what cannot be read is told, and stops nothing."""
    if not path.exists():
        return {}, {}
    try:
        found = restored(read_json(path, what="doubts"))
        doubts, untold = dict(found["doubts"]), dict(found["untold"])
        "".join(each for each in doubts.values() if each is not None)  # else a TypeError
        [hour_text(hour) for hour in untold.values()]
    except (GisRadarError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError):
        reporter.warn("{}: cannot be read: alarms of poses begin anew", path)
        return {}, {}
    return doubts, untold


def _make_all(site: MeasuredSite, spooled: Sequence[Path], touched: Sequence[int]) -> Done:
    """Make recordings of what is there, and measure the hours that are over."""
    done = take_up(site, spooled)
    hours = sorted({*touched, *done.hours})  # what was touched may be half made
    over = [hour for hour in hours if end_of_hour_s(hour) <= time.time()]
    if not over:
        return done
    made = make_hours(site, [], over)
    made.said = [*done.said, *made.said]
    return made

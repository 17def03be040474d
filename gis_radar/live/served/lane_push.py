"""Push of lane measures, which wait on disk until a SensorThings server has them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from gis_radar.base import (
    QUIET,
    GisRadarError,
    Reporter,
    Text,
    quotient,
)
from gis_radar.dataset import STEPS_PER_QUARTER
from gis_radar.live.background import in_background
from gis_radar.live.hours.quarters import QUARTERS_KEPT, QuarterMeasures
from gis_radar.live.served.sensorthings import MEASURES, LaneMeasure, LaneServer, Service
from gis_radar.live.served.snapshot import Place
from gis_radar.live.state_file import StateFile
from gis_radar.site import SensorThingsTable

_FIRST_RETRY_S, _SLOWEST_RETRY_S = 30.0, 900.0
_MOST_WAITING = 50_000  # most waiting measures: two days of 50 lanes by 15 minutes
_DIGITS = 3


class LanePush:
    """Push of measures of lanes, on a thread of its own, until the server has them.

    Parameters
    ----------
    table : SensorThingsTable
        The table of the site's file.
    place : Place
        The site's lanes.
    site : str
        The site's name in topics.
    path : Path
        File of the waiting measures.
    retry_s : float
        Seconds until the first retry; each further one waits twice as long.
    reporter : Reporter
        Receives a line when the server cannot be reached, and when it is again.

    Raises
    ------
    InputError
        If the file with token or password cannot be read.
    """

    def __init__(
        self, table: SensorThingsTable, place: Place, *, site: str, path: Path,
        retry_s: float = _FIRST_RETRY_S, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self._server = LaneServer(Service.of(table), place, site)
        self._file, self._reporter = StateFile(path, indent=None, reporter=reporter), reporter
        lanes = {*place.lane_numbers}  # another map may have others: no server takes those
        waiting, self._taken = self._file.read({"waiting": [], "quarters": []}, _waiting_in)
        self._waiting = [each for each in waiting if each.lane in lanes]
        self._sending: list[LaneMeasure] = []
        self._work: Future[int] | None = None
        self._compare_first = True  # measures that this run counts again may have arrived before
        self._try_at, self._retry_wait_s, self._logged = 0.0, retry_s, ""
        self._retry_s = retry_s

    @property
    def waiting(self) -> int:
        """Number of measures that the server has not taken yet."""
        return len(self._waiting)

    def take(self, quarters: Sequence[QuarterMeasures]) -> None:
        """Add the measures of quarters of an hour that were not taken yet.

        Parameters
        ----------
        quarters : sequence of QuarterMeasures
            Those of the last day; each is taken as it was measured first, so that what its hour
            changes later is not sent.
        """
        new = [each for each in quarters if each.until_step not in self._taken]
        if not new:
            return
        # the file that says which were taken may be lost, or from before others were measured
        self._compare_first |= not self._taken or new[0].until_step < max(self._taken)
        # all given ones, too: a clock that was ahead may have left as many later ones
        self._taken = {
            *sorted(self._taken)[-QUARTERS_KEPT:],
            *(each.until_step for each in quarters),
        }
        if not self._add([row for each in new for row in _measures(each)]):
            self._store()

    def _add(self, done: Sequence[LaneMeasure]) -> bool:
        """Add measures to those that wait; return whether some are new."""
        known = {each[:3] for each in self._waiting} if done else set()
        if added := [each for each in done if each[:3] not in known]:
            self._waiting = [*self._waiting, *added][-_MOST_WAITING:]
            self._store()
        return bool(added)

    def poll(self) -> None:
        """Do what is due: process what was sent, and send waiting measures."""
        if self._work is not None and self._work.done():
            work, self._work = self._work, None
            self._take_sent(work)
        if self._waiting and self._work is None and time.monotonic() >= self._try_at:
            self._sending, again = sorted(self._waiting), self._compare_first
            self._compare_first = False  # unless it fails
            push = partial(self._server.push, self._sending, again=again)
            try:
                self._work = in_background("sensorthings", push)
            except RuntimeError as error:  # no further thread can be started
                self._failed(error)

    def _take_sent(self, work: Future[int]) -> None:
        """Drop the measures that the server has taken, or plan a retry."""
        try:
            refused = work.result()
        except Exception as error:  # noqa: BLE001 - whatever it is, fusion goes on
            self._failed(error)
            return
        sent = {*self._sending}
        self._waiting = [each for each in self._waiting if each not in sent]
        self._store()
        if refused:
            self._reporter.warn("the server of lane measures refuses {} of them", refused)
        if self._logged:
            self._reporter.log("the server of lane measures takes them again")
        self._retry_wait_s, self._logged = self._retry_s, ""

    def _failed(self, error: Exception) -> None:
        """Plan a retry; log each new reason once."""
        self._compare_first, self._try_at = True, time.monotonic() + self._retry_wait_s
        self._retry_wait_s = min(2.0 * self._retry_wait_s, _SLOWEST_RETRY_S)
        if isinstance(error, GisRadarError):
            message = error.message
        else:
            message = Text("lane measures cannot be pushed: {}: {}", type(error).__name__, error)
        if message != self._logged:
            self._logged = message
            self._reporter.warn("{}; trying on", message)

    def _store(self) -> None:
        """Write the waiting measures, and which quarters were taken, to the disk."""
        self._file.write({"quarters": sorted(self._taken), "waiting": self._waiting})


def _measures(quarter: QuarterMeasures) -> Iterator[LaneMeasure]:
    """Yield the measures of a quarter that are known."""
    end = quarter.until_step + 1
    lanes = quarter.lanes.assign(hits=quotient(quarter.lanes["hit_s"], quarter.lanes["observed_s"]))
    for name, measure in MEASURES.items():
        if name not in lanes:  # without vehicles there is no traffic
            continue
        table = lanes[["lane", name, measure.parameter]].dropna()
        for lane, result, parameter in table.itertuples(index=False, name=None):
            yield LaneMeasure(
                int(lane), name, end - STEPS_PER_QUARTER, end,
                round(measure.scale * result, _DIGITS), round(parameter, _DIGITS),
            )  # fmt: skip


def _row(lane: Any, measure: Any, begin: Any, end: Any, result: Any, parameter: Any) -> LaneMeasure:
    """Return the measure of a row of the file; refuse one of an unknown kind."""
    if measure not in MEASURES:
        raise ValueError(measure)
    return LaneMeasure(int(lane), measure, int(begin), int(end), float(result), float(parameter))


def _waiting_in(kept: Any) -> tuple[list[LaneMeasure], set[int]]:
    """Return the waiting measures, and the last steps of the quarters that were taken."""
    return [_row(*row) for row in kept["waiting"]], {int(each) for each in kept["quarters"]}

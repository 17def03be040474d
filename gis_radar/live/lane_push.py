"""Lane measures by interval, which wait on disk until a SensorThings server has taken them."""

from __future__ import annotations

import json
import secrets
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import (
    QUIET,
    STEP_S,
    Booleans,
    GisRadarError,
    Integers,
    Reporter,
    Text,
    atomic_write,
    interval_steps,
    iso_from_step,
)
from gis_radar.live.background import BackgroundTask
from gis_radar.live.sensorthings import LaneMeasure, LaneServer, Service
from gis_radar.live.snapshot import Place
from gis_radar.products import lane_totals
from gis_radar.site import SensorThingsTable

FIRST_RETRY_S, SLOWEST_RETRY_S = 30.0, 900.0
MOST_WAITING = 50_000  # measures: ten days of 50 lanes by 15 minutes
DIGITS = 3


class LaneIntervals:
    """Counts steps of lanes over intervals.

    Parameters
    ----------
    place : Place
        The lanes and their tiles.
    steps : int
        Of an interval; intervals begin at its multiples.
    """

    def __init__(self, place: Place, steps: int) -> None:
        self._lane_of_tile, self._lanes = place.lane_of_tile, place.lane_numbers
        self._tiles = np.maximum(np.bincount(self._lane_of_tile, minlength=len(self._lanes)), 1)
        self._steps, self._number = steps, -1
        self._counts = np.zeros((2, len(self._lane_of_tile)), np.int64)

    def take(self, step: int, hit: Booleans, observed: Booleans) -> list[LaneMeasure]:
        """Count a step; return the measures of the interval that it ends, if it does."""
        done: list[LaneMeasure] = []
        if (number := step // self._steps) != self._number:
            if 0 <= self._number < number:  # else the clock was set back
                done = self._measures()
            self._counts[:], self._number = 0, number
        self._counts[0] += hit
        self._counts[1] += observed
        return done

    def _measures(self) -> list[LaneMeasure]:
        hit, observed = (self._by_lane(row) for row in self._counts)
        begin = self._number * self._steps
        return [
            LaneMeasure(
                lane, begin, begin + self._steps, round(100.0 * hit / seen, DIGITS),
                round(seen / tiles * STEP_S, DIGITS),
            )
            for lane, hit, seen, tiles in zip(
                self._lanes, hit, observed, self._tiles.tolist(), strict=True
            )
            if seen > 0
        ]  # fmt: skip

    def _by_lane(self, counts: Integers) -> list[float]:
        found = lane_totals(counts.astype(float), self._lane_of_tile, len(self._lanes))
        return [float(each) for each in found]


class LanePush:
    """Pushes measures of lanes, on a thread of its own, until the server has them.

    Parameters
    ----------
    table : SensorThingsTable
        Of the site's file.
    place : Place
        The site's lanes.
    site : str
        Its name in topics.
    path : Path
        Where measures wait.
    reporter : Reporter
        Receives a line when the server cannot be reached, and when it is again.

    Raises
    ------
    InputError
        If the file with token or password cannot be read.
    """

    def __init__(
        self, table: SensorThingsTable, place: Place, *, site: str, path: Path,
        reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self._server = LaneServer(Service.of(table), place, site)
        self._intervals = LaneIntervals(place, interval_steps(table.interval))
        self._path, self._reporter = path, reporter
        lanes = {*place.lane_numbers}  # another map may have others: no server takes those
        self._waiting = [each for each in _read(path, reporter) if each.lane in lanes]
        self._sending: list[LaneMeasure] = []
        self._work = BackgroundTask[int]("sensorthings")
        self._again = True  # what a new start counts again may have arrived before
        self._newest = -1  # begin of an interval
        self._try_at, self._patience_s, self._said = 0.0, FIRST_RETRY_S, ""

    @property
    def waiting(self) -> int:
        """Measures that the server has not taken yet."""
        return len(self._waiting)

    def take(self, step: int, hit: Booleans, observed: Booleans) -> None:
        """Count a closed step."""
        done = self._intervals.take(step, hit, observed)
        if done and done[0].begin <= self._newest:  # the clock was set back
            self._again = True
        known = {(each.lane, each.begin) for each in self._waiting} if done else set()
        if done := [each for each in done if (each.lane, each.begin) not in known]:
            self._newest = max(self._newest, done[0].begin)
            self._waiting = [*self._waiting, *done][-MOST_WAITING:]
            self._keep()

    def regular(self) -> None:
        """Do what is due: take in what was sent, and send what waits."""
        if self._work.busy:
            self._take_sent()
        if self._waiting and not self._work.busy and time.monotonic() >= self._try_at:
            self._sending, again = sorted(self._waiting), self._again
            self._again = False  # unless it fails, or the clock is set back meanwhile
            try:
                self._work.begin(lambda: self._server.push(self._sending, again=again))
            except RuntimeError as error:  # no further thread can be started
                self._failed(error)

    def _take_sent(self) -> None:
        try:
            refused = self._work.take()
            if self._work.busy or refused is None:
                return
        except Exception as error:  # noqa: BLE001 - whatever it is, fusion goes on
            self._failed(error)
            return
        sent = {*self._sending}
        self._waiting = [each for each in self._waiting if each not in sent]
        self._keep()
        if refused:
            self._reporter.warn("the server of lane measures refuses {} of them", refused)
        if self._said:
            self._reporter.log("the server of lane measures takes them again")
        self._patience_s, self._said = FIRST_RETRY_S, ""

    def _failed(self, error: Exception) -> None:
        """Try again later; each new reason is told once."""
        self._again, self._try_at = True, time.monotonic() + self._patience_s
        self._patience_s = min(2.0 * self._patience_s, SLOWEST_RETRY_S)
        if isinstance(error, GisRadarError):
            message = error.message
        else:
            message = Text("lane measures cannot be pushed: {}: {}", type(error).__name__, error)
        if message != self._said:
            self._said = message
            self._reporter.warn("{}; trying on", message)

    def _keep(self) -> None:
        try:
            with atomic_write(self._path) as part:
                part.write_text(json.dumps(self._waiting), encoding="utf-8")
        except GisRadarError as error:
            self._reporter.warn(error.message)


def _read(path: Path, reporter: Reporter) -> list[LaneMeasure]:
    """Return measures that waited when fusion ended; a damaged file is put aside, and one line."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        sound = [each for row in rows if (each := _measure(row)) is not None]
        if len(sound) == len(rows):
            return sound
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, RecursionError):
        sound = []
    aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    with suppress(OSError):  # else it is replaced once there is something that waits
        path.rename(aside)
    reporter.warn(
        "{}: it is damaged: put aside as {}; of the lane measures that waited {} are "
        "sound and wait on",
        path,
        aside.name,
        len(sound),
    )
    return sound


def _measure(row: Any) -> LaneMeasure | None:
    """Return what a row of the file holds; nothing where it is none that could have been made."""
    try:
        lane, begin, end, percent, observed = row
        found = LaneMeasure(int(lane), int(begin), int(end), float(percent), float(observed))
        times = iso_from_step(found.begin) < iso_from_step(found.end)
    except (ValueError, TypeError, OverflowError):
        return None
    return found if times and 0.0 <= found.percent <= 100.0 and found.observed_s > 0.0 else None

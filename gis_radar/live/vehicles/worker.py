"""What the process that follows vehicles does: fusion only hands on what sensors send.

Its main thread takes frames in, keeps them on disk and tells the vehicles of now; a second one
follows blocks and writes hours.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.queues import Queue as Channel
from pathlib import Path
from queue import Empty, Queue
from typing import Any, TypeAlias

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import GisRadarError, InputError, OutputError
from gis_radar.live.detections import unpack_detections
from gis_radar.live.hours import HOUR_STEPS, hour_name
from gis_radar.live.vehicles.clocks import SensorFrame
from gis_radar.live.vehicles.follower import (
    POSES_KEPT,
    FollowedSite,
    VehicleFollower,
)
from gis_radar.live.vehicles.now import NowFilter, VehiclesNow
from gis_radar.live.vehicles.occupancy import Finished
from gis_radar.live.vehicles.settings import FollowSettings
from gis_radar.live.vehicles.store import FollowedPose, VehicleStore
from gis_radar.steps import STEPS_PER_SECOND, iso_from_step
from gis_radar.tracking.blocks import Block
from gis_radar.tracking.visibility import SensorView

COMMIT_S, WAIT_S = 1.0, 0.1
AHEAD_S = 10.0  # a frame further in the future is of a wrong clock
SHOWN_STEPS = HOUR_STEPS // 4  # of what is told again after a restart, before the hour


@dataclass(frozen=True, kw_only=True)
class PoseMessage:
    """A pose with what is seen from it, unless another one said that; `number` is fusion's."""

    number: int
    pose: FollowedPose
    view: SensorView | None = None
    road_m: float = np.nan


@dataclass(frozen=True, kw_only=True)
class FramesMessage:
    """Contents of messages of detections: (sensor, fusion's number of the pose, content)."""

    rows: list[tuple[str, int, bytes]]


@dataclass(frozen=True, kw_only=True)
class EndMessage:
    """No more comes: what there is is followed and written."""


@dataclass(frozen=True, kw_only=True)
class WorkerEvent:
    """What the process tells fusion: counts always, the rest where it is new."""

    counts: dict[str, float]
    now: VehiclesNow | None = None
    finished: Finished | None = None
    written: Path | None = None
    said: str = ""
    anew: int | None = None  # the step from which on all counts are told anew
    ready: bool = False  # takes in what is handed on
    ended: bool = False
    refused: bool = False  # could not begin; it is tried again


Inbox: TypeAlias = "Channel[Any] | Queue[Any]"
_Found = tuple[float, Floats] | int | None  # a block's, or the step from which on it begins anew


class VehicleWorker:
    """Takes frames in, has blocks followed, and sends what it finds.

    Parameters
    ----------
    site : FollowedSite
        The site.
    store : VehicleStore
        Detections and batches on disk.
    inbox : Queue
        Of messages.
    tell : callable
        Receives events.
    settings : FollowSettings
        Constants.
    """

    def __init__(
        self, site: FollowedSite, store: VehicleStore, inbox: Inbox,
        tell: Callable[[WorkerEvent], object], settings: FollowSettings,
    ) -> None:  # fmt: skip
        self._site, self._store, self._settings = site, store, settings
        self._inbox, self._hand_back = inbox, tell
        self._follower = VehicleFollower(site=site, store=store, settings=settings)
        self._now = NowFilter(graph=site.graph, tracker=settings.tracker(), settings=settings)
        self._counts: Counter[str] = Counter()
        self._pose_ids: dict[int, int] = {}  # fusion's number: the store's
        self._committed = self._sent = self._heard = time.monotonic()
        self._newest_s = -np.inf
        self._work: Future[_Found] | None = None
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="blocks")
        self._said, self._anew_after = set[str](), 0.0
        self._failing: dict[int, float] = {}  # hours that could not be written, and since when
        self._unwritten: set[int] = set()

    def run(self) -> None:
        """Process messages until the end message."""
        self._resume()
        ended = False
        while not ended:
            ended = self._take_in()
            self._look()
        self._commit()
        while self._begin_work(everything=True) or self._work is not None:
            if self._work is not None:
                wait([self._work])
            self._look()
        for hour in sorted(self._unwritten):
            self._write(hour)
        self._tell(ended=True)
        self._pool.shutdown()

    def _resume(self) -> None:
        """Take up what an earlier process left: frames of the last minutes, blocks of the hour."""
        self._follower.resume()
        if (done := self._follower.done) is None:
            return
        begin, last = _shown_since(done), done // HOUR_STEPS
        oldest, *later = self._store.batch_hours(HOUR_STEPS)
        self._unwritten |= {*later, last}
        if not self._site.path_of(oldest).exists():  # it may still be extended
            self._unwritten.add(oldest)
        over = sorted(each for each in self._unwritten if each < time.time() // 3600)

        def work() -> None:
            for block in self._follower.again(begin):
                self._tell(finished=block)
            for each in over:
                self._write(each)
            self._unwritten.add(last)  # there may be more of it

        self._work = self._pool.submit(work)

    def _take_in(self) -> bool:
        """Process messages of fusion; return whether the end message came."""
        try:
            message = self._inbox.get(timeout=WAIT_S)
        except Empty:
            return False
        if isinstance(message, EndMessage):
            return True
        if isinstance(message, PoseMessage):
            self._take_pose(message)
        else:
            self._take_frames(message)
        return False

    def _take_pose(self, message: PoseMessage) -> None:
        if message.view is not None:
            self._store.add_view(message.view, message.road_m)
            self._follower.add_view(message.view, message.road_m)
        number = self._store.add_pose(message.pose)
        self._follower.add_pose(number, message.pose)
        self._pose_ids[message.number] = number
        if len(self._pose_ids) > 2 * POSES_KEPT:
            known = self._follower.knows
            self._pose_ids = {k: v for k, v in self._pose_ids.items() if known(v)}

    def _take_frames(self, message: FramesMessage) -> None:
        found: list[SensorFrame] = []
        latest = time.time() + AHEAD_S
        for sensor, number, content in message.rows:
            pose = self._pose_ids.get(number, -1)  # the follower counts those of no pose
            try:
                _, frames = unpack_detections(content)
            except InputError:
                self._counts["damaged"] += 1
                continue
            mine = [each for each in frames if 0 < each.time_us < 1e6 * latest]
            self._counts["early"] += len(frames) - len(mine)
            alone = content if len(frames) == 1 else b""
            found += [SensorFrame(sensor, pose, each, alone) for each in mine]
        if found:
            self._counts["frames"] += len(found)
            self._now.take(self._follower.take(found))
            if self._follower.begins_anew is None:
                self._heard = time.monotonic()
                newest = max(each.detections.time_us for each in found) / 1e6
                self._newest_s = max(self._newest_s, newest)

    def _look(self) -> None:
        """Do what the clock asks for."""
        now = time.monotonic()
        if now - self._committed >= COMMIT_S:
            self._commit()
        if now - self._sent >= self._settings.now_s:
            self._sent = now
            self._now.go_on(self._newest_s - self._settings.reorder_s)
            self._tell(now=self._now.now())
        if self._work is not None and self._work.done():
            done, self._work = self._work, None
            try:
                found = done.result()
            except Exception as error:  # noqa: BLE001 - whatever it is, the next block is another
                self._counts["failed"] += 1
                self._say(f"vehicles of a minute are left out: {_told_of(error)}")
            else:
                self._done(found)
        self._begin_work(everything=now - self._heard > self._settings.silent_s)

    def _done(self, found: _Found) -> None:
        """Take in what the second thread found."""
        if isinstance(found, int):
            self._begin_anew(found)
        elif found is not None:
            self._now.correct(*found)

    def _commit(self) -> None:
        self._committed = time.monotonic()
        try:
            self._follower.keep()
        except OutputError as error:  # followed all the same, but gone with a restart
            self._say(error.message)

    def _begin_work(self, *, everything: bool) -> bool:
        """Begin what is due, where nothing is being done; return whether there was anything."""
        if self._work is not None:
            return False
        if (span := self._follower.due(everything=everything)) is not None:
            self._work = self._pool.submit(self._follow, *self._follower.begin(span))
            return True
        begin = self._follower.begins_anew
        if begin is None or not everything or time.monotonic() < self._anew_after:
            return False
        self._anew_after = time.monotonic() + self._settings.silent_s
        self._commit()  # else what was followed comes to the store behind the clearing
        self._work = self._pool.submit(self._make_room, begin)
        return True

    def _follow(self, block: Block, poses: tuple[int, ...]) -> tuple[float, Floats]:
        """Follow a block, and write the hours that are over."""
        before = time.thread_time()
        found = self._follower.finish(block, poses, unwritten=self._unwritten)
        self._counts["blocks"] += 1
        hour = block.first_step // HOUR_STEPS
        for each in sorted(self._unwritten - {hour}):
            self._write(each)
        self._unwritten.add(hour)
        if (block.last_step + 1) % HOUR_STEPS == 0:
            self._write(hour)
        self._counts["cpu_ms"] += round(1000 * (time.thread_time() - before))
        self._tell(finished=found)
        return (block.last_step + 1) / STEPS_PER_SECOND, found.stood

    def _make_room(self, begin: int) -> int:
        """Write what was followed from a step on, and put it aside: it will be followed anew."""
        for hour in sorted(self._unwritten):
            self._write(hour)
        aside = self._site.put_aside(begin // HOUR_STEPS)
        self._store.drop_from(begin)
        for hour in sorted(hour for hour in self._failing if hour >= begin // HOUR_STEPS):
            self._say(f"vehicles of {hour_name(hour)} could not be written: they are dropped")
            self._forget(hour)
        self._say(
            f"clocks were set back: vehicles are followed anew from {iso_from_step(begin)} on"
            + "".join(f"; {old} is put aside as {new}" for old, new in aside)
        )
        return begin

    def _begin_anew(self, begin: int) -> None:
        """Follow what waits from a step on, of which nothing is stored any more."""
        self._follower = self._follower.successor()
        self._now = NowFilter(
            graph=self._site.graph, tracker=self._settings.tracker(), settings=self._settings
        )
        self._heard, self._unwritten = time.monotonic(), set()
        done = self._follower.done
        self._tell(anew=_shown_since(begin - 1 if done is None else min(done, begin - 1)))
        self._resume()
        self._newest_s = (self._follower.newest_step + 1) / STEPS_PER_SECOND

    def _write(self, hour: int) -> None:
        """Write an hour; where that fails, it is tried again with each block, for a day."""
        try:
            path = self._follower.write_hour(hour)
        except Exception as error:  # noqa: BLE001 - a batch may be what it never can be
            since = self._failing.setdefault(hour, time.monotonic())
            name = f"vehicles of {hour_name(hour)}"
            self._say(f"{name} cannot be written: {_told_of(error)}; trying on")
            if time.monotonic() - since >= self._settings.give_up_s:
                self._say(f"{name} could not be written for too long: they are dropped")
                self._forget(hour)
            return
        self._forget(hour)
        self._said.clear()
        if path is not None:
            self._tell(written=path)

    def _forget(self, hour: int) -> None:
        self._unwritten.discard(hour)
        self._failing.pop(hour, None)

    def _say(self, text: str) -> None:
        if text not in self._said:  # once, however often it is tried again
            self._said.add(text)
            self._tell(said=text)

    def _tell(self, **news: Any) -> None:
        follower = self._follower
        counts = {
            **self._counts,
            "late": follower.late, "unknown": follower.unknown, "repeated": follower.repeated,
            "failing_hours": len(self._failing),
            "skipped_s": follower.skipped_steps / STEPS_PER_SECOND,
            "until_s": np.nan if follower.done is None else (follower.done + 1) / STEPS_PER_SECOND,
            "newest_s": self._newest_s if np.isfinite(self._newest_s) else np.nan,
        }  # fmt: skip
        self._hand_back(WorkerEvent(counts=counts, **news))


def _shown_since(done: int) -> int:
    """Return from which step on blocks are told again: the hour's, and a quarter of one before."""
    begin = min(done // HOUR_STEPS * HOUR_STEPS, done - SHOWN_STEPS)
    return begin // SHOWN_STEPS * SHOWN_STEPS


def _told_of(error: Exception) -> str:
    if isinstance(error, GisRadarError):
        return error.message
    return f"{type(error).__name__}: {error}"

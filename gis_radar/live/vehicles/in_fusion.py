"""Vehicles in fusion: hands on what sensors send to a process that follows them, and shows them."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from queue import Full
from threading import Event, Thread
from typing import Any

import geopandas as gpd
import numpy as np

from gis_radar.errors import NoAnswerError
from gis_radar.lanelets.graph import lane_graph
from gis_radar.live.detections import head_of
from gis_radar.live.health import SensorHealth
from gis_radar.live.settings import LiveSite
from gis_radar.live.store import KnownPose
from gis_radar.live.vehicles.counts import VehicleCounts
from gis_radar.live.vehicles.follower import POSES_KEPT, FollowedSite
from gis_radar.live.vehicles.now import VehiclesNow, layer_of
from gis_radar.live.vehicles.process import follow_in_process
from gis_radar.live.vehicles.settings import DEFAULTS, FollowSettings
from gis_radar.live.vehicles.store import FollowedPose
from gis_radar.live.vehicles.worker import (
    EndMessage,
    FramesMessage,
    PoseMessage,
    WorkerEvent,
)
from gis_radar.measures.views import ViewBook
from gis_radar.poses.pose import pose_from_dict
from gis_radar.processes import stop_workers
from gis_radar.progress import QUIET, Reporter
from gis_radar.sight import describe_sight
from gis_radar.steps import STEP_S, interval_steps
from gis_radar.tracking.map_check import map_of_tiles
from gis_radar.tracking.visibility import SensorView

HAND_ON_S = 0.1
CHANNEL = 100  # parcels that may wait for the process: 10 s
AGAIN_S = 10.0  # after the process ended unasked; twice as long each time that it was not ready
MOST_FAILED = 8  # so at most 43 minutes
READY_S = 0.05  # between two looks whether it is
END_S = 120.0  # for the last minutes to be followed and written
OLD_S = 5.0  # vehicles of now that are older are none
POSES_NAMED = POSES_KEPT // 2  # the process knows more, so it knows these
COUNTS = ("frames", "late", "early", "damaged", "unknown", "repeated", "blocks", "failed")


class LiveVehicles:
    """Vehicles of a live site.

    Parameters
    ----------
    site : LiveSite
        Of the site's file.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.
    book : ViewBook
        What is seen from poses.
    settings : FollowSettings
        Constants.
    reporter : Reporter
        Receives what happens.

    Attributes
    ----------
    counts : VehicleCounts
        Occupancy and passages lately.
    written : dict of Path
        Folders of hours, in order.

    Raises
    ------
    InputError
        If the map cannot be read, or is not that of the tiles.
    """

    def __init__(
        self, site: LiveSite, tiles: gpd.GeoDataFrame, book: ViewBook, *,
        settings: FollowSettings = DEFAULTS, reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        roads, described = map_of_tiles(site.map.file, tiles)
        self._site: FollowedSite | None = None
        try:
            graph = lane_graph(roads.lanelets)
        except NoAnswerError as error:
            reporter.log(f"vehicles are not followed: {error.message}", "warning")
        else:
            self._site = FollowedSite(
                sensors=sorted(each.name for each in site.sensor), tiles=tiles,
                fingerprint=book.road.fingerprint, graph=graph, map=described,
                sight=describe_sight(book.scan), folder=site.folder,
            )  # fmt: skip
        self.counts = VehicleCounts(tiles, interval=interval_steps(site.live.interval))
        self.written: dict[Path, None] = {}
        self.dropped = self.restarts = 0
        self._book, self._settings, self._reporter = book, settings, reporter
        self._now, self._crs = VehiclesNow.none(), tiles.crs
        self._event_counts: dict[str, float] = {}
        self._waiting: list[tuple[str, int, bytes]] = []
        self._process: Any = None
        self._inbox: Any = None
        self._outbox: Any = None
        self._known: dict[int, tuple[str, str]] = {}  # by row, sensor and view; used last is last
        self._handed = self._started = self._heard = 0.0
        self._ended = self._refused = self._lost = self._ready = self._broken_off = False
        self._behind, self._said, self._failed = 0.0, "", 0

    def make_ready(self, stop: Event) -> None:
        """Start the process, and wait until it can follow: the first time it compiles."""
        if self._process is None:
            self._start()  # what an earlier run left is finished, too
        while self._process is not None and self._process.is_alive() and not self._lost:
            self._take_in()
            if self._ready:
                return
            if stop.wait(READY_S):
                self._broken_off = True
                return

    def take(
        self, health: SensorHealth, stream: str, content: bytes,
        numbered: Mapping[tuple[str, int], int], poses: Mapping[int, KnownPose],
    ) -> None:  # fmt: skip
        """Take the content of a message of detections.

        Parameters
        ----------
        health : SensorHealth
            Of the sensor.
        stream : str
            Of the sensor's buffer.
        content : bytes
            What is handed on.
        numbered : mapping
            By stream and number, the id of a pose's row in the journal.
        poses : mapping
            By the id of their rows in the journal.

        Raises
        ------
        InputError
            If the bytes begin as no such content.
        """
        number, count = head_of(content)
        health.counts["detections"] += count
        row = numbered.get((stream, number))
        if self._site is None or row is None or not poses[row].content.trusted:
            health.counts["left_out"] += count
            return
        if self._process is None and not self._started:
            self._start()
        if self._process is None:
            self.dropped += 1
            return
        if row not in self._known:
            self._name_pose(health.name, row, poses[row])
        elif len(self._known) > 1:
            self._known[row] = self._known.pop(row)
        self._waiting.append((health.name, row, content))

    def _name_pose(self, sensor: str, row: int, pose: KnownPose) -> None:
        """Tell the process of a pose and of what is seen from it."""
        view, seen = (sensor, pose.view), None
        if view not in self._known.values():
            placed = pose_from_dict(pose.content.pose, what=f"the pose of {sensor}")
            seen = SensorView(
                sensor=sensor, view=pose.view, tile_id=self._book.tiles[pose.view],
                position=placed.position,
            )  # fmt: skip
        followed = FollowedPose(
            sensor=sensor,
            view=pose.view,
            validity_s=pose.content.validity_s,
            content=pose.content.pose,
        )
        road_m = self._book.road_m.get(view, float("nan"))
        if self._hand_on(PoseMessage(number=row, pose=followed, view=seen, road_m=road_m)):
            self._known[row] = view
            if len(self._known) > POSES_NAMED:
                del self._known[next(iter(self._known))]

    def _start(self) -> None:
        if self._site is None:
            return
        context = multiprocessing.get_context("spawn")
        self._inbox = context.Queue(CHANNEL)
        self._outbox, theirs = context.Pipe(duplex=False)
        site_from, site_to = context.Pipe(duplex=False)
        self._refused = self._lost = self._ready = False
        self._known, self._started, self._ended = {}, time.monotonic(), False
        self._process = context.Process(
            target=follow_in_process,
            args=(site_from, self._inbox, theirs, self._settings), daemon=True, name="vehicles",
        )  # fmt: skip
        self._process.start()
        theirs.close()  # only so the end of the process ends what it tells
        site_from.close()
        # As an argument it would fill the pipe of the start, and block if the process died there.
        Thread(target=_hand_over, args=(site_to, self._site), daemon=True, name="site").start()

    def _hand_on(self, message: object) -> bool:
        try:
            self._inbox.put_nowait(message)
        except Full:
            self._known = {}  # poses are named again
            return False
        return True

    def turn(self) -> None:
        """Hand on what came, and take in what was found; called often."""
        if self._process is None:
            if self._started and time.monotonic() - self._started > AGAIN_S * 2**self._failed:
                self._start()
            return
        if (self._lost or not self._process.is_alive()) and not self._ended:
            self._take_in()
            self._lose()
            return
        now = time.monotonic()
        if now - self._handed >= HAND_ON_S:
            self._handed = now
            rows, self._waiting = self._waiting, []
            if rows and not self._hand_on(FramesMessage(rows=rows)):
                self.dropped += len(rows)
            self._take_in()

    def _lose(self) -> None:
        """Go on without the process; a new one takes up what the old one kept on disk."""
        self.dropped += len(self._waiting)
        self._failed = 0 if self._ready else min(self._failed + 1, MOST_FAILED)
        stop_workers([self._process])
        if not self._refused:
            self.restarts += 1
            self._reporter.log(
                f"the process that follows vehicles has ended ({self._process.exitcode}); a new "
                "one takes up where it was",
                "warning",
            )
        self._inbox.cancel_join_thread()  # nobody reads what is still in it
        self._outbox.close()
        self._waiting, self._process, self._now = [], None, VehiclesNow.none()

    def _take_in(self) -> None:
        try:
            while not self._lost and self._outbox.poll():
                self._note(self._outbox.recv())
        except (EOFError, OSError):  # killed, maybe in the midst of a message
            self._lost = True

    def _note(self, event: WorkerEvent) -> None:
        """Note what the process tells."""
        if event.counts.get("newest_s") != self._event_counts.get("newest_s"):
            self._heard = time.monotonic()
        self._event_counts = event.counts or self._event_counts
        self._now = event.now or self._now
        if event.anew is not None:
            self.counts.begin_anew(event.anew)
        if event.finished is not None:
            self.counts.add(event.finished)
        if event.written is not None:
            self.written[event.written] = None
        if event.said and not (event.refused and event.said == self._said):  # once a reason
            self._reporter.log(event.said, "warning")
            self._said = event.said
        self._ended, self._refused = self._ended or event.ended, self._refused or event.refused
        self._ready = self._ready or event.ready
        skipped = self._event_counts.get("skipped_s", 0.0)
        if skipped > self._behind:
            self._reporter.log(
                f"following vehicles takes longer than the traffic: {skipped:.0f} s are left "
                "out so far",
                "warning",
            )
            self._behind = skipped

    def finish(self) -> None:
        """Process and write the last minutes, then stop the process."""
        self._handed = 0.0
        self.turn()
        if self._process is None:
            if not self._started:
                return
            self._start()  # it was lost a moment ago
        until = time.monotonic() + (0.0 if self._broken_off else END_S)
        sent = False
        while self._process.is_alive() and not self._ended and time.monotonic() < until:
            sent = sent or self._hand_on(EndMessage())
            self._take_in()
            time.sleep(0.02)
        self._take_in()
        if not self._ended and not self._broken_off:
            self._reporter.log("the last vehicles are written with the next start", "warning")
        stop_workers([self._process])
        self._inbox.cancel_join_thread()
        self._outbox.close()
        self._process = None

    def now(self) -> VehiclesNow:
        """Return the vehicles of now; none where nothing came for long."""
        newest = self._event_counts.get("newest_s", np.nan)
        old = not newest - self._now.time < OLD_S or time.monotonic() - self._heard > OLD_S
        return VehiclesNow.none() if old or self._process is None else self._now

    def figures(self) -> dict[str, float]:
        """Return counts and lags, by name, for Prometheus."""
        counts = self._event_counts
        newest, until = counts.get("newest_s", np.nan), counts.get("until_s", np.nan)
        return {
            "vehicles_now": float(len(self.now())),
            "vehicles_lag_seconds": newest - until,
            "vehicles_dropped_messages": float(self.dropped),
            "vehicles_skipped_seconds": counts.get("skipped_s", 0.0),
            "vehicles_failing_hours": counts.get("failing_hours", 0.0),
            "vehicles_process_restarts": float(self.restarts),
            "vehicles_cpu_seconds": counts.get("cpu_ms", 0.0) / 1000.0,
            **{f"vehicles_{name}": counts.get(name, 0.0) for name in COUNTS},
        }

    def columns(self) -> dict[str, Any]:
        """Return the columns of the map for QGIS: seconds since the interval last began."""
        found = self.counts.interval()
        return {
            "occupied_s": found.occupied * STEP_S, "visible_s": found.visible * STEP_S,
            "occupancy": found.share(),
        }  # fmt: skip

    def layer(self) -> gpd.GeoDataFrame:
        """Return the vehicles of now as points in the map."""
        return layer_of(self.now(), self._crs)


def _hand_over(connection: Connection[FollowedSite, Any], site: FollowedSite) -> None:
    """Send the site to the process, on a thread of its own: it may have ended already."""
    with suppress(OSError), connection:
        connection.send(site)

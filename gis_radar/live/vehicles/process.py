"""The process that follows vehicles beside fusion: ready once what it runs is compiled."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue as Channel
from queue import Full, Queue
from threading import Thread
from typing import Any

from gis_radar.errors import GisRadarError
from gis_radar.live.first_run import NOT_COMPILED
from gis_radar.live.vehicles.first_run import run_vehicles_once
from gis_radar.live.vehicles.follower import FollowedSite
from gis_radar.live.vehicles.settings import FollowSettings
from gis_radar.live.vehicles.store import VehicleStore
from gis_radar.live.vehicles.worker import VehicleWorker, WorkerEvent
from gis_radar.processes import watch_parent

STORE_FILE = "vehicles.sqlite"
MOST_EVENTS = 1_000  # that may wait for fusion


class _Outbox:
    """Sends events on a thread of its own: fusion may be busy, and a pipe holds little."""

    def __init__(self, connection: Connection[WorkerEvent, Any]) -> None:
        self._connection = connection
        self._waiting: Queue[WorkerEvent | None] = Queue(MOST_EVENTS)
        self._thread = Thread(target=self._send, daemon=True, name="events")
        self._thread.start()

    def _send(self) -> None:
        with suppress(OSError):  # fusion has closed its end: it wants no more
            while (event := self._waiting.get()) is not None:
                self._connection.send(event)

    def put(self, event: WorkerEvent) -> None:
        with suppress(Full):  # the vehicles of now come again; all else waits
            self._waiting.put(event, block=event.now is None, timeout=60.0)

    def close(self) -> None:
        """Send all events that wait."""
        with suppress(Full):
            self._waiting.put(None, timeout=60.0)
        self._thread.join(60.0)


def follow_in_process(
    sites: Connection[Any, FollowedSite], inbox: Channel[Any], outbox: Connection[WorkerEvent, Any],
    settings: FollowSettings,
) -> None:  # fmt: skip
    """Work until the end message; runs in a process of its own. The site comes first."""
    watch_parent()
    site = sites.recv()
    events = _Outbox(outbox)
    _run_once(settings, events)
    events.put(WorkerEvent(counts={}, ready=True))
    try:
        store = VehicleStore(site.folder / STORE_FILE, fingerprint=site.fingerprint)
    except GisRadarError as error:
        events.put(WorkerEvent(counts={}, said=error.message, refused=True))
    else:
        if store.put_aside is not None:
            said = f"{store.path}: it is damaged: put aside as {store.put_aside.name}"
            events.put(
                WorkerEvent(counts={}, said=f"{said}; vehicles of the last hour may be missing")
            )
        VehicleWorker(site, store, inbox, events.put, settings).run()
        store.close()
    events.close()


def _run_once(settings: FollowSettings, events: _Outbox) -> None:
    """Compile the tracker; a signal removes its temporary files."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        run_vehicles_once(settings)
    except (GisRadarError, OSError) as error:
        events.put(WorkerEvent(counts={}, said=NOT_COMPILED.format(error)))
    finally:
        signal.signal(signal.SIGTERM, before)

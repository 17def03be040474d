"""Fusion: what all sensors of a site send becomes the map of now, and a folder of hits an hour."""

from __future__ import annotations

import gc
import secrets
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from gis_radar.errors import GisRadarError, OutputError
from gis_radar.files import atomic_write
from gis_radar.live.background import BackgroundTask
from gis_radar.live.broker import FUSION, Link, SensorTopics
from gis_radar.live.first_run import compile_first, run_fusion_once
from gis_radar.live.health import prometheus_text, serve_metrics
from gis_radar.live.hour_copy import write_copied
from gis_radar.live.hours import HOUR_US
from gis_radar.live.intake import Intake, SensorState
from gis_radar.live.journal import Journal
from gis_radar.live.lane_push import LanePush
from gis_radar.live.map_of_now import MapOfNow, MapState
from gis_radar.live.payload import Acknowledgement
from gis_radar.live.settings import DEFAULTS, LiveSettings, LiveSite, read_live_site
from gis_radar.live.snapshot import place_of
from gis_radar.live.store import Store
from gis_radar.live.vehicles.in_fusion import LiveVehicles
from gis_radar.live.windows import Seen, Windows
from gis_radar.measures.views import ViewBook
from gis_radar.progress import QUIET, Reporter
from gis_radar.sight import SightTiles, describe_sight, open_sight
from gis_radar.steps import STEP_US, interval_steps
from gis_radar.tiles import read_tiles

if TYPE_CHECKING:
    import geopandas as gpd

    from gis_radar.live.server import Page

TAKEN_AT_ONCE = 500  # messages between two looks at the clock
WAIT_S = 0.01
SAID_S = 600.0  # until the same error is logged again: a disk stays full for hours
HITS_FOLDER_NAME, JOURNAL_FILE, NOW_FILE = "hits", "journal.sqlite", "now.gpkg"
PUSH_FILE = "sensorthings.json"


class Fusion:
    """The live system's middle.

    Parameters
    ----------
    site : LiveSite
        Of the site's file.
    settings : LiveSettings
        Constants.
    reporter : Reporter
        Receives what happens.

    Raises
    ------
    InputError
        If tiles or scans cannot be read.
    OutputError
        If its folder cannot be written.
    """

    def __init__(
        self, site: LiveSite, *, settings: LiveSettings = DEFAULTS, reporter: Reporter = QUIET
    ) -> None:
        self._site, self._settings, self._reporter = site, settings, reporter
        self._said: dict[str, float] = {}  # errors, and when they were logged
        self.tiles = read_tiles(site.live.tiles)
        road = SightTiles.of(self.tiles)
        scans = site.scan.files if site.scan is not None else ()
        scan = open_sight(
            road, scans=scans, scan_crs=site.scan.crs if site.scan else None, sight=None,
            reporter=reporter,
        )  # fmt: skip
        self._book = ViewBook(road=road, scan=scan)
        folder = site.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made: {error.strerror}") from error
        self._journal = Journal(folder / JOURNAL_FILE, fingerprint=road.fingerprint)
        self._store = Store(
            folder=folder / HITS_FOLDER_NAME, fingerprint=road.fingerprint, tile_id=road.tile_id,
            sight=describe_sight(scan),
        )  # fmt: skip
        self._windows = Windows(site.live.lateness)
        self._map = MapOfNow(len(road.tile_id), interval=interval_steps(site.live.interval))
        self.vehicles: LiveVehicles | None = (
            LiveVehicles(site, self.tiles, self._book, reporter=reporter)
            if site.live.vehicles else None
        )  # fmt: skip
        self._page = _page(self, site)
        self._push = _push(site, self.tiles, reporter)
        self._written: dict[Path, None] = {}
        self._writer, self._exporter = (
            BackgroundTask[Path | None]("hour"),
            BackgroundTask[None]("export"),
        )
        self._hour = (0, 0.0)  # that is being written, and when a frame of it came last
        self._committer = BackgroundTask[None]("commit")
        self._committing: list[tuple[SensorState, str, int]] = []  # up to which number of a stream
        self._session = secrets.token_hex(4)
        self._committed = self._exported = time.monotonic()
        self.intake = Intake(
            [each.name for each in site.sensor], site=site.live.site, book=self._book,
            journal=self._journal, windows=self._windows, current=self._map, settings=settings,
            reporter=reporter,
        )  # fmt: skip
        self.sensors, self.intake.vehicles = self.intake.sensors, self.vehicles
        now_us = int(time.time() * 1e6)
        self._advance(self.intake.resume(_counted_since(site, now_us), now_us))

    @property
    def outputs(self) -> list[Path]:
        """The folders of the hours that were written, and the files for QGIS."""
        followed = self.vehicles.written if self.vehicles is not None else {}
        return [*self._written, *followed, self._site.folder / NOW_FILE]

    def figures(self) -> dict[str, object]:
        """Return what came of each sensor, by name."""
        return {"sensors": {name: dict(each.health.counts) for name, each in self.sensors.items()}}

    def state(self) -> MapState:
        """Return the map of now."""
        return self._map.state()

    def metrics(self) -> str:
        """Return health as text for Prometheus."""
        open_frames = float(self._journal.waiting)
        figures = {
            "unwritten_frames": open_frames,
            "unwritten_hours": float(len(self.intake.touched)),
            "map_step": float(self._map.step),
            "unknown_sensors": float(len(self.intake.unknown)),
            "broker_connections": float(self._link.connections) if self._link else 0.0,
        }
        if self.vehicles is not None:
            figures |= self.vehicles.figures()
        return prometheus_text([each.health for each in self.sensors.values()], figures)

    _link: Link | None = None

    def run(self, stop: Event) -> None:
        """Work until it is stopped; then all that is stored is written as folders.

        Parameters
        ----------
        stop : Event
            Set from outside.
        """
        live = self._site.live
        compile_first(run_fusion_once, stop, self._reporter)
        if self.vehicles is not None:
            self.vehicles.make_ready(stop)
        topics = SensorTopics(live.site, "+")
        own = SensorTopics(live.site, FUSION).of("status")
        link = Link(
            self._site.address(), name=f"{live.site}-fusion",
            topics=tuple(topics.of(kind) for kind in ("pose", "status", "hits", "detections")),
            will=(own, b'{"version": 1, "state": "offline"}'), reporter=self._reporter,
        )  # fmt: skip
        self._link = link
        server = serve_metrics(live.health, self.metrics) if live.health else None
        if self._page is not None:
            self._reporter.log(f"the page is at {self._page.open()}")
        self._export(self.state())  # the first takes long, before frames come
        gc.collect()
        gc.freeze()  # what is there now stays: to look through it holds frames up for 0.3 s
        link.open()
        connections = 0
        try:
            while not stop.is_set():
                if link.connections != connections and link.connected:
                    connections = link.connections
                    link.publish(own, b'{"version": 1, "state": "online"}', retain=True)
                    for each in self.sensors.values():
                        each.due = bool(each.stream)
                self._take(link)
                self._advance(self._windows.close(int(time.time() * 1e6)))
                self._regular()
            self._finish()
        finally:
            gc.unfreeze()
            link.close(own, b'{"version": 1, "state": "offline"}')
            if server is not None:
                server.close()
            if self._page is not None:
                self._page.close()
            self._journal.__exit__()

    def _take(self, link: Link) -> None:
        message = link.take(WAIT_S)
        for _ in range(TAKEN_AT_ONCE):
            if message is None:
                return
            self.intake.handle(message)
            # of each stream: a replay does not wait for the clock, many radars do
            most = self._settings.commit_frames * max(self._journal.streams_waiting, 1)
            if self._journal.waiting >= most:
                self._commit()
            message = link.take(0.0)

    def _advance(self, steps: Iterable[tuple[int, dict[str, Seen]]]) -> None:
        for step, frames in steps:
            self._map.take(step, frames)
            if self._page is not None:
                state = self._map.state()
                self._page.take(step, state.hit, state.observed)
            if self._push is not None:
                state = self._map.state()
                self._push.take(step, state.hit, state.observed)

    def _regular(self) -> None:
        """Do what the clock asks for: commit, acknowledge, write hours and files."""
        now = time.monotonic()
        self._take_committed()
        if now - self._committed >= self._settings.commit_s:
            self._commit()
            for each in self.sensors.values():
                each.health.look(time.time())
            self._write_what_is_over(now)
        if now - self._exported >= self._site.live.every and not self._exporter.busy:
            self._exported = now
            state = self.state()
            self._exporter.begin(lambda: self._export(state))
        self._exporter.take()
        if self._push is not None:
            self._push.regular()
        for each in self.sensors.values():
            if each.due:
                self._acknowledge(each)
        if self.vehicles is not None:
            self.vehicles.turn()

    def _commit(self, *, wait: bool = False) -> None:
        """Begin to bring frames to the disk, on another thread: the map goes on meanwhile."""
        self._take_committed(wait=wait)
        if self._committer.busy:
            return
        self._committed = time.monotonic()
        if self._journal.collect():
            self._committing = [
                (each, each.stream, each.received) for each in self.sensors.values()
            ]
            self._committer.begin(self._journal.write)
            self._take_committed(wait=wait)

    def _take_committed(self, *, wait: bool = False) -> None:
        """Acknowledge what has come to the disk; nothing else ever is."""
        if not self._committer.busy:
            return
        try:
            self._committer.take(wait=wait)
        except OutputError as error:
            self._say(error)
            return
        if self._committer.busy:
            return
        for sensor, stream, number in self._committing:
            if sensor.stream == stream and sensor.stored < number:
                sensor.stored, sensor.due = number, True
                self._acknowledge(sensor)
        self._forget()

    def _forget(self) -> None:
        try:
            self.intake.forget()
        except OutputError as error:
            self._say(error)

    def _acknowledge(self, sensor: SensorState) -> None:
        if self._link is None or not self._link.connected:
            return
        sensor.due = False
        found = Acknowledgement(
            stream=sensor.stream, stored=sensor.stored, session=self._session,
            resend=sensor.resend, refused=sensor.refused,
        )  # fmt: skip
        self._link.publish(sensor.topics.of("ack"), found.pack(), retain=True)

    def _write_what_is_over(self, now: float) -> None:
        """Begin to write an hour that is over, once the one before it is written."""
        self._take_written()
        over = int((time.time() - self._settings.settle_s) * 1e6) // HOUR_US
        for hour, touched in self.intake.touched.items():
            quiet = now - touched >= self._settings.settle_s
            if hour < over and quiet and not self._writer.busy:
                self._begin_hour(hour)

    def _begin_hour(self, hour: int, *, here: bool = False) -> None:
        """Begin to write an hour: in another process, or here where the map has ended."""
        self._hour = (hour, self.intake.touched[hour])
        self._journal.watch(hour)
        poses, tiles, sensors = dict(self.intake.poses), dict(self._book.tiles), list(self.sensors)
        write = partial(self._store.write_hour) if here else partial(write_copied, self._store)
        self._writer.begin(lambda: write(hour, self._journal, poses, tiles, sensors))

    def _take_written(self, *, wait: bool = False) -> None:
        """Take note of an hour that was written meanwhile."""
        if not self._writer.busy:
            return
        hour, touched = self._hour
        try:
            path = self._writer.take(wait=wait)
            if self._writer.busy:
                return
            self._journal.unwatch()
        except GisRadarError as error:
            self.intake.touched[hour] = time.monotonic()  # tried again later; the journal keeps it
            self._say(error)
            return
        if self.intake.touched.get(hour) == touched:  # else frames came meanwhile: once more
            self.intake.touched.pop(hour, None)
        if path is not None:
            self._written[path] = None

    def _finish(self) -> None:
        self._commit(wait=True)
        self._take_written(wait=True)
        for hour in list(self.intake.touched):
            self._begin_hour(hour, here=True)
            self._take_written(wait=True)
        if self.vehicles is not None:
            self.vehicles.finish()
        self._exporter.take(wait=True)
        self._export(self.state())

    def _export(self, state: MapState) -> None:
        """Replace the files for QGIS."""
        observed_s = state.observed_steps * (STEP_US / 1e6)
        hit_s = state.hit_steps * (STEP_US / 1e6)
        share = np.divide(
            hit_s, observed_s, out=np.full(len(observed_s), np.nan), where=observed_s > 0
        )
        table = self.tiles[["tile_id", "lanelet_id", "geometry"]].assign(
            time=state.time, hit=state.hit.astype(np.int8),
            observed=state.observed.astype(np.int8), hit_s=hit_s,
            observed_s=observed_s, hit_share=share,
        )  # fmt: skip
        if self.vehicles is not None:
            table = table.assign(**self.vehicles.columns())
        try:
            with atomic_write(self._site.folder / NOW_FILE) as part:
                table.to_file(part, layer="now", driver="GPKG", engine="pyogrio")
                if self.vehicles is not None:
                    layer = self.vehicles.layer()
                    layer.to_file(part, layer="vehicles", driver="GPKG", engine="pyogrio", mode="a")
        except GisRadarError as error:
            self._say(error)

    def _say(self, error: GisRadarError) -> None:
        now = time.monotonic()
        if now - self._said.get(error.message, -SAID_S) >= SAID_S:
            self._said[error.message] = now
            hint = f" ({error.hint})" if error.hint else ""
            self._reporter.log(error.message + hint, "warning")


def _page(fusion: Fusion, site: LiveSite) -> Page | None:
    """Return the page where the site's file asks for one; only then is a web server loaded."""
    if site.live.page is None:
        return None
    from gis_radar.live.server import Page  # noqa: PLC0415

    return Page(fusion, site, site.live.page, fusion.tiles)


def _counted_since(site: LiveSite, now_us: int) -> int:
    """Return when the intervals began that count now, those of the map and of the push."""
    texts = [site.live.interval]
    if site.live.sensorthings is not None:
        texts.append(site.live.sensorthings.interval)
    return min(now_us - now_us % (interval_steps(each) * STEP_US) for each in texts)


def _push(site: LiveSite, tiles: gpd.GeoDataFrame, reporter: Reporter) -> LanePush | None:
    """Return the push of lane measures where the site's file asks for one."""
    if site.live.sensorthings is None:
        return None
    return LanePush(
        site.live.sensorthings, place_of(site, tiles), site=site.live.site,
        path=site.folder / PUSH_FILE, reporter=reporter,
    )  # fmt: skip


def run_fusion(
    path: str | Path, *, stop: Event | None = None, reporter: Reporter = QUIET
) -> Fusion:
    """Run the middle of the live system.

    Parameters
    ----------
    path : str or Path
        A site's file with a table `[live]`, described in `docs/live.md`.
    stop : Event, optional
        Set from outside to stop.
    reporter : Reporter
        Receives what happens.

    Raises
    ------
    InputError
        If the file, tiles or scans cannot be read.
    OutputError
        If its folder cannot be written, or another fusion runs in it.
    """
    site = read_live_site(path)
    fusion = Fusion(site, reporter=reporter)
    fusion.run(stop or Event())
    return fusion

"""Fusion: make the map of now, recordings and a dataset from the messages of a site's sensors."""

from __future__ import annotations

import gc
import secrets
import time
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from gis_radar.base import (
    QUIET,
    STEP_S,
    GisRadarError,
    InputError,
    NoAnswerError,
    OutputError,
    Reporter,
    Text,
    atomic_write,
    interval_steps,
    only_writer,
    output_errors,
    quotient,
)
from gis_radar.hdmap import lane_graph, read_tiles
from gis_radar.live.alerts import Alerts, Webhook
from gis_radar.live.background import in_background
from gis_radar.live.health import prometheus_text
from gis_radar.live.hours.hour_work import MeasuredSite, refuse_other_settings
from gis_radar.live.hours.jobs import HourJobs
from gis_radar.live.hours.quarters import Quarters
from gis_radar.live.hours.recent import RecentCounts
from gis_radar.live.hours.spool import Spool, SpoolFile, spool_files
from gis_radar.live.intake import Intake, SensorState
from gis_radar.live.now.map_of_now import MapOfNow, MapState, SensorReport, Windows
from gis_radar.live.now.vehicles_now import LiveVehicles, layer_of
from gis_radar.live.served.lane_push import LanePush
from gis_radar.live.served.snapshot import lanes_of_map, place_of
from gis_radar.live.wire.broker import FUSION, LIVE, Link, SensorTopics
from gis_radar.live.wire.outbox import OFFLINE_STATUS, ONLINE_STATUS, status_message
from gis_radar.live.wire.payload import DETECTIONS_TOPIC, POSE_TOPIC, Acknowledgement
from gis_radar.live.wire.settings import LiveSite, read_live_site
from gis_radar.measures import FrameCounter, validity_of
from gis_radar.scans import SightTiles, open_sight
from gis_radar.tracking import map_of_tiles

if TYPE_CHECKING:
    from pathlib import Path

    import geopandas as gpd

    from gis_radar.live.web_server import WebServer

_MESSAGES_AT_ONCE = 500  # most messages between two looks at the clock
WAIT_S = 0.01  # longest wait for a message
# Between two commits: a kill costs a second of messages, which the sensors send again.
_COMMIT_S = 1.0
# Messages of a sensor that are committed sooner: a fast replay does not wait
_COMMIT_MESSAGES = 200
_SPOOL_BYTES = 1 << 28  # size from which the spool goes on in another file
_LOG_AGAIN_S = 600.0  # least time between two logs of one error: a disk stays full for hours
_SPOOL, _NOW_FILE, _PUSH_FILE, _ALERTS = "spool", "now.gpkg", "sensorthings.json", "alerts.json"


class Fusion:
    """Fusion of a live site.

    Parameters
    ----------
    site : LiveSite
        The site's file.
    webhook : Webhook, optional
        Receives alerts, beside the broker.
    reporter : Reporter
        Receives the log.

    Raises
    ------
    InputError
        If tiles or scans cannot be read.
    OutputError
        If its folder cannot be written.
    """

    def __init__(
        self, site: LiveSite, *, webhook: Webhook | None = None, reporter: Reporter = QUIET
    ) -> None:
        self._site, self._reporter, self._webhook = site, reporter, webhook
        self._logged: dict[str, float] = {}  # errors, with the time at which each was logged
        self.tiles = read_tiles(site.live.tiles)
        road, filters = SightTiles.of(self.tiles), site.filters()
        _require_heights(site, road)
        measured = _measured_site(site, self.tiles)
        scan = open_sight(road, scans=measured.scans, scan_crs=measured.scan_crs, reporter=reporter)
        folder, names = site.folder, [each.name for each in site.sensor]
        with output_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        self._folder_lock = ExitStack()
        self._folder_lock.enter_context(only_writer(folder / _SPOOL, reporter=reporter))
        refuse_other_settings(measured, self.tiles, scan)
        self._dataset = measured.dataset
        self.vehicles = _vehicle_follower(site, self.tiles, names, reporter)
        self.quarters = Quarters()
        self._jobs = HourJobs(measured, self.quarters, reporter=reporter)
        self._map = MapOfNow(len(road.tile_id))
        self._map.validity_s = dict(validity_of(site.cycles(), names))
        self.counts = RecentCounts(len(road.tile_id), interval=interval_steps(site.live.interval))
        self._windows = Windows(site.live.lateness)
        self._spool = Spool(folder / _SPOOL)
        self.intake = Intake(
            names, spool=self._spool, road=road, scan=scan,
            counter=FrameCounter(road, filters=filters), windows=self._windows,
            oldest_s=site.live.oldest, vehicles=self.vehicles, reporter=reporter,
        )  # fmt: skip
        self.sensors = self.intake.sensors
        self._alerts = Alerts(
            site.live.site, [each.health for each in self.sensors.values()],
            path=folder / _ALERTS, publish=self._publish_alert, webhook=webhook,
            language=site.language, reporter=reporter,
        )  # fmt: skip
        self._page, self._push = server_of_page(self, site), _lane_push(site, self.tiles, reporter)
        self._exporting: Future[None] | None = None
        self._writing: Future[bool] | None = None
        self._session = secrets.token_hex(4)
        self._committed = self._exported = time.monotonic()
        self.intake.resume([SpoolFile(path) for path in spool_files(folder / _SPOOL)])
        self._spool.rotate()

    @property
    def outputs(self) -> list[Path]:
        """The dataset, where there is one, and the file for QGIS."""
        dataset = [self._dataset] if self._dataset.exists() else []
        return [*dataset, self._site.folder / _NOW_FILE]

    def figures(self) -> dict[str, object]:
        """Return the counts of each sensor, by its name."""
        return {"sensors": {name: dict(each.health.counts) for name, each in self.sensors.items()}}

    def state(self) -> MapState:
        """Return the map of now."""
        return self._map.state()

    def metrics(self) -> str:
        """Return health as text for Prometheus."""
        figures = {
            "unwritten_messages": float(self._spool.waiting),
            "map_step": float(self.state().step),
            "unknown_sensors": float(len(self.intake.unknown)),
            "broker_connections": float(self.link.connections) if self.link else 0.0,
            **self._jobs.figures(),
        }
        for each in (self.vehicles, self._webhook):
            figures |= each.figures() if each is not None else {}
        return prometheus_text([each.health for each in self.sensors.values()], figures)

    link: Link | None = None

    def run(self, stop: Event) -> None:
        """Run until stopped, then measure the hours that are over.

        Parameters
        ----------
        stop : Event
            Event that stops it.
        """
        live = self._site.live
        self._jobs.resume(self._spool.closed)
        if self.vehicles is not None:
            self.vehicles.make_ready()
        topics = SensorTopics(live.site, "+")
        own = SensorTopics(live.site, FUSION).of("status")
        link = Link(
            self._site.address(), name=f"{live.site}-fusion",
            topics=tuple(topics.of(kind) for kind in (POSE_TOPIC, "status", DETECTIONS_TOPIC)),
            will=(own, status_message(OFFLINE_STATUS)), reporter=self._reporter,
        )  # fmt: skip
        self.link = link
        if self._page is not None:
            self._reporter.log(Text("the page is at {}", self._page.open()))
        self._export()  # the first takes long, before frames come
        gc.collect()
        gc.freeze()  # present objects stay: scanning them for garbage delays frames by 0.3 s
        for each in self.sensors.values():  # no sensor could be heard before
            each.health.heard_s = time.time()
        link.open()
        connections = 0
        try:
            while not stop.is_set():
                if link.connections != connections and link.connected:
                    connections = link.connections
                    link.publish(own, status_message(ONLINE_STATUS), retain=True)
                    self._alerts.repeat()
                    for each in self.sensors.values():
                        each.due = bool(each.stream)
                self.advance(int(time.time() * 1e6))
                self._take(link)
                self._do_due_work()
            self._reporter.log(
                Text("stopping: records what came, and measures hours that are over; a second "
                     "Ctrl-C leaves that to the next start")
            )  # fmt: skip
            self._finish()
        finally:
            gc.unfreeze()
            link.close(own, status_message(OFFLINE_STATUS))
            if self._page is not None:
                self._page.close()
            self.close()

    def close(self) -> None:
        """Close the files and end the processes."""
        if self.vehicles is not None:
            self.vehicles.close()
        self._jobs.stop()
        self._spool.close()
        self._folder_lock.close()

    def _take(self, link: Link) -> None:
        """Handle received messages, at most `_MESSAGES_AT_ONCE`; wait `WAIT_S` for the first."""
        message = link.take(WAIT_S)
        for _ in range(_MESSAGES_AT_ONCE):
            if message is None:
                return
            self.intake.handle(message)
            # a limit for each sensor: a fast replay reaches it, many radars wait for the clock
            if self._spool.waiting >= _COMMIT_MESSAGES * len(self.sensors):
                self._commit()
            message = link.take(0.0)

    def advance(self, now_us: int) -> None:
        """Count the steps that are over by now, microseconds since 1970."""
        for step, frames in self._windows.close(now_us):
            self._count(step, frames)

    def _count(self, step: int, frames: dict[str, SensorReport]) -> None:
        state = self._map.take(step, frames)
        self.counts.take(step, state.hit, state.observed)

    def _do_due_work(self) -> None:
        """Do what is due by the clock: commit, acknowledge, measure, write files."""
        now = time.monotonic()
        self._acknowledge_written()
        if now - self._committed >= _COMMIT_S:
            self._commit()
            for each in self.sensors.values():
                each.health.check(time.time())
            self._alerts.check(time.time(), now)
        self._measure()
        idle = self._exporting is None or self._exporting.done()
        if now - self._exported >= self._site.live.every and idle:
            self._wait_for_export()
            self._exported, self._exporting = now, in_background("export", self._export)
        if self._push is not None:
            self._push.take(self.quarters.measured)
            self._push.poll()
        for each in self.sensors.values():
            if each.due:
                self._acknowledge(each)
        if self.vehicles is not None:
            self.vehicles.poll()

    def _commit(self, *, wait: bool = False) -> None:
        """Start writing messages to the disk on another thread, while the map goes on."""
        self._acknowledge_written(wait=wait)
        if self._writing is not None:
            return
        self._committed, rotate = time.monotonic(), self._jobs.wanted
        if self._spool.collect() or rotate:
            self._writing = in_background("disk", partial(self._write, rotate=rotate))
            self._acknowledge_written(wait=wait)

    def _write(self, *, rotate: bool) -> bool:
        """Write the collected messages; return whether the spool goes on in a new file."""
        self._spool.write()
        if rotate:
            self._spool.rotate()
        return rotate

    def _acknowledge_written(self, *, wait: bool = False) -> None:
        """Acknowledge the messages that are on disk, and only these; start a waiting job."""
        if self._writing is None or not (wait or self._writing.done()):
            return
        disk, self._writing = self._writing, None
        try:
            rotated = disk.result()
        except OutputError as error:  # retried later; waiting messages are kept
            rotated = False
            self._log_error(error)
        for name, each in self.sensors.items():
            if self._spool.mark_of(name, each.stream).number != each.acknowledged:
                self._acknowledge(each)
        if rotated:
            self._jobs.begin(self._spool.closed)

    def _measure(self) -> None:
        """Start measuring what is over, once the spool is closed up to here."""
        self._jobs.touch(self.intake.touched)
        self.intake.touched = set()
        newest = {name: each.health.newest_s for name, each in self.sensors.items()}
        full = self._spool.size > _SPOOL_BYTES
        self._jobs.poll(time.time(), newest, full=full)
        for name, doubt in self._jobs.doubts.items():
            if name in self.sensors:
                self.sensors[name].health.alarm("pose", doubt)

    def _acknowledge(self, sensor: SensorState) -> None:
        """Publish what fusion has stored of a sensor's stream."""
        if self.link is None or not self.link.connected:
            return
        sensor.due, name = False, sensor.health.name
        mark = self._spool.mark_of(name, sensor.stream)
        found = Acknowledgement(
            stream=sensor.stream, stored=mark.number, check=mark.check, session=self._session,
            resend=sensor.resend, refused=sensor.refused,
        )  # fmt: skip
        topic = SensorTopics(self._site.live.site, name).of("ack")
        self.link.publish(topic, found.pack(), retain=True)
        sensor.acknowledged = mark.number

    def _publish_alert(self, sensor: str, alert: bytes) -> None:
        if self.link is not None:
            topic = SensorTopics(self._site.live.site, sensor).of("health")
            self.link.publish(topic, alert, retain=True)

    def _finish(self) -> None:
        """Store what came, measure the hours that are over, and write the files a last time."""
        self._jobs.stop()
        self._commit(wait=True)
        if self.vehicles is not None:
            self.vehicles.close()
        self._jobs.touch(self.intake.touched)
        try:
            self._spool.rotate()
        except OutputError as error:
            self._log_error(error)
        self._jobs.finish(self._spool.closed)
        self._wait_for_export()
        self._export()

    def _wait_for_export(self) -> None:
        """Wait until the files are written; raise what went wrong."""
        if self._exporting is not None:
            self._exporting.result()

    def _export(self) -> None:
        """Replace the file for QGIS."""
        state = self.state()
        hit_s, observed_s = (STEP_S * each for each in self.counts.since_begin())
        table = self.tiles[["tile_id", "lanelet_id", "geometry"]].assign(
            time=state.time, hit=state.hit.astype(np.int8),
            observed=state.observed.astype(np.int8), hit_s=hit_s,
            observed_s=observed_s, hit_share=quotient(hit_s, observed_s),
        )  # fmt: skip
        if (quarter := self.quarters.newest()) is not None:
            table = table.assign(
                occupied_s=quarter.occupied * STEP_S, visible_s=quarter.visible * STEP_S,
                occupancy=quarter.occupancy(),
            )  # fmt: skip
        path = self._site.folder / _NOW_FILE
        try:
            with output_errors(path), atomic_write(path) as part:
                table.to_file(part, layer="now", driver="GPKG", engine="pyogrio")
                if self.vehicles is not None:
                    layer = layer_of(self.vehicles.now(), self.tiles.crs)
                    layer.to_file(part, layer="vehicles", driver="GPKG", engine="pyogrio", mode="a")
        except GisRadarError as error:
            self._log_error(error)

    def _log_error(self, error: GisRadarError) -> None:
        now = time.monotonic()
        if now - self._logged.get(error.message, -_LOG_AGAIN_S) >= _LOG_AGAIN_S:
            self._logged[error.message] = now
            hint = f" ({error.hint})" if error.hint else ""
            self._reporter.warn(error.message + hint)


def _require_heights(site: LiveSite, road: SightTiles) -> None:
    """Refuse a filter by clearance where the tiles have no heights."""
    if site.filters().clearance is not None and np.isnan(road.height).all():
        raise InputError(
            "{}: the tiles have no road heights, which clearance needs",
            site.live.tiles,
            hint=Text("make them with {}, or from a map with ele", "--road"),
        )


def _measured_site(site: LiveSite, tiles: gpd.GeoDataFrame) -> MeasuredSite:
    """Return the inputs from which the hours of a site are made."""
    scan, streets = site.scan, lanes_of_map(site, tiles) if site.map.streets else None
    return MeasuredSite(
        folder=site.folder, map=site.map.file, tiles=site.live.tiles,
        sensors=sorted(each.name for each in site.sensor),
        scans=scan.files if scan else (), scan_crs=scan.crs if scan else None,
        filters=site.filters(), cycles=site.cycles(), timezone=site.timezone,
        vehicles=site.live.vehicles, keep_s=site.live.keep, most_bytes=1e9 * site.live.gigabytes,
        of_lanes={**site.of_lanes, "streets": streets},
    )  # fmt: skip


def _vehicle_follower(
    site: LiveSite, tiles: gpd.GeoDataFrame, names: list[str], reporter: Reporter
) -> LiveVehicles | None:
    """Return the follower of vehicles, where the site's file and its map allow one."""
    if not site.live.vehicles:
        return None
    roads, _ = map_of_tiles(site.map.file, tiles)
    try:
        graph = lane_graph(roads.lanelets)
    except NoAnswerError as error:
        reporter.warn("vehicles are not followed: {}", error.message)
        return None
    return LiveVehicles(graph, names, reporter=reporter)


def server_of_page(fusion: Fusion, site: LiveSite) -> WebServer | None:
    """Return the web server of the page, imported only if the site's file asks for a page."""
    if site.live.page is None:
        return None
    try:
        from gis_radar.live.served.page import page_server  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as error:
        raise GisRadarError(
            "{} is not installed", str(error.name).partition(".")[0], hint=LIVE
        ) from error
    return page_server(fusion, site, site.live.page, fusion.tiles)


def _lane_push(site: LiveSite, tiles: gpd.GeoDataFrame, reporter: Reporter) -> LanePush | None:
    """Return the push of lane measures where the site's file asks for one."""
    if site.live.sensorthings is None:
        return None
    return LanePush(
        site.live.sensorthings, place_of(site, tiles), site=site.live.site,
        path=site.folder / _PUSH_FILE, reporter=reporter,
    )  # fmt: skip


def run_fusion(
    path: str | Path, *, webhook: str | None = None, stop: Event | None = None,
    reporter: Reporter = QUIET,
) -> Fusion:  # fmt: skip
    """Run the fusion of a live site.

    Parameters
    ----------
    path : str or Path
        A site's file with a table `[live]`, described in `docs/live.md`.
    webhook : str, optional
        Address to which alerts of sensors are posted as JSON.
    stop : Event, optional
        Event that stops it.
    reporter : Reporter
        Receives the log.

    Raises
    ------
    UsageError
        If the webhook is neither https nor http on this machine.
    InputError
        If the file, tiles or scans cannot be read.
    OutputError
        If its folder cannot be written, or another fusion runs in it.
    """
    site = read_live_site(path)
    hook = Webhook(webhook, reporter=reporter) if webhook is not None else None
    fusion = Fusion(site, webhook=hook, reporter=reporter)
    fusion.run(stop or Event())
    return fusion

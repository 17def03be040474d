"""Alerts of sensors: a message by MQTT, and to a webhook, when the state of a sensor changes.

States are those of a city's page of the month; the live system's alarms say which one it is.
"""

from __future__ import annotations

import http.client
import json
import math
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from queue import Full, Queue
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from gis_radar.base import (
    QUIET,
    Reporter,
    Text,
    in_language,
    iso_from_time,
    tr,
)
from gis_radar.calibration import SENSOR_STATES, HealthState, concerns_clocks
from gis_radar.live.background import in_background
from gis_radar.live.health import ALARMS, SensorHealth
from gis_radar.live.served.sensorthings import opener_of
from gis_radar.live.state_file import StateFile
from gis_radar.live.wire.payload import VERSION
from gis_radar.live.wire.settings import webhook_address

# Time for which a state lasts before an alert is sent: twice the longest wait for a lost link, so
# that a broker or a sensor's program that is started again is no alert.
HOLD_S = 60.0
TIMEOUT_S = 5.0  # longest wait for a webhook
_RETRIES_S = (5.0, 30.0, 180.0)  # waits before further tries: a receiver that is restarted is back
# most alerts that wait for a webhook: some of each sensor of a large site
MOST_ALERTS_WAITING = 1_000


class _Cause(NamedTuple):
    """Alarms that together mean a state, of which the last says why, and what to do."""

    alarms: tuple[str, ...]
    state: Text
    advice: str


_SET_CLOCK = "set its clock by PTP or NTP, and see whether the network is slow"
CAUSES = (
    _Cause(
        ("offline",), HealthState.SILENT, "check its power, its network and gis-radar edge there"
    ),
    _Cause(
        ("moved",),
        HealthState.MOVED,
        "it counts again once traffic confirms its pose, which takes "
        "minutes; if that does not come, find its pose again with gis-radar localize",
    ),
    _Cause(("silent", "off_time"), HealthState.CLOCK_OFF, _SET_CLOCK),
    _Cause(
        ("silent", "refused"), HealthState.SILENT, "give it the tiles and the version of fusion"
    ),
    _Cause(("silent", "damaged"), HealthState.SILENT, "see the log of gis-radar edge there"),
    _Cause(
        ("silent",),
        HealthState.SILENT,
        "check the radar and its cable; where all sensors are silent, the broker",
    ),
    _Cause(
        ("pose",), HealthState.DOUBTFUL, "its counts are not to be trusted until that is put right"
    ),
    _Cause(("clock",), HealthState.CLOCK_OFF, _SET_CLOCK),
)
"""Causes in the order of precedence: a sensor that was moved is silent as well."""
WELL = "it works; there is nothing to do"


@dataclass(kw_only=True)
class _Watched:
    """A sensor, its state, since when it lasts, and since when it is out of order (monotonic s)."""

    health: SensorHealth
    state: str = ""
    since_s: float = math.inf
    ill_since_s: float = math.inf

    def due(self, sent: str, now_s: float) -> float | None:
        """Return for how long the state has lasted if an alert of it is due, seconds; else None.

        `sent` is the state of the last alert, empty before the first. A sensor that works for less
        than `HOLD_S` counts as out of order all the time: one that fails again and again has one
        alert.
        """
        state, _ = condition(self.health)
        if state != self.state:
            self.state, self.since_s = state, now_s
        if state != HealthState.WORKS:
            self.ill_since_s = min(self.ill_since_s, now_s)
        elif now_s - self.since_s >= HOLD_S:
            self.ill_since_s = math.inf
        begins = state != HealthState.WORKS and sent in {"", HealthState.WORKS}
        lasts_s = now_s - (self.ill_since_s if begins else self.since_s)
        return lasts_s if state != sent and lasts_s >= HOLD_S else None


def condition(health: SensorHealth) -> tuple[Text, Text]:
    """Return the state of a sensor, and what is known of it with what to do."""
    for alarms, state, advice in CAUSES:
        if health.alarms.keys() >= {*alarms}:
            reason = health.alarms[alarms[-1]]
            is_clock = state == HealthState.DOUBTFUL and concerns_clocks(reason)
            text = Text("{}: {}; {}", Text(ALARMS[alarms[-1]]), reason, Text(advice))
            return HealthState.CLOCK_OFF if is_clock else state, text
    return HealthState.WORKS, Text(WELL)


class Alerts:
    """Alerts of a site: the last state sent for each sensor, and a message where it changes.

    Parameters
    ----------
    site : str
        The site's name in topics.
    sensors : iterable of SensorHealth
        Health of the sensors.
    path : Path
        File of the alerts that were sent, so that a new start sends none again.
    publish : callable
        Publishes the message of a sensor, by name and content.
    webhook : Webhook, optional
        Receives each change.
    language : str
        Language of the sentences; states keep their English names.
    reporter : Reporter
        Receives a line when the file cannot be read or written.
    """

    def __init__(
        self, site: str, sensors: Iterable[SensorHealth], *, path: Path,
        publish: Callable[[str, bytes], None], webhook: Webhook | None = None,
        language: str = "en", reporter: Reporter = QUIET,
    ) -> None:  # fmt: skip
        self._site, self._language = site, language
        self._publish, self._webhook = publish, webhook
        self._file = StateFile(path, reporter=reporter)
        self._watched = {each.name: _Watched(health=each) for each in sensors}
        sent = self._file.read({}, _sent_in)
        self._sent = {name: sent[name] for name in self._watched if name in sent}

    def check(self, time_s: float, now_s: float) -> None:
        """Send alerts of the states that changed `HOLD_S` ago or earlier.

        Parameters
        ----------
        time_s, now_s : float
            UNIX seconds, and monotonic ones, by which states last.
        """
        changed = False
        for name, each in self._watched.items():
            before = str(self._sent.get(name, {}).get("state", ""))
            lasts_s = each.due(before, now_s)
            if lasts_s is None:
                continue
            changed, since_s = True, time_s - lasts_s
            if each.state == HealthState.SILENT:
                since_s = min(since_s, each.health.heard_s)
            self._sent[name] = self._record(each, since_s)
            self._publish(name, _packed(self._sent[name]))
            if self._webhook is not None and (before or each.state != HealthState.WORKS):
                self._webhook.put(_packed(self._sent[name]))
        if changed:
            self._file.write(self._sent)

    def repeat(self) -> None:
        """Publish the states again, as a broker that was started anew has none."""
        for name, record in self._sent.items():
            self._publish(name, _packed(record))

    def _record(self, watched: _Watched, since_s: float) -> dict[str, object]:
        name = watched.health.name
        _, text = condition(watched.health)
        with in_language(self._language):
            message = f"{name}: {tr(text)}"
        since = iso_from_time(datetime.fromtimestamp(since_s, UTC))
        return {
            "version": VERSION, "site": self._site, "sensor": name, "state": watched.state,
            "since": since, "message": message,
        }  # fmt: skip


def _packed(record: dict[str, object]) -> bytes:
    return json.dumps(record, ensure_ascii=False).encode()


def _sent_in(found: Any) -> dict[str, dict[str, object]]:
    """Return the last alert of each sensor, of the content of the file."""
    return {name: dict(each) for name, each in found.items() if each["state"] in SENSOR_STATES}


class Webhook:
    """Receiver of alerts by HTTP; they are posted on a thread of its own.

    An alert that the receiver does not take is tried again after `retries_s`, then left out and
    counted. As long as the receiver fails, further alerts are tried once.

    Parameters
    ----------
    url : str
        Its address: https, or http on this machine.
    retries_s : sequence of float
        Waits before further tries, seconds.
    reporter : Reporter
        Receives a line when the receiver begins to fail, and when it takes alerts again.

    Raises
    ------
    UsageError
        If the address is another one.
    """

    def __init__(
        self, url: str, *, retries_s: tuple[float, ...] = _RETRIES_S, reporter: Reporter = QUIET
    ) -> None:
        self._url, self._retries_s, self._reporter = webhook_address(url), retries_s, reporter
        self._host = urlsplit(url).hostname  # the rest of the address may be a secret
        self._waiting: Queue[bytes] = Queue(MOST_ALERTS_WAITING)
        self._is_failing = False
        self.sent = self.lost = 0
        in_background("webhook", self._work)

    def put(self, content: bytes) -> None:
        """Add an alert, which is lost where too many wait."""
        try:
            self._waiting.put_nowait(content)
        except Full:
            self.lost += 1

    def figures(self) -> dict[str, float]:
        """Return how many alerts were taken and lost, by name, for Prometheus."""
        return {"webhook_sent": float(self.sent), "webhook_lost": float(self.lost)}

    def _work(self) -> None:
        """Run on the thread: post what waits, for as long as the program runs."""
        while True:
            content = self._waiting.get()
            for wait_s in (0.0, *(() if self._is_failing else self._retries_s)):
                time.sleep(wait_s)
                fault = self._post(content)
                if not fault:
                    break
                if not self._is_failing:
                    self._is_failing = True
                    self._reporter.warn("the webhook at {} takes no alerts: {}", self._host, fault)
            self.sent, self.lost = self.sent + (not fault), self.lost + bool(fault)
            if self._is_failing and not fault:
                self._is_failing = False
                self._reporter.log(Text("the webhook at {} takes alerts again", self._host))

    def _post(self, content: bytes) -> str:
        """Post an alert; return why the receiver does not take it, empty where it does."""
        try:
            request = urllib.request.Request(  # noqa: S310 - http and https alone, checked
                self._url, data=content, headers={"Content-Type": "application/json"}
            )
            with opener_of(self._url).open(request, timeout=TIMEOUT_S):
                return ""
        except urllib.error.HTTPError as error:
            error.close()
            return Text("it answers {}", error.code)
        except (OSError, ValueError, http.client.HTTPException) as error:
            return str(getattr(error, "reason", error)) or type(error).__name__

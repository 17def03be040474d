"""Health of the live system: alarms, counts a sensor, and both as text for Prometheus."""

from __future__ import annotations

import socket
import statistics
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

from gis_radar.errors import OutputError
from gis_radar.live.settings import DEFAULTS, LiveSettings
from gis_radar.progress import QUIET, Reporter

COUNTS = {
    "messages": "messages that came in",
    "frames": "frames that were stored",
    "hits": "tiles hit, over all frames",
    "late_frames": "frames that came after their window, stored all the same",
    "duplicates": "messages that had come before",
    "gaps": "times that messages were missing, and asked for again",
    "damaged": "messages that could not be read",
    "refused": "messages that were not taken: other tiles or version",
    "off_time": "frames of a time that is too far from now, left out",
}
ALARMS = {
    "offline": "the sensor is not linked",
    "silent": "nothing comes from the sensor",
    "clock": "its clock is off",
    "moved": "it was moved: its tiles are not observed",
    "refused": "what it sends is not taken",
    "damaged": "messages cannot be read",
    "twins": "two sensors have its name",
    "lost": "its buffer is full: frames are lost",
    "off_time": "its frames are of another time and left out",
}


@dataclass(kw_only=True)
class SensorHealth:
    """Counts and alarms of a sensor.

    Parameters
    ----------
    name : str
        Of the sensor.
    settings : LiveSettings
        From when on a clock is wrong, or a sensor silent.
    reporter : Reporter
        Receives a line when an alarm begins or ends.
    """

    name: str
    settings: LiveSettings = DEFAULTS
    reporter: Reporter = QUIET
    counts: Counter[str] = field(default_factory=Counter)
    alarms: dict[str, str] = field(default_factory=dict)
    newest_s: float = float("nan")
    heard_s: float = field(default_factory=time.time)
    lost: int = 0
    raised_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._delays: deque[float] = deque(maxlen=self.settings.clock_frames)
        self._heard = 0

    def alarm(self, kind: str, text: str | None) -> None:
        """Raise an alarm, or end it where there is no text."""
        if text is None:
            self.raised_s.pop(kind, None)
            if self.alarms.pop(kind, None) is not None:
                self.reporter.log(f"{self.name}: over: {ALARMS[kind]}")
            return
        new = kind not in self.alarms
        self.alarms[kind], self.raised_s[kind] = text, time.time()
        if new:
            self.reporter.log(f"{self.name}: {ALARMS[kind]}: {text}", "warning")

    def heard(self, arrival_s: float, frame_s: float, *, live: bool) -> None:
        """Take in when a frame came; those that waited on disk tell nothing of the clock."""
        self.heard_s = arrival_s
        self.newest_s = frame_s
        if not live:
            return
        self._delays.append(arrival_s - frame_s)
        self._heard += 1
        if self._heard % (self.settings.clock_frames // 10):  # the least of many takes its time
            return
        offset_s = self.clock_offset_s
        most_s = self.settings.clock_alarm_s
        wrong = offset_s > most_s or offset_s < -most_s
        text = f"frames come {1000 * offset_s:+,.0f} ms after their time at the least"
        self.alarm("clock", text if wrong else None)

    @property
    def clock_offset_s(self) -> float:
        """The least delay of the last live frames, seconds: the clock's offset and the way."""
        return min(self._delays, default=float("nan"))

    @property
    def lag_s(self) -> float:
        """The usual delay of the last live frames, seconds."""
        return statistics.median(self._delays) if self._delays else float("nan")

    def look(self, now_s: float) -> None:
        """Raise the alarm of a sensor from which nothing comes."""
        quiet_s = now_s - self.heard_s
        for kind in (
            "damaged",
            "off_time",
            "twins",
        ):  # of single messages: over once none came for a while
            if now_s - self.raised_s.get(kind, now_s) > self.settings.over_s:
                self.alarm(kind, None)
        silent = quiet_s > self.settings.silent_s
        self.alarm("silent", f"for {quiet_s:.0f} s" if silent else None)


def prometheus_text(sensors: list[SensorHealth], figures: dict[str, float]) -> str:
    """Return counts, lags and alarms in the text format of Prometheus.

    Parameters
    ----------
    sensors : list of SensorHealth
        All sensors.
    figures : dict
        What concerns all of them: a number by name.
    """
    return "\n".join(_lines(sensors, figures)) + "\n"


def _lines(sensors: list[SensorHealth], figures: dict[str, float]) -> Iterator[str]:
    for name, meaning in COUNTS.items():
        yield from (f"# HELP gis_radar_{name}_total {meaning}",
                    f"# TYPE gis_radar_{name}_total counter")  # fmt: skip
        for each in sensors:
            yield f"gis_radar_{name}_total{_labels(each.name)} {each.counts[name]}"
    gauges = {
        "clock_offset_seconds": [each.clock_offset_s for each in sensors],
        "lag_seconds": [each.lag_s for each in sensors],
        "newest_frame_time_seconds": [each.newest_s for each in sensors],
    }
    for name, values in gauges.items():
        yield f"# TYPE gis_radar_{name} gauge"
        for each, value in zip(sensors, values, strict=True):
            yield f"gis_radar_{name}{_labels(each.name)} {_number(value)}"
    yield "# TYPE gis_radar_alarm gauge"
    for each in sensors:
        for kind in ALARMS:
            yield f"gis_radar_alarm{_labels(each.name, alarm=kind)} {int(kind in each.alarms)}"
    for name, value in figures.items():
        yield f"# TYPE gis_radar_{name} gauge"
        yield f"gis_radar_{name} {_number(value)}"


def _number(value: float) -> str:
    return "NaN" if value != value else f"{value:.6f}".rstrip("0").rstrip(".")  # noqa: PLR0124


def _labels(sensor: str, **more: str) -> str:
    pairs = {"sensor": sensor, **more}.items()
    texts = [f'{name}="{_escaped(value)}"' for name, value in pairs]
    return "{" + ",".join(texts) + "}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


class HealthServer:
    """Serves the text for Prometheus at `/metrics`.

    Parameters
    ----------
    address : str
        HOST:PORT.
    text : callable
        Returns the text.

    Raises
    ------
    OutputError
        If the address is taken.
    """

    def __init__(self, address: str, text: Any) -> None:
        host, _, port = address.rpartition(":")

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                found = self.path == "/metrics"
                body = text().encode() if found else b"see /metrics\n"
                self.send_response(200 if found else 404)
                self.send_header("Content-Type", "text/plain; version=0.0.4; charset=utf-8")
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                """Say nothing of each look."""

        class Server(ThreadingHTTPServer):
            address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

        try:
            self._server = Server((host.strip("[]"), int(port)), Handler)
        except OSError as error:
            raise OutputError(f"{address}: cannot serve there: {error.strerror}") from error
        self._server.daemon_threads = True
        Thread(target=self._server.serve_forever, daemon=True, name="health").start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()

"""Health of the live system: alarms and counts of each sensor, and both as text for Prometheus."""

from __future__ import annotations

import statistics
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gis_radar.base import MOST_ERROR_CHARACTERS, QUIET, Reporter, Text, one_line

if TYPE_CHECKING:
    from prometheus_client import Metric


_CLOCK_ALARM_S = 0.025  # half of a step: a clock that is off by more is wrong
_CLOCK_MESSAGES = 200  # live messages whose least delay is the offset of a sensor's clock: 10 s
_SILENT_S = 5.0  # time without a message after which a sensor is silent
# Time after which an alarm of a single message ends: Prometheus asks once a minute.
_ALARM_END_S = 120.0
METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_COUNTS = {
    "messages": "messages that came in",
    "frames": "frames that were stored",
    "hits": "tiles hit, over all frames",
    "late_frames": "frames that came after their window, stored all the same",
    "duplicates": "messages that had come before",
    "gaps": "times that messages were missing, and asked for again",
    "damaged": "messages that could not be read",
    "refused": "messages that were not taken: other tiles or version",
    "off_time": "frames of a time that is too far from now, left out",
    "lost": "messages that the sensor had no room for",
    "not_followed": "frames by which the sensor did not follow its pose, as fits are too slow",
}
_GAUGES = {  # meaning, attribute of SensorHealth
    "clock_offset_seconds": ("least delay of the last live frames", "clock_offset_s"),
    "lag_seconds": ("median delay of the last live frames", "lag_s"),
    "newest_frame_time_seconds": ("time of the newest frame", "newest_s"),
}
ALARMS = {
    "offline": "the sensor is not linked",
    "silent": "nothing comes from the sensor",
    "clock": "its clock is off",
    "pose": "its pose or what it sends is doubtful",
    "moved": "it was moved: its tiles are not observed",
    "refused": "what it sends is not taken",
    "damaged": "messages cannot be read",
    "twins": "two sensors have its name",
    "lost": "its buffer is full: frames are lost",
    "off_time": "its frames are of another time and left out",
}


@dataclass(kw_only=True)
class SensorHealth:
    """Counts and alarms of one sensor.

    Parameters
    ----------
    name : str
        The sensor's name.
    reporter : Reporter
        Receives a line when an alarm begins or ends.
    counts : Counter
        Counts by the names of :data:`_COUNTS`.
    alarms : dict
        Text of each alarm that is raised, by the names of :data:`ALARMS`.
    newest_s, heard_s : float
        Time of the newest frame, and arrival of the last one, UNIX seconds.
    raised_s : dict
        When each alarm was last raised, UNIX seconds.
    """

    name: str
    reporter: Reporter = QUIET
    counts: Counter[str] = field(default_factory=Counter)
    alarms: dict[str, str] = field(default_factory=dict)
    newest_s: float = float("nan")
    heard_s: float = field(default_factory=time.time)
    raised_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._delays: deque[float] = deque(maxlen=_CLOCK_MESSAGES)
        self._heard = 0

    def alarm(self, kind: str, text: str | None) -> None:
        """Raise an alarm with a text, or end it if the text is None."""
        if text is None:
            self.raised_s.pop(kind, None)
            if self.alarms.pop(kind, None) is not None:
                self.reporter.log(Text("{}: over: {}", self.name, ALARMS[kind]))
            return
        new = kind not in self.alarms
        self.alarms[kind], self.raised_s[kind] = one_line(text, MOST_ERROR_CHARACTERS), time.time()
        if new:
            self.reporter.warn("{}: {}: {}", self.name, ALARMS[kind], text)

    def heard(self, arrival_s: float, frame_s: float, *, live: bool) -> None:
        """Record the arrival of a frame; only live ones, not those from disk, check the clock."""
        self.heard_s = arrival_s
        self.newest_s = frame_s
        if not live:
            return
        self._delays.append(arrival_s - frame_s)
        self._heard += 1
        if self._heard % (_CLOCK_MESSAGES // 10):  # the minimum of all delays is slow
            return
        offset_s = self.clock_offset_s
        wrong = abs(offset_s) > _CLOCK_ALARM_S
        text = Text("frames come {:+,.0f} ms after their time at the least", 1000 * offset_s)
        self.alarm("clock", text if wrong else None)

    @property
    def clock_offset_s(self) -> float:
        """Least delay of the last live frames, seconds: clock offset and transmission."""
        return min(self._delays, default=float("nan"))

    @property
    def lag_s(self) -> float:
        """Median delay of the last live frames, seconds."""
        return statistics.median(self._delays) if self._delays else float("nan")

    def check(self, now_s: float) -> None:
        """Raise or end the alarm of a silent sensor; end alarms of single messages in time."""
        quiet_s = now_s - self.heard_s
        for kind in ("damaged", "off_time", "twins"):  # alarms that single messages raise
            if now_s - self.raised_s.get(kind, now_s) > _ALARM_END_S:
                self.alarm(kind, None)
        silent = quiet_s > _SILENT_S
        self.alarm("silent", Text("for {:.0f} s", quiet_s) if silent else None)


@dataclass(frozen=True)
class _Metrics:
    """Metrics of the sensors and of the site, as prometheus-client collects them."""

    sensors: Sequence[SensorHealth]
    figures: Mapping[str, float]

    def collect(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily  # noqa: PLC0415

        for name, meaning in _COUNTS.items():
            count = CounterMetricFamily(f"gis_radar_{name}", meaning, labels=["sensor"])
            for each in self.sensors:
                count.add_metric([each.name], each.counts[name])
            yield count
        for name, (meaning, attribute) in _GAUGES.items():
            gauge = GaugeMetricFamily(f"gis_radar_{name}", meaning, labels=["sensor"])
            for each in self.sensors:
                gauge.add_metric([each.name], getattr(each, attribute))
            yield gauge
        alarm = GaugeMetricFamily("gis_radar_alarm", "1 while raised", labels=["sensor", "alarm"])
        for each in self.sensors:
            for kind in ALARMS:
                alarm.add_metric([each.name, kind], kind in each.alarms)
        yield alarm
        for name, value in self.figures.items():
            yield GaugeMetricFamily(f"gis_radar_{name}", "of the site", value=value)


def prometheus_text(sensors: Sequence[SensorHealth], figures: Mapping[str, float]) -> str:
    """Return counts, lags and alarms in the text format of Prometheus.

    Parameters
    ----------
    sensors : sequence of SensorHealth
        All sensors.
    figures : mapping
        Figures of the whole site: a number by name.
    """
    from prometheus_client import generate_latest  # noqa: PLC0415 - an extra

    return generate_latest(_Metrics(sensors, figures)).decode()

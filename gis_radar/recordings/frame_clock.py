"""Times of frames: by the sensor's clock, also at the recorder's rate, or by the recorder's."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import Literal

import numpy as np

from gis_radar.base import Floats, InputError, Reporter, Text
from gis_radar.recordings.frames import Frame

Clock = Literal["auto", "sensor", "recorder"]
CLOCKS: tuple[Clock, ...] = ("auto", "sensor", "recorder")

# A clock that was set is far after this; one that counts from its start is not.
_EARLIEST_S = 946_684_800.0  # 2000-01-01
_LATEST_S = 4_102_444_800.0  # 2100-01-01
AGREEING_S = 5.0  # clocks set by NTP or PTP agree far better; TAI is 37 s off
# How far a sensor's clock may move against the recorder's. A busy recorder stamps late, which looks
# as if the sensor's clock fell behind: only one that goes back by its own count is surely wrong.
_FORWARD_S, _BACK_S = 0.5, 0.1
# Frames ahead that distinguish a clock that jumped (all are off) from a single late frame.
_FRAMES_AHEAD = 40
# Frames to which a rate is fitted, half of them at least: 10 s at 20 Hz give it to 0.012 % where
# arrivals jitter by 9 ms.
_RATE_FRAMES = 200
# Quartz clocks differ by 0.01 %, a recorder that NTP corrects by 0.05 %; an ARS430 was 0.8 % slow.
# Over _MOST_RATE one of the two does not show the time, as where a bag was replayed faster.
_LEAST_RATE, _MOST_RATE = 0.003, 0.02
_REFIT_FRAMES = 20  # a second of frames between two fits of a rate
# A PTP clock on TAI, without the leap seconds since 1972.
_TAI_AHEAD_S = 37.0


class FrameClock:
    """Choice of the clock for the times of one sensor's frames, in order of arrival.

    The first frames decide; where the sensor's clock goes wrong later, the recorder's counts from
    there on, for good: two clocks in turn would shuffle the frames. A sensor's clock is right if
    the sensor calls it synchronised, it agrees with the recorder's to `AGREEING_S`, and does not
    jump. One that runs slow or fast by `_LEAST_RATE` or more, evenly over the first `_RATE_FRAMES`,
    is corrected by a robust line through its offsets from the recorder's clock: times are then the
    recorder's without jitter, and jumps are measured from that line.

    Parameters
    ----------
    sensor : str
        Its name, for messages.
    clock : str
        `auto`, or `sensor` or `recorder` for that one in any case.
    reporter : Reporter
        Receives the reason where the sensor's clock is not used.
    """

    def __init__(self, sensor: str, clock: Clock, reporter: Reporter) -> None:
        self.used: list[str] = []
        self._sensor, self._clock, self._reporter = sensor, clock, reporter
        self._waiting: deque[Frame] = deque()
        self._offsets_s: deque[float] = deque(maxlen=_FRAMES_AHEAD)
        self._line: OffsetLine | None = None
        self._latest = -float("inf")
        self._stamp = "sensor"

    @property
    def _name(self) -> str:
        """The clock of the sensor's times, for messages: a stamp may be by any clock."""
        return "the sensor's clock" if self._stamp == "sensor" else f"the {self._stamp}"

    def feed(self, frame: Frame) -> Iterator[tuple[float, Frame]]:
        """Take a frame; yield the one whose time is known by now, if there is one."""
        self._stamp = frame.stamp
        self._waiting.append(frame)
        if len(self._waiting) > _RATE_FRAMES:
            yield self._next()

    def finish(self) -> Iterator[tuple[float, Frame]]:
        """Yield the frames that are still waiting: no more are coming."""
        while self._waiting:
            yield self._next()

    def _next(self) -> tuple[float, Frame]:
        if not self.used:
            self._decide()
        frame = self._waiting.popleft()
        return self._time(frame), frame

    def _decide(self) -> None:
        """Choose the clock by the first frames, and warn where it is not the sensor's as it is."""
        if self._clock != "auto":
            self.used.append(self._stamp if self._clock == "sensor" else self._clock)
            return
        first = islice(self._waiting, _FRAMES_AHEAD + 1)
        reasons = [reason for frame in first if (reason := self._fault(frame))]
        if reasons:
            self._use_recorder(statistics.mode(reasons))
            return
        self._line = self._fit_rate()
        if self._line is None:
            self.used.append(self._stamp)
            return
        rate = self._line.rate
        self.used.append(f"{self._stamp} at the recorder's rate")
        self._reporter.warn(
            "{}: {} runs {:.2%} {} against the recorder's: it is corrected by that rate",
            self._sensor,
            self._name,
            abs(rate),
            Text("fast") if rate > 0 else Text("slow"),
        )

    def _fit_rate(self) -> OffsetLine | None:
        """Return the line of a clock whose rate is wrong; None where it is right or not known."""
        pairs = [
            (frame.sensor_time, offset)
            for frame in self._waiting
            if frame.sensor_time is not None and (offset := _offset_s(frame)) is not None
        ]
        if len(pairs) < _RATE_FRAMES // 2:
            return None
        line, half = OffsetLine(pairs), len(pairs) // 2
        half_rates = [OffsetLine(pairs[:half]).rate, OffsetLine(pairs[half:]).rate]
        # A jump, or a recorder that was busy, changes the rate of one half only.
        if abs(line.rate) < _LEAST_RATE or not all(0.5 <= p / line.rate <= 1.5 for p in half_rates):
            return None
        if abs(line.rate) > _MOST_RATE:
            raise InputError(
                "{}: {} runs {:.1%} {} against the recorder's: one of them is no clock",
                self._sensor,
                self._name,
                abs(line.rate),
                Text("fast") if line.rate > 0 else Text("slow"),
                hint=Text(
                    "a replay? say which counts: {} sensor or {} recorder", "--clock", "--clock"
                ),
            )
        return line

    def _time(self, frame: Frame) -> float:
        """Return the time of a frame by the clock that counts now; refuse an impossible one."""
        recorder = self.used[-1] == "recorder"
        if not recorder and self._clock == "auto":
            reason = self._fault(frame) or self._jump(frame)
            if reason:
                self._use_recorder(reason)
                recorder = True
        time = frame.recorder_time if recorder else self._corrected(frame)
        if time is None or not _EARLIEST_S <= time < _LATEST_S:
            raise InputError(
                "{}: no usable time: the {} says {}, the recorder {}",
                self._sensor,
                self._stamp,
                _time_text(frame.sensor_time),
                _time_text(frame.recorder_time),
                hint=Text(
                    "expected are years from 2000 to 2100; see {}, and {} of tables",
                    "--clock",
                    "--time-unit",
                ),
            )
        return time

    def _corrected(self, frame: Frame) -> float | None:
        """Return the sensor's time (UNIX seconds), corrected where its rate is wrong."""
        if self._line is None or frame.sensor_time is None:
            return frame.sensor_time
        return frame.sensor_time - self._line.at(frame.sensor_time)

    def _use_recorder(self, reason: str) -> None:
        since = Text(" from there on") if self.used else ""
        self.used.append("recorder")
        self._reporter.warn("{}: {}; times are the recorder's{}", self._sensor, reason, since)

    def _fault(self, frame: Frame) -> str:
        """Return what is wrong with the sensor's time of a frame, empty if nothing is."""
        if frame.sensor_time is None:
            return Text("the sensor gives no time")
        if not frame.synchronised:
            return Text("{} is not synchronised", self._name)
        if not _EARLIEST_S <= frame.sensor_time < _LATEST_S:
            return Text("{} stands at {:,.0f} s since 1970", self._name, frame.sensor_time)
        offset_s = _offset_s(frame)
        if offset_s is None or abs(offset_s) <= AGREEING_S or self._line is not None:
            return ""
        return Text("{} is {} the recorder's", self._name, _offset_text(offset_s))

    def _jump(self, frame: Frame) -> str:
        """Return how the sensor's clock jumped at a frame, empty if it did not."""
        offset_s = _offset_s(frame)
        if offset_s is None or frame.sensor_time is None:
            return ""
        usual_s = statistics.median(self._offsets_s) if self._offsets_s else offset_s
        if self._line is not None:
            usual_s = self._line.at(frame.sensor_time)
        jump_s = offset_s - usual_s
        back = jump_s < -_BACK_S and frame.sensor_time < self._latest - _BACK_S
        self._latest = max(self._latest, frame.sensor_time)
        if (back or jump_s > _FORWARD_S) and self._lasts(usual_s, jump_s):
            return Text("{} jumped by {:+.3f} s", self._name, jump_s)
        if abs(jump_s) <= _FORWARD_S:
            self._offsets_s.append(offset_s)
            if self._line is not None:
                self._line.add(frame.sensor_time, offset_s)
        return ""

    def _lasts(self, usual_s: float, jump_s: float) -> bool:
        """Return whether the next frames have jumped by the same: a late frame is alone."""
        ahead = islice(self._waiting, _FRAMES_AHEAD)
        offsets_ahead = [offset for frame in ahead if (offset := _offset_s(frame)) is not None]
        return bool(offsets_ahead) and all(
            (offset - usual_s) / jump_s > 0.5 for offset in offsets_ahead
        )


class OffsetLine:
    """A robust line through the offsets of the sensor's clock over its last frames.

    Parameters
    ----------
    pairs : list of (float, float)
        The sensor's times, UNIX seconds, and how far they are ahead of the recorder's, seconds.

    Attributes
    ----------
    rate : float
        Seconds that the clock gains in a second; negative where it runs slow.
    """

    def __init__(self, pairs: list[tuple[float, float]]) -> None:
        self._pairs = deque(pairs, maxlen=_RATE_FRAMES)
        self._last_of_begin = max(time for time, _ in pairs)
        self._added = 0
        self._fit()

    def at(self, time: float) -> float:
        """Return how far the clock is ahead (s) at a time that it shows (UNIX seconds)."""
        return self._offset_s + self.rate * (time - self._begin)

    def add(self, time: float, offset_s: float) -> None:
        """Add the offset of a frame; skip the frames that the line was begun with."""
        if time <= self._last_of_begin:
            return
        self._pairs.append((time, offset_s))
        self._added += 1
        if self._added == _REFIT_FRAMES:
            self._fit()

    def _fit(self) -> None:
        """Fit by the medians of slopes and of residuals (Theil 1950, Sen 1968)."""
        pairs: Floats = np.array(self._pairs)
        self._begin, self._added = float(pairs[0, 0]), 0
        time, offset_s = pairs[:, 0] - self._begin, pairs[:, 1]
        first, second = np.triu_indices(len(pairs), k=max(len(pairs) // 4, 1))
        elapsed_s = time[second] - time[first]
        slopes = (offset_s[second] - offset_s[first])[elapsed_s != 0.0] / elapsed_s[
            elapsed_s != 0.0
        ]
        self.rate = float(np.median(slopes)) if len(slopes) else 0.0
        self._offset_s = float(np.median(offset_s - self.rate * time))


def _offset_s(frame: Frame) -> float | None:
    """Return how far the sensor's clock is ahead of the recorder's, seconds; None if unknown."""
    if frame.sensor_time is None or frame.recorder_time is None:
        return None
    if not _EARLIEST_S <= frame.recorder_time < _LATEST_S:
        return None
    return frame.sensor_time - frame.recorder_time


def _time_text(time: float | None) -> str:
    return "nothing" if time is None else Text("{:,.3f} s since 1970", time)


def _offset_text(offset_s: float) -> str:
    side = Text("ahead of") if offset_s > 0 else "behind"
    why = " (TAI instead of UTC?)" if abs(offset_s - _TAI_AHEAD_S) < 0.5 else ""
    size = abs(offset_s)
    text = f"{size:.0f} s" if size < 600 else f"{size / 3600:.1f} h"
    return f"{text}{why} {side}" if size < 172_800 else Text("{:.0f} days {}", size / 86400, side)

"""Frames in order of time: inputs merged, whose clock counts, late frames sorted in, no doubles."""

from __future__ import annotations

import heapq
import statistics
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from typing import Literal

from gis_radar.errors import InputError
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.frames import Frame, NothingHereError, ReaderContext

# 12 s of a 20 Hz sensor: far more than a network or a bag writer ever reorders.
WINDOW = 256

Input = Callable[[ReaderContext], Generator[Frame]]
Active = tuple[float, int, Frame, Iterator[Frame]]


def merged(inputs: Sequence[Input], context: ReaderContext) -> Iterator[Frame]:
    """Yield the frames of several inputs in order of arrival, whatever the order of the inputs.

    An input is opened when its first frame is due: a day in a thousand files needs no thousand
    open files.

    Raises
    ------
    NothingHereError
        If no input has a frame; one of several that has none is a warning.
    """
    if len(inputs) == 1:
        yield from inputs[0](context)
        return
    due = sorted(_begins(inputs, context), reverse=True)
    active: list[Active] = []
    while due or active:
        while due and (not active or due[-1][0] <= active[0][0]):
            _, number = due.pop()
            _push(active, number, inputs[number](context))
        if active:
            _, number, frame, frames = heapq.heappop(active)
            yield frame
            _push(active, number, frames)


def _push(active: list[Active], number: int, frames: Iterator[Frame]) -> None:
    frame = next(frames, None)
    if frame is not None:
        heapq.heappush(active, (frame.arrival, number, frame, frames))


def _begins(inputs: Sequence[Input], context: ReaderContext) -> list[tuple[float, int]]:
    """Return when each input begins, and warn of those without frames."""
    looking = replace(context, reporter=QUIET, counts=Counter(), remarks=[])
    begins: list[tuple[float, int]] = []
    empty: list[NothingHereError] = []
    for number, begin in enumerate(inputs):
        frames = begin(looking)
        try:
            begins.append((next(frames).arrival, number))
        except NothingHereError as error:
            empty.append(error)
        frames.close()
    if not begins:
        raise empty[0]
    for nothing in empty:
        context.reporter.log(f"{nothing.message} ({nothing.hint})", "warning")
    return begins


class FrameOrder:
    """Sorter of one sensor's frames by time, within a window.

    Parameters
    ----------
    sensor : str
        As messages name it.

    Attributes
    ----------
    late : int
        How many came after one that is later.
    """

    def __init__(self, sensor: str) -> None:
        self.late = 0
        self._sensor = sensor
        self._heap: list[tuple[float, int, Frame]] = []
        self._number = 0
        self._latest = -float("inf")
        self._left = -float("inf")

    def put(self, time: float, frame: Frame) -> Iterator[tuple[float, Frame]]:
        """Take a frame; yield those that none can precede any more.

        Raises
        ------
        InputError
            If the frame comes so late that those after it are gone.
        """
        if time < self._left:
            raise InputError(
                f"{self._sensor}: time goes back by {self._latest - time:.3f} s "
                f"(to {time:.3f} s since 1970), farther than frames are put in order",
                hint="split the input there, or sort it (reordercap sorts captures)",
            )
        self.late += time < self._latest
        self._latest = max(self._latest, time)
        self._number += 1
        heapq.heappush(self._heap, (time, self._number, frame))
        if len(self._heap) > WINDOW:
            yield self._pop()

    def finish(self) -> Iterator[tuple[float, Frame]]:
        """Yield all that is left."""
        while self._heap:
            yield self._pop()

    def _pop(self) -> tuple[float, Frame]:
        time, _, frame = heapq.heappop(self._heap)
        self._left = time
        return time, frame


Clock = Literal["auto", "sensor", "recorder"]
CLOCKS: tuple[Clock, ...] = ("auto", "sensor", "recorder")

# Clocks that run at all are far after this; one that counts since boot is not.
EARLIEST_S = 946_684_800.0  # 2000-01-01
LATEST_S = 4_102_444_800.0  # 2100-01-01
AGREEING_S = 5.0  # clocks set by NTP or PTP agree far better; TAI is 37 s off
# How far a sensor's clock may move against the recorder's. A recorder that was kept busy stamps
# late, so that of a clock that falls behind only the one that goes back is sure to be wrong.
FORWARD_S, BACK_S = 0.5, 0.1
# So many frames ahead tell a clock that jumped from a frame that was late.
FRAMES_AHEAD = 40
# A PTP clock on TAI, without the leap seconds since 1972.
TAI_AHEAD_S = 37.0


class FrameClock:
    """Choice of the clock that gives one sensor's frames their times, in order of arrival.

    The first two seconds decide; where the sensor's clock goes wrong later, the recorder's counts
    from there on: two clocks that take turns would shuffle the frames. A sensor's clock is right
    where the sensor calls it synchronised, it agrees with the recorder's to `AGREEING_S`, and does
    not jump.

    Parameters
    ----------
    sensor : str
        As messages name it.
    clock : str
        `sensor` or `recorder` to have that one in any case.
    reporter : Reporter
        Receives the reason where the sensor's clock is not used.
    """

    def __init__(self, sensor: str, clock: Clock, reporter: Reporter) -> None:
        self.used: list[str] = []
        self._sensor, self._clock, self._reporter = sensor, clock, reporter
        self._waiting: deque[Frame] = deque()
        self._offsets_s: deque[float] = deque(maxlen=FRAMES_AHEAD)
        self._latest = -float("inf")
        self._stamp = "sensor"

    @property
    def _name(self) -> str:
        """What messages call the clock of the sensor's times: a stamp may be of any clock."""
        return "the sensor's clock" if self._stamp == "sensor" else f"the {self._stamp}"

    def feed(self, frame: Frame) -> Iterator[tuple[float, Frame]]:
        """Take a frame; yield the one whose time is known by now, if there is one."""
        self._stamp = frame.stamp
        self._waiting.append(frame)
        if len(self._waiting) > FRAMES_AHEAD:
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
        if self._clock != "auto":
            self.used.append(self._stamp if self._clock == "sensor" else self._clock)
            return
        reasons = [reason for frame in self._waiting if (reason := self._fault(frame))]
        if reasons:
            self._use_recorder(statistics.mode(reasons))
        else:
            self.used.append(self._stamp)

    def _time(self, frame: Frame) -> float:
        recorder = self.used[-1] == "recorder"
        if not recorder and self._clock == "auto":
            reason = self._fault(frame) or self._jump(frame)
            if reason:
                self._use_recorder(reason)
                recorder = True
        time = frame.recorder_time if recorder else frame.sensor_time
        if time is None or not EARLIEST_S <= time < LATEST_S:
            raise InputError(
                f"{self._sensor}: no usable time: the {self._stamp} says "
                f"{_time_text(frame.sensor_time)}, the recorder {_time_text(frame.recorder_time)}",
                hint="expected are years from 2000 to 2100; see --clock, and --time-unit of tables",
            )
        return time

    def _use_recorder(self, reason: str) -> None:
        since = " from there on" if self.used else ""
        self.used.append("recorder")
        self._reporter.log(f"{self._sensor}: {reason}; times are the recorder's{since}", "warning")

    def _fault(self, frame: Frame) -> str:
        """Return what is wrong with the sensor's time of a frame, empty if nothing is."""
        if frame.sensor_time is None:
            return "the sensor gives no time"
        if not frame.synchronised:
            return f"{self._name} is not synchronised"
        if not EARLIEST_S <= frame.sensor_time < LATEST_S:
            return f"{self._name} stands at {frame.sensor_time:,.0f} s since 1970"
        offset_s = _offset_s(frame)
        if offset_s is None or abs(offset_s) <= AGREEING_S:
            return ""
        return f"{self._name} is {_readable(offset_s)} the recorder's"

    def _jump(self, frame: Frame) -> str:
        """Return how the sensor's clock jumped at a frame, empty if it did not."""
        offset_s = _offset_s(frame)
        if offset_s is None or frame.sensor_time is None:
            return ""
        usual_s = statistics.median(self._offsets_s) if self._offsets_s else offset_s
        jump_s = offset_s - usual_s
        back = jump_s < -BACK_S and frame.sensor_time < self._latest - BACK_S
        self._latest = max(self._latest, frame.sensor_time)
        if (back or jump_s > FORWARD_S) and self._lasts(usual_s, jump_s):
            return f"{self._name} jumped by {jump_s:+.3f} s"
        if abs(jump_s) <= FORWARD_S:
            self._offsets_s.append(offset_s)
        return ""

    def _lasts(self, usual_s: float, jump_s: float) -> bool:
        """Return whether the frames to come have jumped as well: one that was late is alone."""
        coming = [offset for frame in self._waiting if (offset := _offset_s(frame)) is not None]
        return bool(coming) and all((offset - usual_s) / jump_s > 0.5 for offset in coming)


def _offset_s(frame: Frame) -> float | None:
    """Return how far the sensor's clock is ahead; None where there are not two to compare."""
    if frame.sensor_time is None or frame.recorder_time is None:
        return None
    if not EARLIEST_S <= frame.recorder_time < LATEST_S:
        return None
    return frame.sensor_time - frame.recorder_time


def _time_text(time: float | None) -> str:
    return "nothing" if time is None else f"{time:,.3f} s since 1970"


def _readable(offset_s: float) -> str:
    side = "ahead of" if offset_s > 0 else "behind"
    why = " (TAI instead of UTC?)" if abs(offset_s - TAI_AHEAD_S) < 0.5 else ""
    size = abs(offset_s)
    text = f"{size:.0f} s" if size < 600 else f"{size / 3600:.1f} h"
    return f"{text}{why} {side}" if size < 172_800 else f"{size / 86400:.0f} days {side}"

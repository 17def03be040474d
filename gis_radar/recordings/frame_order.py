"""Put frames in order of time: merge several inputs, sort in frames that come late."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace

from gis_radar.base import QUIET, InputError
from gis_radar.recordings.frames import Frame, NothingHereError, ReaderContext

# 12 s of a 20 Hz sensor: far more than a network or a bag writer ever reorders.
REORDERED_FRAMES = 256

Input = Callable[[ReaderContext], Generator[Frame]]
Active = tuple[float, int, Frame, Iterator[Frame]]


def merged(inputs: Sequence[Input], context: ReaderContext) -> Iterator[tuple[int, Frame]]:
    """Yield the frames of several inputs, given in any order, by their time of arrival.

    Each comes with the number of its input.

    An input is opened when its first frame is due: a day in a thousand files does not keep a
    thousand files open.

    Raises
    ------
    NothingHereError
        If no input has a frame; one of several that has none is a warning.
    """
    if len(inputs) == 1:
        yield from ((0, frame) for frame in inputs[0](context))
        return
    due = sorted(_begins(inputs, context), reverse=True)
    active: list[Active] = []
    while due or active:
        while due and (not active or due[-1][0] <= active[0][0]):
            _, number = due.pop()
            _push(active, number, inputs[number](context))
        if active:
            _, number, frame, frames = heapq.heappop(active)
            yield number, frame
            _push(active, number, frames)


def _push(active: list[Active], number: int, frames: Iterator[Frame]) -> None:
    frame = next(frames, None)
    if frame is not None:
        heapq.heappush(active, (frame.arrival, number, frame, frames))


def _begins(inputs: Sequence[Input], context: ReaderContext) -> list[tuple[float, int]]:
    """Return (arrival of the first frame, number) of each input; warn of those without frames."""
    first_look = replace(context, reporter=QUIET, counts=Counter(), remarks=[])
    begins: list[tuple[float, int]] = []
    empty: list[NothingHereError] = []
    for number, begin in enumerate(inputs):
        frames = begin(first_look)
        try:
            begins.append((next(frames).arrival, number))
        except NothingHereError as error:
            empty.append(error)
        frames.close()
    if not begins:
        raise empty[0]
    for nothing in empty:
        context.reporter.warn("{} ({})", nothing.message, nothing.hint)
    return begins


class FrameOrder:
    """Sorter of one sensor's frames by time, within a window.

    Parameters
    ----------
    sensor : str
        Its name, for messages.

    Attributes
    ----------
    late : int
        Number of frames that came after one with a later time.
    """

    def __init__(self, sensor: str) -> None:
        self.late = 0
        self._sensor = sensor
        self._heap: list[tuple[float, int, Frame]] = []
        self._number = 0
        self._latest = -float("inf")
        self._last_yielded = -float("inf")

    def put(self, time: float, frame: Frame) -> Iterator[tuple[float, Frame]]:
        """Take a frame; yield the earliest one, once more than `REORDERED_FRAMES` are held.

        Raises
        ------
        InputError
            If its time is before that of a frame that has been yielded.
        """
        if time < self._last_yielded:
            raise InputError(
                "{}: time goes back by {:.3f} s (to {:.3f} s since 1970), farther than "
                "frames are put in order",
                self._sensor,
                self._latest - time,
                time,
                hint="split the input there, or sort it (reordercap sorts captures)",
            )
        self.late += time < self._latest
        self._latest = max(self._latest, time)
        self._number += 1
        heapq.heappush(self._heap, (time, self._number, frame))
        if len(self._heap) > REORDERED_FRAMES:
            yield self._pop()

    def finish(self) -> Iterator[tuple[float, Frame]]:
        """Yield all that is left."""
        while self._heap:
            yield self._pop()

    def _pop(self) -> tuple[float, Frame]:
        time, _, frame = heapq.heappop(self._heap)
        self._last_yielded = time
        return time, frame

"""Frames of detections in the order of time, also where the clock of a sensor is set back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from gis_radar.live.detections import FrameDetections, pack_detections
from gis_radar.live.vehicles.store import DetectionRow
from gis_radar.steps import STEP_US

BACK_US = 2_000_000  # a clock counts as set back once frames before the last go on for so long


class SensorFrame(NamedTuple):
    """A frame of detections of a sensor.

    Parameters
    ----------
    sensor : str
        Its name.
    pose : int
        The id of its row in the store.
    detections : FrameDetections
        What the sensor sent.
    content : bytes
        As it was sent, where a message held that frame alone.
    """

    sensor: str
    pose: int
    detections: FrameDetections
    content: bytes = b""

    @property
    def step(self) -> int:
        """The step of its time."""
        return self.detections.time_us // STEP_US

    def row(self) -> DetectionRow:
        """Return it as the store keeps it."""
        content = self.content or pack_detections([self.detections], pose=0)
        return DetectionRow(self.detections.time_us, self.sensor, self.pose, content)


@dataclass(kw_only=True)
class MonotonicFilter:
    """Lets through those frames of each sensor that are later than its last.

    Others came twice. But where they go on for two seconds, and none that is later comes between,
    the clock of their sensor was set back: they are let through, and times ascend from there.

    Parameters
    ----------
    repeated : int
        Frames that came twice so far.
    """

    repeated: int = 0
    _last_us: dict[str, int] = field(default_factory=dict)
    _before: dict[str, list[SensorFrame]] = field(default_factory=dict)

    def take(self, frames: list[SensorFrame]) -> tuple[list[SensorFrame], dict[str, int]]:
        """Return frames to be followed, and by sensor from when on it gives its times anew (us)."""
        passed: list[SensorFrame] = []
        anew: dict[str, int] = {}
        for each in frames:
            time_us = each.detections.time_us
            before = self._before.setdefault(each.sensor, [])
            if time_us > self._last_us.get(each.sensor, -1):
                self.repeated += len(before)
                before.clear()
                passed.append(each)
                self._last_us[each.sensor] = time_us
                continue
            if before and time_us <= before[-1].detections.time_us:
                self.repeated += len(before)
                before.clear()
            before.append(each)
            first_us = before[0].detections.time_us
            if time_us - first_us >= BACK_US:
                anew[each.sensor] = min(first_us, anew.get(each.sensor, first_us))
                passed = [one for one in passed if not _replaced(one, each.sensor, first_us)]
                passed += before
                self._last_us[each.sensor], self._before[each.sensor] = time_us, []
        return passed, anew


def _replaced(frame: SensorFrame, sensor: str, since_us: int) -> bool:
    return frame.sensor == sensor and frame.detections.time_us >= since_us

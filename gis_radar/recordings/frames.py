"""Frames, which the readers of formats yield, and the description of a format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gis_radar.base import QUIET, InputError, Reporter, Text
from gis_radar.recordings.recording import FARTHEST_M, Recording

Column = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Detections of one radar cycle, as a file or a socket delivers them.

    Parameters
    ----------
    sensor : str
        Source address, topic, or a name given to the only sensor.
    points : (n, 3) float32 array
        Sensor frame: x forward, y left, z up, metres. NaN where the sensor calls a position
        invalid; z alone is NaN where it measures no elevation.
    range_rate, rcs : (n,) float32 array
        m/s, positive when receding, and dBm2; NaN where unknown.
    further : mapping of str to (n,) array
        Other columns of the recording.
    sensor_time, recorder_time : float or None
        UNIX seconds by the sensor's clock, and by that of the computer that recorded.
    stamp : str
        Source of `sensor_time`: the sensor's clock (`sensor`), or `header stamp`, `file name` or
        `time column`, whose clock is unknown.
    synchronised : bool
        False where the sensor marks its clock as not set.
    identity : object
        Equal for two copies of a frame and for nothing else; None where not known.
    """

    sensor: str
    points: Column
    range_rate: Column
    rcs: Column
    further: Mapping[str, Column] = field(default_factory=dict)
    sensor_time: float | None = None
    recorder_time: float | None = None
    stamp: str = "sensor"
    synchronised: bool = True
    identity: object = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def arrival(self) -> float:
        """UNIX seconds by which files are merged: by the recorder's clock, else the sensor's."""
        if self.recorder_time is not None:
            return self.recorder_time
        return 0.0 if self.sensor_time is None else self.sensor_time

    def rows(self, selection: Any) -> Frame:
        """Return some of the detections, by a mask or a slice."""
        return replace(
            self,
            points=self.points[selection],
            range_rate=self.range_rate[selection],
            rcs=self.rcs[selection],
            further={name: values[selection] for name, values in self.further.items()},
        )

    def without_unusable(self, counts: Counter[str]) -> Frame:
        """Return the frame without detections that have no usable position, and count those."""
        placed = np.isfinite(self.points[:, :2]).all(axis=1) & ~np.isinf(self.points[:, 2])
        near = placed & ~(np.abs(self.points) > FARTHEST_M).any(axis=1)
        # Infinite range rates and cross sections become NaN: unknown.
        rate = np.where(np.isfinite(self.range_rate), self.range_rate, np.nan)
        rcs = np.where(np.isfinite(self.rcs), self.rcs, np.nan)
        known = replace(self, range_rate=rate, rcs=rcs)
        if near.all():
            return known
        counts["invalid_detections"] += int((~placed).sum())
        counts["absurd_detections"] += int((placed & ~near).sum())
        return known.rows(near)


@dataclass(frozen=True, kw_only=True)
class ReaderContext:
    """Options of a format's reader, and its counts of what it leaves out.

    Parameters
    ----------
    columns : mapping of str to str
        Field by column of a recording, as given by the user.
    time_unit : str
        Unit of times in tables: `s`, `ms`, `us` or `ns`.
    sensor : str or None
        The only sensor that is asked for.
    duration_s : float or None
        Seconds after which a reader that never ends by itself ends.
    reporter : Reporter
        Receives progress and remarks.
    counts : Counter
        Numbers of what was left out, by the name that the summary shows.
    remarks : list of str
        How unclear fields were read; shown in the log and in the summary.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    time_unit: str = "s"
    sensor: str | None = None
    duration_s: float | None = None
    reporter: Reporter = QUIET
    counts: Counter[str] = field(default_factory=Counter)
    remarks: list[str] = field(default_factory=list)

    def remark(self, text: str) -> None:
        """Log a remark and keep it for the summary, once."""
        if text not in self.remarks:
            self.remarks.append(text)
            self.reporter.log(text)

    def wants(self, sensor: str) -> bool:
        """Return whether the frames of a sensor are asked for."""
        return self.sensor is None or sensor == self.sensor


class DamagedError(Exception):
    """Bytes of a frame or a file that contradict their own header."""


class NothingHereError(InputError):
    """A sound file without a frame that was asked for; others beside it may have some."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """A format that recordings are made from; each module in `readers` has one as `FORMAT`.

    Parameters
    ----------
    name : str
        Its name in the documentation.
    takes : str
        What its inputs look like, for the message on an unknown one.
    accepts : callable
        Returns whether an input (a path or an address) is of this format.
    frames : callable
        Reads an input and yields its frames in order of arrival. Raises NothingHereError where
        there is none, with what there is instead in the message.
    endings : tuple of str
        Endings of its files, in small letters, for pages and file dialogs: `accepts` alone decides.
        Folders and addresses have none.
    rank : int
        Formats are asked by ascending rank: 0 where content, address or fixed names decide, 1 where
        an ending or a folder of such files does, 2 for tables of any columns.
    opens : callable, optional
        Opens a file as a recording, for every command; without it only `convert` reads the format.
    live : bool
        Whether an input never ends by itself.
    """

    name: str
    takes: str
    accepts: Callable[[str], bool]
    frames: Callable[[str, ReaderContext], Generator[Frame]]
    endings: tuple[str, ...] = ()
    rank: int = 0
    opens: Callable[[Path], Recording] | None = None
    live: bool = False


def counts_text(seen: Mapping[str, int], *, most: int = 8) -> str:
    """Return names with their counts as text: the most frequent first, `most` of them at most."""
    ranked = sorted(seen.items(), key=lambda item: (-item[1], item[0]))
    shown = ", ".join(f"{name} ({count:,})" for name, count in ranked[:most])
    return Text("{} and {} more", shown, len(ranked) - most) if len(ranked) > most else shown

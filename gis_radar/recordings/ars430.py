"""Packets of the ARS430 in bags of `ars430_ros_publisher`: those of one cycle make a frame.

The package has two versions. That for ROS 1 has names such as `AzAng` and keeps the slant range in
`posX` (its `posY` is `-posX tan(AzAng)`, no Cartesian position); that for ROS 2 has names such as
`az_ang` and a field `range`. Azimuth counts to the right in both. The elevation angle is not used:
the maker says to ignore it, and the package writes it, or 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gis_radar.base import Text
from gis_radar.recordings.columns import cartesian
from gis_radar.recordings.frames import Column, DamagedError, Frame

PACKET = "ars430_ros_publisher/msg/RadarPacket"
DETECTION = "ars430_ros_publisher/msg/RadarDetection"
# ROS 2 bags up to Humble do not hold their definitions; those of ROS 1 do.
ARS430_DEFINITIONS = {
    DETECTION: "float32 pos_x\nfloat32 pos_y\nfloat32 pos_z\nfloat32 vrel_rad\nfloat32 az_ang\n"
    "float32 el_ang\nfloat32 rcs\nfloat32 range\nfloat32 range_var\nfloat32 az_ang_var\n"
    "float32 el_ang_var\nfloat32 snr\nuint8 flags",
    PACKET: "std_msgs/Header header\nuint8 event_id\nuint32 time_stamp\n"
    "uint32 measurement_counter\nfloat32 vambig\nars430_ros_publisher/RadarDetection[] detections",
}
# Names of fields in both versions.
_LIST, _COUNTER, SCAN = (
    ("Detections", "detections"),
    ("TimeStamp", "time_stamp"),
    ("EventID", "event_id"),
)
FIELDS = {
    "range": ("range", "posX"),
    "azimuth": ("AzAng", "az_ang"),
    "range_rate": ("VrelRad", "vrel_rad"),
    "rcs": ("RCS", "rcs"),
    "snr": ("SNR", "snr"),
}


def _first_field(record: Any, names: tuple[str, ...]) -> Any:
    for name in names:
        if hasattr(record, name):
            return getattr(record, name)
    raise DamagedError(Text("a packet has none of the fields {}", ", ".join(names)))


@dataclass(kw_only=True)
class PacketGroup:
    """Collector of packets with one time stamp of the sensor, which become a frame.

    Parameters
    ----------
    sensor : str
        The topic.
    """

    sensor: str
    _counter: int | None = None
    _stamp: float = 0.0
    _recorded: float = 0.0
    _parts: list[dict[str, Column]] = field(default_factory=list)

    def put(self, message: Any, *, stamp: float, recorded: float) -> Iterator[Frame]:
        """Take a packet; where its time stamp is a new one, yield the frame of those before it.

        Parameters
        ----------
        message : RadarPacket
            The packet.
        stamp, recorded : float
            UNIX seconds of its header, 0 where it has none, and of its recording.
        """
        counter, part = int(_first_field(message, _COUNTER)), _columns(message)
        if counter != self._counter:
            yield from self.finish()
            self._counter = counter
            self._stamp, self._recorded = stamp, recorded
        self._parts.append(part)

    def finish(self) -> Iterator[Frame]:
        """Yield the frame of the packets that wait, if there are any."""
        parts, self._parts = self._parts, []
        if not parts:
            return
        rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        count = len(rows["range"])
        unknown = np.full(count, np.nan, dtype=np.float32)
        yield Frame(
            sensor=self.sensor,
            points=cartesian(rows["range"], -rows["azimuth"], unknown),
            range_rate=rows["range_rate"],
            rcs=rows["rcs"],
            further={
                "snr": rows["snr"],
                "scan": rows["scan"],
                "counter": np.full(count, self._counter, dtype=np.uint32),
            },
            sensor_time=self._stamp,
            recorder_time=self._recorded,
            stamp="header stamp",
            identity=(self._counter, hash(rows["range"].tobytes())) if count else None,
        )


def _columns(message: Any) -> dict[str, Column]:
    """Return the fields of a packet's detections as columns."""
    listed = _first_field(message, _LIST)
    columns: dict[str, Column] = {
        name: np.array([_first_field(each, names) for each in listed], dtype=np.float32)
        for name, names in FIELDS.items()
    }
    return {**columns, "scan": np.full(len(listed), _first_field(message, SCAN), dtype=np.uint8)}

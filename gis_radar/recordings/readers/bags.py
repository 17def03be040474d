"""Radar in ROS 1 and ROS 2 bags: clouds, scans, detection lists, and packets of the ARS548."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import InputError, Text, UsageError, first_line
from gis_radar.recordings import ars430
from gis_radar.recordings.columns import Layout, find_layout, message_rows, values_of
from gis_radar.recordings.frames import DamagedError, Format, Frame, NothingHereError, ReaderContext
from gis_radar.recordings.readers.udp import LIST_METHOD, method_of, read_detections
from gis_radar.recordings.unpacking import limit_rosbags

CLOUD = "sensor_msgs/msg/PointCloud2"
# Messages that list detections one by one: the field of the list, and the type of its items.
LISTS = {
    "radar_msgs/msg/RadarScan": ("returns", "radar_msgs/msg/RadarReturn"),
    "continental_msgs/msg/ContinentalArs548DetectionList": (
        "detections",
        "continental_msgs/msg/ContinentalArs548Detection",
    ),
}
# Messages that carry the sensor's datagrams unchanged.
_PACKETS = (
    "nebula_msgs/msg/NebulaPackets",
    "nebula_msgs/msg/NebulaPacket",
    "udp_msgs/msg/UdpPacket",
    "ethernet_msgs/msg/Packet",
    "std_msgs/msg/UInt8MultiArray",
)
_KNOWN = (CLOUD, *LISTS, ars430.PACKET, *_PACKETS)
# ROS 2 bags up to Humble do not hold the definitions of their messages.
MESSAGE_DEFINITIONS = {
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 elevation\n"
    "float32 doppler_velocity\nfloat32 amplitude",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nradar_msgs/RadarReturn[] returns",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header\nnebula_msgs/NebulaPacket[] packets",
    "udp_msgs/msg/UdpPacket": "std_msgs/Header header\nstring address\nuint16 src_port\n"
    "uint8[] data",
    "continental_msgs/msg/ContinentalArs548Detection": "float32 azimuth_angle\n"
    "float32 azimuth_angle_std\nbool invalid_distance\nbool invalid_distance_std\n"
    "bool invalid_azimuth\nbool invalid_azimuth_std\nbool invalid_elevation\n"
    "bool invalid_elevation_std\nbool invalid_range_rate\nbool invalid_range_rate_std\n"
    "float32 elevation_angle\nfloat32 elevation_angle_std\nfloat32 range\nfloat32 range_std\n"
    "float32 range_rate\nfloat32 range_rate_std\nint8 rcs\nuint16 measurement_id\n"
    "uint8 raw_positive_predictive_value\nuint8 classification\n"
    "uint8 raw_multi_target_probability\nuint16 object_id\nuint8 raw_ambiguity_flag",
    "continental_msgs/msg/ContinentalArs548DetectionList": "std_msgs/Header header\n"
    "uint8 stamp_sync_status\ngeometry_msgs/Point origin_pos\nfloat32 origin_pitch\n"
    "float32 origin_pitch_std\nfloat32 origin_yaw\nfloat32 origin_yaw_std\n"
    "float32 ambiguity_free_velocity_min\nfloat32 ambiguity_free_velocity_max\n"
    "float32 alignment_azimuth_correction\nfloat32 alignment_elevation_correction\n"
    "uint8 alignment_status\ncontinental_msgs/ContinentalArs548Detection[] detections",
    **ars430.ARS430_DEFINITIONS,
}


def typestore(connection: Any) -> Any:
    """Return the definitions of a topic's messages: the bag's, else the usual ones.

    Parameters
    ----------
    connection : rosbags.interfaces.Connection
        A topic of a bag.

    Returns
    -------
    rosbags.typesys.store.Typestore
        Holds the topic's type and all types in it.
    """
    from rosbags.interfaces import MessageDefinitionFormat as DefinitionFormat  # noqa: PLC0415
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore  # noqa: PLC0415

    definition = connection.msgdef
    if definition.format == DefinitionFormat.NONE:
        store = get_typestore(Stores.ROS2_HUMBLE)
        for name, text in MESSAGE_DEFINITIONS.items():
            store.register(get_types_from_msg(text, name))
        return store
    store = get_typestore(Stores.EMPTY)
    if definition.format == DefinitionFormat.MSG:
        store.register(get_types_from_msg(definition.data, connection.msgtype))
    else:
        store.register(get_types_from_idl(definition.data))
    return store


_ENDINGS = (".bag", ".db3", ".mcap")
_REPAIR_COMMANDS = {
    ".bag": "rosbag reindex",
    ".mcap": "mcap recover",
    ".db3": "sqlite3 FILE .recover",
}
_MESSAGES_A_REPORT = 256  # between two reports of progress
Decode = Callable[[bytes], Any]


def _accepts(source: str) -> bool:
    path = Path(source)
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.is_file() and path.suffix.lower() in _ENDINGS


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    with _opened(source) as reader:
        wanted = [c for c in reader.connections if c.msgtype in _KNOWN and context.wants(c.topic)]
        topics = {topic.id: _Topic(source, topic, reader, context) for topic in wanted}
        found = False
        for topic, stamp, raw in _messages(source, reader, wanted, context):
            for frame in topics[topic.id].frames(raw, stamp * 1e-9):
                found = True
                yield frame
        for each in topics.values():
            for frame in each.finish():
                found = True
                yield frame
        if not found:
            listed = ", ".join(f"{c.topic} ({c.msgtype})" for c in reader.connections) or "none"
            raise NothingHereError(
                "{}: no radar topic{} in it",
                source,
                Text(" of that name") if context.sensor else "",
                hint=Text("topics: {}; known types: {}", listed, ", ".join(_KNOWN)),
            )


@contextmanager
def _opened(source: str) -> Iterator[Any]:
    """Open a bag of either kind; report damage in one line."""
    # Here and not above: the library takes a fifth of a second to load.
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415
    from ruamel.yaml.error import YAMLWarning  # noqa: PLC0415

    limit_rosbags()
    kind = rosbag1 if Path(source).suffix.lower() == ".bag" else rosbag2
    reader = kind.Reader(source)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", YAMLWarning)  # about style
            reader.open()
        _require_counts(reader.connections)
    except Exception as error:
        raise _damaged(source, error) from error
    try:
        yield reader
    finally:
        reader.close()


def _require_counts(connections: list[Any]) -> None:
    for each in connections:
        if not isinstance(each.msgcount, int) or each.msgcount < 0:
            raise ValueError(Text("the number of messages of {} is no number", each.topic))


def _messages(
    source: str, reader: Any, wanted: list[Any], context: ReaderContext
) -> Iterator[tuple[Any, int, bytes]]:
    """Yield the messages of the wanted topics as far as the bag can be read."""
    total, stage = sum(topic.msgcount for topic in wanted), Text("reading {}", Path(source).name)
    messages = iter(reader.messages(connections=wanted)) if wanted else iter(())
    for number in count():
        if number % _MESSAGES_A_REPORT == 0:
            context.reporter.progress(stage, min(number, total), total)
        try:
            message = next(messages, None)
        except Exception as error:
            if number == 0:
                raise _damaged(source, error) from error
            context.counts["damaged_files"] += 1
            context.reporter.warn(
                "{}: after {:,} whole messages: {}", source, number, first_line(error)
            )
            return
        if message is None:
            return
        yield message


def _damaged(source: str, error: Exception) -> InputError:
    """Return the error for a bag that cannot be read, with the command that may repair it."""
    repair = _REPAIR_COMMANDS.get(Path(source).suffix.lower(), "ros2 bag reindex")
    return InputError(
        "{}: cannot be read as a bag: {}",
        source,
        first_line(error),
        hint=Text("a bag that was cut off: {}", repair),
    )


class _Topic:
    """Reader of one topic of a bag, from messages to frames."""

    def __init__(self, source: str, connection: Any, reader: Any, context: ReaderContext) -> None:
        self._name, self._kind = connection.topic, connection.msgtype
        self._context = context
        self._decode = _decoder(source, connection, reader)
        self._layouts: dict[tuple[str, ...], Layout] = {}
        self._group = ars430.PacketGroup(sensor=connection.topic)

    def finish(self) -> Iterator[Frame]:
        """Yield the frame whose packets are still being collected."""
        yield from self._group.finish()

    def frames(self, raw: bytes, recorded: float) -> Iterator[Frame]:
        """Yield the frames of a message; one that is damaged is counted."""
        try:
            message = self._decode(raw)
            if self._kind in _PACKETS:
                yield from self._from_packets(message, recorded)
            elif self._kind == ars430.PACKET:
                stamp = _seconds(message.header.stamp)
                yield from self._group.put(message, stamp=stamp, recorded=recorded)
            else:
                rows = message_rows(message) if self._kind == CLOUD else _rows(message, self._kind)
                yield from self._from_rows(rows, message, recorded)
        # A type of a known name may be of another version, and lack fields.
        except (DamagedError, AttributeError) as error:
            if not self._context.counts["damaged_frames"]:
                self._context.reporter.warn("{}: {}", self._name, error)
            self._context.counts["damaged_frames"] += 1

    def _from_rows(self, rows: Any, message: Any, recorded: float) -> Iterator[Frame]:
        """Yield the frame of a cloud or a list of detections; nothing of a lidar's."""
        layout = self._layout(rows.dtype)
        # A cloud without speeds is a lidar's, unless the user asks for it by name.
        if not (layout.is_radar or (layout.has_positions and self._context.sensor)):
            return
        stamp = _seconds(message.header.stamp)
        frame = layout.frame(
            values_of(rows),
            sensor=self._name,
            sensor_time=stamp,
            recorder_time=recorded,
            stamp="header stamp",
            # Empty clouds without a stamp are all equal, but no duplicates.
            identity=(stamp, hash(rows.tobytes())) if stamp else None,
        )
        yield _without_invalid(frame, rows)

    def _layout(self, kind: np.dtype[Any]) -> Layout:
        """Return, and cache, which fields of a message are which columns."""
        names = kind.names or ()
        if names not in self._layouts:
            try:
                layout = find_layout(names, self._context.columns, kind=kind)
            except UsageError as error:
                hint = Text("{}; {} takes one topic of several", error.hint, "--sensor")
                raise UsageError("{}: {}", self._name, error.message, hint=hint) from error
            if layout.has_positions and not layout.is_radar:
                fields = ", ".join(names)
                self._context.reporter.log(
                    Text("{}: no speeds among the fields {}", self._name, fields)
                )
            layout.explain(self._name, self._context)
            self._layouts[names] = layout
        return self._layouts[names]

    def _from_packets(self, message: Any, recorded: float) -> Iterator[Frame]:
        """Yield a frame for each detection list among the datagrams of a message."""
        for packet in getattr(message, "packets", [message]):
            data = packet.payload if hasattr(packet, "payload") else packet.data
            payload = np.asarray(data, dtype=np.uint8).tobytes()
            if method_of(payload) != LIST_METHOD:
                continue
            time = _packet_time(packet, recorded)
            frame = read_detections(payload, sensor=self._name, recorder_time=time)
            if frame is None:
                raise DamagedError(Text("a detection list counts more than it holds"))
            yield frame


def _decoder(source: str, connection: Any, reader: Any) -> Decode:
    """Return a function that decodes messages of a topic."""
    try:
        store = typestore(connection)
    except Exception as error:
        raise _damaged(source, error) from error
    ros1 = type(reader).__module__.startswith("rosbags.rosbag1")
    read = store.deserialize_ros1 if ros1 else store.deserialize_cdr

    def decode(raw: bytes) -> Any:
        try:
            return read(raw, connection.msgtype)
        except Exception as error:
            raise DamagedError(first_line(error)) from error

    return decode


def _rows(message: Any, kind: str) -> Any:
    """Return the detections that a message lists, as a structured array."""
    where, item_kind = LISTS[kind]
    names = [line.split()[1] for line in MESSAGE_DEFINITIONS[item_kind].splitlines()]
    return np.array(
        [tuple(getattr(item, name) for name in names) for item in getattr(message, where)],
        dtype=[(name, np.float32) for name in names],
    )


def _without_invalid(frame: Frame, rows: Any) -> Frame:
    """Replace, in place, values that the sensor marks as invalid by NaN."""
    for name in ("invalid_distance", "invalid_azimuth", "invalid_elevation"):
        if name in rows.dtype.names:
            frame.points[rows[name] != 0] = np.nan
    if "invalid_range_rate" in rows.dtype.names:
        frame.range_rate[rows["invalid_range_rate"] != 0] = np.nan
    return frame


def _packet_time(packet: Any, recorded: float) -> float:
    """Return when a packet was received, UNIX seconds: by its message, else by the bag."""
    stamped = packet if hasattr(packet, "stamp") else getattr(packet, "header", None)
    stamp = getattr(stamped, "stamp", None)
    return recorded if stamp is None else _seconds(stamp)


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec * 1e-9)


FORMAT = Format(
    name="ROS bag",
    takes=".bag (ROS 1), a folder with metadata.yaml, .db3 or .mcap (ROS 2)",
    accepts=_accepts,
    frames=_frames,
    endings=_ENDINGS,
    rank=1,
)

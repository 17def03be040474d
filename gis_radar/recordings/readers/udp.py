"""Detection lists of the Continental ARS548 RDI: decoding (a UDP datagram each), and reception.

The layout follows the public structs of robotics-upo/ars548_ros and tier4/nebula: big-endian, no
padding. An address looks like `udp://224.0.2.2:42102`.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from ipaddress import IPv4Address
from queue import Empty, Queue
from threading import Event, Thread
from urllib.parse import parse_qs, urlsplit

import numpy as np

from gis_radar.base import InputError, Text, UsageError, stopped_by_signals
from gis_radar.recordings.columns import cartesian
from gis_radar.recordings.frames import (
    Column,
    Format,
    Frame,
    NothingHereError,
    ReaderContext,
    counts_text,
)

PORT = 42102  # the sensor's default, like GROUP
GROUP = "224.0.2.2"
_SLOTS = 800  # detections in a list
_SIZE = 35_336  # bytes of a datagram with a detection list
LIST_METHOD = 336  # SOME/IP method of a detection list
OTHER_METHODS = {329: "object list", 380: "sensor status", 396: "filter status"}

_HEAD = struct.Struct(">HHI")
_STAMP = struct.Struct(">IIB")
_STAMP_AT, _LIST_AT, _COUNT_AT = 36, 101, 35_309
_SYNCHRONISED = 1
_INVALID_POSITION = 0x01 | 0x04 | 0x10  # distance, azimuth, elevation
_INVALID_RATE = 0x40

_DETECTION = np.dtype(
    [
        ("azimuth", ">f4"),
        ("azimuth_std", ">f4"),
        ("invalid", "u1"),
        ("elevation", ">f4"),
        ("elevation_std", ">f4"),
        ("range", ">f4"),
        ("range_std", ">f4"),
        ("range_rate", ">f4"),
        ("range_rate_std", ">f4"),
        ("rcs", "i1"),
        ("measurement_id", ">u2"),
        ("probability", "u1"),
        ("classification", "u1"),
        ("multi_target", "u1"),
        ("object_id", ">u2"),
        ("ambiguity", "u1"),
        ("sort_index", ">u2"),
    ]
)
_FURTHER_FIELDS = ("probability", "multi_target", "ambiguity", "classification", "object_id")


def method_of(payload: bytes) -> int | None:
    """Return the method of an ARS548 message, or None for any other payload.

    The length in the header of a message must be that of the datagram.
    """
    if len(payload) < _HEAD.size:
        return None
    service, method, length = _HEAD.unpack_from(payload)
    known = method == LIST_METHOD or method in OTHER_METHODS
    return method if known and service == 0 and length + _HEAD.size == len(payload) else None


def read_detections(payload: bytes, *, sensor: str, recorder_time: float | None) -> Frame | None:
    """Decode a detection list.

    Parameters
    ----------
    payload : bytes
        A datagram for which :func:`method_of` returns `LIST_METHOD`.
    sensor : str
        Address of the sender.
    recorder_time : float or None
        Time of reception, UNIX seconds.

    Returns
    -------
    Frame or None
        None where the list states more detections than it has slots. `further` has the percentages
        `probability` (that the detection exists), `multi_target` and `ambiguity` (that the speed is
        the right one of several), then `classification` and `object_id`.
    """
    (count,) = struct.unpack_from(">I", payload, _COUNT_AT)
    if len(payload) != _SIZE or count > _SLOTS:
        return None
    nanoseconds, seconds, status = _STAMP.unpack_from(payload, _STAMP_AT)
    rows = np.frombuffer(payload, _DETECTION, count, _LIST_AT)
    points = cartesian(_native(rows, "range"), _native(rows, "azimuth"), _native(rows, "elevation"))
    rate = _native(rows, "range_rate")
    flags = rows["invalid"]
    if flags.any():
        points[(flags & _INVALID_POSITION) != 0] = np.nan
        rate = np.where(flags & _INVALID_RATE, np.float32(np.nan), rate)
    used = payload[: _LIST_AT + count * _DETECTION.itemsize]
    return Frame(
        sensor=sensor,
        points=points,
        range_rate=rate,
        rcs=_native(rows, "rcs"),
        further={name: _native(rows, name) for name in _FURTHER_FIELDS},
        sensor_time=seconds + nanoseconds * 1e-9,
        recorder_time=recorder_time,
        synchronised=status == _SYNCHRONISED,
        identity=hash(used),
    )


def _native(rows: Column, name: str) -> Column:
    return rows[name].astype(np.float32)


_SCHEME = "udp://"
# A second of frames, in case writing to disk blocks.
_RECEIVE_BUFFER_BYTES = 1 << 23
_POLL_S = 0.2  # between two checks of the clock and of Ctrl-C


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    seen = Counter[str]()
    for payload, sensor, now in _received(source, context):
        seen[sensor] += 1
        if method_of(payload) != LIST_METHOD or not context.wants(sensor):
            continue
        frame = read_detections(payload, sensor=sensor, recorder_time=now)
        if frame is None:
            context.counts["damaged_frames"] += 1
        else:
            yield frame
    if not seen:
        raise NothingHereError(
            "{}: nothing came in",
            source,
            hint="is the sensor on, are address, port and interface right?",
        )
    context.reporter.log(Text("heard {}", counts_text(seen)))


def _received(source: str, context: ReaderContext) -> Iterator[tuple[bytes, str, float]]:
    """Yield payload, sender and time (UNIX s) of datagrams until time is up or Ctrl-C."""
    group, port, interface = _address(source)
    queue: Queue[tuple[bytes, str, float]] = Queue()
    end = time.monotonic() + (context.duration_s or float("inf"))
    with _listening(source, group, port, interface) as listener, stopped_by_signals() as stop:
        # In a thread of its own: the system would drop datagrams while writing to disk blocks.
        receiver = Thread(target=_receive, args=(listener, queue, stop), daemon=True)
        receiver.start()
        context.reporter.log(Text("listening to {}, port {}; Ctrl-C ends it", group, port))
        try:
            while not stop.is_set() and time.monotonic() < end:
                with suppress(Empty):
                    yield queue.get(timeout=_POLL_S)
        finally:
            stop.set()
            receiver.join()
        while not queue.empty():
            yield queue.get()


def _receive(listener: socket.socket, queue: Queue[tuple[bytes, str, float]], stop: Event) -> None:
    listener.settimeout(_POLL_S)
    while not stop.is_set():
        with suppress(TimeoutError):
            payload, (sender, _) = listener.recvfrom(2 * _SIZE)
            queue.put((payload, sender, time.time()))


def _address(source: str) -> tuple[str, int, str]:
    """Return address, port and interface of `udp://[GROUP][:PORT][?interface=IP]`."""
    parts = urlsplit(source)
    query = parse_qs(parts.query)
    try:
        port = parts.port or PORT
        group = str(IPv4Address(parts.hostname or GROUP))
        interface = str(IPv4Address(query.pop("interface", ["0.0.0.0"])[0]))  # noqa: S104
    except ValueError as error:
        raise UsageError("{}: {}", source, error, hint=_EXAMPLE) from error
    if query or parts.path.strip("/"):
        raise UsageError("{}: what is more than the address is not known", source, hint=_EXAMPLE)
    return group, port, interface


_EXAMPLE = f"such as {_SCHEME}{GROUP}:{PORT}?interface=10.13.1.1"


@contextmanager
def _listening(source: str, group: str, port: int, interface: str) -> Iterator[socket.socket]:
    """Open a socket that receives the datagrams of a group, or of this machine's address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            multicast = IPv4Address(group).is_multicast
            listener.bind(("" if multicast else group, port))
            if multicast:
                membership = socket.inet_aton(group) + socket.inet_aton(interface)
                listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            raise InputError("{}: cannot listen: {}", source, error.strerror or error) from error
        yield listener


FORMAT = Format(
    name="ARS548 from the network",
    takes=f"{_SCHEME}{GROUP}:{PORT}",
    accepts=lambda source: source.lower().startswith(_SCHEME),
    frames=_frames,
    live=True,
)

"""ARS548 detection lists as they come from the network: `udp://224.0.2.2:42102`."""

from __future__ import annotations

import signal
import socket
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from ipaddress import IPv4Address
from queue import Empty, Queue
from threading import Event, Thread, current_thread, main_thread
from types import FrameType
from urllib.parse import parse_qs, urlsplit

from gis_radar.errors import InputError, UsageError
from gis_radar.recordings.ars548 import GROUP, METHOD, PORT, SIZE, method_of, read_detections
from gis_radar.recordings.frames import Format, Frame, NothingHereError, ReaderContext, counted

SCHEME = "udp://"
# A second of frames, should the disk keep the writer waiting.
RECEIVE_BUFFER_BYTES = 1 << 23
LOOK_UP_S = 0.2  # between two looks at the clock and at Ctrl-C
STOPPING = (signal.SIGINT, signal.SIGTERM)


def _accepts(source: str) -> bool:
    return source.lower().startswith(SCHEME)


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    seen = Counter[str]()
    for payload, sensor, now in _received(source, context):
        seen[sensor] += 1
        if method_of(payload) != METHOD or not context.wants(sensor):
            continue
        frame = read_detections(payload, sensor=sensor, recorder_time=now)
        if frame is None:
            context.counts["damaged_frames"] += 1
        else:
            yield frame
    if not seen:
        raise NothingHereError(
            f"{source}: nothing came in",
            hint="is the sensor on, are address, port and interface right?",
        )
    context.reporter.log(f"heard {counted(seen)}")


def _received(source: str, context: ReaderContext) -> Iterator[tuple[bytes, str, float]]:
    """Yield payload, sender and time of what comes in until the time is up or the user stops it."""
    group, port, interface = _address(source)
    waiting: Queue[tuple[bytes, str, float]] = Queue()
    end = time.monotonic() + (context.duration_s or float("inf"))
    with _listening(source, group, port, interface) as listener, _stopping() as stop:
        # A thread of its own: the system drops what waits while the disk keeps us.
        receiver = Thread(target=_receive, args=(listener, waiting, stop), daemon=True)
        receiver.start()
        context.reporter.log(f"listening to {group}, port {port}; Ctrl-C ends it")
        try:
            while not stop.is_set() and time.monotonic() < end:
                with suppress(Empty):
                    yield waiting.get(timeout=LOOK_UP_S)
        finally:
            stop.set()
            receiver.join()
        while not waiting.empty():
            yield waiting.get()


def _receive(
    listener: socket.socket, waiting: Queue[tuple[bytes, str, float]], stop: Event
) -> None:
    listener.settimeout(LOOK_UP_S)
    while not stop.is_set():
        with suppress(TimeoutError):
            payload, (sender, _) = listener.recvfrom(2 * SIZE)
            waiting.put((payload, sender, time.time()))


def _address(source: str) -> tuple[str, int, str]:
    """Return group or local address, port and interface of `udp://[GROUP][:PORT][?interface=IP]`."""
    parts = urlsplit(source)
    query = parse_qs(parts.query)
    try:
        port = parts.port or PORT
        group = str(IPv4Address(parts.hostname or GROUP))
        interface = str(IPv4Address(query.pop("interface", ["0.0.0.0"])[0]))  # noqa: S104
    except ValueError as error:
        raise UsageError(f"{source}: {error}", hint=_EXAMPLE) from error
    if query or parts.path.strip("/"):
        raise UsageError(f"{source}: what is more than the address is not known", hint=_EXAMPLE)
    return group, port, interface


_EXAMPLE = f"such as {SCHEME}{GROUP}:{PORT}?interface=10.13.1.1"


@contextmanager
def _listening(source: str, group: str, port: int, interface: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            multicast = IPv4Address(group).is_multicast
            listener.bind(("" if multicast else group, port))
            if multicast:
                membership = socket.inet_aton(group) + socket.inet_aton(interface)
                listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError as error:
            raise InputError(f"{source}: cannot listen: {error.strerror or error}") from error
        yield listener


@contextmanager
def _stopping() -> Iterator[Event]:
    """Yield an event that the user's Ctrl-C sets; the second one interrupts as always."""
    stop = Event()

    def note(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    on_main = current_thread() is main_thread()  # the only one that signals reach
    before = {number: signal.signal(number, note) for number in STOPPING} if on_main else {}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


FORMAT = Format(
    name="ARS548 from the network",
    takes=f"{SCHEME}{GROUP}:{PORT}",
    accepts=_accepts,
    frames=_frames,
    live=True,
)

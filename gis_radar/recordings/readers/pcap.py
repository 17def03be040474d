"""ARS548 detection lists in captures of network traffic: pcap and pcapng, also gzipped.

No library is used: dpkt and python-pcapng, last released in 2022, read as many bytes as a damaged
length states, up to 4 GiB; dpkt yields the begin of a cut packet as a whole one and takes the clock
and link type of the first interface for all (its issue 681); python-pcapng reads no pcap, and
pcapng at a tenth of our speed. scapy is large and GPL. The tests read files written by libraries.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from socket import inet_ntoa
from typing import BinaryIO, NamedTuple

from gis_radar.base import Text
from gis_radar.recordings.frames import (
    DamagedError,
    Format,
    Frame,
    NothingHereError,
    ReaderContext,
    counts_text,
)
from gis_radar.recordings.readers.udp import LIST_METHOD, OTHER_METHODS, method_of, read_detections
from gis_radar.recordings.unpacking import ExplodingError, LimitedStream

_GZIP = b"\x1f\x8b"
_PCAPNG = b"\x0a\x0d\x0d\x0a"
# Byte order and ticks a second by the magic number.
_PCAP = {
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
}
_BUFFER_BYTES = 1 << 20
_LARGEST_BLOCK = 1 << 24  # bytes; more is damage
_BYTES_A_REPORT = 1 << 22  # between two reports of progress, some of them a second

_SECTION, _INTERFACE, _PACKET, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 2, 3, 6
_RESOLUTION, _OFFSET = 9, 14
_SECTION_MAGIC = 0x1A2B3C4D
_BLOCK_FRAME = 12  # type and length, and the length again at the end


class Packet(NamedTuple):
    """One captured packet.

    Parameters
    ----------
    time : float or None
        UNIX seconds by the clock of the capturing computer; None where the file has none.
    link : int
        Link type, which states the kind of link header.
    data : bytes
        The packet from its link header on.
    whole : bool
        False where the capture kept only its beginning.
    """

    time: float | None
    link: int
    data: bytes
    whole: bool


class _Interface(NamedTuple):
    link: int
    ticks: int
    offset_s: int


def is_capture(path: Path) -> bool:
    """Return whether a file, unpacked if gzipped, begins like a capture."""
    try:
        with _opened(path) as stream:
            magic = stream.read(4)
    except (OSError, EOFError, zlib.error):
        return False
    return magic == _PCAPNG or magic in _PCAP


def read_packets(path: Path) -> Iterator[tuple[Packet, int]]:
    """Read the packets of a capture one after the other.

    Parameters
    ----------
    path : Path
        A pcap or pcapng file; either may be compressed by gzip.

    Yields
    ------
    packet : Packet
        The packet.
    position : int
        Bytes of the (uncompressed) capture read so far.

    Raises
    ------
    DamagedError
        After the last whole packet, if the file ends in the middle of one or goes on damaged.
    """
    with _opened(path) as stream:
        magic = stream.read(4)
        try:
            if magic == _PCAPNG:
                yield from _read_pcapng(stream)
            elif magic in _PCAP:
                yield from _read_pcap(stream, *_PCAP[magic])
            else:
                raise DamagedError(Text("no capture (pcap, pcapng)"))
        except EOFError as error:
            raise DamagedError(Text("cut off in the middle of a packet")) from error
        except (zlib.error, ExplodingError) as error:
            raise DamagedError(Text("damaged gzip: {}", error)) from error
        except (struct.error, ValueError, ArithmeticError) as error:  # too short for its fields
            raise DamagedError(Text("a block that cannot be: {}", error)) from error


def _opened(path: Path) -> BinaryIO:
    with path.open("rb") as start:
        packed = start.read(2) == _GZIP
    if packed:
        return LimitedStream(gzip.open(path), path.stat().st_size)  # type: ignore[return-value, arg-type]
    return path.open("rb", buffering=_BUFFER_BYTES)


def _read_pcap(stream: BinaryIO, order: str, ticks: int) -> Iterator[tuple[Packet, int]]:
    """Yield the packets of a pcap file from behind its magic number, with positions."""
    head = _read_exactly(stream, 20)
    (link,) = struct.unpack_from(order + "I", head, 16)
    link &= 0xFFFF  # the upper half is about checksums at the end
    record = struct.Struct(order + "IIII")
    position = 24
    while start := stream.read(record.size):
        if len(start) < record.size:
            raise EOFError
        seconds, fraction, kept, length = record.unpack(start)
        if not any(start):  # a disk that was not written to the end
            raise DamagedError(Text("only zeros from byte {:,} on", position))
        if kept > _LARGEST_BLOCK:
            raise DamagedError(Text("a packet of {:,} bytes at byte {:,}", kept, position))
        # nanoseconds under the magic number of microseconds; some programs round up to a second
        if fraction > ticks:
            what = Text("{:,} parts of a second, of which it has {:,}", fraction, ticks)
            raise DamagedError(Text("a time of {} at byte {:,}", what, position))
        data = _read_exactly(stream, kept)
        position += record.size + kept
        yield Packet(seconds + fraction / ticks, link, data, kept >= length), position


def _read_pcapng(stream: BinaryIO) -> Iterator[tuple[Packet, int]]:
    """Yield the packets of a pcapng file from behind its first four bytes, with positions."""
    order, kind, position = "<", _SECTION, 0
    interfaces: list[_Interface] = []
    start = _read_exactly(stream, 4)
    while True:
        if kind == _SECTION:
            order, body, size = _begin_section(stream, start)
            interfaces = []
        else:
            size = struct.unpack(order + "I", start)[0]
            body = _read_exactly(stream, _block_length(size, position) - 8)
        position += size
        if kind == _INTERFACE:
            interfaces.append(_interface(body, order))
        elif kind in (_ENHANCED, _PACKET, _SIMPLE):
            yield _packet(kind, body, order, interfaces), position
        head = stream.read(8)
        if not head:
            return
        if len(head) < 8:
            raise EOFError
        kind, start = struct.unpack(order + "I", head[:4])[0], head[4:]


def _begin_section(stream: BinaryIO, start: bytes) -> tuple[str, bytes, int]:
    """Return byte order, content and length of a section header whose length field is `start`."""
    magic = _read_exactly(stream, 4)
    orders = [order for order in "<>" if struct.unpack(order + "I", magic)[0] == _SECTION_MAGIC]
    if not orders:
        raise DamagedError(Text("a section without byte order"))
    size = _block_length(struct.unpack(orders[0] + "I", start)[0], 0)
    return orders[0], _read_exactly(stream, size - _BLOCK_FRAME), size


def _block_length(size: int, position: int) -> int:
    if not _BLOCK_FRAME <= size <= _LARGEST_BLOCK or size % 4:
        raise DamagedError(Text("a block of {:,} bytes at byte {:,}", size, position))
    return size


def _interface(body: bytes, order: str) -> _Interface:
    """Return link type and clock of an interface description block."""
    (link,) = struct.unpack_from(order + "Hxx4x", body)  # and the longest length, unused
    ticks, offset_s, at = 1_000_000, 0, 8
    while at + 4 <= len(body) - 4:
        code, length = struct.unpack_from(order + "HH", body, at)
        value = body[at + 4 : at + 4 + length]
        if code == 0:
            break
        if code == _RESOLUTION and value:
            ticks = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _OFFSET and length == 8:
            (offset_s,) = struct.unpack(order + "q", value)
        at += 4 + length + -length % 4
    return _Interface(link=link, ticks=ticks, offset_s=offset_s)


def _packet(kind: int, body: bytes, order: str, interfaces: list[_Interface]) -> Packet:
    """Return the packet of a simple, an enhanced or an obsolete packet block."""
    if kind == _SIMPLE:
        number, high, low, start = 0, 0, 0, 4
        (length,) = struct.unpack_from(order + "I", body)
        kept = min(length, len(body) - 8)
    else:
        layout = "IIIII" if kind == _ENHANCED else "HxxIIII"
        number, high, low, kept, length = struct.unpack_from(order + layout, body)
        start = 20
    if number >= len(interfaces) or start + kept > len(body):
        raise DamagedError(
            Text("a packet of no interface") if not interfaces else Text("a packet too long")
        )
    interface = interfaces[number]
    data = body[start : start + kept]
    time = None
    if kind != _SIMPLE:
        time = interface.offset_s + ((high << 32) | low) / interface.ticks
    return Packet(time, interface.link, data, kept >= length)


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    return data


# Link types: (where the EtherType stands, where the content begins).
_ETHERTYPE_AT = {1: (12, 14), 113: (14, 16), 276: (0, 20)}  # Ethernet, Linux cooked v1 and v2
_IP_AT = {0: 4, 108: 4, 12: 0, 14: 0, 101: 0, 228: 0}  # BSD loopback, raw IP
_IPV4 = 0x0800
_VLAN = (0x8100, 0x88A8, 0x9100)
_UDP, _TCP = 17, 6
_MORE, _FRAGMENT_OFFSET = 0x2000, 0x1FFF
# Most incomplete datagrams that are held: senders have few under way, the oldest is given up.
_MOST_PENDING = 64
# Seconds a datagram may take to arrive (RFC 791); later its identification may be used again.
_REASSEMBLY_S = 15.0
_LONGEST_PACKET = 65_535  # bytes of an IPv4 packet


class Datagram(NamedTuple):
    """A UDP datagram.

    Parameters
    ----------
    source : str
        IPv4 address of the sender.
    port : int
        UDP port of the receiver.
    payload : bytes
        Content without the UDP header.
    """

    source: str
    port: int
    payload: bytes


@dataclass(slots=True)
class _Fragments:
    """Fragments of one datagram that have arrived so far."""

    first_time: float
    fragments: dict[int, bytes] = field(default_factory=dict)
    bytes_held: int = 0
    size: int = -1

    def add(self, at: int, fragment: bytes, *, last: bool) -> bytes | None:
        """Take a fragment at byte `at`; return the whole datagram once no fragment is missing."""
        if at not in self.fragments:
            self.fragments[at] = fragment
            self.bytes_held += len(fragment)
        if last:
            self.size = at + len(fragment)
        if not 0 <= self.size <= self.bytes_held:
            return None
        datagram = bytearray(self.size)
        reached = 0
        for start in sorted(self.fragments):
            if start > reached:
                return None
            datagram[start : start + len(self.fragments[start])] = self.fragments[start]
            reached = max(reached, start + len(self.fragments[start]))
        return bytes(datagram[: self.size])


class Datagrams:
    """Reassembly of datagrams from packets in order of capture, with counts of all traffic.

    Attributes
    ----------
    traffic : Counter
        Packets by protocol and destination port, such as `UDP port 42102`.
    cut : int
        Packets of which the capture has only the beginning.
    """

    def __init__(self) -> None:
        self.cut = 0
        self._ports: Counter[tuple[int, int]] = Counter()
        self._others: Counter[str] = Counter()
        self._pending: dict[bytes, _Fragments] = {}
        self._lost = 0

    @property
    def incomplete(self) -> int:
        """Datagrams of which fragments are missing."""
        return self._lost + len(self._pending)

    @property
    def traffic(self) -> Counter[str]:
        """Packets by protocol and destination port."""
        names = {_UDP: "UDP", _TCP: "TCP"}
        seen = Counter({f"{names[kind]} port {port}": n for (kind, port), n in self._ports.items()})
        return seen + self._others

    def take(self, packet: Packet) -> Datagram | None:
        """Take a packet; return the datagram that it completes, if any."""
        if not packet.whole:
            self.cut += 1
        data = packet.data
        start = _network_layer(packet)
        if start is None or len(data) < start + 20 or data[start] >> 4 != 4:
            self._others["no IPv4"] += 1
            return None
        total, _, flags, kind = struct.unpack_from(">HHHxB", data, start + 2)
        begin, end = start + (data[start] & 0x0F) * 4, start + total
        if total == 0:
            end = len(data)  # captured before the network card cut it into segments
        if kind not in (_UDP, _TCP):
            self._others[f"IP protocol {kind}"] += 1
            return None
        if end > len(data):
            self.cut += packet.whole  # cut by a program that states the rest as the whole
            return None
        if flags & (_MORE | _FRAGMENT_OFFSET):
            content = self._reassemble(packet, start, flags, data[begin:end])
        else:
            content = data[begin:end]
        if content is None or len(content) < 8:
            return None
        port, length = struct.unpack_from(">HH", content, 2)
        self._ports[kind, port] += 1
        if kind != _UDP:
            return None
        source = inet_ntoa(data[start + 12 : start + 16])
        return Datagram(source, port, content[8 : length or len(content)])

    def _reassemble(self, packet: Packet, start: int, flags: int, fragment: bytes) -> bytes | None:
        """Add a fragment to its datagram; return the content once it is complete."""
        at = (flags & _FRAGMENT_OFFSET) * 8
        if at + len(fragment) > _LONGEST_PACKET:
            return None
        # Addresses, protocol and identification.
        head = packet.data[start : start + 20]
        key = head[12:20] + head[9:10] + head[4:6]
        now = packet.time or 0.0
        fragments = self._pending.get(key)
        if fragments is None or abs(now - fragments.first_time) > _REASSEMBLY_S:
            self._give_up(key)
            fragments = self._pending[key] = _Fragments(now)
        content = fragments.add(at, fragment, last=not flags & _MORE)
        if content is not None:
            del self._pending[key]
        return content

    def _give_up(self, key: bytes) -> None:
        """Give up an earlier datagram of the same key, or the oldest where there are too many."""
        if key not in self._pending and len(self._pending) < _MOST_PENDING:
            return
        del self._pending[key if key in self._pending else next(iter(self._pending))]
        self._lost += 1


def _network_layer(packet: Packet) -> int | None:
    """Return the byte at which the IPv4 header begins, or None without one."""
    data, link = packet.data, packet.link
    if link in _IP_AT:
        return _IP_AT[link]
    if link not in _ETHERTYPE_AT:
        return None
    at, start = _ETHERTYPE_AT[link]
    kind = int.from_bytes(data[at : at + 2])
    while kind in _VLAN:
        kind = int.from_bytes(data[start + 2 : start + 4])
        start += 4
    return start if kind == _IPV4 else None


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    datagrams, messages, sensors = Datagrams(), Counter[str](), Counter[str]()
    for datagram, time in _datagrams(Path(source), datagrams, context):
        method = method_of(datagram.payload)
        if method != LIST_METHOD:
            messages[OTHER_METHODS.get(method or 0, "")] += 1
            continue
        sensors[datagram.source] += 1
        if not context.wants(datagram.source):
            continue
        frame = read_detections(datagram.payload, sensor=datagram.source, recorder_time=time)
        if frame is None:
            context.counts["damaged_frames"] += 1
            continue
        yield frame
    _warn(source, datagrams, context)
    if not any(context.wants(sensor) for sensor in sensors):
        raise _no_detections_error(source, datagrams, messages, sensors)


def _datagrams(
    path: Path, datagrams: Datagrams, context: ReaderContext
) -> Iterator[tuple[Datagram, float | None]]:
    """Yield the datagrams of a capture; where it is cut off or damaged, warn and end."""
    total = None if path.suffix.lower() == ".gz" else path.stat().st_size
    reported = packets = 0
    try:
        for packet, position in read_packets(path):
            packets += 1
            if position - reported > _BYTES_A_REPORT:
                reported = position
                context.reporter.progress(Text("reading {}", path.name), position, total)
            datagram = datagrams.take(packet)
            if datagram is not None:
                yield datagram, packet.time
    except DamagedError as error:
        context.counts["damaged_files"] += 1
        context.reporter.warn("{}: after {:,} whole packets: {}", path, packets, error)


def _warn(source: str, datagrams: Datagrams, context: ReaderContext) -> None:
    """Count and warn of incomplete datagrams and of packets captured in part."""
    if datagrams.incomplete:
        context.counts["incomplete_datagrams"] += datagrams.incomplete
        context.reporter.warn(
            "{}: {:,} fragmented datagrams are not complete", source, datagrams.incomplete
        )
    if datagrams.cut:
        context.reporter.warn(
            "{}: {:,} packets are captured only in part (capture with a longer snap "
            "length: tcpdump -s 0)",
            source,
            datagrams.cut,
        )


def _no_detections_error(
    source: str, datagrams: Datagrams, messages: Counter[str], sensors: Counter[str]
) -> NothingHereError:
    """Return the error for a capture without the frames asked for: what there is instead."""
    if sensors:
        return NothingHereError(
            "{}: nothing from that sensor",
            source,
            hint=Text("sensors here: {}", counts_text(sensors)),
        )
    del messages[""]
    seen = counts_text(messages + datagrams.traffic) or Text("no packet at all")
    return NothingHereError(
        "{}: no ARS548 detection list in it", source, hint=Text("it has {}", seen)
    )


FORMAT = Format(
    name="ARS548 in a capture",
    takes=".pcap, .pcapng (also .gz)",
    accepts=lambda source: Path(source).is_file() and is_capture(Path(source)),
    frames=_frames,
    endings=(".pcap", ".pcapng", ".gz"),
)

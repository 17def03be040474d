"""UDP datagrams out of captured packets: link layers, VLAN tags, IPv4 and its fragments."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from socket import inet_ntoa
from typing import NamedTuple

from gis_radar.formats.captures import Packet

# Link types: (where the EtherType stands, where the content begins).
_TYPED = {1: (12, 14), 113: (14, 16), 276: (0, 20)}  # Ethernet, Linux cooked v1 and v2
_BARE = {0: 4, 108: 4, 12: 0, 14: 0, 101: 0, 228: 0}  # BSD loopback, raw IP
_IPV4 = 0x0800
_VLAN = (0x8100, 0x88A8, 0x9100)
_UDP, _TCP = 17, 6
_MORE, _OFFSET = 0x2000, 0x1FFF
# A sender has few datagrams on the way at a time; what is older will not be completed.
PENDING = 64
# Identifications come round again; RFC 791 gives a datagram no longer to arrive.
PATIENCE_S = 15.0
LONGEST = 65_535


class Datagram(NamedTuple):
    """A UDP datagram.

    Parameters
    ----------
    source : str
        IPv4 address of the sender.
    port : int
        Where it went.
    payload : bytes
        What it carries.
    """

    source: str
    port: int
    payload: bytes


@dataclass(slots=True)
class _Parts:
    """The fragments of one datagram that have come so far."""

    begun: float
    pieces: dict[int, bytes] = field(default_factory=dict)
    held: int = 0
    size: int = -1

    def add(self, at: int, piece: bytes, *, last: bool) -> bytes | None:
        """Take a fragment; return all of them in order once none is missing."""
        if at not in self.pieces:
            self.pieces[at] = piece
            self.held += len(piece)
        if last:
            self.size = at + len(piece)
        if not 0 <= self.size <= self.held:
            return None
        whole = bytearray(self.size)
        reached = 0
        for start in sorted(self.pieces):
            if start > reached:
                return None
            whole[start : start + len(self.pieces[start])] = self.pieces[start]
            reached = max(reached, start + len(self.pieces[start]))
        return bytes(whole[: self.size])


class Datagrams:
    """Puts datagrams together from packets in order of capture, and counts all that passes.

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
        self._pending: dict[bytes, _Parts] = {}
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
        """Return the datagram that a packet completes, if it does."""
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
            end = len(data)  # the network card did the segmentation
        if kind not in (_UDP, _TCP):
            self._others[f"IP protocol {kind}"] += 1
            return None
        if end > len(data):
            return None
        if flags & (_MORE | _OFFSET):
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

    def _reassemble(self, packet: Packet, start: int, flags: int, piece: bytes) -> bytes | None:
        at = (flags & _OFFSET) * 8
        if at + len(piece) > LONGEST:
            return None
        # Who to whom, which protocol, which identification.
        head = packet.data[start : start + 20]
        key = head[12:20] + head[9:10] + head[4:6]
        now = packet.time or 0.0
        parts = self._pending.get(key)
        if parts is None or abs(now - parts.begun) > PATIENCE_S:
            self._forget(key)
            parts = self._pending[key] = _Parts(now)
        content = parts.add(at, piece, last=not flags & _MORE)
        if content is not None:
            del self._pending[key]
        return content

    def _forget(self, key: bytes) -> None:
        """Give up an earlier datagram of the same key, or the oldest where there are too many."""
        if key not in self._pending and len(self._pending) < PENDING:
            return
        del self._pending[key if key in self._pending else next(iter(self._pending))]
        self._lost += 1


def _network_layer(packet: Packet) -> int | None:
    """Return where the IP header begins, or None where there is none."""
    data, link = packet.data, packet.link
    if link in _BARE:
        return _BARE[link]
    if link not in _TYPED:
        return None
    at, start = _TYPED[link]
    kind = int.from_bytes(data[at : at + 2])
    while kind in _VLAN:
        kind = int.from_bytes(data[start + 2 : start + 4])
        start += 4
    return start if kind == _IPV4 else None

"""Radar data as radars and their users write it: ARS548 datagrams, captures, clouds."""

from __future__ import annotations

import socket
import struct
import warnings

import dpkt
import numpy as np
import pcapng
import pyarrow.parquet as pq
from maps import Listener
from pcapng import blocks

import gis_radar as gr

SENSOR, OTHER_SENSOR = "10.13.1.113", "10.13.1.114"
START = 1_700_000_000.0
SYNCHRONISED, NEVER, LOST = 1, 2, 3

# Written apart from the reader's table, field by field: one detection of the wire format.
DETECTION = struct.Struct(">ffBffffffbHBBBHBH")


def detection(distance=100.0, azimuth=0.1, elevation=0.02, rate=-5.0, rcs=-10, *, invalid=0):
    return DETECTION.pack(
        azimuth, 0.01, invalid, elevation, 0.02, distance, 0.2, rate, 0.3, rcs,
        7, 95, 3, 12, 41, 88, 5,
    )  # fmt: skip


def detection_list(time, detections=None, *, sync=SYNCHRONISED, count=None):
    """One detection list as its UDP payload, 35 336 bytes."""
    rows = [detection()] if detections is None else detections
    head = struct.pack(">HHIHHBBBBQIII", 0, 336, 35_328, 0, 0, 1, 1, 2, 0, 0, 0, 0, 0)
    stamp = struct.pack(">IIB", round(time % 1 * 1e9), int(time), sync)
    body = (head + stamp).ljust(101, b"\0") + b"".join(rows).ljust(800 * 44, b"\0")
    tail = struct.pack(">ffI", -22.9, 22.9, len(rows) if count is None else count)
    return (body + tail).ljust(35_336, b"\0")


def ip_packets(payload, *, source=SENSOR, port=42_102, ident=1, size=1480):
    """IPv4 packets of a UDP datagram, in fragments of at most `size` bytes."""
    udp = bytes(dpkt.udp.UDP(sport=42_101, dport=port, ulen=8 + len(payload), data=payload))
    for at in range(0, len(udp), size):
        more = at + size < len(udp)
        ip = dpkt.ip.IP(
            src=socket.inet_aton(source), dst=socket.inet_aton("224.0.2.2"), p=17, ttl=4,
            id=ident & 0xFFFF, data=udp[at : at + size],
        )  # fmt: skip
        ip.len = 20 + len(ip.data)
        ip.mf, ip.offset = int(more), at // 8
        # dpkt writes no checksum over a fragment unless it is asked to; none is needed here.
        ip.sum = 1
        yield bytes(ip)


def ethernet(ip, *tags):
    """An Ethernet frame, with VLAN tags by their EtherTypes."""
    tagged = b"".join(struct.pack(">HH", tag, 100 + i) for i, tag in enumerate(tags))
    return b"\x01\x00\x5e\x00\x02\x02" + b"\x02" * 6 + tagged + b"\x08\x00" + ip


def frames_of(times, *, source=SENSOR, later=0.06, size=1480, **options):
    """Packets (time of capture, bytes) of one detection list a time."""
    for number, time in enumerate(times):
        payload = detection_list(time, **options)
        for ip in ip_packets(payload, source=source, ident=number + 1, size=size):
            yield time + later, ethernet(ip)


def write_pcap(path, packets, *, link=1, nano=False):
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65_535, linktype=link, nano=nano)
        for time, packet in packets:
            writer.writepkt(packet, time)
    return path


def write_pcapng(path, packets, interfaces):
    """Write packets (interface, ticks, bytes); interfaces are (link type, ticks as a power)."""
    section = blocks.SectionHeader(options={})
    for link, power in interfaces:
        section.new_member(
            blocks.InterfaceDescription, link_type=link, options={"if_tsresol": bytes([power])}
        )
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the library warns of itself
        writer = pcapng.FileWriter(file, section)
        for number, ticks, packet in packets:
            block = section.new_member(blocks.EnhancedPacket, interface_id=number)
            block.timestamp_high, block.timestamp_low = ticks >> 32, ticks & 0xFFFFFFFF
            block.packet_data = packet
            writer.write_block(block)
    return path


def times(count, *, start=START, period=0.05):
    return [start + number * period for number in range(count)]


def frame_times(path):
    """The distinct times of a recording."""
    return np.unique(pq.read_table(path)["time"].to_numpy())


def convert(path, **options):
    """Convert into the input's folder; return the result, the table and what was said."""
    heard = Listener()
    result = gr.convert(path, path.parent / "out.parquet", reporter=heard, **options)
    return result, pq.read_table(result.outputs[0]).to_pandas(), heard.text

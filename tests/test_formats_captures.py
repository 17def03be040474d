"""Captures: containers, link layers, VLAN, fragments, and what is not radar in them."""

import gzip
import struct

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import (
    OTHER_SENSOR,
    SENSOR,
    START,
    detection_list,
    ethernet,
    frame_times,
    frames_of,
    ip_packets,
    times,
    write_pcap,
    write_pcapng,
)

import gis_radar as gr
from gis_radar.base import InputError
from gis_radar.recordings import DamagedError
from gis_radar.recordings.readers.pcap import Datagrams, Packet, read_packets


def convert(path, **options):
    return gr.convert(path, path.with_suffix(".parquet"), **options)


def cooked(ip, version):
    if version == 1:
        return struct.pack(">HHH8sH", 4, 1, 6, b"\x02" * 8, 0x0800) + ip
    return struct.pack(">HHIHBB8s", 0x0800, 0, 3, 1, 4, 6, b"\x02" * 8) + ip


LINKS = {
    "Ethernet": (1, ethernet),
    "VLAN": (1, lambda ip: ethernet(ip, 0x8100)),
    "stacked VLAN": (1, lambda ip: ethernet(ip, 0x88A8, 0x8100)),
    "Linux cooked": (113, lambda ip: cooked(ip, 1)),
    "Linux cooked 2": (276, lambda ip: cooked(ip, 2)),
    "raw IP": (101, lambda ip: ip),
    "loopback": (0, lambda ip: b"\x02\0\0\0" + ip),
}


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("size", [1480, 70_000])
def test_datagrams_out_of_every_link_layer(tmp_path, name, size):
    link, wrapped = LINKS[name]
    packets = [
        (time, wrapped(ip))
        for number, time in enumerate(times(3))
        for ip in ip_packets(detection_list(time), ident=number, size=min(size, 65_000))
    ]
    result = convert(write_pcap(tmp_path / "r.pcap", packets, link=link))
    assert result.recordings[0].frames == 3
    assert result.recordings[0].sensor == SENSOR
    np.testing.assert_allclose(frame_times(result.outputs[0]), times(3), atol=1e-6)


@settings(max_examples=20)
@given(order=st.permutations(range(5)), again=st.lists(st.integers(0, 4), max_size=4))
def test_fragments_in_any_order_and_doubled_give_the_datagram(order, again):
    payload = detection_list(START)
    pieces = list(ip_packets(payload, size=8000))
    datagrams = Datagrams()
    came = [datagrams.take(Packet(START, 101, pieces[i], whole=True)) for i in [*again, *order]]
    found = [datagram for datagram in came if datagram is not None]
    assert found[0].payload == payload
    assert (found[0].source, found[0].port) == (SENSOR, 42_102)


def test_fragments_of_two_datagrams_and_sensors_do_not_mix():
    one = list(ip_packets(detection_list(START), ident=1, size=8000))
    two = list(ip_packets(detection_list(START + 1), ident=2, size=8000))
    other = list(ip_packets(detection_list(START + 2), ident=1, size=8000, source=OTHER_SENSOR))
    datagrams = Datagrams()
    mixed = [piece for pieces in zip(one, two, other, strict=True) for piece in pieces]
    came = [datagrams.take(Packet(START, 101, piece, whole=True)) for piece in mixed]
    payloads = [datagram.payload for datagram in came if datagram]
    assert payloads == [detection_list(START + i) for i in range(3)]
    assert datagrams.incomplete == 0


def test_an_old_fragment_does_not_mend_a_new_datagram():
    old = list(ip_packets(detection_list(START), ident=1, size=8000))
    new = list(ip_packets(detection_list(START + 60), ident=1, size=8000))
    datagrams = Datagrams()
    assert datagrams.take(Packet(START, 101, old[0], whole=True)) is None
    later = [Packet(START + 60, 101, piece, whole=True) for piece in new]
    assert [datagrams.take(packet) for packet in later[1:]] == [None] * 4
    assert datagrams.take(later[0]).payload == detection_list(START + 60)
    assert datagrams.incomplete == 1


def test_a_lost_fragment_costs_its_frame_and_is_said(tmp_path):
    packets = list(frames_of(times(4)))
    del packets[30]  # of the second datagram
    notes = Listener()
    result = convert(write_pcap(tmp_path / "r.pcap", packets), reporter=notes)
    np.testing.assert_allclose(frame_times(result.outputs[0]), np.delete(times(4), 1), atol=1e-6)
    assert result.left_out == {"incomplete_datagrams": 1}
    assert "1 fragmented datagrams are not complete" in notes.text


@settings(max_examples=25)
@given(
    stamps=st.lists(st.integers(0, 4_000_000_000 * 10**6), min_size=1, max_size=8),
    data=st.data(),
)
def test_pcapng_of_any_interfaces_reads_back(tmp_path_factory, stamps, data):
    interfaces = [(1, 6), (113, 9), (101, 0x80 | 20)]
    ticks_a_second = [10**6, 10**9, 2**20]
    packets = []
    for stamp in stamps:
        number = data.draw(st.integers(0, 2))
        packets.append((number, stamp, data.draw(st.binary(min_size=1, max_size=60))))
    path = write_pcapng(tmp_path_factory.mktemp("ng") / "r.pcapng", packets, interfaces)
    for (number, stamp, content), (packet, _) in zip(packets, read_packets(path), strict=True):
        assert packet.data == content
        assert packet.link == interfaces[number][0]
        assert packet.time == pytest.approx(stamp / ticks_a_second[number], rel=1e-15)


@pytest.mark.parametrize("nano", [False, True])
def test_pcap_reads_back(tmp_path, nano):
    packets = [(START + i * 0.125, bytes([i]) * i) for i in range(20)]
    path = write_pcap(tmp_path / "r.pcap", packets, nano=nano)
    read = [(packet.time, packet.data) for packet, _ in read_packets(path)]
    assert read == packets


def test_pcap_of_the_other_byte_order(tmp_path):
    head = struct.pack(">IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, 1)
    record = struct.pack(">IIII", int(START), 500_000, 3, 5) + b"abc"
    (tmp_path / "r.pcap").write_bytes(head + record)
    ((packet, position),) = read_packets(tmp_path / "r.pcap")
    assert packet == Packet(START + 0.5, 1, b"abc", whole=False)
    assert position == 24 + 19


def test_pcapng_and_gzip_give_what_pcap_gives(tmp_path):
    packets = list(frames_of(times(3)))
    plain = write_pcap(tmp_path / "r.pcap", packets)
    (tmp_path / "packed.pcap.gz").write_bytes(gzip.compress(plain.read_bytes()))
    ticks = [(1, round(time * 1e9), packet) for time, packet in packets]
    write_pcapng(tmp_path / "ng.pcapng", ticks, [(113, 6), (1, 9)])
    gr.convert(plain, tmp_path / "plain.parquet")
    expected = pq.read_table(tmp_path / "plain.parquet")
    for name in ("packed.pcap.gz", "ng.pcapng"):
        gr.convert(tmp_path / name, tmp_path / "other.parquet")
        assert pq.read_table(tmp_path / "other.parquet") == expected


@pytest.mark.parametrize("kind", ["pcap", "pcapng", "pcap.gz"])
def test_a_file_cut_off_keeps_what_is_whole(tmp_path, kind):
    packets = list(frames_of(times(10)))
    path = tmp_path / f"r.{kind}"
    if kind == "pcapng":
        write_pcapng(path, [(0, round(t * 1e6), p) for t, p in packets], [(1, 6)])
    else:
        write_pcap(path, packets)
    content = path.read_bytes()
    content = content[: int(len(content) * 0.55)]
    path.write_bytes(gzip.compress(content) if kind.endswith("gz") else content)
    notes = Listener()
    result = gr.convert(path, tmp_path / "out.parquet", reporter=notes)
    assert result.recordings[0].frames == 5
    assert result.left_out["damaged_files"] == 1
    assert "whole packets: cut off in the middle of a packet" in notes.text
    with pytest.raises(DamagedError):
        list(read_packets(path))


def test_gzip_that_is_cut_itself(tmp_path):
    path = write_pcap(tmp_path / "r.pcap", frames_of(times(10)))
    packed = gzip.compress(path.read_bytes())
    path.write_bytes(packed[: len(packed) // 2])
    result = convert(path)
    assert 0 < result.recordings[0].frames < 10
    assert result.left_out["damaged_files"] == 1


def test_other_traffic_is_named(tmp_path):
    packets = [
        (START, ethernet(ip))
        for port, count in ((5353, 3), (53, 1))
        for _ in range(count)
        for ip in ip_packets(b"something else", port=port)
    ]
    packets.append((START, b"\xff" * 12 + b"\x08\x06" + b"\0" * 28))
    with pytest.raises(InputError) as caught:
        convert(write_pcap(tmp_path / "r.pcap", packets))
    assert "no ARS548 detection list" in caught.value.message
    assert "UDP port 5353 (3), UDP port 53 (1), no IPv4 (1)" in caught.value.hint


def test_object_lists_are_called_what_they_are(tmp_path):
    objects = struct.pack(">HHI", 0, 329, 9393).ljust(9401, b"\0")
    packets = [(START, ethernet(ip)) for ip in ip_packets(objects)]
    with pytest.raises(InputError) as caught:
        convert(write_pcap(tmp_path / "r.pcap", packets))
    assert "object list (1)" in caught.value.hint


def test_a_short_snap_length_is_named(tmp_path):
    notes = Listener()
    path = write_pcap(tmp_path / "r.pcap", [])
    with path.open("ab") as file:
        for _, packet in frames_of(times(2)):
            file.write(struct.pack("<IIII", int(START), 0, 96, len(packet)) + packet[:96])
    with pytest.raises(InputError, match="no ARS548"):
        convert(path, reporter=notes)
    assert "tcpdump -s 0" in notes.text


@pytest.mark.parametrize("whole", [0.5, 0.0])
def test_packets_cut_by_a_program_that_hides_it_are_named(tmp_path, whole):
    """It states what it kept as the length of all."""
    packets, notes = list(frames_of(times(4))), Listener()
    kept = round(whole * len(packets))
    cut = [(time, packet[:128]) for time, packet in packets[kept:]]
    path = write_pcap(tmp_path / "r.pcap", packets[:kept] + cut)
    if whole:
        convert(path, reporter=notes)
        assert len(frame_times(path.with_suffix(".parquet"))) == 2
    else:
        with pytest.raises(InputError, match="no ARS548"):
            convert(path, reporter=notes)
    assert "captured only in part" in notes.text


def test_nanoseconds_that_are_called_microseconds_are_no_times(tmp_path):
    notes, path = Listener(), write_pcap(tmp_path / "r.pcap", frames_of(times(3)), nano=True)
    held = path.read_bytes()
    magic = {b"\x4d\x3c\xb2\xa1": b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d": b"\xa1\xb2\xc3\xd4"}
    path.write_bytes(magic[held[:4]] + held[4:])
    with pytest.raises(InputError, match="no ARS548"):
        convert(path, reporter=notes)
    assert "parts of a second, of which it has 1,000,000 at byte 24" in notes.text


def test_a_time_that_was_rounded_up_to_a_second_is_read(tmp_path):
    """As by programs that round the fraction, which write a million microseconds."""
    path = write_pcap(tmp_path / "r.pcap", [])
    with path.open("ab") as file:
        for _, packet in frames_of(times(1)):
            length = len(packet)
            file.write(struct.pack("<IIII", int(START), 1_000_000, length, length) + packet)
    convert(path)
    assert len(frame_times(path.with_suffix(".parquet"))) == 1


@pytest.mark.parametrize(
    ("content", "message", "said"),
    [
        (b"", "no known radar format", ""),
        (b"\n\r\r\n\x00\x00\x00\x00abcd", "no ARS548", "a section without byte order"),
        (b"\xd4\xc3\xb2\xa1" + b"\0" * 20, "no ARS548", ""),
        (b"\xd4\xc3\xb2\xa1" + b"\0" * 5, "no ARS548", "cut off in the middle"),
        (b"\xd4\xc3\xb2\xa1" + b"\0" * 28 + b"\xff" * 8, "no ARS548", "4,294,967,295 bytes"),
    ],
)
def test_captures_that_are_none(tmp_path, content, message, said):
    (tmp_path / "r.pcap").write_bytes(content)
    notes = Listener()
    with pytest.raises(InputError, match=message):
        convert(tmp_path / "r.pcap", reporter=notes)
    assert said in notes.text


def test_garbage_between_packets_keeps_what_is_before(tmp_path):
    packets = list(frames_of(times(10)))
    path = write_pcap(tmp_path / "r.pcap", packets)
    content = bytearray(path.read_bytes())
    record = 24 + sum(16 + len(packet) for _, packet in packets[:120])
    content[record : record + 16] = b"\xff" * 16
    path.write_bytes(content)
    result = convert(path)
    assert result.recordings[0].frames == 5
    assert result.left_out == {"damaged_files": 1}

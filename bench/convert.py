"""Conversion of a network capture: recorded seconds a CPU second, and memory of a long capture.

The capture is of an ARS548 at 20 Hz with 500 detections a frame, each frame in 24 IP fragments.
Each run is a process of its own, which converts a second of the same first. Exit code 1 where a
target is missed.
"""

from __future__ import annotations

import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import dpkt
import numpy as np
from figures import TARGET, TIME_CHANCE, Figure, report, run_alone

RATE_HZ = 20
DETECTIONS = 500
SECONDS = 60
TIMES_LONGER = 10
FRAGMENT_BYTES = 1480
TARGET_RATIO = 100  # recorded seconds a CPU second, at least
TARGET_GROWTH = 1.10  # memory of the long capture beside the short one, at most
START = 1_700_000_000  # UNIX seconds
CHILD = """
import json, sys, time
import gis_radar as gr
warm, capture, recording = sys.argv[1:]
gr.convert(warm, recording)
begin = time.process_time()
made = gr.convert(capture, recording).recordings[0]
taken_s = time.process_time() - begin
print(json.dumps({"ratio": (made.end - made.begin) / taken_s, "detections": made.detections}))
"""


def main() -> None:
    """Measure both lengths, and judge."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seconds in (1, SECONDS, SECONDS * TIMES_LONGER):
            _write_capture(folder / f"{seconds}.pcap", seconds)
        _, short_mib = _convert(folder, SECONDS)
        ratio, long_mib = _convert(folder, SECONDS * TIMES_LONGER)
    report("convert", _figures(ratio, short_mib, long_mib))
    if long_mib > TARGET_GROWTH * short_mib:
        sys.exit(f"memory grows with the capture: {long_mib / short_mib:.2f} x")


def _figures(ratio: float, short_mib: float, long_mib: float) -> Iterator[Figure]:
    yield Figure(
        what="capture of a 20 Hz radar with 500 detections a frame to a recording", ours=ratio,
        unit="x real time", more_is_better=True, chance=TIME_CHANCE, peer=TARGET_RATIO,
        peer_name=TARGET,
    )  # fmt: skip
    yield Figure(
        what="memory of `convert` of 600 s", ours=long_mib, unit="MiB", peer=short_mib,
        peer_name="that of 60 s", chance=TIME_CHANCE,
    )  # fmt: skip


def _convert(folder: Path, seconds: int) -> tuple[float, float]:
    """Return recorded seconds per CPU second, and the largest memory held (MiB)."""
    captures = [folder / f"{each}.pcap" for each in (1, seconds)]
    ran = run_alone("-c", CHILD, *captures, folder / "out.parquet")
    (found,) = ran.lines
    if found["detections"] != seconds * RATE_HZ * DETECTIONS:
        sys.exit(f"{found['detections']} detections came out of {seconds} s")
    return found["ratio"], ran.peak_mib


def _write_capture(path: Path, seconds: int) -> None:
    """Write a capture (pcap) of so many seconds."""
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65_535, nano=True)
        for number in range(seconds * RATE_HZ):
            time = START + number / RATE_HZ
            for packet in _fragments(_detection_list(time, rng), number):
                writer.writepkt(packet, time + 0.06)


def _detection_list(time: float, rng: np.random.Generator) -> bytes:
    """Return the payload of an ARS548 detection list, 35 336 bytes."""
    rows = np.zeros(DETECTIONS, dtype="V44")
    fields = rows.view(
        np.dtype(
            {
                "names": ["azimuth", "elevation", "range", "range_rate", "rcs", "probability"],
                "formats": [">f4", ">f4", ">f4", ">f4", "i1", "u1"],
                "offsets": [0, 9, 17, 25, 33, 36],
                "itemsize": 44,
            }
        )
    )
    fields["azimuth"] = rng.uniform(-1.0, 1.0, DETECTIONS)
    fields["elevation"] = rng.normal(0.0, 0.05, DETECTIONS)
    fields["range"] = rng.uniform(1.0, 300.0, DETECTIONS)
    fields["range_rate"] = rng.normal(0.0, 10.0, DETECTIONS)
    fields["rcs"] = rng.integers(-20, 30, DETECTIONS)
    fields["probability"] = rng.integers(50, 100, DETECTIONS)
    head = struct.pack(">HHI28xIIB", 0, 336, 35_328, round(time % 1 * 1e9), int(time), 1)
    body = head.ljust(101, b"\0") + rows.tobytes().ljust(800 * 44, b"\0")
    return (body + struct.pack(">ffI", -22.9, 22.9, DETECTIONS)).ljust(35_336, b"\0")


def _fragments(payload: bytes, ident: int) -> Iterator[bytes]:
    """Yield the Ethernet packets of a UDP datagram, fragmented by IP."""
    udp = struct.pack(">HHHH", 42_101, 42_102, 8 + len(payload), 0) + payload
    for at in range(0, len(udp), FRAGMENT_BYTES):
        part = udp[at : at + FRAGMENT_BYTES]
        more = 0x2000 if at + FRAGMENT_BYTES < len(udp) else 0
        ip = struct.pack(
            ">BBHHHBBHII", 0x45, 0, 20 + len(part), ident & 0xFFFF, more | at // 8, 64, 17, 0,
            0x0A0D0171, 0xE0000202,
        )  # fmt: skip
        yield b"\x01\x00\x5e\x00\x02\x02" + b"\x02" * 6 + b"\x08\x00" + ip + part


if __name__ == "__main__":
    main()

"""Conversion of a capture: recorded seconds per CPU second, and memory from a short to a long one.

The capture is that of a 20 Hz ARS548 with 500 detections a frame, each list in the 24 fragments
that an Ethernet makes of it. Each run is a process of its own, warmed up on a second of the same.
Exit code 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import dpkt
import numpy as np

ROOT = Path(__file__).parent.parent
RATE_HZ = 20
DETECTIONS = 500
SECONDS = 60
TIMES = 10
FRAGMENT_BYTES = 1480
TARGET_RATIO = 100
TARGET_GROWTH = 1.10
START = 1_700_000_000
CHILD = """
import re, sys, time
from pathlib import Path
import gis_radar as gr
warm, capture, recording = sys.argv[1:]
gr.convert(warm, recording)
begin = time.process_time()
made = gr.convert(capture, recording).recordings[0]
taken = time.process_time() - begin
peak = re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]
print((made.end - made.begin) / taken, int(peak) / 1024, made.detections)
"""


def main() -> None:
    """Measure both lengths, print and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-convert.json")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seconds in (1, SECONDS, SECONDS * TIMES):
            _write_capture(folder / f"{seconds}.pcap", seconds)
        ratio, short_mib = _convert(folder, SECONDS)
        long_ratio, long_mib = _convert(folder, SECONDS * TIMES)
    growth = long_mib / short_mib
    print(f"{SECONDS} s: {ratio:.0f} x real time, {short_mib:.0f} MiB")
    print(f"{SECONDS * TIMES} s: {long_ratio:.0f} x real time, {long_mib:.0f} MiB")
    print(f"memory grows {growth:.2f} x")
    report = {
        "real_time_ratio": ratio,
        "long_real_time_ratio": long_ratio,
        "short_mib": short_mib,
        "long_mib": long_mib,
        "memory_ratio": growth,
    }
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if min(ratio, long_ratio) < TARGET_RATIO:
        sys.exit(f"slower than {TARGET_RATIO} x real time")
    if growth > TARGET_GROWTH:
        sys.exit(f"memory grows with the capture: {growth:.2f} x")


def _convert(folder: Path, seconds: int) -> tuple[float, float]:
    """Return recorded seconds per CPU second, and the largest memory held (MiB)."""
    answer = subprocess.run(
        [sys.executable, "-c", CHILD, *(folder / f"{s}.pcap" for s in (1, seconds)),
         folder / "out.parquet"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    ratio, peak_mib, detections = map(float, answer.stdout.split())
    if detections != seconds * RATE_HZ * DETECTIONS:
        sys.exit(f"{detections:.0f} detections came out of {seconds} s")
    return ratio, peak_mib


def _write_capture(path: Path, seconds: int) -> None:
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65_535, nano=True)
        for number in range(seconds * RATE_HZ):
            time = START + number / RATE_HZ
            for packet in _fragments(_detection_list(time, rng), number):
                writer.writepkt(packet, time + 0.06)


def _detection_list(time: float, rng: np.random.Generator) -> bytes:
    """Return an ARS548 detection list as it travels, 35 336 bytes."""
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

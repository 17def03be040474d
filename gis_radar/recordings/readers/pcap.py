"""ARS548 detection lists in captures of network traffic (pcap, pcapng)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

from gis_radar.recordings.ars548 import METHOD, OTHER_METHODS, method_of, read_detections
from gis_radar.recordings.captures import Datagram, Datagrams, is_capture, read_packets
from gis_radar.recordings.frames import (
    BYTES_A_REPORT,
    DamagedError,
    Format,
    Frame,
    NothingHereError,
    ReaderContext,
    counted,
)


def _knows(source: str) -> bool:
    return Path(source).is_file() and is_capture(Path(source))


def _frames(source: str, context: ReaderContext) -> Generator[Frame]:
    datagrams, messages, sensors = Datagrams(), Counter[str](), Counter[str]()
    for datagram, time in _datagrams(Path(source), datagrams, context):
        method = method_of(datagram.payload)
        if method != METHOD:
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
        raise _nothing(source, datagrams, messages, sensors)


def _datagrams(
    path: Path, datagrams: Datagrams, context: ReaderContext
) -> Iterator[tuple[Datagram, float | None]]:
    """Yield the datagrams of a capture; where it is cut off or damaged, say so and end."""
    total = None if path.suffix.lower() == ".gz" else path.stat().st_size
    reported = packets = 0
    try:
        for packet, position in read_packets(path):
            packets += 1
            if position - reported > BYTES_A_REPORT:
                reported = position
                context.reporter.progress(f"reading {path.name}", position, total)
            datagram = datagrams.take(packet)
            if datagram is not None:
                yield datagram, packet.time
    except DamagedError as error:
        context.counts["damaged_files"] += 1
        context.reporter.log(f"{path}: after {packets:,} whole packets: {error}", "warning")


def _warn(source: str, datagrams: Datagrams, context: ReaderContext) -> None:
    if datagrams.incomplete:
        context.counts["incomplete_datagrams"] += datagrams.incomplete
        context.reporter.log(
            f"{source}: {datagrams.incomplete:,} fragmented datagrams are not complete", "warning"
        )
    if datagrams.cut:
        context.reporter.log(
            f"{source}: {datagrams.cut:,} packets are captured only in part "
            "(capture with a longer snap length: tcpdump -s 0)",
            "warning",
        )


def _nothing(
    source: str, datagrams: Datagrams, messages: Counter[str], sensors: Counter[str]
) -> NothingHereError:
    if sensors:
        return NothingHereError(
            f"{source}: nothing from that sensor", hint=f"sensors here: {counted(sensors)}"
        )
    del messages[""]
    seen = counted(messages + datagrams.traffic) or "no packet at all"
    return NothingHereError(f"{source}: no ARS548 detection list in it", hint=f"it has {seen}")


FORMAT = Format(
    name="ARS548 in a capture",
    takes=".pcap, .pcapng (also .gz)",
    knows=_knows,
    frames=_frames,
)

"""A sensor on UDP, end to end: what live stores is what a capture of the same packets gives."""

import socket
import time

import numpy as np
import pytest
from live_programs import Lines, recorded, selected
from live_site import SAMPLE, Background, LiveSite, needs_mosquitto, wait_for
from radars import SENSOR, detection, detection_list, ethernet, ip_packets, write_pcap

import gis_radar as gr
from gis_radar.live import Edge, Fusion, Radar, frames_of_recording, read_edge_file, read_live_site
from gis_radar.recordings import Frame

pytestmark = pytest.mark.usefixtures("measured_in_a_thread")
FRAMES = 60
GROUP = "224.0.2.2"


def payload_of(frame, time_s):
    """Return a frame of a recording as the radar sends it: angles and distances."""
    x, y, z = frame.points.T.astype(float)
    distance = np.sqrt(x * x + y * y + z * z)
    rows = [
        detection(d, a, e, rate, round(rcs))
        for d, a, e, rate, rcs in zip(
            distance, np.arctan2(y, x), np.arcsin(z / distance), frame.range_rate, frame.rcs,
            strict=True,
        )
        if np.isfinite(d)
    ]  # fmt: skip
    return detection_list(time_s, rows)


def need_multicast(port):
    """Skip where a datagram to a group does not come back."""
    here = socket.inet_aton("127.0.0.1")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        try:
            heard.bind(("", port))
            heard.setsockopt(
                socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + here
            )
            heard.settimeout(10.0)
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, here)
            out.sendto(b"one", (GROUP, port))
            heard.recv(10)
        except OSError:
            pytest.skip("no multicast on this machine's loopback")


@needs_mosquitto
@pytest.mark.parametrize("group", ["127.0.0.1", GROUP], ids=["unicast", "multicast"])
def test_a_radar_on_udp_is_stored_as_its_capture_is_counted(tmp_path, once, port, group):
    if group == GROUP:
        need_multicast(port)
    site = LiveSite(tmp_path, once, names=("R1",))
    site.broker.start()
    said = Lines()
    source = f'address = "udp://{group}:{port}?interface=127.0.0.1"'
    if group == "127.0.0.1":
        source = f'address = "udp://{group}:{port}"'
    middle = Background(Fusion(read_live_site(site.file)).run)
    edge = Edge(read_edge_file(site.edge("R1", source=source)), reporter=said)
    work = Background(edge.run)
    wait_for(lambda: said.told("listening") or work.error)
    packets = []
    frames = list(frames_of_recording(SAMPLE / "R1.parquet"))[:FRAMES]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for number, frame in enumerate(frames):
            now = time.time()
            payload = payload_of(frame, now)
            out.sendto(payload, (group, port))
            packets += [
                (now, ethernet(ip)) for ip in ip_packets(payload, source=SENSOR, ident=number + 1)
            ]
            # the system drops what an edge that gets no time has not taken
            wait_for(lambda number=number: edge.frames > number - 3 or work.error)
            time.sleep(0.01)
    wait_for(lambda: edge.frames >= FRAMES and edge.outbox.empty)
    work.end()
    middle.end()
    site.broker.kill()
    capture = write_pcap(tmp_path / "r.pcap", packets)
    gr.convert(capture, tmp_path / "R1.parquet")
    mine, theirs = recorded(site.folder, "R1"), selected("R1", path=tmp_path / "R1.parquet")
    assert len(mine) == len(theirs)
    for column in theirs:
        np.testing.assert_array_equal(mine[column], theirs[column], err_msg=column)


def frame_at(sensor_s, arrival_s, *, synchronised=True):
    one = np.ones(1, np.float32)
    return Frame(
        sensor="S", points=np.ones((1, 3), np.float32), range_rate=one, rcs=one,
        sensor_time=sensor_s, recorder_time=arrival_s, synchronised=synchronised,
    )  # fmt: skip


def test_a_clock_that_is_set_back_silences_no_radar():
    """A computer's clock an hour ahead, then right: frames go on, with one line."""
    said = Lines()
    start = 1_750_000_000.0
    arrival = [start + 0.05 * k + (3600.0 if 10 <= k < 20 else 0.0) for k in range(40)]

    def read(*_):
        for k, time_s in enumerate(arrival):
            yield frame_at(start + 0.05 * k, time_s, synchronised=False)
        # out of order, as datagrams may be
        yield frame_at(start, start + 0.05 * 38, synchronised=False)

    radar = Radar(source="udp://x", read=read, reporter=said)
    found = [frame.time[0] for frame in radar.frames() if frame is not None]
    assert found == pytest.approx(arrival)
    assert sum("set back by 35" in line for line in said.lines) == 1
    assert radar.counts["frames_out_of_order"] == 1


class StepClock:
    """The module `time` with a clock that can be stepped."""

    ahead_s = 0.0

    def time(self):
        return time.time() + self.ahead_s

    def __getattr__(self, name):
        return getattr(time, name)


@needs_mosquitto
def test_a_clock_of_fusion_that_is_stepped_ends_nothing(tmp_path, once, monkeypatch):
    """An hour ahead and back: the map goes on at once, all is stored."""
    site = LiveSite(tmp_path, once, names=("R1",))
    site.broker.start()
    clock = StepClock()
    monkeypatch.setattr("gis_radar.live.fusion.time", clock)
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    edge = Edge(read_edge_file(site.edge("R1", source='speed = 1.0\nloop = "20s"')))
    work = Background(edge.run)

    def follows():
        return abs(fusion.state().step - clock.time() * 20.0) < 20.0

    wait_for(lambda: follows() and fusion.state().hit.any())
    for clock.ahead_s in (3600.0, -5.0, 0.0):
        wait_for(follows)
    sensor = fusion.sensors["R1"]
    wait_for(lambda: fusion.state().hit.any() and sensor.health.counts["frames"] > 40)
    work.stop.set()
    work.join()
    wait_for(lambda: sensor.received == sensor.acknowledged)
    middle.end()
    site.broker.kill()
    found = recorded(site.folder, "R1")["time"].nunique()
    assert found == sensor.health.counts["frames"] > 40
    assert sensor.health.counts["late_frames"] > 0

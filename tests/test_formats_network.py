"""Detection lists as they come from the network, the command line, and the disk that fills."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from maps import Listener
from radars import detection, detection_list, frames_of, times, write_pcap

import gis_radar as gr
from gis_radar.base import InputError, UsageError
from gis_radar.cli import group

GISRADAR = [sys.executable, "-m", "gis_radar"]


class Sender(threading.Thread):
    """Sends detection lists, each its own, or the same bytes, until told to stop."""

    def __init__(self, address, port, payload=None):
        super().__init__(daemon=True)
        self.sent, self.stop = 0, threading.Event()
        self._to, self._payload = (address, port), payload

    def run(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            while not self.stop.wait(0.02):
                made = detection_list(time.time(), [detection(rcs=self.sent % 100)])
                out.sendto(self._payload or made, self._to)
                self.sent += 1


@pytest.fixture
def sending():
    senders = []

    def start(address, port, payload=None):
        senders.append(Sender(address, port, payload))
        senders[-1].start()
        return senders[-1]

    yield start
    for sender in senders:
        sender.stop.set()
        sender.join()


def test_listening_for_a_while(tmp_path, port, sending):
    sending("127.0.0.1", port)
    notes = Listener()
    before = time.time()
    result = gr.convert(
        f"udp://127.0.0.1:{port}", tmp_path / "r.parquet", duration_s=0.8, reporter=notes
    )
    table = pq.read_table(tmp_path / "r.parquet").to_pandas()
    assert result.recordings[0].sensor == "127.0.0.1"
    assert 5 < len(table) <= 60
    # Nothing is lost on the way: what was sent while we listened is there, one after the other.
    assert (np.diff(table["rcs"]) % 100 == 1).all()
    assert table["time"].between(before - 1, time.time()).all()
    assert f"listening to 127.0.0.1, port {port}" in notes.text
    assert "heard 127.0.0.1" in notes.text


def test_listening_to_a_group(tmp_path, port, sending):
    source = f"udp://224.0.2.2:{port}?interface=127.0.0.1"
    sending("224.0.2.2", port)
    try:
        gr.convert(source, tmp_path / "r.parquet", duration_s=0.5)
    except InputError as error:
        if "cannot listen" in error.message or "nothing came in" in error.message:
            pytest.skip("no multicast on this machine's loopback")
        raise
    assert pq.read_metadata(tmp_path / "r.parquet").num_rows > 3


def test_silence_is_said(tmp_path, port):
    with pytest.raises(InputError, match="nothing came in"):
        gr.convert(f"udp://127.0.0.1:{port}", tmp_path / "r.parquet", duration_s=0.1)
    assert list(tmp_path.iterdir()) == []


def test_other_datagrams_are_no_frames(tmp_path, port, sending):
    sending("127.0.0.1", port, b"hello")
    with pytest.raises(InputError, match="no usable frame"):
        gr.convert(f"udp://127.0.0.1:{port}", tmp_path / "r.parquet", duration_s=0.3)


@pytest.mark.parametrize(
    "source",
    ["udp://radar:42102", "udp://1.2.3.4:99999", "udp://224.0.2.2?port=1", "udp://224.0.2.2/x"],
)
def test_addresses_that_are_none(tmp_path, source):
    with pytest.raises(UsageError, match=r"udp://") as caught:
        gr.convert(source, tmp_path / "r.parquet", duration_s=0.1)
    assert "such as udp://224.0.2.2:42102" in caught.value.hint


def test_an_address_of_another_machine(tmp_path):
    with pytest.raises(InputError, match="cannot listen"):
        gr.convert("udp://192.0.2.1:42102", tmp_path / "r.parquet", duration_s=0.1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_it_and_keeps_all(tmp_path, port, sending, number):
    out = tmp_path / "r.parquet"
    words = [*GISRADAR, "convert", f"udp://127.0.0.1:{port}", "-o", str(out), "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert "listening" in process.stdout.readline()
        sender = sending("127.0.0.1", port)
        while sender.sent < 60:  # the system drops some where the command gets no time
            time.sleep(0.02)
        process.send_signal(number)
        said = [json.loads(line) for line in process.stdout]
    assert process.returncode == 0
    assert said[-1]["event"] == "result"
    assert said[-1]["outputs"] == [str(out)]
    assert said[-1]["summary"]["frames"] >= 15
    assert pq.read_metadata(out).num_rows == said[-1]["summary"]["detections"]


@pytest.fixture
def capture(tmp_path):
    return write_pcap(tmp_path / "r.pcap", frames_of(times(10), size=65_000))


def invoke(*words):
    return CliRunner().invoke(group, [str(word) for word in words])


def test_every_flag_reaches_its_argument(monkeypatch, tmp_path, capture):
    called = {}
    result = gr.convert(capture, tmp_path / "r.parquet")

    def convert(inputs, output, **options):
        called.update(inputs=inputs, output=output, **options)
        return result

    monkeypatch.setattr(gr, "convert", convert)
    answer = invoke(
        "convert", "a.pcap", "udp://1.2.3.4", "-o", tmp_path / "r.parquet", "--sensor", "S",
        "--columns", "x=X, y=-Y", "--time-unit", "ms", "--clock", "recorder", "--duration", "2min",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    del called["reporter"]
    assert called == {
        "inputs": ("a.pcap", "udp://1.2.3.4"),
        "output": tmp_path / "r.parquet",
        "sensor": "S",
        "columns": {"x": "X", "y": "-Y"},
        "time_unit": "ms",
        "clock": "recorder",
        "duration_s": 120.0,
    }


@pytest.mark.parametrize(
    "words", [("--columns", "x"), ("--columns", ","), ("--duration", "soon"), ("--clock", "mine")]
)
def test_flags_that_make_no_sense(tmp_path, capture, words):
    assert invoke("convert", capture, "-o", tmp_path / "r.parquet", *words).exit_code == 2


def test_a_disk_that_is_full(tmp_path):
    rows = [detection(distance=1 + i / 7) for i in range(800)]
    packets = frames_of(times(60), size=65_000, detections=rows)
    capture = write_pcap(tmp_path / "r.pcap", packets)
    out = tmp_path / "out"
    out.mkdir()
    done = subprocess.run(
        [*GISRADAR, "convert", str(capture), "-o", str(out / "r.parquet")],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        # a compiled module cut off by the limit would stay for all
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == 3
    assert "r.parquet: cannot be written" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(out.iterdir()) == []


STEPS = [  # what is loaded, and what is not there afterwards
    ("import gis_radar.cli", "gis_radar.cli.recordings", {"numpy"}),
    ("import gis_radar as gr; gr.run_site; import gis_radar.site.recipes", "gis_radar.site.run",
     {"scipy.spatial", "geopandas", "matplotlib", "gis_radar.tracking"}),
    ("gr.open_recording(gr.sample_folder() / 'R1.parquet')", "gis_radar.recordings",
     {f"gis_radar.recordings.readers.{each}" for each in ("bags", "pcap", "pcd", "tables")}),
    ("import gis_radar.recordings.formats as f; f.known_formats()",
     "gis_radar.recordings.readers.bags", {"rosbags"}),
    ("gr.open_dataset, gr.read_tiles", "geopandas", {"scipy.spatial", "laspy.lib"}),
    ("gr.measure_quality", "gis_radar.dataset.dataset", {"scipy.ndimage", "matplotlib"}),
    ("p = gr.read_pose(gr.sample_folder() / 'R1.json'); repr(p), p._repr_html_()",
     "gis_radar.poses", {"matplotlib", "folium"}),
]  # fmt: skip


def test_no_command_waits_for_libraries_of_others():
    code = "import sys\n" + "".join(f"{first}\nprint(*sys.modules)\n" for first, *_ in STEPS)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for (first, there, absent), shown in zip(STEPS, done.stdout.splitlines(), strict=True):
        loaded = set(shown.split())
        assert there in loaded, first
        assert not absent & loaded, first

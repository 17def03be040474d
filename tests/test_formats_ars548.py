"""ARS548 detection lists: the real packet, its signs, its invalid flags."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from maps import Listener
from radars import SENSOR, START, detection, detection_list, ethernet, ip_packets, write_pcap

import gis_radar as gr
from gis_radar.recordings.readers.udp import method_of, read_detections

SHARED = Path(__file__).parents[2] / "shared" / "data" / "radar" / "nebula_ars548"
BAG, PUBLISHED = SHARED / "1708578204", SHARED / "1708578204_202447652_detection.yaml"
needs_packet = pytest.mark.skipif(
    not BAG.exists(), reason="no real ARS548 packet at ../shared/data"
)


def decode(payload):
    return read_detections(payload, sensor=SENSOR, recorder_time=START)


@pytest.fixture(scope="module")
def published():
    from ruamel.yaml import YAML

    text = PUBLISHED.read_text(encoding="utf-8").partition("---")[0]
    return YAML(typ="safe").load(text)["detections"]


@needs_packet
def test_the_real_packet_comes_out_as_published(tmp_path, published):
    result = gr.convert(BAG, tmp_path / "r.parquet")
    table = pq.read_table(tmp_path / "r.parquet").to_pandas()
    assert len(table) == len(published) == 308
    known = {name: np.array([row[name] for row in published]) for name in published[0]}
    flat = known["range"] * np.cos(known["elevation_angle"])
    expected = {
        "x": flat * np.cos(known["azimuth_angle"]),
        "y": flat * np.sin(known["azimuth_angle"]),
        "z": known["range"] * np.sin(known["elevation_angle"]),
        "range_rate": known["range_rate"],
        "rcs": known["rcs"],
        "probability": known["raw_positive_predictive_value"],
        "multi_target": known["raw_multi_target_probability"],
        "ambiguity": known["raw_ambiguity_flag"],
        "classification": known["classification"],
        "object_id": known["object_id"],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(table[name], values, rtol=1e-5, atol=1e-3, err_msg=name)
    # The sensor was synchronised; the bag was written 15 days later, from a replay.
    assert table["time"].nunique() == 1
    assert table["time"][0] == pytest.approx(1708578203.955760, abs=1e-6)
    assert result.recordings[0].clock == "sensor"


@needs_packet
def test_the_real_packet_out_of_a_capture(tmp_path):
    from rosbags.rosbag2 import Reader

    with Reader(BAG) as reader:
        (raw,) = [raw for _, _, raw in reader.messages() if len(raw) > 35_336]
    payload = bytes(raw[-35_336:])
    packets = [(1708578204.2, ethernet(ip)) for ip in ip_packets(payload)]
    gr.convert(write_pcap(tmp_path / "r.pcap", packets), tmp_path / "pcap.parquet")
    gr.convert(BAG, tmp_path / "bag.parquet")
    assert pq.read_table(tmp_path / "pcap.parquet") == pq.read_table(tmp_path / "bag.parquet")


def test_left_is_positive_y_and_up_is_positive_z():
    ahead, left, up = detection(10, 0, 0), detection(10, np.pi / 2, 0), detection(10, 0, np.pi / 2)
    frame = decode(detection_list(START, [ahead, left, up]))
    np.testing.assert_allclose(frame.points, 10 * np.eye(3), atol=1e-5)


def test_every_field_is_read():
    frame = decode(detection_list(START + 0.25, [detection(rate=-104.25, rcs=-128)]))
    assert frame.sensor_time == START + 0.25
    assert frame.synchronised
    assert frame.range_rate.tolist() == [-104.25]
    assert frame.rcs.tolist() == [-128.0]
    assert {name: values.tolist() for name, values in frame.further.items()} == {
        "probability": [95.0],
        "multi_target": [12.0],
        "ambiguity": [88.0],
        "classification": [3.0],
        "object_id": [41.0],
    }


@pytest.mark.parametrize("flag", [0x01, 0x04, 0x10])
def test_a_detection_with_an_invalid_position_is_left_out_and_counted(tmp_path, flag):
    payload = detection_list(START, [detection(rcs=1), detection(invalid=flag, rcs=2)])
    packets = [(START, ethernet(ip)) for ip in ip_packets(payload)]
    result = gr.convert(write_pcap(tmp_path / "r.pcap", packets), tmp_path / "r.parquet")
    assert pq.read_table(tmp_path / "r.parquet")["rcs"].to_pylist() == [1.0]
    assert result.left_out == {"invalid_detections": 1}


def test_an_invalid_speed_is_unknown_and_other_flags_cost_nothing():
    rows = [detection(invalid=0x40), detection(invalid=0x02 | 0x08 | 0x20 | 0x80)]
    frame = decode(detection_list(START, rows))
    assert np.isnan(frame.range_rate[0])
    assert frame.range_rate[1] == -5.0
    assert np.isfinite(frame.points).all()


def test_only_what_says_its_right_length_is_a_message():
    payload = detection_list(START)
    assert method_of(payload) == 336
    assert method_of(payload[:-1]) is None
    assert method_of(payload[:7]) is None
    assert method_of(b"\0" * 35_336) is None
    assert decode(detection_list(START, count=801)) is None


def test_nonsense_numbers_are_left_out_and_counted(tmp_path):
    rows = [
        detection(distance=np.nan),
        detection(distance=np.inf),
        detection(distance=3e7),
        detection(rate=np.inf, rcs=1),
        detection(rate=-104.0, rcs=2),
    ]
    packets = [(START, ethernet(ip)) for ip in ip_packets(detection_list(START, rows))]
    notes = Listener()
    path = write_pcap(tmp_path / "r.pcap", packets)
    result = gr.convert(path, tmp_path / "r.parquet", reporter=notes)
    table = pq.read_table(tmp_path / "r.parquet").to_pandas()
    assert table["rcs"].tolist() == [1.0, 2.0]
    np.testing.assert_array_equal(table["range_rate"], [np.nan, -104.0])
    assert result.left_out == {"invalid_detections": 2, "absurd_detections": 1}
    assert "absurd_detections (1)" in notes.text

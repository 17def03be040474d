"""Bags of ars430_ros_publisher: both makes of its packets, cycles of several packets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radars import START, convert
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_formats_bags import header, write_bag

from gis_radar.base import InputError
from gis_radar.recordings.ars430 import DETECTION, PACKET

# As the package for ROS 1 defines them.
CAMEL = {
    DETECTION: "float32 posX\nfloat32 posY\nfloat32 posZ\nfloat32 VrelRad\nfloat32 AzAng\n"
    "float32 ElAng\nfloat32 RCS\nfloat32 RangeVar\nfloat32 VrelRadVar\nfloat32 AzAngVar\n"
    "float32 ElAngVar\nfloat32 SNR",
    PACKET: "std_msgs/Header header\nuint8 EventID\nuint32 TimeStamp\nuint32 MeasurementCounter\n"
    "float32 Vambig\nfloat32 CenterFrequency\nars430_ros_publisher/RadarDetection[] Detections",
}
AZIMUTH = np.array([0.5, -0.25, 0.0])  # to the left
RANGE_M = np.array([20.0, 35.5, 12.25])
NEAR, FAR = 3, 1


def fields_of(distance, azimuth):
    """One detection with the values that both makes share, by the names of the one for ROS 1."""
    return {
        "posX": distance, "posY": -distance * np.tan(-azimuth), "posZ": 0.0, "VrelRad": -4.5,
        "AzAng": -azimuth, "ElAng": 0.0, "RCS": -7.5, "RangeVar": 0.1, "VrelRadVar": 0.1,
        "AzAngVar": 0.01, "ElAngVar": 0.0, "SNR": 18.0,
    }  # fmt: skip


def camel_packet(store, time, counter, event, targets):
    one = store.types[DETECTION]
    return store.types[PACKET](
        header=header(store, time), EventID=event, TimeStamp=counter, MeasurementCounter=counter,
        Vambig=20.0, CenterFrequency=76.5, Detections=[one(**fields_of(*each)) for each in targets],
    )  # fmt: skip


def snake_packet(store, time, counter, event, targets):
    names = {
        "posX": "pos_x", "posY": "pos_y", "posZ": "pos_z", "VrelRad": "vrel_rad", "AzAng": "az_ang",
        "ElAng": "el_ang", "RCS": "rcs", "RangeVar": "range_var", "AzAngVar": "az_ang_var",
        "ElAngVar": "el_ang_var", "SNR": "snr",
    }  # fmt: skip
    listed = []
    for distance, azimuth in targets:
        given = fields_of(distance, azimuth)
        known = {names[name]: value for name, value in given.items() if name in names}
        known |= {"pos_x": distance * np.cos(azimuth), "pos_y": distance * np.sin(azimuth)}
        listed.append(store.types[DETECTION](**known, range=distance, flags=0))
    return store.types[PACKET](
        header=header(store, time), event_id=event, time_stamp=counter, measurement_counter=counter,
        vambig=20.0, detections=listed,
    )  # fmt: skip


def write_camel(path, packets, *, later=0.01, stamped=True):
    """Write a ROS 1 bag of packets (time, counter, event, targets)."""
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in CAMEL.items():
        store.register(get_types_from_msg(text, name))
    with Writer1(path) as writer:
        topic = writer.add_connection("/unfiltered_radar_packet_1", PACKET, typestore=store)
        for time, *rest in packets:
            message = camel_packet(store, time if stamped else 0.0, *rest)
            content = store.serialize_ros1(message, PACKET)
            writer.write(topic, round((time + later) * 1e9), content)
    return path


TARGETS = list(zip(RANGE_M, AZIMUTH, strict=True))
CYCLES = [
    (START + 0.073 * cycle + 0.002 * part, 1000 + 73 * cycle, FAR if part else NEAR, [target])
    for cycle in range(4)
    for part, target in enumerate(TARGETS)
]


def check(table):
    assert len(table) == 12
    for _, frame in table.groupby("time"):
        np.testing.assert_allclose(np.hypot(frame["x"], frame["y"]), RANGE_M, rtol=1e-6)
        np.testing.assert_allclose(np.arctan2(frame["y"], frame["x"]), AZIMUTH, atol=1e-6)
        assert frame["z"].isna().all()
        assert frame["range_rate"].tolist() == [-4.5] * 3
        assert frame["rcs"].tolist() == [-7.5] * 3
        assert frame["scan"].tolist() == [NEAR, FAR, FAR]
        assert frame["counter"].nunique() == 1


def test_a_ros_1_bag(tmp_path):
    result, table, text = convert(write_camel(tmp_path / "r.bag", CYCLES))
    assert result.recordings[0].clock == "header stamp"
    assert result.recordings[0].sensor == "/unfiltered_radar_packet_1"
    assert result.figures()["elevation"] == [False]
    assert "measures no elevation" in text
    np.testing.assert_allclose(table["time"].unique(), START + 0.073 * np.arange(4), atol=1e-6)
    check(table)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_ros_2_bag_of_the_port(tmp_path, kind):
    messages = [
        ("/radar", PACKET, time, lambda store, t=time, r=rest: snake_packet(store, t, *r))
        for time, *rest in CYCLES
    ]
    result, table, _ = convert(write_bag(tmp_path / "bag", messages, kind))
    assert result.recordings[0].frames == 4
    check(table)


def test_another_make_is_counted_as_damaged(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("std_msgs/Header header\nuint8 other", PACKET))
    with Writer1(tmp_path / "r.bag") as writer:
        topic = writer.add_connection("/radar", PACKET, typestore=store)
        message = store.types[PACKET](header=header(store, START), other=1)
        writer.write(topic, round(START * 1e9), store.serialize_ros1(message, PACKET))
    with pytest.raises(InputError, match="no radar topic"):
        convert(tmp_path / "r.bag")


@settings(max_examples=20)
@given(sizes=st.lists(st.integers(0, 3), min_size=1, max_size=12), group=st.integers(1, 4))
def test_no_detection_is_lost_however_packets_fall(tmp_path_factory, sizes, group):
    packets = [
        (START + 0.02 * i, i // group, NEAR, [(10.0 + i + j / 8, 0.1) for j in range(size)])
        for i, size in enumerate(sizes)
    ]
    path = write_camel(tmp_path_factory.mktemp("bag") / "r.bag", packets)
    result, table, _ = convert(path)
    assert result.recordings[0].detections == sum(sizes)
    assert result.recordings[0].frames == -(-len(sizes) // group)
    expected = [distance for *_, targets in packets for distance, _ in targets]
    found = table.dropna(subset="x")
    np.testing.assert_allclose(np.hypot(found["x"], found["y"]), expected, rtol=1e-6)

"""ROS bags: clouds of any layout, scans, detection lists, packets, and what else is in them."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radars import SENSOR, START, convert, detection, detection_list, times
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gis_radar.base import InputError, UsageError
from gis_radar.recordings.columns import find_layout, message_rows, values_of
from gis_radar.recordings.readers.bags import MESSAGE_DEFINITIONS, typestore

CLOUD = "sensor_msgs/msg/PointCloud2"
KINDS = ("ros1", "sqlite3", "mcap")
# PointField's numbers, written apart from the reader's table.
NUMBER = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# What the public ARS548 driver publishes: packed, so that no float after RCS is aligned.
ARS548_CLOUD = [
    ("x", "f4"), ("y", "f4"), ("z", "f4"), ("v", "f4"), ("r", "f4"), ("RCS", "i1"),
    ("azimuth", "f4"), ("elevation", "f4"),
]  # fmt: skip


@cache
def store_of(kind):
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in MESSAGE_DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def header(store, time):
    stamp = store.types["builtin_interfaces/msg/Time"](sec=int(time), nanosec=round(time % 1 * 1e9))
    head = store.types["std_msgs/msg/Header"]
    return head(
        stamp=stamp, frame_id="radar", **({"seq": 0} if "seq" in head.__dataclass_fields__ else {})
    )


def cloud(store, time, rows, *, height=1, padding=0, fields=None):
    """A PointCloud2 of a structured array, in its byte order."""
    dtype = rows.dtype
    field = store.types["sensor_msgs/msg/PointField"]
    big = any(dtype[name].base.byteorder == ">" for name in dtype.names)
    lines = rows.reshape(height, -1)
    data = b"".join(line.tobytes() + b"\xff" * padding for line in lines)
    return store.types[CLOUD](
        header=header(store, time),
        height=height,
        width=lines.shape[1],
        fields=fields
        or [
            field(
                name=name,
                offset=dtype.fields[name][1],
                datatype=NUMBER[dtype[name].base.str[1:]],
                count=int(np.prod(dtype[name].shape)),
            )
            for name in dtype.names
        ],
        is_bigendian=big,
        point_step=dtype.itemsize,
        row_step=lines.shape[1] * dtype.itemsize + padding,
        data=np.frombuffer(data, dtype=np.uint8),
        is_dense=True,
    )


def write_bag(path, messages, kind="sqlite3", later=0.01):
    """Write messages (topic, type, time, build); `build(store)` makes the message."""
    store = store_of(kind)
    if kind == "ros1":
        path, writer = path.with_suffix(".bag"), Writer1(path.with_suffix(".bag"))
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
    pack = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with writer:
        topics = {}
        for topic, msgtype, time, build in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(topics[topic], round((time + later) * 1e9), pack(build(store), msgtype))
    return path


def clouds(rows_of, count=3, topic="/radar", **options):
    return [
        (topic, CLOUD, time, lambda store, t=time, i=i: cloud(store, t, rows_of(i), **options))
        for i, time in enumerate(times(count))
    ]


def ars548_rows(number=0, count=4):
    rows = np.zeros(count, dtype=ARS548_CLOUD)
    rows["x"], rows["y"], rows["z"] = np.arange(count) + 10 * number, -2.5, 0.5
    rows["v"], rows["RCS"] = -7.25, np.arange(count) - 20
    return rows


@pytest.mark.parametrize("kind", KINDS)
def test_the_drivers_packed_cloud_out_of_every_bag(tmp_path, kind):
    path = write_bag(tmp_path / "bag", clouds(ars548_rows), kind)
    result, table, _ = convert(path)
    assert result.recordings[0].sensor == "/radar"
    assert result.recordings[0].clock == "header stamp"
    np.testing.assert_allclose(table["time"].unique(), times(3), atol=1e-6)
    expected = np.concatenate([ars548_rows(i) for i in range(3)])
    for name, field in {
        **dict(zip("xyz", "xyz", strict=True)),
        "range_rate": "v",
        "rcs": "RCS",
    }.items():
        np.testing.assert_array_equal(table[name], expected[field].astype(np.float32))


@settings(max_examples=40)
@given(data=st.data())
def test_clouds_of_any_layout_read_back(data):
    order = data.draw(st.sampled_from("<>"))
    names = data.draw(st.permutations(["x", "y", "z", "Doppler", "rcs", "snr", "id"]))
    kinds = {name: data.draw(st.sampled_from(["f4", "f8"])) for name in "xyz"}
    kinds |= {name: data.draw(st.sampled_from(["f4", "i1", "i2"])) for name in ("Doppler", "rcs")}
    kinds |= {"snr": data.draw(st.sampled_from(["u1", "f4"])), "id": "u4"}
    offsets, at = [], 0
    for name in names:
        at += data.draw(st.integers(0, 3))
        offsets.append(at)
        at += np.dtype(kinds[name]).itemsize
    dtype = np.dtype(
        {
            "names": names,
            "formats": [order + kinds[name] for name in names],
            "offsets": offsets,
            "itemsize": at + data.draw(st.integers(0, 5)),
        }
    )
    height, width = data.draw(st.sampled_from([(1, 0), (1, 1), (1, 7), (3, 2)]))
    rows = np.zeros(height * width, dtype=dtype)
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    for name in names:
        rows[name] = rng.integers(0, 100, len(rows))
    padding = data.draw(st.integers(0, 9)) if height > 1 else 0
    made = cloud(store_of("ros2"), START, rows, height=height, padding=padding)
    frame = find_layout(names, {}).frame(values_of(message_rows(made)), sensor="")
    for number, axis in enumerate("xyz"):
        np.testing.assert_array_equal(frame.points[:, number], rows[axis].astype(np.float32))
    np.testing.assert_array_equal(frame.range_rate, rows["Doppler"].astype(np.float32))
    np.testing.assert_array_equal(frame.rcs, rows["rcs"].astype(np.float32))
    assert set(frame.further) == {"snr", "id"}
    for name, values in frame.further.items():
        np.testing.assert_array_equal(values, rows[name])
        assert values.dtype.isnative


def test_clouds_without_a_stamp_are_by_the_recorder_and_not_doubles(tmp_path):
    store_time = [("/radar", CLOUD, t, lambda store: cloud(store, 0.0, ars548_rows(0, 0)))
                  for t in times(3)]  # fmt: skip
    result, table, text = convert(write_bag(tmp_path / "bag", store_time))
    np.testing.assert_allclose(table["time"], np.array(times(3)) + 0.01, atol=1e-6)
    assert result.left_out == {}
    assert "the header stamp stands at 0 s since 1970" in text


@pytest.mark.parametrize(
    "name",
    ["doppler", "Doppler", "range_rate", "rangeRate", "v_r", "vr", "velocity", "radial_speed", "v"],
)
def test_names_of_the_range_rate(tmp_path, name):
    rows = np.ones(2, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), (name, "f4")])
    rows[name] = [3.0, -4.0]
    table = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 1)))[1]
    assert table["range_rate"].tolist() == [3.0, -4.0]
    assert table["rcs"].isna().all()


def test_polar_clouds_become_cartesian(tmp_path):
    rows = np.zeros(2, dtype=[(n, "f4") for n in ("range", "azimuth", "elevation", "doppler")])
    rows["range"], rows["azimuth"], rows["elevation"] = 10, [np.pi / 2, 0], [0, np.pi / 2]
    table = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 1)))[1]
    np.testing.assert_allclose(table[["x", "y", "z"]], [[0, 10, 0], [0, 0, 10]], atol=1e-5)


@pytest.mark.parametrize("kind", ["i1", "i2", "i4"])
def test_a_signed_intensity_beside_a_speed_is_the_cross_section(tmp_path, kind):
    fields = [(n, "f4") for n in ("x", "y", "z", "doppler")]
    rows = np.ones(3, dtype=[*fields, ("intensity", kind)])
    rows["intensity"] = [-20, -7, 14]
    result, table, text = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 2)))
    assert table["rcs"].tolist() == [-20, -7, 14] * 2
    assert "intensity" not in table.columns
    said = "/radar: rcs is the field intensity: whole numbers with a sign, beside the range rate"
    assert text.count(said) == 1
    assert result.figures()["remarks"][0].startswith(said)


@pytest.mark.parametrize(
    ("fields", "options"),
    [
        ([("doppler", "f4"), ("intensity", "f4")], {}),  # an amplitude
        ([("doppler", "f4"), ("intensity", "u1")], {}),  # no cross section is always positive
        ([("doppler", "f4"), ("intensity", "i1"), ("rcs", "f4")], {}),
        ([("intensity", "i1")], {"sensor": "/radar"}),  # a lidar's
    ],
)
def test_other_intensities_are_no_cross_section(tmp_path, fields, options):
    rows = np.ones(3, dtype=[*((axis, "f4") for axis in "xyz"), *fields])
    rows["intensity"] = 7
    path = write_bag(tmp_path / "bag", clouds(lambda _: rows, 1))
    result, table, _ = convert(path, **options)
    assert table["intensity"].tolist() == [7, 7, 7]
    assert not table["rcs"].eq(7).any()
    assert "remarks" not in result.figures()


def test_the_user_names_fields_and_turns_signs(tmp_path):
    rows = np.ones(1, dtype=[("east", "f4"), ("right", "f4"), ("closing", "f4"), ("rcs", "f4")])
    columns = {"x": "east", "y": "-right", "range_rate": "-closing", "rcs": "east"}
    path = write_bag(tmp_path / "bag", clouds(lambda _: rows, 1))
    table = convert(path, columns=columns)[1]
    assert table["z"].isna().all()
    assert table.drop(columns=["time", "z"]).iloc[0].to_dict() == {
        "x": 1.0, "y": -1.0, "range_rate": -1.0, "rcs": 1.0, "rcs_": 1.0,
    }  # fmt: skip
    with pytest.raises(UsageError, match="no field 'up' for z"):
        convert(path, columns={"z": "up"})
    with pytest.raises(UsageError, match="'speed' is no column"):
        convert(path, columns={"speed": "closing"})


@pytest.mark.parametrize("kind", KINDS)
def test_scans(tmp_path, kind):
    def scan(store):
        one = store.types["radar_msgs/msg/RadarReturn"]
        returns = [one(range=10.0, azimuth=a, elevation=0.0, doppler_velocity=-3.0, amplitude=7.0)
                   for a in (0.0, np.pi / 2)]  # fmt: skip
        return store.types["radar_msgs/msg/RadarScan"](header=header(store, START), returns=returns)

    def nothing(store):
        made = scan(store)
        made.header, made.returns = header(store, START + 0.05), []
        return made

    kind_of = "radar_msgs/msg/RadarScan"
    messages = [("/scan", kind_of, START, scan), ("/scan", kind_of, START + 0.05, nothing)]
    result, table, _ = convert(write_bag(tmp_path / "bag", messages, kind))
    assert (result.recordings[0].frames, result.recordings[0].empty_frames) == (2, 1)
    np.testing.assert_allclose(table[["x", "y"]][:2], [[10, 0], [0, 10]], atol=1e-5)
    assert table["range_rate"].tolist()[:2] == [-3.0, -3.0]
    assert table["amplitude"].tolist()[:2] == [7.0, 7.0]


def test_a_detection_list_respects_its_marks(tmp_path):
    def build(store):
        one = store.types["continental_msgs/msg/ContinentalArs548Detection"]
        row = dict.fromkeys(one.__dataclass_fields__, 0) | {"range": 10.0, "range_rate": 2.0}
        del row["__msgtype__"]
        marks = [n for n in row if n.startswith("invalid")]
        row |= dict.fromkeys(marks, False)
        rows = [row, row | {"invalid_azimuth": True}, row | {"invalid_range_rate": True, "rcs": 5}]
        listed = store.types["continental_msgs/msg/ContinentalArs548DetectionList"]
        zero = dict.fromkeys(listed.__dataclass_fields__, 0)
        del zero["__msgtype__"]
        point = store.types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
        known = {"header": header(store, START), "origin_pos": point}
        return listed(**zero | known | {"detections": [one(**r) for r in rows]})

    kind_of = "continental_msgs/msg/ContinentalArs548DetectionList"
    path = write_bag(tmp_path / "bag", [("/list", kind_of, START, build)])
    result, table, _ = convert(path)
    np.testing.assert_array_equal(table["range_rate"], [2.0, np.nan])
    assert result.left_out == {"invalid_detections": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_raw_packets(tmp_path, kind):
    def build(store):
        payload = detection_list(START, [detection(rcs=3)])
        data = np.frombuffer(payload, dtype=np.uint8)
        return store.types["udp_msgs/msg/UdpPacket"](
            header=header(store, START + 0.02), address=SENSOR, src_port=1, data=data
        )

    messages = [("/packets", "udp_msgs/msg/UdpPacket", START, build)]
    result, table, _ = convert(write_bag(tmp_path / "bag", messages, kind))
    assert table["rcs"].tolist() == [3.0]
    assert result.recordings[0].clock == "sensor"


def test_a_bag_without_radar_lists_its_topics(tmp_path):
    def text(store):
        return store.types["std_msgs/msg/String"](data="hello")

    lidar = np.ones(2, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")])
    path = write_bag(
        tmp_path / "bag",
        [("/said", "std_msgs/msg/String", START, text), *clouds(lambda _: lidar, topic="/lidar")],
    )
    with pytest.raises(InputError, match="no radar topic in it") as caught:
        convert(path)
    assert "/said (std_msgs/msg/String), /lidar (sensor_msgs/msg/PointCloud2)" in caught.value.hint
    with pytest.raises(UsageError, match="/lidar: columns: no field 'doppler' for range_rate"):
        convert(path, columns={"range_rate": "doppler"})
    # Asked for by name, a cloud without speeds is taken.
    table = convert(path, sensor="/lidar")[1]
    assert len(table) == 6
    assert table["range_rate"].isna().all()


def test_several_topics(tmp_path):
    messages = clouds(ars548_rows, topic="/radar/front") + clouds(ars548_rows, topic="/radar_front")
    path = write_bag(tmp_path / "bag", messages)
    result, _, _ = convert(path)
    assert sorted(p.name for p in result.outputs) == [
        "out.radar_front_0.parquet",
        "out.radar_front_1.parquet",
    ]
    assert convert(path, sensor="/radar/front")[0].outputs == [tmp_path / "out.parquet"]


def test_clouds_that_cannot_be_are_counted(tmp_path):
    def short(store):
        made = cloud(store, START + 1, ars548_rows())
        made.data = made.data[:-1]
        return made

    def unknown(store):
        made = cloud(store, START + 2, ars548_rows())
        made.fields[0].datatype = 99
        return made

    def outside(store):
        made = cloud(store, START + 3, ars548_rows())
        made.fields[0].offset = 1000
        return made

    bad = [("/radar", CLOUD, START + i + 1, b) for i, b in enumerate((short, unknown, outside))]
    result, table, text = convert(write_bag(tmp_path / "bag", clouds(ars548_rows) + bad))
    assert len(table) == 12
    assert result.left_out == {"damaged_frames": 3}
    assert "/radar: 115 bytes for 1 x 4 points" in text


@pytest.mark.parametrize(
    ("kind", "mended"),
    [("ros1", "rosbag reindex"), ("sqlite3", ".recover"), ("mcap", "mcap recover")],
)
def test_bags_that_are_cut_off(tmp_path, kind, mended):
    path = write_bag(tmp_path / "bag", clouds(ars548_rows, 200), kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:-5000])
    with pytest.raises(InputError, match="cannot be read as a bag") as caught:
        convert(file)
    assert mended in caught.value.hint


IDL = """module m { module msg {
    const string N = "__import__('pathlib').Path('PLACE').touch()";
    struct P { double x[m::msg::N]; };
}; };"""


def test_a_description_of_messages_cannot_bring_code_along(tmp_path):
    """The library makes Python of descriptions: what is no number is no size."""
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.typesys import TypesysError

    data = IDL.replace("PLACE", str(tmp_path / "run"))
    described = MessageDefinition(MessageDefinitionFormat.IDL, data)
    with pytest.raises(TypesysError):
        typestore(SimpleNamespace(msgtype="m/msg/P", msgdef=described))
    assert not (tmp_path / "run").exists()

"""Clocks, order, doubles, several sensors: what becomes of frames between format and recording."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import (
    LOST,
    NEVER,
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
)

import gis_radar as gr
from gis_radar.base import InputError, OutputError, UsageError
from gis_radar.recordings import open_recording

LATER = 0.06


def capture(path, stamped, *, source=SENSOR):
    """Write detection lists of (sensor's time, recorder's time, synchronised or not)."""
    packets = [
        (recorded, ethernet(ip))
        for number, (time, recorded, sync) in enumerate(stamped)
        for ip in ip_packets(
            detection_list(time, sync=sync), source=source, ident=number, size=65_000
        )
    ]
    return write_pcap(path, packets)


def convert(path, **options):
    notes = Listener()
    result = gr.convert(path, path.with_suffix(".parquet"), reporter=notes, **options)
    return result, notes.text


def whole(path, **options):
    return write_pcap(path, frames_of(times(10), size=65_000, **options))


def recorded(count):
    return np.array(times(count)) + LATER


@pytest.mark.parametrize(
    ("offset_s", "sync", "said"),
    [
        (0.0, NEVER, "is not synchronised"),
        (0.0, LOST, "is not synchronised"),
        (3600.0, 1, "is 1.0 h ahead of the recorder's"),
        (-3600.0, 1, "is 1.0 h behind the recorder's"),
        (37.0 + LATER, 1, "is 37 s (TAI instead of UTC?) ahead of the recorder's"),
        (100.0 - START, 1, "stands at 100 s since 1970"),
        (-15 * 86_400.0, 1, "is 15 days behind the recorder's"),
    ],
)
def test_a_sensor_clock_that_is_wrong_is_named_and_not_used(tmp_path, offset_s, sync, said):
    path = capture(tmp_path / "r.pcap", [(t + offset_s, t + LATER, sync) for t in times(10)])
    result, text = convert(path)
    assert result.recordings[0].clock == "recorder"
    assert result.figures()["clock"] == ["recorder"]
    assert said in text
    np.testing.assert_allclose(frame_times(result.outputs[0]), recorded(10), atol=1e-5)


def test_a_sensor_clock_that_is_right_is_used(tmp_path):
    result, text = convert(capture(tmp_path / "r.pcap", [(t, t + 2, 1) for t in times(10)]))
    assert result.recordings[0].clock == "sensor"
    assert "warning" not in text
    np.testing.assert_allclose(frame_times(result.outputs[0]), times(10), atol=1e-6)


@pytest.mark.parametrize("jump_s", [-1.513, 2.0, -7200.0])
def test_a_sensor_clock_that_jumps_is_left_from_there_on(tmp_path, jump_s):
    stamped = [(t + jump_s * (i >= 60), t + LATER, 1) for i, t in enumerate(times(100))]
    result, text = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].clock == "sensor, then recorder"
    assert "from there on" in text
    expected = np.concatenate([times(60), recorded(100)[60:]])
    np.testing.assert_allclose(frame_times(result.outputs[0]), expected, atol=1e-5)


def test_synchronisation_that_is_lost_is_left_from_there_on(tmp_path):
    stamped = [(t, t + LATER, 1 if i < 60 else LOST) for i, t in enumerate(times(100))]
    result, _ = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].clock == "sensor, then recorder"


def test_frames_that_the_network_shuffled_do_not_discredit_the_sensor(tmp_path):
    order = np.argsort(np.arange(200) + np.random.default_rng(3).uniform(0, 15, 200))
    stamped = [(times(200)[i], times(200)[k] + LATER, 1) for k, i in enumerate(order)]
    result, _ = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].clock == "sensor"
    np.testing.assert_allclose(frame_times(result.outputs[0]), times(200), atol=1e-6)


def test_the_user_may_choose_the_clock(tmp_path):
    path = capture(tmp_path / "r.pcap", [(t - 3600, t + LATER, 1) for t in times(10)])
    result, _ = convert(path, clock="sensor")
    expected = np.array(times(10)) - 3600
    np.testing.assert_allclose(frame_times(result.outputs[0]), expected, atol=1e-6)
    path = capture(tmp_path / "s.pcap", [(t, t + LATER, 1) for t in times(10)])
    result, _ = convert(path, clock="recorder")
    np.testing.assert_allclose(frame_times(result.outputs[0]), recorded(10), atol=1e-5)


def test_no_clock_at_all_is_refused(tmp_path):
    path = capture(tmp_path / "r.pcap", [(12.0 + i, 7.0 + i, 1) for i in range(3)])
    with pytest.raises(InputError, match=r"no usable time: the sensor says 12\.000 s since 1970"):
        convert(path)


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), reach=st.integers(1, 200))
def test_frames_out_of_order_are_put_in_order(tmp_path_factory, seed, reach):
    path = tmp_path_factory.mktemp("order") / "r.pcap"
    order = np.argsort(np.arange(300) + np.random.default_rng(seed).uniform(0, reach, 300))
    stamped = [(times(300)[i], times(300)[i] + LATER, 1) for i in order]
    result, _ = convert(capture(path, stamped))
    time = pq.read_table(result.outputs[0])["time"].to_numpy()
    np.testing.assert_allclose(time, times(300), atol=1e-6)
    assert result.left_out.get("reordered_frames", 0) == int(
        (order != np.maximum.accumulate(order)).sum()
    )


def test_time_that_goes_back_too_far_is_refused(tmp_path):
    stamped = [(t, t + LATER, 1) for t in [*times(400, start=START + 100), START]]
    with pytest.raises(InputError, match=r"10\.13\.1\.113: time goes back by 119\.950 s"):
        convert(capture(tmp_path / "r.pcap", stamped))
    assert not (tmp_path / "r.parquet").exists()


def test_doubled_frames_are_left_out_and_counted(tmp_path):
    stamped = [(t, t + LATER + again, 1) for t in times(20) for again in (0.0, 0.001)]
    result, _ = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].frames == 20
    assert result.left_out == {"duplicates": 20}


def test_doubles_that_come_late_do_not_discredit_the_sensor(tmp_path):
    once = [(t, t + LATER, 1) for t in times(100)]
    again = [(t, r + 1.0, 1) for t, r, _ in once]
    stamped = sorted([*once, *again], key=lambda stamps: stamps[1])
    result, _ = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].clock == "sensor"
    assert result.left_out == {"duplicates": 100}


def test_doubled_frames_are_known_by_the_recorder_clock_too(tmp_path):
    stamped = [(t, t + LATER + again, NEVER) for t in times(20) for again in (0.0, 0.001)]
    result, _ = convert(capture(tmp_path / "r.pcap", stamped))
    assert result.recordings[0].frames == 20


def test_files_are_merged_whatever_their_order_and_overlap(tmp_path):
    parts = []
    for number, (first, last) in enumerate([(200, 400), (0, 150), (100, 250)]):
        stamped = [(t, t + LATER, 1) for t in times(400)[first:last]]
        parts.append(capture(tmp_path / f"{number}.pcap", stamped))
    result = gr.convert(parts, tmp_path / "r.parquet")
    np.testing.assert_allclose(frame_times(tmp_path / "r.parquet"), times(400), atol=1e-6)
    assert result.left_out == {"duplicates": 100}


def test_one_of_several_files_may_hold_nothing(tmp_path):
    empty = write_pcap(tmp_path / "empty.pcap", [])
    notes = Listener()
    gr.convert([empty, whole(tmp_path / "r.pcap")], tmp_path / "r.parquet", reporter=notes)
    assert "empty.pcap: no ARS548 detection list in it (it has no packet at all)" in notes.text
    with pytest.raises(InputError, match="no ARS548"):
        gr.convert([empty, empty], tmp_path / "r.parquet")


@pytest.fixture
def two_sensors(tmp_path):
    one = frames_of(times(10), size=65_000)
    other = frames_of(times(7, start=START + 0.02), size=65_000, source=OTHER_SENSOR)
    return write_pcap(tmp_path / "two.pcap", sorted([*one, *other]))


def test_each_sensor_has_a_recording_of_its_own(two_sensors):
    result, text = convert(two_sensors)
    assert [path.name for path in result.outputs] == [
        f"two.{SENSOR}.parquet",
        f"two.{OTHER_SENSOR}.parquet",
    ]
    assert not two_sensors.with_suffix(".parquet").exists()
    assert "2 sensors, a recording each (--sensor takes one)" in text
    assert [len(frame_times(path)) for path in result.outputs] == [10, 7]
    assert [gr.open_recording(path).sensor for path in result.outputs] == [SENSOR, OTHER_SENSOR]


def test_one_of_two_sensors(two_sensors):
    result, _ = convert(two_sensors, sensor=OTHER_SENSOR)
    assert [path.name for path in result.outputs] == ["two.parquet"]
    assert len(frame_times(result.outputs[0])) == 7


def test_a_sensor_that_is_not_there(two_sensors):
    with pytest.raises(InputError) as caught:
        convert(two_sensors, sensor="10.0.0.1")
    assert f"{SENSOR} (10), {OTHER_SENSOR} (7)" in caught.value.hint


def test_an_empty_frame_is_one_row_of_nan(tmp_path):
    packets = [
        (time + LATER, ethernet(ip))
        for i, time in enumerate(times(3))
        for ip in ip_packets(detection_list(time, [] if i == 1 else None), ident=i)
    ]
    result, _ = convert(write_pcap(tmp_path / "r.pcap", packets))
    table = pq.read_table(result.outputs[0]).to_pandas()
    assert len(table) == 3
    assert table.iloc[1].drop("time").isna().all()
    assert table.drop(index=1).notna().all(axis=None)
    assert (result.recordings[0].frames, result.recordings[0].empty_frames) == (3, 1)
    pieces = list(open_recording(result.outputs[0]).read())
    np.testing.assert_array_equal(pieces[0].present, [True, False, True])


def test_the_recording_has_the_columns_of_the_contract(tmp_path):
    result, _ = convert(whole(tmp_path / "r.pcap"))
    schema = pq.read_schema(result.outputs[0])
    assert schema.names[:6] == ["time", "x", "y", "z", "range_rate", "rcs"]
    assert [str(kind) for kind in schema.types[:6]] == ["double"] + ["float"] * 5


def test_options_that_make_no_sense(tmp_path):
    path = whole(tmp_path / "r.pcap")
    with pytest.raises(UsageError, match="files end by themselves"):
        convert(path, duration_s=3.0)
    with pytest.raises(UsageError, match="clock is 'mine'"):
        convert(path, clock="mine")
    with pytest.raises(OutputError, match=r"written as \.parquet"):
        gr.convert(path, tmp_path / "r.csv")
    with pytest.raises(UsageError, match="cannot be merged"):
        gr.convert([path, "udp://127.0.0.1:1"], tmp_path / "r.parquet")
    with pytest.raises(UsageError, match="no input"):
        gr.convert([], tmp_path / "r.parquet")


def test_inputs_that_are_none(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        gr.convert(tmp_path / "none.pcap", tmp_path / "r.parquet")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match="of no known radar format") as caught:
        gr.convert(tmp_path / "notes.txt", tmp_path / "r.parquet")
    assert ".pcapng" in caught.value.hint


def test_no_input_is_replaced(tmp_path, two_sensors):
    table = tmp_path / "t.parquet"
    gr.convert(whole(tmp_path / "r.pcap"), table)
    before = table.read_bytes()
    with pytest.raises(OutputError, match="would replace the input"):
        gr.convert(table, table)
    # Nor by a name that is made up of the output's and a sensor's.
    second = two_sensors.rename(tmp_path / f"out.{SENSOR}.parquet")
    with pytest.raises(OutputError, match="would replace the input"):
        gr.convert(second, tmp_path / "out.parquet")
    assert table.read_bytes() == before
    assert not list(tmp_path.glob(".*part"))

"""Tables with columns of any name, CSV and Parquet."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from maps import Listener
from radars import START, convert, frame_times
from sites import recording

import gis_radar as gr
from gis_radar.base import InputError, UsageError


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_columns_by_the_users_names(tmp_path):
    path = write(
        tmp_path / "r.csv",
        f"stamp_ms,East,Right,Up,closing,sigma,label\n"
        f"{START * 1000:.0f},1,2,3,-4,5,car\n{START * 1000:.0f},6,7,8,9,10,bus\n"
        f"{START * 1000 + 50:.0f},1,1,1,1,1,\n",
    )
    columns = {"time": "stamp_ms", "x": "East", "y": "-Right", "z": "Up",
               "range_rate": "-closing", "rcs": "sigma"}  # fmt: skip
    result, table, _ = convert(path, columns=columns, time_unit="ms")
    assert result.recordings[0].frames == 2
    np.testing.assert_allclose(table["time"], [START, START, START + 0.05])
    np.testing.assert_array_equal(table[["x", "y", "z"]][:2], [[1, -2, 3], [6, -7, 8]])
    assert table["range_rate"].tolist() == [4.0, -9.0, -1.0]
    assert table["label"].tolist() == ["car", "bus", ""]


def test_iso_times_and_degrees(tmp_path):
    path = write(
        tmp_path / "r.csv",
        "Time,Range,azimuth_deg,elevation_deg,Doppler,RCS,SNR\n"
        "2023-11-14T22:13:20Z,10,90,0,1,2,3\n2023-11-14T22:13:20.050Z,10,0,90,1,2,3\n",
    )
    table = convert(path)[1]
    np.testing.assert_allclose(table["time"], [START, START + 0.05])
    np.testing.assert_allclose(table[["x", "y", "z"]], [[0, 10, 0], [0, 0, 10]], atol=1e-5)
    assert table["SNR"].tolist() == [3, 3]


def test_times_of_pandas_are_finer_than_ours(tmp_path):
    """It writes nanoseconds, of which float64 resolves none."""
    time = pa.array(
        [1_700_000_000_005_890_608, 1_700_000_000_055_890_608], pa.timestamp("ns", "UTC")
    )
    numbers = {name: [1.0, 2.0] for name in ("x", "y", "z", "range_rate", "rcs")}
    pq.write_table(pa.table({"time": time, **numbers}), tmp_path / "r.parquet")
    for path in (tmp_path / "r.parquet", tmp_path / "r.csv"):
        if path.suffix == ".csv":
            pq.read_table(tmp_path / "r.parquet").to_pandas().to_csv(path, index=False)
        table = convert(path)[1]
        np.testing.assert_allclose(table["time"], [START + 0.00589, START + 0.05589], atol=1e-6)


@pytest.mark.parametrize(("mark", "told"), [("", True), ("Z", False), ("+01:00", False)])
def test_times_without_a_zone_are_told(tmp_path, mark, told):
    rows = [f"2023-11-14 22:13:20.{k:03d}{mark},1,2,3,4,5" for k in range(0, 200, 50)]
    rows = "\n".join(["time,x,y,z,range_rate,rcs", *rows, ""])
    _, table, heard = convert(write(tmp_path / "r.csv", rows))
    assert ("r.csv: its times name no time zone: they count as UTC" in heard) is told
    assert table["time"].iloc[0] == START - 3600.0 * (mark == "+01:00")


def test_what_the_user_says_wins_over_names(tmp_path):
    path = write(tmp_path / "r.csv", f"time,range,azimuth,az2,v\n{START},10,1.0,90,1\n")
    table = convert(path, columns={"azimuth_deg": "az2"})[1]
    np.testing.assert_allclose(table[["x", "y", "z"]], [[0, 10, np.nan]], atol=1e-5)
    assert table["azimuth"].tolist() == [1.0]


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), frames=st.integers(1, 40), rows=st.sampled_from([3, 50, 5000]))
def test_a_recording_stays_what_it_is(tmp_path_factory, seed, frames, rows):
    folder = tmp_path_factory.mktemp("table")
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(rows, np.ones(frames) / frames)
    time = np.repeat(START + 0.01 + np.arange(frames) * 0.05, np.maximum(counts, 1))
    points = rng.normal(0, 50, (len(time), 3)).astype(np.float32)
    points[np.repeat(counts == 0, np.maximum(counts, 1))] = np.nan
    rate = np.where(np.isnan(points[:, 0]), np.nan, 1.5)
    path = recording(folder / "r.parquet", time, points, range_rate=rate)
    result, table, _ = convert(path)
    pd.testing.assert_frame_equal(table, pq.read_table(path).to_pandas())
    assert result.left_out == {}
    assert result.recordings[0].empty_frames == int((counts == 0).sum())


def test_a_frame_over_the_edge_of_two_batches_is_one(tmp_path, monkeypatch):
    monkeypatch.setattr("gis_radar.recordings.parquet_table.ROWS_AT_ONCE", 7)
    time = START + np.repeat(np.arange(4), 10) * 0.05
    path = recording(tmp_path / "r.parquet", time, np.ones((40, 3)))
    result, table, _ = convert(path)
    assert result.recordings[0].frames == 4
    np.testing.assert_array_equal(table["time"], time)


def test_tables_are_merged_by_time(tmp_path):
    paths = []
    for number in (1, 0):
        time = START + number + np.arange(10) * 0.05
        paths.append(recording(tmp_path / f"{number}.parquet", time, np.ones((10, 3))))
    gr.convert(paths, tmp_path / "out.parquet")
    expected = START + np.concatenate([np.arange(10), np.arange(20, 30)]) * 0.05
    np.testing.assert_allclose(frame_times(tmp_path / "out.parquet"), expected, atol=1e-6)


@pytest.mark.parametrize("rows_in_group", [1, 100])
def test_further_columns_that_differ_between_tables(tmp_path, monkeypatch, rows_in_group):
    monkeypatch.setattr("gis_radar.recordings.recording_file.ROWS_IN_GROUP", rows_in_group)
    one = write(tmp_path / "1.csv", f"time,x,y,id\n{START},1,2,7\n")
    two = write(tmp_path / "2.csv", f"time,x,y,name\n{START + 1},1,2,car\n")
    bad = write(tmp_path / "3.csv", f"time,x,y,id\n{START + 2},1,2,seven\n")
    notes = Listener()
    gr.convert([one, two], tmp_path / "out.parquet", reporter=notes)
    table = pq.read_table(tmp_path / "out.parquet")
    assert table["id"].to_pylist() == [7, None]
    if rows_in_group == 1:
        assert "columns that came late are left out: name" in notes.text
    else:
        assert table["name"].to_pylist() == [None, "car"]
    with pytest.raises(InputError, match="changes its type on the way"):
        gr.convert([one, bad], tmp_path / "out.parquet")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("time,x,y\n", "no rows"),
        ("time;x;y\n1;2;3\n", "separated by semicolons"),
        ("a,b\n1,2\n", "not known which columns are time, x, y"),
        (f"time,x,y\n{START},1,oops\n", "damaged"),
        (f"time,x,y\n{START},1\n", "damaged"),
        ("time,x,y\nyesterday,1,2\n", "neither a number nor ISO 8601"),
        (",x,y\n", "not known which columns are time"),
        ("time,x,y\n,1,2\n", "a row has no time"),
        ("time,x,x,y\n1,1,2,3\n", "several columns 'x'"),
        ("time,x,y\n3.5,1,2\n", "no usable time"),
        (f"time,x,y\n{START * 1e3},1,2\n", "no usable time"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        convert(write(tmp_path / "r.csv", text))


def test_text_where_numbers_belong(tmp_path):
    table = pa.table({"time": [START], "x": ["far"], "y": [1.0]})
    pq.write_table(table, tmp_path / "r.parquet")
    with pytest.raises(InputError, match="column x is text, expected numbers for x"):
        convert(tmp_path / "r.parquet")
    (tmp_path / "r.parquet").write_bytes(b"PAR1" + b"x" * 50)
    with pytest.raises(InputError, match="cannot be read"):
        convert(tmp_path / "r.parquet")


def test_a_unit_that_is_none(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], np.ones((1, 3)))
    with pytest.raises(UsageError, match="time unit 'days'"):
        convert(path, time_unit="days")
    assert frame_times(path).tolist() == [START]

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
import pytest
from sites import START, recording, table

from gis_radar.base import InputError
from gis_radar.recordings import open_recording
from gis_radar.recordings.parquet_table import ROWS_AT_ONCE

NAN = np.nan


def simple(rows=6):
    time = START + np.repeat(np.arange(rows // 2), 2) * 0.05
    points = np.arange(rows * 3, dtype=float).reshape(rows, 3) + 1
    return time, points


def read(path):
    return list(open_recording(path).read(further=True))


def test_parquet_and_csv_read_the_same(tmp_path):
    time, points = simple()
    points[3] = NAN
    made = table(time, points, object=pa.array(["a", "b", "c", "d", "e", "f"]))
    pq.write_table(made, tmp_path / "r.parquet")
    pa_csv.write_csv(made, tmp_path / "r.csv")
    one, other = read(tmp_path / "r.parquet")[0], read(tmp_path / "r.csv")[0]
    np.testing.assert_array_equal(one.time, time)
    np.testing.assert_array_equal(one.points, points)
    np.testing.assert_array_equal(one.present, [True, True, True, False, True, True])
    for name in ("time", "points", "range_rate", "rcs"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6)
    assert one.further.to_pydict() == other.further.to_pydict() == {"object": list("abcdef")}


def test_a_long_recording_comes_in_batches(tmp_path):
    rows = ROWS_AT_ONCE * 2 + 10
    time = START + np.arange(rows) // 500 * 0.05
    path = recording(tmp_path / "r.parquet", time, np.ones((rows, 3)))
    batches = read(path)
    assert max(map(len, batches)) <= ROWS_AT_ONCE
    np.testing.assert_array_equal(np.concatenate([batch.time for batch in batches]), time)


def test_times_may_repeat_but_not_go_back(tmp_path):
    time, points = simple()
    time[4] = time[1]
    time[5] = time[0] - 1
    with pytest.raises(InputError, match=r"r\.parquet: time goes back in row 5"):
        read(recording(tmp_path / "r.parquet", time, points))


def test_time_going_back_between_batches_is_seen(tmp_path):
    rows = ROWS_AT_ONCE + 5
    time = np.full(rows, START + 0.5)
    time[ROWS_AT_ONCE:] -= 1.0
    path = recording(tmp_path / "r.parquet", time, np.ones((rows, 3)))
    with pytest.raises(InputError, match=f"time goes back in row {ROWS_AT_ONCE + 1}"):
        read(path)


@pytest.mark.parametrize(
    ("row", "value", "reason"),
    [
        (2, [np.inf, 0, 0], "position is not finite in row 3"),
        (4, [1, NAN, 1], "position is not finite in row 5"),
    ],
)
def test_odd_positions_are_refused(tmp_path, row, value, reason):
    time, points = simple()
    points[row] = value
    with pytest.raises(InputError, match=reason):
        read(recording(tmp_path / "r.parquet", time, points))


@pytest.mark.parametrize("value", [NAN, np.inf])
def test_a_time_must_be_a_number(tmp_path, value):
    time, points = simple()
    time[3] = value
    with pytest.raises(InputError, match="time is not a finite number in row 4"):
        read(recording(tmp_path / "r.parquet", time, points))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_missing_columns_are_named(tmp_path, suffix):
    made = table(*simple()).drop_columns(["range_rate", "z"])
    path = tmp_path / f"r{suffix}"
    (pq.write_table if suffix == ".parquet" else pa_csv.write_csv)(made, path)
    with pytest.raises(InputError, match="lacks the columns z, range_rate"):
        open_recording(path)


def test_a_column_of_text_is_refused(tmp_path):
    made = table(*simple()).set_column(1, "x", pa.array(["left"] * 6))
    pq.write_table(made, tmp_path / "r.parquet")
    with pytest.raises(InputError, match="column x is string"):
        read(tmp_path / "r.parquet")
    pa_csv.write_csv(made, tmp_path / "r.csv")
    with pytest.raises(InputError, match=r"r\.csv"):
        read(tmp_path / "r.csv")


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_recording_without_rows(tmp_path, suffix):
    path = tmp_path / f"r{suffix}"
    made = table(*simple()).slice(0, 0)
    (pq.write_table if suffix == ".parquet" else pa_csv.write_csv)(made, path)
    with pytest.raises(InputError, match="without rows"):
        read(path)


def test_an_empty_file_and_a_missing_one(tmp_path):
    for name in ("r.parquet", "r.csv"):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(InputError, match="cannot be read"):
            open_recording(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        open_recording(tmp_path / "gone.parquet")
    with pytest.raises(InputError, match="not a known recording format"):
        open_recording(tmp_path / "video.mp4")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_recording_is_refused(tmp_path, share):
    time = START + np.arange(5000) * 0.05
    path = recording(tmp_path / "r.parquet", time, np.ones((5000, 3)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(InputError, match=r"r\.parquet"):
        read(path)


def test_a_flipped_bit_is_refused_where_pages_have_checksums(tmp_path):
    rng = np.random.default_rng(1)
    made = table(START + np.arange(5000) * 0.05, rng.normal(50, 9, (5000, 3)))
    pq.write_table(made, tmp_path / "r.parquet", write_page_checksum=True, compression="none")
    data = bytearray((tmp_path / "r.parquet").read_bytes())
    data[len(data) // 2] ^= 4
    (tmp_path / "r.parquet").write_bytes(data)
    with pytest.raises(InputError, match=r"r\.parquet: damaged"):
        read(tmp_path / "r.parquet")


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9, 1e290])
def test_times_in_other_units_are_refused(tmp_path, factor):
    time, points = simple()
    path = recording(tmp_path / "r.parquet", time * factor, points)
    with pytest.raises(InputError, match=r"time is outside the years .* in row 1") as caught:
        read(path)
    assert "UNIX seconds" in caught.value.hint


@pytest.mark.parametrize("value", [1e38, -1.1e6])
def test_absurd_positions_are_refused(tmp_path, value):
    time, points = simple()
    points[3, 1] = value
    with pytest.raises(InputError, match="position is over 1000 km from the sensor in row 4"):
        read(recording(tmp_path / "r.parquet", time, points))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
@pytest.mark.parametrize("name", ["x", "note"])
def test_a_column_twice_is_refused(tmp_path, suffix, name):
    made = table(*simple(), note=pa.array([1] * 6))
    made = made.append_column(name, made[name])
    path = tmp_path / f"r{suffix}"
    (pq.write_table if suffix == ".parquet" else pa_csv.write_csv)(made, path)
    with pytest.raises(InputError, match=f"has 2 columns '{name}'"):
        open_recording(path)


@pytest.mark.parametrize(
    "kind", [pa.int32(), pa.uint64(), pa.float16(), pa.decimal128(10, 3), pa.decimal256(40, 3)]
)
def test_every_kind_of_number_counts(tmp_path, kind):
    time, points = simple()
    made = table(time, points)
    made = made.set_column(1, "x", made["x"].cast(kind))
    pq.write_table(made, tmp_path / "r.parquet")
    np.testing.assert_array_equal(read(tmp_path / "r.parquet")[0].points, points)


@pytest.mark.parametrize("kind", [pa.string(), pa.dictionary(pa.int32(), pa.string()), pa.binary()])
def test_text_of_digits_is_no_number(tmp_path, kind):
    made = table(*simple()).set_column(1, "x", pa.array(list("123456")).cast(kind))
    pq.write_table(made, tmp_path / "r.parquet")
    with pytest.raises(InputError, match=r"column x is .*, expected numbers"):
        read(tmp_path / "r.parquet")

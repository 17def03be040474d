import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio
import pytest
import shapely
from maps import Listener
from sites import EAST, NORTH, START, UTM, pose, recording

import gis_radar as gr
from gis_radar.base import InputError, OutputError, Reporter, UsageError
from gis_radar.poses import PoseTrack
from gis_radar.products import project, write_projection
from gis_radar.recordings.parquet_table import ROWS_AT_ONCE


@pytest.fixture
def made(tmp_path):
    time = START + np.array([0.0, 0.0, 0.05, 0.1])
    points = np.array([[10, 0, -5], [20, 5, -4], [np.nan] * 3, [30, -5, -3]], dtype=float)
    return recording(
        tmp_path / "r.parquet", time, points, range_rate=-3.5, object=pa.array([1, 2, 3, 4])
    )


class Stopping(Reporter):
    """Raises `stop` when work goes on."""

    def __init__(self, stop):
        self.stop = stop

    def progress(self, *_):
        raise self.stop


SUFFIXES = ("gpkg", "laz", "las", "parquet")
EXPECTED = np.array([[10, 0, 370], [20, 5, 371], [30, -5, 372]], dtype=float)
EXPECTED += np.array([EAST, NORTH, 0.0])


def coordinates(points):
    return shapely.get_coordinates(points.geometry.array, include_z=True)


@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_vector_files_hold_the_same(made, tmp_path, suffix):
    path = tmp_path / f"hits.{suffix}"
    assert write_projection(made, pose(), path) == 3
    read = gpd.read_parquet if suffix == "parquet" else gpd.read_file
    again, expected = read(path), project(made, pose())
    assert again.crs.to_epsg() == 25832
    for name in ("time", "x", "range_rate", "rcs", "object"):
        np.testing.assert_array_equal(again[name], expected[name])
    np.testing.assert_allclose(coordinates(again), EXPECTED)
    assert (again["utc"] == expected["utc"]).all()
    if suffix == "gpkg":
        assert pyogrio.list_layers(path).tolist() == [["hits", "Point Z"]]


def rows_of(path):
    if path.suffix in {".laz", ".las"}:
        return len(laspy.read(path))
    return len(gpd.read_parquet(path) if path.suffix == ".parquet" else gpd.read_file(path))


@pytest.mark.parametrize("suffix", ["laz", "las"])
def test_a_scan_file_holds_the_same(made, tmp_path, suffix):
    path = tmp_path / f"hits.{suffix}"
    write_projection(made, pose(), path)
    scan = laspy.read(path)
    np.testing.assert_allclose(scan.xyz, EXPECTED, atol=0.0006)
    np.testing.assert_array_equal(scan["time"], START + np.array([0.0, 0.0, 0.1]))
    np.testing.assert_array_equal(scan["range_rate"], -3.5)
    assert scan.header.parse_crs().to_epsg() == 25832
    # 2023-11-14T22:13:20Z is GPS week 2288, second 252_818.
    assert scan.gps_time[0] == 2288 * 604_800 + 252_818 - 1_000_000_000


def test_a_track_moves_the_points(made):
    track = PoseTrack(poses=(pose(), pose(easting=EAST + 1)), since=np.array([START, START + 0.1]))
    moved = shapely.get_coordinates(project(made, track).geometry.array)[:, 0]
    np.testing.assert_allclose(moved, EXPECTED[:, 0] + np.array([0, 0, 1]))


def test_a_failure_leaves_no_file(made, tmp_path):
    with pytest.raises(UsageError, match="not a known format"):
        write_projection(made, pose(), tmp_path / "hits.shp")
    damaged = tmp_path / "d.parquet"
    damaged.write_bytes(made.read_bytes()[:-600])
    for suffix in ("gpkg", "laz", "parquet"):
        with pytest.raises(InputError):
            write_projection(damaged, pose(), tmp_path / f"hits.{suffix}")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d.parquet", "r.parquet"]


@pytest.fixture
def long(tmp_path):
    """Three batches, the middle one without any detection, with a column that can be null."""
    rows = 3 * ROWS_AT_ONCE
    points = np.full((rows, 3), np.nan, np.float32)
    points[[0, 1, -1]] = [[10, 0, -5], [20, 5, -4], [30, -5, -3]]
    note = pa.array([None if np.isnan(x) else "seen" for x in points[:, 0]])
    return tmp_path / "long.parquet", START + np.arange(rows) * 0.05, points, {"note": note}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_night_without_detections(tmp_path, suffix):
    nothing = {"note": pa.nulls(4), "size": pa.array([None] * 4, pa.float32())}
    night = recording(
        tmp_path / "night.parquet", START + np.arange(4), np.full((4, 3), np.nan), **nothing
    )
    points = project(night, pose())
    assert (len(points), points.crs) == (0, UTM)
    assert write_projection(night, pose(), tmp_path / f"hits.{suffix}") == 0
    assert rows_of(tmp_path / f"hits.{suffix}") == 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_trouble_in_a_late_batch_keeps_its_name(long, tmp_path, suffix):
    path, time, points, further = long
    points[-2, 0] = np.inf
    late = recording(path, time, points, **further)
    with pytest.raises(InputError, match=f"position is not finite in row {len(time) - 1}"):
        write_projection(late, pose(), tmp_path / f"hits.{suffix}")
    assert [p.name for p in tmp_path.iterdir()] == ["long.parquet"]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("stop", [KeyboardInterrupt(), ZeroDivisionError("own")])
def test_what_stops_the_work_is_not_hidden(made, tmp_path, suffix, stop):
    with pytest.raises(type(stop)):
        write_projection(made, pose(), tmp_path / f"hits.{suffix}", reporter=Stopping(stop))
    assert [p.name for p in tmp_path.iterdir()] == ["r.parquet"]


def test_a_recording_is_not_overwritten(made):
    before = made.read_bytes()
    with pytest.raises(OutputError, match="would replace the input"):
        write_projection(made, pose(), made.parent / "." / made.name)
    assert made.read_bytes() == before


CLASHES = ("fid", "Rcs", "Time", "geometry", "geom", "GEOM", "UTC", "sensor", "fid_recorded")


@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_columns_whose_names_are_taken_get_others(tmp_path, suffix):
    time, points = START + np.arange(2) * 0.05, np.ones((2, 3))
    taken = {name: pa.array([i, i + 1]) for i, name in enumerate(CLASHES)}
    path = recording(tmp_path / "r.parquet", time, points, **taken, free=pa.array(["a", "b"]))
    listener = Listener()
    out = tmp_path / f"hits.{suffix}"
    write_projection(path, pose(), out, reporter=listener)
    found = gpd.read_parquet(out) if suffix == "parquet" else gpd.read_file(out)
    names = {
        "fid": "fid_recorded", "Rcs": "Rcs_recorded", "Time": "Time_recorded",
        "geometry": "geometry_recorded", "geom": "geom_recorded", "GEOM": "GEOM_recorded_recorded",
        "UTC": "UTC_recorded", "sensor": "sensor_recorded",
        "fid_recorded": "fid_recorded_recorded",
    }  # fmt: skip
    for i, name in enumerate(CLASHES):
        assert found[names[name]].tolist() == [i, i + 1]
    assert found["free"].tolist() == ["a", "b"]
    np.testing.assert_array_equal(found["time"], time)
    (remark,) = listener.lines
    assert remark.startswith("r.parquet: columns renamed: 'fid' to 'fid_recorded', ")
    assert "free" not in remark


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_columns_of_every_type_pass_or_are_named(tmp_path, suffix):
    kinds = {
        "list": pa.array([[1], [2, 3]]),
        "struct": pa.array([{"a": 1}, {"a": 2}]),
        "words": pa.array(["a", None]).dictionary_encode(),
        "view": pa.array(["a", "b"], pa.string_view()),
        "span": pa.array([1, 2], pa.duration("us")),
        "exact": pa.array([1, None], pa.decimal256(50, 2)),
        "when": pa.array([1, 2], pa.timestamp("ns")),
        "raw": pa.array([b"a", b"b"]),
        "empty": pa.nulls(2),
        "": pa.array([1, 2]),
    }
    path = recording(tmp_path / "r.parquet", START + np.arange(2), np.ones((2, 3)), **kinds)
    listener = Listener()
    assert write_projection(path, pose(), tmp_path / f"h.{suffix}", reporter=listener) == 2
    assert rows_of(tmp_path / f"h.{suffix}") == 2
    if suffix == "gpkg":
        assert listener.lines[1] == "h.gpkg: a GeoPackage cannot hold span, exact: left out"


@pytest.mark.parametrize("suffix", ["laz", "las"])
def test_a_scan_file_holds_every_number(tmp_path, suffix):
    long_name = "ö" * 20
    numbers = {
        "object": pa.array([7, None], pa.int64()),
        "small": pa.array([255, None], pa.uint8()),
        "huge": pa.array([2**63, None], pa.uint64()),
        "snr": pa.array([1.5, None], pa.float64()),
        "half": pa.array([1.5, None], pa.float16()),
        "price": pa.array([2, None], pa.decimal128(9, 2)),
        "valid": pa.array([True, None]),
        "Intensity": pa.array([3, 4], pa.int32()),
        "sensor_x": pa.array([5, 6], pa.int32()),
        long_name: pa.array([1, 2]),
    }
    texts = {"note": pa.array(["a", "b"]), "when": pa.array([1, 2], pa.timestamp("ms"))}
    points = np.array([[10, 0, -5], [20, 5, -4]], np.float32)
    path = recording(tmp_path / "r.parquet", START + np.arange(2), points, **numbers, **texts)
    listener = Listener()
    write_projection(path, pose(), tmp_path / f"hits.{suffix}", reporter=listener)
    scan = laspy.read(tmp_path / f"hits.{suffix}")
    lowest = np.iinfo(np.int64).min
    expected = {
        "object": [7, lowest], "small": [255, lowest], "huge": [2.0**63, np.nan],
        "snr": [1.5, np.nan], "half": [1.5, np.nan], "price": [2, np.nan],
        "valid": [1, lowest], "Intensity_recorded": [3, 4], "sensor_x_recorded": [5, 6],
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_array_equal(scan[name], np.array(values, scan[name].dtype))
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(scan[f"sensor_{axis}"], points[:, i])
    about = {d.name: d.description for d in scan.header.point_format.extra_dimensions}
    assert about["small"] == f"missing: {lowest}"
    (remark,) = listener.lines
    assert remark.startswith(f"hits.{suffix}: columns left out, no numbers or a long name: ")
    for name in ("note", "when", long_name):
        assert name in remark
    for name in ("Intensity", "sensor_x"):
        assert repr(name) in remark


@pytest.mark.parametrize(("date", "ahead"), [("1975-01-01", 0), ("2010-06-01", 15)])
def test_gps_time_knows_the_leap_seconds_of_its_day(tmp_path, date, ahead):
    time = np.datetime64(date, "s").astype(float)
    path = recording(tmp_path / "r.parquet", [time], [[10.0, 0.0, -5.0]])
    write_projection(path, pose(), tmp_path / "hits.las")
    since = time - np.datetime64("1980-01-06", "s").astype(float)
    assert laspy.read(tmp_path / "hits.las").gps_time[0] == since + ahead - 1e9


def test_a_file_is_hardly_larger_than_the_recording(tmp_path):
    """Of a sensor's own floats, no two of which are alike."""
    sample = gr.sample_folder()
    known = gr.read_pose(sample / "R1.json")
    recorded, recording = pd.read_parquet(sample / "R1.parquet"), tmp_path / "R1.parquet"
    names = ["x", "y", "z", "range_rate"]
    noise = np.random.default_rng(4).normal(0.0, 0.01, (len(recorded), len(names)))
    recorded[names] = (recorded[names] + noise).astype(np.float32)
    recorded.to_parquet(recording, compression="zstd")
    write_projection(recording, known, path := tmp_path / "hits.parquet")
    assert path.stat().st_size < 2.0 * recording.stat().st_size
    read = gpd.read_parquet(path)
    exact = gr.project(recording, known)
    assert shapely.distance(read.geometry.array, exact.geometry.array).max() < 0.008
    assert read.crs == exact.crs
    assert read.has_z.all()
    few = gpd.read_parquet(path, bbox=(*known.position[:2], *(known.position[:2] + 30.0)))
    assert 0 < len(few) < len(read)

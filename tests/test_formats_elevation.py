"""Recordings of sensors without elevation: z is NaN, from the reader to every consumer."""

import re

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from datasets import measured
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener
from radars import START, convert, times
from sites import EAST, NORTH, crossing, pose, recording
from streets import Street
from test_formats_bags import clouds, write_bag

import gis_radar as gr
from gis_radar.base import InputError, NoAnswerError
from gis_radar.calibration import lanelets_of
from gis_radar.calibration.scan.surroundings import read_slow
from gis_radar.calibration.timing.lane_detections import read_lane_detections
from gis_radar.measures import Filters
from gis_radar.poses import as_track
from gis_radar.products import project
from gis_radar.recordings import open_recording

ROAD_M = 370.0  # of the crossing; the sensor is 5 m over it


def slant(points):
    """The same detections as a sensor without elevation reports them: slant range, azimuth."""
    range_m = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    nothing = np.full(len(points), np.nan)
    return np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), nothing])


def cloud_of(count, **columns):
    rows = np.ones(count, dtype=[(name, "f4") for name in columns])
    for name, value in columns.items():
        rows[name] = value
    return rows


# --- conversion


def test_a_cloud_without_z(tmp_path):
    rows = cloud_of(3, x=[3.0, 4.0, 5.0], y=1.0, v=-2.0)
    result, table, text = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 2)))
    assert table["z"].isna().all()
    assert table["x"].tolist() == [3.0, 4.0, 5.0] * 2
    assert result.figures()["elevation"] == [False]
    assert result.recordings[0].elevation is False
    assert "/radar: measures no elevation" in text
    assert "clearance cannot be had" in result.figures()["remarks"][0]
    assert not open_recording(result.outputs[0]).measures_elevation()


def test_a_polar_cloud_without_elevation_is_at_the_slant_range(tmp_path):
    rows = cloud_of(2, range=[10.0, 20.0], azimuth=[0.5, -0.25], doppler=1.0)
    _, table, _ = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 1)))
    np.testing.assert_allclose(np.hypot(table["x"], table["y"]), [10.0, 20.0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(table["y"], table["x"]), [0.5, -0.25], rtol=1e-6)
    assert table["z"].isna().all()


@pytest.mark.parametrize(("count", "level"), [(99, False), (100, True)])
def test_heights_of_0_throughout_are_no_elevation(tmp_path, count, level):
    rows = cloud_of(count, x=5.0, y=np.arange(count), z=0.0, v=1.0)
    result, table, _ = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 1)))
    assert table["z"].isna().all() == level
    assert result.recordings[0].elevation is not level


def test_one_height_that_is_not_0_is_an_elevation(tmp_path):
    rows = cloud_of(300, x=5.0, y=np.arange(300), z=0.0, v=1.0)
    rows["z"][299] = 0.25
    result, table, text = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 1)))
    assert table["z"].tolist() == [0.0] * 299 + [0.25]
    assert "elevation" not in result.figures()
    assert "elevation" not in text


def test_a_detection_without_a_height_among_others_is_invalid(tmp_path):
    rows = cloud_of(4, x=5.0, y=1.0, z=[1.0, np.nan, np.inf, -1.0], v=1.0)
    result, table, _ = convert(write_bag(tmp_path / "bag", clouds(lambda _: rows, 2)))
    assert table["z"].tolist() == [1.0, -1.0] * 2
    assert result.figures()["invalid_detections"] == 4
    assert result.recordings[0].detections == 4


def test_all_row_groups_are_alike(tmp_path, monkeypatch):
    monkeypatch.setattr("gis_radar.recordings.recording_file.ROWS_IN_GROUP", 100)

    def rows_of(number):  # a height that appears later is of no use
        return cloud_of(100, x=5.0, y=np.arange(100), z=float(number == 2), v=1.0)

    _, table, _ = convert(write_bag(tmp_path / "bag", clouds(rows_of, 4)))
    assert len(table) == 400
    assert table["z"].isna().all()


def test_a_table_with_an_empty_z_is_converted_and_read(tmp_path):
    lines = ["time,x,y,z,range_rate,rcs"]
    lines += [f"{time:.3f},10,{y},,1.5,3" for time in times(3) for y in (1, 2)]
    (tmp_path / "r.csv").write_text("\n".join(lines))
    recorded = next(open_recording(tmp_path / "r.csv").read())
    assert recorded.present.all()
    np.testing.assert_allclose(recorded.range_m[:2], [np.hypot(10, 1), np.hypot(10, 2)])
    result, table, _ = convert(tmp_path / "r.csv")
    assert result.recordings[0].detections == 6
    assert table["z"].isna().all()


# --- recordings


def level_recording(path, points=((10.0, 2.0), (20.0, -3.0), (300.5, 0.0)), **columns):
    plan = np.asarray(points, float)
    points = np.column_stack([plan, np.full(len(plan), np.nan)])
    return recording(path, START + np.arange(len(plan)) * 0.05, points, **columns)


def test_empty_frames_do_not_tell(tmp_path):
    points = [[np.nan] * 3, [8.0, 1.0, np.nan], [np.nan] * 3]
    path = recording(tmp_path / "r.parquet", START + np.arange(3) * 0.05, points)
    opened = open_recording(path)
    assert not opened.measures_elevation()
    assert next(opened.read()).present.tolist() == [False, True, False]
    nothing = recording(tmp_path / "e.parquet", [START], [[np.nan] * 3])
    assert open_recording(nothing).measures_elevation()


@pytest.mark.parametrize(
    ("heights", "said"),
    [([1.0, np.nan], "z is missing, unlike before, in row 2"),
     ([np.nan, np.nan, 1.0], "z is there, unlike before, in row 3")],
)  # fmt: skip
@pytest.mark.parametrize("apart", [False, True])
def test_recordings_that_have_some_heights_are_refused(tmp_path, heights, said, apart):
    count = len(heights)
    points = np.column_stack([np.ones(count), np.ones(count), heights])
    path = recording(tmp_path / "r.parquet", START + np.arange(count) * 0.05, points)
    opened = open_recording(path)
    if apart:
        whole = pa.Table.from_batches(opened.batches(None))
        opened = type(opened)(
            path=path, rows=count, batches=lambda _: iter(whole.to_batches(max_chunksize=1))
        )
    with pytest.raises(InputError, match=re.escape(said)):
        list(opened.read())


def test_x_alone_is_no_position(tmp_path):
    path = recording(tmp_path / "r.parquet", [START], [[1.0, np.nan, np.nan]])
    with pytest.raises(InputError, match="position is not finite in row 1"):
        list(open_recording(path).read())


# --- poses


ANGLE = st.floats(-180.0, 180.0)


@given(yaw=ANGLE, azimuth=st.floats(-1.5, 1.5), flat_m=st.floats(0.1, 300.0))
def test_a_point_on_a_level_road_comes_back(yaw, azimuth, flat_m):
    looks = pose(yaw=yaw)
    heading = np.radians(yaw) + azimuth
    place = [EAST + flat_m * np.cos(heading), NORTH + flat_m * np.sin(heading), ROAD_M]
    seen = slant(looks.to_sensor(np.array([place])))
    np.testing.assert_allclose(looks.to_map(seen, road_m=ROAD_M), [place], atol=1e-6)


@given(yaw=ANGLE, pitch=st.floats(-30.0, 30.0), roll=ANGLE)
def test_without_a_road_points_are_at_the_height_of_the_sensor(yaw, pitch, roll):
    points = slant(np.array([[20.0, 5.0, 1.0], [3.0, -9.0, -2.0]]))
    looks = pose(yaw=yaw, pitch=pitch, roll=roll)
    place = looks.to_map(points)
    assert np.isfinite(place).all()
    np.testing.assert_array_equal(place[:, 2], 375.0)
    apart = np.hypot(*(place[:, :2] - looks.position[:2]).T)
    np.testing.assert_allclose(apart, np.hypot(points[:, 0], points[:, 1]), rtol=1e-9)


def test_what_is_nearer_than_the_road_and_what_is_nowhere():
    place = pose().to_map([[3.0, 0.0, np.nan], [np.nan, np.nan, np.nan]], road_m=ROAD_M)
    np.testing.assert_array_equal(place[0], [EAST, NORTH, ROAD_M])
    assert np.isnan(place[1]).all()


# --- consumers


def traffic(frames=200):
    rng = np.random.default_rng(3)
    place = np.column_stack(
        [EAST + rng.uniform(8, 32, 4 * frames), NORTH + rng.uniform(-12, 12, 4 * frames)]
    )
    return np.repeat(START + np.arange(frames) * 0.05, 4), np.column_stack(
        [place, np.full(len(place), ROAD_M)]
    )


def pairs(dataset):
    return set(dataset.hits().itertuples(index=False, name=None))


def test_hits_places_them_on_the_road(tmp_path):
    time, place = traffic()
    looks, notes = pose(yaw=7.0), Listener()
    points = looks.to_sensor(place)
    full = recording(tmp_path / "full.parquet", time, points)
    level = recording(tmp_path / "level.parquet", time, slant(points))
    tiles = crossing(ROAD_M)
    expected = measured([full], [looks], tiles, tmp_path / "ds-full")
    found = measured([level], [looks], tiles, tmp_path / "ds-level", reporter=notes)
    assert len(pairs(expected)) > 100
    # float32 moves what is on an edge
    assert len(pairs(expected) ^ pairs(found)) <= 2
    assert "R1 measures no elevation" in notes.text
    assert "370.0 m" in notes.text
    assert found.recordings()["has_elevation"].tolist() == [False]
    assert expected.recordings()["has_elevation"].tolist() == [True]
    assert "measures no elevation" in gr.measure_quality(found).figures()["R1"]
    assert "elevation" not in gr.measure_quality(expected).figures()["R1"]


def test_what_is_nearer_than_the_road_hits_nothing(tmp_path):
    looks = pose(easting=EAST + 15.0)  # over the lane
    path = level_recording(tmp_path / "r.parquet", [[4.9, 0.0], [-3.0, 0.0], [7.0, 0.0]])
    found = measured([path], [looks], crossing(ROAD_M), tmp_path / "occ")
    assert len({time for _, time in pairs(found)}) == 3  # the frame is valid in three steps


def test_tiles_of_unknown_height_take_them_at_the_slant_range(tmp_path):
    path = level_recording(tmp_path / "r.parquet", [[20.0, 0.0]])
    found = measured([path], [pose()], crossing(np.nan), tmp_path / "occ")
    assert pairs(found)


def test_a_clearance_is_refused(tmp_path):
    path = level_recording(tmp_path / "r.parquet")
    with pytest.raises(
        InputError, match=r"r\.parquet: the sensor measures no elevation.*clearance"
    ):
        measured(
            [path], [pose()], crossing(), tmp_path / "o", filters=Filters(clearance=(-0.5, 4.5))
        )
    assert not (tmp_path / "o").exists()


def test_projection_has_no_gaps(tmp_path):
    notes = Listener()
    points = project(level_recording(tmp_path / "r.parquet"), pose(), reporter=notes)
    xyz = np.array([[p.x, p.y, p.z] for p in points.geometry])
    assert np.isfinite(xyz).all()
    np.testing.assert_array_equal(xyz[:, 2], 375.0)
    assert "r.parquet: R1 measures no elevation" in notes.text


def test_clocks_match_them_to_lanes(tmp_path):
    time, place = traffic()
    points = pose().to_sensor(place)
    counts = []
    for name, seen in (("full", points), ("level", slant(points))):
        path = recording(tmp_path / f"{name}.parquet", time, seen, range_rate=8.0)
        lanelets = lanelets_of(crossing(ROAD_M))
        found = read_lane_detections(
            open_recording(path), as_track(pose()), lanelets, time[0], Listener()
        )
        counts.append(len(found))
    assert counts[0] > 50
    assert counts[1] > 0.8 * counts[0]


def test_the_scan_check_has_nothing_to_compare(tmp_path):
    slow = read_slow(level_recording(tmp_path / "r.parquet"))
    assert len(slow.points) == 0


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp("street")
    scene = Street()
    time, points, rate = scene.detections(scene.pose(), vehicles=8, frames=200)
    path = recording(folder / "R1.parquet", time, slant(points), range_rate=rate)
    return scene, path


@pytest.mark.parametrize("z", [np.nan, 0.0])
def test_localize_refuses_them(street, tmp_path, z):
    scene, path = street
    table = pd.read_parquet(path)
    path = tmp_path / "R1.parquet"
    pd.concat([table] * 5).sort_values("time").assign(z=np.float32(z)).to_parquet(path)
    for method in ("lane", "icp"):
        with pytest.raises(NoAnswerError, match=r"R1\.parquet: the sensor measures no elevation"):
            gr.localize(
                path, scene.roads(), scene.road_points(), guess=(EAST, NORTH), method=method
            )


def test_track_refuses_them(street):
    scene, path = street
    with pytest.raises(NoAnswerError, match="its pose cannot be followed"):
        gr.track(path, scene.roads(), scene.road_points(), scene.pose())

"""Scenes in the layout of INFRA-3DRC, as its publication and its reader describe it."""

import numpy as np
import pytest
from radars import convert
from test_formats_pcd import write_pcd

from gis_radar.base import InputError, UsageError

# Eight float32 a point; the names are those of the annotation, without its index.
FIELDS = [
    (name, "f4")
    for name in ("range", "azimuth_angle", "elevation_angle", "range_rate", "rcs", "x", "y", "z")
]
# Times are in the names of the files, the last number in milliseconds.
NAMES = [f"radar_01__2023-06-02-21-23-51-{ms:03}.pcd" for ms in (22, 72, 122)]
FIRST = 1_685_741_031.022  # 2023-06-02 21:23:51.022 UTC


def rows_of(number, count=4):
    rows = np.zeros(count, dtype=FIELDS)
    rows["range"], rows["azimuth_angle"] = 20.0 + number, 0.1 * np.arange(count)
    rows["elevation_angle"], rows["rcs"], rows["range_rate"] = -0.05, -7.0, -3.5
    flat = rows["range"] * np.cos(rows["elevation_angle"])
    rows["x"] = flat * np.cos(rows["azimuth_angle"])
    rows["y"] = flat * np.sin(rows["azimuth_angle"])
    rows["z"] = rows["range"] * np.sin(rows["elevation_angle"])
    return rows


def write_scene(folder):
    clouds = folder / "radar_01" / "radar_01__data"
    lidar = folder / "lidar_01" / "lidar_01__data"
    for each in (clouds, lidar, folder / "radar_01" / "radar_01__annotation"):
        each.mkdir(parents=True)
    for number, name in enumerate(NAMES):
        write_pcd(clouds / name, rows_of(number))
        points = np.ones(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")])
        write_pcd(lidar / name.replace("radar", "lidar"), points)
    return folder


def test_a_scene_converts_without_further_ado(tmp_path):
    result, table, _ = convert(write_scene(tmp_path / "INFRA-3DRC_scene-01"))
    assert [one.sensor for one in result.recordings] == ["radar_01"]
    assert result.recordings[0].clock == "file name"
    assert list(table.columns) == ["time", "x", "y", "z", "range_rate", "rcs"]
    np.testing.assert_allclose(table["time"].unique(), FIRST + np.arange(3) * 0.05, atol=1e-6)
    expected = np.concatenate([rows_of(number) for number in range(3)])
    for column in table.columns[1:]:
        np.testing.assert_array_equal(table[column], expected[column], column)


def test_a_sensor_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="holds the sensors radar_01"):
        convert(write_scene(tmp_path / "scene"), sensor="radar_02")


def test_fields_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(UsageError, match="no field 'doppler'"):
        convert(write_scene(tmp_path / "scene"), columns={"range_rate": "doppler"})

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sites import EAST, NORTH, UTM, pose

from gis_radar.base import CrsError, InputError
from gis_radar.poses import (
    PoseTrack,
    View,
    pose_from_dict,
    read_pose,
    read_track,
)

ANGLE = st.floats(-179.0, 179.0)
RECORD = {
    "sensor": "R1", "crs": "EPSG:25832", "easting": EAST, "northing": NORTH, "height": 375.0,
    "yaw": 12.3, "pitch": 3.1, "roll": -0.4,
}  # fmt: skip


def elementary(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


@given(yaw=ANGLE, pitch=st.floats(-89, 89), roll=ANGLE)
def test_rotation_is_intrinsic_z_y_x(yaw, pitch, roll):
    expected = elementary("z", yaw) @ elementary("y", pitch) @ elementary("x", roll)
    one = pose(yaw=yaw, pitch=pitch, roll=roll)
    np.testing.assert_allclose(one.R_map_sensor, expected, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(one.quaternion).as_matrix(), expected, atol=1e-12)


def test_words_of_the_angles():
    ahead = np.array([[10.0, 0.0, 0.0]])
    np.testing.assert_allclose(pose(yaw=90.0).to_map(ahead)[0], [EAST, NORTH + 10.0, 375.0])
    assert pose(pitch=5.0).to_map(ahead)[0, 2] < 375.0, "pitch > 0 looks down"
    np.testing.assert_allclose(
        pose(roll=180.0).to_map(np.array([[0.0, 1.0, 0.0]]))[0], [EAST, NORTH - 1.0, 375.0]
    )


@given(seed=st.integers(0, 2**32 - 1), yaw=ANGLE, pitch=st.floats(-89, 89), roll=ANGLE)
def test_to_map_and_back(seed, yaw, pitch, roll):
    points = np.random.default_rng(seed).uniform(-300, 300, (20, 3))
    one = pose(yaw=yaw, pitch=pitch, roll=roll)
    np.testing.assert_allclose(one.to_sensor(one.to_map(points)), points, atol=1e-8)


def test_a_pose_survives_its_file(tmp_path):
    record = RECORD | {"sigma": {"easting": 0.1}, "method": "lane", "view": {"azimuth_deg": 100}}
    first = pose_from_dict(record, what="test")
    first.write(tmp_path / "pose.json")
    again = read_pose(tmp_path / "pose.json")
    assert again == first
    assert again.view == View(azimuth_deg=100)
    assert again.evidence["method"] == "lane"
    assert json.loads((tmp_path / "pose.json").read_text())["crs"] == "EPSG:25832"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"yaw": None}, "lacks yaw"),
        ({"easting": "far"}, "easting is 'far'"),
        ({"height": float("nan")}, "height is nan"),
        ({"roll": True}, "roll is True"),
        ({"quaternion": [0, 0, 0, 1]}, "differ by"),
        ({"quaternion": [0, 0, 0, 2]}, "length 2"),
        ({"quaternion": [0, 0, 1]}, "expected \\[x, y, z, w\\]"),
        ({"view": {"azimut": 100}}, "azimut"),
        ({"view": {"min_range_m": 9, "max_range_m": 3}}, "ascending"),
        ({"view": 120}, "view has 120"),
        ({"sensor": ""}, "sensor"),
        ({"sensor": ["a"]}, "sensor is"),
        ({"sensor": "R\n1"}, "sensor is"),
    ],
)
def test_contradictions_are_refused(change, reason):
    with pytest.raises(InputError, match=reason):
        pose_from_dict(RECORD | change, what="pose.json")


def evidence_of(record):
    return replace(pose(), evidence=record).parsed_evidence()


def test_evidence_is_parsed_once_for_all():
    covariance = np.diag([0.04, 0.01, 0.01, 1e-5, 1e-5, 1e-5])
    covariance[0, 1] = covariance[1, 0] = 0.01
    known = evidence_of(
        {"sigma": {"yaw": 1, "roll": None}, "covariance": covariance.tolist(), "method": "lane"}
    )
    assert known.sigma == {"yaw": 1.0}
    assert known.method == "lane"
    np.testing.assert_array_equal(known.plane_covariance(), covariance[:2, :2])
    by_sigma = evidence_of({"sigma": {"easting": 0.5, "northing": 0.1}})
    np.testing.assert_allclose(by_sigma.plane_covariance(), np.diag([0.25, 0.01]))
    assert evidence_of({"sigma": {"easting": 0.5}}).plane_covariance() is None
    assert pose().plane_covariance() is None


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        ({"covariance": [[1.0]]}, "R1: covariance is not 6 x 6 finite numbers"),
        ({"covariance": "none"}, "not 6 x 6"),
        ({"covariance": np.full((6, 6), np.nan).tolist()}, "not 6 x 6"),
        ({"covariance": (-np.eye(6)).tolist()}, "not symmetric and positive"),
        ({"covariance": np.triu(np.ones((6, 6))).tolist()}, "not symmetric and positive"),
        ({"sigma": {"yaw": -1.0}}, "R1: sigma of yaw is -1.0, expected a number from 0"),
        (
            {"range_scale": {"factor": 1.0, "sigma": "small"}},
            "sigma of range_scale is 'small', expected a number from 0",
        ),
        ({"sigma": {"yaw": "small"}}, "sigma of yaw is 'small'"),
        ({"sigma": 0.1}, "sigma is 0.1, expected a number by component"),
    ],
)
def test_malformed_evidence_is_refused(record, reason):
    with pytest.raises(InputError, match=reason):
        evidence_of(record)


@pytest.mark.parametrize("crs", [None, "EPSG:4326"])
def test_a_pose_needs_a_metric_crs(crs):
    with pytest.raises(InputError, match="crs") as caught:
        pose_from_dict(RECORD | {"crs": crs}, what="pose.json")
    assert crs is None or isinstance(caught.value, CrsError)


def test_a_quaternion_that_agrees_passes_in_either_sign():
    quaternion = pose_from_dict(RECORD, what="x").quaternion
    for sign in (1, -1):
        pose_from_dict(RECORD | {"quaternion": (sign * quaternion).tolist()}, what="x")


def test_a_quaternion_may_be_a_hundredth_of_a_degree_off():
    own = Rotation.from_quat(pose_from_dict(RECORD, what="x").quaternion)
    for off_deg, refused in ((0.009, False), (0.011, True), (180.0, True)):
        turned = (own * Rotation.from_euler("z", off_deg, degrees=True)).as_quat().tolist()
        with pytest.raises(InputError, match="differ by") if refused else nullcontext():
            pose_from_dict(RECORD | {"quaternion": turned}, what="x")


@pytest.mark.parametrize(
    ("length", "refused"), [(0.998, True), (0.9995, False), (1.0005, False), (1.002, True)]
)
def test_a_quaternion_has_length_one_to_a_thousandth(length, refused):
    longer = (length * pose_from_dict(RECORD, what="x").quaternion).tolist()
    with pytest.raises(InputError, match="has length") if refused else nullcontext():
        pose_from_dict(RECORD | {"quaternion": longer}, what="x")


@pytest.mark.parametrize("text", ["", "{", "[1]", '"pose"', "{}"])
def test_not_a_pose_file(tmp_path, text):
    path = tmp_path / "pose.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"pose\.json"):
        read_pose(path)


def test_a_key_that_is_there_twice_leaves_open_which_counts(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps(RECORD).replace("{", '{"easting": 1.0, ', 1))
    with pytest.raises(InputError, match="the key 'easting' is there twice"):
        read_pose(path)


def test_missing_pose_file(tmp_path):
    with pytest.raises(InputError, match=r"gone\.json: cannot be read"):
        read_track(tmp_path / "gone.json")


def track_file(path, rows):
    head = "time,sensor,crs,easting,northing,height,yaw,pitch,roll,event"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def test_a_track_holds_each_pose_until_the_next(tmp_path):
    where = f"R1,EPSG:25832,{EAST},{NORTH},375"
    rows = [f"2023-11-14T22:13:20Z,{where},0,0,0,", f"2023-11-14T22:13:25Z,{where},1,0,0,moved"]
    track = read_track(track_file(tmp_path / "track.csv", rows))
    times = 1_700_000_000.0 + np.array([-100.0, 0.0, 4.99, 5.0, 1e6])
    assert track.at(times).tolist() == [0, 0, 0, 1, 1]
    assert track.poses[1].yaw == 1.0
    assert track.poses[1].evidence["event"] == "moved"
    assert track.poses[0].crs == UTM


def test_a_track_survives_its_file_twice(tmp_path):
    evidence = {"sigma": {"yaw": 0.25}, "event": "moved", "vehicles": 12, "fitness": 0.91}
    first, again = tmp_path / "a.csv", tmp_path / "b.csv"
    PoseTrack(poses=(pose(evidence=evidence),), since=np.array([1.7e9])).write(first)
    read = read_track(first)
    assert read.poses[0].evidence == evidence | {"time": "2023-11-14T22:13:20Z"}
    read.write(again)
    assert again.read_text() == first.read_text()


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ([], "without rows"),
        (["2023-11-14T22:13:20Z,R1,EPSG:25832,1,2,3,0,0,x,"], "row 1: roll is 'x'"),
        (["2023-11-14T22:13:20,R1,EPSG:25832,1,2,3,0,0,0,"], "time zone"),
        (["2023-11-14T22:13:20Z,R1,EPSG:25832,1,2,3,0,0,0,"] * 2, "must ascend"),
        (
            [
                "2023-11-14T22:13:20Z,R1,EPSG:25832,1,2,3,0,0,0,",
                "2023-11-14T22:13:21Z,R2,EPSG:25832,1,2,3,0,0,0,",
            ],
            "one sensor",
        ),
    ],
)
def test_odd_tracks_are_refused(tmp_path, rows, reason):
    with pytest.raises(InputError, match=reason):
        read_track(track_file(tmp_path / "track.csv", rows))


def test_a_view_is_about_the_axis_of_the_sensor():
    view = View(azimuth_deg=120, elevation_deg=30, min_range_m=1, max_range_m=100)
    points = np.array(
        [[50, 0, 0], [45, 77, 0], [45, 79, 0], [101, 0, 0], [0.5, 0, 0], [50, 0, -13], [50, 0, -14],
         [-50, 0, 0], [50, 0, np.nan], [99, 0, -24]], dtype=float,
    )  # fmt: skip
    expected = [True, True, False, False, False, True, False, False, True, False]
    assert view.sees(points).tolist() == expected

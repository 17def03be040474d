"""Localization: known truths found again, and every reason to refuse."""

import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from maps import Listener
from sites import EAST, NORTH, recording
from streets import CROSSING, STRAIGHT, Street, errors

from gis_radar.base import InputError, NoAnswerError, UsageError
from gis_radar.calibration import localize
from gis_radar.calibration.registration.certainty import eigenvalues, is_fixed, pose_covariance
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.single import lane_method
from gis_radar.calibration.single.icp import pose_information, voxels
from gis_radar.calibration.single.moving import read_moving
from gis_radar.poses import read_pose

CLOSE = np.array([0.4, 0.4, 0.2, 0.5, 0.5, 0.3])


@pytest.fixture(scope="module")
def scene(once):
    def recorded(folder):
        street = Street()
        pose = street.pose()
        return street, pose, street.record(folder / "R1.parquet", pose)

    return once("scene", recorded)


def find(street, path, guess, **options):
    return localize(path, street.roads(), street.road_points(), guess=guess, **options)


def near(pose, east=5.0, north=-4.0):
    return (pose.easting + east, pose.northing + north)


@pytest.fixture(scope="module")
def answer(scene, once):
    """The answer for the scene from a rough guess."""
    street, pose, path = scene
    return once("answer", lambda _: find(street, path, near(pose)))


def test_a_pose_is_found_from_a_rough_guess(scene, answer):
    _, pose, _ = scene
    found = answer
    assert (np.abs(errors(found.pose, pose)) < CLOSE).all(), errors(found.pose, pose)
    assert found.observable
    assert found.fitness > 0.9
    assert found.vehicles >= 20
    assert found.pose.sensor == "R1"


def test_the_search_covers_all_headings(tmp_path):
    street = Street(turn_deg=38.0 - 175.0)  # the scene has -38, moved 35
    pose = street.pose()
    street.record(tmp_path / "R1.parquet", pose)
    found = find(street, tmp_path / "R1.parquet", near(pose, -6.0, 5.0))
    assert (np.abs(errors(found.pose, pose)) < CLOSE).all(), errors(found.pose, pose)


def test_round_an_even_bend_a_pose_is_open_and_neither_refused_nor_sure(tmp_path):
    """All poses on a circle explain the traffic: they are one answer, near the guess."""
    street = Street(lanes=STRAIGHT, radius_m=80.0, slope=(0.0, 0.0))
    pose = street.pose()
    street.record(tmp_path / "R1.parquet", pose)
    guess = street.placed([(-24.0, 11.0)])[0]
    told = Listener()
    found = find(street, tmp_path / "R1.parquet", guess, reporter=told)
    assert not found.observable
    (line,) = [text for text in told.lines if "leaves open" in text]
    assert " m of its place" in line
    assert "--scan" in line
    assert "record more traffic" in str(found.left_open(scanned=True))
    assert np.hypot(*(found.pose.position[:2] - guess)) < 15.0
    sigma = found.pose.evidence["sigma"]
    across = np.hypot(sigma["easting"], sigma["northing"])
    assert np.hypot(*errors(found.pose, pose)[:2]) < 2.0 * across
    assert abs(errors(found.pose, pose)[5]) < 2.0 * sigma["yaw"]


def test_the_answer_moves_with_the_site(scene, answer):
    street, pose, path = scene
    other = replace(street, turn_deg=73.0, middle=(EAST - 4321.0, NORTH + 987.0))
    moved = other.pose()
    here = answer
    there = find(other, path, near(moved), heading=moved.yaw + 8.0)
    assert np.allclose(
        errors(here.pose, pose)[2:], errors(there.pose, moved)[2:], atol=[0.05, 0.1, 0.1, 0.1]
    )
    flat = np.radians(73.0)
    turn = np.array([[np.cos(flat), -np.sin(flat)], [np.sin(flat), np.cos(flat)]])
    assert np.allclose(turn @ errors(here.pose, pose)[:2], errors(there.pose, moved)[:2], atol=0.1)


def test_a_sensor_upside_down_is_found(tmp_path):
    street = Street()
    pose = street.pose(roll=178.5)
    street.record(tmp_path / "R1.parquet", pose)
    found = find(street, tmp_path / "R1.parquet", near(pose), heading=pose.yaw + 8.0)
    assert (np.abs(errors(found.pose, pose)) < CLOSE).all(), errors(found.pose, pose)


def test_a_heading_may_be_given(scene):
    street, pose, path = scene
    found = find(street, path, near(pose), heading=pose.yaw + 24.0)
    assert abs(errors(found.pose, pose)[5]) < 0.3


def test_sigma_counts_the_place_of_the_map_and_what_drivers_of_a_lane_do_alike(scene, monkeypatch):
    street, pose, path = scene
    scene_of, certainty = lane_method.Scene, lane_method.certainty

    def covariance(*, map_sigma_m=0.15, lane_sigma_m=(0.18, 0.36)):
        monkeypatch.setattr(lane_method, "Scene", partial(scene_of, lane_sigma_m=lane_sigma_m))
        sure = partial(certainty, map_sigma_m=map_sigma_m)
        monkeypatch.setattr(lane_method, "certainty", sure)
        found = find(street, path, near(pose), heading=pose.yaw)
        return np.array(found.pose.evidence["covariance"])

    stated = covariance()
    placed = stated - covariance(map_sigma_m=0.0)
    assert np.allclose(placed, np.diag([0.15**2, 0.15**2, 0.0, 0.0, 0.0, 0.0]), atol=1e-9)
    driven = stated - covariance(lane_sigma_m=(0.0, 0.0))
    assert np.linalg.eigvalsh(driven)[0] > -1e-9
    assert np.trace(driven[:2, :2]) > 0.02**2
    straight = stated - covariance(lane_sigma_m=(0.0, 0.36))  # no lane of the crossing bends
    assert np.allclose(straight, driven, atol=1e-9)


def test_the_evidence_is_written_and_read(answer, tmp_path):
    answer.pose.write(tmp_path / "pose.json")
    evidence = read_pose(tmp_path / "pose.json").evidence
    covariance = np.array(evidence["covariance"])
    assert covariance.shape == (6, 6)
    assert np.allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    sigma = [evidence["sigma"][name] for name in ("easting", "northing", "height")]
    assert np.allclose(np.sqrt(np.diag(covariance))[:3], sigma)
    yaw_sigma = np.degrees(np.sqrt(covariance[5, 5]))
    assert evidence["sigma"]["yaw"] == pytest.approx(yaw_sigma)
    assert evidence["method"] == "lane"
    assert evidence["converged"] is True
    assert evidence["observable"] is True
    assert evidence["frames"] == 600
    assert evidence["time"].endswith("Z")


def test_errors_keep_to_their_sigma(scene, answer, tmp_path):
    street, pose, _ = scene
    ratios = []
    for seed in range(4):  # the scene is that of seed 0
        path = street.record(tmp_path / f"{seed}.parquet", pose, seed=seed)
        found = (find(street, path, near(pose), heading=pose.yaw) if seed else answer).pose
        sigma = found.evidence["sigma"]
        names = ("easting", "northing", "height", "roll", "pitch", "yaw")
        ratios.append(errors(found, pose) / [sigma[name] for name in names])
    assert np.mean(np.abs(ratios) < 2.0) > 0.7  # few and small scenes: a check for sanity
    assert np.abs(ratios).max() < 6.0
    assert np.abs(ratios).max() > 0.05  # a sigma beyond all errors would say nothing


def test_a_straight_road_fixes_no_place_along_it(tmp_path):
    street = Street(lanes=STRAIGHT, turn_deg=30.0)
    pose = street.pose(place=(0.0, 9.0), yaw=-60.0)
    street.record(tmp_path / "R1.parquet", pose)
    found = find(street, tmp_path / "R1.parquet", near(pose, 3.0, 2.0), heading=pose.yaw + 9.0)
    assert not found.observable
    covariance = np.array(found.pose.evidence["covariance"])[:2, :2]
    along = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    across = np.array([-along[1], along[0]])
    assert np.sqrt(along @ covariance @ along) > 2.0
    assert np.sqrt(across @ covariance @ across) < 0.5
    assert abs(errors(found.pose, pose)[:2] @ across) < 0.4
    assert found.eigenvalues[0] < found.eigenvalues[-1] / 100.0


def test_a_mirrored_recording_is_refused(tmp_path):
    street = Street()
    pose = street.pose()
    time, xyz, rate = street.detections(pose)
    recording(tmp_path / "R1.parquet", time, xyz * [1.0, -1.0, 1.0], range_rate=rate)
    with pytest.raises(NoAnswerError, match="mirrored") as refused:
        find(street, tmp_path / "R1.parquet", near(pose))
    assert "y" in refused.value.hint


def test_no_traffic_is_refused(tmp_path):
    street = Street()
    path = street.record(tmp_path / "R1.parquet", street.pose(), vehicles=2)
    with pytest.raises(NoAnswerError, match="moving vehicles"):
        find(street, path, near(street.pose()))


def test_too_few_frames_are_refused(tmp_path):
    street = Street()
    time, xyz, rate = street.detections(street.pose())
    early = time < time[0] + 3.0
    recording(tmp_path / "R1.parquet", time[early], xyz[early], range_rate=rate[early])
    with pytest.raises(NoAnswerError, match="frames"):
        find(street, tmp_path / "R1.parquet", near(street.pose()))


def test_a_guess_far_off_is_refused(scene):
    street, pose, path = scene
    with pytest.raises(NoAnswerError, match="no lane"):
        find(street, path, near(pose, 900.0, 0.0))
    with pytest.raises(NoAnswerError):
        find(street, path, near(pose, 45.0, 40.0), heading=pose.yaw)


def test_a_heading_that_no_pose_confirms_is_named_as_a_cause(scene):
    street, pose, path = scene
    with pytest.raises(NoAnswerError, match=r"puts the traffic|too far off") as caught:
        find(street, path, near(pose), heading=pose.yaw + 75.0)
    assert "check the heading, which counts anticlockwise from grid east" in caught.value.hint


def test_two_poses_that_fit_alike_are_refused(tmp_path):
    street = Street(lanes=CROSSING, slope=(0.0, 0.0))
    pose = street.pose(place=(-8.0, 7.0), yaw=-40.0)
    street.record(tmp_path / "R1.parquet", pose)
    middle = street.middle
    with pytest.raises(NoAnswerError, match="ambiguous"):
        find(street, tmp_path / "R1.parquet", middle)
    found = find(street, tmp_path / "R1.parquet", middle, heading=pose.yaw)
    assert (np.abs(errors(found.pose, pose)) < CLOSE).all()


def test_lanes_without_direction_do_with_a_warning(scene):
    street, pose, path = scene
    heard = Listener()
    both = replace(street, one_way=False)
    found = find(both, path, near(pose), heading=pose.yaw, reporter=heard)
    assert (np.abs(errors(found.pose, pose))[:3] < [0.5, 0.5, 0.3]).all()
    assert [level for level, message in heard.messages if "direction" in message] == ["warning"]


def test_a_scan_of_another_place_is_refused(scene):
    street, pose, path = scene
    elsewhere = street.road_points() + [2000.0, 0.0, 0.0]
    with pytest.raises(InputError, match="of the lanes around"):
        localize(path, street.roads(), elsewhere, guess=near(pose))


@pytest.mark.parametrize("frame", [{"crs": 25832}, {"origin": (690000.0, 5336000.0)}])
def test_a_frame_beside_a_map_that_is_read_already_is_refused(scene, frame):
    street, pose, path = scene
    with pytest.raises(UsageError, match="the map has its own"):
        find(street, path, near(pose), **frame)


def test_an_unknown_method_is_refused(scene):
    street, pose, path = scene
    with pytest.raises(UsageError, match="lane, icp"):
        find(street, path, near(pose), method="magic")


def test_the_figure_appears(scene, answer, tmp_path):
    street, *_ = scene
    answer.draw(tmp_path / "figure.png", street.roads(), street.road_points())
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_icp_without_open3d_says_how_to_install_it(scene, monkeypatch):
    street, pose, path = scene
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match="Open3D") as refused:
        find(street, path, near(pose), heading=pose.yaw, method="icp")
    assert "pip install" in refused.value.hint


def test_icp_comes_near(scene):
    pytest.importorskip("open3d", reason="needs the extra localize", exc_type=ImportError)
    street, pose, path = scene
    found = find(street, path, near(pose, 1.5, -1.0), heading=pose.yaw + 3.0, method="icp")
    assert np.hypot(*errors(found.pose, pose)[:2]) < 3.0
    assert found.pose.evidence["method"] == "icp"
    assert len(found.eigenvalues) == 6


def test_a_junction_fixes_all_of_an_icp_pose(tmp_path):
    street = Street(lanes=CROSSING)
    pose = street.pose()
    source = voxels(read_moving(street.record(tmp_path / "R1.parquet", pose)).points, 0.5)
    origin = [*street.middle, 0.0]
    state = State(position=pose.position - origin, R_map_sensor=pose.R_map_sensor, reflection=0.0)
    information = pose_information(source, voxels(street.road_points() - origin, 0.5), state)
    assert eigenvalues(information)[0] > 1.0
    assert is_fixed(pose_covariance(information, state))


@pytest.mark.parametrize(
    "guess", [(11.55, 48.14), (48.14, 11.55), (690_000.0,), (1.0, 2.0, 3.0, 4.0)]
)
def test_a_guess_that_is_no_position_in_metres_is_refused(scene, guess):
    street, _, path = scene
    with pytest.raises(UsageError, match=r"degrees|expected easting, northing"):
        find(street, path, guess)


def test_a_rival_beside_the_answer_hides_none_farther_off(tmp_path, monkeypatch):
    street = Street(lanes=CROSSING)
    pose = street.pose()
    street.record(tmp_path / "R1.parquet", pose)
    refined = lane_method.refine

    def with_rivals(scene, tried):
        """The best fit, one half a metre beside it and one five metres off, all alike."""
        best = refined(scene, tried)[0]
        fits = [
            replace(best.fit, state=best.fit.state.moved(move), loss=best.fit.loss + 1e-6 * k)
            for k, move in enumerate(np.array([0.0, 0.5, 5.0])[:, None] * np.eye(7)[0])
        ]
        return [replace(best, fit=fit) for fit in fits]

    monkeypatch.setattr(lane_method, "refine", with_rivals)
    with pytest.raises(NoAnswerError, match=r"ambiguous, two poses 5\.0 m"):
        find(street, tmp_path / "R1.parquet", near(pose), heading=pose.yaw)

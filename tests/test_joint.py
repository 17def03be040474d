"""Several sensors of a site together: vehicles that two of them see relate their poses."""

import json
import math
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from sites import START, recording
from streets import CROSSING, Street, errors

import gis_radar as gr
from gis_radar.base import Text
from gis_radar.calibration import (
    CLASH_HINT,
    AmbiguousError,
    JointCalibration,
    Localization,
    SensorClock,
    Solved,
    adjust_poses,
    localize_together,
)
from gis_radar.calibration.registration.traces import Moving
from gis_radar.calibration.several.adjustment import (
    STRETCH_SIGMA_M,
    Correspondences,
    adjust,
    planar_covariance,
    shared_covariance,
    stated_covariance,
)
from gis_radar.calibration.several.correspondences import (
    HALF_LENGTH_M,
    Moments,
    assign,
    compare_moments,
)
from gis_radar.calibration.several.joint import common_time, locate_all
from gis_radar.calibration.several.network import FIRM_PAIRS
from gis_radar.calibration.single.moving import Span, best_end, read_span, refuse_equal
from gis_radar.cli import group
from gis_radar.poses import COMPONENTS, View

LONG = Street(
    lanes=(
        ((-90.0, -1.75), (320.0, -1.75)),
        ((320.0, 1.75), (-90.0, 1.75)),
        *CROSSING[2:],
    ),
    turn_deg=25.0,
)
ALONG = LONG.placed([[1.0, 0.0]])[0] - LONG.placed([[0.0, 0.0]])[0]
TRAFFIC = {"frames": 900, "vehicles": 60, "seed": 1}
FIRM = (0.15, 0.15, 0.15, 0.1, 0.1, 0.1)  # sigmas of a sensor that stands fast, m and degrees


@pytest.fixture(scope="module")
def true():
    """R1 at the crossing; R2 on the long street, from where the crossing is out of sight."""
    far = LONG.pose(place=(165.0, 9.0), yaw=184.0)
    view = View(elevation_deg=60.0, max_range_m=115.0)
    return {"R1": LONG.pose(), "R2": replace(far, sensor="R2", view=view)}


@pytest.fixture(scope="module")
def recordings(true, tmp_path_factory):
    folder = tmp_path_factory.mktemp("together")
    return {
        name: LONG.record(folder / f"{name}.parquet", pose, noise=number, **TRAFFIC)
        for number, (name, pose) in enumerate(true.items())
    }


def stated(pose, sigma=FIRM, *, along_m=0.0, spread_m=0.0):
    """A pose with its covariance, moved along the street, and perhaps uncertain along it."""
    radians = np.array([*sigma[:3], *np.radians(sigma[3:])])
    covariance = np.diag(radians**2)
    covariance[:2, :2] += spread_m**2 * np.outer(ALONG, ALONG)
    sigmas = np.sqrt(np.diag(covariance)) * ([1.0] * 3 + [math.degrees(1.0)] * 3)
    east, north = pose.position[:2] + along_m * ALONG
    evidence = {
        "covariance": covariance.tolist(),
        "sigma": dict(zip(COMPONENTS, sigmas.tolist(), strict=True)),
    }
    return replace(pose, easting=east, northing=north, evidence=evidence)


def matched(recordings, **poses):
    return adjust_poses(
        {name: recordings[name] for name in poses}, poses, LONG.roads(), LONG.road_points(),
        end=common_time(list(recordings.values())),
    )  # fmt: skip


def test_a_sensor_on_a_straight_road_is_fixed_along_it_by_its_neighbour(written, true):
    pose = gr.read_pose(written["outputs"][1])
    gained = pose.evidence["together"]["gained"]
    before, after = (
        np.hypot(gained["easting"][when], gained["northing"][when]) for when in ("before", "after")
    )
    assert before > 5.0
    assert after < 1.0
    assert pose.evidence["observable"]
    error, sigma = errors(pose, true["R2"]), pose.evidence["sigma"]
    assert (np.abs(error) < 2.0 * np.array([sigma[name] for name in COMPONENTS])).all()


def test_the_same_detections_of_two_sensors_confirm_nothing(recordings, true):
    twice = {"R1": recordings["R1"], "R2": recordings["R1"]}
    with pytest.raises(gr.InputError, match="R1 and R2 have the same detections"):
        matched(twice, R1=(stated(true["R1"]),), R2=(stated(true["R1"]),))


def test_two_radars_of_coarse_positions_have_some_in_common():
    """Of a metre and a degree, or of half a metre, busy lanes fill every cell."""
    rng = np.random.default_rng(1)
    seen = {}
    for name in ("R1", "R2"):
        points = np.round(rng.uniform([10.0, -8.0, -5.0], [90.0, 8.0, -5.0], (9000, 3)) * 2.0) / 2.0
        rate = np.round(rng.normal(12.0, 3.0, 9000), 1)
        seen[name] = Moving(
            time=np.arange(9000.0), points=points, range_rate=rate, frames=9000, begin=0.0,
            end=9000.0,
        )  # fmt: skip
    refuse_equal(seen)
    with pytest.raises(gr.InputError, match="R1 and R3 have the same detections"):
        refuse_equal(seen | {"R3": replace(seen["R1"], time=seen["R1"].time + 3.0)})


@pytest.mark.parametrize("spread_m", [0.5, 6.0])
def test_no_sigma_grows_where_the_poses_agree(recordings, true, spread_m):
    mine = {"R1": stated(true["R1"]), "R2": stated(true["R2"], spread_m=spread_m, along_m=0.1)}
    solved = matched(recordings, **{name: (pose,) for name, pose in mine.items()})
    for name, pose in mine.items():
        before, after = stated_covariance(pose), stated_covariance(solved.poses[name])
        assert np.linalg.eigvalsh(before - after).min() > -1e-9
        assert planar_covariance(solved.poses[name])[2, 2] < 0.95 * before[5, 5]


def test_errors_are_as_large_as_stated(recordings, true):
    """NEES of the joint poses, single answers drawn from their covariance: chi-square of 3."""
    nees = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        drawn = {}
        for name, pose in true.items():
            known = stated(pose, spread_m=0.2)
            step = rng.multivariate_normal(np.zeros(6), stated_covariance(known))
            drawn[name] = (
                replace(
                    known,
                    easting=known.easting + step[0],
                    northing=known.northing + step[1],
                    yaw=known.yaw + math.degrees(step[5]),
                ),
            )
        solved = matched(recordings, **drawn)
        for name, pose in solved.poses.items():
            error = errors(pose, true[name])[[0, 1, 5]] * [1.0, 1.0, math.radians(1.0)]
            nees.append(error @ np.linalg.solve(planar_covariance(pose), error))
    assert 1.0 < np.mean(nees) < 4.5


def test_poses_that_contradict_each_other_are_refused(recordings, true):
    solved = matched(recordings, R1=(stated(true["R1"]),), R2=(stated(true["R2"], along_m=3.0),))
    assert (solved.poses, solved.refused.keys()) == ({}, {"R1", "R2"})
    (why,) = set(solved.refused.values())
    assert why.startswith("R1 and R2: their poses contradict each other: ")
    assert float(why.split()[-3]) == pytest.approx(3.0, abs=1.1)


def test_two_sensors_that_contradict_each_other_end_with_one_line(recordings, true, monkeypatch):
    poses = {"R1": stated(true["R1"]), "R2": stated(true["R2"], along_m=4.0)}

    def single(recording, *_, **__):
        return Localization(pose=poses[recording.stem], fitness=0.9, observable=True)

    monkeypatch.setattr("gis_radar.calibration.several.joint.localize_one", single)
    with pytest.raises(gr.NoAnswerError, match=r"^R1 and R2: .*contradict[^;]*$") as refusal:
        locate_all(
            list(recordings.values()), LONG.roads(), LONG.road_points(), guesses=[(0, 0), (0, 0)]
        )
    assert (refusal.value.exit_code, refusal.value.hint) == (4, CLASH_HINT)


def test_the_span_of_a_recording_is_that_of_its_rows(recordings, tmp_path):
    times = pd.read_parquet(recordings["R1"])["time"]
    found = read_span(recordings["R1"])
    assert (found.begin, found.end) == (times.iloc[0], times.iloc[-1])
    table = pq.read_table(recordings["R1"])
    pq.write_table(table, tmp_path / "R1.parquet", write_statistics=False, row_group_size=5000)
    pd.read_parquet(recordings["R1"]).to_csv(tmp_path / "R1.csv", index=False)
    for name in ("R1.parquet", "R1.csv"):
        same = read_span(tmp_path / name)
        assert (same.begin, same.end) == pytest.approx((found.begin, found.end), abs=1e-6)
    ahead = read_span(recordings["R1"], SensorClock(offset_s=3.0))
    assert found.begin - ahead.begin == pytest.approx(3.0)


def test_the_time_in_which_most_sensors_recorded_counts():
    def spans(*pairs):
        return [Span(path=Path("R.parquet"), begin=a, end=b) for a, b in pairs]

    whole = {"R1": spans((0, 200), (1000, 1100)), "R2": spans((50, 260)), "R3": spans((2000, 2100))}
    assert best_end(whole, 100.0) == 200
    assert best_end({"R1": spans((0, 100)), "R2": spans((1, 101))}, 100.0) == 100


def test_a_sensor_that_did_not_record_then_is_named(recordings, true, tmp_path):
    time, xyz, rate = LONG.detections(true["R2"], vehicles=4)
    later = recording(tmp_path / "R3.parquet", time + 1000.0, xyz, range_rate=rate)
    mine = {name: (stated(pose),) for name, pose in true.items()}
    mine["R3"] = (stated(replace(true["R2"], sensor="R3")),)
    whole = {name: (path,) for name, path in recordings.items()} | {"R3": (later,)}
    solved = adjust_poses(whole, mine, LONG.roads(), LONG.road_points())
    assert solved.pairs.keys() == {("R1", "R2")}
    assert solved.unmatched == {"R3": "it did not record while the others did"}
    assert solved.poses["R3"] == mine["R3"][0]


def test_measured_clocks_are_corrected(recordings, true, tmp_path):
    time, xyz, rate = LONG.detections(true["R2"], noise=1, **TRAFFIC)
    late = recording(tmp_path / "R2.parquet", time + 3600.0, xyz, range_rate=rate)
    clocks = {"R2": SensorClock(offset_s=3600.0, sigma_s=0.01)}
    solved = adjust_poses(
        {"R1": recordings["R1"], "R2": late}, {n: (stated(pose),) for n, pose in true.items()},
        LONG.roads(), LONG.road_points(), clocks=clocks,
    )  # fmt: skip
    assert solved.pairs["R1", "R2"] > 25
    assert solved.remarks == ()


def late_and_loose(street, folder, true, ahead_s, **traffic):
    """The poses of R1, which stands fast, and R2, which is open along the street and late."""
    paths = {}
    for number, (name, pose) in enumerate(true.items()):
        time, xyz, rate = street.detections(pose, noise=number, **TRAFFIC | traffic)
        time = time + (ahead_s if name == "R2" else 0.0)
        paths[name] = recording(folder / f"{name}.parquet", time, xyz, range_rate=rate)
    mine = {"R1": stated(true["R1"]), "R2": stated(true["R2"], along_m=3.0, spread_m=9.0)}
    solved = adjust_poses(
        paths, {name: (pose,) for name, pose in mine.items()}, street.roads(),
        street.road_points(), end=common_time(list(paths.values())),
    )  # fmt: skip
    return solved, mine["R2"]


@pytest.mark.parametrize("ahead_s", [-1.5, 0.6, 1.0])
def test_a_clock_that_is_off_is_no_other_place(true, tmp_path, ahead_s):
    """Vehicles of one direction alone fit another place: seen late, or from elsewhere."""
    seed = 2  # of several draws the one that fails where the clock is not estimated
    solved, _ = late_and_loose(LONG, tmp_path, true, ahead_s, vehicles=40, seed=seed)
    pose = solved.poses["R2"]
    along_m = errors(pose, true["R2"])[:2] @ ALONG
    assert abs(along_m) < 3.0 * math.sqrt(ALONG @ planar_covariance(pose)[:2, :2] @ ALONG)
    assert pose.evidence["sigma"]["easting"] < 1.0
    (told,) = solved.remarks
    assert float(told.split()[5]) == pytest.approx(abs(ahead_s), abs=0.05)


@pytest.mark.parametrize("ahead_s", [0.0, 1.0])
def test_traffic_of_one_direction_and_speed_places_no_sensor_whose_clock_may_be_off(
    true, tmp_path, ahead_s
):
    street = replace(LONG, lanes=(LONG.lanes[0], *LONG.lanes[2:]))
    solved, mine = late_and_loose(street, tmp_path, true, ahead_s, vehicles=60, speeds=(9.9, 10.1))
    assert solved.poses["R2"] == mine
    assert "traffic in both directions" in solved.unmatched["R2"]


@pytest.mark.parametrize("ahead_s", [0.2, -3.2, 0.0])
def test_a_clock_that_is_off_is_told_and_moves_no_pose(recordings, true, tmp_path, ahead_s):
    time, xyz, rate = LONG.detections(true["R2"], noise=1, **TRAFFIC)
    late = recording(tmp_path / "R2.parquet", time + ahead_s, xyz, range_rate=rate)
    mine = {name: (stated(pose),) for name, pose in true.items()}
    solved = matched({"R1": recordings["R1"], "R2": late}, **mine)
    told = [re.match(r"the clock of R2 is (.*) s (ahead|behind)", r) for r in solved.remarks]
    found = [float(each[1]) * (1.0 if each[2] == "ahead" else -1.0) for each in told]
    assert found == ([pytest.approx(ahead_s, abs=0.03)] if ahead_s else [])
    assert solved.pairs["R1", "R2"] > 25
    assert (np.abs(errors(solved.poses["R2"], true["R2"])[:2]) < 0.3).all()


@pytest.mark.parametrize(("right_at", "ahead_s"), [(0.0, 4.0), (0.5, 0.0)])
def test_a_clock_of_another_rate_moves_no_pose(recordings, true, tmp_path, right_at, ahead_s):
    """Also where it is right in the middle of the recording, and hardly off at its ends."""
    time, xyz, rate = LONG.detections(true["R2"], noise=1, **TRAFFIC)
    late = time - 0.01 * (time - np.quantile(time, right_at)) + ahead_s
    path = recording(tmp_path / "R2.parquet", late, xyz, range_rate=rate)
    solved = matched({"R1": recordings["R1"], "R2": path},
                  **{name: (stated(pose),) for name, pose in true.items()})  # fmt: skip
    (told,) = solved.remarks
    assert "runs 1.0% slow" in told
    assert (np.abs(errors(solved.poses["R2"], true["R2"])[:2]) < 0.3).all()


@pytest.fixture(scope="module")
def few(true, tmp_path_factory):
    """The same street with a third of the traffic."""
    folder = tmp_path_factory.mktemp("few")
    return {
        name: LONG.record(folder / f"{name}.parquet", pose, noise=n, **(TRAFFIC | {"vehicles": 20}))
        for n, (name, pose) in enumerate(true.items())
    }


def test_few_vehicles_move_no_pose_that_is_certain_by_itself(few, true):
    mine = {"R1": stated(true["R1"]), "R2": stated(true["R2"], along_m=0.3)}
    solved = matched(few, **{name: (pose,) for name, pose in mine.items()})
    assert (solved.poses, solved.pairs) == (mine, {})
    assert re.fullmatch(
        r"\d+ vehicles shared with R1 confirm its pose, too few to move it", solved.unmatched["R2"]
    )
    loose = stated(true["R2"], along_m=4.0, spread_m=6.0)
    solved = matched(few, R1=(mine["R1"],), R2=(loose,))
    assert 4 <= solved.pairs["R1", "R2"] < FIRM_PAIRS
    assert abs(errors(solved.poses["R2"], true["R2"])[:2] @ ALONG) < 1.0


def test_what_is_alike_on_a_stretch_is_no_evidence_of_each_vehicle():
    """Thirty vehicles on one stretch say hardly more than ten of them do."""
    rng = np.random.default_rng(5)
    known = [np.diag([1.0, 1.0, 0.01]) ** 2] * 2
    sigma = []
    for pairs in (10, 30, 1000):
        slope = np.tile(np.eye(2, 13) - np.eye(2, 13, 3) + np.eye(2, 13, 11), (pairs, 1, 1))
        gap = rng.normal(0.0, 0.5, (pairs, 2))
        correspondences = Correspondences(
            information=4.0 * np.einsum("pik,pil->pkl", slope, slope),
            gradient=4.0 * np.einsum("pik,pi->pk", slope, gap),
            gap=gap, slope=slope, covariance=np.tile(0.25 * np.eye(2), (pairs, 1, 1)),
            stretch=np.zeros(pairs, dtype=int),
        )  # fmt: skip
        covariance = adjust({(0, 1): correspondences}, np.zeros((2, 3)), known).covariance
        apart = np.array([1.0, 0.0, 0.0, -1.0, 0.0, 0.0])
        sigma.append(np.sqrt(apart @ covariance @ apart))
    assert sigma[0] > sigma[1] > sigma[2]
    assert sigma[2] == pytest.approx(STRETCH_SIGMA_M[0], rel=0.2)


def test_of_three_the_one_that_two_contradict_is_refused(recordings, true, tmp_path):
    copy = replace(true["R2"], sensor="R3")
    beside = LONG.record(tmp_path / "R3.parquet", true["R2"], noise=2, **TRAFFIC)
    whole = recordings | {"R3": beside}
    solved = matched(
        whole,
        R1=(stated(true["R1"]),),
        R2=(stated(true["R2"], along_m=4.0),),
        R3=(stated(copy),),
    )
    assert list(solved.refused) == ["R2"]
    assert solved.poses.keys() == {"R1", "R3"}
    assert abs((solved.poses["R3"].position[:2] - copy.position[:2]) @ ALONG) < 0.5


def test_a_contradiction_is_told_once_and_others_keep_their_poses(recordings, true, tmp_path):
    """Two that contradict each other, and a third that sees other traffic."""
    alone = LONG.record(tmp_path / "R3.parquet", true["R2"], noise=9, **(TRAFFIC | {"seed": 77}))
    solved = matched(
        recordings | {"R3": alone},
        R1=(stated(true["R1"]),),
        R2=(stated(true["R2"], along_m=4.0),),
        R3=(stated(replace(true["R2"], sensor="R3")),),
    )
    assert solved.poses.keys() == {"R3"}
    assert solved.refused.keys() == {"R1", "R2"}
    failure = JointCalibration(found={}, refused=solved.refused, pairs={}).failure
    assert failure.message.startswith("R1 and R2: their poses contradict")
    assert failure.message.count("contradict") == 1


@pytest.mark.parametrize("right", [0, 1])
def test_of_several_poses_the_neighbour_tells_the_right_one(recordings, true, right):
    """Two places that the sensor alone cannot tell apart, 14 m from each other."""
    wrong = stated(true["R2"], along_m=14.0, spread_m=0.5)
    mine = [wrong, wrong]
    mine[right] = stated(true["R2"], along_m=0.4, spread_m=0.5)
    solved = matched(recordings, R1=(stated(true["R1"]),), R2=tuple(mine))
    assert solved.chosen["R2"] == right
    assert abs(errors(solved.poses["R2"], true["R2"])[:2] @ ALONG) < 0.6


@pytest.mark.parametrize("spread_m", [0.0, 6.0])
@pytest.mark.parametrize("seed", [77, 81])
def test_a_sensor_that_sees_other_traffic_keeps_its_answer(
    recordings, true, tmp_path, seed, spread_m
):
    other = TRAFFIC | {"seed": seed}
    alone = LONG.record(tmp_path / "R2.parquet", true["R2"], noise=9, **other)
    mine = {"R1": stated(true["R1"]), "R2": stated(true["R2"], spread_m=spread_m)}
    solved = matched(
        {"R1": recordings["R1"], "R2": alone}, **{name: (pose,) for name, pose in mine.items()}
    )
    assert solved.pairs == {}
    assert solved.poses == mine


def test_the_poses_that_fit_come_back_from_a_worker_process(true):
    each = Localization(pose=true["R1"], fitness=0.9, observable=True)
    sent = AmbiguousError("R1: ambiguous", hint="record longer", answers=(each, each))
    back = pickle.loads(pickle.dumps(sent))  # noqa: S301 - our own
    assert (back.message, back.hint, len(back.answers)) == ("R1: ambiguous", "record longer", 2)


def test_what_no_neighbour_places_keeps_its_reason(recordings, true, tmp_path, monkeypatch):
    """R2 cannot tell two poses apart, and sees none of R1's vehicles."""
    other = TRAFFIC | {"seed": 77}
    alone = LONG.record(tmp_path / "R2.parquet", true["R2"], noise=9, **other)
    results = {
        "R1": Localization(pose=stated(true["R1"]), fitness=0.9, observable=True),
        "R2": AmbiguousError(
            "{}: ambiguous",
            "R2",
            hint="",
            answers=tuple(
                Localization(pose=stated(true["R2"], along_m=far), fitness=0.9, observable=True)
                for far in (0.0, 14.0)
            ),
        ),
    }

    def single(recording, *_, **__):
        found = results[recording.stem]
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr("gis_radar.calibration.several.joint.localize_one", single)
    done = locate_all(
        [recordings["R1"], alone], LONG.roads(), LONG.road_points(), guesses=[(0, 0), (0, 0)]
    )
    assert list(done.found) == ["R1"]
    assert done.failure.exit_code == 4
    assert done.failure.message == "R2: ambiguous"


@pytest.fixture
def located(true, tmp_path, monkeypatch):
    """Locate sensors that share no vehicles; by sensor, easting of the guess and where it fits."""

    def locate(fits, *, guesses, verdict=None):
        evidence = {} if verdict is None else {"scan_check": {"verdict": verdict}}

        def single(recording, *_, guess, **__):
            if guess[0] not in fits[recording.stem]:
                raise gr.NoAnswerError("no place fits")
            pose = stated(true["R1"])
            pose = replace(pose, evidence={**pose.evidence, **evidence})
            return Localization(pose=pose, fitness=0.9, observable=True)

        def unmatched(_, poses, *__, **___):
            firsts = {name: each[0] for name, each in poses.items()}
            return Solved(poses=firsts, chosen=dict.fromkeys(poses, 0), refused={}, pairs={})

        place = "gis_radar.calibration.several.joint"
        monkeypatch.setattr(f"{place}.localize_one", single)
        monkeypatch.setattr(f"{place}.adjust_poses", unmatched)
        monkeypatch.setattr(f"{place}.common_time", lambda _: START)
        paths = [tmp_path / f"{name}.parquet" for name in guesses]
        places = [(east, 0.0) for east in guesses.values()]
        return locate_all(paths, LONG.roads(), LONG.road_points(), guesses=places)

    return locate


SWAPPED = {"R1": {0.0, 400.0}, "R2": {400.0}, "R3": {800.0}}  # R1's fits a wrong place by chance


def test_swapped_guesses_leave_no_wrong_pose(located):
    with pytest.raises(gr.NoAnswerError, match=r"^R1: .* traffic of R2 fits") as refusal:
        located(SWAPPED, guesses={"R1": 400.0, "R2": 0.0})
    assert refusal.value.hint == "give guesses in the order of recordings"
    done = located(SWAPPED, guesses={"R1": 400.0, "R2": 0.0, "R3": 800.0})
    assert list(done.found) == ["R3"]
    assert done.refused.keys() == {"R1", "R2"}


def test_a_wrong_guess_takes_no_pose_from_a_sensor_beside(located):
    """R2 stands 10 m from R1, so that its recording fits at R1's guess, too."""
    done = located({"R1": {400.0}, "R2": {400.0}}, guesses={"R1": 400.0, "R2": 0.0})
    assert list(done.found) == ["R1"]
    assert done.refused == {"R2": "no place fits"}


def test_a_pose_that_the_scan_confirms_is_of_no_swapped_guess(located):
    done = located(SWAPPED, guesses={"R1": 400.0, "R2": 0.0}, verdict="confirms")
    assert list(done.found) == ["R1"]


def test_a_sensor_before_which_nothing_moves_then_is_not_tied(recordings, true, tmp_path):
    times = START + np.arange(200) * 0.05
    still = recording(tmp_path / "R2.parquet", times, np.tile([20.0, 5.0, -3.0], (200, 1)))
    mine = {name: (stated(pose),) for name, pose in true.items()}
    solved = matched({"R1": recordings["R1"], "R2": still}, **mine)
    assert solved.pairs == {}
    assert solved.poses == {name: pose for name, (pose,) in mine.items()}


def test_recordings_without_common_time_are_refused(recordings, true, tmp_path):
    time, xyz, rate = LONG.detections(true["R2"], vehicles=4)
    later = recording(tmp_path / "R2.parquet", time + 1000.0, xyz, range_rate=rate)
    with pytest.raises(gr.InputError, match=r"R1\.parquet ends \d+ s before .*R2\.parquet begins"):
        common_time([recordings["R1"], later])


def counts():
    """Wrong calls: recordings, options, what the message says."""
    two = ["a/R1.parquet", "a/R2.parquet"]
    yield ["a/R1.parquet"], {"guesses": [(0, 0)]}, "1 recording, at least two"
    yield two, {"guesses": [(0, 0)]}, "2 recordings, but 1 guesses"
    yield two, {"guesses": [(0, 0)] * 2, "headings": [1.0]}, "2 recordings, but 1 headings"
    yield two, {"guesses": [(0, 0)] * 2, "headings": [1, 1], "compasses": [1, 1]}, "both heading"
    yield ["a/R1.parquet", "b/R1.parquet"], {"guesses": [(0, 0)] * 2}, "two recordings are of R1"


@pytest.mark.parametrize(("paths", "options", "message"), list(counts()))
def test_wrong_calls_are_refused_in_a_line(paths, options, message):
    with pytest.raises(gr.UsageError, match=message):
        localize_together(paths, "map.osm", "road.laz", **options)


def some_moments(seed, place, *, vehicles=10):
    """Vehicles for four seconds each on two lanes, seen by one sensor."""
    rng = np.random.default_rng(seed)
    track, moment = (each.ravel() for each in np.mgrid[0:vehicles, 0:20])
    along = np.where(track[:, None] % 2, [1.0, 0.0], [-1.0, 0.0])
    begin = rng.uniform(-80.0, 80.0, (vehicles, 1))
    middle = np.column_stack([begin[track, 0], 2.0 * along[:, 0]])
    middle += along * (10.0 * 0.2 * moment)[:, None]
    arm = np.column_stack([middle, np.zeros(len(track))]) - place
    return Moments(
        track=track, moment=moment, arm=arm, place=np.asarray(place, float), along=along,
        speed=np.full(len(track), 10.0), count=np.full(len(track), 3),
    )  # fmt: skip


def stepped(seen, step):
    """What a sensor sees after a small step of it: easting, northing, yaw."""
    east, north = seen.arm[:, 0], seen.arm[:, 1]
    turn = step[2] * np.column_stack([-north, east, np.zeros(len(seen))])
    return replace(seen, arm=seen.arm + turn, place=seen.place + [*step[:2], 0.0])


@pytest.mark.parametrize("part", range(6))
def test_derivatives_by_the_poses_are_right(part):
    one, other = some_moments(1, [0.0, 12.0, 5.0]), some_moments(1, [60.0, -15.0, 6.0])
    rows, step = compare_moments(one, other), np.zeros(6)
    step[part] = 1e-5
    after = compare_moments(stepped(one, step[:3]), stepped(other, step[3:]))
    assert (rows.tracks == after.tracks).all()
    # that a turn changes the aspect, and the share of the sides with it, is left out
    off = np.abs((after.gap - rows.gap) / 1e-5 - rows.poses[:, :, part])
    assert off.max() < (HALF_LENGTH_M if part in {2, 5} else 1e-6)


def test_each_track_is_paired_once_at_the_least_misfit():
    tracks = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [2, 2]])
    assert assign(np.array([1.0, 2.0, 2.0, 9.0, 20.0]), tracks, 13.8).tolist() == [1, 2]


matrices = st.integers(0, 2**32 - 1)


def covariances(rng, n):
    for _ in range(n):
        root = rng.normal(size=(3, 3)) * np.exp(rng.normal(0.0, 1.5, (3, 1)))
        yield root @ root.T + 1e-6 * np.eye(3)


@settings(max_examples=60)
@given(seed=matrices, n=st.integers(2, 4), pairs=st.integers(1, 12))
def test_an_adjustment_never_knows_less_than_the_single_answers(seed, n, pairs):
    rng = np.random.default_rng(seed)
    known = list(covariances(rng, n))
    slope = rng.normal(size=(pairs, 2, 13))
    gap = rng.normal(0.0, 3.0, (pairs, 2))
    correspondences = {
        (0, n - 1): Correspondences(
            information=np.einsum("pik,pil->pkl", slope, slope),
            gradient=np.einsum("pik,pi->pk", slope, gap),
            gap=gap, slope=slope, covariance=np.tile(np.eye(2), (pairs, 1, 1)),
            stretch=rng.integers(0, 3, pairs),
        )
    }  # fmt: skip
    single = shared_covariance(known)
    assert np.linalg.eigvalsh(single).min() > 0.0
    found = adjust(correspondences, np.zeros((n, 3)), known)
    scale = np.sqrt(np.diag(single))
    less = (single - found.covariance) / np.outer(scale, scale)
    assert np.linalg.eigvalsh(less).min() > -1e-7
    assert np.isfinite(found.step).all()


@pytest.fixture(scope="module")
def files(recordings, tmp_path_factory):
    """The scanned road; the map's lanes come from the scene itself."""
    road = LONG.write_road(tmp_path_factory.mktemp("road") / "road.laz")
    return [str(recordings["R1"]), str(recordings["R2"]), "--map", "map.osm", "--road", str(road)]


def invoke(files, output, *more):
    words = ["localize", *files, "--together", "--json", "-o", str(output), *more]
    return CliRunner().invoke(group, words, standalone_mode=False)


def guess_words(true):
    return [
        word
        for pose in true.values()
        for word in ("--guess", f"{pose.easting - 3:.1f},{pose.northing + 4:.1f}")
    ]


@pytest.fixture(scope="module")
def scene_map():
    with pytest.MonkeyPatch.context() as here:
        here.setattr(
            "gis_radar.calibration.single.localization.read_map", lambda *_, **__: LONG.roads()
        )
        yield


@pytest.fixture(scope="module")
def written(files, true, scene_map, tmp_path_factory):
    """What the command says, which finds both poses."""
    folder = tmp_path_factory.mktemp("written") / "poses"
    headings = [word for pose in true.values() for word in ("--heading", f"{pose.yaw + 8:.1f}")]
    done = invoke(files, folder, *guess_words(true), *headings)
    assert done.exception is None
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["outputs"] == [str(folder / f"{name}.json") for name in true]
    return result


def test_the_command_writes_a_pose_for_each_sensor(written, true):
    assert "vehicles shared with R1" in written["summary"]["R2"]
    for path, pose in zip(written["outputs"], true.values(), strict=True):
        assert (np.abs(errors(gr.read_pose(path), pose)[:2]) < 1.0).all()


@pytest.mark.usefixtures("scene_map")
def test_the_command_fails_after_the_poses_where_a_sensor_has_none(
    files, true, tmp_path, monkeypatch
):
    pose = stated(true["R1"])
    found = Localization(pose=pose, fitness=0.9, observable=True)
    part = JointCalibration(
        found={"R1": found}, refused={"R2": Text("{}: 2 moving vehicles", "R2")}, pairs={}
    )
    monkeypatch.setattr("gis_radar.calibration.localize_together", lambda *_, **__: part)
    done = invoke(files, tmp_path, *guess_words(true))
    assert isinstance(done.exception, gr.NoAnswerError)
    assert done.exception.message == "R2: 2 moving vehicles"
    assert [path.name for path in tmp_path.iterdir()] == ["R1.json"]
    assert json.loads(done.stdout.splitlines()[-1])["outputs"] == [str(tmp_path / "R1.json")]


@pytest.mark.usefixtures("scene_map")
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--figure", "f.png"), "for one sensor"),
        (("--method", "icp"), "for one sensor"),
        (("--guess", "690000,5336000"), "2 recordings, but 3 guesses"),
        (("--heading", "3", "--compass", "north"), "both --heading and --compass"),
    ],
)
def test_what_does_not_go_together_is_wrong_usage(files, true, tmp_path, more, message):
    done = invoke(files, tmp_path / "poses", *guess_words(true), *more)
    assert isinstance(done.exception, gr.UsageError)
    assert message in done.exception.message
    assert not (tmp_path / "poses").exists()


def test_several_recordings_need_the_option(files, tmp_path):
    words = ["localize", *files, "--guess", "690000,5336000", "-o", str(tmp_path / "pose.json")]
    done = CliRunner().invoke(group, words, standalone_mode=False)
    assert isinstance(done.exception, gr.UsageError)
    assert (done.exception.message, done.exception.hint[:10]) == ("2 times RECORDING", "--together")


def test_a_file_in_the_place_of_the_folder_is_refused_before_any_work(files, true, tmp_path):
    (tmp_path / "poses").write_text("mine")
    done = invoke(files, tmp_path / "poses", *guess_words(true))
    assert isinstance(done.exception, gr.OutputError)
    assert "is a file" in done.exception.message

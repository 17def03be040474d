"""What is no vehicle, and which pose is off: inputs that mislead."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from test_vehicles_evidence import detections_at, driven, road_of, setting_off

from gis_radar.tracking import are_persons
from gis_radar.tracking.batches import pose_warnings
from gis_radar.tracking.motion import fit_motion
from gis_radar.tracking.start import track_management
from gis_radar.tracking.start.bodies import is_person, without_faint_ends
from gis_radar.tracking.start.detectability import Detectability, Occluders
from gis_radar.tracking.start.passes import Passes
from gis_radar.tracking.start.resting import rate_without
from gis_radar.tracking.start.stationary import StationaryTarget, detected_parts
from gis_radar.tracking.start.strips import Strips
from gis_radar.tracking.start.track_management import split_at_drives

RATE = 20


def followed(rcs, speeds):
    """Motions of so many dBm2 and m/s, twenty detections each, beside a hundred still ones."""
    count = 20 * len(rcs)
    detections = detections_at(
        np.tile(np.arange(20.0) / RATE, len(rcs) + 5), np.full((count + 100, 2), 30.0)
    )
    detections.rcs[:count] = np.repeat(rcs, 20)
    detections.range_rate[count:] = 0.0
    motions = [driven(0.0, 1.0, v, 20 * k + np.arange(20)) for k, v in enumerate(speeds)]
    return detections, motions


@pytest.mark.parametrize("ghosts", [0, 2])
def test_where_no_vehicle_drives_walkers_are_none(ghosts):
    rcs, speeds = [-17.0, -16.0, -3.0] + ghosts * [-18.0], [1.4, 4.0, 3.0] + ghosts * [12.0]
    detections, motions = followed(rcs, speeds)  # what stands returns 0 dBm2
    persons = is_person(detections, motions)
    assert persons == [True, True, False] + ghosts * [True]


def test_persons_are_weaker_than_who_drives_fast():
    detections, motions = followed([-6.0, -1.0, 0.0], [1.4, 12.0, 10.0])
    assert is_person(detections, motions) == [True, False, False]


@pytest.mark.parametrize(
    ("rcs", "fast", "spread", "steady", "person"),
    [
        (-5.0, 5.0, 0.6, True, True),  # a cyclist
        (-5.0, 5.0, 1.5, True, False),  # as long as a car that creeps
        (0.0, 5.0, 0.6, True, False),  # a car of which one end is seen
        (-5.0, 12.0, 0.6, True, False),  # a motorcycle
        (-10.0, 5.0, np.nan, True, True),
        (-4.0, 5.0, np.nan, True, False),  # of unknown size, as of now: rather a car
        (-2.0, 5.0, 0.9, True, False),  # a small car that creeps
        (-13.0, 0.3, 0.7, False, True),  # a walker who waits
        (-11.0, 0.3, 3.9, False, False),  # a lorry far away that stands
    ],
)
def test_a_cyclist_is_weak_and_small_and_slow(rcs, fast, spread, steady, person):
    found = are_persons(
        np.array([rcs, 0.0]), np.array([fast, 14.0]), np.array([spread, 1.4]),
        np.array([steady, False]), 0.0,
    )  # fmt: skip
    assert found.tolist() == [person, False]


def test_where_vehicles_differ_by_more_a_weak_one_is_no_person():
    weak, slow = -12.0, 6.0
    for others, person in (
        ([-2.0, -1.0, 0.0, 1.0, 2.0], True),
        ([-8.0, -4.0, 0.0, 4.0, 8.0], False),
    ):
        rcs = np.array([weak, *others])
        found = are_persons(
            rcs, np.array([slow, *[14.0] * 5]), np.full(6, 1.5), np.zeros(6, np.bool_), 0.0
        )
        assert found.tolist() == [person, *[False] * 5]


@pytest.mark.parametrize("apart", [1.0, 5.0, 8.0])
def test_the_weaker_a_slow_track_is_the_rather_it_is_a_person(apart):
    others = apart * np.array([-1.0, -0.7, 0.0, 0.7, 1.0])
    found = [
        bool(
            are_persons(
                np.array([weak, *others]), np.array([3.0, *[14.0] * 5]), np.full(6, 0.75),
                np.ones(6, np.bool_), -50.0,
            )[0]
        )
        for weak in range(0, -40, -1)
    ]  # fmt: skip
    assert found == sorted(found)
    assert found[-1]


def test_who_mostly_stands_is_no_cyclist():
    detections, motions = followed([-6.0, 0.0], [5.0, 12.0])
    stopped = replace(motions[0], speed=np.where(np.arange(20) < 12, 0.0, 5.0))
    both = [motions[0], stopped, motions[1]]
    assert is_person(detections, both) == [True, False, False]


def seen_by(sensor, shift, ways, rng, on=1.0):
    """Vehicles of a sensor that drives beside its lanes by a shift, in directions of 20 degrees."""
    count = 100
    way = rng.choice(ways, count)
    turn = np.radians(20.0 * way)
    left = shift[1] * np.cos(turn) - shift[0] * np.sin(turn) + rng.normal(0.0, 0.2, count)
    size = np.full(count, 30)
    hits = np.where(rng.random(count) < on, 30, 0)
    return pd.DataFrame(
        {
            "vehicle": np.arange(count) + 100 * sensor, "sensor": sensor, "way": way,
            "towards": np.radians(20.0 * way), "size": size, "on": hits, "count": hits,
            "left_m": np.where(hits > 0, left, np.nan),
        }
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shift", "said"),
    [((0.3, -0.2), []), ((1.0, 0.0), ["0.9 m east of"]), ((-0.7, 0.7), ["m north-west of"])],
)
def test_a_pose_that_is_off_is_named(shift, said):
    rng = np.random.default_rng(1)
    seen = pd.concat(
        [seen_by(0, (0.0, 0.2), [0, 9, -4], rng), seen_by(1, shift, [0, 4, 9, -4], rng)]
    )
    lines = pose_warnings(seen, ["R1", "R2"])
    assert len(lines) == len(said)
    for line, part in zip(lines, said, strict=True):
        assert line.startswith("R2: ")
        assert part in line


def test_across_one_road_only_a_pose_is_judged_across_it():
    rng = np.random.default_rng(2)
    along, across = (seen_by(0, shift, [0, 9], rng) for shift in ((9.0, 0.0), (0.0, 1.2)))
    assert pose_warnings(along, ["R1"]) == []
    assert "1.2 m north" in pose_warnings(across, ["R1"])[0]


def test_a_pose_whose_vehicles_follow_no_lane_is_named():
    seen = seen_by(0, (0.0, 0.0), [0, 9], np.random.default_rng(3), on=0.7)
    (line,) = pose_warnings(seen, ["R1"])
    assert "follow no lanelet" in line


def test_a_pose_turned_off_is_named_by_what_others_measure():
    rng = np.random.default_rng(4)
    right, turned = (seen_by(k, (0.0, 0.0), [0, 4, 9, -4], rng) for k in (0, 1))
    turned["left_m"] += 1.2 * (turned.groupby("way").cumcount() % 3 - 1)
    (line,) = pose_warnings(pd.concat([right, turned]), ["R1", "R2"])
    assert line.startswith("R2: ")
    assert "farther from their lanes' centres" in line


def test_a_shift_that_few_vehicles_of_one_lane_seem_to_show_is_not_named():
    """Eight that turn out of a queue, all 0.7 m off to one side, may be drivers of that lane."""
    seen = seen_by(0, (0.0, 0.0), [0], np.random.default_rng(6)).head(8)
    few = seen.assign(left_m=[-0.9, -0.8, -0.8, *5 * [np.nan]], count=[9, 9, 9, *5 * [0]])
    assert pose_warnings(few, ["R1"]) == []
    many = pd.concat([seen.assign(vehicle=seen["vehicle"] + 10 * k, left_m=-1.2) for k in range(5)])
    assert "m south" in pose_warnings(many, ["R1"])[0]


def test_a_sensor_that_sees_no_straight_lane_hides_no_other():
    rng = np.random.default_rng(4)
    right, turned = (seen_by(k, (0.0, 0.0), [0, 4, 9, -4], rng) for k in (0, 1))
    turned["left_m"] += 1.2 * (turned.groupby("way").cumcount() % 3 - 1)
    bends = seen_by(2, (0.0, 0.0), [0], rng).assign(count=0, left_m=np.nan)
    (line,) = pose_warnings(pd.concat([right, turned, bends]), ["R1", "R2", "R3"])
    assert line.startswith("R2: ")


def test_few_vehicles_judge_no_pose():
    seen = seen_by(0, (2.0, 0.0), [0, 4], np.random.default_rng(5)).head(7)
    assert pose_warnings(seen, ["R1"]) == []


def test_a_person_followed_with_a_vehicle_is_cut_off():
    detections, (motion,) = followed([0.0], [10.0])
    detections.rcs[:10] = -15.0
    states = np.zeros((len(detections), 6))
    states[:, :2], states[:, 3] = detections.points, 10.0
    _, fast = followed([0.0, 0.0], [10.0, 10.0])
    fast = [each for each in fast if each.rows[0] == 20]
    (cut, whole) = without_faint_ends(detections, [motion, *fast], states)
    assert cut.rows.tolist() == list(range(10, 20))
    assert whole is fast[0]


def test_a_few_faint_returns_are_of_the_vehicle():
    detections, (motion,) = followed([0.0], [10.0])
    detections.rcs[:4] = -15.0
    (whole,) = without_faint_ends(detections, [motion], np.zeros((len(detections), 6)))
    assert whole is motion


@pytest.mark.parametrize(
    ("silent_s", "moved_m", "parts"), [(3.0, 8.0, 1), (12.0, 8.0, 2), (12.0, 0.0, 1)]
)
def test_who_is_elsewhere_after_a_long_silence_is_joined_by_links(silent_s, moved_m, parts):
    time = np.concatenate([np.arange(20.0) / RATE, silent_s + 1.0 + np.arange(20.0) / RATE])
    points = np.column_stack([30.0 + np.repeat([0.0, moved_m], 20), np.full(40, 0.5)])
    detections = detections_at(time, points)
    detections.range_rate[:] = 0.0
    states = np.zeros((40, 6))
    states[:, :2] = detections.points
    motion = fit_motion(detections, np.arange(40), states)
    passes = Passes.of([], detections, Strips.of(road_of(1)))
    free = np.zeros(40, bool)
    found = split_at_drives(motion, detections, states, free, passes)
    assert len(found) == parts


@pytest.mark.parametrize(("driver_y", "parts"), [(0.5, 2), (40.0, 1)])
def test_who_is_silent_while_others_drive_over_its_place_has_left(driver_y, parts):
    time = np.concatenate([np.arange(20.0) / RATE, 13.0 + np.arange(20.0) / RATE])
    drives = 4.0 + np.arange(120.0) / RATE
    points = np.column_stack([np.full(40, 60.0), np.full(40, 0.5)])
    driver = np.column_stack([20.0 + 12.0 * (drives - 4.0), np.full(120, driver_y)])
    order = np.argsort(np.concatenate([time, drives]), kind="stable")
    detections = detections_at(
        np.concatenate([time, drives])[order], np.vstack([points, driver])[order]
    )
    moves = np.flatnonzero(order >= 40)
    detections.range_rate[:] = np.where(order >= 40, 12.0, 0.0)
    states = np.zeros((160, 6))
    states[:, :2], states[moves, 3] = detections.points, 12.0
    stays, other = (
        fit_motion(detections, rows, states) for rows in (np.flatnonzero(order < 40), moves)
    )
    passes = Passes.of([other], detections, Strips.of(road_of(1)))
    found = split_at_drives(stays, detections, states, np.zeros(160, bool), passes)
    assert len(found) == parts


def test_who_hides_others_is_numbered_as_the_parts_after_cuts(monkeypatch):
    """The first of two is cut, where it is elsewhere after ten silent seconds."""
    time = np.concatenate([np.arange(20.0) / RATE, 13.0 + np.arange(20.0) / RATE])
    points = np.column_stack([30.0 + np.repeat([0.0, 9.0], 20), np.full(40, 0.5)])
    later = 30.0 + np.arange(40.0) / RATE
    ahead = np.column_stack([60.0 + 10.0 * (later - 30.0), np.full(40, 0.5)])
    detections = detections_at(np.concatenate([time, later]), np.vstack([points, ahead]))
    states = np.zeros((80, 6))
    states[:, :2], states[40:, 3] = detections.points, 10.0
    motions = [fit_motion(detections, rows, states) for rows in (np.arange(40), np.arange(40, 80))]
    asked = []

    def record(number, motion, *given):
        asked.append((number, motion, given[-1].occluders))
        return motion

    monkeypatch.setattr(track_management, "with_rest", record)
    free = np.zeros(80, np.bool_)
    track_management.complete_tracks(detections, road_of(1), motions, states, free)
    assert len(asked) == 3
    for number, motion, occluders in asked:
        own = Occluders.of([motion])
        assert occluders.half[occluders.owner == number].tolist() == own.half.tolist()


def test_where_no_rate_is_known_nothing_stands():
    target = StationaryTarget(
        strip=0, rear_m=0.0, front_m=4.0, begin=0.0, end=9.0, rows=np.arange(60)
    )
    detections = detections_at(np.arange(60.0) / 6.0, np.tile([30.0, 0.0], (60, 1)))
    assert detected_parts(target, detections, 0.0) == []
    assert len(detected_parts(target, detections, 900.0)) == 1


def test_what_is_there_once_the_followers_have_gone_is_of_the_road():
    detections, drives = setting_off(fixed=True)  # until 60 s
    states = np.zeros((len(detections), 6))
    states[:, 0] = detections.points[:, 0]
    motion = fit_motion(detections, drives, states)
    free = detections.range_rate == 0.0
    seen = Detectability.learned(detections, [])
    follower = Occluders.stationary(1, (41.0, 50.0), 50.0, 0.0, 0.0, 4.5)
    seen = replace(seen, occluders=follower)
    rate = rate_without(0, motion, 0, detections, free, seen)
    assert rate == pytest.approx(5.0, rel=0.2)

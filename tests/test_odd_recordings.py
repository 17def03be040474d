"""Recordings that hold no traffic, other units or a clock of another rate: one line, right code."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from sites import START, recording
from streets import Street, errors

import gis_radar as gr

STREET = Street()
TRUE = STREET.pose()
GUESS = (TRUE.easting + 4.0, TRUE.northing - 3.0)


@cache
def passing(vehicles=40, frames=600):
    return STREET.detections(TRUE, vehicles=vehicles, frames=frames)


def localized(folder, time, points, rate, **options):
    path = recording(folder / "R1.parquet", time, points, range_rate=rate)
    return gr.localize(path, STREET.roads(), STREET.road_points(), guess=GUESS, **options)


def people(speeds, count=40, frames=900):
    """What a radar sees of people, or cars, that go up and down beside the lanes at some speeds."""
    rng = np.random.default_rng(1)
    time, points, rate = [], [], []
    for number in range(count):
        lane = np.array(STREET.lanes[number % len(STREET.lanes)])
        along = (lane[1] - lane[0]) / np.linalg.norm(lane[1] - lane[0])
        beside = np.array([-along[1], along[0]]) * rng.uniform(2.5, 4.5) * rng.choice([-1, 1])
        speed = rng.uniform(*speeds) * rng.choice([-1, 1])
        late = np.flatnonzero(rng.random(frames) < 0.5) * 0.05
        plan = lane[0] + np.outer(rng.uniform(10, 80) + speed * late, along) + beside
        plan += rng.normal(0.0, 0.2, plan.shape)
        place = np.column_stack([plan + STREET.middle, STREET.ground(plan) + 1.0])
        sight = place - TRUE.position
        toward = sight[:, :2] @ along / np.linalg.norm(sight, axis=1)
        time.append(START + late)
        points.append(TRUE.to_sensor(place))
        rate.append(speed * toward + rng.normal(0.0, 0.02, len(late)))
    order = np.argsort(np.concatenate(time), kind="stable")
    return tuple(np.concatenate(each)[order] for each in (time, points, rate))


@pytest.mark.parametrize(
    ("what", "made"),
    [
        ("walkers only", lambda: people((0.8, 1.8))),
        ("a parked car park", lambda: people((0.0, 0.0))),
        ("one vehicle", lambda: passing(vehicles=1)),
    ],
)
def test_without_traffic_there_is_no_answer(tmp_path, what, made):
    line = r"(?m)^R1: [0-4] moving vehicles in \d+ frames, at least 5 are needed$"
    with pytest.raises(gr.NoAnswerError, match=line) as refusal:
        localized(tmp_path, *made())
    assert refusal.value.exit_code == 4, what


def other_units():
    """Recordings in other units, and what the message names."""
    time, points, rate = passing()
    place = TRUE.to_map(points)
    turn = np.column_stack([place[:, :2] / 1e5, place[:, 2]]) - [0.0, 0.0, 370.0]
    yield "millimetres", time, points * 1000.0, rate
    yield "it looks like degrees", time, turn, rate


@pytest.mark.parametrize(("named", "time", "points", "rate"), list(other_units()))
def test_other_units_are_named(tmp_path, named, time, points, rate):
    with pytest.raises(gr.InputError, match=rf"R1\.parquet: [^\n]*{named}") as refusal:
        localized(tmp_path, time, points, rate, heading=TRUE.yaw)
    assert refusal.value.exit_code == 3
    assert "metres" in refusal.value.hint


@pytest.mark.parametrize("method", ["lane", "icp"])
@pytest.mark.parametrize(
    ("longer", "faster", "line", "advice"),
    [
        (
            3.28084,
            1.0,
            r"3\.28\d .* positions look like feet",
            "multiply x, y and z of all detections by 0.3048",
        ),
        (1.0 / 0.9144, 1.0, r"1\.09\d .* positions look like yards", "by 0.9144"),
        (
            1.05,
            1.0,
            r"1\.05\d \xb1 0\.0[01]\d times .* \(\d+ vehicles\): ranges are 5\.\d% too long, .*",
            "by 1.05",
        ),
        (1.0, 3.6, r"0\.27\d .* range rates look like km/h", "divide range_rate by 3.6"),
        (1.0, -1.0, r"-1\.00\d .* range rates look positive where targets approach", "the sign"),
    ],
)
def test_ranges_that_change_otherwise_than_stated_are_refused(
    tmp_path, method, longer, faster, line, advice
):
    time, points, rate = passing()
    with pytest.raises(gr.NoAnswerError, match=rf"(?m)^R1: ranges change {line}$") as refusal:
        localized(tmp_path, time, longer * points, faster * rate, heading=TRUE.yaw, method=method)
    assert refusal.value.exit_code == 4
    assert advice in refusal.value.hint


def test_signs_that_are_lost_are_named(tmp_path):
    time, points, rate = passing()
    with pytest.raises(gr.NoAnswerError, match="range rates look like absolute values"):
        localized(tmp_path, time, points, np.abs(rate), heading=TRUE.yaw)


def test_a_clock_that_runs_one_percent_slow_moves_no_pose(tmp_path):
    time, points, rate = passing()
    found = localized(tmp_path, START + 0.99 * (time - START), points, rate, heading=TRUE.yaw)
    assert (np.abs(errors(found.pose, TRUE)[:2]) < 0.3).all()

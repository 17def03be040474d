"""Clocks of two sensors, compared by traffic that a test drives past them."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from datasets import measured
from hypothesis import given
from hypothesis import strategies as st
from sites import EAST, NORTH, START, lane_quads, pose, recording, tiles_of

from gis_radar import read_clocks
from gis_radar.base import CrsError, InputError, NoAnswerError, UsageError, ranges
from gis_radar.calibration import SensorClock, measure_clocks
from gis_radar.calibration.timing.clock_offsets import (
    ClockOffset,
    NoCommonTrafficError,
    fine_offset,
    rough_offset,
    validate_offset,
)
from gis_radar.calibration.timing.clocks import adjust_network, best_linked, why_not_compared
from gis_radar.calibration.timing.lane_detections import LaneDetections

LENGTH_M = 4.4
SECONDS = 60


def street(count=240):
    """Two lanes of opposite directions, 120 m, between two sensors at their ends."""
    return tiles_of(
        [
            lane_quads(EAST + 10.0, NORTH - 1.8, 0.0, count=count),
            lane_quads(EAST + 130.0, NORTH + 1.8, 180.0, count=count),
        ],
        height_m=370.0,
    )


def looks():
    return [pose(), pose(sensor="R2", easting=EAST + 140.0, yaw=180.0)]


def vehicles(rng):
    """When each vehicle enters its lane, on which lane, its speed there, its acceleration."""
    count = SECONDS // 2
    enters = np.sort(rng.uniform(-20.0, SECONDS, count))
    return np.column_stack(
        [
            enters,
            rng.integers(0, 2, count),
            rng.uniform(5, 14, count),
            rng.uniform(-0.5, 0.5, count),
        ]
    )


def seen_by(sensor, traffic, rng):
    """Detections of the face that each vehicle turns to a sensor: time, points, range rate."""
    rows = []
    time = np.arange(0, SECONDS, 0.05) + rng.uniform(0, 0.05)
    eastern = sensor.easting > EAST + 50
    for at in time:
        age = at - traffic[:, 0]
        moved = traffic[:, 2] * age + traffic[:, 3] * age**2 / 2
        speed = traffic[:, 2] + traffic[:, 3] * age
        for i in np.flatnonzero((age > 0) & (moved > 0) & (moved < 120) & (speed > 2)):
            west = traffic[i, 1] == 1
            front = west == (not eastern)  # it comes towards the sensor
            s = moved[i] + (LENGTH_M / 2 if front else -LENGTH_M / 2) + rng.normal(0, 0.2)
            x = EAST + (130.0 - s if west else 10.0 + s)
            place = np.array([[x, NORTH + (1.8 if west else -1.8), 370.8]])
            velocity = np.array([-speed[i] if west else speed[i], 0.0, 0.0])
            sight = place[0] - sensor.position
            rate = velocity @ sight / np.linalg.norm(sight) + rng.normal(0, 0.05)
            rows.append([at, *sensor.to_sensor(place)[0], rate])
    return np.array(rows)


@cache
def driven():
    """What both sensors see of one minute, at the true times."""
    rng = np.random.default_rng(7)
    traffic = vehicles(rng)
    return [seen_by(sensor, traffic, rng) for sensor in looks()]


def recorded(path, rows, ahead_s=0.0):
    time = START + rows[:, 0] + ahead_s
    return recording(path, time, rows[:, 1:4], range_rate=np.float32(rows[:, 4]))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Give a function that records a minute of the same street by both sensors."""
    folder = tmp_path_factory.mktemp("drive")

    def record(name, ahead_s=0.0):
        one, other = driven()
        return [
            recorded(folder / f"{name}-1.parquet", one),
            recorded(folder / f"{name}-2.parquet", other, ahead_s),
        ]

    return record


@pytest.mark.parametrize("ahead_s", [0.012, 17.3, -1_699_999_000.0])
def test_offsets_from_milliseconds_to_time_since_boot(drive, ahead_s):
    """One sensor sees fronts where the other sees rears: no bias of a vehicle's length."""
    found = measure_clocks(drive("a", ahead_s), looks(), street())
    clock = found.clocks["R2"]
    assert found.reference == "R1"
    assert clock.sigma_s < 0.06
    assert abs(clock.offset_s - ahead_s) < min(3.0 * clock.sigma_s, 0.1)


def drifting(path, drift, ahead_s=0.2):
    """What the second sensor sees of that minute, by a clock that runs fast by `drift`."""
    rows = driven()[1]
    return recorded(path, rows, ahead_s + drift * (rows[:, 0] - SECONDS / 2))


@pytest.mark.parametrize("drift", [-0.008, 0.005])
def test_a_clock_that_runs_slow_by_a_percent_has_that_rate(drive, tmp_path, drift):
    slow = drifting(tmp_path / "slow.parquet", drift)
    clock = measure_clocks([drive("a")[0], slow], looks(), street()).clocks["R2"]
    assert abs(clock.drift_ppm - drift * 1e6) < 3.0 * clock.drift_sigma_ppm < 3000
    middle = START + SECONDS / 2
    assert abs(clock.corrected(np.array([middle + 0.2]))[0] - middle) < 0.05


def test_a_rate_of_no_clock_is_refused(drive, tmp_path):
    odd = drifting(tmp_path / "odd.parquet", -0.015)
    with pytest.raises(NoAnswerError, match=r"R1 and R2: their clocks run apart by 1\.[3-7]%"):
        measure_clocks([drive("a")[0], odd], looks(), street())


def test_traffic_that_they_do_not_share_gives_no_offset(drive, tmp_path):
    one, _ = drive("a")
    rng = np.random.default_rng(8)
    other = recorded(tmp_path / "b.parquet", seen_by(looks()[1], vehicles(rng), rng))
    with pytest.raises(NoAnswerError, match="R1 and R2: "):
        measure_clocks([one, other], looks(), street())


def test_sensors_that_see_different_roads_give_no_offset(drive):
    turned = [looks()[0], pose(sensor="R2", easting=EAST + 5000.0, yaw=180.0)]
    with pytest.raises(NoAnswerError, match="no common traffic"):
        measure_clocks(drive("a"), turned, street())


def test_the_reason_given_is_that_of_a_pair_with_common_traffic():
    nothing = NoCommonTrafficError("in whatever words")
    reasons = {("R1", "R3"): nothing, ("R2", "R3"): NoAnswerError("too few"), ("R1", "R2"): nothing}
    assert why_not_compared("R3", reasons) == "with R2: too few"
    assert why_not_compared("R1", reasons) == "with R3: in whatever words"


def test_what_is_asked_wrongly(drive):
    one, other = drive("a")
    with pytest.raises(UsageError, match="two sensors"):
        measure_clocks([one, one], [pose(), pose()], street())
    with pytest.raises(UsageError, match="there is no R7"):
        measure_clocks([one, other], looks(), street(), reference="R7")
    with pytest.raises(UsageError, match="2 recordings, but 1 poses"):
        measure_clocks([one, other], looks()[:1], street())
    apart = [looks()[0], pose(sensor="R2", crs="EPSG:25833")]
    with pytest.raises(CrsError, match="of R2 is in EPSG:25833, but the tiles in EPSG:25832"):
        measure_clocks([one, other], apart, street())


def test_corrected_hits_are_those_of_right_clocks(drive, tmp_path):
    """The file of clocks, applied: steps within one of those with clocks that never were off."""
    wrong = drive("b", 3600.25)
    found = measure_clocks(wrong, looks(), street())
    found.write(tmp_path / "clocks.json")
    clocks = read_clocks(tmp_path / "clocks.json")
    fixed = measured(wrong, looks(), street(), tmp_path / "fixed", clocks=clocks)
    right = measured(drive("a"), looks(), street(), tmp_path / "right")
    for sensor in ("R1", "R2"):
        one, other = (each.frame_steps(sensor) for each in (fixed, right))
        assert abs(one.first[0] - other.first[0]) <= 2
        assert abs(one.last[-1] - other.last[-1]) <= 2
    offsets = fixed.recordings().set_index("sensor")["clock_offset"]
    assert offsets["R2"] == clocks["R2"].offset_s


@given(
    ahead=st.lists(st.floats(-4000, 4000), min_size=3, max_size=5),
    drift=st.lists(st.floats(-900, 900), min_size=5, max_size=5),
    late=st.lists(st.floats(0, 3000), min_size=10, max_size=10),
)
def test_a_network_of_exact_pairs_is_adjusted_exactly(ahead, drift, late):
    """Pairs compared at different times, clocks that run at different speeds."""
    names = [f"R{i}" for i in range(len(ahead))]
    drift = [1e-6 * ppm for ppm in drift[: len(names)]]
    edges = {}
    for i, one in enumerate(names):
        for j, other in enumerate(names[i + 1 :], start=i + 1):
            at = late[(i + j) % 10]  # by the clock that is right
            offset = [ahead[k] + drift[k] * at for k in (i, j)]
            edges[one, other] = ClockOffset(
                offset_s=offset[1] - offset[0], sigma_s=1e-3, drift=drift[j] - drift[i],
                drift_sigma=1e-9, at=START + at + offset[1], vehicles=9,
            )  # fmt: skip
    clocks, _ = adjust_network(edges, "R0")
    for k, name in enumerate(names):
        true = START + np.array([0.0, 1500.0, 3000.0])
        stamped = true + ahead[k] + drift[k] * (true - START)
        reference = true + ahead[0] + drift[0] * (true - START)
        close = clocks[name].corrected(stamped) - reference
        assert np.abs(close).max() < 0.02  # what drifts do within the offsets themselves


def passages(rng, seconds, ahead_s, drift, side):
    """Detections of an hour of vehicles on a lane, straight from their motion."""
    count = seconds // 6
    enters = np.random.default_rng(3).uniform(0, seconds, count)
    speed = np.random.default_rng(4).uniform(5, 15, count)
    age = np.sort(rng.uniform(0, 7, (count, 40)), axis=1)
    s_m = speed[:, None] * age
    time = (enters[:, None] + age).ravel()
    order = np.argsort(time)
    return LaneDetections(
        time=START + time[order] + ahead_s + drift * (time[order] - seconds / 2),
        lanelet=np.zeros(len(order), np.int64),
        s_m=s_m.ravel()[order] - 2.0 * side + rng.normal(0, 0.5, len(order)),
        speed=np.repeat(speed, 40)[order] + rng.normal(0, 0.05, len(order)),
        side=np.full(len(order), float(side)),
    )


def test_a_cell_full_of_traffic_takes_no_more_memory(monkeypatch):
    """In a jam before one sensor, a few cells hold most pairs."""
    rng, taken = np.random.default_rng(6), list[int]()
    one, other = (passages(rng, 1800, 0.0, 0.0, side) for side in (1, -1))
    jam = one.take(np.flatnonzero(one.s_m > 20.0))
    jams = [replace(jam, s_m=jam.s_m % 2.0, speed=jam.speed % 1.0 + 1.5)] * 2
    one, other = (
        LaneDetections.joined(list(pair)) for pair in zip((one, other), jams, strict=True)
    )
    one, other = (each.take(np.argsort(each.time, kind="stable")) for each in (one, other))
    usual = rough_offset(one, other)
    module = "gis_radar.calibration.timing.clock_offsets"
    monkeypatch.setattr(f"{module}._PAIRS_AT_ONCE", 100_000)
    monkeypatch.setattr(
        f"{module}.ranges", lambda *given: taken.append(given[1].sum()) or ranges(*given)
    )
    assert rough_offset(one, other) == usual
    assert len(taken) > 10
    assert max(taken) < 110_000


def test_an_hour_gives_the_drift():
    rng = np.random.default_rng(5)
    one, other = (passages(rng, 3600, *late) for late in ((0.0, 0.0, 1), (5.0, 80e-6, -1)))
    found = fine_offset(one, other, rough_offset(one, other))
    assert found.drift_sigma < 15e-6
    assert abs(found.drift - 80e-6) < 3 * found.drift_sigma
    assert abs(found.offset_s - 5.0 - 80e-6 * (found.at - START - 1805)) < 3 * found.sigma_s
    validate_offset(one, other, found.offset_s)
    with pytest.raises(NoAnswerError, match=r"same vehicles|other lags"):
        validate_offset(one, other, found.offset_s + 40.0)


@pytest.mark.parametrize(
    ("step", "limit"),
    [
        (rough_offset, {"ROUGH_PAIRS": 10**6}),
        (fine_offset, {"_LEAST_VEHICLES": 10**6}),
        (validate_offset, {"_LEAST_SHARE": 1.01}),
    ],
)
def test_each_step_refuses_by_its_limit(step, limit, monkeypatch):
    rng = np.random.default_rng(5)
    one, other = (passages(rng, 300, 0.0, 0.0, side) for side in (1, -1))
    given = (one, other) if step is rough_offset else (one, other, 0.0)
    step(*given)
    for name, value in limit.items():
        monkeypatch.setattr(f"gis_radar.calibration.timing.clock_offsets.{name}", value)
    with pytest.raises(NoAnswerError):
        step(*given)


def test_the_best_linked_clock_is_the_reference():
    offset = ClockOffset(
        offset_s=1.0, sigma_s=0.1, drift=0.0, drift_sigma=1e-4, at=START, vehicles=9
    )
    assert best_linked({("R2", "R3"): offset}, ["R1", "R2", "R3"]) == "R2"
    assert best_linked({}, ["R1", "R2"]) == "R1"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", "not a file of clocks"),
        ("{", "not a file of clocks"),
        ('{"clocks": {"R1": {}}}', "R1: lacks offset_s"),
        ('{"clocks": {"R1": {"offset_s": "1"}}}', "offset_s is '1'"),
        ('{"clocks": {"R1": {"offset_s": 1, "drift_ppm": 5}}}', "time `at`"),
        ('{"clocks": {"R1": {"offset_s": 1, "drift_ppm": 1e9, "at": "2026-01-01T00:00Z"}}}', "ppm"),
        ('{"clocks": {"R1": {"offset_s": NaN}}}', "offset is nan"),
    ],
)
def test_files_that_are_no_clocks(tmp_path, text, said):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=said):
        read_clocks(tmp_path / "c.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_clocks(tmp_path / "gone.json")


def test_a_written_clock_is_read_back(tmp_path):
    clock = SensorClock(offset_s=-0.25, drift_ppm=12.0, at=START)
    (tmp_path / "c.json").write_text(json.dumps({"clocks": {"R2": clock.as_dict()}}))
    again = read_clocks(tmp_path / "c.json")["R2"]
    time = START + np.arange(3) * 1e5
    assert (again.corrected(time) == clock.corrected(time)).all()
    assert (clock.corrected(time[:1]) == START + 0.25).all()

"""What speaks for vehicles: detections that are due, heights, and the scatterers of a body."""

import numpy as np
import pytest

from gis_radar.lanelets.graph import LaneGraph
from gis_radar.vehicles.detectability import Detectability, Occluders
from gis_radar.vehicles.doubles import distinct_stands, join_tall
from gis_radar.vehicles.echoes import Echoes
from gis_radar.vehicles.forward import ForwardFilter
from gis_radar.vehicles.life_settings import (
    DetectabilitySettings,
    LifeSettings,
    StandingSettings,
    TallSettings,
)
from gis_radar.vehicles.lives import _as_strong
from gis_radar.vehicles.motion import Motion, Path
from gis_radar.vehicles.resting import unbroken
from gis_radar.vehicles.settings import ForwardSettings, MotionSettings, VehicleSettings
from gis_radar.vehicles.size import size_of
from gis_radar.vehicles.standing import Stand, not_built
from gis_radar.vehicles.strips import Strips
from gis_radar.vehicles.sweeps import Sweeps
from gis_radar.vehicles.tall import tall_odds

BEGIN = 1_700_000_000.0
RATE = 20


def echoes_at(time, points, height_m=0.7):
    away = np.hypot(points[:, 0], points[:, 1])
    return Echoes(
        time=time,
        points=points,
        height_m=np.full(len(time), height_m),
        range_rate=np.full(len(time), 10.0),
        sight=points / away[:, None],
        range_m=away,
        sensor=np.zeros(len(time), np.int64),
        rcs=np.zeros(len(time)),
    )


def driven(begin, seconds, speed, rows):
    """A vehicle along the line y = 30 m from x = 0, seen from the origin at each of its steps."""
    count = int(seconds * RATE)
    s = 10.0 + speed / RATE * np.arange(count)
    return Motion(
        rows=rows,
        path=Path(np.column_stack([np.arange(-10.0, 200.0), np.full(210, 30.0)])),
        first_step=round(begin * RATE),
        s_m=s,
        speed=np.full(count, speed),
        var_s=np.ones(count),
        length_m=4.5,
        width_m=1.8,
        length_sigma_m=0.5,
        p_heavy=0.0,
        along_m=np.zeros(count),
        left_m=np.zeros(count),
    )


@pytest.fixture(name="learned", scope="module")
def learned_from_two_passages():
    count = 10 * RATE
    time = np.concatenate([BEGIN + np.arange(count) / RATE, BEGIN + 60.0 + np.arange(count) / RATE])
    x = np.tile(10.0 / RATE * np.arange(count), 2)
    echoes = echoes_at(time, np.column_stack([x, np.full(len(x), 30.0)]))
    motions = [
        driven(BEGIN, 10.0, 10.0, np.arange(count)),
        driven(BEGIN + 60.0, 10.0, 10.0, count + np.arange(count)),
    ]
    return Detectability.learned(echoes, motions, DetectabilitySettings())


def halves(begin, seconds):
    return int(2 * begin) + np.arange(int(2 * seconds))


def test_a_vehicle_is_due_as_often_as_others_that_drove_there(learned):
    places = np.tile([50.0, 30.0], (8, 1))
    assert learned.due(places, halves(BEGIN, 4.0), (0, -1)) == pytest.approx(80.0, rel=0.2)


def test_nothing_is_due_where_nobody_drove(learned):
    places = np.tile([50.0, 90.0], (8, 1))
    assert learned.due(places, halves(BEGIN, 4.0), (0, -1)) == 0.0


def test_nothing_is_due_while_the_sensor_is_off(learned):
    places = np.tile([50.0, 30.0], (8, 1))
    assert learned.due(places, halves(BEGIN + 30.0, 4.0), (-1, -1)) == 0.0


def test_nothing_is_due_behind_another_vehicle(learned):
    in_the_way = Occluders.standing(
        7, (BEGIN, BEGIN + 10.0), 25.0, 15.0, np.arctan2(30.0, 50.0), 4.5
    )
    hidden = Detectability(**{**vars(learned), "occluders": in_the_way})
    places = np.tile([50.0, 30.0], (8, 1))
    assert hidden.due(places, halves(BEGIN, 4.0), (0, -1)) == 0.0
    assert hidden.due(places, halves(BEGIN, 4.0), (7, -1)) > 40.0
    aside = np.tile([80.0, 30.0], (8, 1))
    assert hidden.due(aside, halves(BEGIN, 4.0), (0, -1)) > 40.0


def test_too_short_a_silence_is_none(learned):
    places = np.array([[50.0, 30.0], [51.0, 30.0]])
    assert learned.due_between(places, (BEGIN + 1.0, BEGIN + 1.4), (0, -1)) == 0.0
    assert learned.due_between(places, (BEGIN + 1.0, BEGIN + 6.0), (0, -1)) > 40.0


def ends_from(cos):
    sin = np.sqrt(1.0 - cos**2)
    return np.column_stack([-np.sign(cos), np.abs(cos), sin])


@pytest.mark.parametrize("length", [4.5, 8.5, 12.0, 16.5])
@pytest.mark.parametrize("often", [5, 400])
def test_a_length_is_found_however_often_the_front_returns(length, often):
    places = np.linspace(-length / 2 + 0.2, length / 2 - 0.2, int(length / 0.5))
    along = np.concatenate([np.repeat(places, 8), np.full(often, length / 2)])
    time = np.concatenate([np.tile(np.arange(8.0), len(places)), np.linspace(0, 8, often)])
    cos = np.full(len(along), -0.95)
    size, ahead = size_of(
        along, ends_from(cos), np.full(len(along), 0.3), time, np.ones(len(along)), MotionSettings()
    )
    assert size.length_m == pytest.approx(length, abs=0.8)
    assert ahead == pytest.approx(0.0, abs=0.5)


def test_seen_from_one_end_only_a_length_is_that_of_a_car():
    along = np.full(400, 2.2)
    size, _ = size_of(
        along, ends_from(np.full(400, -1.0)), np.full(400, 0.3), np.linspace(0, 20, 400),
        np.ones(400), MotionSettings(),
    )  # fmt: skip
    assert size.length_m == pytest.approx(4.5, abs=0.5)
    assert size.sigma_m > 1.0


def test_what_passes_by_makes_no_longer():
    along = np.concatenate([np.repeat(np.linspace(-2.0, 2.0, 9), 10), [-9.0, -8.0, -7.0, -6.0]])
    time = np.concatenate([np.tile(np.arange(10.0), 9), [4.0, 4.1, 4.2, 4.3]])
    cos = np.full(len(along), -0.9)
    size, _ = size_of(
        along, ends_from(cos), np.full(len(along), 0.3), time, np.ones(len(along)), MotionSettings()
    )
    assert size.length_m < 6.0


def test_nothing_to_trust_is_a_car():
    none = np.zeros(3)
    size, ahead = size_of(none, ends_from(none + 0.5), none + 0.3, none, none, MotionSettings())
    assert (size.length_m, ahead) == (4.5, 0.0)


def test_heights_tell_lorries_from_cars_when_they_are_near():
    settings = TallSettings()
    near, far = np.full(200, 30.0), np.full(200, 180.0)
    assert tall_odds(np.full(200, 1.8), near, settings) > 2.0
    assert tall_odds(np.full(200, 0.7), near, settings) < -1.0
    assert abs(tall_odds(np.full(200, 1.8), far, settings)) < 1.0
    assert tall_odds(np.full(200, np.nan), near, settings) == 0.0
    assert tall_odds(np.full(3, 1.8), near[:3], settings) == 0.0


def stand(rear, front, rows, begin=0.0, end=30.0):
    return Stand(strip=1, rear_m=rear, front_m=front, begin=begin, end=end, rows=rows)


@pytest.mark.parametrize(
    ("height", "second", "count"),
    [
        (2.0, (7.0, 11.5), 1),  # both ends of a lorry
        (0.7, (7.0, 11.5), 2),  # two cars
        (2.0, (16.0, 24.0), 2),  # two lorries
    ],
)
def test_two_tall_neighbours_are_one_lorry(height, second, count):
    points = np.tile([30.0, 0.0], (200, 1))
    echoes = echoes_at(BEGIN + np.arange(200.0) / 10, points, height)
    pair = [stand(0.0, 4.5, np.arange(100)), stand(*second, np.arange(100, 200))]
    joined = join_tall(pair, echoes, TallSettings())
    assert len(joined) == count
    if count == 1:
        assert (joined[0].rear_m, joined[0].front_m) == (0.0, 11.5)
        assert len(joined[0].rows) == 200


def test_lorries_that_stand_one_after_the_other_are_two():
    echoes = echoes_at(BEGIN + np.arange(200.0) / 10, np.tile([30.0, 0.0], (200, 1)), 2.0)
    pair = [
        stand(0.0, 4.5, np.arange(100), 0.0, 10.0),
        stand(7.0, 11.5, np.arange(100, 200), 9.0, 20.0),
    ]
    assert len(join_tall(pair, echoes, TallSettings())) == 2


def test_who_stands_on_does_so_until_a_silence():
    time = np.array([0.0, 2.0, 40.0, 45.0, 50.0, 52.0, 58.0, 90.0])
    kept = unbroken(time, (46.0, 51.0), 10.0)
    assert time[kept].tolist() == [40.0, 45.0, 50.0, 52.0, 58.0]
    assert time[unbroken(time, (100.0, 101.0), 5.0)].tolist() == []


def road_of(lanes):
    """Return so many lanelets beside each other, 0.3 m apart, along x."""
    s = np.arange(201.0)
    points = [np.column_stack([s, np.full(201, 0.3 * k), np.zeros(201)]) for k in range(lanes)]
    return LaneGraph(
        lanelet_id=np.arange(lanes) + 1,
        length_m=np.full(lanes, 200.0),
        first=np.arange(lanes + 1) * 201,
        points=np.vstack(points),
        s_m=np.tile(s, lanes),
        heading=np.zeros(201 * lanes),
        half_width_m=np.full(201 * lanes, 1.75),
        two_way=np.zeros(lanes, bool),
        successors=[np.zeros(0, np.int64)] * lanes,
        origin=np.zeros(2),
    )


@pytest.mark.parametrize("lanes", [1, 2, 3])
def test_a_detection_on_lanes_that_overlap_counts_once_for_a_new_vehicle(lanes):
    x = 50.0 + 0.5 * np.arange(3.0)
    echoes = echoes_at(0.05 * np.arange(3.0), np.column_stack([x, np.zeros(3)]))
    two, _ = ForwardFilter(road_of(lanes), ForwardSettings()).push(echoes.take(slice(0, 2)))
    three, _ = ForwardFilter(road_of(lanes), ForwardSettings()).push(echoes)
    assert two.tolist() == [-1, -1]
    assert three.tolist() == [0, 0, 0]


def stopping_at(*stops):
    """Return a vehicle along x that stands for 20 s at each of some places."""
    parts = [np.full(400, float(stop)) for stop in stops]
    for k in range(len(stops) - 1, 0, -1):
        parts.insert(k, np.linspace(stops[k - 1], stops[k], 140))
    s = np.concatenate(parts)
    return Motion(
        rows=np.arange(10),
        path=Path(np.column_stack([np.arange(301.0), np.zeros(301)])),
        first_step=0,
        s_m=s,
        speed=np.append(np.diff(s) * RATE, 0.0),
        var_s=np.ones(len(s)),
        length_m=4.5,
        width_m=1.8,
        length_sigma_m=0.5,
        p_heavy=0.0,
        along_m=np.zeros(10),
        left_m=np.zeros(10),
    )


@pytest.mark.parametrize("stops", [(50,), (50, 120), (120, 50)])
def test_what_lies_on_a_vehicle_at_one_of_its_stops_is_that_one(stops):
    begin = 27.0 * stops.index(50)
    on_it = stand(47.7, 52.3, np.arange(5), begin + 1.0, begin + 19.0)
    beside = stand(67.7, 72.3, np.arange(5), begin + 1.0, begin + 19.0)
    places = [(np.array([50.0, 0.0]), 0.0), (np.array([70.0, 0.0]), 0.0)]
    assert distinct_stands([on_it, beside], places, [stopping_at(*stops)], LifeSettings()) == [1]


@pytest.mark.parametrize("unknown", [0, 1, 9])
def test_a_weak_return_is_refused_though_some_cross_sections_are_unknown(unknown):
    echoes = echoes_at(np.arange(20.0) / RATE, np.tile([30.0, 0.0], (20, 1)))
    echoes.rcs[:] = np.repeat([10.0, -20.0], 10)
    echoes.rcs[:unknown] = np.nan
    weak, strong = stand(0.0, 4.0, np.arange(10, 20)), stand(0.0, 4.0, np.arange(10))
    fast = driven(0.0, 2.0, 10.0, np.arange(10))
    assert _as_strong([weak, strong], echoes, [fast], VehicleSettings()) == [strong]


@pytest.mark.parametrize("through", [True, False])
def test_what_is_seen_while_others_drive_over_it_holds_no_vehicle(through):
    graph = road_of(1)
    time = np.arange(0.0, 60.0, 0.1)
    echoes = echoes_at(time, np.tile([100.0, 0.0], (len(time), 1)))
    path = Path(np.column_stack([np.arange(201.0), np.full(201, 0.0 if through else 30.0)]))
    count = 20 * RATE
    drivers = [
        Motion(
            rows=np.arange(len(time)), path=path, first_step=begin * RATE,
            s_m=10.0 / RATE * np.arange(count), speed=np.full(count, 10.0), var_s=np.ones(count),
            length_m=4.5, width_m=1.8, length_sigma_m=0.5, p_heavy=0.0,
            along_m=np.zeros(len(time)), left_m=np.zeros(len(time)),
        )
        for begin in (0, 20, 40)
    ]  # fmt: skip
    sweeps = Sweeps.of(drivers, echoes, Strips.of(graph), StandingSettings())
    left = not_built(echoes, np.ones(len(time), bool), sweeps, StandingSettings())
    assert left.all() != through
    assert left.any() != through

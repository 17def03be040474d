"""Tracking: sensors that stand, are knocked, shake or see nothing, with the truth known."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from maps import Listener
from scipy.stats import ttest_1samp
from sites import START, lane_quads, recording, tiles_of
from streets import STRAIGHT, Street, errors

import gis_radar as gr
from gis_radar.base import (
    CrsError,
    InputError,
    NoAnswerError,
    OutputError,
    seconds_from_iso,
)
from gis_radar.calibration import Follower, WindowFitter, start_estimate, track
from gis_radar.calibration.monitoring import monitor
from gis_radar.calibration.monitoring.kalman_filter import KNOCK as BLOW
from gis_radar.calibration.monitoring.kalman_filter import Measurement
from gis_radar.calibration.monitoring.monitor import BY_HAND
from gis_radar.calibration.monitoring.moves import AGREEMENT, agreement
from gis_radar.calibration.monitoring.windows import WindowTraffic
from gis_radar.calibration.registration.traces import Moving
from gis_radar.cli import group
from gis_radar.poses import read_track

STREET = Street()
FRAMES, VEHICLES = 2000, 140  # 100 s
NAMES = ("easting", "northing", "height", "roll", "pitch", "yaw")
SIGMA = dict(zip(NAMES, (0.15, 0.15, 0.15, 0.2, 0.2, 0.15), strict=True))
KNOCK = dict(zip(NAMES, (0.2, -0.2, 0.0, 0.0, 0.3, 1.0), strict=True))


@pytest.fixture(scope="module")
def seen():
    """Time, points and range rates of 100 s of traffic, in the map's frame, and the true pose."""
    pose = STREET.pose()
    time, points, rate = STREET.detections(pose, vehicles=VEHICLES, frames=FRAMES)
    return time, pose.to_map(points), rate, pose


def knocked(pose, by=KNOCK, times=1.0):
    return replace(pose, **{name: getattr(pose, name) + times * by[name] for name in by})


def record(path, seen, poses=(), until=FRAMES * 0.05, keep=None):
    """Write what a sensor sees whose pose is changed: [(from, to, pose)], seconds."""
    time, points, rate, true = seen
    inside = time < START + until
    if keep is not None:
        inside &= keep(time - START)
    time, points, rate = time[inside], points[inside], rate[inside]
    xyz = true.to_sensor(points)
    for begin, end, pose in poses:
        moved = (time >= START + begin) & (time < START + end)
        xyz[moved] = pose.to_sensor(points[moved])
    frames = START + np.arange(round(until / 0.05)) * 0.05
    every = np.concatenate([time, frames])
    order = np.argsort(every, kind="stable")
    xyz = np.vstack([xyz, np.tile([20.0, 5.0, -3.0], (len(frames), 1))])[order]
    rate = np.concatenate([rate, np.zeros(len(frames))])[order]
    return recording(path, every[order], xyz, range_rate=rate)


def start(pose, sigma=SIGMA, **changes):
    shifted = {name: getattr(pose, name) + change for name, change in changes.items()}
    return replace(pose, **shifted, evidence={"sigma": dict(sigma)})


def follow(path, pose, street=STREET, **options):
    return track(path, street.roads(), street.road_points(), pose, **options)


def nees(pose, true):
    gap = errors(pose, true)
    gap[3:] = np.radians(gap[3:])
    return float(gap @ np.linalg.solve(np.array(pose.evidence["covariance"]), gap))


def times(found, kind):
    return [seconds_from_iso(e.time, what="event") - START for e in found.events if e.kind == kind]


@pytest.fixture(scope="module")
def still(seen, once):
    def standing(folder):
        path = record(folder / "R1.parquet", seen)
        heard = Listener()
        begin = start(seen[3], easting=0.12, northing=-0.1, yaw=0.15, pitch=-0.2)
        return follow(path, begin, reporter=heard), heard, begin, path

    return once("still", standing)


def test_a_pose_is_corrected_every_five_seconds(still, seen):
    found, heard, begin, _ = still
    poses, since = found.poses.poses, found.poses.since
    assert np.allclose(np.diff(since), 5.0)
    assert len(poses) == 21
    assert np.allclose(poses[0].position, begin.position)
    assert found.events == ()
    assert np.abs(errors(poses[-1], seen[3]))[:3].max() < 0.25
    assert np.abs(errors(poses[-1], seen[3]))[3:].max() < 0.3
    assert np.median([nees(pose, seen[3]) for pose in poses]) < 12.6  # chi2(6) at 95 %
    assert poses[-1].evidence["sigma"]["yaw"] < begin.evidence["sigma"]["yaw"]
    assert poses[-1].view == begin.view
    assert heard.stages[-1][1] == heard.stages[-1][2]
    assert found.figures()["corrected"] >= 18


def test_windows_that_overlap_do_not_count_twice(still):
    found, *_ = still
    sigma = np.array([[p.evidence["sigma"][n] for n in NAMES] for p in found.poses.poses])
    # twenty windows of which each shares 95 % with the last are worth about one
    assert (sigma[-1] > 0.5 * sigma[10]).all()


def test_what_a_window_tells_of_reflections_fixes_the_height(still, seen):
    """Without it the height is no better known than that of reflections, 0.25 m."""
    last = still[0].poses.poses[-1]
    assert last.evidence["sigma"]["height"] < 0.13
    assert abs(errors(last, seen[3])[2]) < 0.2


def test_a_fit_that_came_to_no_rest_contradicts_nothing(seen, tmp_path, monkeypatch):
    path = record(tmp_path / "R1.parquet", seen, until=60.0)
    fit, count = WindowFitter.fit, []

    def restless(self, traffic, centre, reflection_m, **options):
        found = fit(self, traffic, centre, reflection_m, **options)
        if found is not None and "near" in options:
            count.append(found)
            found = replace(found, fit=replace(found.fit, converged=False))
        return found

    monkeypatch.setattr(WindowFitter, "fit", restless)
    assert times(follow(path, start(seen[3])), "rejected") == []
    assert count


def test_a_track_is_written_and_read(still, tmp_path):
    found, *_ = still
    found.poses.write(tmp_path / "track.csv")
    again = read_track(tmp_path / "track.csv")
    assert np.allclose(again.since, found.poses.since, atol=1e-6)
    for here, there in zip(found.poses.poses, again.poses, strict=True):
        assert np.abs(errors(here, there)).max() < 1e-5
        assert here.evidence["sigma"] == pytest.approx(there.evidence["sigma"], abs=1e-5)
        assert here.view == there.view
    with (tmp_path / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["time"] == "2023-11-14T22:13:20Z"
    quaternions = np.array([[float(row[f"quaternion_{axis}"]) for axis in "xyzw"] for row in rows])
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-8)
    assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.99).all()
    assert {row["event"] for row in rows} == {""}


def test_the_sign_of_the_quaternion_does_not_jump(still, tmp_path):
    poses = [replace(still[0].poses.poses[0], yaw=yaw) for yaw in (179.9, -179.9)]
    gr.PoseTrack(poses=tuple(poses), since=np.array([1.7e9, 1.7e9 + 5])).write(
                tmp_path / "track.csv")  # fmt: skip
    with (tmp_path / "track.csv").open() as file:
        first, second = list(csv.DictReader(file))
    both = np.array(
        [[float(row[f"quaternion_{axis}"]) for axis in "xyzw"] for row in (first, second)]
    )
    assert both[0] @ both[1] > 0.99
    assert [pose.yaw for pose in read_track(tmp_path / "track.csv").poses] == [179.9, -179.9]


@pytest.fixture(scope="module")
def moved(seen, once):
    def knocked_at_62_s(folder):
        after = knocked(seen[3])
        path = record(folder / "R1.parquet", seen, [(62.0, np.inf, after)])
        return follow(path, start(seen[3])), after, path

    return once("moved", knocked_at_62_s)


def test_a_knock_is_told_with_its_time(moved, seen):
    found, after, _ = moved
    assert times(found, "moved") == [pytest.approx(62.0, abs=2.0)]
    at = found.poses.at(START + np.array([55.0, 66.0, 99.0]))
    before, soon, last = (found.poses.poses[i] for i in at)
    assert abs(errors(before, seen[3])[5]) < 0.2
    for pose in (soon, last):
        assert np.abs(errors(pose, after)[:2]).max() < 0.3
        assert abs(errors(pose, after)[5]) < 0.3
        assert nees(pose, after) < 22.5  # chi2(6) at 99.9 %
    # begun anew: less is known than before, and the more the longer it lasts
    sigma = [p.evidence["sigma"]["yaw"] for p in (before, soon, last)]
    assert sigma[1] > sigma[0]
    assert sigma[2] < sigma[1]
    assert (np.diff(found.poses.since) > 0).all()


def test_a_move_of_half_a_metre_is_told(seen, tmp_path):
    after = knocked(seen[3], {"easting": 0.5})
    path = record(tmp_path / "R1.parquet", seen, [(35.0, np.inf, after)], until=60.0)
    found = follow(path, start(seen[3]))
    assert times(found, "moved") == [pytest.approx(35.0, abs=2.0)]
    last = found.poses.poses[-1]
    assert np.abs(errors(last, after)[:2]).max() < 0.25
    assert abs(errors(last, after)[5]) < 0.3
    assert nees(last, after) < 22.5  # chi2(6) at 99.9 %


def test_hits_uses_the_corrected_poses(moved, seen, tmp_path):
    """What stands at a place of the map after the knock falls on its tile by the track alone."""
    found, after, _ = moved
    found.poses.write(tmp_path / "track.csv")
    seen[3].write(tmp_path / "fixed.json")
    target = STREET.placed([[60.0, -1.75]])[0]
    spot = np.array([*target, float(STREET.ground([60.0, -1.75])) + 0.5])
    moments = START + 70.0 + np.arange(400) * 0.05
    points = np.tile(after.to_sensor(spot[None]), (400, 1))
    path = recording(tmp_path / "late.parquet", moments, points)
    quads = np.concatenate([lane_quads(*(target - [5.0, w]), 0.0, count=20, width_m=0.5)
                            for w in np.arange(-2.0, 2.5, 0.5)])  # fmt: skip
    tiles = tiles_of([quads], height_m=370.0)
    problems = tiles.iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    gr.write_tiles(tiles, tmp_path / "tiles.gpkg", problems=problems)
    off = {}
    for pose in ("track.csv", "fixed.json"):
        words = ["measure", str(path), "--hits-only", "--pose", str(tmp_path / pose), "--tiles",
                 str(tmp_path / "tiles.gpkg"), "-o", str(tmp_path / f"occ_{pose}")]  # fmt: skip
        done = CliRunner().invoke(group, words, catch_exceptions=False)
        assert done.exit_code == 0
        tile = gr.open_dataset(tmp_path / f"occ_{pose}").hits()["tile_id"].unique()
        centres = tiles.geometry.centroid[tile]
        off[pose] = max(np.hypot(centres.x - target[0], centres.y - target[1]))
    assert off["track.csv"] < 0.75
    assert off["fixed.json"] > 1.0


def watched(begin, end, *, y, speed, x=-60.0):
    """Return the returns of what drives along x beside a sensor, of one place on it."""
    time = np.arange(begin, end, 0.05)
    place = np.column_stack([x + speed * (time - begin), np.full(len(time), y), 0.0 * time])
    return time, place, speed * place[:, 0] / np.hypot(place[:, 0], y)


def test_a_vehicle_that_is_watched_for_long_counts_once():
    """Its track is cut every eight seconds, and a bus alone is no traffic."""
    ways = [watched(0.0, 30.0, y=20.0, speed=4.0), watched(5.0, 15.0, y=30.0, speed=-9.0, x=60.0)]
    time, points, rate = (np.concatenate(part) for part in zip(*ways, strict=True))
    order = np.flatnonzero(np.abs(rate) > 0.15)
    order = order[np.argsort(time[order], kind="stable")]
    moving = Moving(
        time=time[order], points=points[order], range_rate=rate[order], frames=600,
        begin=0.0, end=30.0,
    )  # fmt: skip
    traffic = WindowTraffic.of(moving)
    assert traffic.samples().tracks > 4
    assert traffic.vehicles == 2
    assert traffic.between(0.0, 4.0).vehicles == 1


@given(
    st.lists(st.floats(0.5, 20.0), min_size=8, max_size=40),
    st.floats(30.0, 1e4),
    st.integers(0, 39),
)
def test_one_vehicle_alone_moves_no_sensor(gains, most, which):
    """Whatever it gains by a move; where all gain, no single one decides."""

    def agreed(gain):
        nothing = np.zeros(len(gain) + 3)  # numbers without a vehicle
        rest, moved = nothing + 50.0 * (np.arange(len(nothing)) < len(gain)), nothing.copy()
        moved[: len(gain)] = 50.0 - np.array(gain)
        return agreement(SimpleNamespace(costs=rest), SimpleNamespace(costs=moved))

    alone = np.zeros(len(gains))
    alone[which % len(gains)] = most
    assert agreed(alone) < 1.2 < AGREEMENT
    assert agreed(-np.array(gains)) < 0.0
    expected = ttest_1samp(gains, 0.0).statistic if np.ptp(gains) > 1e-3 else np.inf
    assert agreed(gains) == pytest.approx(expected) or expected > 1e5
    assert agreed(np.full(8, 2.0)) > AGREEMENT


def test_a_shake_is_no_move(seen, tmp_path):
    shaken = [(30.0 + k * 0.5, 30.5 + k * 0.5, knocked(seen[3], times=(-1.0) ** k))
              for k in range(10)]  # fmt: skip
    path = record(tmp_path / "R1.parquet", seen, shaken, until=50.0)
    found = follow(path, start(seen[3]))
    assert times(found, "moved") == []
    assert abs(errors(found.poses.poses[-1], seen[3])[5]) < 0.2
    assert max(nees(pose, seen[3]) for pose in found.poses.poses) < 22.5


def test_without_traffic_the_pose_is_held(seen, tmp_path):
    path = record(tmp_path / "R1.parquet", seen, keep=lambda t: t < 15.0, until=125.0)
    found = follow(path, start(seen[3]))
    poses = found.poses.poses
    assert len(poses) == 26
    assert found.events == ()
    held = [pose for pose, s in zip(poses, found.poses.since, strict=True) if s > START + 116.0]
    assert len(held) >= 2
    assert not any(pose.evidence["corrected"] for pose in held)
    assert np.array_equal(held[0].position, held[-1].position)
    for name in NAMES:
        assert held[-1].evidence["sigma"][name] > held[0].evidence["sigma"][name]


def test_a_straight_road_says_nothing_about_the_place_along_it(tmp_path):
    street = Street(lanes=STRAIGHT, turn_deg=30.0)
    pose = street.pose(place=(0.0, 9.0), yaw=-60.0)
    street.record(tmp_path / "R1.parquet", pose, frames=800, vehicles=60)
    found = follow(tmp_path / "R1.parquet", start(pose, {**SIGMA, "easting": 0.5, "northing": 0.5}),
                   street)  # fmt: skip
    along = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    across = np.array([-along[1], along[0]])
    covariance = np.array(found.poses.poses[-1].evidence["covariance"])[:2, :2]
    assert np.sqrt(along @ covariance @ along) > 0.4
    assert np.sqrt(across @ covariance @ across) < 0.25


@pytest.mark.parametrize(
    ("shift", "said"),
    [
        ({"easting": 3.5}, "sensor"),
        ({"yaw": 5.0, "easting": 2.0}, "lanes|sensor"),
        ({"yaw": 180.0}, "lanes"),
        ({"easting": -35.0, "northing": 30.0}, "lanes|sensor"),
    ],
)
def test_a_start_pose_that_the_data_contradict_is_refused(seen, tmp_path, shift, said):
    path = record(tmp_path / "R1.parquet", seen, until=40.0)
    with pytest.raises(NoAnswerError, match=said) as refused:
        follow(path, start(seen[3], **shift))
    assert "localize" in refused.value.hint


def test_no_traffic_or_too_few_frames_are_refused(seen, tmp_path):
    empty = record(tmp_path / "empty.parquet", seen, until=20.0, keep=lambda t: t < 0.0)
    with pytest.raises(NoAnswerError, match="moving vehicles"):
        follow(empty, start(seen[3]))
    short = record(tmp_path / "short.parquet", seen, until=3.0)
    with pytest.raises(NoAnswerError, match="60 frames"):
        follow(short, start(seen[3]))


def test_files_that_do_not_belong_together_are_refused(seen, tmp_path):
    path = record(tmp_path / "R1.parquet", seen, until=30.0)
    with pytest.raises(CrsError, match="25833"):
        follow(path, replace(start(seen[3]), crs=25833))
    with pytest.raises(NoAnswerError, match="no lane"):
        follow(path, start(seen[3], easting=5000.0))
    with pytest.raises(InputError, match="of the lanes around"):
        track(path, STREET.roads(), STREET.road_points() + [3000.0, 0, 0], start(seen[3]))
    with pytest.raises(InputError, match="no such file"):
        follow(tmp_path / "gone.parquet", start(seen[3]))


def test_a_track_begins_at_the_pose_that_holds_then(seen, tmp_path):
    path = record(tmp_path / "R1.parquet", seen, until=20.0)
    poses = (start(seen[3], easting=40.0), start(seen[3]), start(seen[3], easting=40.0))
    known = gr.PoseTrack(poses=poses, since=START + np.array([-900.0, -5.0, 900.0]))
    assert follow(path, known).poses.poses[0].easting == pytest.approx(seen[3].easting)


def test_gaps_in_a_recording_have_no_poses(seen, tmp_path):
    time, points, rate, true = seen
    early = time < START + 40.0
    time, points, rate = time[early], points[early], rate[early]
    late = np.where(time < START + 20.0, 0.0, 600.0)
    path = recording(tmp_path / "R1.parquet", time + late, true.to_sensor(points), range_rate=rate)
    found = follow(path, start(true))
    gaps = np.diff(found.poses.since)
    assert gaps.min() == pytest.approx(5.0)
    assert (gaps > 100.0).sum() == 1
    assert times(found, "moved") == []


def test_what_a_pose_file_knows_is_where_the_filter_starts(seen):
    pose = seen[3]
    given = start_estimate(start(pose), START)
    assert np.degrees(np.sqrt(given.angle_covariance[5, 5])) == pytest.approx(0.15, rel=0.01)
    by_hand = start_estimate(replace(pose, evidence={}), START)
    assert np.sqrt(by_hand.covariance[0, 0]) == pytest.approx(BY_HAND[0], rel=0.01)
    covariance = np.diag([0.04, 0.01, 0.01, 1e-5, 1e-5, 1e-5])
    covariance[0, 1] = covariance[1, 0] = 0.01
    found = {"covariance": covariance.tolist(), "method": "lane", "time": "2023-11-14T22:13:00Z"}
    before = start_estimate(replace(pose, evidence=found), START)
    assert np.allclose(before.angle_covariance, covariance, atol=2e-6)
    assert np.abs(before.common).max() > 0.0
    # what was found from these very data knows nothing beyond them
    found["time"] = "2023-11-14T22:15:00Z"
    same = start_estimate(replace(pose, evidence=found), START)
    assert np.allclose(same.covariance, by_hand.covariance)


@pytest.mark.parametrize(
    "evidence",
    [
        {"covariance": [[1.0]]},
        {"sigma": {"yaw": -1.0}},
        {"method": "lane", "covariance": np.eye(6).tolist(), "time": "noon"},
    ],
)
def test_false_evidence_is_refused(seen, evidence):
    with pytest.raises(InputError, match="R1"):
        start_estimate(replace(seen[3], evidence=evidence), START)


def test_the_figure_appears(moved, tmp_path):
    moved[0].draw(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def words(folder, *more):
    return ["track", str(folder / "R1.parquet"), "--map", "map.osm", "--road",
            str(folder / "road.laz"), "--pose", str(folder / "R1.json"), "-o",
            str(folder / "track.csv"), *more]  # fmt: skip


@pytest.fixture
def files(seen, tmp_path, monkeypatch):
    """A recording, a pose and a scanned road; the map's lanes come from the scene itself."""
    record(tmp_path / "R1.parquet", seen, until=20.0)
    start(seen[3]).write(tmp_path / "R1.json")
    STREET.write_road(tmp_path / "road.laz")
    monkeypatch.setattr(gr, "read_map", lambda *_, **__: STREET.roads(), raising=False)
    return tmp_path


def test_the_command_writes_a_track(files):
    picture = files / "figure.png"
    done = CliRunner().invoke(
        group, words(files, "--figure", str(picture), "--json"), catch_exceptions=False
    )
    assert done.exit_code == 0
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["outputs"] == [str(files / "track.csv"), str(picture)]
    assert result["summary"]["poses"] == 5
    assert len(read_track(files / "track.csv").poses) == 5


def test_an_interrupted_track_leaves_nothing(files, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("gis_radar.calibration.monitoring.pose_track.Track.draw", stop)
    before = sorted(files.iterdir())
    CliRunner().invoke(group, words(files, "--figure", str(files / "figure.png")))
    assert sorted(files.iterdir()) == before


def test_outputs_that_cannot_be_are_refused(files):
    named = [*words(files)[:-1], str(files / "track.json")]
    assert isinstance(CliRunner().invoke(group, named).exception, gr.UsageError)
    for figure, error in (("R1.json", OutputError), ("track.csv", gr.UsageError)):
        over = CliRunner().invoke(group, words(files, "--figure", str(files / figure)))
        assert isinstance(over.exception, error)
    assert not (files / "track.csv").exists()


class Lost:
    """Lanes on which the traffic never lies."""

    def fit(self, *_, **__):
        turn = np.array([0.0, 0.0, 0.0, 1.0])
        told = Measurement(
            position=np.ones(3), quaternion=turn, covariance=np.eye(6), noise=0.3 * np.eye(6)
        )
        return SimpleNamespace(
            trusted=False, on_lanes=False, fit=SimpleNamespace(fitness=0.1), measurement=told
        )


def test_who_is_lost_for_long_says_so(seen):
    begin = start_estimate(start(seen[3]), START)
    follower = Follower(Lost(), begin)
    follower.confirmed = True
    for time in np.arange(5.0, 121.0, 5.0):
        follower.cycle(START + time)
    events = [row.event for row in follower.rows]
    assert events[:3] == ["", "moved", "rejected"]
    assert set(events[2:]) == {"rejected"}
    sigma = [np.sqrt(np.diag(row.estimate.covariance)) for row in follower.rows]
    assert (sigma[0] < 0.3).all()
    assert (sigma[1] >= BLOW).all()
    assert (sigma[-1] >= BLOW).all()
    assert np.allclose(np.diff([row.estimate.time for row in follower.rows]), 5.0)
    for row in follower.rows:
        assert np.array_equal(row.estimate.position, begin.position)


@pytest.mark.parametrize("cycle_s", [5.0, 5.3, 3.3, 0.7])
def test_cycles_of_any_length_end(tmp_path, monkeypatch, cycle_s):
    """Twenty times a second, for a minute: a cycle ends at the first frame after it."""
    time = np.repeat(START + np.arange(1200) * 0.05, 2)
    points = np.random.default_rng(0).normal(size=(len(time), 3))
    path = recording(tmp_path / "R1.parquet", time, points)
    pushed, ends = [], []

    def cycle(end):
        ends.append(end)
        assert len(ends) < 1000

    follower = SimpleNamespace(
        push=lambda rows: pushed.append(len(rows)), cycle=cycle, finish=lambda _: None, rows=[],
        now=SimpleNamespace(time=START),
    )  # fmt: skip
    found = SimpleNamespace(poses=SimpleNamespace(warn_uncertain=lambda *_: ()))
    monkeypatch.setattr(monitor, "WindowFitter", lambda *_, **__: None)
    monkeypatch.setattr(monitor, "Follower", lambda *_, **__: follower)
    monkeypatch.setattr(monitor, "track_of", lambda *_: found)
    monkeypatch.setattr(monitor, "CYCLE_S", cycle_s)
    follow(path, start(STREET.pose()))
    assert sum(pushed) == len(time)
    assert np.all(np.diff(ends) > 0.0)
    assert len(ends) in {int(60.0 / cycle_s), int(60.0 / cycle_s) + 1}

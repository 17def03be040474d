"""Recordings and maps as they come: what the check says of each, and that none is refused wrongly.

Each is a site of the sample's junction with one thing that is unusual, or wrong, and the command
`gis-radar check` or `measure` on it.
"""

import json
import re
from dataclasses import replace
from itertools import chain

import numpy as np
import pandas as pd
import pytest
import shapely
from pyproj import Transformer
from scipy.spatial.transform import Rotation

import gis_radar as gr
from gis_radar.calibration import (
    Finding,
    LaneMap,
    RangeScale,
    RecordedSensor,
    SensorClock,
    check_plausibility,
)
from gis_radar.calibration.check import explanations, fitted_pose, nearly_right, plausibility
from gis_radar.calibration.check.evidence import score
from gis_radar.calibration.check.excerpt import read_excerpts
from gis_radar.calibration.check.explanations import compare_explanations
from gis_radar.calibration.check.faults import Rows, find_fault
from gis_radar.calibration.check.mistakes import AGAINST, MIRRORED, NO_MISTAKE, Mistake
from gis_radar.calibration.check.plausibility import judge
from gis_radar.calibration.check.scene_change import SceneChange
from gis_radar.calibration.findings import Cause, judged, wrong
from gis_radar.calibration.monitoring.kalman_filter import Measurement
from gis_radar.calibration.registration.state import State
from gis_radar.calibration.registration.traces import NONE
from gis_radar.calibration.unit_mistakes import FEET, USUAL_MISTAKES
from gis_radar.poses import PoseTrack, as_track

SAMPLE = gr.sample_folder()
MAP = SAMPLE / "junction.osm"
POSES = {name: gr.read_pose(SAMPLE / f"{name}.json") for name in ("R1", "R2")}
TO_UTM = Transformer.from_crs(4326, 25832, always_xy=True)
FITS, WRONG, LITTLE = "fits", "does not fit", "too little traffic to tell"
MOVES_MPS = 0.5
NO_HEIGHTS = "without heights of map and radar, height and tilt are not compared"


@pytest.fixture(scope="module")
def rows(first_seconds):
    """Rows of forty seconds of both sensors."""
    return {n: pd.read_parquet(first_seconds(SAMPLE / f"{n}.parquet", 40)) for n in POSES}


@pytest.fixture(scope="module")
def lanes():
    return LaneMap(lanelets=gr.read_map(MAP).lanelets, road=np.empty((0, 3)))


@pytest.fixture
def excerpts(tmp_path):
    """Give a function that yields the excerpts of a recording, by R1's pose or another one."""

    def read(table, pose=POSES["R1"]):
        table.to_parquet(tmp_path / "R1.parquet", index=False)
        return read_excerpts([gr.open_recording(tmp_path / "R1.parquet")], [as_track(pose)])

    return read


@pytest.fixture
def write(tmp_path):
    """Give a function that writes a site with sensors."""

    def site(sensors, *, osm=MAP, scan=""):
        parts = [f'title = "A"\ntimezone = "Europe/Berlin"\n[map]\nfile = "{osm}"\n']
        parts += ['crs = "EPSG:25832"\n', scan, "[vehicles]\nfollow = false\n"]
        for name, (table, pose) in sensors.items():
            table.to_parquet(tmp_path / f"{name}.parquet", index=False)
            replace(pose, sensor=name).write(tmp_path / f"{name}.json")
            parts.append(
                f'[[sensor]]\nname = "{name}"\nrecordings = ["{name}.parquet"]\n'
                f'pose = "{name}.json"\n'
            )
        (tmp_path / "SITE.toml").write_text("".join(parts), encoding="utf-8")
        return tmp_path / "SITE.toml"

    return site


@pytest.fixture
def checked(run, write):
    """Give a function that checks sensors, and returns exit code, verdicts and the whole answer."""

    def check(sensors, **options):
        code, out, _ = run("check", write(sensors, **options), "--json")
        events = {event["event"]: event for event in map(json.loads, out.splitlines())}
        table = events["result"]["summary"]["plausibility"] if "result" in events else [[]]
        return code, {line[0]: line[1:] for line in table[1:]}, events

    return check


def test_short_recordings_are_read_whole_as_a_long_one(rows, tmp_path, excerpts):
    table = rows["R1"]
    *_, whole = excerpts(table)
    part = ((table["time"] - table["time"].iloc[0]) // 5.0).astype(int)
    paths = []
    for number, each in table.groupby(part):
        paths.append(tmp_path / f"{number}.parquet")
        each.to_parquet(paths[-1], index=False)
    recordings = [gr.open_recording(path) for path in paths]
    assert len(recordings) == 8
    *_, last = read_excerpts(recordings, [as_track(POSES["R1"])] * len(recordings))
    assert len(last.moving.time) == len(whole.moving.time) > 10_000


def moved(pose, north_m):
    return replace(pose, northing=pose.northing + north_m)


def moves(table):
    return table["range_rate"].abs() > MOVES_MPS


def quiet(table):
    """Leave what stands: at night nobody drives."""
    return table[~moves(table)]


def jam(table):
    """Let nobody move in the first half."""
    early = table["time"] < table["time"].iloc[0] + 20.0
    return table.assign(range_rate=table["range_rate"].mask(early & moves(table), 0.1))


def one_lane(table):
    """Leave of what moves that on one lane through the junction."""
    lanelets = gr.read_map(MAP).lanelets
    there = POSES["R1"].to_map(table[["x", "y", "z"]].to_numpy(np.float64))
    points = shapely.points(there[:, :2])
    moving = moves(table).to_numpy()
    count = [shapely.contains(lane, points[moving]).sum() for lane in lanelets.geometry]
    lane = lanelets.geometry.iloc[int(np.argmax(count))].buffer(1.0)
    return table[~moving | shapely.contains(lane, points)]


def no_rates(table):
    return table.drop(columns="range_rate")


def flat(table):
    return table.assign(z=np.float32(np.nan))


def as_it_is(given):
    return given


def short(table):
    return table[table["time"] < table["time"].iloc[0] + 5.0]


USUAL = {
    "a quiet night": (quiet, {LITTLE}),
    "a jam at start": (jam, {FITS}),
    "one lane": (one_lane, {LITTLE}),
    "no elevation": (flat, {FITS}),
    "five seconds": (short, {LITTLE}),
}


@pytest.mark.parametrize(("change", "verdicts"), USUAL.values(), ids=USUAL)
def test_a_right_pose_is_not_refused(checked, rows, change, verdicts):
    code, found, _ = checked({"R1": (change(rows["R1"]), POSES["R1"])})
    assert code == 0
    verdict, evidence, advice = found["R1"]
    assert verdict in verdicts
    assert re.search(r"\d+%? ?(of|vehicles)", evidence)
    assert (NO_HEIGHTS in evidence) is (change is flat)
    if change in (one_lane, short):  # ten vehicles and more, but a metre would pass
        assert re.search(r"with the sensor off by up to \d+\.\d m to the \S+ or \S+", evidence)
        assert advice == "record more traffic, on crossing lanes, too"
    else:
        assert advice == ("" if verdict == FITS else "record more traffic")


@pytest.mark.parametrize("constant", [False, True])
def test_positions_that_are_all_empty_are_refused_after_a_constant_rate(checked, rows, constant):
    table = rows["R1"].assign(**dict.fromkeys("xyz", np.float32(np.nan)))
    if constant:
        table = table.assign(range_rate=np.float32(1.5))
    code, found, _ = checked({"R1": (table, POSES["R1"])})
    assert code == 4
    verdict, evidence, _ = found["R1"]
    assert verdict == WRONG
    said = "range_rate is 1.5 in all detections" if constant else "none of .* has a position"
    assert re.search(said, evidence)


def test_more_is_read_where_traffic_does_not_show_the_pose(rows, excerpts, lanes):
    """The earlier pieces of a long recording are among the later ones; as few as do are read."""
    little = list(excerpts(one_lane(rows["R1"])))
    assert len(little) == 1
    assert judge("R1", little, lanes, {})[0].verdict == LITTLE
    parts = [rows["R1"].assign(time=rows["R1"]["time"] + 40.0 * number) for number in range(4)]
    more = excerpts(pd.concat(parts))
    found, excerpt = judge("R1", chain(little, more), lanes, {})
    assert found.verdict == FITS
    assert excerpt.vehicles >= 30
    assert all(set(excerpt.moving.time) < set(each.moving.time) for each in more)


@pytest.mark.parametrize(("north_m", "change"), [(0.0, as_it_is), (1.5, as_it_is), (1.5, flat)])
def test_without_heights_a_pose_that_is_off_shows(checked, rows, tmp_path, north_m, change):
    """Height and tilt are taken as given there."""
    text = re.sub(r"<tag k=.ele. v=.[^/]*/>", "", MAP.read_text(encoding="utf-8"))
    (tmp_path / "flat.osm").write_text(text, encoding="utf-8")
    given = {"R1": (change(rows["R1"]), moved(POSES["R1"], north_m))}
    _, found, _ = checked(given, osm=tmp_path / "flat.osm")
    verdict, evidence, _ = found["R1"]
    assert NO_HEIGHTS in evidence
    if north_m:
        assert re.search(r"its pose (is|may be) off .* sensor 1\.\d\d ± 0\.\d+ m away: ", evidence)
    else:
        assert verdict == FITS
        assert " off" not in evidence


def test_a_metre_off_shows_in_half_a_minute(checked, rows):
    """From there a single fit comes to rest beside the right place, and shows nothing."""
    table = rows["R2"][rows["R2"]["time"] < rows["R2"]["time"].iloc[0] + 30.0]
    _, found, _ = checked({"R2": (table, moved(POSES["R2"], 1.0))})
    told = r"its pose may be off .* sensor 0\.[89]\d ± 0\.\d+ m away: .* m to the south\)"
    assert re.search(told, found["R2"][1])
    assert found["R2"][2].startswith("set easting 690379")


@pytest.mark.parametrize(("north_m", "verdict"), [(0.0, FITS), (0.8, LITTLE)])
def test_what_is_measured_to_be_off_counts_in_what_would_show(checked, rows, north_m, verdict):
    """0.6 ± 0.3 m off may as well be a metre: it is not doubted yet, but not said to fit."""
    table = rows["R1"][rows["R1"]["time"] < rows["R1"]["time"].iloc[0] + 22.0]
    _, found, _ = checked({"R1": (table, moved(POSES["R1"], north_m))})
    assert found["R1"][0] == verdict
    assert ("off by up to 1." in found["R1"][1]) is (verdict == LITTLE)


def test_a_turn_that_a_shift_would_hide_shows_where_the_place_is_surveyed():
    """Along a bend a pose slides, and turns, with hardly a change; the place holds it."""
    pose = replace(POSES["R1"], yaw=0.0, pitch=0.0, roll=0.0)
    centre = State(position=np.zeros(3), R_map_sensor=np.eye(3), reflection=0.7)
    slide = np.array([0.0, 1.0, 0.0, 0.0, 0.0, np.radians(0.7)])
    spread = np.diag([0.2] * 3 + [np.radians(0.1)] * 3) ** 2 + 1e4 * np.outer(slide, slide)
    turned = Rotation.from_euler("z", 1.2, degrees=True).as_quat()
    seen = Measurement(position=np.zeros(3), quaternion=turned, covariance=spread, noise=spread)
    ways = [
        fitted_pose.offs_of(pose, each, centre)
        for each in fitted_pose.single_mistakes(seen, centre)
    ]
    assert any(yaw.far and abs(yaw.amount - 1.2) < 2.0 * yaw.sigma for _, yaw, *_ in ways)
    assert any(abs(place.amount - 1.2 / 0.7) < 2.0 * place.sigma for place, *_ in ways)
    assert not any(each.far for each in fitted_pose.offs_of(pose, seen, centre))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"yaw": 1.5}, "turned 1.50 ± 0.10 deg clockwise, seen from above"),
        ({"yaw": -1.5}, "turned 1.50 ± 0.10 deg anticlockwise, seen from above"),
        ({"pitch": -2.0}, "tilted 2.00 ± 0.10 deg down"),
        ({"roll": -3.0}, "rolled 3.00 ± 0.10 deg clockwise, seen from behind"),
        ({"easting": 1.0, "northing": -2.0},
         "2.24 ± 0.20 m away: 1.00 m to the west and 2.00 m to the north"),
    ],
)  # fmt: skip
def test_it_is_said_how_a_sensor_would_have_to_be_moved(given, told):
    """As somebody sees it who stands there: its x axis looks to the east."""
    right = replace(POSES["R1"], yaw=0.0, pitch=0.0, roll=0.0)
    pose = replace(right, **{name: getattr(right, name) + by for name, by in given.items()})
    away = np.array([right.easting - pose.easting, right.northing - pose.northing, 0.0])
    spread = np.diag([0.2] * 3 + [np.radians(0.1)] * 3) ** 2
    seen = Measurement(
        position=away, quaternion=np.array([0.0, 0.0, 0.0, 1.0]), covariance=spread, noise=spread
    )
    centre = State(position=np.zeros(3), R_map_sensor=pose.R_map_sensor, reflection=0.7)
    assert [each.text for each in fitted_pose.offs_of(pose, seen, centre) if each.far] == [told]


@pytest.mark.parametrize(("turn", "named"), [(180.0, True), (178.0, False)])
def test_a_cause_is_named_only_if_all_fits_once_it_is_corrected(
    rows, excerpts, lanes, monkeypatch, turn, named
):
    """Two degrees beside the right yaw most vehicles still drive along lanes."""
    mistake = Mistake(
        causes=(Cause("of a test", ""),), pose=lambda pose: replace(pose, yaw=pose.yaw + turn)
    )
    monkeypatch.setattr(explanations, "usual_mistakes", lambda *_, **__: [mistake])
    excerpt = next(excerpts(rows["R1"], replace(POSES["R1"], yaw=POSES["R1"].yaw + 180.0)))
    assert mistake.score(excerpt, lanes).share > explanations.LEAST_ON_LANES
    found = compare_explanations(excerpt, lanes, {})
    assert found.verdict == WRONG
    assert ("of a test" in found.cause) is named


@pytest.mark.parametrize("lost", [True, False])
def test_signs_that_are_lost_show_where_few_approach(rows, excerpts, lanes, lost):
    """Who recedes for good, and drives along a lane backwards, has lost the sign of its rate."""
    table = rows["R1"]
    early = table["time"] < table["time"].iloc[0] + 8.0
    table = table[early | (table["range_rate"] > -MOVES_MPS)]
    if lost:
        table = table.assign(range_rate=table["range_rate"].abs())
    found = compare_explanations(next(excerpts(table)), lanes, {})
    assert found.cause == ("range rates look like absolute values" if lost else "")


@pytest.mark.parametrize(("factor", "verdict"), [(1.0, FITS), (USUAL_MISTAKES[FEET], WRONG)])
def test_feet_are_named_by_lanes_where_range_rates_do_not_tell(
    rows, excerpts, lanes, factor, verdict
):
    table = rows["R1"].assign(**{name: factor * rows["R1"][name] for name in "xyz"})
    excerpt = next(excerpts(table))
    found = compare_explanations(excerpt, lanes, {}, units_known=False)
    assert found.verdict == verdict
    assert ("positions look like feet" in found.cause) is (verdict == WRONG)
    if verdict == WRONG:
        assert "feet" not in compare_explanations(excerpt, lanes, {}).cause


def test_lanes_driven_against_are_no_likelier_than_a_pose_across_the_street(rows, excerpts, lanes):
    """A lane's traffic, seen from 7 m beside, lies on the lane of the other direction."""
    beside = replace(POSES["R1"], easting=POSES["R1"].easting - 7.0)
    found = compare_explanations(next(excerpts(one_lane(rows["R1"]), beside)), lanes, {})
    assert found.verdict == WRONG
    told = (
        r"its pose is off: compared with it, the sensor is 6\.\d m to the east or traffic runs ag"
    )
    assert re.match(told, found.cause)
    assert found.advice.count("; ") == 1


def test_a_mirrored_map_and_another_place_are_two_mistakes():
    """The traffic of one street of elsewhere lies on some street if mirrored and moved."""
    pose = POSES["R1"]
    for east_m, twofold in ((0.5, False), (12.0, True)):
        there = replace(pose, easting=pose.easting + east_m)
        assert replace(MIRRORED.by(pose, there), fitted=6).is_twofold(pose) is twofold
        assert not replace(NO_MISTAKE.by(pose, there), fitted=6).is_twofold(pose)


def test_a_doubted_pose_may_be_ranges_that_are_too_long(rows, excerpts, lanes):
    """Unless the range rates tell that they are not."""
    table = rows["R1"].assign(**{name: 1.025 * rows["R1"][name] for name in "xyz"})
    excerpt = next(excerpts(table))
    fits = Finding(sensor="R1", verdict=FITS, evidence="most drive along lanes")
    found = [
        nearly_right.judge_offset(
            excerpt, lanes, fits, RangeScale(factor=factor, sigma=sigma, vehicles=30)
        )
        for factor, sigma in ((1.025, 0.02), (1.0, 0.004))
    ]
    assert [each.verdict for each in found] == [FITS, FITS]
    assert [str(each.cause) for each in found] == [
        "its pose may be off or ranges are 2.5% too long, or range rates too low",
        "its pose may be off",
    ]


def test_where_all_approach_lost_signs_and_turned_ones_are_the_same(checked, rows):
    table = rows["R1"][rows["R1"]["range_rate"] < MOVES_MPS]
    _, found, _ = checked({"R1": (table.assign(range_rate=table["range_rate"].abs()), POSES["R1"])})
    looks = "range rates look positive where targets approach", "range rates look like absolute"
    assert all(each in found["R1"][1] for each in looks)
    assert found["R1"][2].count("; ") == 1


def test_vehicles_that_are_all_there_from_the_first_frame_on_tell_no_moment(
    rows, excerpts, lanes, monkeypatch
):
    """None is before it, as in a queue; half of them beside the lanes."""
    excerpt = next(excerpts(rows["R1"]))
    excerpt = replace(excerpt, time=np.full(len(excerpt), excerpt.time[0]), scene_change=None)
    half = np.arange(excerpt.vehicles) < excerpt.vehicles // 2
    given = replace(score(excerpt, lanes), on_lane=half.astype(np.float64))
    monkeypatch.setattr("gis_radar.calibration.check.plausibility.score", lambda *_: given)
    assert judge("R1", [excerpt], lanes, {})[0].verdict == FITS


@pytest.mark.parametrize("others", [(), (Cause("its pose is off", "find it"),)])
def test_where_the_scene_stays_only_what_leaves_it_is_named_from_a_moment_on(
    rows, excerpts, lanes, monkeypatch, others
):
    still = SceneChange(time=None, share=0.9, usual=0.9)
    excerpt = replace(next(excerpts(rows["R1"])), scene_change=still)
    first = excerpt.time[np.unique(excerpt.vehicle, return_index=True)[1]]
    late = replace(score(excerpt, lanes), on_lane=(first > np.median(first)).astype(np.float64))
    monkeypatch.setattr(plausibility, "score", lambda *_: late)
    fits = judged(FITS, "most")
    sides = iter([wrong("few", *others, AGAINST), fits, fits])
    monkeypatch.setattr(plausibility, "compare_explanations", lambda *_, **__: next(sides))
    found, _ = judge("R1", [excerpt], lanes, {})
    assert found.cause.startswith("until ") is not bool(others)


def test_two_detections_of_a_few_may_be_alike_by_chance():
    """As of a radar of coarse positions on a quiet street."""
    rng = np.random.default_rng(1)
    for count, found in ((10, False), (100, True)):
        detected = np.append(np.arange(count - 2), np.arange(count // 2 if found else 2))
        points, rate = rng.normal(0.0, 50.0, (count, 3))[detected], np.arange(count)[detected] + 1.0
        rows = Rows(
            time=np.zeros(len(rate)), points=points, range_rate=rate,
            source=np.zeros(len(rate), np.int64),
        )  # fmt: skip
        fault = find_fault(rows, rate > 0.0)
        assert (fault is not None) is found
        assert fault is None or "twice" in fault.evidence


@pytest.mark.parametrize(("offset_s", "asked"), [(0.004, False), (-1.0, True)])
def test_the_sign_of_a_correction_is_asked_for_where_it_can_matter(
    rows, lanes, tmp_path, monkeypatch, offset_s, asked
):
    apart = Finding(sensor="R1", verdict=WRONG, evidence="", advice="find the offset")
    monkeypatch.setattr(plausibility, "odd_clocks", lambda _: {"R1": apart})
    quiet(rows["R1"]).to_parquet(tmp_path / "R1.parquet", index=False)
    sensor = RecordedSensor(
        recordings=[gr.open_recording(tmp_path / "R1.parquet")], tracks=[as_track(POSES["R1"])],
        clock=SensorClock(offset_s=offset_s),
    )  # fmt: skip
    (found,) = check_plausibility({"R1": sensor}, lanes)
    assert ("is the sign right?" in found.advice) == asked


def test_objects_that_are_left_out_leave_no_gaps(rows, excerpts):
    """What was seen from a place that is not the usual one; numbers are places of arrays."""
    since = np.array([0.0, rows["R1"]["time"].iloc[0] + 15.0])
    track = PoseTrack(since=since, poses=(moved(POSES["R1"], 9.0), POSES["R1"]))
    excerpt = next(excerpts(rows["R1"], track))
    moving, number = excerpt.as_usual
    assert 0 < len(moving) < len(excerpt.moving)
    known = np.unique(number[number != NONE])
    assert list(known) == list(range(len(known)))
    until, since = excerpt.split_at(float(rows["R1"]["time"].iloc[0]) + 20.0)
    assert len(until.moving) + len(since.moving) == len(excerpt.moving)
    assert not np.intersect1d(until.vehicle, since.vehicle).size


def test_without_range_rates_nothing_is_told(checked, rows):
    code, found, events = checked({"R1": (no_rates(rows["R1"]), POSES["R1"])})
    assert code == 3
    assert not found
    assert "range_rate" in events["error"]["message"]


def test_left_hand_traffic_fits(checked, rows, tmp_path):
    """The junction in a mirror, with lanes whose bounds and direction are right."""
    middle = POSES["R1"].northing

    def mirrored(match):
        east, north = TO_UTM.transform(float(match[2]), float(match[1]))
        lon, lat = TO_UTM.transform(east, 2.0 * middle - north, direction="INVERSE")
        return f'lat="{lat:.11f}" lon="{lon:.11f}"'

    text = re.sub(r'lat="([\d.]+)" lon="([\d.]+)"', mirrored, MAP.read_text(encoding="utf-8"))
    roles = {"left": "right", "right": "left"}
    text = re.sub(r'role="(left|right)"', lambda match: f'role="{roles[match[1]]}"', text)
    (tmp_path / "left.osm").write_text(text, encoding="utf-8")
    pose = replace(POSES["R1"], yaw=-POSES["R1"].yaw, roll=-POSES["R1"].roll)
    table = rows["R1"].assign(y=-rows["R1"]["y"])
    code, found, _ = checked({"R1": (table, pose)}, osm=tmp_path / "left.osm")
    assert (code, found["R1"][0]) == (0, FITS)


def test_clocks_are_not_compared_without_a_common_view(checked, rows):
    """A clock a second off cannot show where two sensors see no vehicle together."""
    middle_m = np.mean([each.easting for each in POSES.values()])

    def half(name, side):
        table = rows[name]
        east = POSES[name].to_map(table[["x", "y", "z"]].to_numpy(np.float64))[:, 0]
        return table[~(side * (east - middle_m) < 5.0)]

    sides = {"R1": half("R1", -1.0), "R2": half("R2", 1.0)}
    sides["R2"] = sides["R2"].assign(time=sides["R2"]["time"] + 1.0)
    code, found, _ = checked({name: (table, POSES[name]) for name, table in sides.items()})
    assert code == 0
    assert WRONG not in {line[0] for line in found.values()}


def test_of_two_clocks_that_are_apart_a_run_keeps_one(
    write, run, rows, tmp_path, in_this_process, blank_paper, without_report
):
    """A map of one sensor is right; which of the two clocks is off is not known."""
    brief = {n: rows[n][rows[n]["time"] < rows[n]["time"].iloc[0] + 24.0] for n in POSES}
    late = brief["R2"].assign(time=brief["R2"]["time"] + 1.0)
    site = write({"R1": (brief["R1"], POSES["R1"]), "R2": (late, POSES["R2"])})
    code, _, err = run("run", site, "-o", tmp_path / "out")
    assert code == 4
    assert "no result for R2; the heat maps show R1 only; R2: does not fit: its clock" in err
    assert gr.open_dataset(tmp_path / "out" / "dataset").sensors == ["R1"]


def test_another_sensor_from_half_way_on_is_told_by_what_stands(checked, rows):
    """Of what stands nearly nothing stays, be there traffic or not."""
    middle = rows["R1"]["time"].iloc[0] + 20.0
    parts = [rows["R1"][rows["R1"]["time"] < middle], rows["R2"][rows["R2"]["time"] >= middle]]
    code, found, _ = checked({"R1": (quiet(pd.concat(parts)), POSES["R1"])})
    assert code == 4
    assert found["R1"][0] == WRONG
    assert re.search(r"from .*07:30:\S+ on it is another sensor's recording", found["R1"][1])
    assert re.search(
        r"\(across that moment \d+% of what stands around it stays where it was", found["R1"][1]
    )


@pytest.mark.parametrize("still", [0, 1])
def test_another_sensor_is_told_where_nothing_at_all_moves_on_one_side(checked, rows, still):
    """Traffic before alone, or since alone: as a night ends, or begins."""
    middle = rows["R1"]["time"].iloc[0] + 20.0
    parts = [rows["R1"][rows["R1"]["time"] < middle], rows["R2"][rows["R2"]["time"] >= middle]]
    parts[still] = parts[still][parts[still]["range_rate"].abs() <= 0.1]
    code, found, _ = checked({"R1": (pd.concat(parts), POSES["R1"])})
    assert code == 4
    assert found["R1"][0] == WRONG


def test_a_sensor_that_is_turned_half_way_is_told(checked, rows):
    """By five degrees: much of what stands near it stays in its cells."""
    table = rows["R1"]
    late = (table["time"] >= table["time"].iloc[0] + 20.0).to_numpy()
    places = (table["x"] + 1j * table["y"]).to_numpy() * np.exp(1j * np.radians(5.0 * late))
    table = table.assign(x=places.real.astype(np.float32), y=places.imag.astype(np.float32))
    code, found, _ = checked({"R1": (table, POSES["R1"])})
    assert code == 4
    assert found["R1"][0] == WRONG
    assert "2025-06-12T07:30" in found["R1"][1]


WRONGS = {
    "R4": (as_it_is, lambda pose: replace(pose, yaw=pose.yaw + 180.0), "off by 180 deg"),
    "R6": (lambda table: table.assign(y=-table["y"]), as_it_is, "left and right"),
    "R8": (lambda table: table.assign(range_rate=table["range_rate"] * np.float32(3.6)),
            as_it_is, "km/h"),
}  # fmt: skip


def test_of_five_sensors_three_are_wrong(checked, rows):
    """All three are named, each with its cause and advice; the others go on."""
    sensors, rng = {}, np.random.default_rng(0)
    for number in (1, 2, 4, 6, 8):
        name, of = f"R{number}", ("R1", "R2")[number % 2]
        lasts_s = 20.0 if name in WRONGS else 12.0
        table = rows[of][rows[of]["time"] < rows[of]["time"].iloc[0] + lasts_s]
        near = table["x"] + rng.normal(0.0, 0.02, len(table)).astype(np.float32)  # frames differ
        change, turn, _ = WRONGS.get(name, (as_it_is, as_it_is, ""))
        sensors[name] = change(table.assign(x=near)), turn(POSES[of])
    code, found, events = checked(sensors)
    assert code == 4
    assert {name for name, line in found.items() if line[0] == WRONG} == set(WRONGS)
    assert all(says in found[name][1] and found[name][2] for name, (*_, says) in WRONGS.items())
    assert len(events["error"]["parts"]) == 3

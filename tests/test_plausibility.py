"""Poses and recordings that do not fit are refused by their likeliest mistake; right ones not."""

import json
import re
from dataclasses import replace
from functools import reduce
from itertools import permutations

import numpy as np
import pandas as pd
import pytest
from maps import Listener
from site_runs import no_report

import gis_radar as gr
from gis_radar.base import QUIET, UsageError
from gis_radar.calibration import (
    FITS,
    UNKNOWN,
    WRONG,
    Finding,
    ImplausibleError,
    LaneMap,
    RecordedSensor,
    SensorClock,
    check_plausibility,
    refuse_implausible,
)
from gis_radar.calibration.check.faults import iso
from gis_radar.calibration.check.mistakes import other_pose
from gis_radar.calibration.findings import Cause, wrong
from gis_radar.poses import PoseTrack, as_track
from gis_radar.site import recipes

SAMPLE = gr.sample_folder()
MAP = SAMPLE / "junction.osm"
POSES = {name: gr.read_pose(SAMPLE / f"{name}.json") for name in ("R1", "R2")}


@pytest.fixture(scope="module")
def tiles():
    return gr.make_tiles(gr.read_map(MAP))


@pytest.fixture(scope="module")
def rows(first_seconds):
    """Rows of both sensors: enough traffic to tell a mistake."""
    return {n: pd.read_parquet(first_seconds(SAMPLE / f"{n}.parquet", 24)) for n in POSES}


@pytest.fixture(scope="module")
def minute(first_seconds):
    """Rows of a minute."""
    return {n: pd.read_parquet(first_seconds(SAMPLE / f"{n}.parquet", 60)) for n in POSES}


def turned(angle, by=None):
    return replace(POSES["R1"], **{angle: by})


def times(column, factor):
    return lambda table: table.assign(**{column: table[column] * np.float32(factor)})


def signless(table):
    return table.assign(range_rate=table["range_rate"].abs())


def some_infinite(table):
    odd = np.random.default_rng(1).random(len(table)) < 0.02
    return table.assign(range_rate=table["range_rate"].mask(odd, np.inf))


def frozen(table):
    """Repeat one frame for five seconds."""
    frames = np.unique(table["time"])
    one = table[table["time"] == frames[300]]
    again = [one.assign(time=time) for time in frames[300:400]]
    return pd.concat(
        [table[table["time"] < frames[300]], *again, table[table["time"] > frames[399]]]
    )


def doubled(table):
    return pd.concat([table, table]).sort_values("time", kind="stable")


def swapped(table):
    return table.assign(y=table["z"], z=table["y"])


def upside_down(table):
    return table.assign(y=-table["y"], z=-table["z"])


def constant_rate(table):
    return table.assign(range_rate=np.float32(5.0))


def faster(table):
    return table.assign(range_rate=table["range_rate"] + np.float32(0.6))


def shorter(factor):
    return lambda table: table.assign(**{name: table[name] * np.float32(factor) for name in "xyz"})


def joined(table):
    """Join the frames of R1 and R2 in one table."""
    other = pd.read_parquet(SAMPLE / "R2.parquet")
    other = other[other["time"] <= table["time"].iloc[-1]]
    return pd.concat([table, other]).sort_values("time", kind="stable")


OTHER = replace(POSES["R2"], sensor="R1")
YAW, PITCH = POSES["R1"].yaw, POSES["R1"].pitch
MISTAKES = {
    "turned": (turned("yaw", YAW + 180.0), None, "yaw is off by 180 deg", "set yaw to 21.7 deg"),
    "a bearing": (turned("yaw", 90.0 - YAW), None, "its yaw is a bearing", "21.7"),
    "clockwise": (turned("yaw", 360.0 - YAW), None, "counts clockwise", "set yaw to 21.7 deg"),
    "two degrees": (turned("yaw", YAW + 2.0), None, "its pose is off", "set yaw 21.6"),
    "pitch": (turned("pitch", -PITCH), None, "pitch has the wrong sign", "set pitch to 3.2"),
    "height": (turned("height", POSES["R1"].height + 3.0), None, "height is 3", "height to 520"),
    "mirrored": (POSES["R1"], times("y", -1.0), "left and right are swapped", "the sign of y"),
    "backward": (POSES["R1"], times("x", -1.0), "x points backward", "the sign of x"),
    "z down": (POSES["R1"], times("z", -1.0), "z points down", "the sign of z"),
    "y, z swapped": (POSES["R1"], swapped, "y and z are swapped", "swap y and z"),
    "upside down": (POSES["R1"], upside_down, "roll is off by 180 deg, or y points", "y and z"),
    "no z": (POSES["R1"], times("z", 0.0), "z was not measured", "leave z empty"),
    "no rate": (POSES["R1"], constant_rate, "range_rate was not measured", "leave range_rate"),
    "rate off": (POSES["R1"], faster, "range rates are 0.60 m/s too high", "subtract 0.60 from"),
    "two sensors": (OTHER, joined, "cause unknown", "the recording is of one sensor"),
    "ellipsoid": (turned("height", POSES["R1"].height + 45.0), None, "ellipsoid", "to 520"),
    "km/h": (POSES["R1"], times("range_rate", 3.6), "range rates look like km/h", "by 3.6"),
    "cm/s": (POSES["R1"], times("range_rate", 100.0), "cm/s or mm/s", "m/s"),
    "km": (POSES["R1"], shorter(1e-3), "look like kilometres", "are metres"),
    "divided by 100": (POSES["R1"], shorter(1e-2), "divided by 100", "are metres"),
    "infinite": (POSES["R1"], some_infinite, "damaged, or was converted wrongly", "has NaN"),
    "sign": (POSES["R1"], times("range_rate", -1.0), "positive where targets", "change the sign"),
    "absolute": (POSES["R1"], signless, "absolute values", "positive"),
    "doubled": (POSES["R1"], doubled, "joined with a copy of itself", "each detection once"),
    "frozen": (POSES["R1"], frozen, "the recording is frozen", "leave"),
}  # fmt: skip


@pytest.mark.parametrize(("pose", "change", "cause", "advice"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_before_anything_is_written(
    tmp_path, tiles, rows, pose, change, cause, advice
):
    table = rows["R1"] if change is None else change(rows["R1"])
    table.to_parquet(tmp_path / "R1.parquet", index=False)
    with pytest.raises(ImplausibleError) as caught:
        gr.measure([tmp_path / "R1.parquet"], [pose], tiles, MAP, tmp_path / "dataset")
    assert cause in caught.value.message
    assert advice in caught.value.hint
    assert "--accept R1" in caught.value.hint
    assert caught.value.exit_code == 4
    assert not (tmp_path / "dataset").exists()


def test_a_pose_a_metre_off_is_doubted_not_refused(tmp_path, tiles, rows):
    """So far a survey, drivers' habits and a map together may be off."""
    rows["R1"].to_parquet(tmp_path / "R1.parquet")
    heard, pose = Listener(), replace(POSES["R1"], northing=POSES["R1"].northing + 1.0)
    made = gr.measure(
        [tmp_path / "R1.parquet"], [pose], tiles, MAP, tmp_path / "d", hits_only=True,
        reporter=heard,
    )  # fmt: skip
    assert made.manifest.doubts["R1"].startswith(
        "R1: fits, but its pose may be off (with this pose 9"
    )
    assert made.manifest.doubts["R1"] in str(heard.messages)


def test_who_is_accepted_lets_no_other_pass_and_each_doubt_is_told():
    one, other = (
        replace(wrong("few", Cause("turned", "turn")), sensor=name) for name in ("R1", "R2")
    )
    with pytest.raises(ImplausibleError, match=r"^R2: does not fit") as caught:
        refuse_implausible([one, other], ["R1"], Listener())
    assert caught.value.findings == (other,)
    heard, fits = Listener(), Finding(sensor="R3", verdict=FITS, evidence="many")
    doubted = [replace(fits, cause="it may be off"), replace(fits, verdict=UNKNOWN)]
    refuse_implausible([one, other, fits, *doubted], ["R1", "R2"], heard)
    assert [line for _, line in heard.messages] == [
        f"{one.line}; it is accepted anyway", f"{other.line}; it is accepted anyway",
        *(each.line for each in doubted),
    ]  # fmt: skip


def test_findings_on_several_times_join_alike_in_any_order():
    """The worst one stays; its words are the latest, and it holds since the first of its kind."""

    def of(day, verdict, cause=""):
        time = f"2026-10-0{day}T00:00:00Z"
        evidence = f"of day {day}"
        return Finding(
            sensor="R1", verdict=verdict, evidence=evidence, cause=cause, since=time, until=time
        )

    days = [of(1, FITS), of(2, FITS, "it may be off"), of(3, UNKNOWN), of(4, FITS, "it may be off")]
    for order in permutations(days):
        found = reduce(Finding.joined, order)
        assert (found.evidence, found.since[:10]) == ("of day 4", "2026-10-02")
    assert reduce(Finding.joined, days[::2]) == days[2]
    turned = replace(wrong("few", Cause("turned", "turn")), sensor="R1")
    assert turned.joined(days[3]) == days[3].joined(turned) == turned


@pytest.fixture
def mixed_up(tmp_path, rows):
    """A folder with a site whose recordings are mixed up."""
    for name, other in (("A", "R2"), ("B", "R1")):
        rows[other].to_parquet(tmp_path / f"{name}.parquet", index=False)
    (tmp_path / "SITE.toml").write_text(
        f'title = "A"\ntimezone = "Europe/Berlin"\n[map]\nfile = "{MAP}"\ncrs = "EPSG:25832"\n'
        "[vehicles]\nfollow = false\n"
        + "".join(
            f'[[sensor]]\nname = "{name}"\nrecordings = ["{file}.parquet"]\n'
            f'pose = "{SAMPLE / name}.json"\naccept = false\n'
            for name, file in (("R1", "A"), ("R2", "B"))
        )
    )
    return tmp_path


def test_recordings_that_are_mixed_up_are_named_in_a_table(run, mixed_up):
    code, out, _ = run("check", mixed_up / "SITE.toml", "--json")
    assert code == 4
    events = {event["event"]: event for event in map(json.loads, out.splitlines())}
    head, *lines = events["result"]["summary"]["plausibility"]
    assert head == ["sensor", "verdict", "evidence", "what to do"]
    for line, (name, other) in zip(lines, (("R1", "R2"), ("R2", "R1")), strict=True):
        assert line[:2] == [name, "does not fit"]
        assert f"the recording fits the pose of {other}" in line[2]
        assert line[3] == f"give this recording with the pose of {other}"
    assert "accept = true in [[sensor]] R1" in events["error"]["hint"]
    parts = events["error"]["parts"]
    assert [part["hint"].partition(";")[0] for part in parts] == [line[3] for line in lines]


def test_a_run_leaves_out_what_does_not_fit_and_a_product_says_what_was_accepted(
    run, mixed_up, rows, in_this_process, blank_paper
):
    for name, file in (("R1", "A"), ("R2", "B")):
        rows[name].to_parquet(mixed_up / f"{file}.parquet", index=False)
    replace(POSES["R1"], northing=POSES["R1"].northing + 1.0).write(mixed_up / "R1.json")
    replace(POSES["R2"], yaw=POSES["R2"].yaw + 180.0).write(mixed_up / "R2.json")
    site = mixed_up / "SITE.toml"
    site.write_text(site.read_text().replace(f'pose = "{SAMPLE}/', 'pose = "'))
    with no_report():
        code, out, _ = run("run", site, "-o", mixed_up / "out", "--json")
    assert code == 4
    events = {event["event"]: event for event in map(json.loads, out.splitlines())}
    assert "no result for R2" in events["error"]["message"]
    assert "yaw is off by 180 deg" in events["error"]["message"]
    hint = "set yaw to -66.4 deg; or go on anyway: accept = true in [[sensor]] R2"
    assert events["error"]["hint"] == hint
    assert "R2 is left out: does not fit: yaw is off" in out
    record = (mixed_up / "out" / "run.json").read_text()
    assert "does not fit: yaw is off" in record
    summary = events["result"]["summary"]
    (doubt,) = summary["not_known_to_fit"]
    assert doubt.startswith("R1: fits, but its pose may be off (")
    assert summary["sensors"]["R1"]["state"] == doubt.removeprefix("R1: ")
    assert doubt in record
    dataset = mixed_up / "out" / "dataset"
    assert gr.open_dataset(dataset).sensors == ["R1"]
    tiles = mixed_up / "out" / "tiles.gpkg"
    code, _, err = run(
        "measure", mixed_up / "B.parquet", "--pose", mixed_up / "R2.json", "--tiles", tiles,
        "--map", MAP, "-o", dataset, "--accept", "R2", "--hits-only",
    )  # fmt: skip
    assert code == 0
    assert "yaw is off by 180 deg" in err
    assert "it is accepted anyway" in err
    checks = gr.open_dataset(dataset).manifest.doubts
    assert list(checks) == ["R1", "R2"]
    assert checks["R2"].startswith("R2: does not fit: yaw is off by 180 deg (")
    code, _, err = run("heatmap", dataset, "-o", mixed_up / "map")
    assert code == 0
    assert checks["R2"] in err
    code, out, _ = run("report", mixed_up / "map", "--dataset", dataset, "--json")
    assert code == 0
    events = [json.loads(line) for line in out.splitlines()]
    assert checks["R2"] in events[-1]["summary"]["remarks"]


def test_a_pose_track_is_judged_at_the_pose_in_force(tmp_path, tiles, rows):
    """What was wrong before anything was recorded does no harm; small corrections are one pose."""
    path = tmp_path / "R1.parquet"
    rows["R1"].to_parquet(path, index=False)
    begin = rows["R1"]["time"].iloc[0]
    right, wrong = POSES["R1"], turned("yaw", YAW + 180.0)

    def measured(*poses, changed_s=20.0):
        since = np.array([begin - 3600.0, begin + changed_s])
        track = PoseTrack(since=since, poses=poses)
        return gr.measure([path], [track], tiles, MAP, tmp_path / "d", hits_only=True, only=True)

    assert measured(wrong, right, changed_s=-60.0).manifest.doubts == {}
    near = replace(right, yaw=YAW + 0.05)
    assert measured(near, right).manifest.doubts == {}
    with pytest.raises(ImplausibleError, match=r"R1: does not fit: yaw is off by 180 deg"):
        measured(wrong, replace(wrong, yaw=YAW + 179.9))


def test_the_pose_of_a_sensor_that_is_not_given_is_refused(tmp_path, tiles, rows):
    rows["R1"].to_parquet(tmp_path / "A.parquet", index=False)
    with pytest.raises(ImplausibleError, match="R2: does not fit"):
        gr.measure(
            [tmp_path / "A.parquet"], [POSES["R2"]], tiles, MAP, tmp_path / "d", hits_only=True
        )


def test_a_doubt_stays_with_the_recording_that_it_is_of(tmp_path, tiles, rows):
    first, later = tmp_path / "first.parquet", tmp_path / "later.parquet"
    times("x", 1.3)(rows["R1"]).to_parquet(first, index=False)
    rows["R1"].assign(time=rows["R1"]["time"] + 7200.0).to_parquet(later, index=False)
    dataset = tmp_path / "d"

    def measured(files, accept):
        given = (files, [POSES["R1"]] * len(files), tiles, MAP, dataset)
        return gr.measure(*given, hits_only=True, accept=accept).manifest.doubts

    with pytest.raises(UsageError, match="R9: no sensor of that name is given"):
        measured([first], ["R9"])
    doubt = measured([first], ["R1"])
    assert "does not fit" in doubt["R1"]
    assert measured([later], []) == doubt
    rows["R1"].to_parquet(first, index=False)
    assert measured([first, later], []) == {}


def test_from_half_way_on_it_is_another_sensor(tmp_path, tiles, minute, rows):
    middle = minute["R1"]["time"].iloc[0] + 30.0
    parts = [
        minute["R1"][minute["R1"]["time"] < middle],
        minute["R2"][minute["R2"]["time"] >= middle],
    ]
    pd.concat(parts).to_parquet(tmp_path / "A.parquet", index=False)
    rows["R2"].to_parquet(tmp_path / "B.parquet", index=False)
    files = [tmp_path / "A.parquet", tmp_path / "B.parquet"]
    with pytest.raises(ImplausibleError, match=r"R1: does not fit: from .*07:30:\S+ on: .* of R2"):
        gr.measure(files, [*POSES.values()], tiles, MAP, tmp_path / "d", hits_only=True)


def test_a_sensor_that_was_knocked_half_way_is_two_in_a_site_file(tmp_path, tiles, minute):
    knocked = minute["R1"].copy()
    late = knocked["time"] >= knocked["time"].median()
    turn, x, y = np.radians(4.0), knocked["x"].copy(), knocked["y"].copy()
    knocked.loc[late, "x"] = (x * np.cos(turn) - y * np.sin(turn))[late]
    knocked.loc[late, "y"] = (x * np.sin(turn) + y * np.cos(turn))[late]
    knocked.to_parquet(tmp_path / "A.parquet", index=False)
    with pytest.raises(ImplausibleError) as refused:
        gr.measure(
            [tmp_path / "A.parquet"], [POSES["R1"]], tiles, MAP, tmp_path / "d", hits_only=True
        )
    (found,) = refused.value.findings
    assert "its pose is off: compared with it, the sensor is turned 4" in found.cause
    assert found.advice.endswith(
        "is two in a site file, with the recordings until then and from then on"
    )


def test_a_clock_that_is_off_is_named_between_sensors_with_a_common_view(tmp_path, tiles, rows):
    rows["R1"].to_parquet(tmp_path / "A.parquet", index=False)
    late = rows["R2"].assign(time=rows["R2"]["time"] + 1.0)
    late.to_parquet(tmp_path / "B.parquet", index=False)
    files = [tmp_path / "A.parquet", tmp_path / "B.parquet"]
    second = r"(0\.99|1\.0\d) ± 0\.0\d s"
    said = rf"R2: .* clock and that of R1 are apart \(.* this one is {second} ahead"
    with pytest.raises(ImplausibleError, match=said) as e:
        gr.measure(files, [*POSES.values()], tiles, MAP, tmp_path / "d", hits_only=True)
    assert re.search(rf"R1: .* that of R2 are apart \(.* {second} behind", e.value.message)
    assert [each.sensor for each in e.value.findings] == ["R1", "R2"]
    clocks = {"R2": SensorClock(offset_s=-1.0)}
    with pytest.raises(ImplausibleError, match=r"this one is (1\.9|2\.0)\d ± ") as e:
        gr.measure(files, [*POSES.values()], tiles, MAP, tmp_path / "d", clocks=clocks)
    assert e.value.hint.count("its times were corrected by +1.00 s: is the sign right?") == 1
    clocks = {"R2": SensorClock(offset_s=1.0)}
    gr.measure(files, [*POSES.values()], tiles, MAP, tmp_path / "d", hits_only=True, clocks=clocks)


@pytest.mark.parametrize("seconds", [0.5, 60])
def test_right_poses_pass_and_too_little_traffic_is_said(tmp_path, tiles, minute, seconds):
    """A careful survey is 0.3 m off, and drivers keep off the middle."""
    table = minute["R1"]
    table[table["time"] < table["time"].iloc[0] + seconds].to_parquet(tmp_path / "R1.parquet")
    near = replace(POSES["R1"], easting=POSES["R1"].easting + 0.3)
    heard = Listener()
    made = gr.measure(
        [tmp_path / "R1.parquet"], [near], tiles, MAP, tmp_path / "d", hits_only=True,
        reporter=heard,
    )  # fmt: skip
    said = {"R1": "R1: too little traffic to tell: 4 vehicles move, 10 are needed"}
    assert made.manifest.doubts == ({} if seconds == 60 else said)
    assert ("too little traffic" in str(heard.messages)) == (seconds < 1)


def test_a_few_vehicles_tell_a_pose_that_is_turned(tmp_path, minute):
    """They do not tell that a pose fits; with none of them on lanes, it does not."""
    table = minute["R1"]
    table[table["time"] < table["time"].iloc[0] + 1.0].to_parquet(tmp_path / "R1.parquet")
    lanes = LaneMap(lanelets=gr.read_map(MAP).lanelets, road=np.empty((0, 3)))

    def found(pose):
        recorded = RecordedSensor(
            recordings=[gr.open_recording(tmp_path / "R1.parquet")], tracks=[as_track(pose)]
        )
        return check_plausibility({"R1": recorded}, lanes)[0]

    right, wrong_way = found(POSES["R1"]), found(turned("yaw", YAW + 180.0))
    assert right.verdict == UNKNOWN
    assert "vehicles move, 10 are needed" in right.evidence
    assert wrong_way.refused
    assert wrong_way.cause == "yaw is off by 180 deg"


def test_without_elevation_and_without_a_map_poses_are_judged_as_well(tmp_path, tiles, rows):
    rows["R1"].assign(z=np.float32(np.nan)).to_parquet(tmp_path / "R1.parquet")
    made = gr.measure(
        [tmp_path / "R1.parquet"], [POSES["R1"]], tiles, None, tmp_path / "d", hits_only=True
    )
    assert made.manifest.doubts == {}
    with pytest.raises(ImplausibleError, match="yaw is off by 180 deg"):
        gr.measure(
            [tmp_path / "R1.parquet"], [turned("yaw", YAW + 180.0)], tiles, None, tmp_path / "e",
            hits_only=True,
        )  # fmt: skip


def test_how_surely_a_pitch_is_off_does_not_depend_on_where_north_is(tmp_path, minute):
    """Where map and pose are turned together, the error of a pitch is not that of a roll."""
    minute["R2"].to_parquet(tmp_path / "R2.parquet")
    pose, lanelets = POSES["R2"], gr.read_map(MAP).lanelets
    off = replace(pose, pitch=pose.pitch + 1.7)
    sigmas = []
    for turn in (0.0, 90.0):
        by = {"angle": turn, "origin": (pose.easting, pose.northing)}
        there = lanelets.assign(**{n: lanelets[n].rotate(**by) for n in ("centre", "geometry")})
        recorded = RecordedSensor(
            recordings=[gr.open_recording(tmp_path / "R2.parquet")],
            tracks=[as_track(replace(off, yaw=pose.yaw + turn))],
        )
        lanes = LaneMap(lanelets=there, road=np.empty((0, 3)))
        (found,) = check_plausibility({"R2": recorded}, lanes)
        stated = re.search(r"tilted 2\.\d+ ± ([\d.]+) deg up", found.evidence)
        sigmas.append(float(stated[1]))
    assert sigmas[1] == pytest.approx(sigmas[0], abs=0.03)


def test_a_pitch_that_the_traffic_does_not_show_is_not_said_to_fit(tmp_path, minute):
    """Across a street a pitch and a height raise all that passes alike."""
    table = minute["R1"]
    table[table["x"].between(35.0, 45.0)].to_parquet(tmp_path / "R1.parquet")
    recorded = RecordedSensor(
        recordings=[gr.open_recording(tmp_path / "R1.parquet")], tracks=[as_track(POSES["R1"])]
    )
    lanes = LaneMap(lanelets=gr.read_map(MAP).lanelets, road=np.empty((0, 3)))
    (found,) = check_plausibility({"R1": recorded}, lanes)
    hidden = re.search(r"off by up to .*?([\d.]+) deg of pitch", found.evidence)
    assert float(hidden[1]) > 3.0


@pytest.mark.parametrize(
    ("there", "named"),
    [
        ({"roll": -90.0, "yaw": 0.2}, "is tilted by 90 deg"),
        ({"yaw": 20.0, "pitch": 40.0}, "turned 20.0 deg anticlockwise, seen from above, tilted by"),
        ({"yaw": 5.0, "roll": 1.0}, "is turned 5.0 deg anticlockwise, seen from above"),
    ],
)
def test_a_pose_that_is_tilted_is_said_to_be(there, named):
    pose = replace(gr.read_pose(gr.sample_folder() / "R1.json"), yaw=0.0, pitch=3.0, roll=0.0)
    assert named in other_pose(pose, replace(pose, **there)).causes[0].text


def write_knocked(folder, table):
    """Write recordings of a sensor before and after a knock, an hour apart; return their paths."""
    turn, paths = np.radians(20.0), (folder / "A.parquet", folder / "B.parquet")
    later = table.assign(
        time=table["time"] + 3600.0,
        x=np.cos(turn) * table["x"] - np.sin(turn) * table["y"],
        y=np.sin(turn) * table["x"] + np.cos(turn) * table["y"],
    )
    for path, each in zip(paths, (table, later), strict=True):
        each.astype(table.dtypes).to_parquet(path, index=False)
    return paths


@pytest.mark.parametrize("ahead_s", [0.0, 7200.0])
def test_the_moment_of_a_knock_is_by_the_clock_of_the_recordings(tmp_path, rows, ahead_s):
    paths = write_knocked(tmp_path, rows["R1"])
    recorded = RecordedSensor(
        recordings=[gr.open_recording(path) for path in paths],
        tracks=[as_track(POSES["R1"])] * 2, clock=SensorClock(offset_s=ahead_s),
    )  # fmt: skip
    lanes = LaneMap(lanelets=gr.read_map(MAP).lanelets, road=np.empty((0, 3)))
    (found,) = check_plausibility({"R1": recorded}, lanes)
    begin, end = rows["R1"]["time"].iloc[[0, -1]]
    assert end < pd.Timestamp(found.moment).timestamp() < begin + 3630.0


def test_a_sensor_that_was_knocked_keeps_its_earlier_recordings(
    run, tmp_path, rows, in_this_process, blank_paper
):
    write_knocked(tmp_path, rows["R1"])
    (tmp_path / "SITE.toml").write_text(
        f'title = "A"\ntimezone = "UTC"\n[map]\nfile = "{MAP}"\ncrs = "EPSG:25832"\n'
        '[vehicles]\nfollow = false\n[[sensor]]\nname = "R1"\n'
        f'recordings = ["A.parquet", "B.parquet"]\npose = "{SAMPLE}/R1.json"\n'
    )
    with no_report():
        code, out, err = run("run", tmp_path / "SITE.toml", "-o", tmp_path / "out")
    assert code == 4
    assert "R1 is left out but for its earlier recordings: does not fit: from" in out + err
    assert "of R1 only a part is in the heat maps; R1: does not fit: from" in err
    with no_report():
        again = gr.run_site(tmp_path / "SITE.toml", tmp_path / "out")
    assert "; only a part of R1: R1: does not fit: from" in repr(again)
    dataset = gr.open_dataset(tmp_path / "out" / "dataset")
    assert dataset.sensors == ["R1"]
    assert dataset.recordings()["path"].tolist() == [str(tmp_path / "A.parquet")]


@pytest.mark.parametrize(("before_end_s", "kept"), [(10.0, ["A", "B"]), (70.0, ["A"])])
def test_a_recording_that_ends_soon_after_the_moment_of_a_knock_is_judged_by_itself(
    tmp_path, rows, monkeypatch, before_end_s, kept
):
    table = rows["R1"]
    paths = [tmp_path / f"{name}.parquet" for name in "ABC"]
    for hour, path in enumerate(paths):
        table.assign(time=table["time"] + 3600.0 * hour).to_parquet(path, index=False)
    moment = iso(table["time"].iloc[-1] + 3600.0 - before_end_s)
    judged = []

    def measured(recordings, *_, **__):
        judged.append([path.stem for path in recordings])
        if len(judged) == 1:
            found = Finding(sensor="R1", verdict=WRONG, evidence="", moment=moment)
            raise ImplausibleError("R1", findings=(found,))

    monkeypatch.setattr(recipes, "measure_recordings", measured)
    track = as_track(POSES["R1"])
    _, refused = recipes.measure_site(
        {"R1": (paths, track)}, tmp_path, MAP, tmp_path, reporter=QUIET
    )
    assert judged == [["A", "B", "C"], kept]
    assert list(refused) == ["R1"]

"""The sensors of a site together: one places another, two contradict each other, one is alone."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from fake_stages import execute
from maps import Listener
from sites import recording
from small_site import write_map
from test_joint import LONG, TRAFFIC, stated

import gis_radar as gr
from gis_radar.calibration import AmbiguousError, Localization
from gis_radar.poses import View
from gis_radar.products.report.content import how_found
from gis_radar.site import SiteRun, stages_of
from gis_radar.site import stages as work

POSES = (
    work.road_stage, work.localize_stage, work.together_stage, work.pose_stage,
    work.tied_pose_stage,
)  # fmt: skip
R2 = 'recordings = "R2.parquet"'
GUESS = "guess = [690000, 5336000]"
SENSOR = f'\n[[sensor]]\nname = "{{0}}"\nrecordings = "{{0}}.parquet"\n{GUESS}\n{{1}}\n'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with map, road and recordings of two sensors on one street, and their poses."""
    folder = tmp_path_factory.mktemp("site")
    write_map(LONG, folder / "map.osm")
    LONG.write_road(folder / "road.laz")
    far = replace(
        LONG.pose(place=(165.0, 9.0), yaw=184.0),
        sensor="R2", view=View(elevation_deg=60.0, max_range_m=115.0),
    )  # fmt: skip
    true = {"R1": LONG.pose(), "R2": far}
    for number, (name, pose) in enumerate(true.items()):
        LONG.record(folder / f"{name}.parquet", pose, noise=number, **TRAFFIC)
    return SimpleNamespace(folder=folder, true=true)


@pytest.fixture
def run(site, tmp_path, monkeypatch):
    """Find the poses of a site, each alone as given, and return how it ended."""

    def call(alone, **options):
        def localize(paths, *_, sensor, **__):
            found = alone[sensor]
            if isinstance(found, Exception):
                raise found
            return Localization(pose=found, fitness=0.9, observable=True, recording=paths[0].name)

        monkeypatch.setattr("gis_radar.calibration.localize", localize)
        path = site.folder / f"{tmp_path.name}.toml"
        sensors = "".join(SENSOR.format(name, options.get(name, "")) for name in alone)
        sensors = sensors.replace(R2, options.get("recordings", R2))
        for name, line in options.get("guess", {}).items():
            head, own = sensors.split(f'"{name}.parquet"\n')
            sensors = f'{head}"{name}.parquet"\n{own.replace(GUESS, line, 1)}'
        path.write_text(
            'title = "Street"\n[map]\nfile = "map.osm"\ncrs = "EPSG:25832"\n'
            f'[scan]\nroad = "road.laz"\n{options.get("more", "")}{sensors}'
        )
        read, heard = gr.read_site(path), Listener()
        stages = [each for each in stages_of(read, tmp_path) if each.work in POSES]
        outcomes = list(execute(stages, tmp_path, reporter=heard).values())
        return SimpleNamespace(
            outcomes=outcomes, folder=tmp_path, heard=heard,
            told="\n".join(text for _, text in heard.messages),
            done=SiteRun(site=read, folder=tmp_path, outcomes=outcomes),
            pose=lambda name: gr.read_pose(tmp_path / "sensors" / name / "pose.json"),
        )  # fmt: skip

    return call


@pytest.fixture(scope="module")
def traffic(site):
    """A third sensor at the place of the second, before which other vehicles drive."""
    other = TRAFFIC | {"seed": 77}
    return LONG.record(site.folder / "R3.parquet", site.true["R2"], noise=9, **other)


def several(*poses):
    """The refusal of a sensor that fits in several places."""
    answers = tuple(Localization(pose=each, fitness=0.9, observable=True) for each in poses)
    name = poses[0].sensor
    return AmbiguousError("{}: ambiguous, two poses", name, hint="record longer", answers=answers)


def test_two_sensors_gain_by_each_other(site, run):
    known = stated(site.true["R2"], spread_m=3.0, along_m=2.0)
    found = run({"R1": stated(site.true["R1"]), "R2": known})
    assert found.done.failure is None
    pose = found.pose("R2")
    assert abs(pose.easting - site.true["R2"].easting) < 0.5
    gained = pose.evidence["together"]["gained"]["easting"]
    assert gained["after"] < 0.3 * gained["before"]
    line = r"R2: position \u00b1 0.\d\d m \(alone 3.\d\d\), yaw .*; \d+ vehicles shared with R1"
    assert re.search(line, found.told)
    single = gr.read_pose(found.folder / "sensors" / "R2" / "localization.json")
    assert single.easting == known.easting
    shown = found.done.figures()["sensors"]["R2"]
    assert (shown["easting"], shown["fitness"]) == (round(pose.easting, 3), 0.9)
    assert "vehicles that R" in how_found(pose.evidence)


def test_a_sensor_that_alone_is_refused_is_placed_by_its_neighbour(site, run):
    places = [stated(site.true["R2"], along_m=far, spread_m=0.5) for far in (14.0, 0.4)]
    found = run({"R1": stated(site.true["R1"]), "R2": several(*places)})
    assert found.done.failure is None
    assert abs(found.pose("R2").easting - site.true["R2"].easting) < 0.6
    assert "alone it was refused (ambiguous, two poses)" in found.told
    made = {path.name for path in found.done.outputs}
    assert {"candidates.json", "together.json"} <= made
    assert not (found.folder / "sensors" / "R2" / "localization.json").exists()


def test_swapped_guesses_leave_no_wrong_pose(site, run, traffic, monkeypatch):
    """The recording of R3 fits a wrong place by chance, that of R1 fits the place of R3's guess."""

    def localize_one(path, *_, guess, **__):
        if (path.stem, guess[0]) not in {("R1", 690400.0), ("R3", 690000.0)}:
            raise gr.NoAnswerError("no place fits")

    monkeypatch.setattr("gis_radar.calibration.localize_one", localize_one)
    alone = {"R1": gr.NoAnswerError("R1: nothing fits"), "R3": stated(site.true["R2"])}
    far = {"R3": "guess = [690400, 5336000]"}
    found = run(alone, guess=far)
    assert found.done.missing.keys() == {"R1", "R3"}
    assert "R3: no pose, as the traffic of R1 fits its guess: are guesses swapped?" in found.told
    monkeypatch.setattr("gis_radar.calibration.localize_one", several)  # none is asked for
    near = run(alone, more="")
    assert near.done.missing.keys() == {"R1"}


def test_one_that_nobody_places_keeps_its_reason_and_stops_no_other(site, run, traffic):
    places = [stated(replace(site.true["R2"], sensor="R3"), along_m=far) for far in (0.0, 14.0)]
    found = run({"R1": stated(site.true["R1"]), "R3": several(*places)})
    failure = found.done.failure
    assert (failure.exit_code, found.done.missing.keys()) == (4, {"R3"})
    assert failure.message.endswith("R3: ambiguous, two poses")
    assert found.pose("R1").easting == site.true["R1"].easting
    assert "R3: not placed: no other sensor sees enough of the same vehicles" in found.told


def test_two_that_contradict_each_other_are_named_in_one_line(site, run):
    alone = {"R1": stated(site.true["R1"]), "R2": stated(site.true["R2"], along_m=4.0)}
    found = run(alone)
    failure = found.done.failure
    assert failure.exit_code == 4
    line = (
        "no result for R1, R2; there is no heat map; R1 and R2: their poses contradict each other: "
    )
    assert failure.message.startswith(line)
    assert "clocks" in failure.hint
    warned = [text for level, text in found.heard.messages if level == "warning"]
    assert sum("contradict" in text for text in warned) == 1
    assert not (found.folder / "sensors" / "R1" / "pose.json").exists()
    again = run(alone, R2="tied = false")  # the user knows better
    assert again.done.failure is None
    assert "poses together" not in {each.stage.name for each in again.outcomes}


def test_a_sensor_with_bad_data_stops_no_other(site, run):
    found = run({"R1": stated(site.true["R1"]), "R2": gr.InputError("R2.parquet: damaged")})
    assert type(found.done.failure) is gr.InputError
    assert "R1: alone: no other sensor has a pose" in found.told
    assert found.pose("R1").easting == site.true["R1"].easting


def test_a_damaged_recording_beside_a_good_one_stops_no_other(site, run):
    """The pose of R2 was found from its good recording; the damaged one is of the same time."""
    whole = (site.folder / "R2.parquet").read_bytes()
    (site.folder / "R2_2.parquet").write_bytes(whole[: len(whole) // 2])
    alone = {name: stated(pose) for name, pose in site.true.items()}
    found = run(alone, recordings='recordings = ["R2.parquet", "R2_2.parquet"]')
    assert found.done.failure is None
    assert "vehicles shared with R1" in found.told
    (site.folder / "R5.parquet").write_bytes(whole[: len(whole) // 2])
    alone["R5"] = stated(replace(site.true["R2"], sensor="R5"))
    found = run(alone)
    assert found.done.failure is None  # its hit share would say so
    assert re.search(r"R5: alone: .*R5\.parquet: ", found.told)


def test_what_changes_is_solved_again(site, run):
    alone = {name: stated(pose) for name, pose in site.true.items()}
    assert {each.state for each in run(alone).outcomes} == {"done"}
    assert {each.state for each in run(alone).outcomes} == {"kept"}
    (site.folder / "clocks.json").write_text(json.dumps({"clocks": {"R2": {"offset_s": 0.0}}}))
    later = run(alone, more='[measure]\nclocks = "clocks.json"\n')
    states = {each.stage.name: each.state for each in later.outcomes}
    assert states == {
        "road": "kept", "localize R1": "kept", "localize R2": "kept", "poses together": "done",
        "pose R1": "kept", "pose R2": "kept",
    }  # fmt: skip


def test_measured_clocks_are_used_and_others_are_found(site, run):
    time, xyz, rate = LONG.detections(site.true["R2"], noise=1, **TRAFFIC)
    recording(site.folder / "R4.parquet", time + 2.0, xyz, range_rate=rate)
    alone = {"R1": stated(site.true["R1"]), "R4": stated(replace(site.true["R2"], sensor="R4"))}
    warned = [text for level, text in run(alone).heard.messages if level == "warning"]
    assert [text.partition(" that of")[0] for text in warned] == [
        "poses together: the clock of R4 is 2.00 s ahead of"
    ]
    (site.folder / "clocks.json").write_text(json.dumps({"clocks": {"R4": {"offset_s": 2.0}}}))
    quiet = run(alone, more='[measure]\nclocks = "clocks.json"\n')
    assert "warning" not in {level for level, _ in quiet.heard.messages}
    assert "vehicles shared with R1" in quiet.told


def test_a_site_of_one_sensor_refuses_one_that_fits_in_several_places(site, run):
    found = run({"R2": several(*[stated(site.true["R2"], along_m=far) for far in (0.0, 14.0)])})
    failure = found.done.failure
    assert (failure.exit_code, failure.hint) == (4, "record longer")
    assert failure.message.endswith("R2: ambiguous, two poses")


@pytest.mark.parametrize(("reach_m", "warnings"), [(115.0, 0), (90.0, 1)])
def test_only_another_view_than_that_of_a_given_pose_is_a_warning(
    site, tmp_path, reach_m, warnings
):
    """What site file and pose state alike overrules nothing."""
    site.true["R2"].write(tmp_path / "R2.json")
    listener = Listener()
    work.pose_stage(
        pose=tmp_path / "R2.json", outputs=[tmp_path / "pose.json"], reporter=listener,
        sensor="R2", view=vars(View(elevation_deg=60.0, max_range_m=reach_m)), given=True,
    )  # fmt: skip
    assert [level for level, _ in listener.messages] == warnings * ["warning"]
    assert gr.read_pose(tmp_path / "pose.json").view.max_range_m == 115.0

"""The commands about what sensors delivered: options reach their arguments, tables come out."""

import shutil
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pytest
from click.testing import CliRunner

import gis_radar as gr
from gis_radar.cli import group

SAMPLE = gr.sample_folder()
BEGIN = 1_749_713_400.0  # of its recordings
MAP = ("--map", str(SAMPLE / "junction.osm"))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with tiles, a second of two recordings and their poses."""
    folder = tmp_path_factory.mktemp("made")
    roads = gr.read_map(SAMPLE / "junction.osm")
    gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
    for name in ("R1", "R2"):
        table = pd.read_parquet(SAMPLE / f"{name}.parquet")
        table[table["time"] < BEGIN + 1.0].to_parquet(folder / f"{name}.parquet", index=False)
        gr.read_pose(SAMPLE / f"{name}.json").write(folder / f"{name}.json")
    return folder


@pytest.fixture
def site(made, tmp_path, monkeypatch):
    """A copy of it; it is where we are."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


def run(*words):
    return CliRunner().invoke(group, list(words))


BOTH = (
    "R1.parquet", "R2.parquet", "--pose", "R1.json", "--pose", "R2.json", "--tiles", "tiles.gpkg",
)  # fmt: skip


@pytest.mark.parametrize(
    ("words", "cycles"),
    [
        ((), None),
        (("--cycle", "R1=57ms,R2=0.1s"), {"R1": 0.057, "R2": 0.1}),
    ],
)
def test_options_reach_their_arguments(site, monkeypatch, words, cycles):
    seen = {}

    def caught(*_, **options):
        seen.update(options)
        raise gr.NoAnswerError("enough")

    monkeypatch.setattr("gis_radar.dataset.measure", caught)
    (site / "clocks.json").write_text('{"clocks": {"R2": {"offset_s": 3.5}}}')
    answer = run(
        "measure", *BOTH, *MAP, "-o", "site", "--clocks", "clocks.json", "--hits-only",
        "--min-speed", "0.5", "--timezone", "Europe/Berlin", "--jobs", "3", *words,
    )  # fmt: skip
    assert "the clock of R1 is not corrected" in answer.output
    assert seen["cycles"] == cycles
    assert seen["clocks"]["R2"].offset_s == 3.5
    assert seen["filters"] == gr.Filters(min_speed=0.5)
    assert (seen["hits_only"], seen["timezone"], seen["processes"]) == (True, "Europe/Berlin", 3)


def test_lanes_have_the_streets_of_the_tiles(site):
    line = gr.read_map(SAMPLE / "junction.osm").lanes().set_index("lane").geometry.loc[[83]]
    gpd.GeoDataFrame({"name": ["Weststraße"]}, geometry=list(line), crs=line.crs).to_file(
        site / "streets.gpkg"
    )
    words = ("tiles", MAP[1], "--streets", "streets.gpkg", "-o", "tiles.gpkg")
    assert run(*words).exit_code == 0
    assert run("measure", *BOTH, *MAP, "-o", "site", "--hits-only").exit_code == 0
    streets = gr.open_dataset("site").lanes().set_index("lane")["street"]
    tiles = gpd.read_file("tiles.gpkg", layer="lanes").set_index("lane")["street"]
    assert streets[83] == "Weststraße"
    assert streets.dropna().to_dict() == tiles.dropna().to_dict()
    gr.open_dataset("site").state_lanes([{"id": 83, "name": "To the harbour"}])
    named = (Path("site") / "lanes.json").read_bytes()
    assert run("measure", *BOTH, *MAP, "-o", "site", "--hits-only").exit_code == 0
    assert (Path("site") / "lanes.json").read_bytes() == named


@pytest.mark.parametrize("text", ["57ms", "auto", "R1=fast", "R1=57", "R1=57ms,,R2=1s"])
def test_cycles_that_cannot_be_read(site, text):
    answer = run("measure", *BOTH, *MAP, "-o", "site", "--cycle", text)
    assert answer.exit_code == 2
    assert "--cycle" in answer.output
    assert not (site / "site").exists()


def test_clocks_correct_the_times_of_frames(site):
    (site / "clocks.json").write_text(
        '{"clocks": {"R1": {"offset_s": 0}, "R2": {"offset_s": 3.5}}}'
    )
    words = ("-o", "site", "--hits-only", "--clocks", "clocks.json")
    assert run("measure", *BOTH, *MAP, *words).exit_code == 0
    ds = gr.open_dataset("site")
    shift_us = ds.frames().groupby("sensor")["shift_us"].first()
    assert shift_us.to_dict() == {"R1": 0, "R2": -3_500_000}
    assert ds.recordings().set_index("sensor")["clock_offset"].to_dict() == {"R1": 0.0, "R2": 3.5}


def test_a_recording_is_withdrawn_and_found_again(site):
    assert run("measure", *BOTH, *MAP, "-o", "site", "--hits-only").exit_code == 0
    (site / "moved").mkdir()
    (site / "R1.parquet").rename(site / "moved" / "else.parquet")
    answer = run("dataset", "site", "--withdraw", "R2.parquet")
    assert isinstance(answer.exception, gr.InputError)
    assert answer.exception.exit_code == 3
    assert "R1.parquet: is not there" in answer.exception.message
    assert run("dataset", "site", "--relink", "moved", "--withdraw", "R2.parquet").exit_code == 0
    ds = gr.open_dataset("site")
    assert ds.sensors == ["R1"]
    assert ds.recordings()["path"].tolist() == [(site / "moved" / "else.parquet").as_posix()]


def test_a_folder_to_look_in_has_to_be_there(site):
    assert run("measure", *BOTH, *MAP, "-o", "site", "--hits-only").exit_code == 0
    answer = run("dataset", "site", "--relink", "nowhere")
    assert isinstance(answer.exception, gr.InputError)
    assert "nowhere: is no folder" in answer.exception.message


def test_what_a_dataset_keeps_or_makes_again_is_said(site):
    assert run("measure", *BOTH, *MAP, "-o", "site", "--hits-only").exit_code == 0
    pose = gr.read_pose("R1.json")
    replace(pose, yaw=pose.yaw + 1.0).write("R1.json")
    words = ("--hits-only", "--timezone", "Europe/Berlin")
    said = run("measure", *BOTH, *MAP, "-o", "site", *words).output
    assert "R1.parquet: is placed or timed otherwise than before" in " ".join(said.split())
    assert "stays in the time zone UTC" in " ".join(said.split())


def test_outputs_do_not_replace_inputs(site):
    for words in (
        ("clocks", *BOTH, "-o", "R1.parquet"),
        ("measure", *BOTH, *MAP, "-o", "tiles.gpkg"),
        ("measure", *BOTH, *MAP, "-o", "R1.parquet"),
    ):
        assert isinstance(run(*words).exception, gr.OutputError), words

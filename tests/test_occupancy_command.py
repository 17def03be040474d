"""The commands about what sensors delivered: options reach their arguments, tables come out."""

import json

import pandas as pd
import pytest
from click.testing import CliRunner
from sites import START, crossing, pose, recording

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.occupancy.tile_sets import decode_tiles

ON_TILE = [12.25, 0.0, -5.0]


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder with tiles, two recordings of slow radars and their poses; it is where we are."""
    monkeypatch.chdir(tmp_path)
    problems = crossing().iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    gr.write_tiles(crossing(), tmp_path / "tiles.gpkg", problems=problems)
    for name in ("R1", "R2"):
        gr.write_pose(pose(sensor=name), tmp_path / f"{name}.json")
        time = [START + 0.1 * k for k in range(120)]
        recording(tmp_path / f"{name}.parquet", time, [ON_TILE] * 120, range_rate=3.0)
    return tmp_path


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
def test_cycles_and_clocks_reach_their_arguments(site, monkeypatch, words, cycles):
    seen = {}

    def caught(*_, **options):
        seen.update(options)
        raise gr.NoAnswerError("enough")

    monkeypatch.setattr("gis_radar.occupancy.measure_occupancy", caught)
    (site / "clocks.json").write_text('{"clocks": {"R2": {"offset_s": 3.5}}}')
    answer = run("occupancy", *BOTH, "-o", "occ", "--clocks", "clocks.json", *words)
    assert "the clock of R1 is not corrected" in answer.output
    assert seen["cycles"] == cycles
    assert seen["clocks"]["R2"].offset_s == 3.5


@pytest.mark.parametrize("text", ["57ms", "auto", "R1=fast", "R1=57", "R1=57ms,,R2=1s"])
def test_cycles_that_cannot_be_read(site, text):
    answer = run("occupancy", *BOTH, "-o", "occ", "--cycle", text)
    assert answer.exit_code == 2
    assert "--cycle" in answer.output
    assert not (site / "occ").exists()


def test_pairs_are_written_for_other_programs(site):
    assert run("occupancy", *BOTH, "-o", "occ", "--pairs").exit_code == 0
    table = pd.read_parquet("occ/hits.parquet")
    assert list(table) == ["step", "tile_id"]
    assert len(table) == 120 == len(table.drop_duplicates())
    sets = pd.read_parquet("occ/hits_by_sensor.parquet")
    assert sum(len(decode_tiles(each)) for each in sets["tiles"]) == 240


@pytest.mark.parametrize("words", [("heatmap", "--tiles", "tiles.gpkg", "-o", "map"), ("quality",)])
def test_commands_name_folders_of_older_rules_and_do_not_merge_them(site, words):
    for name in ("old", "new"):
        run("occupancy", *BOTH, "-o", name, "--pairs")
    manifest = json.loads((site / "old" / "manifest.json").read_text())
    (site / "old" / "manifest.json").write_text(json.dumps(manifest | {"rules": 1, "hold_s": {}}))
    alone = run(words[0], "old", *words[1:])
    assert alone.exit_code == 0
    assert "warning: old: follows rules 1, not 2" in alone.output
    both = run(words[0], "new", "old", *words[1:])
    assert isinstance(both.exception, gr.InputError)
    assert both.exception.message == "old: follows rules 1, new rules 2: they do not merge"


def test_clocks_are_found_or_refused(site, monkeypatch):
    """Two radars in one place on a vehicle that stands in the Doppler of one lane: no answer."""
    answer = run("occupancy", *BOTH, "-o", "occ", "--clocks", "auto")
    assert isinstance(answer.exception, gr.NoAnswerError)
    assert not (site / "occ").exists()
    clocks = {
        name: gr.SensorClock(offset_s=0.5 * i, at=START) for i, name in enumerate(("R1", "R2"))
    }
    found = gr.Clocks(reference="R1", clocks=clocks, refused={"R3": "with R1: nothing"}, pairs={})
    for place in ("gis_radar.measure_clocks", "gis_radar.clocks.measure_clocks"):
        monkeypatch.setattr(place, lambda *_, **__: found)
    answer = run("clocks", *BOTH, "-o", "clocks.json", "--reference", "R1")
    assert answer.exit_code == 0
    assert "+0.500 s" in answer.output
    assert "no answer: with R1: nothing" in answer.output
    assert gr.read_clocks("clocks.json").keys() == {"R1", "R2"}
    assert run("occupancy", *BOTH, "-o", "occ", "--clocks", "auto").exit_code == 0
    rows = pd.read_parquet("occ/deliveries.parquet")
    assert rows.groupby("sensor")["shift_us"].first().to_dict() == {"R1": 0, "R2": -500_000}


def test_quality_is_said_and_written(site):
    answer = run("occupancy", *BOTH, "-o", "occ")
    assert "warning: R1: frozen: 99 % of the frames repeat the last" in answer.output
    answer = run("quality", "nowhere", "-o", "q.xlsx")
    assert isinstance(answer.exception, gr.UsageError)  # before the folder is looked for
    answer = run("quality", "occ", "--timezone", "Europe/Berlin", "-o", "q.csv")
    assert answer.exit_code == 0
    assert "0 of 1 hours good; frozen" in answer.output
    table = pd.read_csv("q.csv")
    assert table["sensor"].tolist() == ["R1", "R2"]
    assert table["hour"].tolist() == [23, 23]


def test_outputs_do_not_replace_inputs(site):
    run("occupancy", *BOTH, "-o", "occ")
    for words in (
        ("clocks", *BOTH, "-o", "R1.parquet"),
        ("quality", "occ", "-o", "occ/hits_by_sensor.parquet"),
        ("occupancy", *BOTH, "-o", "tiles.gpkg", "--clocks", "tiles.gpkg"),
    ):
        assert isinstance(run(*words).exception, gr.OutputError), words
    for _ in range(2):
        assert run("quality", "occ", "-o", "occ/quality.csv").exit_code == 0
    assert run("occupancy", *BOTH, "-o", "occ").exit_code == 0

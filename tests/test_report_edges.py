"""Reports of odd folders, hostile names and very many intervals; refusals; the command."""

from __future__ import annotations

import csv
import errno
import json
import shutil

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from datasets import recordings_of, write_dataset
from report_site import (
    FILES,
    FORMULA,
    HOSTILE,
    Page,
    report_tiles,
    write_results,
    write_run,
    write_whole_run,
)

import gis_radar as gr
from gis_radar.base.spreadsheets import safe
from gis_radar.cli import group
from gis_radar.products import REPORT_FILES, make_heatmap
from gis_radar.products.heatmap.heatmap import OWNED_BY_HEATMAP
from gis_radar.products.report import report


@pytest.fixture(scope="module")
def results(once):
    return once("whole run", write_whole_run)


def test_text_of_others_stays_text(tmp_path, blank_paper):
    folder = write_results(tmp_path, names=(HOSTILE, FORMULA), interval=None, steps=400)
    write_run(folder, title=f"Site {HOSTILE} & \"quotes'")
    gr.write_report(folder)
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert HOSTILE not in text
    page = Page(text)
    assert page.tags.count("script") == 0  # one map alone needs none
    assert any(HOSTILE in cell for table in page.tables for row in table for cell in row)
    assert "".join(page.words).count(f"Town of {HOSTILE}") >= 1
    with (folder / "quality.csv").open(encoding="utf-8", newline="") as file:
        assert {row["sensor"] for row in csv.DictReader(file)} == {HOSTILE, f"'{FORMULA}"}


@pytest.mark.parametrize("begin", list("=+-@\t\r\n") + [" =", "\uff1d"])
def test_no_cell_begins_a_formula(begin):
    assert safe(f"{begin}cmd|' /C calc'!A0").startswith("'")


@pytest.mark.parametrize("number", [-0.5, 3, 0.0, np.float64(-2.5), np.int64(-7)])
def test_numbers_stay_numbers(number):
    assert safe(number) == number
    assert not isinstance(safe(number), str)


def test_what_is_not_known_is_empty():
    assert [safe(None), safe(float("nan")), safe(pd.NaT)] == ["", "", ""]


def test_a_heat_map_alone_asks_for_its_dataset(results, tmp_path, blank_paper):
    shutil.copytree(results / "heatmap", tmp_path / "map")
    with pytest.raises(gr.InputError, match="no such dataset") as caught:
        gr.write_report(tmp_path / "map")
    assert caught.value.hint == "name the dataset that the heat map was made of"
    report = gr.write_report(tmp_path / "map", dataset=results / "dataset")
    assert sorted(path.name for path in report.outputs) == sorted(FILES)
    text = (tmp_path / "map" / "report.html").read_text(encoding="utf-8")
    assert "All times: UTC." in text
    short = [each for each in report.summary["remarks"] if " were recorded: " in each]
    assert [each.endswith("and no usual day") for each in short] == [True]
    assert repr(report).startswith("Report('map', 5 files: ")
    assert "report.html" in report._repr_html_()
    # a new heat map takes the place of both
    make_heatmap(gr.open_dataset(results / "dataset")).write(tmp_path / "map")
    assert not (tmp_path / "map" / "report.html").exists()


def test_a_dataset_of_other_tiles_is_refused(results, tmp_path):
    shutil.copytree(results / "heatmap", tmp_path / "run" / "heatmap")
    other = write_dataset(tmp_path / "run" / "dataset").folder
    for given in (None, other):
        with pytest.raises(gr.InputError, match="the heat map was not made of"):
            gr.write_report(tmp_path / "run", dataset=given)


@pytest.mark.parametrize("other", ["another sensor", "another day"])
def test_a_dataset_that_the_heat_map_was_not_made_of_is_refused(results, tmp_path, other):
    shutil.copytree(results / "heatmap", tmp_path / "run" / "heatmap")
    tiles, sensor = gr.open_dataset(results / "dataset").layer("tiles"), "R9"
    if other == "another day":
        sensor = gr.open_dataset(results / "dataset").sensors[0]
    write_dataset(tmp_path / "run" / "dataset", tiles=tiles, recordings=recordings_of([sensor]))
    with pytest.raises(gr.InputError, match="the heat map was not made of"):
        gr.write_report(tmp_path / "run")


def test_a_file_of_somebody_beside_a_heat_map_stays(results, tmp_path):
    shutil.copytree(results / "heatmap", tmp_path / "map")
    (tmp_path / "map" / "heatmap_notes.txt").write_text("mine")
    heat = make_heatmap(gr.open_dataset(results / "dataset"))
    with pytest.raises(gr.OutputError, match="heatmap_notes"):
        heat.write(tmp_path / "map")
    assert (tmp_path / "map" / "heatmap_notes.txt").read_text() == "mine"


def tiles_file(folder):
    tiles = report_tiles()
    problems = gpd.GeoDataFrame({"action": []}, geometry=[], crs=tiles.crs)
    gr.write_tiles(tiles, folder / "tiles.gpkg", problems=problems)
    return folder / "tiles.gpkg"


def test_a_sensor_without_a_result_is_told_first(results, tmp_path, blank_paper):
    shutil.copytree(results, tmp_path / "run")
    write_run(
        tmp_path / "run", title="x", sensors_in_heat_maps=["R1", "R2"],
        stages=[{"name": "localize R3", "error": "two places fit", "warnings": ["a <b> c"]}],
    )  # fmt: skip
    document = json.loads((tmp_path / "run" / "run.json").read_text())
    document["site"]["sensor"] = [{"name": name} for name in ("R1", "R2", "R3")]
    (tmp_path / "run" / "run.json").write_text(json.dumps(document))
    gr.write_report(tmp_path / "run")
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "No result for sensor R3: two places fit" in text
    assert "localize R3: a &lt;b&gt; c" in text
    assert "no result: two places fit" in text


def test_a_warning_of_several_stages_is_told_once(results, tmp_path, blank_paper):
    shutil.copytree(results, tmp_path / "run")
    stages = [{"name": name, "warnings": ["27 repaired"] * 2} for name in ("mask", "tiles")]
    write_run(tmp_path / "run", title="x", sensors_in_heat_maps=["R1", "R2"], stages=stages)
    gr.write_report(tmp_path / "run")
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert text.count("27 repaired") == 1
    assert "mask, tiles: 27 repaired" in text


@pytest.mark.parametrize("kind", ["missing", "empty", "broken", "run"])
def test_refusals(kind, tmp_path):
    folder = tmp_path / "there"
    if kind != "missing":
        folder.mkdir()
    if kind == "broken":
        (folder / "heatmap.gpkg").write_bytes(b"no database")
    if kind == "run":
        (folder / "run.json").write_text("{")
    with pytest.raises(gr.InputError) as caught:
        gr.write_report(folder)
    assert str(folder) in caught.value.message
    assert "\n" not in caught.value.message
    assert not list(tmp_path.rglob("report.*"))


def test_a_zone_that_is_none(results, tmp_path):
    with pytest.raises(gr.UsageError, match="time zone"):
        gr.write_report(results, output=tmp_path, timezone="Mars/Olympus")


def test_very_many_intervals_share_pictures(tmp_path, blank_paper):
    folder = write_results(tmp_path, interval="250ms", names=("R1",), steps=500)
    report = gr.write_report(folder)
    text = (folder / "report.html").read_text(encoding="utf-8")
    frames = Page(text).all("img")
    assert sum(each.get("class") == "frame" for each in frames) == 50
    assert report.summary["pictures"] == 51
    assert "100 intervals; each picture shows 2 of them together" in text
    assert len(pd.read_csv(folder / "lanes_by_interval.csv")) == 100 * 3


def test_the_options_of_the_command_reach_their_arguments(results, tmp_path, blank_paper):
    shutil.copytree(results / "heatmap", tmp_path / "map")
    words = [
        "report", str(tmp_path / "map"), "-o", str(tmp_path / "out"), "--title", "Main Street",
        "--timezone", "Asia/Kolkata", "--language", "de", "--csv-locale", "de",
        "--dataset", str(results / "dataset"), "--json",
    ]  # fmt: skip
    done = CliRunner().invoke(group, words)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout.splitlines()[-1])["summary"]["timezone"] == "Asia/Kolkata"
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for part in ('<html lang="de">', "<h1>Main Street</h1>", "Asia/Kolkata"):
        assert part in text
    assert (tmp_path / "out" / "quality.csv").read_bytes().startswith(b"\xef\xbb\xbf")


def test_a_folder_without_a_heat_map_is_bad_input(tmp_path):
    done = CliRunner().invoke(group, ["report", str(tmp_path)])
    assert isinstance(done.exception, gr.InputError)
    assert str(done.exception).startswith(f"{tmp_path}: holds no heat map")


def test_a_heat_map_takes_the_place_of_a_report_in_its_folder():
    assert all(name.startswith(OWNED_BY_HEATMAP) for name in REPORT_FILES)


def test_a_table_of_an_earlier_report_does_not_stay(results, tmp_path, blank_paper):
    shutil.copytree(results, tmp_path / "run")
    gr.write_report(tmp_path / "run")
    assert (tmp_path / "run" / "quality.csv").is_file()
    gr.open_dataset(tmp_path / "run" / "dataset").keep(0.0)  # what sensors delivered is gone
    gr.write_report(tmp_path / "run")
    assert sorted(path.name for path in (tmp_path / "run").glob("*.csv")) == [
        "lanes.csv", "lanes_by_interval.csv",
    ]  # fmt: skip
    # a file that no report has written stays
    shutil.copytree(results / "heatmap", tmp_path / "map")
    (tmp_path / "map" / "quality.csv").write_text("mine")
    gr.write_report(tmp_path / "map", dataset=tmp_path / "run" / "dataset")
    assert (tmp_path / "map" / "quality.csv").read_text() == "mine"


def test_a_full_disk_leaves_no_new_folder(results, tmp_path, monkeypatch, blank_paper):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(report, "page_of", full)
    (tmp_path / "mine").mkdir()
    for place in (tmp_path / "new" / "report", tmp_path / "mine"):
        with pytest.raises(gr.OutputError, match="the disk is full"):
            gr.write_report(results, output=place)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_chosen_output_that_is_a_file(results, tmp_path):
    (tmp_path / "report").write_text("mine")
    with pytest.raises(gr.OutputError, match="report"):
        gr.write_report(results, output=tmp_path / "report")
    assert (tmp_path / "report").read_text() == "mine"

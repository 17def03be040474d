"""Runs of a small site, and of the sample: results, inputs, exit codes."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import geopandas as gpd
import laspy
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pypdf
import pytest
import scans
from click.testing import CliRunner
from maps import Listener
from site_runs import HITS_ALONE, change, only_pictures, results, states
from streets import errors

import gis_radar as gr
from gis_radar.base import only_writer, refuse_foreign
from gis_radar.cli import group
from gis_radar.demo import pose_errors
from gis_radar.scans import SightScan, SightTiles
from gis_radar.site import run as product
from gis_radar.site import site_template, stages_of
from gis_radar.site.plan import OWNED_BY_RUN


def test_the_whole_way(small):
    _, out, true = small
    found = gr.read_pose(out / "sensors" / "R1" / "pose.json")
    assert found.sensor == "R1"
    assert found.view.max_range_m == 150.0
    assert found.evidence["scan_check"]["verdict"] == "nothing to compare"  # a bare road
    assert (np.abs(errors(found, true["R1"])) < [0.4, 0.4, 0.2, 0.5, 0.5, 0.3]).all()
    given = gr.read_pose(out / "sensors" / "R2" / "pose.json")
    assert given.sensor == "R2"
    assert errors(given, true["R2"]) == pytest.approx(np.zeros(6), abs=1e-9)
    assert gr.read_tiles(out / "tiles.gpkg")["height_m"].notna().all()
    # The same by hand.
    measured = gr.open_dataset(out / "dataset")
    heat = gr.make_heatmap(measured, interval="10s")
    wide = gpd.read_parquet(out / "heatmap" / "heatmap.parquet")
    for column in ("hit_s", "visible_s", "occupancy"):
        assert wide[column].to_numpy() == pytest.approx(heat.wide()[column].to_numpy(), nan_ok=True)
    assert wide["occupied_s"].sum() > 0
    stages = json.loads((out / "run.json").read_text())["stages"]
    (stage,) = [stage for stage in stages if stage["name"] == "measure"]
    assert stage["figures"]["vehicles"] == len(measured.vehicles()) > 0
    names = {"road.laz", "tiles.gpkg", "run.json", "sensors/R1/localization.png",
             "heatmap/heatmap.gpkg", "heatmap/heatmap.tif", "heatmap/heatmap.png",
             "sensors.gpkg", "sight.gpkg", "site.qgz", "report.html", "report.pdf", "lanes.csv",
             "lanes_by_interval.csv", "quality.csv"}  # fmt: skip
    assert names <= set(results(out))


def test_the_project_shows_the_sensors_of_the_heat_map(small):
    _, out, _ = small
    assert list(gpd.read_file(out / "sensors.gpkg", layer="sensors")["sensor"]) == ["R1", "R2"]
    stages = json.loads((out / "run.json").read_text())["stages"]
    (stage,) = [stage for stage in stages if stage["name"] == "QGIS project"]
    assert stage["outputs"] == ["sensors.gpkg", "sight.gpkg", "site.qgz"]


def test_single_vehicles_are_shown_by_choice(copied, blank_paper, without_report):
    path, out = copied
    text = path.read_text(encoding="utf-8")
    for chosen in (True, False):
        given = f"{text}\n[vehicles]\nfootprints = {str(chosen).lower()}\n"
        path.write_text(given, encoding="utf-8")
        done = gr.run_site(path, out)
        assert states(done)["measure"] == "kept"
        assert (out / "footprints.gpkg").exists() == chosen
        assert (out / "footprints.gpkg" in done.outputs) == chosen
    # Without its state, a folder is still a result, which is made again.
    (out / "footprints.gpkg").touch()
    shutil.rmtree(out / ".gis-radar")
    refuse_foreign(out, OWNED_BY_RUN)


def test_what_was_in_effect_is_beside_the_results(small):
    path, out, _ = small
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert run["finished"] is True
    assert run["sensors_in_heat_maps"] == ["R1", "R2"]
    assert set(run["inputs"]) == {each.name for each in path.parent.iterdir()}
    assert all(re.fullmatch("[0-9a-f]{32}", found) for found in run["inputs"].values())
    assert run["site"]["sensor"][0]["recordings"] == ["R1.parquet"]
    assert run["site"]["measure"]["clearance"] == [-0.5, 4.5]
    assert {"gis_radar", "numpy", "python"} <= set(run["software"])
    warnings = [text for stage in run["stages"] for text in stage["warnings"]]
    assert any("R2_0.parquet: 99.9 %" in text for text in warnings)


def test_what_stands_elsewhere_is_a_warning(small, copied, without_report):
    """A scan check that doubts is no failure; it is in pose, picture and figures."""
    path, out = copied
    scan = laspy.read(path.parent / "scan_1.laz")
    pose = small[2]["R1"]
    rng = np.random.default_rng(4)
    recorded = pd.read_parquet(path.parent / "R1.parquet")
    trees = np.column_stack([rng.uniform(25, 70, 25), rng.uniform(-30, 30, 25), np.full(25, 0.5)])
    places = np.repeat(trees, 8, axis=0) + rng.uniform(-1.2, 1.2, (200, 3)) * [1.0, 1.0, 0.1]
    times = recorded["time"].unique()
    still = pd.DataFrame(np.tile(places, (len(times), 1)), columns=["x", "y", "z"]).assign(
        time=np.repeat(times, len(places)), rcs=5.0, range_rate=0.0
    )
    both = pd.concat([recorded, still]).sort_values("time", kind="stable")[[*recorded.columns]]
    both.astype(recorded.dtypes).to_parquet(path.parent / "R1.parquet", index=False)
    turned = replace(pose, yaw=pose.yaw + 20.0)  # the crowns stand 20 degrees aside
    crowns = np.repeat(turned.to_map(trees), 300, axis=0)
    crowns += rng.uniform(-1.5, 1.5, crowns.shape)
    xyz = np.vstack([scan.xyz, crowns]) - [scans.EAST, scans.NORTH, 0.0]
    kinds = np.r_[np.asarray(scan.classification), np.full(len(crowns), 5, np.uint8)]
    scans.write_points(path.parent / "scan_1.laz", xyz, category=kinds)
    path.write_text(path.read_text() + HITS_ALONE)
    with only_pictures("localization.png"):
        done = gr.run_site(path, out)
    assert done.failure is None
    look = gr.read_pose(out / "sensors" / "R1" / "pose.json").evidence["scan_check"]
    assert look["verdict"] == "doubts", look
    assert done.figures()["sensors"]["R1"]["scan_check"] == "doubts"
    (stage,) = [each for each in done.outcomes if each.stage.name == "localize R1"]
    assert any(text.startswith("scan check: doubts: ") for text in stage.warnings)
    picture = plt.imread(out / "sensors" / "R1" / "localization.png")
    assert picture.shape[0] > 7 * 216  # a second row of panels: alone the traces have 6.6 inches


def test_the_report_shows_occupancy_and_its_tables_hits_beside_it(small):
    _, out, _ = small
    wide = gpd.read_parquet(out / "heatmap" / "heatmap.parquet")
    lanes = pd.read_csv(out / "lanes.csv")
    sums = {name: wide[name].sum() for name in ("occupied_s", "visible_s", "hit_s")}
    for name, total in sums.items():
        column = name.replace("_s", "_tile_s")
        assert lanes[column].sum() == pytest.approx(total, abs=0.01 * len(lanes))
    sure = wide["occupancy"] - wide["occupancy_se"]
    top = sure.idxmax()
    best = (lanes["busiest_spot"] - lanes["busiest_spot_se"]).idxmax()
    assert lanes.loc[best, "busiest_spot"] == pytest.approx(wide["occupancy"][top], abs=1e-6)
    assert lanes.loc[best, "busiest_spot_se"] == pytest.approx(wide["occupancy_se"][top], abs=1e-6)
    by_interval = pd.read_csv(out / "lanes_by_interval.csv")
    assert by_interval["occupied_tile_s"].sum() == pytest.approx(sums["occupied_s"], abs=0.5)
    assert by_interval["hit_tile_s"].sum() == pytest.approx(sums["hit_s"], abs=0.5)
    text = (out / "report.html").read_text(encoding="utf-8")
    for words in (
        "Traffic occupancy report", "Seen and inferred", "no count of vehicles",
        "share of time with a vehicle",
    ):  # fmt: skip
        assert words in text
    assert "radar hits" not in text
    shown, error = (100 * wide[name][top] for name in ("occupancy", "occupancy_se"))
    assert f"{shown:.0f}\u202f±\u202f{error:.0f}\u202f%" in text
    about = pypdf.PdfReader(out / "report.pdf").metadata
    assert about.subject == "Traffic occupancy report"


def test_vehicles_that_are_not_followed_leave_heat_maps_of_hits(
    copied, blank_paper, without_report
):
    path, out = copied
    path.write_text(path.read_text() + HITS_ALONE)
    done = gr.run_site(path, out)
    assert states(done)["measure"] == "done"
    assert not (out / "dataset" / "tracks").exists()
    assert gr.read_heatmap(out / "heatmap").measure == "hit_share"
    assert not (out / "heatmap" / "heatmap.tif").exists()


def test_a_track_and_a_road_that_are_there(
    small, tmp_path, in_this_process, all_fit, blank_paper, without_report
):
    path, out, _ = small
    folder = tmp_path / "site"
    shutil.copytree(path.parent, folder)
    shutil.copy(out / "road.laz", folder)
    pose = json.loads((out / "sensors" / "R1" / "pose.json").read_text())
    names = ("sensor", "crs", "easting", "northing", "height", "yaw", "pitch", "roll")
    with (folder / "R1_track.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", *names])
        rows.writerow(["2023-11-14T22:13:20Z", *(pose[name] for name in names)])
    site = folder / "SITE.toml"
    change(site, 'files = ["scan*.laz"]', 'road = "road.laz"')
    text = re.sub(r"guess = .*\ncompass = .*", 'pose = "R1_track.csv"', site.read_text())
    site.write_text(text + HITS_ALONE)
    done = gr.run_site(site, tmp_path / "out", jobs=1)
    assert done.failure is None
    assert (tmp_path / "out" / "sensors" / "R1" / "track.csv").is_file()
    shown = gpd.read_file(tmp_path / "out" / "sensors.gpkg", layer="sensors")
    assert list(shown["sensor"]) == ["R1", "R2"]
    one, other = (gr.open_dataset(each / "dataset").hits() for each in (out, tmp_path / "out"))
    pd.testing.assert_frame_equal(one, other)


def test_bad_places_for_results(small, tmp_path):
    path = small[0]
    (tmp_path / "file").touch()
    with pytest.raises(gr.OutputError, match="cannot be written"):
        gr.run_site(path, tmp_path / "file")
    with pytest.raises(gr.OutputError, match="would replace the input"):
        gr.run_site(path, path.parent)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter.txt").touch()
    with pytest.raises(gr.OutputError, match=r"holds 'letter.txt'"):
        gr.run_site(path, tmp_path / "home")
    assert [each.name for each in (tmp_path / "home").iterdir()] == ["letter.txt"]
    with pytest.raises(gr.UsageError, match="jobs is 0"):
        gr.run_site(path, tmp_path / "out", jobs=0)
    state = tmp_path / "two" / product.STATE
    state.mkdir(parents=True)
    with (
        only_writer(tmp_path / "two", lock=state / "lock"),
        pytest.raises(gr.OutputError, match="two: another run is writing it"),
    ):
        gr.run_site(path, tmp_path / "two")


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written(small, tmp_path):
    (tmp_path / "out").mkdir(mode=0o500)
    with pytest.raises(gr.OutputError, match="cannot be written: Permission denied"):
        gr.run_site(small[0], tmp_path / "out")


class Recorder:
    """Stands for `gis_radar.convert`: converts by copying, and splits sensors where asked to."""

    def __init__(self, sensors=("a",)):
        self.sensors, self.heard = sensors, {}

    def convert(self, inputs, output, **options):
        self.heard = {"inputs": inputs, **options}
        places = [output.with_name(f"{name}.parquet") for name in self.sensors]
        for place in places:
            shutil.copyfile(inputs[0], place)
        recordings = [SimpleNamespace(sensor=name) for name in self.sensors]
        return SimpleNamespace(outputs=places, recordings=recordings, figures=lambda: {"frames": 3})


def test_other_formats_are_converted_first(small, tmp_path, monkeypatch):
    folder = tmp_path / "site"
    shutil.copytree(small[0].parent, folder)
    (folder / "R1.parquet").rename(folder / "R1.bag")
    site = folder / "SITE.toml"
    convert = 'convert = { columns = { x = "-X" }, clock = "sensor" }'
    change(site, '["R1.parquet"]', f'"R1.bag"\n{convert}')
    stages = {stage.name: stage for stage in stages_of(gr.read_site(site), tmp_path / "out")}
    stage = stages["convert R1"]
    assert "convert R2" not in stages
    assert stages["localize R1"].inputs["recordings"] == stage.outputs
    assert set(stage.outputs) < set(stages["measure"].reads)
    recorder = Recorder()
    monkeypatch.setattr("gis_radar.recordings.convert", recorder.convert)
    stage.outputs[0].parent.mkdir(parents=True)
    words = {"outputs": stage.outputs, "reporter": Listener(), **stage.arguments}
    assert stage.work(**words) == {"frames": 3}
    assert stage.outputs[0].read_bytes() == (folder / "R1.bag").read_bytes()
    assert recorder.heard["columns"] == {"x": "-X"}
    assert (recorder.heard["clock"], recorder.heard["sensor"]) == ("sensor", None)
    monkeypatch.setattr("gis_radar.recordings.convert", Recorder(("a", "b")).convert)
    with pytest.raises(gr.InputError, match="has several sensors: a, b"):
        stage.work(**words)


def test_the_options_of_the_command_reach_their_arguments(monkeypatch, tmp_path):
    heard = {}

    def listen(*places, **options):
        heard.update(options, places=places)
        raise gr.NoAnswerError("heard")

    monkeypatch.setattr(gr, "run_site", listen, raising=False)
    words = ["run", "S.toml", "-o", str(tmp_path), "--jobs", "3", "--fresh"]
    assert isinstance(CliRunner().invoke(group, words).exception, gr.NoAnswerError)
    assert heard["places"] == (Path("S.toml"), tmp_path)
    assert (heard["jobs"], heard["fresh"]) == (3, True)
    printed = CliRunner().invoke(group, ["run", "--template"])
    assert (printed.exit_code, printed.stdout) == (0, site_template())


@pytest.fixture
def demo(run, once):
    """The folder of the demo and its result: as `make test` has made it, or made here."""

    def made(folder):
        code, said, _ = run("demo", "-o", folder / "demo", "--json")
        assert code == 0
        return folder / "demo", said

    ready = os.environ.get("GIS_RADAR_DEMO")
    if ready:
        folder = Path(ready)
        said = folder.with_suffix(".jsonl").read_text(encoding="utf-8")
    else:
        folder, said = once("demo", made)
    return folder, json.loads(said.splitlines()[-1])


def test_the_demo_finds_its_sensors(demo):
    folder, result = demo
    figures = result["summary"]
    assert all(Path(path).exists() for path in result["outputs"])
    for sensor in ("R1", "R2"):
        off = figures["errors_of_the_poses"][sensor]
        assert off["2D_m"] < 0.5
        assert abs(off["height_m"]) < 0.3
        assert max(abs(off[f"{name}_deg"]) for name in ("yaw", "pitch", "roll")) < 0.5
    for name in ("road.laz", "tiles.gpkg", "dataset/dataset.json", "heatmap/heatmap.gpkg"):
        assert (folder / name).is_file()


def test_the_scan_of_a_site_gives_sight(demo):
    folder, _ = demo
    tiles = gr.read_tiles(folder / "tiles.gpkg")
    road = SightTiles.of(tiles)
    scan = SightScan([gr.sample_folder() / "scan.laz"], road)
    measured = gr.open_dataset(folder / "dataset")
    recordings, sights = measured.recordings(), measured.sights()
    for sensor in ("R1", "R2"):
        assert measured.manifest.settings["sight"]["scan"] == scan.digest
        seen = gr.find_sight(gr.read_pose(folder / "sensors" / sensor / "pose.json"), road, scan)
        assert seen.figures()["hidden"] > 0
        (row,) = recordings[recordings["sensor"] == sensor].itertuples()
        mine = sights[sights["pose"] == row.pose]
        assert sorted(mine["tile_id"]) == seen.seen.tolist()
    kept = list((folder / ".gis-radar" / "sights").rglob("*.npz"))
    assert len(kept) == 2  # found once a sensor: recordings and hours share it


def test_errors_of_poses_turn_the_short_way():
    true = gr.read_pose(gr.sample_folder() / "R1.json")
    found = replace(true, yaw=true.yaw - 359.0, easting=true.easting + 3.0, height=true.height - 1)
    off = pose_errors(replace(found, northing=true.northing + 4.0), true)
    assert off == {"2D_m": 5.0, "height_m": -1.0, "yaw_deg": 1.0, "pitch_deg": 0.0, "roll_deg": 0.0}

"""Bad input: one sentence in the log, QGIS lives, no broken GeoPackage."""

import os
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path

import pytest
from conftest import ROOT, SAMPLE, WORKER
from helpers import Feedback, is_whole, layer_called, leftovers, one_sentence
from qgis.core import QgsProcessingFeatureSourceDefinition, QgsProject, QgsVectorLayer
from test_algorithms import memory_copy, parameters_of, tiles_layer


def refused(run, name, parameters, *parts):
    results, heard = run(name, parameters)
    assert results is None
    said = one_sentence(heard)
    for part in parts:
        assert part in said
    return said


def added(layer):
    QgsProject.instance().addMapLayer(layer)
    return layer.id()


def test_a_wrong_layer(run, site, tmp_path):
    layer = QgsVectorLayer(f"{site}/heatmap/heatmap.gpkg|layername=by_interval", "long",
                           "ogr")  # fmt: skip
    parameters, made = parameters_of("measure", site, tmp_path)
    refused(run, "measure", parameters | {"TILES": added(layer)},
            "'long' is not one of tiles: it lacks index, s_m")  # fmt: skip
    assert not made.exists()


def test_a_layer_without_crs(run, site, tmp_path):
    layer = memory_copy(tiles_layer(site), lambda row: row["tile_id"] < 5)
    layer.setCrs(type(layer.crs())())
    parameters, _ = parameters_of("measure", site, tmp_path)
    refused(run, "measure", parameters | {"TILES": added(layer)},
            "'in memory' has no coordinate system: set it first")  # fmt: skip


def test_a_layer_in_degrees(run, site, tmp_path):
    layer = QgsVectorLayer("Polygon?crs=EPSG:4326", "degrees", "memory")
    fields = [field for field in tiles_layer(site).fields() if field.name() != "fid"]
    layer.dataProvider().addAttributes(fields)
    layer.updateFields()
    parameters, _ = parameters_of("measure", site, tmp_path)
    refused(run, "measure", parameters | {"TILES": added(layer)},
            "'degrees' is in degrees (EPSG:4326)")  # fmt: skip
    parameters, _ = parameters_of("maskroad", site, tmp_path)
    parameters.pop("MAP")
    refused(run, "maskroad", parameters | {"ROADS": layer.id()}, "is in degrees")


def test_an_empty_selection(run, site, tmp_path):
    key = added(tiles_layer(site))
    nothing = QgsProcessingFeatureSourceDefinition(key, selectedFeaturesOnly=True)
    parameters, _ = parameters_of("measure", site, tmp_path)
    refused(run, "measure", parameters | {"TILES": nothing}, "nothing in it is selected")


def test_map_and_polygons(run, site, tmp_path):
    parameters, _ = parameters_of("maskroad", site, tmp_path)
    parameters.pop("MAP")
    refused(run, "maskroad", parameters, "either a Lanelet2 map or a layer of road polygons")


def test_other_tiles(run, site, brief, tmp_path):
    """Tiles of another length do not fit a dataset."""
    shutil.copytree(site / "dataset", tmp_path / "dataset")
    other = {"MAP": str(SAMPLE / "junction.osm"), "LENGTH": 1.0}
    _, heard = run("splitlanelets", other | {"OUTPUT": str(tmp_path / "other.gpkg")})
    assert heard.errors == []
    parameters, made = parameters_of("measure", site, tmp_path)
    parameters["RECORDINGS"] = [str(brief / f"{name}.parquet") for name in ("R2", "R1")]
    before = made.read_bytes()
    tiles = f"{tmp_path}/other.gpkg|layername=tiles"
    refused(run, "measure", parameters | {"TILES": tiles}, str(tmp_path / "dataset"), "tiles")
    assert made.read_bytes() == before


def test_a_folder_that_is_no_dataset(run, site, tmp_path):
    call = {"DATASET": str(site / "heatmap"), "OUTPUT": str(tmp_path / "q.csv")}
    refused(run, "quality", call, str(site / "heatmap"))
    assert not (tmp_path / "q.csv").exists()


def test_poses_and_recordings_that_do_not_pair(run, site, tmp_path):
    parameters, _ = parameters_of("measure", site, tmp_path)
    poses = parameters["POSES"]
    refused(run, "measure", parameters | {"POSES": poses[:1]}, "2 recordings and 1 poses")
    other = tmp_path / "R9.json"
    other.write_text(Path(poses[0]).read_text().replace('"R2"', '"R9"'))
    refused(run, "measure", parameters | {"POSES": [str(other), poses[1]]}, "Only some")


@pytest.mark.parametrize("name", ["splitlanelets", "heatmap"])
def test_a_folder_that_cannot_be_written(run, site, tmp_path, name):
    """As root nothing is read-only, but nobody makes a file in /proc."""
    parameters, made = parameters_of(name, site, tmp_path)
    out = Path("/proc/gis_radar") / Path(parameters["OUTPUT"]).name
    refused(run, name, parameters | {"OUTPUT": str(out)}, "/proc/gis_radar")


LOCK = (
    "import sqlite3, sys\n"
    "editor = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
    "editor.execute('BEGIN EXCLUSIVE')\nprint('locked', flush=True)\nsys.stdin.read()"
)


def test_an_output_that_is_open_in_qgis(run, site, tmp_path, copying_worker, monkeypatch):
    """It is replaced as a whole, and the layer shows what is there now; not while others write."""
    parameters, made = parameters_of("heatmap", site, tmp_path)
    _, heard = run("heatmap", dict(parameters), load=True)
    assert heard.errors == []
    layer = layer_called("Occupancy by interval")
    assert layer.featureCount() == 5 * 5387
    assert sum(1 for _ in layer.getFeatures()) == 5 * 5387
    monkeypatch.setenv("GIS_RADAR_PYTHON", WORKER)
    _, heard = run("heatmap", parameters | {"INTERVAL": "50s"}, load=True)
    assert heard.errors == []
    layer = layer_called("Occupancy by interval")  # still one: it was not loaded twice
    assert sum(1 for _ in layer.getFeatures()) == 2 * 5387
    assert layer.featureCount() == 2 * 5387
    QgsProject.instance().clear()  # or the file is in use, and cannot be locked
    assert is_whole(made)
    assert sorted(path.name for path in made.parent.iterdir()) == [
        "heatmap.gpkg", "heatmap.parquet", "heatmap.png", "heatmap.qml", "heatmap.tif", "hits.tif",
    ]  # fmt: skip
    before = made.read_bytes()
    words = ["/usr/bin/python3", "-c", LOCK, str(made)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as editor:
        assert editor.stdout.readline() == b"locked\n"
        refused(run, "heatmap", parameters, "another program has it locked", "try again")
        editor.stdin.close()
    assert made.read_bytes() == before
    assert leftovers(tmp_path) == []


def test_two_runs_at_once(run, provider, site, tmp_path):
    """Two background runs with outputs of their own do not disturb each other."""
    from gis_radar_plugin.runner import Listener, run_worker

    done = {}

    def work(name):
        words = ["sensors", str(SAMPLE / "R1.json"), "-o", str(tmp_path / f"{name}.gpkg")]
        done[name] = run_worker(os.environ["GIS_RADAR_PYTHON"], words, Listener())

    threads = [threading.Thread(target=work, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert done["a"].summary == done["b"].summary
    assert is_whole(tmp_path / "a.gpkg")
    assert is_whole(tmp_path / "b.gpkg")


def test_a_worker_of_another_version(run, site, tmp_path, fake_worker, monkeypatch):
    fake_worker("sys.exit(1)", version="9.9.1")
    monkeypatch.setattr("gis_radar_plugin.base.plugin_version", lambda: "9.8.0")
    parameters, _ = parameters_of("heatmap", site, tmp_path)
    said = refused(run, "heatmap", parameters)
    assert said == (
        "The worker is gis_radar 9.9.1, the plugin 9.8.0: run 'Set up the worker' again."
    )


def test_a_python_without_gis_radar(run, site, tmp_path, monkeypatch):
    monkeypatch.setenv("GIS_RADAR_PYTHON", "/usr/bin/python3")
    parameters, _ = parameters_of("heatmap", site, tmp_path)
    refused(run, "heatmap", parameters, "/usr/bin/python3 has no gis_radar: run 'Set up")


def test_a_program_that_is_no_python(run, site, tmp_path, monkeypatch):
    broken = tmp_path / "broken"
    broken.write_text("no program\n")
    broken.chmod(0o755)
    monkeypatch.setenv("GIS_RADAR_PYTHON", str(broken))
    parameters, _ = parameters_of("heatmap", site, tmp_path)
    refused(run, "heatmap", parameters, "does not start")


def test_words_beside_the_protocol_are_shown(run, site, tmp_path, fake_worker):
    """A library that prints, bytes that are no UTF-8, an empty object: the run goes on."""
    fake_worker(
        "os.write(1, b'caf\\xe9 says hello\\n[1, 2]\\n{}\\n\\n')\n"
        "say(event='log', level='warning', message='mind the gap')\n"
        "say(event='result', outputs=[], summary={})"
    )
    parameters, _ = parameters_of("samplesite", site, tmp_path)
    results, heard = run("samplesite", parameters)
    assert results is not None
    assert "mind the gap" in heard.infos
    assert any("says hello" in text for text in heard.infos)


def test_much_on_standard_error_does_not_block(run, site, tmp_path, fake_worker):
    fake_worker("print('x' * 5_000_000, file=sys.stderr)\nsay(event='result', outputs=[])")
    parameters, _ = parameters_of("samplesite", site, tmp_path)
    results, _ = run("samplesite", parameters)
    assert results is not None


def test_qgis_dies_during_a_run(site, tmp_path, fake_worker):
    """The worker notices that nobody holds its standard input any more."""
    fake_worker("")  # only for its folder
    script = tmp_path / "qgis.py"
    script.write_text(
        "import sys, threading\n"
        "sys.path.insert(0, sys.argv[1])\n"
        "from gis_radar_plugin.runner import Listener, run_worker\n"
        "class Told(Listener):\n"
        "    def progress(self, stage, done, total):\n        print(stage, flush=True)\n"
        "run_worker(sys.argv[2], sys.argv[3:], Told())\n"
    )
    out = tmp_path / "occ"
    words = ["/usr/bin/python3", str(script), str(ROOT / "qgis_plugin"), WORKER, "measure",
             str(SAMPLE / "R1.parquet"), "--pose", str(SAMPLE / "R1.json"),
             "--tiles", str(site / "tiles.gpkg"),
             "--map", str(SAMPLE / "junction.osm"), "-o", str(out)]  # fmt: skip
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as qgis:
        assert qgis.stdout.readline()
        tasks = Path(f"/proc/{qgis.pid}/task").glob("*/children")
        children = [child for task in tasks for child in task.read_text().split()]
        assert children
        qgis.send_signal(signal.SIGKILL)
    for _ in range(3000):
        if not any(Path(f"/proc/{child}").exists() for child in children):
            break
        time.sleep(0.1)
    else:
        pytest.fail("the worker lives on")
    assert not list(out.rglob("*.part"))
    assert leftovers(tmp_path) == []


def test_a_damaged_map(run, site, tmp_path):
    broken = tmp_path / "broken.osm"
    broken.write_text("<osm><node")
    parameters, made = parameters_of("splitlanelets", site, tmp_path)
    refused(run, "splitlanelets", parameters | {"MAP": str(broken)}, "broken.osm")
    assert not made.exists()


def test_a_heat_map_that_is_none(run, tmp_path):
    refused(run, "exportreport", {"HEATMAP": str(tmp_path), "OUTPUT": str(tmp_path / "r")},
            "heatmap.gpkg: no such file")  # fmt: skip
    assert not (tmp_path / "r").exists()
    assert leftovers(tmp_path) == []


def test_feedback_that_is_cancelled_before(run, site, tmp_path):
    heard = Feedback()
    heard.cancel()
    parameters, made = parameters_of("heatmap", site, tmp_path)
    results, heard = run("heatmap", parameters, feedback=heard)
    assert results is None
    assert not made.exists()


def test_the_site_is_as_it_was(site):
    """No run above has touched its inputs."""
    assert is_whole(site / "tiles.gpkg")
    assert is_whole(site / "heatmap" / "heatmap.gpkg")
    assert shutil.disk_usage(site).free

"""Each algorithm in a real QGIS: run, progress, cancel, crash, missing worker, odd layers."""

import json
import time
from pathlib import Path

import pytest
from conftest import SAMPLE
from helpers import Feedback, algorithm, layer_called, leftovers, one_sentence
from qgis.core import (
    QgsFeature,
    QgsGeometry,
    QgsProcessingFeatureSourceDefinition,
    QgsProject,
    QgsRectangle,
    QgsVectorLayer,
)

IDS = (
    "splitlanelets", "maskroad", "localizeradar", "trackpose", "sight",
    "convertrecordings", "clocks", "measure", "heatmap", "monthmap", "footprints", "detections",
    "quality", "dataset", "traffic", "compare", "runsite", "exportreport", "sitereport",
    "qgisproject", "setupworker", "samplesite",
)  # fmt: skip
# One class turns all into the worker's command; of these one has two commands.
BY_WORKER = ("heatmap", "localizeradar")


def parameters_of(name, site, out):
    """Return a call of an algorithm that works, and its main output."""
    calls = {
        "splitlanelets": ({"MAP": SAMPLE / "junction.osm", "ROAD": site / "road.laz",
                           "OUTPUT": out / "tiles.gpkg"}, "tiles.gpkg"),
        "maskroad": ({"SCANS": [SAMPLE / "scan.laz"], "MAP": SAMPLE / "junction.osm",
                      "OUTPUT": out / "road.laz"}, "road.laz"),
        "localizeradar": ({"RECORDING": SAMPLE / "R1.parquet", "MAP": SAMPLE / "junction.osm",
                           "ROAD": site / "road.laz", "GUESS": "11.559382,48.150384 [EPSG:4326]",
                           "COMPASS": "68", "POSE": out / "R1.json", "FIGURE": out / "R1.png",
                           "OUTPUT": out / "R1.gpkg"}, "R1.gpkg"),
        "convertrecordings": ({"INPUT": [SAMPLE / "R1.parquet"], "OUTPUT": out / "c.parquet"},
                              "c.parquet"),
        "measure": ({"RECORDINGS": [SAMPLE / "R1.parquet", SAMPLE / "R2.parquet"],
                     "POSES": [SAMPLE / "R2.json", SAMPLE / "R1.json"],
                     "TILES": f"{site}/tiles.gpkg|layername=tiles", "CLEARANCE": "-0.5,4.5",
                     "MAP": SAMPLE / "junction.osm", "SCANS": [SAMPLE / "scan.laz"],
                     "OUTPUT": out / "dataset"}, "dataset/dataset.json"),
        "heatmap": ({"DATASET": site / "dataset", "INTERVAL": "20s", "OUTPUT": out / "map"},
                    "map/heatmap.gpkg"),
        "traffic": ({"DATASET": site / "dataset", "INTERVAL": "1min", "OUTPUT": out / "traffic"},
                    "traffic/traffic.gpkg"),
        "runsite": ({"SITE": SAMPLE / "SITE.toml", "OUTPUT": out / "run"}, "run/site.qgz"),
        "samplesite": ({"OUTPUT": out / "sample"}, "sample/junction.osm"),
    }  # fmt: skip
    call, made = calls[name]
    text = {
        key: [str(path) for path in value] if isinstance(value, list) else str(value)
        for key, value in call.items()
    }
    return text, out / made


def test_ids_are_stable(provider):
    assert sorted(alg.name() for alg in provider.algorithms()) == sorted(IDS)


@pytest.mark.parametrize("name", IDS)
def test_each_says_what_it_is(provider, name):
    one = algorithm(name)
    assert one.shortHelpString().startswith("<p>")
    assert not any(" %" in each.shortHelpString() for each in provider.algorithms())
    assert one.displayName() and one.group() and one.groupId().isalpha()
    assert not one.icon().isNull()
    assert Path(one.svgIconPath()).is_file()
    assert one.flags() is not None


@pytest.mark.preload
@pytest.mark.parametrize(
    "name",
    ["splitlanelets", "localizeradar", "convertrecordings", "heatmap", "traffic", "samplesite"],
)  # fmt: skip
def test_run(run, site, tmp_path, name):
    parameters, made = parameters_of(name, site, tmp_path)
    results, heard = run(name, parameters, load=True)
    assert heard.errors == []
    assert made.is_file()
    assert results["OUTPUT"] in (str(made), str(made.parent))
    assert heard.percents, "no progress"
    assert heard.percents[-1] <= 100
    assert heard.stages, "no stage"
    assert leftovers(tmp_path) == []
    if name == "localizeradar":
        assert abs(json.loads((tmp_path / "R1.json").read_text())["easting"] - 690360.113) < 0.5
        assert (tmp_path / "R1.png").stat().st_size > 10_000


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("name", BY_WORKER)
def test_cancel(run, site, tmp_path, fake_worker, name):
    """The worker ignores that it is let go, so it is killed after the grace time."""
    fake_worker(
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "for done in range(6000):\n    say(event='progress', stage='work', done=done, total=6000)\n"
        "    time.sleep(0.05)"
    )
    parameters, made = parameters_of(name, site, tmp_path)
    began = time.monotonic()
    results, heard = run(name, parameters, feedback=Feedback(cancel_after=3))
    assert results is None
    assert one_sentence(heard) == "Cancelled; nothing was left half-written."
    assert time.monotonic() - began < 150  # it would take twice that
    assert not made.exists()


def test_stages_that_take_turns(run, site, tmp_path, fake_worker):
    """A site's run tells of several sensors at once: each is named once, the bar only grows."""
    fake_worker(
        "def at(stage, done, total):\n"
        "    say(event='progress', stage=stage, done=done, total=total)\n"
        "at('all stages', 0, 4)\n"
        "for share in (10, 50, 99):\n"
        "    at('localize R1', share, 100)\n    at('localize R2', share, 100)\n"
        "at('localize R1', 100, 100)\nat('all stages', 1, 4)\nat('measure R1', 50, 100)\n"
        "sensor = {'easting': 690360.041, 'scan_check': 'confirms'}\n"
        "say(event='result', outputs=[], summary={'sensors': {'R1': sensor}, 'tiles': 7})"
    )
    parameters, _ = parameters_of("samplesite", site, tmp_path)
    results, heard = run("samplesite", parameters)
    assert results is not None
    assert heard.stages == ["localize R1", "localize R2", "measure R1"]
    assert heard.percents == sorted(heard.percents)
    assert heard.percents[-1] == pytest.approx(100 * (1 + 0.99 + 0.5) / 4)
    assert heard.infos[-2:] == ["sensors: R1: easting 690360.04, scan check confirms", "tiles: 7"]


def test_cancel_of_the_real_worker_leaves_nothing(run, site, tmp_path):
    parameters, made = parameters_of("measure", site, tmp_path)
    results, heard = run("measure", parameters, feedback=Feedback(cancel_after=1))
    assert results is None
    assert one_sentence(heard) == "Cancelled; nothing was left half-written."
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", BY_WORKER)
def test_crash_of_the_worker(run, site, tmp_path, fake_worker, name):
    fake_worker(
        "say(event='progress', stage='work', done=1, total=2)\n"
        "print('Fatal Python error', file=sys.stderr, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGSEGV)"
    )
    parameters, made = parameters_of(name, site, tmp_path)
    results, heard = run(name, parameters)
    assert results is None
    said = one_sentence(heard)
    assert "stopped unexpectedly" in said
    assert "SIGSEGV" in said
    assert "Fatal Python error" in said
    assert not made.exists()


@pytest.mark.parametrize("name", BY_WORKER)
def test_without_a_worker(provider, monkeypatch, tmp_path, name):
    monkeypatch.delenv("GIS_RADAR_PYTHON")
    can, why = algorithm(name).canExecute()
    assert not can
    assert "Set up the worker" in why
    assert "\n" not in why
    monkeypatch.setenv("GIS_RADAR_PYTHON", str(tmp_path / "gone"))
    can, why = algorithm(name).canExecute()
    assert not can
    assert "gone is not there: run 'Set up the worker' again." in why


@pytest.mark.parametrize("name", IDS)
def test_with_a_worker(provider, name):
    assert algorithm(name).canExecute() == (True, "")


def test_hits_only_give_a_map_of_the_hit_share(run, site, brief, tmp_path):
    """Two sensors, one after the other, into one dataset."""
    parameters, _ = parameters_of("measure", site, tmp_path)
    for name in ("R1", "R2"):
        one = {
            "RECORDINGS": [str(brief / f"{name}.parquet")],
            "POSES": [str(SAMPLE / f"{name}.json")],
        }
        _, heard = run("measure", parameters | one | {"SCANS": [], "HITS_ONLY": True})
        assert heard.errors == []
    assert "sensors: R1, R2" in heard.infos
    assert not (tmp_path / "dataset" / "tracks").exists()
    parameters, made = parameters_of("heatmap", site, tmp_path)
    given = {"DATASET": str(tmp_path / "dataset")}
    _, heard = run("heatmap", parameters | given, load=True)
    assert heard.errors == []
    layer = layer_called("Hit share by interval")
    assert layer.renderer().classAttribute() == "hit_share"
    assert layer.renderer().ranges()[0].label() == "0 %, never hit"


def tiles_layer(site):
    layer = QgsVectorLayer(f"{site}/tiles.gpkg|layername=tiles", "tiles", "ogr")
    assert layer.isValid()
    return layer


def memory_copy(layer, keep):
    copy = QgsVectorLayer("Polygon?crs=EPSG:25832", "in memory", "memory")
    fields = [field for field in layer.fields() if field.name() != "fid"]
    copy.dataProvider().addAttributes(fields)
    copy.updateFields()
    rows = []
    for row in layer.getFeatures():
        if keep(row):
            new = QgsFeature(copy.fields())
            new.setGeometry(row.geometry())
            for field in fields:
                new[field.name()] = row[field.name()]
            rows.append(new)
    assert copy.dataProvider().addFeatures(rows)[0]
    return copy


@pytest.mark.parametrize("kind", ["memory", "filtered", "selected"])
def test_parts_of_tiles(run, site, tmp_path, kind, request):
    """Sight on a part of the tiles, which live in QGIS alone; what the worker is given, of two."""
    layer = tiles_layer(site)
    few = layer.uniqueValues(layer.fields().lookupField("lanelet_id"))
    some = sorted(few)[: len(few) // 2]
    wanted = f'"lanelet_id" in ({",".join(map(str, some))})'
    if kind == "memory":
        chosen = memory_copy(layer, lambda row: row["lanelet_id"] in some)
        count = chosen.featureCount()
        QgsProject.instance().addMapLayer(chosen)
        value = chosen.id()
    else:
        QgsProject.instance().addMapLayer(layer)
        layer.setSubsetString(wanted) if kind == "filtered" else layer.selectByExpression(wanted)
        count = layer.featureCount() if kind == "filtered" else layer.selectedFeatureCount()
        value = layer.id()
        if kind == "selected":
            value = QgsProcessingFeatureSourceDefinition(layer.id(), selectedFeaturesOnly=True)
    assert 0 < count < 5387
    package, table = tmp_path / "sight.gpkg", "sight"
    if kind != "memory":
        table = "tiles"
        request.getfixturevalue("fake_worker")(
            "import shutil\n"
            "given, to = (words[words.index(each) + 1] for each in ('--tiles', '-o'))\n"
            "shutil.copyfile(given, to)\n"
            "say(event='result', outputs=[to], summary={})"
        )
    call = {"POSES": [str(SAMPLE / "R1.json")], "SCANS": [str(SAMPLE / "scan.laz")],
            "TILES": value, "OUTPUT": str(package)}  # fmt: skip
    _, heard = run("sight", call)
    assert heard.errors == []
    written = QgsVectorLayer(f"{package}|layername={table}", "sight", "ogr")
    assert 0 < written.featureCount() <= count
    assert table == "sight" or written.featureCount() == count


def test_road_polygons_that_were_drawn(run, site, tmp_path):
    layer = QgsVectorLayer("Polygon?crs=EPSG:25832&field=name:string", "drawn", "memory")
    row = QgsFeature(layer.fields())
    row.setGeometry(QgsGeometry.fromRect(QgsRectangle(690400, 5336150, 690460, 5336230)))
    assert layer.dataProvider().addFeatures([row])[0]
    QgsProject.instance().addMapLayer(layer)
    parameters, made = parameters_of("maskroad", site, tmp_path)
    del parameters["MAP"]
    results, heard = run("maskroad", parameters | {"ROADS": layer.id()})
    assert heard.errors == []
    assert made.is_file()

"""What algorithms offer beside what the command line offers: no option is forgotten."""

import json
import os
import subprocess

import pytest
from conftest import ROOT, SAMPLE, WORKER
from helpers import algorithm

# Which algorithm is which command's, and the names of parameters that differ from their options'.
# tests/test_plugin.py reads here that no command is forgotten.
COMMANDS = {
    "tiles": ("splitlanelets", {"map_path": "MAP"}),
    "mask": ("maskroad", {"scans": "SCANS"}),
    "localize": ("localizeradar", {"recordings": "RECORDING", "scan": "SCANS", "output": "POSE"}),
    "track": ("trackpose", {}),
    "sight": ("sight", {"pose": "POSES", "scan": "SCANS"}),
    "convert": ("convertrecordings", {"inputs": "INPUT"}),
    "clocks": ("clocks", {"pose": "POSES"}),
    "measure": ("measure", {"pose": "POSES", "scan": "SCANS"}),
    "dataset": ("dataset", {"folder": "DATASET"}),
    "quality": ("quality", {"folder": "DATASET"}),
    "traffic": ("traffic", {"folder": "DATASET"}),
    "compare": ("compare", {"folder": "DATASET"}),
    "heatmap": ("heatmap", {"folder": "DATASET"}),
    "footprints": ("footprints", {"folder": "DATASET"}),
    "project": ("detections", {}),
    "run": ("runsite", {}),
    "report": ("sitereport", {"folder": "RESULTS"}),
    "qgis": ("qgisproject", {}),
    "sample": ("samplesite", {}),
}
# Options that no algorithm has, and why.
LEFT_OUT = {
    "mask": {"map_crs": "a layer of QGIS has its own", "layer": "a layer of QGIS is one"},
    "localize": {"guess_crs": "a click has its own", "together": "the site wizard takes several"},
    "convert": {"duration": "QGIS does not listen to a network"},
    "traffic": {
        "headways": "a table for engineers; the command has it",
        "cycles": "a table for engineers, without lines to show",
        "signals": "for cycles",
        "service": "a table for engineers; a run's report has the levels",
        "datex": "files for a data exchange, which an administrator fills",
        "sumo_net": "for SUMO, which is run by commands, too",
    },
    "dataset": {
        "keep": "an administrator's, every night",
        "site": "QGIS renames lanes in the layer; a site's run has the names of its file",
        "match_lanes": "a table for a new version of the map; the command has it",
        "output": "of matched lanes",
    },
    "report": {"month": "a page of many sites, for a browser; the command writes it"},
    "heatmap": {"month": "'Map of a month' has it"},
    "run": {
        "template": "the site wizard writes the file",
        "city_template": "a city is run by an administrator, every night",
        "executor": "of a city",
    },
}
# Commands without an algorithm, and why.
NO_ALGORITHM = {
    "check": "the last page of the site wizard shows it, also of a site file that it opens",
    "sensors": "'Localize a radar' and a site's run make the layer",
    "profile": "a table of a street, without lines to show",
    "query": "a language for programs; the tables open in QGIS as they lie",
    "publish": "an administrator fills the database; QGIS opens its tables",
    "edge": "a server at a sensor, which runs for years",
    "live": "a server, which runs for years; QGIS shows its files",
    "demo": "'Get the sample site' and 'Run a site file'",
}
_ASK = """
import json
from gis_radar.cli import group
print(json.dumps({
    name: [each.opts[-1].strip("-").replace("-", "_") for each in command.params]
    for name, command in group.commands.items()
}))
"""


@pytest.fixture(scope="module")
def options():
    """The options of every command, as the command line has them."""
    around = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    done = subprocess.run([WORKER, "-c", _ASK], capture_output=True, text=True, check=True,
                          cwd=ROOT, env=around)  # fmt: skip
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_option_is_forgotten(provider, options, command):
    name, other_names = COMMANDS[command]
    one = algorithm(name)
    has = {each.name() for each in one.parameterDefinitions()}
    left_out = LEFT_OUT.get(command, {})
    wanted = {
        other_names.get(each, each.upper())
        for each in options[command]
        if each not in {"json", "help", *left_out}
    }
    assert wanted - has == set()
    assert set(left_out) <= set(options[command])  # none is left out that is gone


@pytest.mark.parametrize(
    ("written", "sent"),
    [("Nordost", "north-east"), ("nord-ost", "north-east"), ("Süd West", "south-west"),
     ("north-east", "north-east"), ("68,5", "68.5"), ("68.5", "68.5")],
)  # fmt: skip
def test_compass_words_are_the_users(monkeypatch, written, sent):
    from gis_radar_plugin import parameters, words

    monkeypatch.setattr(words, "language", lambda: "de")
    assert parameters.bearing_word(written) == sent


R1, POSE = str(SAMPLE / "R1.parquet"), str(SAMPLE / "R1.json")
OSM, SCAN = str(SAMPLE / "junction.osm"), str(SAMPLE / "scan.laz")
GPKG, LAYER = "SITE/tiles.gpkg", "SITE/tiles.gpkg|layername=tiles"
PAIRED = {"RECORDINGS": [R1], "POSES": [POSE], "TILES": LAYER}
UTM = "EPSG:25832"
# What is given, and all words that reach the worker; OUT is the output, SITE the folder of results.
WORDS = {
    "splitlanelets": (
        {"MAP": OSM, "ROAD": SCAN, "LENGTH": 1, "CRS": UTM, "SUBTYPE": "road", "ORIGIN": "1,2"},
        ["tiles", OSM, "--road", SCAN, "--length", "1", "--crs", UTM, "--subtype", "road",
         "--origin", "1,2", "-o", "OUT"],
    ),
    "maskroad": (
        {"SCANS": [SCAN], "ROADS": "SITE/road.roads.gpkg", "ENGINE": "laspy", "SCAN_CRS": UTM},
        ["mask", SCAN, "--map", "SITE/road.roads.gpkg", "--layer", "roads", "--scan-crs", UTM,
         "--engine", "laspy", "-o", "OUT"],
    ),
    "localizeradar": (
        {"RECORDING": R1, "MAP": OSM, "ROAD": SCAN, "GUESS": "690356,5336183 [EPSG:25832]",
         "SCANS": [SCAN], "COMPASS": "68,5", "METHOD": 1, "POSE": "pose.json", "FIGURE": "f.png"},
        ["localize", R1, "--guess", "690356.000,5336183.000", "--guess-crs", UTM, "--map", OSM,
         "--road", SCAN, "--scan", SCAN, "--compass", "68.5", "--method", "icp", "-o", "pose.json",
         "--figure", "f.png"],
    ),
    "trackpose": (
        {"RECORDING": R1, "MAP": OSM, "ROAD": SCAN, "POSE": POSE},
        ["track", R1, "--pose", POSE, "--map", OSM, "--road", SCAN, "-o", "OUT"],
    ),
    "sight": (
        {"POSES": [POSE], "TILES": LAYER, "SCANS": [SCAN]},
        ["sight", "--pose", POSE, "--tiles", GPKG, "--scan", SCAN, "-o", "OUT"],
    ),
    "convertrecordings": (
        {"INPUT": [R1, POSE], "SENSOR": "1.2.3.4", "COLUMNS": "x=X", "TIME_UNIT": "ms",
         "CLOCK": "auto"},
        ["convert", R1, POSE, "--sensor", "1.2.3.4", "--columns", "x=X", "--time-unit", "ms", "-o",
         "OUT"],
    ),
    "clocks": (
        {**PAIRED, "REFERENCE": "R1"},
        ["clocks", R1, "--pose", POSE, "--tiles", GPKG, "--reference", "R1", "-o", "OUT"],
    ),
    "measure": (
        {**PAIRED, "MAP": OSM, "SCANS": [SCAN], "SCAN_CRS": UTM,
         "HITS_ONLY": True, "ACCEPT": "R1", "CLEARANCE": "-0.5,4.5", "MIN_SPEED": 0.5,
         "ELEVATION_ERROR": 1, "MAX_RANGE": 250, "AZIMUTH": 100, "ELEVATION": 25.5,
         "CYCLE": "R1=150ms", "CLOCKS": "c.json", "JOBS": 2},
        ["measure", R1, "--pose", POSE, "--tiles", GPKG, "--map", OSM, "--scan", SCAN,
         "--scan-crs", UTM, "--hits-only", "--accept", "R1", "--clearance",
         "-0.5,4.5", "--min-speed", "0.5", "--elevation-error", "1", "--max-range", "250",
         "--azimuth", "100", "--elevation", "25.5", "--cycle", "R1=150ms", "--clocks", "c.json",
         "--jobs", "2", "-o", "OUT"],
    ),
    "heatmap": (
        {"DATASET": "d", "BEGIN": "2025-06-12 07:30"},
        ["heatmap", "d", "--interval", "15min", "--begin", "2025-06-12 07:30", "--language", "en",
         "-o", "OUT"],
    ),
    "footprints": ({"DATASET": "d"}, ["footprints", "d", "-o", "OUT"]),
    "detections": (
        {"RECORDING": R1, "POSE": POSE}, ["project", R1, "--pose", POSE, "-o", "OUT"]
    ),
    "traffic": (
        {"DATASET": "d", "BEGIN": "2025-06-12 07:30", "COUNTS": "c.csv", "LANGUAGE": "de"},
        ["traffic", "d", "--interval", "15min", "--begin", "2025-06-12 07:30", "--counts", "c.csv",
         "--language", "de", "--csv-locale", "en", "-o", "OUT"],
    ),
    "compare": (
        {"DATASET": "d", "OTHER": "e", "BEFORE": "2026-09-07/2026-09-21", "DAYS": "Mo-Fr"},
        ["compare", "d", "e", "--before", "2026-09-07/2026-09-21", "--days", "Mo-Fr", "--language",
         "en", "--csv-locale", "en", "-o", "OUT"],
    ),
    "quality": ({"DATASET": "d"}, ["quality", "d", "--csv-locale", "en", "-o", "OUT"]),
    "dataset": (
        {"DATASET": "d", "RELINK": "here", "WITHDRAW": R1, "WITHDRAW_SENSOR": "R1",
         "WITHDRAW_DAY": "2026-10-05", "CHECK": True},
        ["dataset", "d", "--relink", "here", "--withdraw", R1, "--withdraw-sensor", "R1",
         "--withdraw-day", "2026-10-05", "--check"],
    ),
    "runsite": (
        {"SITE": "site.toml", "FRESH": True}, ["run", "site.toml", "--fresh", "-o", "OUT"]
    ),
    "sitereport": (
        {"RESULTS": "r", "TIMEZONE": "Europe/Berlin", "DATASET": "d", "CSV_LOCALE": "de",
         "NO_WAYS": True},
        ["report", "r", "--timezone", "Europe/Berlin", "--language", "en", "--csv-locale", "de",
         "--dataset", "d", "--no-ways", "-o", "OUT"],
    ),
    "qgisproject": (
        {"HEATMAP": "h", "LANES": "t.gpkg", "TITLE": "Ä", "LANGUAGE": "de"},
        ["qgis", "h", "--lanes", "t.gpkg", "--title", "Ä", "--language", "de", "-o", "OUT"],
    ),
    "samplesite": ({}, ["sample", "-o", "OUT"]),
}  # fmt: skip


@pytest.mark.parametrize("name", WORDS)
def test_options_reach_the_worker(run, site, tmp_path, fake_worker, name):
    heard, out = tmp_path / "words.json", str(tmp_path / "out.gpkg")
    fake_worker(f"open({str(heard)!r}, 'w').write(json.dumps(words))\nsys.exit(3)")
    here = {"SITE": str(site), "OUT": out}

    def placed(value):
        whole = isinstance(value, str) and value.replace("SITE/", f"{site}/", 1)
        return here.get(value, whole) if whole else value

    given, expected = WORDS[name]
    run(name, {key: placed(value) for key, value in given.items()} | {"OUTPUT": out})
    assert json.loads(heard.read_text()) == [*map(placed, expected), "--json"]


def test_each_command_is_called_so(provider):
    assert set(WORDS) == {name for name, _ in COMMANDS.values()}


def test_the_project_is_written(run, site, tmp_path):
    project = tmp_path / "site.qgz"
    call = {"HEATMAP": site / "heatmap", "LANGUAGE": "de", "OUTPUT": project}
    _, heard = run("qgisproject", {key: str(value) for key, value in call.items()})
    assert (heard.errors, project.is_file()) == ([], True)

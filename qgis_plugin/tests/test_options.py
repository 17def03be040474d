"""What algorithms offer beside what the command line offers: no option is forgotten."""

import json
import os
import subprocess

import pytest
from conftest import ROOT, SAMPLE, WORKER
from helpers import algorithm

# Which algorithm is which command's, and the names of parameters that differ from their options'.
COMMANDS = {
    "tiles": ("splitlanelets", {"map_path": "MAP"}),
    "mask": ("maskroad", {"scans": "SCANS"}),
    "localize": ("localizeradar", {"recordings": "RECORDING", "scan": "SCANS", "output": "POSE"}),
    "track": ("trackpose", {}),
    "sight": ("sight", {"pose": "POSES", "scan": "SCANS", "recording": "RECORDINGS"}),
    "convert": ("convertrecordings", {"inputs": "INPUT"}),
    "clocks": ("clocks", {"pose": "POSES"}),
    "measure": ("measure", {"pose": "POSES", "scan": "SCANS"}),
    "dataset": ("dataset", {"folder": "DATASET"}),
    "quality": ("quality", {"folder": "DATASET"}),
    "heatmap": ("heatmap", {"folder": "DATASET"}),
    "footprints": ("footprints", {"folder": "DATASET"}),
    "project": ("detections", {}),
    "run": ("runsite", {}),
    "check": ("checksite", {}),
    "report": ("sitereport", {"folder": "RESULTS"}),
    "qgis": ("qgisproject", {}),
    "sample": ("samplesite", {}),
}
# Options that no algorithm has, and why.
LEFT_OUT = {
    "mask": {"map_crs": "a layer of QGIS has its own", "layer": "a layer of QGIS is one"},
    "localize": {"guess_crs": "a click has its own", "together": "the site wizard takes several"},
    "convert": {"duration": "QGIS does not listen to a network"},
    "run": {"template": "the site wizard writes the file"},
}
# Commands without an algorithm, and why.
NO_ALGORITHM = {
    "sensors": "'Localize a radar' and a site's run make the layer",
    "trajectories": "files for other programs; 'Vehicles that move on the map' shows them here",
    "query": "a language for programs; the tables open in QGIS as they lie",
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


def test_every_command_has_its_algorithm(options):
    assert sorted(options) == sorted(COMMANDS | NO_ALGORITHM)


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


def words_of(run, fake_worker, tmp_path, name, parameters):
    """Return the words that reach the worker, with the value behind each option."""
    heard = tmp_path / "words.json"
    fake_worker(f"open({str(heard)!r}, 'w').write(json.dumps(words))\nsys.exit(3)")
    run(name, parameters)
    words = json.loads(heard.read_text())
    return words, dict(zip(words, words[1:]))


def test_options_reach_the_worker(run, site, tmp_path, fake_worker):
    shared = {
        "RECORDINGS": [str(SAMPLE / "R1.parquet")], "POSES": [str(SAMPLE / "R1.json")],
        "TILES": f"{site}/tiles.gpkg|layername=tiles", "OUTPUT": str(tmp_path / "out"),
        "MAX_RANGE": 250, "AZIMUTH": 100, "ELEVATION": 25.5, "CYCLE": "R1=150ms", "CLOCKS": "auto",
        "SIGHT": "sight.gpkg", "MAP": str(SAMPLE / "junction.osm"),
    }  # fmt: skip
    expected = {
        "--max-range": "250", "--azimuth": "100", "--elevation": "25.5", "--cycle": "R1=150ms",
        "--clocks": "auto", "--sight": "sight.gpkg",
    }  # fmt: skip
    more = {"MIN_SPEED": 0.5, "ELEVATION_ERROR": 1, "HITS_ONLY": True, "JOBS": 2}
    words, given = words_of(run, fake_worker, tmp_path, "measure", shared | more)
    assert {flag: given[flag] for flag in expected} == expected
    assert (given["--min-speed"], given["--elevation-error"]) == ("0.5", "1")
    assert (given["--map"], given["--jobs"]) == (str(SAMPLE / "junction.osm"), "2")
    assert "--hits-only" in words
    assert "--min-rcs" not in words


@pytest.mark.parametrize(
    ("written", "sent"),
    [("Nordost", "north-east"), ("nord-ost", "north-east"), ("Süd West", "south-west"),
     ("north-east", "north-east"), ("68,5", "68.5"), ("68.5", "68.5")],
)  # fmt: skip
def test_compass_words_are_the_users(monkeypatch, written, sent):
    from gis_radar_plugin import parameters, words

    monkeypatch.setattr(words, "language", lambda: "de")
    assert parameters.bearing_word(written) == sent


def test_files_reach_the_worker(run, site, tmp_path, fake_worker):
    """Of the algorithms that do nothing but call a command."""
    recording, pose = str(SAMPLE / "R1.parquet"), str(SAMPLE / "R1.json")
    osm, scan = str(SAMPLE / "junction.osm"), str(SAMPLE / "scan.laz")
    tiles, out = f"{site}/tiles.gpkg|layername=tiles", str(tmp_path / "out.gpkg")
    paired = {"RECORDINGS": [recording], "POSES": [pose], "TILES": tiles}
    calls = {
        "trackpose": ({"RECORDING": recording, "MAP": osm, "ROAD": scan, "POSE": pose},
                      ["track", recording, "--map", osm, "--road", scan, "--pose", pose]),
        "sight": ({**paired, "SCANS": [scan]},
                  ["sight", "-o", out, "--tiles", f"{site}/tiles.gpkg", "--pose", pose,
                   "--recording", recording, "--scan", scan]),
        "clocks": ({**paired, "REFERENCE": "R1"},
                   ["clocks", recording, "--tiles", f"{site}/tiles.gpkg", "--pose", pose, "-o", out,
                    "--reference", "R1"]),
        "detections": ({"RECORDING": recording, "POSE": pose},
                       ["project", recording, "--pose", pose, "-o", out]),
        "heatmap": ({"DATASET": "d", "INTERVAL": "15min", "BEGIN": "2025-06-12 07:30"},
                    ["heatmap", "d", "-o", out, "--interval", "15min",
                     "--begin", "2025-06-12 07:30"]),
        "dataset": ({"DATASET": "d", "RELINK": "here", "WITHDRAW": recording},
                    ["dataset", "d", "--relink", "here", "--withdraw", recording]),
        "quality": ({"DATASET": "d"}, ["quality", "d", "-o", out]),
        "footprints": ({"DATASET": "d"}, ["footprints", "d", "-o", out]),
        "sitereport": ({"RESULTS": str(site), "TIMEZONE": "Europe/Berlin", "DATASET": "d"},
                       ["report", str(site), "-o", out, "--dataset", "d",
                        "--timezone", "Europe/Berlin",
                        "--language", "en", "--csv-locale", "en"]),
    }  # fmt: skip
    for name, (call, expected) in calls.items():
        words, _ = words_of(run, fake_worker, tmp_path, name, {**call, "OUTPUT": out})
        assert words[: len(expected)] == expected, name


def test_the_new_ones_run(run, site, tmp_path):
    """With the real worker, on the sample: those that take a second or two."""
    project = tmp_path / "site.qgz"
    call = {"HEATMAP": site / "heatmap", "LANGUAGE": "de", "OUTPUT": project}
    results, heard = run("qgisproject", {key: str(value) for key, value in call.items()})
    assert (heard.errors, project.is_file()) == ([], True)
    results, heard = run("checksite", {"SITE": str(SAMPLE / "SITE.toml")})
    assert (heard.errors, results["WARNINGS"]) == ([], 0)
    assert any("R1" in line and "167616" in line for line in heard.infos)

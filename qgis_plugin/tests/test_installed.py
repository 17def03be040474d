"""The zip in an empty profile: qgis_process as a nightly job."""

import json
import sys
from pathlib import Path

from conftest import ROOT, SAMPLE, call
from helpers import is_whole, leftovers

POSE = ("sensor", "crs", "easting", "northing", "height", "yaw", "pitch", "roll")


def run(profiles, name, **inputs):
    """Run an algorithm; the exit code of qgis_process says little, so the caller looks at files."""
    return call(profiles, "--json", "run", f"gisradar:{name}", inputs=inputs)


def test_all_algorithms_are_there_in_german(profiles):
    done = call(profiles, "list", LANGUAGE="de", LANG="de_DE.UTF-8", LC_ALL="de_DE.UTF-8")
    assert done.stdout.count("gisradar:") == 22
    assert "Standortdatei ausführen" in done.stdout
    assert "Run a site file" not in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_the_version_is_the_projects(profiles):
    metadata = profiles / "profiles/default/python/plugins/gis_radar_plugin/metadata.txt"
    version = next(
        line for line in (ROOT / "pyproject.toml").read_text().splitlines() if "version" in line
    )
    assert f"version={version.split(chr(34))[1]}" in metadata.read_text()


def test_a_night_on_the_sample(profiles, site, brief, tmp_path):
    """Tiles to report by qgis_process, in a folder of an odd name."""
    out = tmp_path / "über Nacht"
    osm, tiles = SAMPLE / "junction.osm", out / "tiles.gpkg"
    run(profiles, "splitlanelets", MAP=osm, ROAD=site / "road.laz", OUTPUT=tiles)
    assert is_whole(tiles)
    pose = json.loads((SAMPLE / "R1.json").read_text())
    surveyed = out / "surveyed.json"  # as one by hand, without a view
    surveyed.write_text(json.dumps({name: pose[name] for name in POSE}))
    run(profiles, "measure", RECORDINGS=[brief / "R1.parquet"], POSES=[surveyed], MAP=osm,
        TILES=f"{tiles}|layername=tiles", CLEARANCE="-0.5,4.5", MAX_RANGE=120,
        OUTPUT=out / "dataset")  # fmt: skip
    assert [each.name for each in (out / "dataset" / "tracks").rglob("*.parquet")] == ["07.parquet"]
    run(profiles, "heatmap", DATASET=out / "dataset", INTERVAL="50s", OUTPUT=out / "map")
    assert is_whole(out / "map" / "heatmap.gpkg")
    run(profiles, "exportreport", HEATMAP=out / "map", SENSORS=site / "sensors.gpkg", DPI=60,
        PLACES=f"{site}/sensors.gpkg|layername=sensors", OUTPUT=out / "report")  # fmt: skip
    assert (out / "report" / "report.pdf").read_bytes().startswith(b"%PDF")
    assert sorted(each.name for each in (out / "report").glob("R*.png")) == [
        "R1_whole.png", "R2_whole.png",
    ]  # fmt: skip
    assert leftovers(out) == []


def test_a_failure_leaves_no_file_and_says_why(profiles, tmp_path):
    """The exit code is not to be trusted, the file and the sentence are."""
    broken = tmp_path / "broken.osm"
    broken.write_text("<osm>")
    done = run(profiles, "splitlanelets", MAP=broken, OUTPUT=tmp_path / "t.gpkg")
    assert "broken.osm" in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "t.gpkg").exists()


def test_nothing_of_the_plugin_needs_a_wheel(profiles):
    """No file of it imports anything but the standard library and what QGIS brings."""
    import ast

    known = set(sys.stdlib_module_names) | {"qgis", "processing", "osgeo"}
    folder = Path(profiles) / "profiles/default/python/plugins/gis_radar_plugin"
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            assert all(name.split(".")[0] in known for name in names), (path, names)

"""A site made once by the real worker, the provider in a real QGIS, and workers that misbehave."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import tomllib

ROOT = Path(__file__).parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
SAMPLE = ROOT / "sample_maps"
SITE = os.environ.get("GIS_RADAR_QGIS_SITE")  # made once for both processes
WORKER = os.environ.get("GIS_RADAR_PYTHON", str(ROOT / ".venv" / "bin" / "python"))
sys.path.insert(0, os.environ.get("GIS_RADAR_PLUGINS", str(ROOT / "qgis_plugin")))


def worker(*words):
    """Run the real worker as the command line does, without QGIS's libraries in front."""
    command = [WORKER, "-m", "gis_radar", *map(str, words)]
    around = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT, env=around)


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Give a function that has a folder made once, only to be read."""
    root = tmp_path_factory.getbasetemp()

    def make(name, work):
        folder, made = root / name, root / f"{name}.made"
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of one that failed
            folder.mkdir()
            work(folder)
            made.touch()
        return folder

    return make


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Results of the sample junction in a folder with a space and umlauts."""
    folder = tmp_path_factory.mktemp("qgis") / "Straße mit Ümlaut"
    if SITE:
        shutil.copytree(SITE, folder)
    else:
        worker("demo", "-o", folder)
    return folder


@pytest.fixture(scope="session")
def brief(once):
    """Ten seconds of the sample's recordings; its hundred take longer."""
    cut = (
        "import sys, pandas as pd\n"
        "for name in ('R1', 'R2'):\n"
        "    table = pd.read_parquet(f'{sys.argv[1]}/{name}.parquet')\n"
        "    table = table[table['time'] < table['time'].iloc[0] + 10.0]\n"
        "    table.to_parquet(f'{sys.argv[2]}/{name}.parquet', index=False)\n"
    )
    around = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    command = [WORKER, "-c", cut, str(SAMPLE)]
    return once("brief", lambda at: subprocess.run([*command, str(at)], check=True, env=around))


@pytest.fixture(scope="session")
def project(site, tmp_path_factory):
    """A project as a run writes it, in a folder that was moved afterwards; only to be read."""
    place = tmp_path_factory.mktemp("project")
    folder = shutil.copytree(site, place / "moved")
    worker("qgis", folder / "heatmap", "--sensors", folder / "sensors.gpkg",
           "--lanes", folder / "tiles.gpkg",
           "--title", "Sample", "--timezone", "Europe/Berlin", "--source", "City",
           "-o", folder / "site.qgz")  # fmt: skip
    there = place / "and moved again"
    folder.rename(there)
    return there / "site.qgz"


@pytest.fixture(scope="session")
def provider(qgis_app, qgis_processing):
    """The provider, registered as QGIS does it without a window."""
    from qgis.core import QgsApplication

    from gis_radar_plugin import classFactory

    plugin = classFactory(None)
    plugin.initProcessing()
    yield QgsApplication.processingRegistry().providerById("gisradar")
    plugin.unload()


@pytest.fixture(autouse=True)
def the_worker(monkeypatch):
    monkeypatch.setenv("GIS_RADAR_PYTHON", WORKER)


@pytest.fixture
def impatient(monkeypatch):
    """Have a worker that does not listen killed sooner than a user has to wait for it."""
    from gis_radar_plugin.runner import run_worker

    monkeypatch.setitem(run_worker.__kwdefaults__, "grace_s", 0.3)


@pytest.fixture
def fake_worker(tmp_path, monkeypatch):
    """Give a function that puts a program in the worker's place; it sees the command's words."""

    def make(body, version=VERSION):
        path = tmp_path / "worker.py"
        path.write_text(
            f"#!/usr/bin/python3\nimport json, os, signal, sys, time\n"
            f"if sys.argv[1] == '-c':\n    print({version!r})\n    sys.exit()\n"
            f"words = sys.argv[4:]\n"
            f"def say(**event):\n    print(json.dumps(event), flush=True)\n{body}\n"
        )
        path.chmod(0o755)
        monkeypatch.setenv("GIS_RADAR_PYTHON", str(path))
        return path

    return make


@pytest.fixture
def copying_worker(site, fake_worker):
    """A worker that makes the site's heat map whatever it is asked for: it copies it."""
    return fake_worker(
        f"import shutil\nshutil.copytree({str(site / 'heatmap')!r}, words[words.index('-o') + 1],"
        " dirs_exist_ok=True)\nsay(event='result', outputs=[], summary={})"
    )


@pytest.fixture
def run(provider, qgis_new_project):
    """Run an algorithm as the toolbox does, and load what it gives into the project."""
    from helpers import run_algorithm

    return run_algorithm


@pytest.fixture(scope="session")
def profiles(once, tmp_path_factory):
    """An empty folder of profiles with the plugin installed from its zip."""
    own = tmp_path_factory.mktemp("installed") / "own"  # as QGIS writes there
    return shutil.copytree(once("profiles", install), own)


def install(folder):
    tool = [sys.executable, str(ROOT / "tools" / "plugin_zip.py"), "-o", str(folder)]
    done = subprocess.run(tool, check=True, capture_output=True, text=True)
    plugins = folder / "profiles" / "default" / "python" / "plugins"
    with zipfile.ZipFile(done.stdout.split()[-1]) as archive:
        archive.extractall(plugins)
    said = call(folder, "plugins", "enable", "gis_radar_plugin")
    assert "Enabled gis_radar_plugin" in said.stdout


def environment(profiles, **more):
    kept = ("HOME", "LANG", "TZ", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    clean = {name: os.environ[name] for name in kept if name in os.environ}
    return clean | {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "QT_QPA_PLATFORM": "offscreen",
        "QGIS_CUSTOM_CONFIG_PATH": str(profiles),
        "XDG_RUNTIME_DIR": str(profiles),
        "GIS_RADAR_PYTHON": WORKER,
        **more,
    }


def call(profiles, *words, inputs=None, **more):
    if inputs is not None:
        words = (*words, "-")
    return subprocess.run(
        ["qgis_process", *words],
        input=json.dumps({"inputs": inputs}, default=str) if inputs is not None else None,
        capture_output=True, text=True, check=False, timeout=350, env=environment(profiles, **more),
    )  # fmt: skip

"""The QGIS plugin as far as it can be seen without QGIS: its runner, its words, its zip.

The rest is tested in a real QGIS, in qgis_plugin/tests.
"""

import ast
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
from plugin_words import FOLDER, errors_with_values_inside, project_texts, texts

from gis_radar.base.languages import catalogue
from gis_radar.cli import group

ROOT = Path(__file__).parents[1]
posix = pytest.mark.skipif(os.name == "nt", reason="the stand-in for a worker is a script")


@pytest.fixture
def plugin(monkeypatch):
    """Let the plugin's modules be imported that know nothing of QGIS."""
    monkeypatch.syspath_prepend(str(FOLDER.parent))
    from gis_radar_plugin import runner

    return runner


@pytest.fixture
def program(tmp_path):
    """Give a function that writes a program to stand in the worker's place."""

    def make(body):
        path = tmp_path / "worker"
        path.write_text(
            f"#!{sys.executable}\nimport json, os, signal, subprocess, sys, time\n"
            "words = sys.argv[1:]\n"
            f"def say(**event): print(json.dumps(event), flush=True)\n{body}\n"
        )
        path.chmod(0o755)
        return str(path)

    return make


class Heard:
    """Keeps what a worker tells, and stops it after so many stages."""

    def __init__(self, stop_after=None):
        self.stages, self.remarks, self.asked = [], [], []
        self._stop_after = stop_after

    def progress(self, stage, done, total):
        self.stages.append((stage, done, total))

    def log(self, message, level):
        self.remarks.append((level, message))

    def cancelled(self):
        self.asked.append(time.monotonic())
        return self._stop_after is not None and len(self.stages) >= self._stop_after


@posix
def test_a_worker_is_heard(plugin, program):
    heard = Heard()
    python = program(
        "say(event='progress', stage='work', done=1, total=2)\n"
        "say(event='log', level='warning', message='käse')\n"
        "say(event='result', outputs=['a'], summary={'words': words})"
    )
    answer = plugin.run_worker(python, ["tiles", "map with space.osm"], heard)
    assert heard.stages == [("work", 1, 2)]
    assert heard.remarks == [("warning", "käse")]
    assert answer.outputs == ["a"]
    words = ["-P", "-m", "gis_radar", "tiles", "map with space.osm", "--json"]
    assert answer.summary == {"words": words}


@posix
def test_the_real_worker(plugin, tmp_path):
    heard = Heard()
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT!s} exec {sys.executable} "$@"\n')
    python.chmod(0o755)
    sample = ROOT / "sample_maps"
    out = tmp_path / "Ärger.gpkg"
    words = ["sensors", str(sample / "R1.json"), "-o", str(out)]
    assert plugin.run_worker(str(python), words, heard).summary == {"sensors": ["R1"]}
    assert out.is_file()
    with pytest.raises(plugin.WorkerError, match=r"no such file|cannot be read"):
        plugin.run_worker(
            str(python), ["sensors", str(tmp_path / "no.json"), "-o", str(out)], heard
        )


@posix
def test_a_polite_worker_stops_when_let_go(plugin, program):
    """It has no signal to wait for: its standard input ends."""
    python = program(
        "say(event='progress', stage='work', done=0, total=1)\n"
        "assert os.environ['GIS_RADAR_PARENT_WATCHDOG'] == 'stdin'\nsys.stdin.read()\n"
        "open(sys.argv[0] + '.left', 'w').close()"
    )
    with pytest.raises(plugin.CancelledError):
        plugin.run_worker(python, [], Heard(stop_after=1), grace_s=60.0)
    assert Path(f"{python}.left").exists()


@posix
def test_a_stubborn_worker_is_killed_with_its_children(plugin, program, tmp_path):
    note = tmp_path / "child"
    python = program(
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "child = subprocess.Popen(['sleep', '600'])\n"
        f"open({str(note)!r}, 'w').write(str(child.pid))\n"
        "say(event='progress', stage='work', done=0, total=1)\ntime.sleep(600)"
    )
    with pytest.raises(plugin.CancelledError):
        plugin.run_worker(python, [], Heard(stop_after=1), grace_s=0.2)
    state = Path(f"/proc/{note.read_text()}/stat")
    for _ in range(6000):
        if not state.exists() or state.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child lives on")


@posix
@pytest.mark.parametrize(
    ("language", "body", "said"),
    [
        ("en", "os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV"),
        ("en", "print('out of memory', file=sys.stderr)\nsys.exit(7)", "code 7: out of memory"),
        ("en", "pass", "ended without a result"),
        ("en", "say(event='error', code=3, message='a.osm: bad', hint='mend it')\nsys.exit(3)",
         "a.osm: bad (mend it)"),
        ("en", "say(event='error', code=3, message='two\\nlines', hint='')\nsys.exit(3)",
         "two lines"),
        ("en", "say(event='result', outputs=[])\nsys.exit(1)", "ended with code 1"),
        ("de", "os.kill(os.getpid(), signal.SIGSEGV)",
         "aufgehört: sie wurde durch SIGSEGV beendet"),
        ("de", "print('kein Speicher', file=sys.stderr)\nsys.exit(7)",
         "Die Arbeitsumgebung hat unerwartet aufgehört: Ende mit Code 7: kein Speicher"),
        ("de", "say(event='error', code=3, message='')\nsys.exit(3)",
         "die Arbeitsumgebung hat versagt"),
        ("de", "say(event='error', code=3, message='{x}: Karte')\nsys.exit(3)", "{x}: Karte"),
    ],
)  # fmt: skip
def test_how_a_worker_fails(plugin, program, monkeypatch, language, body, said):
    monkeypatch.setattr("gis_radar_plugin.words.language", lambda: language)
    with pytest.raises(plugin.WorkerError) as caught:
        plugin.run_worker(program(body), [], Heard())
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_worker_that_is_not_there(plugin, tmp_path):
    with pytest.raises(plugin.WorkerError, match="does not start"):
        plugin.run_worker(str(tmp_path / "gone"), [], Heard())


def test_no_error_of_the_plugin_is_put_together_where_it_is_raised():
    assert errors_with_values_inside() == []


@posix
def test_what_is_wrong_with_a_worker_is_german(plugin, program, monkeypatch, tmp_path):
    from gis_radar_plugin import installer, worker

    monkeypatch.setattr("gis_radar_plugin.words.language", lambda: "de")
    gone, odd = str(tmp_path / "gone"), program("print('Käse', file=sys.stderr)\nsys.exit(1)")
    asked = {
        f"Das Python der Arbeitsumgebung, {gone}, ist nicht da": lambda: worker.find_python(
            gone, tmp_path),
        f"Das Python der Arbeitsumgebung, {odd}, läuft nicht: Käse": lambda: worker.worker_version(
            odd),
        f"{gone} ist kein Python 3.11 oder neuer (ein anderes wählen)": lambda: (
            installer.find_tools(gone)),
    }  # fmt: skip
    for said, ask in asked.items():
        with pytest.raises(plugin.WorkerError) as caught:
            ask()
        assert str(caught.value) == said
    monkeypatch.delenv("GIS_RADAR_PYTHON", raising=False)
    with pytest.raises(plugin.NoWorkerError, match="gis_radar braucht"):
        worker.find_python("", tmp_path)


def test_the_environment_is_cleaned(plugin):
    around = {"PATH": "/bin", "PYTHONHOME": "x", "PROJ_LIB": "x", "LD_PRELOAD": "x"}
    assert plugin.clean_environment(around) == {
        "PATH": "/bin", "GIS_RADAR_PARENT_WATCHDOG": "stdin", "PYTHONUTF8": "1",
        "PYTHONIOENCODING": "utf-8",
    }  # fmt: skip


def test_versions_of_one_series_work_together(plugin):
    from gis_radar_plugin.worker import same_series

    assert same_series("0.7.3", "0.7.0")
    assert same_series("0.7.3", "")  # a checkout
    assert not same_series("0.8.0", "0.7.9")


def test_a_translation_is_complete():
    assert [text for text in (*texts(), *project_texts()) if text not in catalogue("de")] == []


@pytest.mark.usefixtures("plugin")
def test_the_plugin_reads_the_catalogue_of_the_package():
    from gis_radar_plugin.words import dictionary

    assert dictionary("de") == catalogue("de")
    assert dictionary("fr") == {}


# Qt 6 knows an enum's members by the enum only: Qt.AlignmentFlag.AlignRight, not Qt.AlignRight.
NO_ENUM = {
    "QgsRuleBasedRenderer.Rule",
    "QgsLayoutObject.DataDefinedProperty",  # the enums themselves
    "QWizard.WizardButton", "QgsFileWidget.StorageMode",
    "QgsProcessingParameterDefinition.Flag", "QgsMapLayer.StyleCategory",
    "QgsVectorLayer.LayerOptions",
    "QgsVectorFileWriter.SaveVectorOptions", "QgsProcessingContext.LayerDetails",
    "QgsLayoutExporter.PdfExportSettings", "QgsLayoutExporter.ImageExportSettings",
}  # fmt: skip


def is_short(node):
    """Tell Class.Member of Qt or QGIS."""
    return (
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and re.match(r"(Qgs|Qgis$|Q[A-Z]|Qt$)", node.value.id) is not None
        and node.attr[0].isupper()
    )


def test_every_command_has_its_algorithm_or_says_why_not():
    """What an algorithm offers of its command's options is compared in a real QGIS."""
    text = (FOLDER.parent / "tests" / "test_options.py").read_text(encoding="utf-8")
    tables = {
        ast.unparse(each.targets[0]): each.value
        for each in ast.parse(text).body
        if isinstance(each, ast.Assign)
    }
    named = [ast.literal_eval(tables[name]) for name in ("COMMANDS", "NO_ALGORITHM")]
    assert sorted(group.commands) == sorted([*named[0], *named[1]])


def test_enums_are_scoped_as_qt_6_wants_them():
    short = set()
    for path in FOLDER.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        longer = {node.value for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        for node in ast.walk(tree):
            if is_short(node) and node not in longer:
                short.add(f"{node.value.id}.{node.attr}")
    assert sorted(short - NO_ENUM) == []


def test_qt_comes_through_qgis():
    for path in FOLDER.rglob("*.py"):
        assert not re.search(r"import PyQt|from PyQt", path.read_text(encoding="utf-8")), path


def test_it_reads_as_python_3_9():
    for path in FOLDER.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 9))
        for node in ast.walk(tree):  # what parses, but fails as it runs
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", "")
                unions = [arg for arg in node.args if isinstance(arg, ast.BinOp)]
                assert not (name == "isinstance" and unions), f"{path}:{node.lineno}"
                words = {word.arg for word in node.keywords}
                assert not (name == "zip" and "strict" in words), f"{path}:{node.lineno}"
                assert not (name == "dataclass" and words & {"kw_only", "slots"}), path


def tool():
    spec = importlib.util.spec_from_file_location("plugin_zip", ROOT / "tools" / "plugin_zip.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_zip(tmp_path):
    builder = tool()
    wheel = tmp_path / f"gis_radar-{builder.project()['version']}-py3-none-any.whl"
    wheel.write_bytes(b"wheel")
    first = builder.build(tmp_path / "a", wheel)
    assert first.read_bytes() == builder.build(tmp_path / "b", wheel).read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = archive.namelist()
        metadata = archive.read("gis_radar_plugin/metadata.txt").decode()
    assert {name.split("/")[0] for name in names} == {"gis_radar_plugin"}
    assert not [name for name in names if re.search(r"__pycache__|\.pyc$|/\.|tests?/", name)]
    for name in ("metadata.txt", "LICENSE", "__init__.py", f"worker/{wheel.name}"):
        assert f"gis_radar_plugin/{name}" in names
    catalogue_files = {
        f"base/languages/{name}" for name in ("po.py", "de/LC_MESSAGES/gis_radar.po")
    }
    shared = {name.partition("/resources/")[2] for name in names if "/resources/" in name}
    assert shared == documents_of_the_plugin() | catalogue_files
    fields = dict(line.split("=", 1) for line in metadata.splitlines() if re.match(r"\w+=", line))
    assert fields["version"] == builder.project()["version"]
    assert fields["hasProcessingProvider"] == "yes"
    assert (fields["qgisMinimumVersion"], fields["qgisMaximumVersion"]) == ("3.34", "4.99")
    assert fields["supportsQt6"] == "True"
    assert (FOLDER / fields["icon"]).is_file()
    assert all(fields[name] for name in builder.REQUIRED)


def documents_of_the_plugin():
    """Return the files of the package that the plugin's source asks for."""
    text = "".join(path.read_text(encoding="utf-8") for path in FOLDER.rglob("*.py"))
    return set(re.findall(r'shared\("([^"]+\.\w+)"\)', text))


def test_a_wheel_of_another_version_is_refused(tmp_path):
    with pytest.raises(SystemExit, match="not of version"):
        tool().build(tmp_path, tmp_path / "gis_radar-99.0-py3-none-any.whl")


def test_the_checks_of_the_plugin_site():
    """The site that distributes plugins runs bandit; it shall find nothing."""
    if importlib.util.find_spec("bandit") is None:
        pytest.skip("bandit is not installed")
    words = [sys.executable, "-m", "bandit", "--quiet", "--recursive", "--format", "json", FOLDER]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert json.loads(done.stdout)["results"] == []


@pytest.fixture
def drafts(plugin):
    """What the site wizard fills in, as far as it needs no QGIS."""
    from gis_radar_plugin.wizard import draft

    return draft


def test_what_the_wizard_writes_is_a_site_file(drafts, tmp_path):
    """Read back by the code that the command line reads it with, quotes and umlauts and all."""
    sample = ROOT / "sample_maps"
    site = drafts.SiteDraft(
        title='Haupt"straße" \\ Bahnhof', timezone="Europe/Berlin", language="de",
        map_file=str(sample / "junction.osm"), crs="EPSG:25832", origin="690400.0, 5336200.0",
        map_source="Stadt", scans=[str(sample / "scan.laz")], scan_crs="EPSG:25832",
        scan_source="Land", attribution="Wir", footprints=True, intervals=["15min", "1h"],
    )  # fmt: skip
    shutil.copy(sample / "R1.parquet", tmp_path / "R1_2.parquet")
    name = drafts.next_name(site.sensors)
    site.sensors.append(
        drafts.SensorDraft(
            name, [str(sample / "R1.parquet"), str(tmp_path / "R1_2.parquet")],
            690356.1234, 5336183.0,
            heading=21.66, view={"azimuth_deg": 100.0, "max_range_m": 250.0}, cycle="150ms",
        )
    )  # fmt: skip
    name = drafts.next_name(site.sensors)
    site.sensors.append(
        drafts.SensorDraft(name, [str(sample / "R2.parquet")], pose=str(sample / "R2.json"),
                           measured={"azimuth_deg": 114.0, "max_range_m": 178.0})
    )  # fmt: skip
    path = tmp_path / "SITE.toml"
    path.write_text(site.text(tmp_path), encoding="utf-8")
    import gis_radar as gr

    read = gr.read_site(path)
    assert read.title == site.title
    assert (read.timezone, read.language) == ("Europe/Berlin", "de")
    assert read.map.origin == (690400.0, 5336200.0)
    assert read.credits == ["Stadt", "Land", "Wir"]
    assert read.measure.clearance == (-0.5, 4.5)
    assert (read.vehicles.follow, read.vehicles.footprints) == (True, True)
    assert read.heatmap.intervals == ("15min", "1h")
    one, other = read.sensor
    assert (one.name, one.guess, one.heading) == ("R1", (690356.12, 5336183.0), 21.7)
    assert [path.name for path in one.recordings] == ["R1.parquet", "R1_2.parquet"]
    assert (one.view.azimuth_deg, one.view.max_range_m, one.cycle) == (100.0, 250.0, 0.15)
    assert (other.pose, other.guess) == (sample / "R2.json", None)
    assert other.view is None  # the pose has one


def test_files_are_named_from_the_site_file(drafts, tmp_path):
    """So that the folder can be moved; what is elsewhere is named in full."""
    beside, elsewhere = tmp_path / "site" / "data" / "a.osm", tmp_path / "b.laz"
    text = drafts.SiteDraft(map_file=str(beside), scans=[str(elsewhere)]).text(tmp_path / "site")
    assert 'file = "data/a.osm"' in text
    assert f'files = ["{elsewhere.as_posix()}"]' in text


def test_an_earlier_site_file_is_kept(drafts, tmp_path):
    path = tmp_path / "SITE.toml"
    assert drafts.keep_earlier(path, "new") is None
    path.write_text("by hand")
    assert drafts.keep_earlier(path, "by hand") is None
    (tmp_path / "SITE_1.toml").write_text("still earlier")
    assert drafts.keep_earlier(path, "new") == tmp_path / "SITE_2.toml"
    assert (tmp_path / "SITE_2.toml").read_text() == "by hand"
    assert (tmp_path / "SITE_1.toml").read_text() == "still earlier"
    assert not path.exists()


def test_the_wizard_knows_every_key_that_it_can(drafts):
    """A key of the site file that the wizard does not offer is left out on purpose."""
    from gis_radar.site import Sensor, Site

    left_out = {
        "tiles",  # half a metre is the unit of all statistics
        "subtypes", "road", "engine", "min_speed", "min_rcs", "elevation_error",  # for specialists
        "live",  # a server runs it, not QGIS
        "lane",  # numbers of lanes are known once tiles are made
        "accept",  # asked for by the check that refuses a sensor, and decided in the file
        "method", "tied", "convert", "compass", "min_range_m",  # the defaults serve; a drag is one
    }  # fmt: skip
    keys = {"title", "timezone", "language", "csv_locale", "attribution", "map", "scan",
            "measure", "vehicles", "heatmap", "sensor"}  # fmt: skip
    assert set(Site.model_fields) - left_out == keys
    fields = {"name", "recordings", "guess", "heading", "pose", "cycle", "view"}
    assert set(Sensor.model_fields) - left_out == fields

"""The command line as outside scripts use it: exit codes, one line of error, JSON lines."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time

import click
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from sites import EAST, NORTH, START, crossing, lane_quads, pose, recording, tiles_of

import gis_radar as gr
from gis_radar.base import Text
from gis_radar.cli import group
from gis_radar.cli.console import JsonConsole, Result, TerminalConsole, command, run_group

COMMANDS = sorted(group.commands)


@pytest.fixture
def site(tmp_path):
    """A folder with tiles, a recording and its pose."""
    problems = crossing().iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    gr.write_tiles(crossing(), tmp_path / "tiles.gpkg", problems=problems)
    pose().write(tmp_path / "R1.json")
    rng = np.random.default_rng(0)
    time_s = START + np.arange(400) // 4 * 0.05
    points = np.column_stack(
        [rng.uniform(10, 30, 400), rng.uniform(-9, 9, 400), np.full(400, -4.5)]
    )
    recording(tmp_path / "R1.parquet", time_s, points)
    return tmp_path


def measure_words(site, out="occ"):
    return (
        "measure", site / "R1.parquet", "--pose", site / "R1.json",
        "--tiles", site / "tiles.gpkg", "--hits-only", "-o", site / out,
    )  # fmt: skip


def refused(answer, code, *parts):
    """Check the exit code and that the error is one line with these parts."""
    assert answer[0] == code, answer
    lines = [line for line in answer[2].splitlines() if not line.startswith("warning")]
    assert len(lines) == 1, lines
    assert "Traceback" not in answer[2]
    for part in parts:
        assert str(part) in lines[0]


def test_the_help_says_what_each_command_does_in_whole_sentences():
    """A narrow terminal wraps them: a sentence that is cut tells nobody which command to take."""
    shown = CliRunner().invoke(group, ["--help"], terminal_width=80).output
    assert max(map(len, shown.splitlines())) <= 80
    commands = " ".join(shown.split("Commands:")[1].split())
    assert "..." not in commands
    for name, verb in group.commands.items():
        sentence = " ".join(verb.help.split("\n\n")[0].split()).removesuffix(".")
        assert f"{name} {sentence}." in commands


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_has_an_example(name):
    answer = CliRunner().invoke(group, [name, "--help"])
    assert answer.exit_code == 0
    assert "Example: gis-radar" in " ".join(answer.output.split())


def test_an_option_that_a_pose_overrules_is_said(site, run):
    code, _, err = run(*measure_words(site), "--max-range", "50")
    assert code == 0
    assert "the pose of R1 has another view, which counts" in err


def test_an_option_that_a_pose_agrees_with_is_no_warning(site, run):
    seen_m = gr.read_pose(site / "R1.json").view.max_range_m
    code, _, err = run(*measure_words(site), "--max-range", str(seen_m))
    assert code == 0
    assert "which counts" not in err


def test_no_trustworthy_answer(site, run):
    pose(easting=EAST + 9000).write(site / "R1.json")
    words = "no tile lies in the view of R1", " m from the nearest tile"
    refused(run(*measure_words(site)), 4, *words)
    assert not (site / "occ").exists()


def test_any_name_of_a_sensor_can_be_shown(site, run):
    pose(sensor="[/b] $\\frac{$").write(site / "R1.json")
    code, out, _ = run(*measure_words(site))
    assert code == 0
    assert "[/b] $\\frac{$" in out
    words = ("heatmap", site / "occ", "-o", site / "map")
    assert run(*words)[0] == 0


def test_the_whole_way(site, run):
    assert run(*measure_words(site))[0] == 0
    words = ("heatmap", site / "occ", "-o", site / "map")
    code, out, _ = run(*words, "--interval", "1s")
    assert code == 0
    assert "hits.tif" in out
    names = {"heatmap.gpkg", "hits.tif", "heatmap.parquet", "heatmap.png"}
    assert names <= {path.name for path in (site / "map").iterdir()}


def test_json_lines(site, run):
    code, out, err = run(*measure_words(site), "--json")
    events = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert err == ""
    assert {event["event"] for event in events} == {"progress", "log", "result"}
    assert events[-1]["outputs"] == [str(site / "occ")]
    assert events[-1]["summary"]["hits"] > 10
    progress = [event for event in events if event["event"] == "progress"]
    assert progress[-1] == {"event": "progress", "stage": "measuring", "done": 1, "total": 1}


def test_json_errors(site, run):
    code, out, err = run("project", site / "gone.parquet", "--pose", site / "R1.json",
                         "-o", site / "hits.gpkg", "--json")  # fmt: skip
    assert (code, err) == (3, "")
    event = json.loads(out)
    assert event["event"] == "error"
    assert event["code"] == 3
    assert "gone.parquet" in event["message"]
    code, out, _ = run("project", "--json")
    assert code == 2
    assert json.loads(out)["code"] == 2


def test_wrong_usage(site, run):
    refused(run("tiles"), 2, "MAP.osm")
    refused(run("nonsense"), 2, "nonsense")
    refused(run(*measure_words(site), "--clearance", "high"), 2, "LOW,HIGH")
    refused(run(*measure_words(site), "--clearance", "4,0"), 2, "clearance")
    refused(run(*measure_words(site), "--pose", site / "R1.json"), 2, "1 recordings", "2 poses")
    refused(run(*measure_words(site), "--azimuth", "400"), 2, "azimuth_deg is 400")
    refused(run(*measure_words(site), "--max-range", "-5"), 2, "-5")
    refused(run(*measure_words(site), "--min-rcs", "nan"), 2, "nan")
    words = ("heatmap", site / "occ", "-o", site / "map")
    run(*measure_words(site))
    refused(run(*words, "--interval", "soon"), 2, "soon")
    refused(run(*words, "--interval", ""), 2, "interval")
    refused(run(*words, "--at", "14 November"), 2, "expected a time such as 2026-11-20 09:00")
    assert not (site / "map").exists()


def test_files_that_are_missing_or_wrong(site, run):
    words = list(measure_words(site))
    for position, name in ((1, "R9.parquet"), (3, "R9.json"), (5, "t.gpkg")):
        changed = [*words[:position], site / name, *words[position + 1 :]]
        refused(run(*changed), 3, name)
    (site / "R1.parquet").write_bytes((site / "R1.parquet").read_bytes()[:500])
    refused(run(*words), 3, "R1.parquet")
    assert not (site / "occ").exists()


def test_a_map_that_is_no_map(tmp_path, run):
    for content in (b"", b"<osm", b"PK\x03\x04", b"<osm/>", b"<!DOCTYPE osm><osm/>"):
        (tmp_path / "map.osm").write_bytes(content)
        refused(run("tiles", tmp_path / "map.osm", "-o", tmp_path / "t.gpkg"), 3, "map.osm")
    assert [path.name for path in tmp_path.iterdir()] == ["map.osm"]


def test_a_geographic_crs_is_refused_by_name(run, tmp_path):
    sample = gr.sample_folder() / "junction.osm"
    words = ("tiles", sample, "-o", tmp_path / "t.gpkg", "--crs")
    refused(run(*words, "EPSG:4326"), 3, "--crs", "WGS 84", "geographic")
    refused(run(*words, "EPSG:0"), 3, "--crs")
    assert list(tmp_path.iterdir()) == []


def test_tiles_of_another_map_or_crs(site, run):
    run(*measure_words(site))
    none = crossing().iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    other = tiles_of([lane_quads(EAST, NORTH, 45.0)])
    gr.write_tiles(other, site / "other.gpkg", problems=none)
    words = list(measure_words(site))
    words[5] = site / "other.gpkg"
    refused(run(*words), 3, "tiles")
    pose(crs="EPSG:32632").write(site / "R1.json")
    refused(run(*measure_words(site, "occ2")), 3, "EPSG:32632", "EPSG:25832")
    assert not (site / "occ2").exists()


def test_a_place_that_cannot_be_written(site, run):
    refused(run(*measure_words(site, "gone/occ")), 3, "gone", "cannot be written")
    (site / "thesis").mkdir()
    (site / "thesis" / "chapter1.txt").write_text("work")
    refused(run(*measure_words(site, "thesis")), 3, "chapter1.txt")
    assert (site / "thesis" / "chapter1.txt").read_text() == "work"


def test_no_command_replaces_what_it_reads(site, run):
    before = {path.name: path.read_bytes() for path in site.iterdir()}
    sources = {name: site / name for name in before}
    tiles, recording_, pose_ = (sources[n] for n in ("tiles.gpkg", "R1.parquet", "R1.json"))
    calls = [
        ("tiles", tiles, "-o", tiles),
        ("project", recording_, "--pose", pose_, "-o", recording_),
        measure_words(site, "R1.json"),
    ]
    for words in calls:
        refused(run(*words), 3, "input")
    assert {path.name: path.read_bytes() for path in site.iterdir()} == before


def test_every_option_reaches_its_argument(site, run):
    """What the dataset says of a call that sets all options."""
    pose(view=None).write(site / "R1.json")
    answer = run(
        *measure_words(site), "--max-range", "150", "--azimuth", "90", "--elevation", "20",
        "--min-speed", "0.15", "--min-rcs", "-3", "--clearance", "0.1,4.5",
        "--elevation-error", "0.7", "--timezone", "Europe/Berlin",
    )  # fmt: skip
    assert answer[0] == 0, answer
    made = gr.open_dataset(site / "occ")
    given = {"min_speed": 0.15, "min_rcs": -3.0, "clearance": [0.1, 4.5],
             "elevation_error_deg": 0.7}  # fmt: skip
    assert given.items() <= made.manifest.settings["filters"].items()
    assert not made.has_vehicles
    assert made.timezone == "Europe/Berlin"
    (document,) = made.poses()["document"]
    view = json.loads(document)["view"]
    assert (view["azimuth_deg"], view["elevation_deg"], view["max_range_m"]) == (90.0, 20.0, 150.0)


def test_tiles_options_reach_their_arguments(tmp_path, run):
    words = ("tiles", gr.sample_folder() / "junction.osm", "-o", tmp_path / "t.gpkg")
    assert run(*words, "--crs", "EPSG:25833", "--length", "2", "--subtype", "road")[0] == 0
    tiles = gr.read_tiles(tmp_path / "t.gpkg")
    assert tiles.crs == "EPSG:25833"
    assert tiles["length_m"].median() == pytest.approx(2.0, abs=0.1)
    assert set(tiles["subtype"]) == {"road"}


DROPPING = """
import ctypes, sys, click
from gis_radar.cli.console import run_group
@click.group()
def group(): pass
@group.command()
def drop(): ctypes.pythonapi.PyRun_SimpleString(b"raise KeyboardInterrupt")
sys.argv = ["gis-radar", "drop"]
run_group(group)
"""


def test_an_interruption_that_compiled_code_drops_is_no_traceback():
    """As of a message of PROJ, which pyproj hands to Python's log."""
    words = [sys.executable, "-c", DROPPING]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("signal_name", ["SIGINT", "SIGTERM"])
def test_an_interruption_leaves_nothing_and_says_130(site, signal_name):
    """A long recording is stopped midway."""
    rows = 600_000
    time_s = START + np.arange(rows) // 500 * 0.05
    column = np.full(rows, 20.0, dtype=np.float32)
    zero = np.zeros(rows, dtype=np.float32)
    names = ("x", "y", "z", "range_rate", "rcs")
    made = pa.table({"time": time_s, **dict(zip(names, [column, *[zero] * 4], strict=True))})
    pq.write_table(made, site / "R1.parquet")
    command = [sys.executable, "-m", "gis_radar", *map(str, measure_words(site)), "--json"]
    command += ["--accept", "R1"]  # its frames are all the same
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in child.stdout:
        event = json.loads(line)  # the check before it writes nothing
        if event["event"] == "progress" and not event["stage"].startswith("checking"):
            break
    child.send_signal(getattr(signal, signal_name))
    out, err = child.communicate(timeout=300)
    assert child.returncode == 130, err
    event = json.loads(out.splitlines()[-1])
    assert (event["event"], event["code"]) == ("error", 130)
    assert "Traceback" not in err
    names = sorted(path.name for path in site.iterdir())
    assert names == ["R1.json", "R1.parquet", "occ", "tiles.gpkg"]
    assert gr.open_dataset(site / "occ").hours().empty
    assert not list((site / "occ").rglob(".*"))


def test_an_interruption_that_python_drops_comes_again():
    """What is raised in a callback of a weak reference goes to a hook and is ignored."""
    dropped = """
import signal, sys, time, weakref
import click
from gis_radar.cli.console import run_group

class Thing:
    pass

@click.command()
def waits():
    thing = Thing()
    kept = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
    del thing
    time.sleep(30.0)

run_group(waits)
"""
    begun = time.monotonic()
    answer = subprocess.run([sys.executable, "-c", dropped], check=False, capture_output=True)
    assert answer.returncode == 130
    assert time.monotonic() - begun < 25.0


@pytest.mark.parametrize("levels", [1, 3])
def test_an_interruption_of_compiled_code_is_one(capfd, monkeypatch, handlers_stay, levels):
    """Numba reports errors of its own for an interruption that reaches it, at each of its calls."""

    @command(example="work")
    def work(*, reporter):
        cause = KeyboardInterrupt()
        for _ in range(levels):
            error = SystemError("a result with an exception set")
            error.__cause__, cause = cause, error
        raise error

    monkeypatch.setattr(sys, "argv", ["gis-radar", "work", "--json"])
    with pytest.raises(SystemExit) as ended:
        run_group(click.Group(commands=[work]))
    event = json.loads(capfd.readouterr().out)
    assert (ended.value.code, event["code"]) == (130, 130)
    assert event["message"] == "interrupted; nothing was left half-written"


def test_as_a_module_it_is_the_same_command(site):
    environment = {**os.environ, "COLUMNS": "80"}
    answer = subprocess.run(
        [sys.executable, "-m", "gis_radar", "--version"],
        check=True, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert "version" in answer.stdout


def test_a_foreign_proj_database_does_not_spoil_a_map(site, run):
    """Some programs leave PROJ_DATA pointing to their own, older database."""
    run(*measure_words(site))
    with sqlite3.connect(site / "proj.db") as old:
        old.execute("create table metadata (key text, value text)")
        layout = [("DATABASE.LAYOUT.VERSION.MAJOR", "1"), ("DATABASE.LAYOUT.VERSION.MINOR", "0")]
        old.executemany("insert into metadata values (?, ?)", layout)
    old.close()
    words = ("heatmap", site / "occ", "-o", site / "map")
    answer = subprocess.run(
        [sys.executable, "-m", "gis_radar", *map(str, words)],
        check=False, capture_output=True, text=True,
        env={**os.environ, "PROJ_DATA": str(site), "PROJ_LIB": str(site)},
    )  # fmt: skip
    assert answer.returncode == 3, answer
    assert "PROJ_DATA" in answer.stderr
    assert "Traceback" not in answer.stderr
    assert not (site / "map").exists()


def test_a_table_in_a_summary_keeps_its_digits(capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    row = {"easting": 690360.0421, "northing": 5336178.0914, "state": "no pose fits [/b]"}
    result = Result(outputs=[], summary={"sensors": {"R2": {"yaw": -1.5}, "R1": row}})
    with TerminalConsole() as console:
        console.result(result)
    heads, second, first = filter(None, capfd.readouterr().out.splitlines())
    assert heads.split() == ["sensors", "easting", "northing", "state", "yaw"]
    assert first.split() == ["R1", "690360.042", "5336178.091", "no", "pose", "fits", "[/b]"]
    assert second.split() == ["R2", "-1.500"]
    result = Result(
        outputs=[], summary={"sensors": {"R1": {"max_range_m": 190.0, "azimuth": 114.3}}}
    )
    with TerminalConsole() as console:
        console.result(result)
    assert capfd.readouterr().out.split()[-3:] == ["R1", "190", "114.300"]


def test_a_summary_says_what_is_not_known(capfd):
    result = Result(outputs=[], summary={"tiles": 66549, "epoch": None})
    with TerminalConsole() as console:
        console.result(result)
    told = [line.split() for line in capfd.readouterr().out.splitlines() if line.strip()]
    assert told == [["tiles", "66,549"], ["epoch", "not", "known"]]


@pytest.fixture
def clock(monkeypatch):
    """Set the console's clock: seconds, to be moved."""
    clock = [1000.0]
    monkeypatch.setattr("gis_radar.cli.console.monotonic", lambda: clock[0])
    return clock


def test_a_log_hears_now_and_then_of_what_moves(capfd, clock):
    """Bars are for terminals; without one a run is not silent for hours."""
    with TerminalConsole() as console:
        for done in range(5):
            console.progress("all stages", 1, 4)
            console.progress("hits R1", 10 * done, 100)
            clock[0] += 5.9
        assert capfd.readouterr().err == ""
        clock[0] += 0.6
        console.progress("running PDAL", 65_536, None)  # of what, and of how many, nobody knows
        assert capfd.readouterr().err == "all stages 25 %, hits R1 40 %, running PDAL\n"
        clock[0] += 31.0
        console.progress("hits R1", 50, 100)
        assert capfd.readouterr().err == "hits R1 50 %\n"
        clock[0] += 31.0
        console.progress("hits R1", 100, 100)
    assert capfd.readouterr().err == ""


def test_a_remark_ends_the_silence_of_a_log(capfd, clock):
    with TerminalConsole() as console:
        clock[0] += 29.0
        console.log("R1: its clock jumps")
        clock[0] += 29.0
        console.progress("hits R1", 10, 100)
        assert capfd.readouterr().err == "R1: its clock jumps\n"
        clock[0] += 1.0
        console.progress("hits R1", 20, 100)
    assert capfd.readouterr().err == "hits R1 20 %\n"


def test_lines_of_progress_are_german_for_who_wants_it(capfd, clock, monkeypatch):
    monkeypatch.setenv("GIS_RADAR_LANGUAGE", "de")
    with TerminalConsole() as console:
        console.progress("all stages", 1, 4)
        clock[0] += 31.0
        console.progress(Text("localize {}", "R1"), 50, 100)
    told = "alle Schritte 25 %, Standort und Ausrichtung suchen: R1 50 %\n"
    assert capfd.readouterr().err == told


def test_people_read_the_clocks_of_the_site_and_programs_utc(capfd):
    summary = {"sensors": {"R1": {"begin": "2025-06-12T07:30:00.050Z"}}, "end": "2025-12-12T23:30Z"}
    result = Result(outputs=[], summary=summary, timezone="Europe/Berlin")
    TerminalConsole().result(result)
    printed = capfd.readouterr().out
    assert "2025-06-12 09:30:00.050 UTC+02:00" in printed
    assert "2025-12-13 00:30 UTC+01:00" in printed
    assert "Europe/Berlin" in printed
    JsonConsole().result(result)
    told = json.loads(capfd.readouterr().out)
    assert told["summary"] == summary
    assert told["local"]["end"] == "2025-12-13 00:30 UTC+01:00"  # as the plugin shows it


def test_sentences_of_a_summary_are_lines_of_their_own(capfd):
    summary = {
        "facts": {"Recorded": "100 s", "Sensors": "2 (R1, R2)"},
        "basis": [["What", "Here"], ["Recorded", "100 s"], ["Sensors", "two of them"]],
        "remarks": ["Only 100 s were recorded", "R2 stands alone"],
        "highest_lane": 17863, "worst_lane": None,
    }  # fmt: skip
    TerminalConsole().result(Result(outputs=[], summary=summary))
    lines = [line.strip() for line in capfd.readouterr().out.splitlines()]
    assert lines == [
        "facts         Recorded: 100 s", "Sensors: 2 (R1, R2)",
        "remarks       Only 100 s were recorded", "R2 stands alone", "highest lane  17863",
        "worst lane    not known",
        "basis", "What      Here", "Recorded  100 s", "Sensors   two of them",
    ]  # fmt: skip


def test_another_pipe_that_breaks_is_told():
    """Only where nobody listens is there nothing to say."""
    code = (
        "import click\n"
        "from gis_radar.cli.console import command, run_group\n"
        "@command(example='work')\n"
        "def work(*, reporter):\n"
        "    raise BrokenPipeError(32, 'Broken pipe')\n"
        "run_group(click.Group(commands=[work]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "work"],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 3
    assert "ended early: [Errno 32] Broken pipe" in done.stderr


@pytest.mark.parametrize("name", ["map.osm", "SITE.toml", "R1.json"])
def test_nobody_waits_for_a_pipe_or_reads_a_device_to_its_end(run, tmp_path, name):
    os.mkfifo(tmp_path / name)
    words = {
        "map.osm": ["tiles", tmp_path / name, "-o", tmp_path / "out.gpkg"],
        "SITE.toml": ["check", tmp_path / name],
        "R1.json": ["sensors", "/dev/zero", "-o", tmp_path / "out.gpkg"],
    }[name]
    refused(run(*words), 3, words[1], "is a pipe or a device, expected a file")
    told = json.loads(run(*words, "--json")[1])
    assert (told["event"], told["code"]) == ("error", 3)

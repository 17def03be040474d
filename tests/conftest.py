"""What this machine has for the tests: PDAL, with a word on it at the end, and SUMO."""

import gc
import hashlib
import importlib.util
import multiprocessing
import os
import pickle
import shutil
import signal
import socket
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import hypothesis
import pandas as pd
import pytest
from filelock import FileLock

import gis_radar as gr
from gis_radar.cli import group
from gis_radar.cli.console import run_group
from gis_radar.hdmap import fingerprint
from gis_radar.live.hours.jobs import HourJobs
from gis_radar.scans import find_pdal
from gis_radar.scans.pdal import VARIABLE

FETCHED = Path(__file__).parents[1] / ".pdal" / "bin" / "pdal"
PICTURED = {"test_heatmap_files.py", "test_heatmap_occupancy.py", "test_same_bytes.py"}
NONE = "none was found, and `make pdal` fetched none"
os.environ["LANGUAGE"] = "en"  # whatever this machine speaks


@pytest.fixture(scope="session")
def pdal():
    """Give the PDAL of this machine; skip where there is none, fail where it does not start."""
    runner = find_pdal()
    if runner is None:
        assert VARIABLE not in os.environ, f"{os.environ[VARIABLE]} does not start"
        pytest.skip(f"no PDAL here: {NONE}")
    return runner


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Give a function that makes what is dear once for all processes of a run of the tests.

    It calls ``work(folder)``, whose answer the others read: it is only to be looked at.
    """
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    def make(name, work):
        made = root / f"{name}.pickle"
        with FileLock(root / f"{name}.lock"):
            if not made.exists():
                folder = tmp_path_factory.mktemp(name)
                made.write_bytes(pickle.dumps(work(folder)))
        return pickle.loads(made.read_bytes())  # noqa: S301 - our own

    return make


@pytest.fixture(scope="session")
def first_seconds(once):
    """Give a function that cuts a recording of the sample: its hundred seconds take longer."""

    def cut(path, seconds):
        def write(folder):
            table = pd.read_parquet(path)
            kept = table[table["time"] < table["time"].iloc[0] + seconds]
            kept.to_parquet(folder / path.name, index=False)
            return folder / path.name

        return once(f"{path.stem}-{seconds:.0f}s", write)

    return cut


@pytest.fixture(scope="session")
def measure_once(once):
    """Give a function that measures for all who ask in the same words, and gives the folder."""
    measure = gr.measure

    def measured(recordings, poses, tiles, map_path, **options):
        options = {"check": False} | options  # a third of the time; test_plausibility.py is on it
        asked = [recordings, [vars(pose) for pose in poses], fingerprint(tiles), map_path, options]
        name = f"dataset-{hashlib.sha256(repr(asked).encode()).hexdigest()[:16]}"

        def make(folder):
            measure(recordings, poses, tiles, map_path, folder / "made", **options)
            return folder / "made"

        return once(name, make)

    return measured


@pytest.fixture
def measured_once(monkeypatch, measure_once):
    """Make a dataset that several examples measure with the same words only once."""

    def measured(recordings, poses, tiles, map_path, out, **options):
        made = measure_once(recordings, poses, tiles, map_path, **options)
        return gr.open_dataset(shutil.copytree(made, out))

    monkeypatch.setattr(gr, "measure", measured, raising=False)


def _of_the_first(seconds):
    @pytest.fixture
    def measured_once_of_the_first(monkeypatch, measured_once, first_seconds):
        """Measure once what several examples ask for, of the sample's first seconds."""
        measure = gr.measure

        def measured(recordings, *given, **options):
            return measure([first_seconds(each, seconds) for each in recordings], *given, **options)

        monkeypatch.setattr(gr, "measure", measured, raising=False)

    return measured_once_of_the_first


measured_briefly, measured_a_minute = _of_the_first(12.0), _of_the_first(61.0)


@pytest.fixture(scope="session")
def sound_inputs(once):
    """Give a folder with a sound input of every kind, which is only to be looked at or copied."""

    def build(folder):
        with warnings.catch_warnings(action="ignore"):  # of hypothesis, about trio
            from fuzz.targets import build_inputs
        build_inputs(folder)
        return folder

    return once("sound_inputs", build)


@pytest.fixture
def sumo_installed():
    """Skip where SUMO is missing. Importing it would send PROJ to SUMO's data in this process."""
    if importlib.util.find_spec("sumo") is None:
        pytest.skip("SUMO is not installed")


def pytest_configure(config):
    # No deadline: a first call compiles, and other processes have the cores, too. `make test` draws
    # the same examples each time, so that it fails only by a change; `make faults` draws others.
    hypothesis.settings.register_profile(
        "ours", deadline=None, derandomize=os.environ.get("GIS_RADAR_FAULTS") != "all"
    )
    hypothesis.settings.load_profile("ours")
    if find_pdal() is None and FETCHED.is_file():
        os.environ[VARIABLE] = str(FETCHED)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # a shell's background job ignores interrupts, and what the tests start would inherit that
        signal.signal(signal.SIGINT, signal.default_int_handler)
    config.addinivalue_line("markers", "pdal: runs a real PDAL, by the fixture `pdal`")


def pytest_collection_modifyitems(items):
    for item in items:
        if "pdal" in getattr(item, "fixturenames", ()):
            item.add_marker("pdal")


def pytest_collection_finish():
    """Keep the garbage collector from looking at what lives to the end: modules and all tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)  # a twentieth of the tests' time went into young objects


def pytest_terminal_summary(terminalreporter):
    """Say before the runner's own last line whether real PDAL was tested."""
    reports = {
        # a file that could not be collected reports too, but has no keywords
        outcome: [
            report
            for report in terminalreporter.getreports(outcome)
            if "pdal" in getattr(report, "keywords", ())
        ]
        for outcome in ("passed", "failed", "error", "skipped")
    }
    if not any(reports.values()):
        return
    ran = [report for report in reports["passed"] if report.when == "call"]
    bad = reports["failed"] + reports["error"]
    if bad:
        text = f"PDAL: {len(bad)} tests with a real PDAL failed"
    elif ran:
        text = f"PDAL: tested with {find_pdal().name}, {len(ran)} tests"
    else:
        text = f"PDAL: not tested, only the built-in engine: {NONE}"
    terminalreporter.write_line(text)


@pytest.fixture
def handlers_stay():
    """Leave this process its handlers of signals: a command has its own until it ends."""
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    yield
    for each, handler in before.items():
        signal.signal(each, handler)


@pytest.fixture
def run(capfd, monkeypatch, handlers_stay):
    """Run a command in this process; return exit code, standard output and standard error."""

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["gis-radar", *map(str, words)])
        with pytest.raises(SystemExit) as leave:
            run_group(group)
        out, err = capfd.readouterr()
        return leave.value.code, out, err

    return call


@pytest.fixture
def port():
    """Give a port for datagrams that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def ready_workers(monkeypatch):
    """Fork the workers of the live system from a process that has loaded what they import.

    Each that is spawned loads it anew: 2.5 s of the processor. Those of programs, which tests
    start as processes, are spawned.
    """
    forking, get_context = multiprocessing.get_context("forkserver"), multiprocessing.get_context
    forking.set_forkserver_preload(
        ["numba", "gis_radar.live.hours.hour_work", "gis_radar.live.now.vehicles_now"]
    )
    chosen = lambda method=None: forking if method == "spawn" else get_context(method)  # noqa: E731
    monkeypatch.setattr(multiprocessing, "get_context", chosen)
    monkeypatch.setattr("gis_radar.live.hours.jobs.NICE", 0)  # beside other tests it would starve


class _WorkerThread(ThreadPoolExecutor):
    """Stands for the process in which fusion measures; it ends once its work is done."""

    def stop(self):
        super().shutdown(cancel_futures=True)


@pytest.fixture
def measured_in_a_thread(monkeypatch):
    """Let fusion measure in a thread where a test looks at other things than its process.

    It has two in its life; each loads for more than a second of the processor.
    """
    process = lambda: _WorkerThread(1)  # noqa: E731
    monkeypatch.setitem(HourJobs.__init__.__kwdefaults__, "process", process)


@pytest.fixture
def in_this_process(monkeypatch):
    """Stages of a run go in a thread of this process: starting workers takes longer than most."""
    from site_runs import in_a_thread

    monkeypatch.setattr("gis_radar.site.run.process_pool", in_a_thread)


@pytest.fixture
def all_fit():
    """Let poses pass unchecked where a test looks at other things: half of the time of a run."""
    from site_runs import unchecked

    with unchecked():
        yield


@pytest.fixture
def blank_paper():
    """Leave pictures and the PDF empty where a test looks at other files."""
    from site_runs import only_pictures

    with only_pictures():
        yield


@pytest.fixture
def without_report():
    """Leave the report of a run empty where a test looks at other results."""
    from site_runs import no_report

    with no_report():
        yield


@pytest.fixture
def without_pdf(monkeypatch):
    """Leave the PDF of reports empty where a test looks at other files: it takes the most time."""
    writing = importlib.import_module(
        "gis_radar.products.report.report"
    )  # there is a function, too
    monkeypatch.setattr(writing, "write_pdf", lambda _, path: path.write_bytes(b"%PDF"))


@pytest.fixture(scope="module", autouse=True)
def heatmap_pictures(request):
    """Leave pictures of heat maps empty but in PICTURED, which look at them: one takes a second."""
    with pytest.MonkeyPatch.context() as here:
        if request.path.name not in PICTURED:
            place = "gis_radar.products.heatmap.heatmap.write_figure"
            here.setattr(place, lambda _heat, path, _reporter: path.touch())
        yield


@pytest.fixture
def no_pdal(monkeypatch):
    """Hide every PDAL of this machine."""
    monkeypatch.setattr("gis_radar.scans.pdal.shutil.which", lambda *_, **__: None)
    monkeypatch.delenv(VARIABLE, raising=False)

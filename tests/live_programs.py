"""Programs of the live system as processes of their own, a link that can be cut, and the batch."""

import contextlib
import math
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from live_site import LONGEST_S, SAMPLE, free_port

import gis_radar as gr
from gis_radar.dataset.tables import FRAMES, HITS, OBSERVED
from gis_radar.live.edge import Edge
from gis_radar.live.hits_folder.folder import merge_stored_hits, read_stored_hits
from gis_radar.live.hits_folder.tables import LOG_COLUMNS
from gis_radar.measures.validity import valid_steps
from gis_radar.progress import Reporter

LONG = os.environ.get("GIS_RADAR_LIVE") == "all"
takes_long = pytest.mark.skipif(not LONG, reason="takes long: make live-test")


class Lines(Reporter):
    """A reporter that keeps what it is told."""

    def __init__(self):
        self.lines = []

    def log(self, message, _level="info"):
        self.lines.append(message)

    def told(self, words):
        return any(words in line for line in self.lines)


class HeldEdge(Edge):
    """A sensor's side whose recording goes on to so many frames and waits there."""

    until = math.inf

    def _source(self):
        for frame in super()._source():
            while self.frames >= self.until:
                time.sleep(0.01)
                yield None
            yield frame


class Program:
    """A gis-radar command that runs; its words go to a file."""

    def __init__(self, folder, *words):
        self.log = folder / f"{words[0]}-{time.monotonic_ns()}.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gis_radar", *map(str, words)], cwd=folder,
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    @property
    def said(self):
        return self.log.read_text(encoding="utf-8", errors="replace")

    def told(self, words):
        assert self.process.poll() in {None, 0}, self.said
        return words in self.said

    def kill(self):
        """Kill it without a word, as a power cut does."""
        self.process.kill()
        self.process.wait()

    def end(self):
        """Stop it as Ctrl-C does; all that is stored is then written."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        assert self.process.wait(LONGEST_S) == 0, self.said

    def wait(self):
        assert self.process.wait(LONGEST_S) == 0, self.said


class Cable:
    """A way to a port that can be cut: by force, or so that nothing is noticed.

    It counts whom it has turned away.
    """

    def __init__(self, to):
        self.port, self._to = free_port(), to
        self._pairs, self._cut, self._silent, self.refused = [], False, False, 0
        self._server = socket.create_server(("127.0.0.1", self.port))
        self._ended = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, *, silent):
        """End all links and refuse new ones; where silent, nobody is told and bytes are lost."""
        self._cut, self._silent = True, silent
        if not silent:
            self._drop()

    def mend(self):
        """Let through what comes from now on; what was cut in silence is gone."""
        self._drop()
        self._cut = self._silent = False

    def close(self):
        self._ended.set()
        self._server.close()
        self._drop()

    def _drop(self):
        pairs, self._pairs = self._pairs, []
        for each in pairs:
            for one in each:
                with_shutdown(one)

    def _accept(self):
        while not self._ended.is_set():
            try:
                near, _ = self._server.accept()
            except OSError:
                return
            if self._cut and not self._silent:
                near.close()
                self.refused += 1
                continue
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                near.close()
                continue
            pair = (near, far)
            self._pairs.append(pair)
            threading.Thread(target=self._carry, args=pair, daemon=True).start()

    def _carry(self, near, far):
        other = {near: far, far: near}
        try:
            while True:
                for one in select.select([near, far], [], [], 0.2)[0]:
                    data = one.recv(65_536)
                    if not data:
                        return
                    if not self._cut:
                        other[one].sendall(data)
        except (OSError, ValueError):
            return
        finally:
            for one in other:
                with_shutdown(one)


def with_shutdown(one):
    """Close a socket so that whoever waits for it wakes."""
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
    one.close()


class FullDisk:
    """A disk of its own in memory, a few megabytes large, that can be made larger."""

    def __init__(self, folder, size):
        self.folder = folder
        folder.mkdir(exist_ok=True)
        words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(words, check=False).returncode:
            pytest.skip("no disk in memory can be mounted here: that needs root")

    def grow(self, size):
        words = ["mount", "-o", f"remount,size={size}", str(self.folder)]
        subprocess.run(words, check=True)

    def close(self):
        subprocess.run(["umount", "-l", str(self.folder)], check=True)


def columns(stream):
    """Return the columns of a stream of rows, put together."""
    return [np.concatenate(each) for each in zip(*stream, strict=True)]


def assert_same_tables(live, batch):
    """Compare what fusion stored with a dataset of the same frames, row by row."""
    assert live.fingerprint == batch.manifest.fingerprint
    assert live.sensors == batch.sensors
    tile, step = valid_pairs(live, columns(live.hits_by_sensor(live.sensors)))
    hits = rows_of(batch, HITS, ("tile_id", "step"))
    assert len(tile)
    assert np.array_equal([tile, step], hits)
    log = dict(zip(LOG_COLUMNS, columns(live.frame_log(live.sensors)), strict=True))
    order = np.lexsort((log["time_us"], log["sensor"]))
    names = [name for name in LOG_COLUMNS if name != "sensor"]
    for name, theirs in zip(names, rows_of(batch, FRAMES, names), strict=True):
        assert np.array_equal(log[name][order], theirs), name
    assert np.array_equal(observed_steps(live), steps_of_runs(batch))


def rows_of(dataset, table, names):
    """Return columns of a table of a dataset."""
    parts = [part.select(names) for part in dataset.batches(table, columns=names)]
    return [np.concatenate([part[name].to_numpy() for part in parts]) for name in names]


def valid_pairs(live, rows):
    """Return (tile, step) of hits in all steps that their frames are valid, each once, ascending.

    A frame is valid in its own step and those up to its sensor's next frame, but a tenth of a
    second at most.
    """
    found = []
    for number, sensor in enumerate(live.sensors):
        step, tile = (column[rows[2] == number] for column in rows[:2])
        for k in range(valid_steps(live.validity_s[sensor]) + 1):
            held = k < steps_to_next(live, sensor, step)
            found.append(np.stack([tile[held], step[held] + k]))
    return np.unique(np.concatenate(found, axis=1), axis=1)


def steps_to_next(live, sensor, step):
    """Return how many steps after each of some frames of a sensor its next frame comes."""
    runs = live.frames[live.frames["sensor"] == sensor]
    spans = zip(runs["first_step"], runs["last_step"] + 1, strict=True)
    frames = np.unique(np.concatenate([np.arange(*span) for span in spans]))
    after = np.append(frames, np.iinfo(np.int64).max)[np.searchsorted(frames, step, "right")]
    return after - step


def observed_steps(live):
    """Return how many steps each tile is in sight of a valid frame, tiles ascending."""
    seen = {view: set(rows["tile_id"]) for view, rows in live.views.groupby("view")}
    by_tile = {}
    for (sensor, view), runs in live.frames.groupby(["sensor", "view"]):
        spans = zip(runs["first_step"], runs["last_step"] + 1, strict=True)
        step = np.concatenate([np.arange(*span) for span in spans])
        last = np.minimum(
            valid_steps(live.validity_s[sensor]), steps_to_next(live, sensor, step) - 1
        )
        steps = np.concatenate([step[last >= k] + k for k in range(int(last.max()) + 1)])
        for tile in seen.get(view, ()):
            by_tile.setdefault(tile, []).append(steps)
    sums = {tile: len(np.unique(np.concatenate(by_tile[tile]))) for tile in sorted(by_tile)}
    return np.array([[*sums], [*sums.values()]])


def steps_of_runs(dataset):
    """Return the same of a dataset."""
    tile, first, last = rows_of(dataset, OBSERVED, ("tile_id", "first_step", "last_step"))
    ids, number = np.unique(tile, return_inverse=True)
    return np.array([ids, np.bincount(number, last - first + 1).astype(np.int64)])


def stored(folder):
    """Return all hours that fusion wrote, as one."""
    hours = sorted((folder / "live" / "hits").iterdir())
    return merge_stored_hits([read_stored_hits(each) for each in hours])


def measured(names):
    """Return what makes the dataset of the hits of the sample's recordings, for `once`."""

    def make(folder):
        roads = SAMPLE / "junction.osm"
        poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in names]
        recordings = [SAMPLE / f"{name}.parquet" for name in names]
        tiles = gr.make_tiles(gr.read_map(roads))
        gr.measure(recordings, poses, tiles, roads, folder / "dataset", hits_only=True)
        return folder / "dataset"

    return make

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
from gis_radar.live.edge import Edge
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


def assert_same_tables(one, other):
    """Compare all tables of two occupancies exactly."""
    assert one.fingerprint == other.fingerprint
    assert one.frames.equals(other.frames)
    assert one.views.equals(other.views)
    assert one.hold_s == other.hold_s
    names = one.sensors
    for read in ("hits_by_sensor", "frame_log"):
        mine, theirs = (columns(getattr(each, read)(names)) for each in (one, other))
        assert len(mine[0])
        for number, (a, b) in enumerate(zip(mine, theirs, strict=True)):
            assert np.array_equal(a, b), f"{read}, column {number}"


def stored(folder):
    """Return all hours that fusion wrote, as one occupancy."""
    return gr.read_occupancy(sorted((folder / "live" / "occupancy").iterdir()))


def measured(names):
    """Return what makes the batch's occupancy of the sample's recordings, for `once`."""

    def make(folder):
        tiles = gr.make_tiles(gr.read_map(SAMPLE / "junction.osm"))
        poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in names]
        recordings = [SAMPLE / f"{name}.parquet" for name in names]
        gr.measure_occupancy(recordings, poses, tiles, folder / "occupancy")
        return folder / "occupancy"

    return make

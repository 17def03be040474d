"""Programs of the live system as processes of their own, a link that can be cut, and the batch."""

import contextlib
import hashlib
import math
import os
import select
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time

import numpy as np
import pandas as pd
import pytest
from live_hours import selected_frames
from live_site import LONGEST_S, free_port

import gis_radar as gr
from gis_radar.base import Reporter
from gis_radar.live import Edge, SpoolFile, spool_files, unpack_detections, unpack_message
from gis_radar.live.hours.spool import FRAMES_RECORD

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

    def source(self):
        for frame in super().source():
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

    def __init__(self, folder, size, *, files=0):
        self.folder, self.filling = folder, folder / "filling"
        folder.mkdir(exist_ok=True)
        options = f"size={size},nr_inodes={files}"  # 0: no limit
        words = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(words, check=False).returncode:
            pytest.skip("no disk in memory can be mounted here: that needs root")

    def fill(self):
        """Take all inodes."""
        self.filling.mkdir()
        with contextlib.suppress(OSError):
            for number in range(10_000):
                (self.filling / str(number)).touch()

    def free(self):
        """Give them back."""
        shutil.rmtree(self.filling)

    def grow(self, size):
        words = ["mount", "-o", f"remount,size={size}", str(self.folder)]
        subprocess.run(words, check=True)

    def close(self):
        subprocess.run(["umount", "-l", str(self.folder)], check=True)


def assert_equal_to_batch(site, names, *, hits_only=True, **given):
    """Compare the bytes of what fusion measured with those that `gis-radar measure` makes.

    The batch has the recordings that fusion wrote, and the poses beside them.
    """
    recordings = [path for name in names for path in recordings_of(site.folder, name)]
    poses = [gr.read_track(pose_beside(path)) for path in recordings]
    folder = site.folder / f"batch-{time.monotonic_ns()}"
    tiles = gr.read_tiles(site.tiles)
    given = {"hits_only": hits_only, "check": False} | given  # live refuses no pose
    gr.measure(recordings, poses, tiles, site.map_file, folder, **given)
    mine, theirs = (parts_of(each) for each in (site.folder / "live" / "dataset", folder))
    assert mine
    assert mine == theirs


def parts_of(dataset):
    """Return the digests of the bytes of all parts of a dataset."""
    return {
        str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in dataset.glob("*/date=*/*.parquet")
    }


def recordings_of(folder, name):
    """Return the recordings that fusion wrote of a sensor."""
    return sorted((folder / "live" / "recordings" / name).glob("*.parquet"))


def pose_beside(path):
    """Return the file with the poses of a recording."""
    alone = path.with_suffix(".json")
    return alone if alone.exists() else path.with_suffix(".csv")


def recorded(folder, name):
    """Return the rows that fusion has recorded of a sensor, also those of an hour still open."""
    paths = recordings_of(folder, name) + sorted(
        (folder / "live" / "parts" / name).glob("*.parquet")
    )
    tables = [pd.read_parquet(path) for path in paths]
    return pd.concat(tables, ignore_index=True).sort_values("time", kind="stable")


def frames_in(content):
    """Return the times (us) of the frames of a message."""
    return {each.time_us for each in unpack_detections(content)[1]}


def frames_on_disk(folder, name):
    """Return the times (us) of a sensor's frames that fusion holds, beside whoever writes them."""
    live, found = folder / "live", set()
    if [*live.glob(f"parts/{name}/*.parquet"), *recordings_of(folder, name)]:
        found = {round(1e6 * each) for each in recorded(folder, name)["time"]}
    for path in spool_files(live / "spool"):
        for _, record in SpoolFile(path).records():
            if (record.kind, record.sensor) == (FRAMES_RECORD, name):
                found |= frames_in(unpack_message(record.payload)[1])
    return found


def frames_that_wait(buffer):
    """Return the times (us) of frames in a sensor's buffer, once its program is gone."""
    with contextlib.closing(sqlite3.connect(buffer)) as database:
        rows = database.execute("SELECT content FROM messages").fetchall()
    return set().union(*(frames_in(content) for (content,) in rows))


def selected(name, *, path):
    """Return the rows that a sensor sends of a recording, as its own should hold them."""
    rows = [each.as_rows() for each in selected_frames(name, path)]
    points = np.concatenate([each.points for each in rows])
    table = {"time": np.concatenate([each.time for each in rows])}
    table |= {axis: points[:, k] for k, axis in enumerate("xyz")}
    table |= {
        column: np.concatenate([getattr(each, column) for each in rows])
        for column in ("range_rate", "rcs")
    }
    return pd.DataFrame(table)


def assert_all_recorded(site, names):
    """Compare what fusion has recorded with what the sensors select: each row, once."""
    for name in names:
        mine = recorded(site.folder, name)
        theirs = selected(name, path=site.recordings / f"{name}.parquet")
        assert len(mine) == len(theirs), name
        for column in theirs:
            np.testing.assert_array_equal(mine[column], theirs[column], err_msg=column)


def rows_of(dataset, table, names):
    """Return columns of a table of a dataset."""
    parts = [part.select(names) for part in dataset.batches(table, columns=names)]
    return [np.concatenate([part[name].to_numpy() for part in parts]) for name in names]

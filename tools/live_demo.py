"""Run the live system on the sample junction: a broker, fusion, and two radars that are replayed.

    python tools/live_demo.py out/live-demo

Ctrl-C or SIGTERM ends it. The folder `live` there has recordings, the dataset of finished hours,
and `now.gpkg` for QGIS.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Sequence
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path

import gis_radar as gr
from gis_radar.base import stopped_by_signals
from gis_radar.live import write_broker_files

PATIENCE_S = 180.0  # for a program to end: fusion may be measuring an hour
STATUS_S = 10.0  # between lines that are printed
SENSORS = ("R1", "R2")
SITE = """\
title = "Sample junction, replayed"
timezone = "Europe/Berlin"
[map]
file = "{sample}/junction.osm"
[live]
site = "junction"
tiles = "tiles.gpkg"
[live.page]
address = "127.0.0.1:{page}"
[live.broker]
address = "mqtt://127.0.0.1:{port}"
{password}
[[sensor]]
name = "R1"
[[sensor]]
name = "R2"
"""
EDGE = """\
sensor = "{name}"
site = "junction"
tiles = "tiles.gpkg"
pose = "{sample}/{name}.json"
[source]
recording = "{sample}/{name}.parquet"
loop = "100s"
[broker]
address = "mqtt://127.0.0.1:{port}"
password_file = "broker/password_of_{name}"
[view]
max_range_m = 200.0
[buffer]
file = "{name}.buffer"
"""


def main(folder: Path) -> None:
    """Write the files of the site, start the programs, and wait for Ctrl-C or SIGTERM."""
    mosquitto = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if mosquitto is None:
        sys.exit("live-demo: Mosquitto is not installed: sh tools/get_mosquitto.sh, as root")
    folder.mkdir(parents=True, exist_ok=True)
    page = write_files(folder, _free_port(), _free_port())
    health = f"{page}metrics"
    broker = [mosquitto, "-c", "broker/mosquitto.conf"]
    ours = [["live", "SITE.toml"], *(["edge", f"{name}.toml"] for name in SENSORS)]
    programs: list[subprocess.Popen[bytes]] = []
    with stopped_by_signals() as stop:
        try:
            for words in (broker, *([sys.executable, "-m", "gis_radar", *each] for each in ours)):
                errors = subprocess.DEVNULL if words is broker else None
                # in sessions of their own: Ctrl-C is for this program alone
                programs.append(
                    subprocess.Popen(words, cwd=folder, stderr=errors, start_new_session=True)
                )
            _say(f"page: {page}; for QGIS: {page}ogc, {folder / 'live' / 'now.gpkg'}; "
                 f"health: {health}")  # fmt: skip
            while all(each.poll() is None for each in programs) and not stop.wait(STATUS_S):
                _show(health)
            _say(
                "stopping; what came is being recorded" if stop.is_set() else "a program has ended"
            )
        finally:
            _end(programs)


def _say(text: str) -> None:
    """Print a line; a closed pipe does not end the system."""
    with suppress(BrokenPipeError):
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def _end(programs: Sequence[subprocess.Popen[bytes]]) -> None:
    """End the sensors first and the broker last; kill what stays, after a second Ctrl-C at once."""
    with suppress(KeyboardInterrupt):
        for each in reversed(programs):
            each.terminate()
            with suppress(subprocess.TimeoutExpired):
                each.wait(PATIENCE_S)
    for each in programs:  # they are in sessions of their own, which end with no terminal
        each.kill()
    for each in programs:
        each.wait()


def write_files(folder: Path, port: int, page: int) -> str:
    """Write tiles, files of site, sensors and broker; return the address of the page."""
    sample = gr.sample_folder().resolve()
    if not (folder / "tiles.gpkg").exists():
        roads = gr.read_map(sample / "junction.osm")
        gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
    texts = {"sample": sample, "port": port, "page": page}
    site = folder / "SITE.toml"
    site.write_text(SITE.format(password="", **texts), encoding="utf-8")
    write_broker_files(site, folder / "broker")
    known = 'password_file = "broker/password_of_fusion"'
    site.write_text(SITE.format(password=known, **texts), encoding="utf-8")
    for name in SENSORS:
        (folder / f"{name}.toml").write_text(EDGE.format(name=name, **texts), encoding="utf-8")
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # else it would become another user
        with (folder / "broker" / "mosquitto.conf").open("a", encoding="utf-8") as config:
            config.write("user root\n")
    return f"http://127.0.0.1:{page}/"


def _show(address: str) -> None:
    """Print the number of frames of each sensor, and alarms."""
    try:
        with urllib.request.urlopen(address, timeout=5.0) as answer:  # noqa: S310 - our own
            lines = answer.read().decode().splitlines()
    except (OSError, HTTPException):
        return
    frames = [line for line in lines if line.startswith("gis_radar_frames_total{")]
    alarms = [line for line in lines if line.startswith("gis_radar_alarm{") and line[-1] == "1"]
    _say("  ".join(frames + alarms).replace("gis_radar_", ""))


def _free_port() -> int:
    with socket.socket() as each:
        each.bind(("127.0.0.1", 0))
        return int(each.getsockname()[1])


if __name__ == "__main__":
    main(Path(sys.argv[1]))

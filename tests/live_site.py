"""A live site on this machine: a real broker, the sample junction's tiles, two sensors' files."""

import os
import random
import shutil
import signal
import socket
import subprocess
import threading
from contextlib import suppress

import pandas as pd
import pytest
from waiting import LONGEST_S, wait_for

import gis_radar as gr
from gis_radar.live import write_broker_files
from gis_radar.live.wire.broker_files import password_lines

SAMPLE = gr.sample_folder()
BRIEF_S = 30.0
OF_THE_SAMPLE = 'oldest = "36500d"\nkeep = "36500d"'  # it is of 2025
MOSQUITTO = shutil.which("mosquitto") or shutil.which("/usr/sbin/mosquitto")


def free_port():
    """Give a port that nobody has, none of those that clients get, so that it stays free."""
    while True:
        port = random.SystemRandom().randrange(12_000, 32_000)
        with socket.socket() as each, suppress(OSError):
            each.bind(("127.0.0.1", port))
            return port


class Broker:
    """Mosquitto with a configuration, to be killed and started again."""

    def __init__(self, config, port):
        self.config, self.port, self.process = config, port, None

    def start(self):
        self.log = self.config.with_suffix(".log").open("ab")
        self.process = subprocess.Popen(
            [MOSQUITTO, "-c", str(self.config)], stdout=self.log, stderr=self.log
        )
        wait_for(lambda: is_open(self.port) or self.process.poll() is not None)
        assert self.process.poll() is None, self.config.with_suffix(".log").read_text()

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.log.close()


def is_open(port):
    with socket.socket() as each:
        return each.connect_ex(("127.0.0.1", port)) == 0


class Background(threading.Thread):
    """Something that runs until it is stopped; what it raises is raised by `end`."""

    def __init__(self, work):
        super().__init__(daemon=True)
        self.stop, self._work, self.error = threading.Event(), work, None
        self.start()

    def run(self):
        try:
            self._work(self.stop)
        except Exception as error:  # noqa: BLE001 - raised in the test
            self.error = error

    def join(self, timeout=LONGEST_S):
        super().join(timeout)

    def end(self):
        self.stop.set()
        self.join()
        assert not self.is_alive()
        if self.error:
            raise self.error


def cut_recordings(folder):
    """Write the first half minute of the sample: what is lost or counted twice shows in it."""
    for name in ("R1", "R2"):
        table = pd.read_parquet(SAMPLE / f"{name}.parquet")
        brief = table[table["time"] < table["time"].iloc[0] + BRIEF_S]
        brief.to_parquet(folder / f"{name}.parquet", index=False)
    return folder


def make_tiles_file(folder):
    roads = gr.read_map(SAMPLE / "junction.osm")
    path = folder / "tiles.gpkg"
    gr.write_tiles(gr.make_tiles(roads), path, problems=roads.problems)
    return path


class LiveSite:
    """Files of a site and its sensors, and the broker that they name.

    The sample junction and half a minute of it, or what is given: its sensors, map, tiles, poses
    and recordings.
    """

    names = ("R1", "R2")
    map_file = SAMPLE / "junction.osm"
    scheme, host, authority = "mqtt", "127.0.0.1", ""
    vehicles = "false"  # else a process begins with each fusion
    of_site = ""  # more of SITE.toml, and of its table [live]
    of_live = OF_THE_SAMPLE

    def __init__(self, folder, once, **given):
        vars(self).update(given)
        self.folder, self.port = folder, free_port()
        self.tiles = given.get("tiles") or once("live_tiles", make_tiles_file)
        self.recordings = given.get("recordings") or once("live_recordings", cut_recordings)
        self.file = folder / "SITE.toml"
        self.file.write_text(self.site_text("broker/password_of_fusion"))
        write_broker_files(self.file, folder / "broker")
        config = folder / "broker" / "mosquitto.conf"
        if os.geteuid() == 0:  # it would take another user, who may not read here
            config.write_text(config.read_text() + "user root\n")
        self.broker = Broker(config, self.port)

    @property
    def address(self):
        return f"{self.scheme}://{self.host}:{self.port}"

    def password(self, user):
        return (self.folder / "broker" / f"password_of_{user}").read_text().strip()

    def let_in(self, user, *rules):
        """Give a further client a log-in of its own, with lines of the broker's access list."""
        folder = self.folder / "broker"
        (folder / f"password_of_{user}").write_text("secret\n")
        with (folder / "passwords").open("a") as file:
            file.write(password_lines({user: "secret"}))
        with (folder / "access").open("a") as file:
            file.write("\n".join(["", f"user {user}", *rules, ""]))
        if self.broker.process is not None:
            self.broker.process.send_signal(signal.SIGHUP)

    def site_text(self, password):
        secret = f', password_file = "{password}"' if password else ""
        secret += f', authority = "{self.authority}"' if self.authority else ""
        sensors = "".join(f'[[sensor]]\nname = "{name}"\n' for name in self.names)
        return f"""
title = "Sample junction"
[map]
file = "{self.map_file}"
{self.of_site}
[live]
site = "junction"
tiles = "{self.tiles}"
broker = {{ address = "{self.address}"{secret} }}
vehicles = {self.vehicles}
{self.of_live}
{sensors}
"""

    def edge(self, name, *, more="", source="speed = 0.0", port=None, **keys):
        """Write the file of a sensor and return it; a key that is None is left out."""
        path = self.folder / f"{keys.pop('file', name)}.toml"
        user = keys.pop("user", name)
        if "recording" not in source and "address" not in source:
            source = f'recording = "{self.recordings / name}.parquet"\n{source}'
        keys = {
            "pose": f'"{SAMPLE / name}.json"', "tiles": f'"{self.tiles}"', "follow": "false",
        } | keys  # fmt: skip
        keys = {key: value for key, value in keys.items() if value is not None}
        address = f"{self.scheme}://{self.host}:{port or self.port}"
        path.write_text(
            f"""
sensor = "{name}"
site = "junction"
{"".join(f"{key} = {value}" + chr(10) for key, value in keys.items())}
{more}
[source]
{source}
[broker]
address = "{address}"
password_file = "broker/password_of_{user}"
{f'authority = "{self.authority}"' if self.authority else ""}
[buffer]
file = "{path.stem}.buffer"
"""
        )
        return path


needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")

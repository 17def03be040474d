"""CPU of a fusion that begins anew where the spool holds minutes of frames of many sensors.

    python bench/live_restart.py [SENSORS 100] [SECONDS 300] [KEPT 8]

Its counts were kept so many seconds before it was killed. Frames are those of the sample, at 20 Hz.
"""

from __future__ import annotations

import struct
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np

import gis_radar as gr
from gis_radar.live import (
    DetectionSelector,
    Envelope,
    Fusion,
    PoseContent,
    RecentCounts,
    Spool,
    SpooledFrames,
    frames_of_recording,
    key_of_pose,
    pack_detections,
    pack_message,
    read_live_site,
)
from gis_radar.live.fusion import COUNTS_FILE, SPOOL
from gis_radar.live.wire.first_run import run_fusion_once
from gis_radar.live.wire.payload import varint
from gis_radar.scans import SightTiles

KEY, HZ, STEPS = b"1234", 20, 20
SITE = """
title = "Restart"
[map]
file = "{map}"
[live]
site = "restart"
tiles = "tiles.gpkg"
broker = {{ address = "mqtt://127.0.0.1:1" }}
vehicles = false
interval = "24h"
"""


def filled(folder: Path, names: list[str], seconds: int, end_s: int) -> Path:
    """Write site and spool; return the site's file."""
    sample = gr.sample_folder()
    roads = gr.read_map(sample / "junction.osm")
    gr.write_tiles(gr.make_tiles(roads), folder / "tiles.gpkg", problems=roads.problems)
    file = folder / "SITE.toml"
    text = SITE.format(map=sample / "junction.osm")
    file.write_text(text + "".join(f'[[sensor]]\nname = "{name}"\n' for name in names))
    road = SightTiles.of(gr.read_tiles(folder / "tiles.gpkg"))
    pose, selector = gr.read_pose(sample / "R1.json"), DetectionSelector(road)
    bodies = []
    for frame in islice(frames_of_recording(sample / "R1.parquet"), 50 * HZ):
        found = selector.find(frame, pose, road_m=np.nan)
        head = KEY + varint(1) + varint(found.time_us)
        bodies.append(pack_detections([found], pose=KEY)[len(head) :])
    messages = {}
    for name in names:
        record = pose.as_dict() | {"sensor": name}
        messages[name] = PoseContent(pose=record, fingerprint=road.fingerprint).pack()
    spool = Spool(read_live_site(file).folder / SPOOL)
    spool.rotate()
    for k in range(seconds * HZ):
        for number, (name, message) in enumerate(messages.items()):
            time_us = (end_s - seconds) * 1_000_000 + k * 50_000 + number
            body = bodies[(k + 37 * number) % len(bodies)]
            content = key_of_pose(message) + varint(1) + varint(time_us) + body
            envelope = Envelope(stream=struct.pack(">I", number), number=k + 1, first=k == 0)
            spool.add(SpooledFrames(name, message, pack_message(envelope, content)))
        if k % HZ == HZ - 1:
            spool.collect()
            spool.write()
    spool.close()
    return file


def keep(file: Path, end_s: int, kept_s: int, seconds: int) -> None:
    """Keep counts as an earlier fusion does."""
    road = SightTiles.of(gr.read_tiles(file.parent / "tiles.gpkg"))
    counts = RecentCounts(len(road.tile_id), interval=24 * 72_000)
    every = np.ones(len(road.tile_id), np.bool_)
    for step in range((end_s - seconds) * STEPS, (end_s - kept_s) * STEPS):
        counts.take(step, ~every, every)
    counts.keep(read_live_site(file).folder / COUNTS_FILE, road.fingerprint)


def main() -> None:
    """Fill a spool, begin anew, and print what it took."""
    given = [int(each) for each in sys.argv[1:]]
    sensors, seconds, kept_s = [*given, *(100, 300, 8)[len(given) :]]
    names, end_s = [f"S{k:03}" for k in range(sensors)], int(time.time())
    with tempfile.TemporaryDirectory() as place:
        file = filled(Path(place), names, seconds, end_s)
        keep(file, end_s, kept_s, seconds)
        run_fusion_once()
        begin = time.process_time()
        fusion = Fusion(read_live_site(file))
        spent_s = time.process_time() - begin
        counted = fusion.counts.last_minutes()[1].max() / STEPS
        fusion.close()
    print(f"{spent_s:.1f} CPU s for {sensors * seconds * HZ:,} messages; {counted:.0f} s counted")


if __name__ == "__main__":
    main()

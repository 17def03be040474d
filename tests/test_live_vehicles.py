"""Vehicles of the live system: those of the recordings, within bounds, once, whatever is killed."""

import os
import signal
import time
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from live_programs import stored, takes_long
from live_site import SAMPLE, Background, LiveSite, needs_mosquitto, wait_for
from live_vehicles import Sent, compare, frames_in, occupancy, states_of

import gis_radar as gr
from gis_radar.dataset.tables.tracks import EVERY
from gis_radar.live.edge import Edge
from gis_radar.live.fusion import Fusion
from gis_radar.live.settings import read_edge_file, read_live_site
from gis_radar.live.vehicles.counts import VehicleCounts
from gis_radar.live.vehicles.now import NowFilter
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.steps import STEPS_PER_SECOND

NAMES = ("R1", "R2")
MAP = SAMPLE / "junction.osm"
RECORDINGS = [SAMPLE / f"{name}.parquet" for name in NAMES]
HOUR = "2025-06-12T07Z"


@pytest.fixture(scope="session")
def batch(once):
    """Give the dataset that the batch makes of the sample's recordings."""

    def make(folder):
        tiles = gr.make_tiles(gr.read_map(MAP))
        poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in NAMES]
        gr.measure(RECORDINGS, poses, tiles, MAP, folder / "dataset")
        return folder / "dataset"

    return gr.open_dataset(once("live_vehicles_batch", make))


@pytest.fixture(scope="module")
def sent(tmp_path_factory):
    poses = [gr.read_pose(SAMPLE / f"{name}.json") for name in NAMES]
    return Sent(MAP, RECORDINGS, poses, tmp_path_factory.mktemp("sent"))


@pytest.fixture(scope="module")
def followed(sent):
    """Follow the sample; give the blocks, the folder of the hour, and vehicles of now by time."""
    follower = sent.follower()
    now = NowFilter(graph=sent.site.graph, tracker=follower.settings.tracker())
    told = []

    def look(detections):
        now.take(detections)
        now.go_on(float(detections.time[-1]) - 0.3)
        told.append(now.now())

    blocks = []
    for part in (sent.feed(follower, sent.messages, at_once=20, each=look), sent.end(follower)):
        for block in part:
            blocks.append(block)
            now.correct((block.last_step + 1) / STEPS_PER_SECOND, block.stood)
    return blocks, follower.write_hour(blocks[0].first_step // (3600 * STEPS_PER_SECOND)), told


def test_vehicles_are_those_of_the_recordings_within_bounds(sent, followed, batch):
    blocks, folder, _ = followed
    assert folder.name == HOUR
    assert len(blocks) >= 2
    found = compare(folder, batch, sent.tiles)
    assert found["recall"] > 0.85
    assert found["precision"] > 0.95
    assert found["rms_m"] < 0.5
    assert found["occupancy_error"] < 0.01
    assert found["occupancy"] == pytest.approx(found["occupancy_batch"], rel=0.05)
    assert found["passages"] == pytest.approx(found["passages_batch"], rel=0.05)
    assert found["passages_off"] < 0.1 * found["passages_batch"]


def test_counts_of_blocks_are_those_of_the_folder(sent, followed):
    blocks, folder, _ = followed
    counts = VehicleCounts(sent.tiles, interval=18_000)
    for block in [*blocks, blocks[0]]:  # told again: nothing counts twice
        counts.add(block)
    occupied, visible = (pd.read_parquet(folder / f"{k}.parquet") for k in ("occupied", "visible"))
    lately = counts.last_minutes()
    tile = np.searchsorted(sent.tiles["tile_id"], visible["tile_id"])
    steps = visible["last_step"] - visible["first_step"] + 1
    assert np.array_equal(lately.visible, np.bincount(tile, steps, len(sent.tiles)))
    share, known = occupancy(occupied, visible, sent.tiles), lately.visible > 0
    assert np.nanmean(np.abs(share - lately.share())[known]) < 0.01  # occupied, not visible too
    lanes = counts.lanes_lately()
    passages = len(pd.read_parquet(folder / "passages.parquet"))
    assert 0.5 * passages < lanes["passages"].sum() <= passages
    assert counts.intervals()["occupied_s"].sum() == pytest.approx(lanes["occupied_s"].sum())


def test_vehicles_of_now_are_where_the_batch_has_them(sent, followed, batch):
    """The filter alone, half a second late: most vehicles, within two metres."""
    _, _, told = followed
    table = states_of(batch)
    true = found = shown = 0
    for now in told[100::2]:
        step = round(now.time * STEPS_PER_SECOND)
        if step % EVERY:
            continue
        rows = table[(table["step"] == step) & table["seen"]]
        true, shown = true + len(rows), shown + len(now)
        assert len(set(now.vehicle.tolist())) == len(now)
        if len(rows) and len(now):
            apart = np.hypot(
                *np.moveaxis(rows[["easting", "northing"]].to_numpy()[:, None] - now.place, -1, 0)
            )
            found += int((apart.min(axis=1) < 4.0).sum())
    assert found > 0.8 * true
    assert shown < 1.4 * true


@takes_long
def test_a_follower_that_begins_anew_goes_on_as_if_it_had_not(sent, tmp_path):
    """Killed in the midst of a block: the same vehicles, occupancy and passages, each once."""
    begin = sent.messages[0][0]
    messages = [each for each in sent.messages if each[0] < begin + 66 and each[1] == "R1"]
    short = replace(DEFAULTS, steps=400, margin_steps=200)
    whole = sent.at(tmp_path / "whole")
    follower = whole.follower(short)
    blocks = [*whole.feed(follower, messages), *whole.end(follower)]
    hour = blocks[0].first_step // (3600 * STEPS_PER_SECOND)
    folders = [follower.write_hour(hour)]

    cut = sent.at(tmp_path / "cut")
    first = cut.follower(short)
    found = list(cut.feed(first, messages[:900]))
    assert len(found) == 1
    first.store.close()  # and not a word more
    second = cut.follower(short)
    again = list(second.again(0))
    assert [each.last_step for each in again] == [each.last_step for each in found]
    assert np.array_equal(again[0].occupied, found[0].occupied)
    second.resume()
    found += [*cut.feed(second, messages[880:]), *cut.end(second)]  # some come twice
    folders.append(second.write_hour(hour))
    assert [each.last_step for each in found] == [each.last_step for each in blocks]
    for name in ("tracks", "vehicles", "passages", "occupied", "visible", "frames"):
        one, other = (pd.read_parquet(each / f"{name}.parquet") for each in folders)
        pd.testing.assert_frame_equal(one, other)


@needs_mosquitto
@takes_long
def test_fusion_follows_vehicles_in_a_process_that_may_be_killed(tmp_path, once):
    site = LiveSite(tmp_path, once, vehicles="true")
    site.broker.start()
    fusion = Fusion(read_live_site(site.file))
    middle = Background(fusion.run)
    try:
        wait_for(lambda: fusion._link is not None and fusion._link.connected)
        work = [Background(Edge(read_edge_file(short(site, name))).run) for name in NAMES]
        process = fusion.vehicles._process
        for each in work:
            each.join()
            each.end()
        taken = sum(each.health.counts["detections"] for each in fusion.sensors.values())
        assert taken == sum(map(len, map(times, NAMES)))
        wait_for(lambda: fusion.vehicles._event_counts.get("frames", 0) == taken)
        time.sleep(1.5)  # on disk within a second
        os.kill(process.pid, signal.SIGKILL)
        wait_for(lambda: fusion.vehicles.restarts)
    finally:
        middle.end()
        site.broker.kill()
    hour = site.folder / "live" / "vehicles" / HOUR
    assert sorted(frames_in(hour)["sensor"].unique()) == [*NAMES]
    assert len(pd.read_parquet(hour / "vehicles.parquet")) > 10
    assert fusion.vehicles.counts.last_minutes().occupied.sum() > 1000
    now = gpd.read_file(site.folder / "live" / "now.gpkg", layer="now")
    assert now["occupancy"].max() > 0.1
    assert stored(site.folder).sensors == [*NAMES]


def times(name):
    """Return the times of the frames of the first 15 seconds of a recording."""
    found = np.unique(pd.read_parquet(SAMPLE / f"{name}.parquet", columns=["time"])["time"])
    return found[found < found[0] + 15.0]


def short(site, name):
    """Write the file of a sensor that replays 15 seconds, ten times as fast."""
    table = pd.read_parquet(SAMPLE / f"{name}.parquet")
    path = site.folder / f"{name}.parquet"
    table[table["time"] <= times(name)[-1]].to_parquet(path, index=False)
    several = {"detections": "true", "frames_a_message": "5"}
    file = site.edge(name, source="speed = 10.0", **several)
    file.write_text(file.read_text().replace(str(SAMPLE / f"{name}.parquet"), str(path)))
    return file

"""Measuring: hits against a plain loop, and the same bytes however recordings come."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from maps import Listener
from measured import EDGE_S, MAP, contents, cut, measured, sample_pose, tiles

import gis_radar as gr
from bench.tile_oracles import TileTree
from gis_radar.base import step_of
from gis_radar.hdmap import quads
from gis_radar.scans import SightTiles


def random_frames(rng, cycle_s, late_s, seconds=2.0):
    """Times and points of frames around an hour's edge, some of them lost and some empty."""
    found = []
    for at in np.arange(EDGE_S - seconds / 2 + late_s, EDGE_S + seconds / 2, cycle_s):
        if rng.random() < 0.2:
            continue
        count = int(rng.integers(0, 30))
        spread = np.column_stack(
            [rng.uniform(5, 90, count), rng.uniform(-40, 40, count), rng.uniform(-5, -3, count)]
        )
        spread = spread if count else np.full((1, 3), np.nan)
        found += [(at + rng.uniform(0, 0.01), *point) for point in spread.tolist()]
        found[-len(spread) :] = [(found[-1][0], *row[1:]) for row in found[-len(spread) :]]
    table = pd.DataFrame(found, columns=["time", "x", "y", "z"])
    points = table[["x", "y", "z"]].astype("float32")
    return table.assign(**points, range_rate=np.float32(0), rcs=np.float32(5))


def steps_at(times):
    """The steps that begin at some times."""
    return (times.astype("datetime64[us, UTC]").astype("int64") // 50_000).tolist()


def plainly(frames_of, validity_steps):
    """The pairs of tile and step, and the observed steps of each tile, sentence by sentence."""
    engine = TileTree(quads(tiles()))
    hits, observed = set(), {}
    for sensor, table in frames_of.items():
        pose = sample_pose(sensor)
        seen = gr.find_sight(pose, SightTiles.of(tiles())).seen.tolist()
        steps = sorted(set(step_of(table["time"].to_numpy()).tolist()))
        until = {
            step: min(step + validity_steps[sensor], after - 1)
            for step, after in zip(steps, [*steps[1:], 2**62], strict=True)
        }
        for time, rows in table.groupby("time"):
            step = int(step_of(np.array([time]))[0])
            valid = range(step, until[step] + 1)
            points = rows[["x", "y", "z"]].to_numpy(float)
            points = points[~np.isnan(points[:, 0])]
            points = points[(pose.view or gr.View()).sees(points)]
            place = pose.to_map(points)
            hit = set(engine.assign(place[:, 0], place[:, 1])[1].tolist())
            hits |= {(tile, each) for tile in hit for each in valid}
            for each in valid:
                observed.setdefault(each, set()).update(seen)
    return hits, observed


def test_hits_and_observed_steps_are_those_of_a_plain_loop(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("plain"), np.random.default_rng(1)
    frames = {"R1": random_frames(rng, 0.05, 0.0), "R2": random_frames(rng, 0.17, 0.3)}
    paths = []
    for sensor, table in frames.items():
        table.to_parquet(folder / f"{sensor}.parquet", index=False)
        paths.append((sensor, folder / f"{sensor}.parquet"))
    ds = measured(folder / "site", *paths, hits_only=True, cycles={"R2": 0.17})
    hits, observed = plainly(frames, {"R1": 2, "R2": 5})
    assert len(ds.hours()) == 2
    found = ds.hits()
    assert len(found) == len(hits)
    got = list(zip(found["tile_id"].tolist(), steps_at(found["time"]), strict=True))
    assert set(got) == hits
    runs = ds.observed()
    first, after = (steps_at(runs[name]) for name in ("begin", "end"))
    pairs = {
        (tile, step)
        for tile, low, high in zip(runs["tile_id"], first, after, strict=True)
        for step in range(low, high)
    }
    assert pairs == {(tile, step) for step, seen in observed.items() for tile in seen}
    counts = ds.tile_counts()
    assert counts["observed_steps"].sum() == len(pairs)
    assert counts["hit_steps"].sum() == len(pairs & hits)


@pytest.fixture(scope="module")
def halves(once):
    """Two recordings over an hour's edge: a second before it and one after it."""

    def both_cut(folder):
        return {
            sensor: cut(folder / f"{sensor}.parquet", sensor, 19.0, 21.0, edge_s=20.0)
            for sensor in ("R1", "R2")
        }

    return once("halves", both_cut)


@pytest.fixture(scope="module")
def whole(halves, once):
    """Measured at once, which is only to be looked at or copied."""

    def measure(folder):
        measured(folder / "site", *halves.items())
        return folder / "site"

    return once("halves measured", measure)


@pytest.fixture(scope="module")
def both(whole):
    return contents(whole)


def test_the_order_in_which_recordings_come_changes_no_byte(halves, both, tmp_path):
    for sensor in ("R2", "R1"):
        measured(tmp_path / "site", (sensor, halves[sensor]))
    assert contents(tmp_path / "site") == both


def test_blocks_of_an_hour_side_by_side_write_the_same_bytes(tmp_path):
    # a block ends at 300 s of the hour, amid it
    recording = cut(tmp_path / "R2.parquet", "R2", 17.0, 23.0, edge_s=-280.0)
    for processes in (1, 3):
        measured(tmp_path / str(processes), ("R2", recording), processes=processes)
    assert len(gr.open_dataset(tmp_path / "1").tracks()) > 50
    assert contents(tmp_path / "3") == contents(tmp_path / "1")


def of_hours(found):
    """What does not tell which files it was measured from: the check of poses judges each file."""
    manifest = json.loads(found["dataset.json"])
    for name in ("checks", "texts"):
        manifest.pop(name, None)
    kept = {name: each for name, each in found.items() if name != "recordings.parquet"}
    return kept | {"dataset.json": manifest}


def test_recordings_that_overlap_or_follow_each_other_give_the_same_hours(halves, both, tmp_path):
    pieces = {"R1": ((19.0, 19.7), (19.2, 20.5), (19.3, 21.0)), "R2": ((19.0, 19.3), (19.3, 21.0))}
    files = [
        (sensor, cut(tmp_path / f"{sensor}_{span[0]}.parquet", sensor, *span, edge_s=20.0))
        for sensor, spans in pieces.items()
        for span in spans
    ]
    measured(tmp_path / "site", *files)
    assert of_hours(contents(tmp_path / "site")) == of_hours(both)


def test_measuring_again_changes_nothing(halves, whole, both, tmp_path):
    site = shutil.copytree(whole, tmp_path / "site")
    when = {p: p.stat().st_mtime_ns for p in (site / "hits").rglob("*.parquet")}
    notes = Listener()
    measured(site, *halves.items(), reporter=notes)
    assert contents(site) == both
    assert when == {p: p.stat().st_mtime_ns for p in when}
    warned = [line for level, line in notes.messages if level == "warning"]
    assert not [line for line in warned if "too little traffic to tell" not in line]


def test_the_same_recording_twice_counts_once(halves, tmp_path):
    notes = Listener()
    once, twice = tmp_path / "once", tmp_path / "twice"
    measured(once, *halves.items(), hits_only=True)
    measured(twice, ("R1", halves["R1"]), *halves.items(), hits_only=True, reporter=notes)
    assert contents(twice) == contents(once)
    assert len([line for _, line in notes.messages if "counts once" in line]) == 1


def test_an_hour_without_frames_has_all_its_parts(tmp_path):
    path = cut(
        tmp_path / "R1.parquet", "R1", 15.5, 18.5, edge_s=17.0,
        change=lambda t: t.assign(time=t["time"] + 7200.0 * (t["time"] >= EDGE_S)),
    )  # fmt: skip
    ds = measured(tmp_path / "site", ("R1", path))
    hours = ds.hours()
    assert len(hours) == 4
    assert hours["frames"].tolist()[1:3] == [0, 0]  # the last frame before is valid for a moment
    assert hours.iloc[2].drop(["begin", "method"]).sum() == 0
    assert ds.tile_counts()["observed_steps"].sum() > 0


def test_a_recording_without_range_rates_gives_hits_only(tmp_path):
    path = cut(
        tmp_path / "R1.parquet", "R1", 14.0, 16.0, edge_s=0.0,
        change=lambda t: t.assign(range_rate=np.float32("nan")),
    )  # fmt: skip
    notes = Listener()
    ds = measured(tmp_path / "site", ("R1", path), reporter=notes)
    assert ds.manifest.settings["vehicles"] is False
    assert any("has no range rates" in line for _, line in notes.messages)
    second = cut(tmp_path / "R2.parquet", "R2", 14.0, 16.0, edge_s=0.0)
    assert measured(tmp_path / "site", ("R2", second)).sensors == ["R1", "R2"]


def test_the_map_stays_with_the_dataset(halves, tmp_path):
    measured(tmp_path / "site", ("R1", halves["R1"]), hits_only=True)
    assert (tmp_path / "site" / "map.osm").read_bytes() == MAP.read_bytes()


@pytest.mark.parametrize("of_live", [False, True])
def test_detections_that_end_before_the_view_are_named_unless_the_sensor_chose(tmp_path, of_live):
    """A sensor of the live system sends those near the road only: they say nothing of its range."""

    def near(table):
        table = table[np.hypot(table["x"], table["y"]) < 100.0]
        return table.assign(pose="0123") if of_live else table

    path = cut(tmp_path / "R1.parquet", "R1", 0.0, 10.0, edge_s=20.0, change=near)
    notes = Listener()
    measured(tmp_path / "site", ("R1", path), reporter=notes, hits_only=True)
    named = [line for _, line in notes.messages if "of the detections lie within" in line]
    assert bool(named) != of_live

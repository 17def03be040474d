"""Folders of vehicles merge over time: sums stay exact, cut vehicles become one."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from test_vehicles_folder import FIRST, drive, frames_of_span, rows_of, straight_tiles, write

import gis_radar as gr
from gis_radar.errors import InputError
from gis_radar.vehicles.folder import VehiclePiece, joined_rows
from gis_radar.vehicles.hours import join_hours, write_driven

CUT = FIRST + 300


def traffic():
    """Three vehicles: one before the cut, one over it, one that stands over it beside the first."""
    return pd.concat(
        [
            drive(1, FIRST + 10, np.arange(0.0, 15.0, 0.25)),
            drive(5, CUT - 40, np.arange(0.0, 20.0, 0.25), speed=5.0),
            drive(6, FIRST, np.full(600, 29.0), speed=0.0),
        ],
        ignore_index=True,
    )


def two_parts(folder, tiles):
    tracks = traffic()
    cut = {}
    for name, part in (("a", tracks["step"] < CUT), ("b", tracks["step"] >= CUT)):
        rows = tracks[part].assign(vehicle=tracks["vehicle"] + (100 if name == "b" else 0))
        last = CUT - 1 if name == "a" else FIRST + 599
        cut[name] = write(folder / name, tiles, rows, last=last, continues=True)
    return cut["a"], cut["b"]


@pytest.fixture
def merged(tmp_path):
    tiles = straight_tiles(60)
    one, other = two_parts(tmp_path, tiles)
    whole = write(tmp_path / "whole", tiles, traffic())
    return whole, gr.merge_vehicles([other, one])


def steps_by_tile(vehicles, name):
    found = {}
    for block in vehicles.blocks():
        runs = getattr(block, name)
        steps = runs["last_step"] - runs["first_step"] + 1
        for tile, count in steps.groupby(runs["tile_id"]).sum().items():
            found[tile] = found.get(tile, 0) + count
    return found


def test_sums_are_those_of_the_whole_and_cut_vehicles_are_joined(merged, tmp_path):
    whole, parts = merged
    assert steps_by_tile(parts, "covered") == steps_by_tile(whole, "covered")
    seen = [steps_by_tile(gr.read_vehicles(tmp_path / name), "visible") for name in "ab"]
    sums = {tile: seen[0].get(tile, 0) + seen[1].get(tile, 0) for tile in range(60)}
    assert steps_by_tile(parts, "visible") == sums
    assert parts.vehicles["vehicle"].tolist() == [0, 1, 2]
    names = ["first_step", "last_step", "length_m"]
    pd.testing.assert_frame_equal(parts.vehicles[names], whole.vehicles[names])
    read, expected = pd.concat(parts.tracks()), pd.concat(whole.tracks())
    renamed = expected.assign(vehicle=expected["vehicle"].map({1: 0, 5: 1, 6: 2}))
    pd.testing.assert_frame_equal(read.reset_index(drop=True), renamed.reset_index(drop=True))
    assert parts.frames[["first_step", "last_step"]].to_numpy().tolist() == [[FIRST, FIRST + 599]]
    assert len(parts.provenance.sources) == 2


def test_passages_of_a_joined_vehicle_count_once(merged):
    whole, parts = merged
    renamed = whole.passages.assign(vehicle=whole.passages["vehicle"].map({1: 0, 5: 1, 6: 2}))
    pd.testing.assert_frame_equal(parts.passages, renamed)


def test_an_hour_that_knows_what_was_before_it_adds_up_to_the_whole(merged, tmp_path):
    """What an earlier vehicle hides and passes at the edge is known from the margin before."""
    whole, _ = merged
    tiles, tracks = straight_tiles(60), traffic()
    after = tracks[tracks["step"] >= CUT]
    margin = tracks[tracks["step"].between(CUT - 250, CUT - 1)]
    frames = frames_of_span(CUT - 250, CUT - 1)
    before = VehiclePiece(
        first_step=CUT - 250, last_step=CUT - 1, tracks=margin.sort_values(["step", "vehicle"]),
        vehicles=rows_of(margin), frames=frames,
    )  # fmt: skip
    write(tmp_path / "c", tiles, after, last=FIRST + 599, warm_up=before, continues=True)
    for name in "ac":
        write_driven(tmp_path / name, [])
    joined = join_hours([tmp_path / "a", tmp_path / "c"], tmp_path / "joined", tiles=tiles)
    for name in ("covered", "visible"):
        assert steps_by_tile(joined, name) == steps_by_tile(whole, name)
    assert joined.passages["step"].tolist() == whole.passages["step"].tolist()
    assert joined.vehicles["first_step"].tolist() == whole.vehicles["first_step"].tolist()
    (source,) = joined.provenance.sources
    assert source["rows"] == 20


@pytest.mark.parametrize("apart_m", [-0.2, 0.2])
def test_a_middle_between_hours_is_passed_once(tmp_path, apart_m):
    """Each hour fits a vehicle by itself: past the middle by one, not yet by the other."""
    tiles = straight_tiles(60)  # their middle is at 15 m
    fronts = np.arange(0.0, 20.0, 0.25) + 4.9  # at 14.9 m in the last step before the cut
    both = [drive(5, CUT - 41, fronts + more, speed=5.0) for more in (0.0, 0.1 + apart_m)]
    ends = [rows[rows["step"] < CUT] for rows in both]
    after = both[1][both[1]["step"] >= CUT]
    write(tmp_path / "a", tiles, ends[0], last=CUT - 1, continues=True)
    before = VehiclePiece(
        first_step=CUT - 41, last_step=CUT - 1, tracks=ends[1], vehicles=rows_of(ends[1]),
        frames=frames_of_span(CUT - 41, CUT - 1),
    )  # fmt: skip
    write(tmp_path / "b", tiles, after, last=CUT + 100, warm_up=before, continues=True)
    for name in "ab":
        write_driven(tmp_path / name, [])
    joined = join_hours([tmp_path / "a", tmp_path / "b"], tmp_path / "joined", tiles=tiles)
    assert len(joined.vehicles) == 1
    assert len(joined.passages) == 1
    assert abs(joined.passages["step"].iloc[0] - CUT) < 2


def test_only_outer_ends_stay_cut(merged):
    _, parts = merged
    assert parts.vehicles.set_index("vehicle")["continues"].tolist() == [True, False, True]


def test_a_vehicle_elsewhere_is_another_one(tmp_path):
    tiles = straight_tiles(60)
    one = write(tmp_path / "a", tiles, drive(1, FIRST, np.full(20, 8.0)), continues=True)
    other = write(tmp_path / "b", tiles, drive(1, FIRST + 20, np.full(20, 13.0)), continues=True)
    assert len(gr.merge_vehicles([one, other]).vehicles) == 2


def changed(vehicles, **provenance):
    return replace(vehicles, provenance=replace(vehicles.provenance, **provenance), place="other")


@pytest.mark.parametrize(
    ("provenance", "what"),
    [
        ({"fingerprint": "x"}, "tiles"),
        ({"map": {"digest": "x"}}, "map"),
        ({"sight": {"scan": "x"}}, "sight"),
        ({"settings": {"coverage": {}}}, "settings"),
        ({"hold_s": {"R1": 0.2}}, "frame hold"),
        ({"sources": [{"sensor": "R1", "poses": [{"easting": 3.0}]}]}, "poses"),
    ],
)
def test_folders_of_another_origin_are_refused(tmp_path, provenance, what):
    one, other = two_parts(tmp_path, straight_tiles(60))
    with pytest.raises(InputError, match=f"a and other have different {what}: they do not merge"):
        gr.merge_vehicles([one, changed(other, **provenance)])


def test_folders_with_a_common_step_are_refused(tmp_path):
    one, _ = two_parts(tmp_path, straight_tiles(60))
    with pytest.raises(InputError, match=r"have steps in common, from .*Z: they do not merge"):
        gr.merge_vehicles([one, one])


def test_older_rules_and_damage_are_told(tmp_path):
    one, _ = two_parts(tmp_path, straight_tiles(60))
    manifest = tmp_path / "a" / "manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace('"rules": 2', '"rules": 1'))
    with pytest.raises(InputError, match="follows rules 1, expected 2"):
        gr.read_vehicles(tmp_path / "a")
    manifest.write_text("{")
    with pytest.raises(InputError, match=r"manifest\.json: not a manifest of vehicles: not JSON"):
        gr.read_vehicles(tmp_path / "a")
    manifest.write_text(text.replace(one.provenance.fingerprint, "x"))
    with pytest.raises(InputError, match=r"tracks\.parquet: was made from tiles .*, its folder"):
        gr.read_vehicles(tmp_path / "a")
    (tmp_path / "b" / "covered.parquet").unlink()
    with pytest.raises(InputError, match="not a folder of vehicles: lacks covered"):
        gr.read_vehicles(tmp_path / "b")


def test_lanelets_of_both_parts_follow_each_other():
    row = {"length_sigma_m": 0.3, "first_step": 1, "last_step": 2, "continues": False}
    one = row | {"lanelets": np.array([4, 7, 8]), "length_m": 4.0}
    other = row | {"lanelets": np.array([7, 8, 9]), "length_m": 5.0, "length_sigma_m": 0.1}
    found = joined_rows(one, other)
    assert found["lanelets"].tolist() == [4, 7, 8, 9]
    assert found["length_m"] == 5.0

"""Lanes of an old map and of a new one: what is the same, what was split, merged, turned, gone."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from maps import SHARED_MAPS, map_name
from shapely import LineString, reverse
from shapely.affinity import rotate, translate

import gis_radar as gr
from gis_radar.hdmap import write_tiles

SAMPLE = gr.sample_folder() / "junction.osm"


def lanes(**lines):
    """Lanes by number: `a7=[...]` is lane 7."""
    numbers = [int(name[1:]) for name in lines]
    shapes = [LineString(line) for line in lines.values()]
    return gpd.GeoDataFrame({"lane": numbers}, geometry=shapes, crs="EPSG:25832")


OLD = lanes(a1=[(0, 0), (100, 0)], a2=[(0, 3.2), (100, 3.2)])


def rows(old, new):
    found = gr.match_lanes(old, new)
    whole = found.astype(object).where(found.notna(), None)
    return [
        (row.old_lane, row.new_lane, round(row.share_of_old, 1), round(row.share_of_new, 1),
         bool(row.same))
        for row in whole.itertuples()
    ]  # fmt: skip


@pytest.mark.parametrize(("east", "north", "turn"), [(0, 0, 0), (0.4, 0.9, 0), (-1.5, -0.5, 0.3)])
def test_lanes_that_were_drawn_anew_are_the_same(east, north, turn):
    new = OLD.assign(lane=[11, 12], geometry=[
        rotate(translate(line, east, north), turn, origin=(50, 0)) for line in OLD.geometry
    ])  # fmt: skip
    found = gr.match_lanes(OLD, new)
    assert found[["old_lane", "new_lane"]].to_numpy().tolist() == [[1, 11], [2, 12]]
    assert found["same"].all()
    assert found["offset_m"].iloc[0] == pytest.approx(abs(north), abs=0.15)


def test_a_split_lane_has_two_parts():
    new = lanes(a1=[(0, 0), (30, 0)], a5=[(30, 0), (100, 0)], a2=[(0, 3.2), (100, 3.2)])
    assert rows(OLD, new) == [
        (1, 1, 0.3, 1.0, False), (1, 5, 0.7, 1.0, False), (2, 2, 1.0, 1.0, True)
    ]  # fmt: skip


def test_merged_lanes_have_one_whole():
    old = lanes(a1=[(0, 0), (40, 0)], a2=[(40, 0), (100, 0)])
    assert rows(old, lanes(a9=[(0, 0), (100, 0)])) == [
        (1, 9, 1.0, 0.4, False), (2, 9, 1.0, 0.6, False)
    ]  # fmt: skip


def test_a_lane_that_leads_back_is_another():
    new = OLD.assign(geometry=reverse(OLD.geometry.array))
    assert [row[:2] for row in rows(OLD, new)] == [(1, None), (2, None), (None, 1), (None, 2)]


def test_what_is_gone_and_what_is_new_is_said():
    new = lanes(a2=[(0, 3.2), (100, 3.2)], a3=[(0, 40), (50, 90)])
    assert rows(OLD, new) == [
        (1, None, 0.0, 0.0, False), (2, 2, 1.0, 1.0, True), (None, 3, 0.0, 0.0, False)
    ]  # fmt: skip


def test_lanes_in_another_coordinate_system_are_met():
    assert gr.match_lanes(OLD, OLD.to_crs("EPSG:32633"))["same"].all()


@pytest.mark.parametrize("path", [SAMPLE, *SHARED_MAPS], ids=map_name)
def test_a_map_drawn_anew_with_other_numbers_has_the_same_lanes(path):
    roads = gr.read_map(path)
    old = roads.lanes()
    rng = np.random.default_rng(5)
    numbers = rng.permutation(len(old)) + 10_000
    shaken = [translate(line, *rng.normal(0.0, 0.2, 2)).simplify(0.05) for line in old.geometry]
    new = old.assign(lane=numbers, geometry=shaken).sample(frac=1.0, random_state=1)
    found = gr.match_lanes(old, new)
    right = dict(zip(old["lane"], numbers, strict=True))
    same = found[found["same"]]
    wrong = same[same["new_lane"] != same["old_lane"].map(right)]
    assert len(same) >= 0.97 * len(old)
    assert len(wrong) <= 0.01 * len(old)


def test_files_of_tiles_and_datasets_are_read(tmp_path, run, first_seconds):
    roads = gr.read_map(SAMPLE)
    write_tiles(gr.make_tiles(roads), tmp_path / "new.gpkg", lanes=roads.lanes())
    sample = gr.sample_folder()
    brief = first_seconds(sample / "R1.parquet", 10)
    gr.measure([brief], [sample / "R1.json"], gr.make_tiles(roads), SAMPLE,
               tmp_path / "site", hits_only=True, check=False)  # fmt: skip
    out = tmp_path / "lanes.csv"
    code, said, _ = run(
        "dataset", tmp_path / "site", "--match-lanes", tmp_path / "new.gpkg", "-o", out
    )
    assert code == 0, said
    assert "lanes the same" in said
    table = pd.read_csv(out)
    assert table["same"].all()
    assert len(table) == len(roads.lanes())
    assert run("dataset", tmp_path / "site", "-o", out)[0] == 2
    assert run("dataset", tmp_path / "site", "--match-lanes", tmp_path / "new.gpkg")[0] == 2


def test_what_has_no_lanes_is_said(tmp_path, run):
    write_tiles(gr.make_tiles(gr.read_map(SAMPLE)), tmp_path / "bare.gpkg")
    with pytest.raises(gr.InputError, match=r"bare\.gpkg: holds no lanes"):
        gr.match_lanes(OLD, tmp_path / "bare.gpkg")
    with pytest.raises(gr.InputError, match=r"none\.gpkg"):
        gr.match_lanes(OLD, tmp_path / "none.gpkg")

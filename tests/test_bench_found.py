"""The bench of vehicles: what was found, tables, and the pages that get them."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from datasets import BEGIN, HOUR, write_dataset
from maps import EAST, NORTH
from shapely import Polygon

sys.path.append(str(Path(__file__).parents[1] / "bench" / "vehicles"))

import command
import figures
import pages
import tables
from found import found_by_peer, found_in
from passages import joined
from true_occupancy import TrueOccupancy

import gis_radar as gr
from gis_radar.dataset import STEPS_PER_HOUR

COUNT, FIRST = 100, 34_000_000_000  # steps
CORNERS = ((0.0, -1.5), (0.5, -1.5), (0.5, 1.5), (0.0, 1.5))
FRAME_COUNTS = (
    "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum", "shift_us",
)  # fmt: skip


def straight_tiles(count=40, lanelet_id=7):
    """Tiles of a lanelet to the east from 0, 0."""
    east = np.arange(count) / 2.0
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(count), "lanelet_id": lanelet_id, "index": np.arange(count),
            "s_m": east, "length_m": 0.5, "width_m": 3.0, "height_m": np.nan,
            "geometry": [Polygon([(x + a, b) for a, b in CORNERS]) for x in east],
        },
        crs="EPSG:25832",
    )  # fmt: skip


def eastward(steps, *, vehicle=3, speed=4.0, length=4.0):
    """States of a vehicle whose front is at 0 in the first step."""
    steps = np.asarray(steps)
    front = speed * 0.05 * steps
    return pd.DataFrame(
        {
            "vehicle": vehicle, "step": FIRST + steps, "easting": front - length / 2,
            "northing": 0.2, "heading": 0.0, "speed": speed, "length": length, "width": 1.8,
        }
    )  # fmt: skip


def true_of(states):
    """The occupancy of vehicles of 4 m by hand: tiles whose middles lie under them."""
    occupied = np.zeros((40, COUNT), bool)
    middle = np.arange(40) / 2.0 + 0.25
    for step, east in zip(states["step"] - FIRST, states["easting"], strict=True):
        occupied[np.abs(middle - east) <= 2.0, step] = True
    return TrueOccupancy(
        tile_id=np.arange(40), first_step=FIRST, occupied=occupied,
        visible=np.ones_like(occupied), blocked=np.zeros_like(occupied),
    )  # fmt: skip


def test_what_a_peer_found_is_counted_as_the_truth_is(monkeypatch, tmp_path):
    states = eastward(np.arange(COUNT))
    truth = true_of(states)
    site = SimpleNamespace(tiles=straight_tiles, truth=lambda: truth, map=tmp_path)
    roads = gpd.GeoDataFrame({"lanelet_id": [7], "successors": [()]})
    monkeypatch.setattr(gr, "read_map", lambda _: SimpleNamespace(lanelets=roads))
    found = found_by_peer(site, states)
    # the middle at 10 m after 2.5 s
    assert found.passages["lanelet_id"].tolist() == [7]
    assert found.passages["step"].to_numpy() - FIRST == pytest.approx([50], abs=1)
    true = truth.table()["occupancy"].to_numpy()
    assert found.occupancy["occupancy"].to_numpy() == pytest.approx(true, abs=0.011)


def test_a_dataset_is_read_over_the_edge_of_an_hour(tmp_path):
    edge = BEGIN + STEPS_PER_HOUR
    steps = edge + np.array([-8, -4, -1, 0, 4])
    one, other = np.array([HOUR, HOUR + 1]) * 1_000_000 + 5
    numbers = np.array([one, one, one, other, other])
    along = 10 * (steps - edge)  # cm: 2 m/s
    runs = {"tile_id": [3, 3], "first_step": [edge - 8, edge], "last_step": [edge - 1, edge + 4]}
    ends = runs | {"vehicle": [one, other]}
    del ends["tile_id"]
    none, lanelets = np.ma.masked_all(5, np.int64), np.empty(2, object)
    lanelets[:] = [[7], [7]]
    dataset = write_dataset(
        tmp_path / "site",
        {
            "frames": {
                "sensor": ["R1", "R1"], "time_us": np.array([edge - 8, edge]) * 50_000,
                "first_step": [edge - 8, edge], "last_step": [edge - 1, edge + 4],
                "pose": ["a", "a"],
                **dict.fromkeys(FRAME_COUNTS, np.zeros(2, np.int64)),
            },
            "observed": runs, "visible": runs | {"seen": [True] * 2},
            "occupied": runs | {"seen": [True] * 2},
            "tracks": {
                "vehicle": numbers, "step": steps, "x_cm": along, "y_cm": 0 * along,
                "heading_cdeg": 0 * along, "speed_cms": 0 * along + 200, "lanelet_id": none,
                "s_cm": none, "d_cm": none, "seen": np.ones(5, np.bool_),
            },
            "vehicles": ends | {
                "length_m": [4.0, 4.0], "width_m": [1.8, 1.8], "length_sigma_m": [0.5, 0.5],
                "p_exists": [1.0, 1.0], "p_heavy": [0.0, 0.0], "lanelets": lanelets,
            },
            "continued": {"vehicle": [one], "next": [other]},
            "passages": {
                "vehicle": [other], "lanelet_id": [7], "step": [edge + 1], "speed_cms": [200],
                "p_heavy": [0.0],
            },
        },
        sights={"pose": ["a"], "tile_id": [3]},
    )  # fmt: skip
    found = found_in(dataset)
    assert found.states["vehicle"].unique().tolist() == [one]
    assert (found.states["step"] - edge).tolist() == list(range(-8, 5))
    assert found.states["easting"].to_numpy() - EAST == pytest.approx(0.1 * np.arange(-8, 5))
    assert found.states["northing"].to_numpy() == pytest.approx(NORTH)
    assert found.passages.to_numpy().tolist() == [[7, edge + 1]]
    assert found.occupancy[["tile_id", "occupancy"]].to_numpy().tolist() == [[3, 1.0]]


def test_texts_go_between_the_marks_of_a_page(tmp_path):
    page = tmp_path / "x.md"
    quoted = '- after "<!-- b -->"\n'  # a directive that names a mark is none
    page.write_text(
        f"{quoted}<!-- b -->\nold\nlines\n<!-- end of b -->\n<!-- a -->\n<!-- end of a -->"
    )
    pages.put(page, {"a": "A", "b": "B\nB"})
    assert page.read_text() == (
        f"{quoted}<!-- b -->\nB\nB\n<!-- end of b -->\n<!-- a -->\nA\n<!-- end of a -->"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a\n<!-- end of b -->\nc\n", "x.md: has the line <!-- b --> 0 times, not once"),
        ("a\n<!-- b -->\nc\n", "<!-- end of b --> 0 times"),
        ("<!-- b -->\n<!-- b -->\n<!-- end of b -->\n", "<!-- b --> 2 times"),
        ("<!-- end of b -->\n<!-- b -->\n", "has <!-- end of b --> before <!-- b -->"),
    ],
)
def test_a_page_whose_marks_are_not_in_order_is_left_as_it_is(tmp_path, text, words):
    page = tmp_path / "x.md"
    whole = f"<!-- a -->\n<!-- end of a -->\n{text}"
    page.write_text(whole)
    with pytest.raises(SystemExit, match=words):
        pages.put(page, {"a": "A", "b": "B"})
    assert page.read_text() == whole


def test_figures_are_collected_and_become_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "KEPT", tmp_path / "bench.json")
    monkeypatch.setattr(figures, "OUT", tmp_path)
    score = {"true_mean": 0.053, "rank": 0.9512, "scale": math.inf, "mae_percent": math.nan}
    command.keep("town", "hits", {"occupancy": score})
    command.keep("town", "oracle", {"occupancy": score | {"scale": 0.98}})
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert kept["town"]["hits"]["occupancy"]["scale"] is None
    lines = tables.readme(kept).splitlines()
    assert lines[0].split(" | ")[2:4] == ["hits", "Stone Soup"]
    assert lines[2].startswith("| town | 5.3% | 0.95 / - / - | - / - / - |")
    assert lines[2].endswith("| 0.95 / 0.98 / - | >= .95 / .95-1.05 / <= 2 % |")
    assert figures.read(tmp_path / "vehicles.json") == []
    command.keep("town", "found", {"occupancy": score | {"mae_percent": 1.5}})
    rank, error = figures.read(tmp_path / "vehicles.json")
    assert (rank.what, rank.ours) == ("occupancy, town: rank", 0.9512)
    assert (error.what, error.ours) == ("occupancy, town: mean error", 1.5)


def test_lanelets_without_shared_nodes_follow_each_other():
    first = straight_tiles(20)
    beyond = straight_tiles(20, lanelet_id=8)
    beyond.geometry = beyond.geometry.translate(10.2, 0.1)
    beside = straight_tiles(20, lanelet_id=9)
    beside.geometry = beside.geometry.translate(10.0, 3.0)
    assert joined(pd.concat([first, beyond, beside], ignore_index=True)) == {(7, 8)}

"""The bench of vehicles: what was found, where an occupancy is wrong, tables, bad input."""

import json
import math
import sys
from importlib import import_module
from pathlib import Path
from types import CodeType, SimpleNamespace

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from datasets import BEGIN, HOUR, write_dataset
from maps import EAST, NORTH
from shapely import Polygon

sys.path.append(str(Path(__file__).parents[1] / "bench" / "vehicles"))

import causes
import command
import components
import pages
import tables
from bad_input import _lasting, _whole
from breakdown import by_group, step_errors
from components import COMPONENTS, ROOM, Off, changed, replaced
from found import found_by_peer, found_in
from passages import joined
from tracks import Scored
from true_occupancy import TrueOccupancy

import gis_radar as gr
from gis_radar.dataset import STEPS_PER_HOUR
from gis_radar.tracking import forward, motion
from gis_radar.tracking.settings import VehicleSettings

COUNT, FIRST = 100, 34_000_000_000  # steps
CORNERS = ((0.0, -1.5), (0.5, -1.5), (0.5, 1.5), (0.0, 1.5))
FRAME_COUNTS = (
    "detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum", "shift_us",
)  # fmt: skip
ROOM_MODULES = [path.stem for path in Path(motion.__file__).parent.glob("*.py")]


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
    assert (found.occupied != truth.occupied).mean() < 0.01


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
    none_true = np.zeros((20, COUNT), bool)
    truth = TrueOccupancy(
        tile_id=np.arange(20), first_step=edge - 20, occupied=none_true, visible=~none_true,
        blocked=none_true,
    )  # fmt: skip
    found = found_in(dataset, truth)
    assert found.states["vehicle"].unique().tolist() == [one]
    assert (found.states["step"] - edge).tolist() == list(range(-8, 5))
    assert found.states["easting"].to_numpy() - EAST == pytest.approx(0.1 * np.arange(-8, 5))
    assert found.states["northing"].to_numpy() == pytest.approx(NORTH)
    assert found.passages.to_numpy().tolist() == [[7, edge + 1]]
    assert found.occupied.sum() == found.occupied[3, 12:25].sum() == 13
    assert found.occupancy[["tile_id", "occupancy"]].to_numpy().tolist() == [[3, 1.0]]


def test_steps_are_missed_misplaced_or_false():
    true = true_of(eastward(np.arange(COUNT)))
    given = np.zeros_like(true.occupied)
    given[[1, 38], :10] = True  # a metre behind the true vehicle, and where nothing was
    hidden = true.blocked.copy()
    hidden[:, 50:] = True
    truth = TrueOccupancy(
        tile_id=true.tile_id, first_step=FIRST, occupied=true.occupied, visible=true.visible,
        blocked=hidden,
    )  # fmt: skip
    errors = step_errors(given, straight_tiles(), truth)
    total = true.occupied.sum()
    right = true.occupied[1, :10].sum()
    near = true.occupied[:10, :10].any(axis=0).sum()
    assert errors["missed_in_view"] == pytest.approx((true.occupied[:, :50].sum() - right) / total)
    assert errors["missed_hidden"] == pytest.approx(true.occupied[:, 50:].sum() / total)
    assert errors["misplaced"] == pytest.approx((near - right) / total)
    assert errors["false_in_view"] == pytest.approx((20 - near) / total)
    assert errors["false_hidden"] == 0.0


def test_groups_have_figures_of_their_own():
    truth = true_of(eastward(np.arange(COUNT)))
    table = truth.table().assign(occupancy_se=0.01)
    table.loc[:9, "occupancy"] += 0.1
    first = np.arange(40) < 10
    figures = by_group(truth, table, {"first": first, "rest": ~first})
    assert figures["first"]["mae_percent"] == pytest.approx(10.0)
    assert (figures["rest"]["mae_percent"], figures["rest"]["within_2_se"]) == (0.0, 1.0)
    assert figures["first"]["within_2_se"] == 0.0


def test_false_vehicles_count_where_they_last():
    steps = np.arange(0, 400, 10)
    rows = pd.concat(
        pd.DataFrame({"vehicle": v, "step": s})
        for v, s in ((1, steps[:20]), (2, steps[:19]), (3, np.append(steps[:15], steps[20:35])))
    )
    assert _lasting(rows).tolist() == [1]


def used_names(module):
    """Return the names that the functions of a module of the room use."""
    left = [compile(Path(import_module(ROOM + module).__file__).read_text("utf-8"), module, "exec")]
    names = set()
    while left:
        code = left.pop()
        names |= set(code.co_names)
        left += [each for each in code.co_consts if isinstance(each, CodeType)]
    return names


@pytest.mark.parametrize("name", COMPONENTS)
def test_each_component_is_one_that_the_package_has(name):
    off, whole = COMPONENTS[name], VehicleSettings()
    assert off.settings or off.replaced or off.sensors
    for place in off.settings:
        assert changed(whole, {place: off.settings[place]}) != whole
    for place, new in off.replaced.items():
        module, _, path = place.partition(":")
        owner = import_module(ROOM + module)
        for each in path.split("."):
            owner = getattr(owner, each)
        assert owner is not new
        # what nothing uses can be replaced without effect
        within = ROOM_MODULES if "." in path else [module]
        assert any(path.split(".")[-1] in used_names(each) for each in within)


def test_what_is_replaced_works_in_compiled_code_and_is_put_back():
    given = (40, np.array([0, 39]), np.array([5.0, 5.0]), np.full(2, 0.01),
             np.array([0.0, 9.75]), np.full(2, 0.01), 0.0, 5.0, 2.0)  # fmt: skip
    before = motion._look_back
    with replaced(COMPONENTS["smoothing over later detections"].replaced):
        filtered = motion._smooth(*given)[2]
    assert motion._look_back is before
    smoothed = motion._smooth(*given)[2]
    assert filtered[-1] == pytest.approx(smoothed[-1])
    assert filtered[-2] > 2.0 * smoothed[-2]


def test_a_constant_is_put_back_though_what_is_done_with_it_fails():
    with pytest.raises(KeyError), replaced({"forward:FORK_M": -1.0}):
        assert forward.FORK_M == -1.0
        raise KeyError
    assert forward.FORK_M > 0.0


def test_the_second_sensor_is_judged_by_what_the_first_sees(monkeypatch):
    site = SimpleNamespace(
        recordings=["R1", "R2"], truth=lambda: "both", tiles=list, sensors=lambda: ["A", "B"],
        traffic=list,
    )  # fmt: skip
    monkeypatch.setattr(components, "true_occupancy", lambda _, sensors, __: sensors)
    monkeypatch.setattr(components, "_found", lambda _, off, __, ___, truth: (off, truth))
    monkeypatch.setattr(components, "_figures", lambda _, __, truth, count: (count, truth))
    names = ("links", tables.SECOND)
    assert list(components.ablate(site, names)) == [
        (tables.NOTHING, (Off(), "both")), ("links", (COMPONENTS["links"], "both")),
        (tables.NOTHING_FIRST, (1, ["A"])), (tables.SECOND, (Off(sensors=1), ["A"])),
    ]  # fmt: skip
    site.recordings = ["R1"]
    assert [name for name, _ in components.ablate(site, names)] == [tables.NOTHING, "links"]


def test_changes_without_a_component_become_tables():
    def figures(rank, recall):
        occupancy = {"rank": rank, "scale": 1.0, "mae_percent": 2.0}
        vehicles = {"recall": recall, "precision": 0.8}
        return {"occupancy": occupancy, "vehicles": vehicles, "passages": {"count_error": None}}

    report = {
        "ablation": {
            "town": {tables.NOTHING: figures(0.9, 0.7), "links": figures(0.85, 0.7),
                     "forks": figures(0.9, 0.7), tables.NOTHING_FIRST: figures(0.5, 0.5),
                     tables.SECOND: figures(0.4, 0.6)},
            "light": {tables.NOTHING: figures(0.8, 0.6), "links": figures(0.8, 0.65)},
        }
    }  # fmt: skip
    occupancy, vehicles = tables.ablation(report).split("\n\n")
    assert occupancy.splitlines()[2:] == [
        "| nothing | 0.90 / 1.00 / 2.00 | 0.80 / 1.00 / 2.00 |",
        "| links | -0.05 / +0.00 / +0.00 | - |",
        "| forks | - |  |",
        "| second sensor | -0.10 / +0.00 / +0.00 |  |",
    ]
    assert vehicles.splitlines()[3] == "| links | - | +5% / +0% / - |"


def test_texts_go_between_the_marks_of_a_page(tmp_path):
    page = tmp_path / "x.md"
    quoted = '- after "<!-- b -->"\n'  # a directive that names a mark is none
    page.write_text(
        f"{quoted}<!-- b -->\nold\nlines\n<!-- end of b -->\n<!-- a -->\n<!-- end of a -->"
    )
    assert pages.marked(page, ("a", "b", "c")) == ["a", "b"]
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
    with pytest.raises(SystemExit, match="has no line <!-- c --> nor <!-- d -->"):
        pages.marked(page, ("c", "d"))


def test_figures_are_collected_and_become_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "KEPT", tmp_path / "bench.json")
    score = {"true_mean": 0.053, "rank": 0.9512, "scale": math.inf, "mae_percent": math.nan}
    command.keep("scenes", "town", "hits", {"occupancy": score})
    command.keep("scenes", "town", "oracle association", {"occupancy": score | {"scale": 0.98}})
    ended = {"code": 3, "good": True, "false": 0, "doubled": 2, "said": "/x/y/a|b"}
    command.keep("bad input", "half of a file", None, ended)
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert kept["scenes"]["town"]["hits"]["occupancy"]["scale"] is None
    lines = tables.readme(kept).splitlines()
    assert lines[0].split(" | ")[2:4] == ["hits", "best possible"]
    assert lines[2].startswith("| town | 5.3% | 0.95 / - / - | 0.95 / 0.98 / - | >= .95")
    assert "| half of a file | 3 | yes | 0 | 2 | a/b |" in tables.bad_input(kept)


def test_lanelets_without_shared_nodes_follow_each_other():
    first = straight_tiles(20)
    beyond = straight_tiles(20, lanelet_id=8)
    beyond.geometry = beyond.geometry.translate(10.2, 0.1)
    beside = straight_tiles(20, lanelet_id=9)
    beside.geometry = beside.geometry.translate(10.0, 3.0)
    assert joined(pd.concat([first, beyond, beside], ignore_index=True)) == {(7, 8)}


def test_false_and_missed_vehicles_have_a_cause(tmp_path, monkeypatch):
    def states(*rows):
        table = pd.DataFrame(rows, columns=["vehicle", "step", "easting", "northing"])
        more = {"heading": 0.0, "speed": 5.0, "length": 4.0, "due": True, "hidden": False}
        return table.assign(range_m=20.0, **more).sort_values("step", ignore_index=True)

    step = int(FIRST)
    true = states((1, step, 0.0, 0.0), (2, step, 50.0, 0.0), (3, step, 80.0, 0.0))
    true["hidden"] = true["vehicle"] == 3
    given = states(
        (7, step, 0.5, 0.0), (8, step, 6.0, 0.0), (9, step, 20.0, 0.0), (10, step, 120.0, 0.0)
    )
    walker = {"t": step * 0.05, "kind": "walker", "easting": 21.0, "northing": 0.0}
    pd.DataFrame([walker]).to_parquet(tmp_path / "vehicles.parquet")
    heard = pd.DataFrame({"vehicle": [2], "at": [step + 15]})
    monkeypatch.setattr(causes, "steps_with_detections", lambda *_: heard)
    site = SimpleNamespace(folder=tmp_path, traffic=lambda: SimpleNamespace(states=None))
    found = causes.causes(site, Scored(true=true, given=given))
    assert {name: value for name, value in found.items() if value} == {
        "double": 0.25, "person": 0.25, "ghost": 0.25,
        "missed_while_hidden": 1 / 3, "missed_with_data": 1 / 3,
    }  # fmt: skip


def test_the_tail_of_a_long_vehicle_is_on_it():
    true = pd.DataFrame(
        {"easting": [0.0, 50.0], "northing": 0.0, "heading": np.pi / 2, "length": [16.6, 4.0]}
    )
    places = _whole(true)
    assert np.allclose(sorted(places["northing"]), [-6.0, 0.0, 0.0, 0.0, 0.0, 6.0])
    assert np.allclose(sorted(places["easting"]), [0.0, 0.0, 0.0, 50.0, 50.0, 50.0])

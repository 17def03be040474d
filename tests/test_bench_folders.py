"""The bench of vehicles: folders from states, where a coverage is wrong, tables, bad input."""

import json
import math
import sys
from importlib import import_module
from pathlib import Path
from types import CodeType, SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from test_vehicles_folder import FIRST, frames_of_span, provenance_of, straight_tiles, view_of

sys.path.append(str(Path(__file__).parents[1] / "bench" / "vehicles"))

import causes
import command
import components
import pages
import tables
from bad_input import _lasting, _whole
from breakdown import by_group, step_errors
from components import COMPONENTS, ROOM, Off, changed, replaced
from folders import Ground, write_states
from passages import Lanes, joined
from score import coverage_of_folder
from tracks import Scored
from true_coverage import TrueCoverage

from gis_radar.vehicles import forward, motion, read_vehicles
from gis_radar.vehicles.settings import VehicleSettings

COUNT = 100  # steps
ROOM_MODULES = [path.stem for path in Path(motion.__file__).parent.glob("*.py")]


def ground():
    """Forty tiles of a lanelet to the east, seen by one sensor."""
    tiles = straight_tiles()
    at = tiles["s_m"].to_numpy() + 0.25
    lanes = Lanes(
        lanelet=np.full(40, 7), index=np.arange(40), tile_id=np.arange(40), heading=np.zeros(40),
        middle=np.column_stack([at, np.zeros(40)]), width=np.full(40, 3.0), half={7: 20},
        follows=set(), s_m=at,
    )  # fmt: skip
    return Ground(
        tiles=tiles, lanes=lanes, views=[view_of(tiles)],
        frames=frames_of_span(FIRST, FIRST + COUNT - 1), provenance=provenance_of(tiles),
    )  # fmt: skip


def eastward(steps, *, vehicle=3, speed=4.0, length=4.0):
    """States of a vehicle whose front is at 0 in the first step."""
    steps = np.asarray(steps)
    front = speed * 0.05 * steps
    return pd.DataFrame(
        {
            "vehicle": vehicle, "step": FIRST + steps, "easting": front - length / 2,
            "northing": 0.2, "heading": 0.0, "speed": speed, "length": length, "width": 1.8,
            "seen": True,
        }
    )  # fmt: skip


def true_of(states):
    """The coverage of vehicles of 4 m by hand: tiles whose middles lie under them."""
    covered = np.zeros((40, COUNT), bool)
    middle = np.arange(40) / 2.0 + 0.25
    for step, east in zip(states["step"] - FIRST, states["easting"], strict=True):
        covered[np.abs(middle - east) <= 2.0, step] = True
    return TrueCoverage(
        tile_id=np.arange(40), first_step=FIRST, covered=covered,
        visible=np.ones_like(covered), blocked=np.zeros_like(covered),
    )  # fmt: skip


def test_states_become_a_folder_with_places_along_the_lane(tmp_path):
    states = eastward(np.arange(COUNT))
    folder = write_states(ground(), states, tmp_path / "vehicles")
    tracks = pd.read_parquet(folder / "tracks.parquet")
    on = tracks[tracks["s_m"].notna()]
    assert on["lanelet_id"].unique().tolist() == [7]
    assert on["s_m"].to_numpy() == pytest.approx(0.2 * (on["step"] - FIRST), abs=1e-3)
    assert on["d_m"].to_numpy() == pytest.approx(0.2)
    passages = read_vehicles(folder).passages
    # the middle at 10 m after 2.5 s
    assert (passages["lanelet_id"].tolist(), passages["step"].tolist()) == ([7], [FIRST + 49])
    table = coverage_of_folder(folder, ground().tiles).set_index("tile_id")
    true = true_of(states).table().set_index("tile_id")["coverage"]
    assert table["covered_s"].div(table["visible_s"]).to_numpy() == pytest.approx(true.to_numpy())
    assert (table["coverage_se"] > 0.0).all()


def test_a_vehicle_that_is_gone_for_a_while_becomes_two(tmp_path):
    states = eastward([*range(40), *range(50, 90)])
    vehicles = read_vehicles(write_states(ground(), states, tmp_path / "vehicles")).vehicles
    assert (vehicles["last_step"] - FIRST).tolist() == [39, 89]


def test_steps_are_missed_misplaced_or_false(tmp_path):
    true = true_of(eastward(np.arange(COUNT)))
    runs = pd.DataFrame(
        # a metre behind the true vehicle, and where nothing was
        {"tile_id": [1, 38], "first_step": FIRST + np.array([0, 0]), "last_step": FIRST + 9}
    )
    runs.to_parquet(tmp_path / "covered.parquet")
    hidden = true.blocked.copy()
    hidden[:, 50:] = True
    truth = TrueCoverage(
        tile_id=true.tile_id, first_step=FIRST, covered=true.covered, visible=true.visible,
        blocked=hidden,
    )  # fmt: skip
    errors = step_errors(tmp_path, ground().tiles, truth)
    total = true.covered.sum()
    right = true.covered[1, :10].sum()
    near = true.covered[:10, :10].any(axis=0).sum()
    assert errors["missed_in_view"] == pytest.approx((true.covered[:, :50].sum() - right) / total)
    assert errors["missed_hidden"] == pytest.approx(true.covered[:, 50:].sum() / total)
    assert errors["misplaced"] == pytest.approx((near - right) / total)
    assert errors["false_in_view"] == pytest.approx((20 - near) / total)
    assert errors["false_hidden"] == 0.0


def test_groups_have_figures_of_their_own():
    truth = true_of(eastward(np.arange(COUNT)))
    table = truth.table().assign(coverage_se=0.01)
    table.loc[:9, "coverage"] += 0.1
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
    monkeypatch.setattr(components, "true_coverage", lambda _, sensors, __: sensors)
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
        coverage = {"rank": rank, "scale": 1.0, "mae_percent": 2.0}
        vehicles = {"recall": recall, "precision": 0.8}
        return {"coverage": coverage, "vehicles": vehicles, "passages": {"count_error": None}}

    report = {
        "ablation": {
            "town": {tables.NOTHING: figures(0.9, 0.7), "links": figures(0.85, 0.7),
                     "forks": figures(0.9, 0.7), tables.NOTHING_FIRST: figures(0.5, 0.5),
                     tables.SECOND: figures(0.4, 0.6)},
            "light": {tables.NOTHING: figures(0.8, 0.6), "links": figures(0.8, 0.65)},
        }
    }  # fmt: skip
    coverage, vehicles = tables.ablation(report).split("\n\n")
    assert coverage.splitlines()[2:] == [
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
    command.keep("scenes", "town", "hits", {"coverage": score})
    command.keep("scenes", "town", "oracle association", {"coverage": score | {"scale": 0.98}})
    ended = {"code": 3, "good": True, "false": 0, "doubled": 2, "said": "/x/y/a|b"}
    command.keep("bad input", "half of a file", None, ended)
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert kept["scenes"]["town"]["hits"]["coverage"]["scale"] is None
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

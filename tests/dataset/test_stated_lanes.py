"""Names, streets and free speeds that a site states of its lanes: the dataset holds them."""

import json
import shutil
import zipfile

import numpy as np
import pandas as pd
import pytest
from forks import APPROACH, LEFT, STRAIGHT, fork_dataset, through
from maps import Listener

import gis_radar as gr
from gis_radar.base import InputError

HOUR = 472_222  # 2023-11-14, 22 h
NAMED = [{"id": APPROACH, "name": "To the harbour", "speed_kmh": 72.0}, {"id": LEFT, "name": "Off"}]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    tracks = [through(n, HOUR * 72_000 + 400 * n, LEFT) for n in range(8)]
    return fork_dataset(tmp_path_factory.mktemp("fork") / "data", tracks).folder


@pytest.fixture
def folder(measured, tmp_path):
    return shutil.copytree(measured, tmp_path / "data")


def names_in_sql(folder):
    rows = gr.open_dataset(folder).query("SELECT lane, name FROM lanes")
    return dict(zip(rows["lane"], rows["name"], strict=True))


def bytes_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_whoever_asks_gets_the_names_that_are_stated(folder, tmp_path):
    by_map, before = names_in_sql(folder), bytes_of(folder)
    dataset = gr.open_dataset(folder).state_lanes(NAMED)
    assert bytes_of(folder).items() >= before.items()  # no hour follows from them
    wanted = by_map | {APPROACH: "To the harbour", LEFT: "Off"}
    assert names_in_sql(folder) == wanted
    for each in (dataset, gr.open_dataset(folder)):
        traffic, turns = each.traffic("1min"), each.turns("1min")
        assert dict(zip(traffic["lane"], traffic["name"], strict=True)) == wanted
        assert "To the harbour" in set(turns["from_name"])
        assert "To the harbour" in set(each.queues("1min")["name"])
    gr.make_traffic(folder, interval="1min").write(tmp_path / "out", datex="DE:Town")
    with zipfile.ZipFile(tmp_path / "out" / "traffic.xlsx") as book:
        cells = b"".join(book.read(name) for name in book.namelist() if name.endswith(".xml"))
    assert b"To the harbour" in cells
    for name in ("traffic.csv", "turns.csv", "datex.sites.xml"):
        assert "To the harbour" in (tmp_path / "out" / name).read_text(encoding="utf-8-sig")


def test_free_speeds_count_where_delays_are_asked_for(folder):
    before = gr.open_dataset(folder).traffic("1min")
    after = gr.open_dataset(folder).state_lanes(NAMED).traffic("1min")
    mine = (before["lane"] == APPROACH) & before["delay_s"].notna()
    later = (after["delay_s"] - before["delay_s"])[mine & (before["delay_s"] > 0)]
    assert later.tolist() == pytest.approx([3.0] * len(later))  # 60 m at 36 km/h, then at 72
    others = before["lane"] != APPROACH
    pd.testing.assert_series_equal(after["delay_s"][others], before["delay_s"][others])
    found = gr.open_dataset(folder).query("SELECT lane, speed_limit_kmh FROM lanes")
    assert found.set_index("lane")["speed_limit_kmh"][APPROACH] == 72.0


def test_streets_are_those_of_profiles_and_of_names(folder):
    stated = [{"id": each, "street": "Südring"} for each in (APPROACH, STRAIGHT)]
    dataset = gr.open_dataset(folder).state_lanes(stated)
    assert dataset.profile("Südring")["direction"].unique().tolist() == ["Südring eastbound"]
    assert names_in_sql(folder)[APPROACH].startswith("Südring eastbound, lane 1")


def test_what_is_stated_anew_takes_the_place_of_all_before(folder):
    by_map = names_in_sql(folder)
    gr.open_dataset(folder).state_lanes(NAMED)
    once = bytes_of(folder)
    gr.open_dataset(folder).state_lanes(NAMED[::-1])  # the same, in another order
    assert bytes_of(folder) == once
    gr.open_dataset(folder).state_lanes([{"id": LEFT, "name": "Away"}])
    assert names_in_sql(folder) == by_map | {LEFT: "Away"}
    gr.open_dataset(folder).state_lanes([])
    assert names_in_sql(folder) == by_map


def test_nothing_is_written_where_nothing_is_stated(folder):
    before = bytes_of(folder)
    gr.open_dataset(folder).state_lanes([])
    assert bytes_of(folder) == before


def test_numbers_of_a_table_are_lanes(folder):
    dataset = gr.open_dataset(folder)
    lanes = dataset.lanes()["lane"]
    number = lanes[lanes == LEFT].iloc[0]
    assert isinstance(number, np.int64)
    dataset.state_lanes([{"id": number, "name": "Off", "speed_kmh": np.float32(30.0)}])
    assert names_in_sql(folder)[LEFT] == "Off"


def test_a_lane_that_the_map_has_not_is_one_warning(folder):
    by_map, heard = names_in_sql(folder), Listener()
    gr.open_dataset(folder).state_lanes([*NAMED, {"id": 77, "name": "gone"}], reporter=heard)
    (said,) = heard.messages
    assert "names lanes that the map has not: 77; they are left out" in str(said)
    assert names_in_sql(folder) == by_map | {APPROACH: "To the harbour", LEFT: "Off"}


def test_names_for_one_question_come_before_those_of_the_dataset(folder):
    dataset = gr.open_dataset(folder).state_lanes(NAMED)
    other = dataset.with_lanes([{"id": LEFT, "name": "Elsewhere"}]).traffic("1min")
    names = dict(zip(other["lane"], other["name"], strict=True))
    assert (names[LEFT], names[APPROACH]) == ("Elsewhere", "To the harbour")
    assert names_in_sql(folder)[LEFT] == "Off"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[]", "damaged"),
        ('{"lanes": 7}', "damaged"),
        ('{"lanes": [7]}', "damaged"),
        ("{", "not JSON"),
        ('{"lanes": [{"id": 77}]}', "has no lane 77"),
        ('{"lanes": [{"id": "10"}]}', "id is '10', expected a whole number"),
        ('{"lanes": [], "speed_kmh": "50"}', "speed_kmh is '50', expected a number"),
    ],
)
def test_a_file_that_was_edited_wrongly_is_named(folder, text, told):
    (folder / "lanes.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told) as refused:
        gr.open_dataset(folder).lanes()
    assert "lanes.json" in refused.value.message
    gr.open_dataset(folder).state_lanes(NAMED)
    assert names_in_sql(folder)[LEFT] == "Off"


def test_a_site_file_names_the_lanes_of_a_dataset(run, folder, tmp_path):
    streets = [{"id": each, "street": "Südring"} for each in (APPROACH, STRAIGHT)]
    gr.open_dataset(folder).state_lanes([*streets, {"id": LEFT, "name": "Off"}])
    for name in ("map.osm", "R1.parquet", "R1.json"):
        (tmp_path / name).touch()
    site = tmp_path / "SITE.toml"
    site.write_text(
        f'title = "Fork"\n[map]\nfile = "map.osm"\n[[lane]]\nid = {APPROACH}\nname = "Ring, left"\n'
        '[[lane]]\nid = 77\nname = "gone"\n[[sensor]]\nname = "R1"\nrecordings = ["R1.parquet"]\n'
        'pose = "R1.json"\n',
        encoding="utf-8",
    )
    code, _, said = run("dataset", folder, "--site", site)
    assert code == 0
    assert "names lanes that the map has not: 77" in said
    code, out, _ = run("query", folder, "SELECT name FROM lanes WHERE lane = 10", "--json")
    assert code == 0
    assert json.loads(out.splitlines()[-1])["summary"]["rows"] == [{"name": "Ring, left"}]
    assert names_in_sql(folder)[LEFT] != "Off"
    assert names_in_sql(folder)[STRAIGHT].startswith("Südring eastbound")  # of a layer of streets


@pytest.mark.parametrize(
    "stated", [{"speed_kmh": -5.0}, {"lanes": [{"id": APPROACH, "speed_kmh": 0.0}]}]
)
def test_a_speed_that_nobody_drives_is_refused(folder, stated):
    before = bytes_of(folder)
    with pytest.raises(InputError, match=r"speed_kmh is .*, expected more than 0"):
        gr.open_dataset(folder).state_lanes(**stated)
    assert bytes_of(folder) == before


@pytest.mark.parametrize(
    "name", ["lanes.json", "tiles.gpkg", "map.osm", "poses.parquet", "sights.parquet"]
)
def test_the_check_finds_a_damaged_file_beside_the_hours(folder, name):
    gr.open_dataset(folder).state_lanes(NAMED)
    gr.open_dataset(folder).check()
    whole = (folder / name).read_bytes() if (folder / name).exists() else b"<osm></osm>"
    (folder / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=name):
        gr.open_dataset(folder).check()

"""Count sections and counts by hand, on the fork: who crosses a line is counted there once."""

import math
import sqlite3
from contextlib import closing
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
from datasets import HOUR
from driven import drive
from forks import APPROACH, LEFT, STRAIGHT, fork, fork_dataset, through
from maps import EAST, NORTH, UTM, Listener
from shapely import LineString, MultiLineString

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR

BEGIN = HOUR * STEPS_PER_HOUR


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Eight cars through the fork, each a minute after the last, and two that turn back before."""
    exits = [STRAIGHT] * 5 + [LEFT] * 3
    tracks = [through(n, BEGIN + 1200 * n, lane) for n, lane in enumerate(exits)]
    short = np.arange(2.0, 30.0, 0.5)
    tracks += [drive(n, BEGIN + 1200 * n, short, lanelet_id=APPROACH) for n in (20, 21)]
    return fork_dataset(tmp_path_factory.mktemp("fork") / "dataset", tracks)


def lines(**places):
    """Give sections by name: from one place to another, metres from the fork's begin."""
    drawn = [LineString(np.add(each, (EAST, NORTH))) for each in places.values()]
    return gpd.GeoDataFrame({"name": list(places)}, geometry=drawn, crs=UTM)


ACROSS = lines(early=[(20, -5), (20, 5)], late=[(40, -5), (40, 5)], exits=[(80, 20), (80, -5)])


def test_who_crosses_a_section_is_counted_there(dataset):
    found = dataset.count_sections(ACROSS, "15min")
    assert found.groupby("section")["counted"].sum().to_dict() == {
        "early": 10, "late": 8, "exits": 8,
    }  # fmt: skip
    assert set(found["direction"]) == {"eastbound"}
    assert found["speed_time_mean_kmh"].dropna().tolist() == pytest.approx([36.0] * 4, abs=1.0)
    by_minute = dataset.count_sections(ACROSS, "1min")
    sums = by_minute.groupby("section")["counted"].sum()
    assert sums.to_dict() == {"early": 10, "late": 8, "exits": 8}
    whole = dataset.count_sections(ACROSS, "1h").set_index("section")
    assert whole["counted"].to_dict() == sums.to_dict()


def test_sections_have_the_names_of_a_column_in_capitals(dataset):
    found = dataset.count_sections(ACROSS.rename(columns={"name": "NAME"}), "15min")
    assert set(found["section"]) == set(ACROSS["name"])


def test_a_section_at_the_stop_line_counts_what_its_lane_does(dataset):
    there = lines(line=[(60 - 1e-6, -2), (60 - 1e-6, 2)])
    found = dataset.count_sections(there, "5min").set_index("begin")
    lane = dataset.traffic("5min").query(f"lane == {APPROACH}").set_index("begin")
    for name in ("visible_share", "counted", "volume", "volume_se"):
        assert found[name].astype(float).tolist() == pytest.approx(
            lane[name].astype(float).tolist(), nan_ok=True
        )


def test_sections_whose_names_are_all_empty_are_numbered(dataset, tmp_path):
    ACROSS.assign(name=None).to_file(tmp_path / "lines.gpkg")
    found = dataset.count_sections(tmp_path / "lines.gpkg", "15min")
    assert sorted(found["section"].unique()) == ["1", "2", "3"]


@pytest.mark.parametrize("off", [0.0, 0.003, -0.003])
def test_a_section_through_the_end_of_a_lane_counts_once(dataset, off):
    """It was snapped there: lanes that begin in the same place are not crossed as well."""
    node = lines(node=[(60 + off, -2), (60 + off, 2)])
    found = dataset.count_sections(node, "15min")
    assert found["counted"].sum() == 8


def test_a_direction_that_nobody_sees_has_rows_without_figures(tmp_path):
    tracks = [through(n, BEGIN + 1200 * n, STRAIGHT) for n in range(3)]
    left = fork().query(f"lanelet_id == {LEFT}")["tile_id"]
    unseen = fork_dataset(tmp_path / "dataset", tracks, unseen=left)
    places = lines(early=[(20, -5), (20, 5)], left=[(81, 7), (79, 11)], exits=[(80, 20), (80, -5)])
    found = unseen.count_sections(places, "5min").set_index("section")
    assert found.loc["early", "counted"].sum() == 3
    for name in ("left", "exits"):
        rows = found.loc[[name]]
        assert rows["begin"].tolist() == found.loc[["early"], "begin"].tolist()
        assert (rows["visible_share"] == 0.0).all()
        assert rows["volume"].isna().all()
    assert found.loc[["left"], "counted"].isna().all()


def test_directions_are_told_apart_by_the_side_they_come_from(dataset):
    """A line that is drawn the other way round names the same direction."""
    turned = lines(late=[(40, 5), (40, -5)])
    one, other = (dataset.count_sections(each, "15min") for each in (ACROSS, turned))
    columns = ["direction", "begin", "counted", "volume"]
    one = one[one["section"] == "late"].reset_index(drop=True)
    pd.testing.assert_frame_equal(pd.DataFrame(one[columns]), pd.DataFrame(other[columns]))


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ({"off": [(20, 50), (20, 60)]}, "section off crosses no lane"),
        ({"flat": [(10, -0.2), (50, 0.2)]}, "section flat runs along lane 10"),
        ({"bow": [(20, -5), (25, 5), (30, -5)]}, "section bow crosses lane 10 more than once"),
    ],
)
def test_a_section_off_the_road_or_along_it_is_refused(dataset, places, said):
    with pytest.raises(gr.InputError, match=said):
        dataset.count_sections(lines(**places))


def test_a_section_is_of_one_part(dataset):
    """QGIS writes a line as a collection of one; parts that meet are one line."""
    halves = [MultiLineString([each.coords[:]]) for each in ACROSS.geometry]
    counted = dataset.count_sections(ACROSS.set_geometry(halves), "15min")
    assert counted["counted"].sum() == 26
    apart = MultiLineString([[(EAST + 20, NORTH + y), (EAST + 20, NORTH + y + 1)] for y in (-1, 1)])
    with pytest.raises(gr.InputError, match="sections are lines across a road"):
        dataset.count_sections(gpd.GeoDataFrame(geometry=[apart], crs=UTM))


def test_sections_of_other_systems_are_moved_or_refused(dataset):
    moved = dataset.count_sections(ACROSS.to_crs("EPSG:25833"), "15min")
    assert moved["counted"].sum() == 26
    with pytest.raises(gr.CrsError, match="is geographic"):
        dataset.count_sections(ACROSS.to_crs("EPSG:4326"))
    with pytest.raises(gr.CrsError, match="has no coordinate system"):
        dataset.count_sections(ACROSS.set_crs(None, allow_override=True))
    twice = pd.concat([ACROSS, ACROSS])
    with pytest.raises(gr.InputError, match="two sections have one name"):
        dataset.count_sections(twice)


def test_the_layer_of_sections_shows_their_volumes(dataset, tmp_path):
    gr.make_traffic(dataset, sections=ACROSS, language="de").write(tmp_path / "out", language="de")
    with closing(sqlite3.connect(tmp_path / "out" / "traffic.gpkg")) as database:
        styles = dict(database.execute("SELECT f_table_name, styleQML FROM layer_styles"))
    shown = {name: ET.fromstring(qml.partition("\n")[2]) for name, qml in styles.items()}  # noqa: S314 - ours
    assert {name: each.get("labelsEnabled") for name, each in shown.items()} == {
        "lanes": None, "turns": None, "sections": "1",
    }  # fmt: skip
    expression = shown["sections"].find(".//text-style").get("fieldName")
    assert expression.endswith("' Kfz/h'")
    assert [each.get("label") for each in shown["lanes"].iter("range")][1::6] == [
        "50 bis 100 Kfz/h", "über 1200 Kfz/h",
    ]  # fmt: skip


@pytest.fixture
def given(tmp_path):
    ACROSS.to_file(tmp_path / "sections.gpkg")

    def write(text):
        (tmp_path / "counts.csv").write_text(text, encoding="utf-8")
        return tmp_path / "sections.gpkg", tmp_path / "counts.csv"

    return write


@pytest.mark.parametrize("written", ["eastbound", "east", "Ost", "Osten", "nach Osten"])
def test_the_direction_of_a_count_may_be_a_wind(run, dataset, given, tmp_path, written):
    sections, counts = given(
        f"section;direction;begin;end;volume\nlate;{written};2023-11-14 22:00;2023-11-14 22:10;8\n"
    )
    words = ["--sections", sections, "--counts", counts, "--interval", "5min"]
    assert run("traffic", dataset.folder, "-o", tmp_path / "out", *words)[0] == 0
    assert pd.read_csv(tmp_path / "out" / "hand_counts.csv")["direction"].tolist() == ["eastbound"]


def test_counts_by_hand_stand_beside_ours(run, dataset, given, tmp_path):
    name = dataset.traffic()["name"].iloc[0]
    sections, counts = given(
        "section;lane;begin;end;volume;volume_se\n"
        "late;;2023-11-14 22:00;2023-11-14 22:10;8;\n"
        "early;;2023-11-14 22:00;2023-11-14 22:05;9,5;0,2\n"
        f";{APPROACH};2023-11-14 22:00;2023-11-14 22:05;1;\n"
        f";{name};2023-11-14T22:05Z;2023-11-14T22:10Z;3;\n"
        "late;;2023-11-15 22:00;2023-11-15 22:10;8;\n"
    )
    code, out, _ = run(
        "traffic", dataset.folder, "-o", tmp_path / "out", "--interval", "5min", "--json",
        "--sections", sections, "--counts", counts,
    )  # fmt: skip
    assert code == 0, out
    table = pd.read_csv(tmp_path / "out" / "hand_counts.csv")
    late, early, lane, named, gone = table.to_dict("records")
    assert (late["volume_by_hand"], late["volume"], late["agrees"]) == (8, pytest.approx(8), True)
    assert late["geh"] == pytest.approx(0.0, abs=0.01)
    assert early["difference"] == pytest.approx(early["volume"] - 9.5)
    assert lane["agrees"] is False or not lane["agrees"]
    assert lane["geh"] == pytest.approx(
        np.sqrt(2 * 12 * (lane["volume"] - 1) ** 2 / (lane["volume"] + 1)), rel=0.01
    )
    assert named["place"] == f"'{name}"  # a name that begins with = is text for spreadsheets
    assert np.isnan(gone["volume"])
    assert pd.isna(gone["agrees"])
    assert '"hand_counts": 5, "hand_counts_compared": 4, "hand_counts_that_agree": 2' in out
    columns = list(pd.read_csv(tmp_path / "out" / "sections.csv"))
    assert columns[columns.index("volume") :][:3] == ["volume", "volume_se", "volume_veh_h"]
    layer = gpd.read_file(tmp_path / "out" / "traffic.gpkg", layer="sections")
    assert layer["counted"].sum() == 26
    sheets = pyogrio.list_layers(tmp_path / "out" / "traffic.xlsx")[:, 0]
    assert sheets.tolist() == ["Lanes", "Turns", "Count sections", "Counts by hand", "Notes"]


@pytest.mark.parametrize(("separator", "encoding"), [(";", "cp1252"), ("\t", "utf-16")])
def test_counts_are_read_as_excel_writes_them_in_germany(dataset, tmp_path, separator, encoding):
    """As CSV, and as Unicode text."""
    sections = ACROSS.replace("late", "Münchner Straße")
    text = (
        "section; begin;end;volume;\r\n"
        "Münchner Straße;14.11.2023 22:00;14.11.2023 22:05;9,5;\r\n;;;;\r\n\r\n"
        "early;14.11.2023 22:00:00;2023-11-14 22:05;3;\r\n"
    )
    (tmp_path / "counts.csv").write_bytes(text.replace(";", separator).encode(encoding))
    made = gr.make_traffic(
        dataset, interval="5min", sections=sections, hand_counts=tmp_path / "counts.csv"
    )
    assert made.hand_counts["place"].tolist() == ["Münchner Straße", "early"]
    assert made.hand_counts["volume_by_hand"].tolist() == [9.5, 3.0]
    assert made.hand_counts["begin"].nunique() == made.hand_counts["end"].nunique() == 1


@pytest.mark.parametrize(
    ("name", "known"),
    [("a\nb", "a b"), ("\ufffe", "\\ufffe"), ("\x00a", "\\x00a"), ("  ", "1"), ("Süd ", "Süd")],
)
def test_names_of_sections_are_one_line_that_xml_can_hold(dataset, name, known):
    places = lines(x=[(20, -5), (20, 5)]).assign(name=[name])
    assert set(dataset.count_sections(places)["section"]) == {known}


def test_the_layer_of_lines_is_taken_and_of_several_none(dataset, tmp_path):
    path = tmp_path / "project.gpkg"
    ACROSS.set_geometry(ACROSS.buffer(1.0)).to_file(path, layer="areas")
    ACROSS.to_file(path, layer="mine")
    assert set(dataset.count_sections(path)["section"]) == set(ACROSS["name"])
    ACROSS.to_file(path, layer="others")
    with pytest.raises(gr.GisRadarError, match=r"project\.gpkg: has 2 layers of lines: mine, othe"):
        dataset.count_sections(path)


@pytest.mark.filterwarnings("ignore:invalid value encountered in linestrings")
@pytest.mark.parametrize("end", [None, math.nan, math.inf])
def test_a_section_without_a_line_is_refused(dataset, end):
    line = None if end is None else LineString([(0.0, 0.0), (end, 0.0)])
    layer = gpd.GeoDataFrame(geometry=[*ACROSS.geometry, line], crs=UTM)
    with pytest.raises(gr.InputError, match="a section has no line"):
        dataset.count_sections(layer)


def test_a_count_by_hand_may_be_any_number(dataset, given):
    """Our volumes have 32 bits, in which larger numbers do not exist."""
    text = "section,begin,end,volume\nlate,2023-11-14 22:00,2023-11-14 22:05,1e40\n"
    sections, counts = given(text)
    traffic = gr.make_traffic(dataset, interval="5min", sections=sections, hand_counts=counts)
    assert traffic.hand_counts["difference"].tolist() == pytest.approx([-1e40])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("begin,end,volume\n2023-11-14,2023-11-15,3\n", "lacks the columns section or lane"),
        ("lane,begin,end,volume\n99,22:00,22:05,3\n", "line 2: lane '99' is none"),
        (
            "section,begin,end,volume\nx,22:00,22:05,3\n",
            "line 2: section is 'x', expected one of early",
        ),
        (
            "section,begin,end,volume\nlate,2023-11-14 22:01,2023-11-14 22:05,3\n",
            "line 2: begins or ends within one of our intervals",
        ),
        (
            "section,begin,end,volume\nlate,2023-11-14 22:05,2023-11-14 22:00,3\n",
            "line 2: ends before it begins",
        ),
        (
            "section,begin,end,volume\nlate,2023-11-14 22:00,2023-11-14 22:05,many\n",
            "line 2: volume is 'many'",
        ),
        ("section,begin,end,volume\nlate,tomorrow,2023-11-14 22:05,3\n", "line 2: begin is"),
        (
            "section,direction,begin,end,volume\nlate,upward,2023-11-14 22:00,2023-11-14 22:05,3\n",
            "line 2: direction is 'upward', expected one of eastbound",
        ),
        (
            "section,begin,end,volume\nlate,2023-11-15 22:00,2023-11-15 22:05,3\n",
            "none of its counts is of the time that was measured, 2023-11-14 2",
        ),
        (
            "section,begin,end,volume" + 2 * "\nlate,2023-11-14 22:00,2023-11-14 22:05,3",
            "counts late from 2023-11-14 22:00+00:00 twice",
        ),
        ("section,begin,end,volume\n", "holds no counts"),
        (
            "section,begin,end,volume,volume\nlate,2023-11-14 22:00,2023-11-14 22:05,3,9\n",
            "has two columns 'volume'",
        ),
        ("", "lacks the columns begin, end and volume"),
        (
            "section;begin;end;volume\n\n;;;\nlate;2023-11-14 22:00;2023-11-14 22:05;1.234\n",
            "line 4: volume is '1.234'",
        ),
    ],
)
def test_counts_that_are_none_are_one_line(run, dataset, given, tmp_path, text, said):
    sections, counts = given(text)
    code, _, err = run(
        "traffic", dataset.folder, "-o", tmp_path / "out", "--interval", "5min",
        "--sections", sections, "--counts", counts,
    )  # fmt: skip
    assert code == 3
    assert said in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("direction", ["eastbound", "nach Osten"])
def test_directions_of_counts_are_read_in_any_language(dataset, given, language, direction):
    sections, counts = given(
        "section,direction,begin,end,volume\n"
        f"late,{direction},2023-11-14 22:00,2023-11-14 22:05,3\n"
    )
    made = gr.make_traffic(
        dataset, interval="5min", sections=sections, hand_counts=counts, language=language
    )
    expected = {"en": "eastbound", "de": "nach Osten"}[language]
    assert made.hand_counts["direction"].tolist() == [expected]
    assert made.hand_counts["volume"].notna().all()


def test_a_section_that_ends_inside_a_lane_is_named(dataset):
    """It crosses the way straight on, and stops before the middle of that to the left."""
    listener = Listener()
    dataset.count_sections(ACROSS, reporter=listener)
    assert listener.lines == []
    found = dataset.count_sections(lines(short=[(80, -5), (80, 8.5)]), reporter=listener)
    assert found["counted"].sum() == 5
    assert [str(line) for line in listener.lines] == [
        f"section short ends inside lane {LEFT}, which it does not count; draw it across the lane"
    ]


@pytest.mark.parametrize("at_m", [60.0, 70.0])
def test_a_section_that_ends_on_the_bounds_of_its_lane_is_not_named(dataset, at_m):
    """Snapped to the map, it touches the lanes beyond: those that begin there, or lie beside."""
    listener = Listener()
    dataset.count_sections(lines(snapped=[(at_m, -1.5), (at_m, 1.5)]), reporter=listener)
    assert listener.lines == []

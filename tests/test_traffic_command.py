"""`gis-radar traffic`: tables, a workbook, layers for QGIS, and files that SUMO reads."""

import csv
import json
import re
import sqlite3
import zipfile
from contextlib import closing, nullcontext
from dataclasses import replace
from itertools import combinations
from textwrap import wrap
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from datasets import HOUR, write_dataset
from driven import driven
from forks import (
    APPROACH,
    LEFT,
    LINE_M,
    STRAIGHT,
    crossing,
    fork,
    fork_dataset,
    fork_lanes,
    through,
)
from maps import EAST, NORTH, Listener
from shapely import LineString, box
from shapely.affinity import rotate
from sites import pose

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import LaneTraffic
from gis_radar.dataset.hours.remarks import remark_on_counting_lines
from gis_radar.products import Traffic, publisher_of, traffic_picture
from gis_radar.products import traffic as traffic_module
from gis_radar.products.report.results import traffic_of
from gis_radar.products.sumo import write_mean_data
from gis_radar.products.traffic_picture import draw_turning_diagram
from simulation.sumo import run as run_sumo

BEGIN = HOUR * STEPS_PER_HOUR
CARS = {STRAIGHT: 5, LEFT: 3}
FILES = {
    "traffic.csv", "turns.csv", "traffic.xlsx", "traffic.gpkg", "sumo.edgedata.xml",
    "sumo.lanedata.xml", "sumo.turns.xml", "turns.png",
}  # fmt: skip
SHEET = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Eight cars in the first quarter of an hour, each a minute after the last, and one later."""
    exits = [lane for lane, count in CARS.items() for _ in range(count)]
    tracks = [through(n, BEGIN + 1200 * n, lane) for n, lane in enumerate(exits)]
    tracks.append(through(90, BEGIN + 20_000, LEFT))
    folder = tmp_path_factory.mktemp("fork") / "dataset"
    return fork_dataset(folder, tracks, timezone="Europe/Berlin")


@pytest.fixture
def written(run, dataset, tmp_path):
    """Run the command; give its folder and its last line."""

    def call(*options):
        code, out, _ = run("traffic", dataset.folder, "-o", tmp_path / "out", "--json", *options)
        assert code == 0, out
        return tmp_path / "out", json.loads(out.splitlines()[-1])

    return call


def sheet_of(path, number):
    """Read a sheet by the standard library: rows of cells, texts told from numbers."""
    with zipfile.ZipFile(path) as file:
        shared = ET.fromstring(file.read("xl/sharedStrings.xml"))  # noqa: S314 - ours
        texts = ["".join(each.itertext()).strip() for each in shared.iter(f"{SHEET}si")]
        root = ET.fromstring(file.read(f"xl/worksheets/sheet{number}.xml"))  # noqa: S314
        names = re.findall(r'<sheet name="([^"]*)"', file.read("xl/workbook.xml").decode())
    assert root.find(f".//{SHEET}f") is None  # no formula
    rows = []
    for row in root.iter(f"{SHEET}row"):
        cells = {}
        for cell in row.iter(f"{SHEET}c"):
            value = cell.find(f"{SHEET}v").text.strip()
            column = re.match("[A-Z]+", cell.get("r"))[0]
            cells[column] = texts[int(value)] if cell.get("t") == "s" else float(value)
        rows.append(cells)
    return names, rows


def test_all_files_are_named_and_there(written):
    folder, last = written()
    assert {path.name for path in folder.iterdir()} == FILES
    assert [*map(str, sorted(folder.iterdir()))] == sorted(last["outputs"])
    summary = last["summary"]
    assert summary["lanes"] == 3
    assert summary["turns"] == 2
    assert summary["vehicles_at_stop_lines"] == 9
    assert summary["begin"] == "2023-11-14T22:00:00Z"


def test_without_a_visible_stop_line_none_are_counted_at_one(dataset):
    made = gr.make_traffic(dataset)
    lanes = made.lanes.assign(queue_max_m=np.nan)
    assert Traffic(lanes=lanes, turns=made.turns).figures()["vehicles_at_stop_lines"] is None


def test_verbs_take_a_dataset_or_its_folder(dataset):
    folder = str(dataset.folder)
    pd.testing.assert_frame_equal(gr.make_traffic(folder).turns, gr.make_traffic(dataset).turns)
    assert repr(gr.make_heatmap(folder)) == repr(gr.make_heatmap(dataset))
    assert repr(gr.measure_quality(folder)) == repr(gr.measure_quality(dataset))
    assert gr.open_dataset(dataset) is dataset


def test_traffic_reads_as_one_line_and_as_a_card(dataset):
    made = gr.make_traffic(dataset)
    known = made.figures()
    assert repr(made) == (
        f"Traffic({known['begin']} to {known['end']}: {known['lanes']} lanes, "
        f"{known['turns']} turns, {known['intervals']} intervals)"
    )
    assert "vehicles at stop lines" in made._repr_html_()


def test_an_interval_that_is_a_number_is_named(dataset):
    with pytest.raises(gr.UsageError, match="interval is 15, expected a text"):
        dataset.traffic(15)


def test_tables_are_those_of_the_dataset(written, dataset):
    folder, _ = written()
    rows = list(csv.DictReader((folder / "traffic.csv").open(encoding="utf-8")))
    first = rows[0]
    assert first["name"] == "'=Ring eastbound, lane 1 (left turn and straight ahead)"
    assert first["begin"] == "2023-11-14T23:00:00+01:00"
    assert first["counted"] == "8"
    assert float(first["speed_kmh"]) == pytest.approx(36.0, rel=1e-3)
    turns = pd.read_csv(folder / "turns.csv")
    assert turns["turn"].unique().tolist() == ["straight"]  # 25 degrees are no turn
    assert turns["volume"].tolist()[:1] == [5.0]
    both = turns[turns["begin"] == turns["begin"].min()]
    assert both.set_index("to_lane")["volume"].to_dict() == {STRAIGHT: 5.0, LEFT: 3.0}
    assert len(rows) == len(dataset.traffic())


def test_german_spreadsheets_open_the_table(written):
    folder, _ = written("--csv-locale", "de", "--language", "de")
    text = (folder / "traffic.csv").read_text(encoding="utf-8-sig")
    assert text.splitlines()[1].startswith("10;'=Ring nach Osten, Fahrstreifen 1 (links ab und ")
    assert ";1,0;" in text


def test_the_workbook_has_a_sheet_each_with_ids_and_names_as_text(written):
    folder, _ = written()
    names, lanes = sheet_of(folder / "traffic.xlsx", 1)
    assert names == ["Lanes", "Turns", "Notes"]
    head, first = lanes[0], lanes[1]
    titles = {title: column for column, title in head.items()}
    assert first[titles["Lane (id)"]] == "10"
    assert first[titles["Lane"]].startswith("=Ring eastbound")  # text, as it has no <f>
    assert first[titles["Counted [veh]"]] == 8.0
    assert titles["Mean speed on the lane [km/h]"]
    day = pd.Timestamp("1899-12-30") + pd.to_timedelta(first[titles["Begin (Europe/Berlin)"]], "D")
    assert day.round("s") == pd.Timestamp("2023-11-14 23:00")
    _, turns = sheet_of(folder / "traffic.xlsx", 2)
    assert [row["A"] for row in turns[1:]] == ["10"] * 4
    _, notes = sheet_of(folder / "traffic.xlsx", 3)
    assert notes[0]["A"] == "How to read these figures"
    assert "say nothing about other hours or days" in notes[-1]["A"]


def test_numbers_of_approaches_that_meet_do_not_lie_on_each_other():
    """Three lanes that end in one place, a few degrees apart."""
    from matplotlib.figure import Figure

    ends = [(-60.0, 0.0), (-60.0, 4.0), (-60.0, -4.0)]
    lines = [LineString([end, (0.0, 0.0)]) for end in ends]
    ways = [LineString([(0.0, 0.0), (-x / 6.0, -y / 6.0)]) for x, y in ends]
    lanes = gpd.GeoDataFrame({"lane": [1, 2, 3]}, geometry=lines, crs=25832)
    known = gpd.GeoDataFrame(
        {"from_lane": [1, 2, 3], "to_lane": [4, 5, 6], "turn": ["straight"] * 3,
         "volume_veh_h": [100.0] * 3, "error_veh_h": [10.0] * 3},
        geometry=ways, crs=25832,
    )  # fmt: skip
    figure = Figure((10.0, 10.0), dpi=100)
    axes = draw_turning_diagram(figure, lanes, known)
    figure.canvas.draw()
    areas = []
    for text in axes.texts:
        x, y = axes.transData.transform(text.get_position())
        turned = text.get_rotation()
        text.set_rotation(0.0)
        extent = text.get_window_extent()
        flat = box(x - extent.width, y - 0.4 * extent.height, x, y + 0.4 * extent.height)
        areas.append(rotate(flat, turned, origin=(x, y)))
    assert len(areas) == 3
    assert not any(one.intersects(other) for one, other in combinations(areas, 2))


def test_numbers_that_find_no_room_before_their_junction_are_left_out():
    """Two lanes end in one place; a junction lies between them and the room farther back."""
    from matplotlib.figure import Figure

    lines = [LineString([(-60.0, y), (0.0, 0.0)]) for y in (0.0, 1.0)]
    ways = [LineString([(0.0, 0.0), (10.0, y)]) for y in (0.0, -1.0)]
    across = LineString([(-18.0, 10.0), (-18.0, -10.0)])
    lanes = gpd.GeoDataFrame({"lane": [1, 2, 3]}, geometry=[*lines, across], crs=25832)
    known = gpd.GeoDataFrame(
        {"from_lane": [1, 2, 3], "to_lane": [4, 5, 6], "turn": ["straight"] * 3,
         "volume_veh_h": [100.0] * 3, "error_veh_h": [10.0] * 3},
        geometry=[*ways, across], crs=25832,
    )  # fmt: skip
    figure = Figure((10.0, 10.0), dpi=100)
    assert len(draw_turning_diagram(figure, lanes, known).texts) == 2
    figure = Figure((10.0, 10.0), dpi=100)
    assert len(draw_turning_diagram(figure, lanes, known[:2]).texts) == 2


def test_title_and_foot_of_the_diagram_lie_on_no_numbers(monkeypatch, tmp_path):
    """Of lanes that lead down into a junction and up into one the numbers reach far."""
    from matplotlib.figure import Figure

    ways = [LineString([(0.0, 0.0), (0.0, -10.0)]), LineString([(30.0, -100.0), (30.0, -90.0)])]
    begin = pd.Timestamp("2026-10-05 07:00", tz="Europe/Berlin")
    names = ["straight", "left", "right", "back"]
    turns = gpd.GeoDataFrame(
        {"from_lane": [1] * 4 + [2] * 4, "to_lane": [3, 4, 5, 6] * 2, "turn": names * 2,
         "begin": begin, "end": begin + pd.Timedelta("15min"), "volume": 100.0, "volume_se": 10.0,
         "volume_veh_h": 400.0},
        geometry=[way for way in ways for _ in names], crs=25832,
    )  # fmt: skip
    figure = Figure((10.0, 10.0), dpi=100, layout="constrained")
    monkeypatch.setattr(traffic_picture, "picture_file", lambda *_, **__: nullcontext(figure))
    traffic_picture.write_turning_diagram(turns[["geometry"]], turns, tmp_path / "turns.png")
    figure.savefig(tmp_path / "drawn.png")
    (axes,) = figure.axes
    numbers = [text.get_window_extent() for text in axes.texts]
    around = [text.get_window_extent() for text in figure.texts]
    assert max(each.y1 for each in numbers) > axes.bbox.y1  # else there is nothing to test
    assert min(each.y0 for each in numbers) < axes.bbox.y0
    assert len(around) == 2
    assert not any(each.overlaps(other) for each in numbers for other in around)


def test_the_workbook_shows_heads_and_whole_times(written):
    folder, _ = written()
    with zipfile.ZipFile(folder / "traffic.xlsx") as file:
        sheets = [file.read(name) for name in file.namelist() if "/worksheets/" in name]
    assert sheets
    for sheet in map(ET.fromstring, sheets):
        pane = sheet.find(f"{SHEET}sheetViews/{SHEET}sheetView/{SHEET}pane")
        assert (pane.get("state"), pane.get("ySplit")) == ("frozen", "1")
        wide = [each for each in sheet.iter(f"{SHEET}col") if float(each.get("width")) > 19.0]
        assert wide  # columns of times, which are ### where they do not fit


def test_the_workbook_can_be_read_on_paper(written):
    """Each page names its rows and columns; numbers have the digits that mean something."""
    folder, _ = written()
    with zipfile.ZipFile(folder / "traffic.xlsx") as file:
        sheet = ET.fromstring(file.read("xl/worksheets/sheet1.xml"))  # noqa: S314 - ours
        book, styles = (file.read(f"xl/{name}.xml").decode() for name in ("workbook", "styles"))
    page = sheet.find(f"{SHEET}pageSetup")
    assert page.get("orientation") == "landscape"
    assert 2 <= int(page.get("fitToWidth", "1")) <= 5
    assert page.get("fitToHeight") == "0"  # as many as the rows need
    assert "Lanes!$A:$B,Lanes!$1:$1" in book
    assert 'formatCode="0.0"' in styles
    assert 'formatCode="0.000"' in styles  # an occupancy of 0.4 % is not shown as 0
    for cell_format in ET.fromstring(styles).find(f"{SHEET}cellXfs"):  # noqa: S314 - ours
        assert cell_format.find(f"{SHEET}alignment").get("vertical") == "top"
    shown = {
        column: each.get("style")
        for each in sheet.iter(f"{SHEET}col")
        for column in range(int(each.get("min")), int(each.get("max")) + 1)
    }
    names = list(sheet_of(folder / "traffic.xlsx", 1)[1][0].values())
    share, volume, name = (
        shown[names.index(title) + 1]
        for title in ("Visible share [0-1]", "Volume, estimated [veh]", "Lane")
    )
    assert len({share, volume, name}) == 3


def test_titles_of_the_workbook_stand_over_their_values(written):
    """Numbers are on the right, and text that follows one does not touch it."""
    folder, _ = written()
    _, lanes = sheet_of(folder / "traffic.xlsx", 1)
    with zipfile.ZipFile(folder / "traffic.xlsx") as file:
        sheet, styles = (
            ET.fromstring(file.read(f"xl/{name}.xml"))  # noqa: S314 - ours
            for name in ("worksheets/sheet1", "styles")
        )
    formats = [each.find(f"{SHEET}alignment") for each in styles.find(f"{SHEET}cellXfs")]
    heads = [formats[int(each.get("s"))] for each in next(sheet.iter(f"{SHEET}row"))]
    titles = dict(zip(lanes[0].values(), heads, strict=True))
    assert titles["Counted [veh]"].get("horizontal") == "right"
    assert titles["Volume, estimated [veh]"].get("horizontal") == "right"
    assert titles["Lane"].get("horizontal") == "left"
    columns = {
        int(each.get("min")): formats[int(each.get("style"))] for each in sheet.iter(f"{SHEET}col")
    }
    assert list(titles).index("Stop line") + 1 in columns
    assert columns[list(titles).index("Stop line") + 1].get("indent") == "1"
    assert titles["Stop line"].get("indent") == "1"


def test_the_workbook_speaks_german(written):
    """Its titles are read whole: no word is wider than its column, no line below the row's end."""
    folder, _ = written("--language", "de", "--headways")
    with zipfile.ZipFile(folder / "traffic.xlsx") as file:
        sheet = ET.fromstring(file.read("xl/worksheets/sheet1.xml"))  # noqa: S314 - ours
    widths = [float(each.get("width")) for each in sheet.iter(f"{SHEET}col") for _ in
              range(int(each.get("min")), int(each.get("max")) + 1)]  # fmt: skip
    height = float(sheet.find(f"{SHEET}sheetData/{SHEET}row").get("ht"))
    names, lanes = sheet_of(folder / "traffic.xlsx", 1)
    assert names == ["Fahrstreifen", "Abbiegen", "Hinweise"]
    assert "Verkehrsstärke [Kfz/h]" in lanes[0].values()
    assert "eingezeichnet" in lanes[1].values()
    for title, width in zip(lanes[0].values(), widths, strict=True):
        lines = wrap(title, int(width / 1.2), break_long_words=False)
        assert max(map(len, lines)) <= width / 1.15
        assert len(lines) <= height / 15


def test_layers_have_times_in_utc_and_a_style(written, dataset):
    folder, _ = written()
    lanes = gpd.read_file(folder / "traffic.gpkg", layer="lanes")
    turns = gpd.read_file(folder / "traffic.gpkg", layer="turns")
    assert lanes.crs == dataset.crs
    assert lanes["begin"].iloc[0] == pd.Timestamp("2023-11-14T22:00Z")
    assert lanes["counted"].iloc[0] == 8
    assert turns.geometry.length.round(3).eq(16.0).all()  # 1 m before the line, 15 m of the exit
    with closing(sqlite3.connect(folder / "traffic.gpkg")) as database:
        styles = dict(database.execute("SELECT f_table_name, styleQML FROM layer_styles"))
    assert styles.keys() == {"lanes", "turns"}
    for qml in styles.values():
        assert 'attr="volume_veh_h"' in qml
        assert ET.fromstring(qml.partition("\n")[2]) is not None  # noqa: S314 - ours
    assert 'fixedDuration="899990"' in styles["lanes"]


def test_sumo_reads_back_the_same_turns(written, tmp_path, sumo_installed):
    folder, _ = written("--end", "2023-11-14 23:15")
    nodes = [("a", 0, 0), ("b", 60, 0), ("c", 100, 0), ("d", 96, 17)]
    edges = [(APPROACH, "a", "b"), (STRAIGHT, "b", "c"), (LEFT, "b", "d")]
    files = {
        "n.xml": "<nodes>" + "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, x, y in nodes)
        + "</nodes>",
        "e.xml": "<edges>" + "".join(f'<edge id="{e}" from="{a}" to="{b}"/>' for e, a, b in edges)
        + "</edges>",
        "f.xml": f'<routes><flow id="f" from="{APPROACH}" begin="0" end="900" number="8"/>'
        "</routes>",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    at = {name: str(tmp_path / name) for name in (*files, "net.xml", "routes.xml")}
    run_sumo("netconvert", ["-n", at["n.xml"], "-e", at["e.xml"], "-o", at["net.xml"]])
    run_sumo("jtrrouter", [
        "-n", at["net.xml"], "-r", at["f.xml"], "--turn-ratio-files",
        str(folder / "sumo.turns.xml"), "--accept-all-destinations", "-o", at["routes.xml"],
        "--seed", "3",
    ])  # fmt: skip
    routes = ET.parse(at["routes.xml"]).iter("route")  # noqa: S314 - SUMO's
    taken = pd.Series([each.get("edges").split()[-1] for each in routes]).value_counts()
    assert taken.sum() == 8
    assert set(taken.index) == {str(STRAIGHT), str(LEFT)}
    root = ET.parse(folder / "sumo.turns.xml").getroot()  # noqa: S314 - ours
    counts = {each.get("to"): float(each.get("count")) for each in root.iter("edgeRelation")}
    assert counts == {str(lane): count for lane, count in CARS.items()}


def test_edges_and_lanes_carry_the_measures(written):
    folder, _ = written()
    edges = ET.parse(folder / "sumo.edgedata.xml").getroot()  # noqa: S314 - ours
    first = edges.find("interval")
    assert (first.get("begin"), first.get("end")) == ("0.00", "900.00")
    assert first.find("edge").get("entered") == "8.00"
    assert float(first.find("edge").get("speed")) == pytest.approx(10.0, abs=0.05)
    lanes = ET.parse(folder / "sumo.lanedata.xml").getroot()  # noqa: S314 - ours
    assert lanes.find("interval/edge/lane").get("id") == "10_0"


def test_a_line_that_is_seen_straight_across_has_a_larger_error(tmp_path):
    """There a range rate does not tell who sets off; by 12 m along the lane it does."""
    tracks = [through(n, BEGIN + 1200 * n, STRAIGHT) for n in range(4)]
    east, north = EAST + 60.0, NORTH - 30.0
    datasets = [
        fork_dataset(
            tmp_path / str(ahead), tracks, seen_from=pose(easting=east - ahead, northing=north)
        )
        for ahead in (0.0, 12.0)
    ]
    listener = Listener()
    for each in datasets:
        tiles = each.tiles().sort_values("tile_id", ignore_index=True)
        remark_on_counting_lines(each, tiles, each.lanes(), listener)
    (said,) = listener.lines
    assert said.startswith(f"lane {APPROACH}: every sensor looks straight across")
    across, along = (each.traffic() for each in datasets)
    volume = across["volume"].iloc[0]
    assert volume == along["volume"].iloc[0] >= 4
    more = across["volume_se"].iloc[0] ** 2 - along["volume_se"].iloc[0] ** 2
    assert np.sqrt(more) == pytest.approx(0.33 * volume, rel=0.01)
    assert across["volume_se"].iloc[1:].equals(along["volume_se"].iloc[1:])


# What is in what and in which order, by the schemas of DATEX II 3.2 to 3.5.
DATEX_ORDER = {
    "payload": "publicationTime publicationCreator measurementSiteTableReference headerInformation "
    "measurementSiteTable siteMeasurements",
    "publicationCreator": "country nationalIdentifier",
    "headerInformation": "informationStatus",
    "measurementSiteTable": "measurementSite",
    "measurementSite": "measurementSiteName measurementSiteNumberOfLanes "
    "measurementSpecificCharacteristics measurementSiteLocation",
    "measurementSiteName": "values",
    "values": "value",
    "measurementSpecificCharacteristics": "measurementSpecificCharacteristics period "
    "specificMeasurementValueType",
    "measurementSiteLocation": "gmlLineString",
    "gmlLineString": "posList",
    "siteMeasurements": "measurementSiteReference physicalQuantity measurementTimeDefault",
    "physicalQuantity": "physicalQuantity basicData",
    "basicData": "percentageLongVehicles vehicleFlow averageVehicleSpeed speedPercentile density "
    "occupancy",
    "vehicleFlow": "vehicleFlowRate",
    "averageVehicleSpeed": "speed",
    "speedPercentile": "vehiclePercentage speedPercentile speed",
    "density": "densityOfVehicles",
    **dict.fromkeys(("percentageLongVehicles", "vehiclePercentage", "occupancy"), "percentage"),
    "measurementTimeDefault": "timeMeaning timeValue period",
    "period": "startOfPeriod endOfPeriod",
}


def test_datex_sends_the_table_of_sites_and_what_is_measured(written, dataset):
    folder, last = written("--datex", "DE:City of Example")
    assert {"datex.sites.xml", "datex.measured.xml"} <= {path.name for path in folder.iterdir()}
    assert len(last["outputs"]) == len(FILES) + 2
    sites, measured = (
        ET.parse(folder / f"datex.{name}.xml").getroot()  # noqa: S314 - ours
        for name in ("sites", "measured")
    )
    for each in (*sites.iter(), *measured.iter()):
        children = [child.tag.partition("}")[2] for child in each]
        order = DATEX_ORDER.get(each.tag.partition("}")[2], "").split()
        assert [order.index(child) for child in children] == sorted(map(order.index, children))
    lanes = dataset.traffic()
    assert len(measured.findall("{*}siteMeasurements")) == len(lanes)
    names = {each.get("id"): each.find(".//{*}value").text for each in sites.iter() if
             each.tag.endswith("}measurementSite")}  # fmt: skip
    assert names == dict(zip(lanes["lane"].astype(str), lanes["name"], strict=True))
    first, row = measured.find("{*}siteMeasurements"), lanes.iloc[0]
    assert first.find("{*}measurementSiteReference").get("id") == str(row["lane"])
    flow = first.find(".//{*}vehicleFlow")
    assert flow.get("numberOfInputValuesUsed") == "8"
    accuracy = 100 - 100 * row["volume_se"] / row["volume"]
    assert float(flow.get("accuracy")) == pytest.approx(accuracy, abs=0.06)
    assert flow.find("{*}vehicleFlowRate").text == str(round(row["volume_veh_h"]))
    occupancy = first.find(".//{*}occupancy/{*}percentage").text
    assert float(occupancy) == pytest.approx(100 * row["occupancy"], abs=0.01)
    assert first.find(".//{*}startOfPeriod").text == "2023-11-14T22:00:00Z"
    line = sites.find(".//{*}posList").text.split()
    assert [float(each) for each in line[:2]] == pytest.approx(
        [*lanes.to_crs(4326).geometry.iloc[0].coords[0]][1::-1], abs=1e-6
    )


def test_datex_is_xml_whatever_a_street_is_called(dataset, tmp_path):
    """Layers of streets may hold characters that XML cannot."""
    traffic = gr.make_traffic(dataset)
    named = replace(traffic, lanes=traffic.lanes.assign(name="<a>\0\x0b\ufffe&\U0001f697"))
    named.write(tmp_path / "out", datex="fr:Ville")
    root = ET.parse(tmp_path / "out" / "datex.sites.xml").getroot()  # noqa: S314 - ours
    assert "<a>\ufffd\ufffd\ufffd&\U0001f697" in {each.text for each in root.iter()}


def test_datex_has_another_version_for_another_table_of_sites(dataset, tmp_path):
    def versions(traffic):
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        traffic.write(folder, datex="fr:Ville")
        texts = [(folder / f"datex.{name}.xml").read_text() for name in ("sites", "measured")]
        found = {each for text in texts for each in re.findall(r' version="(\w+)"', text)}
        assert len(found) == 1
        return found

    quarters, minutes = gr.make_traffic(dataset), gr.make_traffic(dataset, interval="5min")
    one = quarters.lanes["lane"] == quarters.lanes["lane"].iloc[0]
    fewer = Traffic(lanes=quarters.lanes[~one], turns=quarters.turns)
    emptied = quarters.lanes.assign(volume_veh_h=np.nan)
    assert versions(quarters) == versions(Traffic(lanes=emptied, turns=quarters.turns))
    assert len(set.union(*map(versions, (quarters, minutes, fewer)))) == 3


def test_datex_leaves_out_what_is_null(dataset, tmp_path):
    made = gr.make_traffic(dataset)
    lanes = made.lanes.assign(volume_veh_h=np.nan, speed_time_mean_kmh=np.nan)
    Traffic(lanes=lanes, turns=made.turns).write(tmp_path / "out", datex="fr:Ville")
    text = (tmp_path / "out" / "datex.measured.xml").read_text()
    assert "vehicleFlow" not in text
    assert "averageVehicleSpeed" not in text
    assert "occupancy" in text


def test_a_publisher_has_any_letters():
    assert publisher_of(' De : Köln "A" <b>: c') == ("de", 'Köln "A" <b>: c')


def test_an_earlier_result_with_more_files_is_replaced(written):
    written("--datex", "DE:City of Example", "--cycles")
    folder, _ = written()
    assert {path.name for path in folder.iterdir()} == FILES


def test_rows_that_no_sheet_holds_are_left_to_the_tables(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(traffic_module, "SHEET_ROWS", 2)
    listener = Listener()
    made = gr.make_traffic(dataset)
    names = {path.name for path in made.write(tmp_path / "out", reporter=listener)}
    assert names == FILES - {"traffic.xlsx"}
    (said,) = listener.lines
    assert said.startswith(f"traffic.xlsx is left out: {len(made.lanes)} rows, and a sheet holds 2")


@pytest.mark.parametrize(
    "publisher",
    ["City of Example", "DEU:City", "DE:", "D1:City", "ÄÖ:City", "DE:a\x01b", f"DE:{'ä' * 1025}"],
)
def test_a_publisher_is_a_country_and_a_name(run, dataset, tmp_path, publisher):
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", "--datex", publisher)
    assert code == 2
    assert "expected a country and a name such as 'DE:City of Example'" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("interval", ["1min", "15min", "24h"])
def test_the_diagram_has_the_figures_of_the_report(dataset, tmp_path, monkeypatch, interval):
    drawn = []
    monkeypatch.setattr(
        traffic_picture, "draw_turning_diagram", lambda *given: drawn.append(given[2])
    )
    gr.make_traffic(dataset, interval=interval).write(tmp_path / "out")
    reported = traffic_of(dataset, gr.make_heatmap(dataset))
    its = reported.by_turn.assign(error_veh_h=reported.by_turn["volume_se"] / reported.hours)
    columns = ["from_lane", "to_lane", "begin", "end", "volume_veh_h", "error_veh_h"]
    pd.testing.assert_frame_equal(drawn[0][columns], its[columns])
    assert (its["volume_veh_h"] > 0.0).all()


def test_without_volumes_there_is_no_diagram(dataset, tmp_path):
    made = gr.make_traffic(dataset)
    made = replace(made, whole_turns=made.whole_turns.assign(volume=np.nan))
    assert {path.name for path in made.write(tmp_path / "out")} == FILES - {"turns.png"}


def test_an_hour_is_measured_once_for_all_tables(dataset, tmp_path, monkeypatch):
    measured, finer = [], LaneTraffic.finer
    monkeypatch.setattr(
        LaneTraffic, "finer", lambda *given: measured.append(given[1].hour) or finer(*given)
    )
    gr.make_traffic(gr.open_dataset(dataset.folder), interval="1min")
    assert len(measured) == len(set(measured))


def test_a_recording_too_short_for_its_intervals_is_told(run, dataset, tmp_path):
    words = ["traffic", dataset.folder, "-o", tmp_path / "out", "--interval", "24h"]
    code, _, err = run(*words)
    assert code == 0
    assert "warning: no interval was visible for a fifth" in err
    _, out, _ = run(*words, "--json")  # QGIS shows it, too
    assert any("take a shorter interval" in json.loads(line).get("message", "")
               for line in out.splitlines())  # fmt: skip


@pytest.mark.parametrize("line_m", [np.nan, LINE_M])
def test_a_map_without_stop_lines_is_named_as_why_there_are_no_queues(run, tmp_path, line_m):
    tracks = [through(n, HOUR * STEPS_PER_HOUR + 1200 * n, STRAIGHT) for n in range(3)]
    dataset = driven(
        tmp_path / "data", fork(), pd.concat(tracks), lanes=fork_lanes(line_m)
    )  # fmt: skip
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", "--interval", "1min")
    assert code == 0
    assert ("the map has no stop line" in err) == np.isnan(line_m)


def test_queues_and_the_counts_of_stop_lines_tell_drawn_from_presumed_ones(tmp_path):
    tiles, lanes = crossing()
    tracks = pd.concat([through(n, HOUR * STEPS_PER_HOUR + 1200 * n, STRAIGHT) for n in range(3)])
    dataset = driven(tmp_path / "data", tiles, tracks, lanes=lanes)
    queues = dataset.queues("1min")
    assert set(zip(queues["lane"], queues["stop_line"], strict=True)) == {
        (APPROACH, "presumed"), (40, "presumed")
    }  # fmt: skip
    assert gr.make_traffic(dataset, interval="1min").figures()["vehicles_at_stop_lines"] is None


@pytest.mark.parametrize(
    ("options", "code", "text"),
    [
        (["--interval", "7min"], 2, "neither a part of 15 min"),
        (["--begin", "2030-01-01"], 3, "nothing was measured in that time"),
        (
            ["--begin", "2023-11-14 23:59", "--end", "2023-11-15"],
            3,
            "the nearest recording goes from 2023-11-14T22:00:00Z",
        ),
        (["--begin", "2023-11-15", "--end", "2023-11-14"], 2, "is not after begin"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(run, dataset, tmp_path, options, code, text):
    got, _, err = run("traffic", dataset.folder, "-o", tmp_path / "out", *options)
    assert got == code
    assert text in " ".join(err.split())
    assert not (tmp_path / "out").exists()


def test_a_folder_with_files_of_others_stays(run, dataset, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    code, _, err = run("traffic", dataset.folder, "-o", tmp_path)
    assert code == 3
    assert "mine.txt" in err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_dataset_of_hits_alone_is_refused(run, tmp_path):
    folder = write_dataset(tmp_path / "data", hours=[HOUR], vehicles=False).folder
    code, _, err = run("traffic", folder, "-o", tmp_path / "out")
    assert code == 3
    assert "holds no vehicles" in err


def test_a_file_of_the_dataset_is_not_replaced(run, dataset):
    before = {path: path.read_bytes() for path in dataset.folder.rglob("*") if path.is_file()}
    for name, more in (("query", ["SELECT 1 AS a"]), ("quality", []), ("footprints", [])):
        kind = "*.gpkg" if name == "footprints" else "*.parquet"
        output = next(dataset.folder.rglob(kind))
        code, _, err = run(name, dataset.folder, *more, "-o", output)
        assert code == 3
        assert f"would replace the input {output}" in err
    assert all(path.read_bytes() == content for path, content in before.items())


EDGES = {"in": (APPROACH, "a", "b"), "on": (STRAIGHT, "b", "c"), "off": (LEFT, "b", "d")}


def network(tmp_path, *, projection="+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs"):
    """Write a network of SUMO under the fork, with edges of two lanes where it has one."""
    nodes = [("a", 0, 0), ("b", 60, 0), ("c", 100, 0), ("d", 96.25, 17)]
    files = {
        "n.xml": "<nodes>" + "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, x, y in nodes)
        + "</nodes>",
        "e.xml": "<edges>" + "".join(
            f'<edge id="{e}" from="{a}" to="{b}" spreadType="center"/>'
            for e, (_, a, b) in EDGES.items()
        ) + "</edges>",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    at = {name: str(tmp_path / name) for name in (*files, "net.xml")}
    run_sumo("netconvert", ["-n", at["n.xml"], "-e", at["e.xml"], "-o", at["net.xml"],
                            "--offset.disable-normalization"])  # fmt: skip
    path = tmp_path / "net.xml"
    text = re.sub('netOffset="[^"]*"', f'netOffset="{-EAST},{-NORTH}"', path.read_text())
    path.write_text(text.replace('projParameter="!"', f'projParameter="{projection}"'))
    return path


def test_files_for_sumo_name_the_edges_of_a_network(written, tmp_path, sumo_installed):
    net = network(tmp_path)
    folder, last = written("--sumo-net", net, "--end", "2023-11-14 23:15")
    assert last["summary"]["lanes_on_network"] == 3
    edges = ET.parse(folder / "sumo.edgedata.xml").getroot()  # noqa: S314 - ours
    entered = {each.get("id"): each.get("entered") for each in edges.iter("edge")}
    assert entered["in"] == "8.00"
    lanes = ET.parse(folder / "sumo.lanedata.xml").getroot()  # noqa: S314 - ours
    assert {each.get("id") for each in lanes.iter("lane")} == {"in_0", "on_0", "off_0"}
    (tmp_path / "f.xml").write_text(
        '<routes><flow id="f" from="in" begin="0" end="900" number="8"/></routes>'
    )
    run_sumo("jtrrouter", [
        "-n", str(net), "-r", str(tmp_path / "f.xml"), "--turn-ratio-files",
        str(folder / "sumo.turns.xml"), "--accept-all-destinations", "--seed", "3",
        "-o", str(tmp_path / "routes.xml"),
    ])  # fmt: skip
    routes = ET.parse(tmp_path / "routes.xml").iter("route")  # noqa: S314 - SUMO's
    assert {each.get("edges").split()[-1] for each in routes} == {"on", "off"}


def test_networks_of_no_projection_or_of_another_place_are_refused(
    run, dataset, tmp_path, sumo_installed
):
    def refused(path):
        options = ("traffic", dataset.folder, "-o", tmp_path / "out", "--sumo-net", path)
        code, _, err = run(*options)
        assert not (tmp_path / "out").exists()
        return code, err

    for none in "!-":  # without one, and by degrees times a length
        code, err = refused(network(tmp_path, projection=none))
        assert code == 3
        assert "the network has no projection" in err
    code, err = refused(network(tmp_path, projection="+proj=utm +zone=33 +ellps=GRS80"))
    assert code == 4
    assert "no lane of the dataset lies on one of the network" in err
    (tmp_path / "bad.xml").write_text("<net><location")
    assert refused(tmp_path / "bad.xml")[0] == 3
    (tmp_path / "empty.xml").write_text("<net/>")
    assert "it has no lanes" in refused(tmp_path / "empty.xml")[1]


def test_an_edge_is_known_where_all_its_lanes_are(tmp_path):
    begin = pd.Timestamp("2026-01-01")
    lanes = pd.DataFrame(
        {
            "lane": [1, 2, 3], "begin": begin, "end": begin + pd.Timedelta("15min"),
            "volume": [10.0, 30.0, 5.0], "speed_kmh": [36.0, 72.0, np.nan],
            "flow_veh_h": [40.0, 120.0, 0.0], "occupancy": [0.1, 0.3, 0.2],
            "density_veh_km": [1.0, 2.0, 3.0], "travel_time_s": [6.0, 3.0, np.nan],
            "delay_s": [2.0, 1.0, np.nan], "geometry": None,
        }
    )  # fmt: skip
    edges = pd.DataFrame(
        {
            "lane": [1, 2, 3], "edge": ["two", "two", "half"],
            "sumo_lane": ["two_0", "two_1", "half_0"], "edge_lanes": 2,
            "counts": True, "place": "line", "as_long": True,
        }
    )  # fmt: skip
    path = tmp_path / "edgedata.xml"
    write_mean_data(lanes, edges, begin, path, by_lane=False)
    found = {each.get("id"): each.attrib for each in ET.parse(path).iter("edge")}  # noqa: S314
    assert found["two"] == {
        "id": "two", "entered": "40.00", "speed": "17.50", "occupancy": "20.00",
        "density": "3.00", "traveltime": "3.75", "timeLoss": "50.00",  # as SUMO's: of all vehicles
    }  # fmt: skip
    assert found["half"] == {"id": "half"}
    longer = edges.assign(as_long=[False, False, True])
    write_mean_data(lanes, longer, begin, path, by_lane=False)
    assert {"traveltime", "timeLoss"}.isdisjoint(ET.parse(path).find("*/edge").attrib)  # noqa: S314
    write_mean_data(lanes, edges, begin, path, by_lane=True)
    lane = ET.parse(path).find("interval/edge[@id='half']/lane")  # noqa: S314 - ours
    assert lane.attrib == {
        "id": "half_0", "entered": "5.00", "occupancy": "20.00", "density": "3.00"
    }  # fmt: skip


def test_turns_to_lanes_that_nobody_observes_are_written_for_sumo(dataset, tmp_path):
    made = gr.make_traffic(dataset)
    seen = made.lanes[made.lanes["lane"] != LEFT].reset_index(drop=True)
    replace(made, lanes=seen).write(tmp_path / "out")
    turns = ET.parse(tmp_path / "out" / "sumo.turns.xml").iter("edgeRelation")  # noqa: S314 - ours
    assert str(LEFT) in {each.get("to") for each in turns}

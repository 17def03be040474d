"""What a report says, against the tables that it was made from."""

from __future__ import annotations

import math
import re
import shutil
from itertools import pairwise

import geopandas as gpd
import numpy as np
import pandas as pd
import pypdf
import pytest
from report_site import FILES, Page, reports_of_whole_run, write_whole_run

import gis_radar as gr
from gis_radar.base import csv_for, write_csv


@pytest.fixture(scope="module")
def results(once):
    return once("whole run", write_whole_run)


@pytest.fixture(scope="module")
def made(once):
    report = reports_of_whole_run(once)["en"]
    folder = report.outputs[0].parent
    assert sorted(path.name for path in report.outputs) == FILES
    assert sorted(path.name for path in folder.iterdir()) == FILES
    return folder


@pytest.fixture(scope="module")
def page(made):
    return Page((made / "report.html").read_text(encoding="utf-8"))


def long_layer(folder):
    layer = gpd.read_file(folder / "heatmap" / "heatmap.gpkg", layer="by_interval")
    return pd.DataFrame(layer.drop(columns="geometry"))


LANES = {100: [100, 101], 102: [102], 103: [103]}  # by number, the smallest lanelet


def test_lanes_are_the_sums_of_their_tiles(results, made):
    rows = long_layer(results)
    table = pd.read_csv(made / "lanes.csv").set_index("lane")
    assert table.index.tolist() == sorted(LANES)  # hits rank no lane
    for lane, lanelets in LANES.items():
        mine = rows[rows["lanelet_id"].isin(lanelets)]
        assert str(table.loc[lane, "lanelets"]) == " ".join(map(str, lanelets))
        observed = mine["observed_s"].sum()
        assert table.loc[lane, "observed_tile_s"] == pytest.approx(observed, abs=0.006)
        if observed == 0:
            assert pd.isna(table.loc[lane, "hit_share"])
            continue
        share = mine["hit_s"].sum() / observed
        assert table.loc[lane, "hit_share"] == pytest.approx(share, abs=1e-6)
        by_tile = mine.groupby("tile_id")[["hit_s", "observed_s"]].sum()
        shares = by_tile["hit_s"] / by_tile["observed_s"].where(by_tile["observed_s"] > 0)
        assert table.loc[lane, "busiest_spot"] == pytest.approx(shares.max(), abs=1e-6)
        assert table.loc[lane, "over_20_percent_m"] == pytest.approx(0.5 * (shares >= 0.2).sum())
        assert table.loc[lane, "observed_m"] == pytest.approx(0.5 * shares.notna().sum())


def test_tables_for_german_spreadsheets_hold_the_same(results, made, tmp_path, blank_paper):
    gr.write_report(results, output=tmp_path, csv_locale="de")
    for name in ("lanes.csv", "lanes_by_interval.csv", "quality.csv"):
        assert (tmp_path / name).read_bytes().startswith(b"\xef\xbb\xbf")
        german = pd.read_csv(tmp_path / name, sep=";", decimal=",", encoding="utf-8-sig")
        pd.testing.assert_frame_equal(german, pd.read_csv(made / name))
    assert b"," in (tmp_path / "lanes.csv").read_bytes()
    with pytest.raises(gr.UsageError, match="csv_locale is 'fr', expected one of en, de"):
        gr.write_report(results, output=tmp_path, csv_locale="fr")


def test_numbers_of_numpy_are_numbers_of_a_spreadsheet(tmp_path):
    cells = [1.5, np.float32(2.5), np.float64(3.5), np.int64(4), np.float32("nan"), math.nan, "a.b",
             True, np.False_]  # fmt: skip
    with csv_for("de"):
        write_csv(tmp_path / "a.csv", pd.DataFrame([cells], dtype=object))
    line = (tmp_path / "a.csv").read_text(encoding="utf-8-sig").splitlines()[1]
    assert line == "1,5;2,5;3,5;4;;;a.b;WAHR;FALSCH"


def test_intervals_of_lanes(results, made):
    rows = long_layer(results)
    table = pd.read_csv(made / "lanes_by_interval.csv")
    assert len(table) == len(LANES) * rows["begin"].nunique()
    for _, row in table.iterrows():
        begin = pd.Timestamp(row["begin_utc"])
        assert pd.Timestamp(row["begin_local"]) == begin
        assert row["begin_local"].endswith("+02:00")
        mine = rows[rows["lanelet_id"].isin(LANES[row["lane"]]) & rows["begin"].eq(begin)]
        observed = mine["observed_s"].sum()
        if observed == 0:
            assert pd.isna(row["hit_share"])
        else:
            assert row["hit_share"] == pytest.approx(mine["hit_s"].sum() / observed, abs=1e-6)


def test_the_busiest_interval_is_that_of_the_table(made):
    lanes = pd.read_csv(made / "lanes.csv").set_index("lane")
    intervals = pd.read_csv(made / "lanes_by_interval.csv")
    for lane in (100, 102):
        mine = intervals[intervals["lane"].eq(lane)]
        best = mine.loc[mine["hit_share"].idxmax()]
        assert lanes.loc[lane, "busiest_begin_utc"] == best["begin_utc"]
        assert lanes.loc[lane, "busiest_hit_share"] == best["hit_share"]


def test_the_page_says_what_the_tables_say(made, page):
    lanes = pd.read_csv(made / "lanes.csv")
    (table,) = (each for each in page.tables if each[0][0] == "Lane")
    head, *rows = table
    seen = lanes[lanes["hit_share"].notna()]
    assert [int(row[0]) for row in rows] == seen["lane"].tolist()
    for row, (_, known) in zip(rows, seen.iterrows(), strict=True):
        shown = (
            row[head.index("Hit share of observed time")].replace("\u202f", "").removesuffix("%")
        )
        assert float(shown) == pytest.approx(100 * known["hit_share"], abs=0.05)
    assert len(lanes) - len(seen) == 1
    assert "1 lane of the map was not observed." in " ".join(page.words)


def test_times_are_those_of_the_site_and_said_so(page):
    text = " ".join(page.words)
    assert "All times: Europe/Berlin, UTC+02:00." in text
    assert "15 June 2025, 17:06:40 to 17:07:40" in text
    assert "17:07:00 to 17:07:20" in text
    assert "15:06" not in text


def test_the_page_shows_what_sensors_see(page):
    alts = [each["alt"] for each in page.all("img") if "in sight" in each.get("alt", "")]
    (alt,) = alts
    assert re.match(
        r"Maps of the tiles in sight of each sensor: R1 \d+ tiles in sight, \d+ hid", alt
    )


def test_sensors_have_their_sigma(page):
    (table,) = (each for each in page.tables if each[0][0] == "Sensor" and len(each[0]) == 8)
    assert [row[0] for row in table[1:]] == ["R1", "R2"]
    assert table[1][1] == "678\u202f000.00 ±\u202f0.25"
    assert table[1][4] == "east, 90.0° ±\u202f0.25°"
    assert "91\u202f% of the vehicle paths lie on the lanes" in table[1][7]


def test_quality_is_that_of_the_dataset(results, page, made):
    dataset = gr.open_dataset(results / "dataset")
    known = gr.measure_quality(dataset, timezone="Europe/Berlin").table
    written = pd.read_csv(made / "quality.csv")
    assert written["verdict"].tolist() == known["verdict"].tolist()
    assert written["frames"].tolist() == known["frames"].tolist()
    (table,) = (each for each in page.tables if each[0][-1] == "Verdict")
    assert [row[-1] for row in table[1:]] == known["verdict"].tolist()


def test_the_page_is_closed(made, page):
    text = (made / "report.html").read_text(encoding="utf-8")
    (policy,) = (each for each in page.all("meta") if "http-equiv" in each)
    assert policy["content"].startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert "unsafe" not in policy["content"]
    links = re.findall(r"(?:src|href)=\"(?!data:|#)([^\"]*)\"", text)
    assert sorted(links) == ["lanes.csv", "lanes_by_interval.csv", "quality.csv"]
    assert all((made / name).is_file() for name in links)
    assert text.count("url(") == text.count("url(#gaps-")  # a pattern within the page
    assert "@import" not in text


def test_the_page_is_readable_by_machines(page):
    assert page.all("html") == [{"lang": "en"}]
    assert page.tags.count("h1") == 1
    levels = [int(tag[1]) for tag in page.tags if re.fullmatch(r"h\d", tag)]
    assert all(after - before <= 1 for before, after in pairwise(levels))
    assert page.tags.count("caption") == page.tags.count("table") == len(page.tables)
    assert all(each.get("scope") in {"row", "col"} for each in page.all("th"))
    pictures = [each["alt"] for each in page.all("img")]
    assert pictures.count("") == 1  # scale and north lie over a picture that is described
    assert sum("Map of radar hits" in alt for alt in pictures) == 4


def test_the_paper(made):
    paper = pypdf.PdfReader(made / "report.pdf")
    text = " ".join(page.extract_text() for page in paper.pages).replace("\n", " ")
    assert paper.metadata.title.startswith("Kreuzung Münchner Straße \u2013 Süd: radar hits")
    assert "Kreuzung Münchner Straße \u2013 Süd" in text
    assert "All times: Europe/Berlin, UTC+02:00." in text
    assert "678 000.00 ± 0.25" in text.replace("\u202f", " ")
    assert f"Page 1 of {len(paper.pages)}" in text
    assert f"Page {len(paper.pages)} of {len(paper.pages)}" in text
    assert paper.root_object["/Lang"] == "en"
    titles = [each["/Title"] for each in paper.outline]
    assert titles == [
        "In short", "Map", "What this rests on", "Can this be trusted?", "Lanes",
        "The lanes over time",
        "Sensors", "What sensors delivered", "Settings and sources", "What the words mean",
    ]  # fmt: skip
    described = [
        node["/Alt"]
        for number in range(1, paper.trailer["/Size"])
        if isinstance(node := paper.get_object(number), dict) and "/Alt" in node
    ]
    assert sum("Map of radar hits" in text for text in described) == 1
    links = {each["/A"]["/URI"] for page in paper.pages for each in page.get("/Annots", ())
             if "/URI" in each.get("/A", {})}  # fmt: skip
    assert "lanes.csv" in links


def test_a_dataset_from_elsewhere(results, made, tmp_path, blank_paper):
    shutil.copytree(results / "heatmap", tmp_path / "map")
    place = results / "dataset"
    gr.write_report(tmp_path / "map", dataset=place, timezone="Europe/Berlin", title="x")
    for name in ("quality.csv", "lanes.csv"):
        assert (tmp_path / "map" / name).read_bytes() == (made / name).read_bytes()

"""The page of a city's month, against the data that it was made from, and in a browser."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from axe_core_python.selenium import Axe
from browser import start_chromium, wide
from cities import HOUR, driven_hour, write_run, write_site
from click.testing import CliRunner
from datasets import write_dataset
from maps import Listener
from report_site import Page

import gis_radar as gr
from gis_radar.base.languages import catalogue
from gis_radar.cli import group

FIRST = HOUR // 24 * 24 - 13 * 24  # 2023-11-01, 0 h
MONTH = "2023-11"
HOURS = [FIRST + 24 * day + hour for day in range(3) for hour in (7, 17)]  # Wednesday on
BEFORE = [hour - 28 * 24 for hour in HOURS]  # the same weekdays of October
PHONE = 390


def write_city(root):
    """Write a busy site and a slow one, one of last month, and one without vehicles."""
    busy = driven_hour(root / "busy", every_s=10.0)
    slow = driven_hour(root / "slow", every_s=15.0, speed=5.0, east_m=900.0)
    city = root / "city"
    write_site(city, "Adlerweg", busy, [*BEFORE, *HOURS])
    spans = {"R1": [(hour, hour + 1) for hour in [*BEFORE, *HOURS[:4]]],
             "R2": [(hour, hour + 1) for hour in [*BEFORE, *HOURS]]}  # fmt: skip
    write_site(city, "Birkenallee", slow, [*BEFORE, *HOURS], sensors=spans)
    write_site(city, "Buchenplatz", slow, BEFORE)
    write_dataset(city / "site=Eichenhof", hours=HOURS[:1], vehicles=False)
    write_run(city, "Adlerweg", title="Ring <b>1</b> & Tor")
    for language in ("en", "de"):
        gr.write_month_page(city, MONTH, output=root / language, language=language, title="Town")
    return root


@pytest.fixture(scope="module")
def made(once):
    return once("month", write_city)


@pytest.fixture(scope="module")
def page(made):
    return Page((made / "en" / "month.html").read_text(encoding="utf-8"))


def test_lanes_have_the_names_that_their_site_states(made, tmp_path):
    root = shutil.copytree(made / "city", tmp_path / "city")
    named = gr.open_city(root).sites["Adlerweg"].state_lanes([{"id": 7, "name": "To the harbour"}])
    assert "To the harbour" in set(named.traffic()["name"])
    gr.write_month_page(root, MONTH, output=tmp_path / "page", title="Town")
    assert "To the harbour" in (tmp_path / "page" / "month.html").read_text(encoding="utf-8")


def table(page, first):
    """Give the rows of the table whose first heading is given, by their first cell."""
    (found,) = (
        each
        for each in page.tables
        if each[0][0].strip() == first[0] and any(first[1] in head for head in each[0])
    )
    return {row[0].strip(): row for row in found[1:]}


def test_each_site_has_a_row_those_with_gaps_first(page):
    rows = table(page, ("Site", "Time with data"))
    assert list(rows)[:2] == ["Buchenplatz", "Eichenhof"]
    assert set(rows) == {"Buchenplatz", "Eichenhof", "Birkenallee", "Ring <b>1</b> & Tor"}
    assert rows["Buchenplatz"][3:] == ["0 of 1", *["\u2013"] * 5]


def test_volumes_are_those_of_the_dataset(made, page):
    dataset = gr.open_city(made / "city").sites["Adlerweg"]
    lanes = dataset.traffic(begin="2023-11-01", end="2023-12-01", whole=True)
    shown = table(page, ("Site", "Time with data"))["Ring <b>1</b> & Tor"][6]
    volume, error = (int(part) for part in re.sub(r"[\u202f ]", "", shown).split("±"))
    assert volume == round(lanes["volume_veh_h"][0]) == pytest.approx(358, abs=3)
    hours = lanes["volume"][0] / lanes["volume_veh_h"][0]
    assert error == np.ceil(lanes["volume_se"][0] / hours)


def test_the_lane_on_which_most_time_is_lost_is_first(page):
    rows = table(page, ("Lane", "Time lost"))
    assert [name.partition(":")[0] for name in rows] == ["Birkenallee", "Ring <b>1</b> & Tor"]
    first = next(iter(rows.values()))
    delay = 60.0 / 5.0 - 60.0 / (50.0 / 3.6)
    assert float(first[2].split("\u202f")[0]) == pytest.approx(delay, abs=1.0)
    assert first[3] == "A"


def test_what_did_not_change_is_not_told(page):
    words = " ".join(page.words)
    assert "No difference is told." in words
    assert "2 lanes of 2 sites" in words or "1 lanes of 1 sites" in words


def test_the_health_names_the_silent_sensor(page):
    rows = table(page, ("Sensor", "State"))
    assert next(iter(rows.values()))[1] == "silent"
    assert rows["Birkenallee: R1"][1] == "silent"
    assert rows["Birkenallee: R1"][2] == "2023-11-02 18:00"


def test_links_lead_to_the_reports_that_are_there(made, page):
    links = {each["href"] for each in page.all("a") if not each["href"].startswith("#")}
    assert links == {"../city/results/Adlerweg/report.html"}
    assert (made / "en" / links.pop()).is_file()


def test_nothing_of_others_gets_in(made, page):
    text = (made / "en" / "month.html").read_text(encoding="utf-8")
    assert "<b>1</b>" not in text
    assert "script" not in page.tags
    assert "://" not in text
    assert len(text) < 200_000


def test_the_page_in_german_is_german(made):
    page = Page((made / "de" / "month.html").read_text(encoding="utf-8"))
    english = {text for text, german in catalogue("de").items() if german != text}
    words = {each.strip() for each in page.words} - {""}
    assert words & english == set()
    assert page.all("html")[0]["lang"] == "de"


def test_the_command_writes_equal_bytes_of_equal_data(made):
    city, out = made / "city", made / "again"
    done = CliRunner().invoke(
        group, ["report", str(city), "--month", MONTH, "-o", str(out), "--title", "Town", "--json"]
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert done.exit_code == 0
    assert result["outputs"] == [str(out / "month.html")]
    assert result["summary"]["sites"] == 4
    assert result["summary"]["sites_without_data"] == 2
    assert result["summary"]["title"] == "Town"
    assert (out / "month.html").read_bytes() == (made / "en" / "month.html").read_bytes()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--month", "2024-01"], 3, "has no data of 2024-01"),
        (["--month", "January"], 2, "is no month"),
        ([], 2, "which month"),
        (["--month", MONTH, "--no-ways"], 2, "--no-ways is of the report of a site"),
        (["--month", MONTH, "--csv-locale", "de"], 2, "--csv-locale"),
        (["--month", MONTH, "--title", " "], 2, "title is empty"),
        (["--month", MONTH, "--timezone", "Nowhere"], 2, "no time zone"),
    ],
)  # fmt: skip
def test_what_is_refused(run, made, tmp_path, words, code, said):
    left, out, _ = run("report", str(made / "city"), *words, "-o", str(tmp_path / "out"), "--json")
    error = json.loads(out.splitlines()[-1])
    assert (left, error["event"]) == (code, "error")
    assert said in error["message"]
    if not words or "2024-01" in words:
        assert "there are 2023-10, 2023-11" in error["hint"]
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_no_city(tmp_path):
    with pytest.raises(gr.InputError, match="is no city"):
        gr.write_month_page(tmp_path, MONTH)


def test_damaged_sites_are_left_out_and_named_in_the_words_of_the_city_file(made, tmp_path):
    """One with a damaged dataset, one with a damaged record of its run."""
    root = shutil.copytree(made / "city", tmp_path / "city")
    part = root / "site=Birkenallee" / "recordings.parquet"
    part.write_bytes(part.read_bytes()[:-20])
    (root / "results" / "Adlerweg" / "run.json").write_text("{")
    noted = {"title": "Simstadt", "language": "de", "timezone": "Europe/Berlin"}
    (root / "run.json").write_text(json.dumps(noted), encoding="utf-8")
    report = gr.write_month_page(root, MONTH)
    assert report.outputs == [root / "month.html"]
    assert sorted(report.summary["sites_left_out"]) == ["Adlerweg", "Birkenallee"]
    assert (report.summary["title"], report.summary["timezone"]) == ("Simstadt", "Europe/Berlin")
    page = Page(report.outputs[0].read_text(encoding="utf-8"))
    assert page.all("html")[0]["lang"] == "de"
    for name in ("Adlerweg", "Birkenallee"):
        assert f"Standort {name}" in " ".join(page.words)


def test_hours_that_were_not_measured_are_told_with_their_site(made, tmp_path):
    root = shutil.copytree(made / "city", tmp_path / "city")
    dataset = gr.open_dataset(root / "site=Adlerweg")
    settings = dataset.manifest.settings | {"drawn": "NOT MEASURED: drawn."}
    replace(dataset.manifest, settings=settings).write(dataset.folder)
    report = gr.write_month_page(root, MONTH, output=tmp_path / "page")
    assert "NOT MEASURED: drawn. Ring <b>1</b> & Tor." in report.summary["remarks"]
    text = report.outputs[0].read_text(encoding="utf-8")
    assert "NOT MEASURED: drawn. Ring &lt;b&gt;1&lt;/b&gt; &amp; Tor." in text


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    browser = start_chromium(tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.quit()


def look(chromium, path: Path, width, *, scheme="light", media=""):
    wide(chromium, width)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": features})
    chromium.get_log("browser")
    chromium.get(path.as_uri())


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (PHONE, "dark")])
def test_accessible_by_the_rules_of_axe(chromium, made, width, scheme):
    look(chromium, made / "en" / "month.html", width, scheme=scheme)
    assert chromium.get_log("browser") == []
    found = Axe().run(chromium)
    wrong = [(each["id"], each["help"], len(each["nodes"])) for each in found["violations"]]
    assert wrong == []
    assert len(found["passes"]) > 25


@pytest.mark.parametrize(("width", "language"), [(800, "de"), (PHONE, "en"), (PHONE, "de")])
def test_nothing_is_wider_than_the_window(chromium, made, width, language):
    look(chromium, made / language / "month.html", width)
    assert chromium.execute_script("return document.documentElement.scrollWidth") <= width


def test_no_table_is_cut_on_paper(chromium, made):
    look(chromium, made / "de" / "month.html", 688, media="print")
    edges = chromium.execute_script(
        "return [...document.querySelectorAll('table, figure, dl, .profiles')]"
        ".map(each => each.getBoundingClientRect().right)"
    )
    assert len(edges) > 5
    assert max(edges) <= 688.5


def test_sites_that_can_be_compared_are_and_the_others_are_named(made):
    periods = {"before": "2023-10-04/2023-10-08", "after": "2023-11-01/2023-11-05"}
    said = Listener()
    city = gr.open_city(made / "city")
    found = city.compare(**periods, reporter=said)
    assert list(found) == ["Adlerweg", "Birkenallee"]
    alone = gr.compare(city.sites["Birkenallee"], **periods)
    pd.testing.assert_frame_equal(found["Birkenallee"].table, alone.table)
    for name in ("Buchenplatz", "Eichenhof"):
        assert any(f"{name} is left out: " in each for each in said.lines)

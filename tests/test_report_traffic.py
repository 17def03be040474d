"""Traffic in a report, against the tables that it is from: volumes, turns, queues."""

from __future__ import annotations

import re
import shutil
from base64 import b64decode
from dataclasses import replace
from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from datasets import HOUR
from driven import drive, driven
from forks import APPROACH, LEFT, LINE_M, STRAIGHT, crossing, fork, fork_dataset, through
from maps import EAST, NORTH
from PIL import Image
from report_site import Page, reports_of_whole_run
from sites import pose

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import (
    LaneTraffic,
    open_dataset,
    read_hours,
    write_record,
)
from gis_radar.products import make_heatmap

BEGIN = HOUR * STEPS_PER_HOUR
FRONTS_M = (59.0, 52.0, 45.0)  # of three cars that wait, 4.5 m long


def waiting(vehicle, first_step, front_m, exit_lane, wait_s=30):
    """Drive to the stop line, wait, and go on."""
    way = [np.arange(2.0, front_m, 0.5), np.full(20 * wait_s, front_m), np.arange(front_m, 95, 0.5)]
    fronts, speed = np.concatenate(way), np.repeat([10.0, 0.0, 10.0], [len(each) for each in way])
    before = fronts < LINE_M
    track = drive(vehicle, first_step, fronts, speed=speed, lanelet_id=APPROACH)
    return track.assign(
        lanelet_id=pd.array(np.where(before, APPROACH, exit_lane), dtype="Int64"),
        s_m=np.where(before, fronts, fronts - LINE_M),
    )


def cars():
    """Give three cars that wait in the third minute, and five that drive through."""
    tracks = [waiting(n, BEGIN + 2400 + 40 * n, front, (STRAIGHT, LEFT)[n % 2])
              for n, front in enumerate(FRONTS_M)]  # fmt: skip
    return tracks + [through(10 + n, BEGIN + 1200 * n, STRAIGHT) for n in range(5)]


def reported(folder, tracks, languages=("en", "de"), **options):
    """Write a dataset of cars on the fork, its heat map, and a report in each language."""
    dataset = fork_dataset(folder / "dataset", tracks, timezone="Europe/Berlin", **options)
    make_heatmap(dataset).write(folder / "heatmap")
    for language in languages:
        (folder / language).mkdir()
        gr.write_report(folder, output=folder / language, language=language, title="Fork")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a report of the fork of which the exit to the left is hidden but for its end."""
    tiles = fork()
    hidden = tiles[(tiles["lane"] == LEFT) & (tiles["s_m"] < 35.0)]["tile_id"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gis_radar.products.report.report.write_pdf", lambda *_: None)
        return reported(tmp_path_factory.mktemp("fork"), cars(), unseen=hidden)


@pytest.fixture(scope="module")
def page(folder):
    return Page((folder / "en" / "report.html").read_text(encoding="utf-8"))


def table_of(page, head):
    (rows,) = (each for each in page.tables if each[0][: len(head)] == head)
    titles = rows[0]
    return [dict(zip(titles, row, strict=True)) for row in rows[1:]]


def volumes(page):
    return {int(row["No. on the plan"]): row
            for row in table_of(page, ["Lane", "No. on the plan", "Counted vehicles"])}  # fmt: skip


def pictures(folder, chapter, language="en"):
    """Return the pictures of a chapter as they are read."""
    text = (folder / language / "report.html").read_text(encoding="utf-8")
    section = text.partition(f'<section id="{chapter}"')[2].partition("</section>")[0]
    found = re.findall(r'(?:src|srcset)="data:image/png;base64,([^"]*)"', section)
    return [Image.open(BytesIO(b64decode(each))).convert("RGB") for each in found]


def redness(picture):
    """Return the share of pixels in shades of the colour of flows and queues."""
    r, g, b = np.moveaxis(np.asarray(picture, float), -1, 0)
    return float(((r - g > 40) & (r - b > 20)).mean())


def test_numbers_of_lanes_lead_to_their_plan(folder):
    text = (folder / "en" / "report.html").read_text(encoding="utf-8")
    assert text.count('<small><a href="#lanes">on the plan</a></small>') == 3
    plan = text.partition('<section id="lanes"')[2].partition("</section>")[0]
    assert "data:image/png" in plan


def test_figures_are_those_of_the_dataset(folder, page):
    dataset = open_dataset(folder / "dataset")
    known = dataset.traffic(whole=True).set_index("lane")
    fine = dataset.traffic("1min")
    hours = fine["begin"].nunique() / 60.0
    rows = volumes(page)
    assert rows.keys() == {APPROACH, STRAIGHT, LEFT}
    for lane in (APPROACH, STRAIGHT):
        row, figures = rows[lane], known.loc[lane]
        assert row["Lane"] == figures["name"]
        assert int(row["Counted vehicles"]) == fine[fine["lane"] == lane]["counted"].sum()
        volume, error = (float(each) for each in row["Volume veh/h"].split("\u202f±\u202f"))
        assert volume == pytest.approx(figures["volume"] / hours, abs=0.5)
        assert error == pytest.approx(figures["volume_se"] / hours, abs=0.5)
        assert float(row["Mean speed km/h, waiting included"]) == round(figures["speed_kmh"])
        # the table of lanes has it, whose error counts a shift along the lane: no figure has two
        assert not any("occupancy" in name for name in row)
    assert float(rows[APPROACH]["Longest queue m"]) == round(known.loc[APPROACH, "queue_max_m"])
    assert rows[STRAIGHT]["Longest queue m"] == "\u2013"  # it has no stop line


@pytest.mark.parametrize(("language", "words"), [
    ("en", ["presumed stop line: 20", "20*", "*The map draws no stop line"]),
    ("de", ["angenommene Haltlinie: 20", "20*", "*Die Karte zeichnet"]),
])  # fmt: skip
def test_a_queue_from_a_presumed_stop_line_says_so(tmp_path, monkeypatch, language, words):
    monkeypatch.setattr("gis_radar.products.report.report.write_pdf", lambda *_: None)
    tiles, lanes = crossing()
    dataset = driven(tmp_path / "dataset", tiles, pd.concat(cars()), lanes=lanes)
    make_heatmap(dataset).write(tmp_path / "heatmap")
    gr.write_report(tmp_path, output=tmp_path / language, language=language)
    text = (tmp_path / language / "report.html").read_text(encoding="utf-8")
    queues = text.partition('<section id="queues"')[2].partition("</section>")[0]
    assert [word for word in words if word not in queues] == []
    assert "HCM" not in queues  # levels of service are of signals


def test_lanes_have_the_names_of_their_traffic_in_all_tables(folder):
    named = [
        pd.read_csv(folder / "en" / name).dropna(subset="name").set_index("lane")["name"]
        for name in ("lanes.csv", "traffic.csv")
    ]
    assert named[0].to_dict() == named[1].to_dict()
    assert len(named[0]) == 3


def test_tracks_are_those_of_the_dataset_where_there_was_no_run(page):
    (row,) = (
        each for each in table_of(page, ["What", "Here"]) if each["What"] == "Vehicles followed"
    )
    assert row["Here"] == "8 tracks, 0 of heavy vehicles"


def test_the_busiest_lane_stands_first_by_name(page):
    row, words = volumes(page)[APPROACH], " ".join(" ".join(page.words).split())
    fact = f"Busiest lane {row['Volume veh/h']} veh/h {row['Lane']} ({APPROACH})"
    fact += "; first of 1 lane with a sure volume at its stop line"  # others may have more
    assert " ".join(fact.split()) in words


@pytest.mark.parametrize(("every", "until"), [(60, 2200), (4800, 3300)])
def test_no_lane_is_named_the_busiest_that_was_seen_too_little(tmp_path, monkeypatch, every, until):
    """Of many cars, for under half of the time; of two cars, for more, but one of them."""
    monkeypatch.setattr("gis_radar.products.report.report.write_pdf", lambda *_: None)
    tiles = fork()
    line = tiles[(tiles["lane"] == APPROACH) & (tiles["s_m"] > LINE_M - 2.0)]["tile_id"]
    tracks = [through(n, BEGIN + step, STRAIGHT) for n, step in enumerate(range(0, 4801, every))]
    folder = reported(tmp_path, tracks, ["en"], until=dict.fromkeys(line, BEGIN + until))
    words = " ".join(Page((folder / "en" / "report.html").read_text(encoding="utf-8")).words)
    assert "Busiest lane none to be named too little seen" in " ".join(words.split())


@pytest.mark.parametrize(("away_m", "said"), [(99.0, f"{STRAIGHT}"), (101.0, f"{APPROACH}")])
def test_lanes_far_from_every_sensor_are_named(tmp_path, monkeypatch, away_m, said):
    """The sensor stands before the line of the approach, 20 m farther from that of the exit."""
    monkeypatch.setattr("gis_radar.products.report.report.write_pdf", lambda *_: None)
    there = pose(easting=EAST + LINE_M - away_m, northing=NORTH)
    folder = reported(tmp_path, cars(), ["en"], seen_from=there)
    words = " ".join(Page((folder / "en" / "report.html").read_text(encoding="utf-8")).words)
    _, _, named = " ".join(words.split()).partition("missed than \u00b1 states: ")
    assert said in named.partition(".")[0]
    assert (str(APPROACH) in named.partition(".")[0]) == (away_m > 100.0)
    assert (f"({APPROACH}); over 100 m from every sensor" in words) == (away_m > 100.0)


def test_what_is_not_visible_is_not_seen_and_not_0(page):
    row = volumes(page)[LEFT]
    assert (row["Counted vehicles"], row["Volume veh/h"]) == ("not seen", "not seen")
    (turn,) = table_of(page, ["From lane"])
    assert "not seen" in {turn["Straight ahead veh/h"], turn.get("Left turn veh/h")}
    assert "which is not 0" in " ".join(page.words)


def test_the_profile_is_that_of_the_dataset(folder, page):
    fine = open_dataset(folder / "dataset").traffic("1min").set_index(["lane", "begin"])
    volume = fine.loc[APPROACH, "volume_veh_h"].astype(float).dropna()
    assert len(volume) > 3
    text = (folder / "en" / "report.html").read_text(encoding="utf-8")
    section = text.partition('<section id="volumes"')[2].partition("</section>")[0]
    (strip,) = section.split('<div class="strip">')[1:]
    assert "=Ring eastbound, lane 1" in strip
    top = float(re.search(r'class="scale"><span>([^<]*)<', strip)[1])
    (line,) = re.findall(r'class="line"[^>]* d="([^"]*)"', strip)
    heights = [100.0 - float(each) for each in line.removeprefix("M").split()[1::4]]
    assert heights == pytest.approx((100.0 * volume / top).tolist(), abs=1.0)


def test_pictures_are_there_and_show_something(folder):
    turns, courses = pictures(folder, "turns"), pictures(folder, "queues")
    assert [len(turns), len(courses)] == [2, 2]  # one for a phone
    for each in turns:
        assert redness(each) > 0.0001  # two short turns
    for each in courses:
        assert redness(each) > 0.01
        assert (np.asarray(each).sum(axis=-1) < 250).mean() > 0.005  # ways


def test_the_course_of_a_queue_is_that_of_its_cars(folder):
    """Three cars that wait: from the first to the last of them the back moves by 7 m each."""
    dataset = open_dataset(folder / "dataset")
    made = LaneTraffic(folder=dataset.folder, fingerprint=dataset.manifest.fingerprint)
    (course,) = made.courses(dataset.records(), APPROACH, (BEGIN, BEGIN + 6000))
    backs = sorted(set(np.round(course.back_m[course.back_m > 0], 2)))
    assert backs == [pytest.approx(LINE_M - front + 4.5) for front in FRONTS_M]
    assert max(backs) == pytest.approx(dataset.queues("1min")["queue_max_m"].max(), abs=0.01)
    first = course.vehicle == 0
    assert course.to_line_m[first].max() == pytest.approx(LINE_M - 2.0, abs=0.3)
    assert (np.diff(course.step[first]) > 0).all()
    assert course.seen[:, 3].max() == pytest.approx(LINE_M)
    (short,) = made.courses(dataset.records(), APPROACH, (BEGIN, BEGIN + 5))  # under a second
    assert short.back_step.tolist() == [BEGIN]


def test_tables_lie_beside_the_page_with_names_as_it_has_them(folder):
    dataset = open_dataset(folder / "dataset")
    for name, known in (("traffic", dataset.traffic("1min")), ("turns", dataset.turns("1min"))):
        path = folder / "en" / f"{name}.csv"
        rows, german = pd.read_csv(path), pd.read_csv(folder / "de" / f"{name}.csv")
        names = [each for each in rows if each.endswith("name")]
        pd.testing.assert_frame_equal(rows.drop(columns=names), german.drop(columns=names))
        for column in names:
            assert rows[column].str.contains("bound, ").all()
            assert german[column].str.contains(" nach ").all()
        assert rows.columns.tolist() == [each for each in known if each != "geometry"]
        np.testing.assert_allclose(rows["volume"], known["volume"].astype(float), atol=1e-4)
        assert f'href="{name}.csv"' in (folder / "en" / "report.html").read_text(encoding="utf-8")


def test_in_german(folder):
    words = Page((folder / "de" / "report.html").read_text(encoding="utf-8")).words
    text = " ".join(words)
    for each in ("Wie viele Fahrzeuge, wie schnell?", "Wohin biegen sie ab?",
                 "Wo stockt es, und wann?", "=Ring nach Osten, Fahrstreifen 1"):  # fmt: skip
        assert each in text
    assert "nicht gesehen" in text
    assert "Wege von Fahrzeugen" in text  # what the report shows of single vehicles


def test_of_one_interval_there_is_no_profile(tmp_path, blank_paper):
    reported(tmp_path, [through(1, BEGIN + 40, STRAIGHT)], ["en"])
    text = (tmp_path / "en" / "report.html").read_text(encoding="utf-8")
    assert volumes(Page(text))[APPROACH]["Counted vehicles"] == "1"
    assert 'class="strip"' not in text
    assert '<section id="queues"' not in text  # nobody waited
    assert "it shows no way of a vehicle" in text


def test_without_exact_tables_there_are_no_ways(folder, tmp_path, blank_paper):
    shutil.copytree(folder / "dataset", tmp_path / "dataset")
    shutil.copytree(folder / "heatmap", tmp_path / "heatmap")
    place = tmp_path / "dataset"
    dataset = open_dataset(place)
    LaneTraffic(folder=place, fingerprint=dataset.manifest.fingerprint).update(HOUR)
    for record in read_hours(place).values():
        write_record(place, replace(record, dropped=("tracks", "visible", "occupied")))
    gr.write_report(tmp_path, title="Fork")
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert volumes(page)[APPROACH]["Counted vehicles"] == "8"
    assert not pictures(tmp_path, "queues", ".")
    assert table_of(page, ["Lane", "No. on the plan", "Longest queue m"])


def test_exact_tables_that_were_deleted_of_other_hours_change_nothing(tmp_path, blank_paper):
    second, later = BEGIN + STEPS_PER_HOUR, (HOUR + 1) * 1_000_000
    tracks = [through(1, second - 400, STRAIGHT), through(later, second + 40, STRAIGHT)]
    dataset = fork_dataset(tmp_path / "dataset", tracks)
    record = read_hours(dataset.folder)[HOUR]
    write_record(dataset.folder, replace(record, dropped=("tracks", "visible", "occupied")))
    begin = pd.Timestamp(HOUR + 1, unit="h", tz="UTC")
    make_heatmap(dataset, begin=begin.isoformat()).write(tmp_path / "heatmap")
    gr.write_report(tmp_path, title="Fork")
    rows = pd.read_csv(tmp_path / "traffic.csv", parse_dates=["begin", "end"])
    assert set(rows["end"] - rows["begin"]) == {pd.Timedelta("1min")}
    assert set(rows["begin"]) == {begin}


def test_of_hits_alone_it_says_so(once):
    report = reports_of_whole_run(once)["en"]
    text = report.outputs[0].read_text(encoding="utf-8")
    assert not re.search('<section id="(volumes|turns|queues)"', text)
    assert "Vehicles were not looked for: this report has no volumes" in text
    assert not {"traffic.csv", "turns.csv"} & {path.name for path in report.outputs}


def test_ways_of_vehicles_can_be_left_out(folder, tmp_path, without_pdf):
    gr.write_report(folder, output=tmp_path, title="Fork", ways=False)
    without, with_ways = pictures(tmp_path, "queues", "."), pictures(folder, "queues")
    for one, other in zip(without, with_ways, strict=True):
        assert redness(one) > 0.01
        dark = [(np.asarray(each).sum(axis=-1) < 250).sum() for each in (one, other)]
        assert dark[0] < dark[1]
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "it shows no way of a vehicle" in text
    assert "way of one vehicle" not in text


def test_lanes_have_the_names_of_the_site_file(folder, tmp_path, without_pdf):
    """A name is a text, in HTML and in pictures."""
    for name in ("dataset", "heatmap"):
        shutil.copytree(folder / name, tmp_path / name)
    name = r"Ring, <b>bus</b> $\foo$ lane"
    lane = {"id": APPROACH, "name": name, "speed_kmh": 72.0}
    gr.open_dataset(tmp_path / "dataset").state_lanes([lane])
    gr.write_report(tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert volumes(Page(text))[APPROACH]["Lane"] == name
    rows = pd.read_csv(tmp_path / "traffic.csv").set_index("lane").loc[APPROACH]
    free = pd.read_csv(folder / "en" / "traffic.csv").set_index("lane").loc[APPROACH]
    known = free["delay_s"] > 0  # 60 m at 36 km/h took 6 s, at 72 km/h 3
    assert known.any()
    assert (rows["delay_s"] - free["delay_s"])[known].tolist() == pytest.approx([3.0] * known.sum())


def test_slow_lanes_without_a_queue_are_listed(tmp_path, monkeypatch, without_pdf):
    known = gr.Dataset.traffic

    def jammed(self, *args, **options):
        rows = known(self, *args, **options)
        there = rows["lane"] == APPROACH
        rows.loc[there, "queue_max_m"] = np.nan
        slow = {"speed_kmh": 12.0, "occupancy": 0.4, "occupancy_se": 0.05}
        rows.loc[there, [*slow]] = [*slow.values()]
        return rows

    monkeypatch.setattr(gr.Dataset, "traffic", jammed)
    page = Page(
        (reported(tmp_path, cars(), ("en",)) / "en" / "report.html").read_text(encoding="utf-8")
    )
    (slow,) = table_of(page, ["Lane", "No. on the plan", "Mean speed km/h"])
    assert slow["No. on the plan"] == str(APPROACH)
    assert slow["Mean speed km/h"] == "12"
    assert slow["Occupancy %"].replace("\u202f", " ") == "40 \N{PLUS-MINUS SIGN} 5"
    assert float(slow["Free speed km/h"]) > 24.0
    assert "whose queue is not known" in " ".join(page.words)  # the lane has a stop line

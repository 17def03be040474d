"""Pages of a report on paper: what a reader of the PDF sees, by its text."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from io import BytesIO
from itertools import product
from zoneinfo import ZoneInfo

import pypdf
import pytest
from maps import Listener
from PIL import Image
from report_site import write_results

import gis_radar as gr
from gis_radar.base import Clock, OutputError, in_language
from gis_radar.products import Fact, Strip, Table
from gis_radar.products.report.content import Chapter, Chart, Content, Figure, MapSeries
from gis_radar.products.report.pages import bound_percents, page_of, write_pdf
from gis_radar.products.report.report import lane_columns

MOMENT = datetime(2025, 6, 12, tzinfo=UTC)
A4_PT, EDGE_PT = 595.3, 42.5  # width, and of a margin


def picture(size):
    place = BytesIO()
    Image.new("RGB", size, "white").save(place, "PNG")
    return place.getvalue()


def content_of(*, facts=(), parts=(), size=(300, 200)):
    """Return a report of little: a white map, figures, parts."""
    whole = Figure(
        png=picture(size), width=size[0], height=size[1], title="Whole time", alt="A map.",
        caption="Below the map",
    )  # fmt: skip
    series = MapSeries(
        whole=whole, frames=(), overlay=picture(size), narrow=b"", caption="note", note=""
    )  # fmt: skip
    return Content(
        title="Title", subtitle="when", zone="UTC", until=MOMENT, intro="Intro", facts=facts,
        remarks=(), basis=Table(name="basis", caption="basis", columns=(), rows=()), map=series,
        chapters=[Chapter("lanes", "Lanes", parts)], made_by="gis_radar", measure="occupancy",
    )  # fmt: skip


def pages_of(folder, content):
    write_pdf(content, folder / "report.pdf")
    return pypdf.PdfReader(folder / "report.pdf").pages


def places_on(page):
    """Return where each piece of text begins: from the left, from the upper edge, points."""
    found = {}

    def note(text, outer, inner, *_):
        if text.strip():
            x, y = inner[4], inner[5]
            left = x * outer[0] + y * outer[2] + outer[4]
            base = x * outer[1] + y * outer[3] + outer[5]
            found[text.strip()] = (left, float(page.mediabox.height) - base)

    page.extract_text(visitor_text=note)
    return found


def letters_of(pages):
    """Return all letters of pages as one word, so that it does not matter where lines end."""
    return "".join("".join(page.extract_text() for page in pages).split())


def words_of(folder, tables):
    """Write tables of one row, each with its columns and cells; return the words of each."""
    parts = [
        Table(name="lanes", caption=f"Caption{k}.", columns=columns, rows=[cells])
        for k, (columns, cells) in enumerate(tables)
    ]
    pages = pages_of(folder, content_of(parts=parts))
    right = max(left for page in pages for left, _ in places_on(page).values())
    assert right < A4_PT - EDGE_PT
    words = " ".join(page.extract_text() for page in pages).split()
    begins = [words.index(f"Caption{k}.") for k in range(len(tables))]
    return [words[begin:end] for begin, end in zip(begins, [*begins[1:], len(words)], strict=True)]


def test_heads_and_numbers_of_lanes_are_not_broken(tmp_path):
    tables = []
    for language, lane in product(("en", "de"), ("10944738", str(2**63 - 1))):
        with in_language(language):
            columns = lane_columns(None, "occupancy")
        cells = [lane, "too few tracks", "north-west", *["12.3 % ± 1.2 %"] * (len(columns) - 3)]
        tables.append((columns, cells))
    # As in a town: four digits of length, five of a lane, and why a lane has no rank.
    with in_language("de"):
        clock = Clock(zone=ZoneInfo("Europe/Berlin"), first=MOMENT, last=MOMENT)
        columns = lane_columns(clock, "occupancy")
    cells = ["17863", "zu wenig davon einsehbar", "Bahnhofsvorplatz (West), Nordost",
             "27,8 ± 24,4 %", "41", "1 700", "100 %", "100 ± 26 % bei 1 266 m", "194,3",
             "23:13:20 bis 23:13:40: 35 ± 4 %"]  # fmt: skip
    *narrow, full = words_of(tmp_path, [*tables, (columns, cells)])
    for (columns, (lane, *_)), found in zip(tables, narrow, strict=True):
        for column in columns:
            assert set(bound_percents(f"{column.title} {column.unit}").split()) <= set(found)
        assert lane in found
    assert {"einsehbar", "Bahnhofsvorplatz"} <= set(full)


def test_lanes_without_a_rank_are_on_the_screen_only(tmp_path):
    with in_language("en"):
        columns = lane_columns(None, "occupancy")[:2]
    rows = [[f"lane{k}", "1"] for k in range(5)]
    table = Table(name="lanes", caption="Lanes", columns=columns, rows=rows, printed=2)
    page = content_of(parts=[table])
    letters = letters_of(pages_of(tmp_path, page))
    assert "lane1" in letters
    assert "lane2" not in letters
    assert "Printedarethefirst2of5rows." in letters
    assert "lane4" in page_of(page)


def test_lanes_over_time_but_the_first_are_on_the_screen_only(tmp_path):
    charts = [
        Chart(
            caption="c", alt="a", heading="h", below="b", top="10", times=[(0.0, "09:00")],
            strips=[Strip(f"lane{k}", "M0 0H1000", "M0 0H1000", ()) for k in (first, first + 1)],
        )
        for first in (1, 3)
    ]  # fmt: skip
    for name, is_printed in (("time", False), ("queues", True)):
        page = replace(content_of(), chapters=[Chapter(name, "Lanes over time", charts)])
        letters = letters_of(pages_of(tmp_path, page))
        assert "lane2" in letters
        assert ("lane3" in letters) == is_printed
        assert ("Printedarethefirst2lanes." in letters) != is_printed
        assert "lane4" in page_of(page)


def test_what_a_figure_rests_on_stands_in_its_field(tmp_path):
    rests = "19 Spuren, 61 % der Länge; der erste von 3 Fahrstreifen mit Rang"
    facts = [Fact("Aufgezeichnet", "40 s", "in 40 s"), Fact("Sensoren", "3", "R1"),
             Fact("Am stärksten belegter", "28 %", rests), Fact("Vierte", "4")]  # fmt: skip
    places = places_on(pages_of(tmp_path, content_of(facts=facts))[0])
    assert bound_percents(rests) not in places  # on one line it would be too small to read
    last = max(top for text, (_, top) in places.items() if text in bound_percents(rests))
    assert last < places["Vierte"][1] - 10
    assert places["Vierte"][0] == pytest.approx(places["Aufgezeichnet"][0], abs=0.5)


@pytest.mark.parametrize("size", [(300, 60), (200, 300)])
def test_map_and_legend_are_beside_each_other(tmp_path, size):
    """Of a flat map and of a tall one: the legend is whole, the words are below both."""
    page = next(
        each for each in pages_of(tmp_path, content_of(size=size))
        if "Below the map" in each.extract_text()
    )  # fmt: skip
    places = {text: place for text, place in places_on(page).items() if "not visible" not in text}
    legend = [place for text, place in places_on(page).items() if "not visible" in text]
    assert EDGE_PT + 100 < legend[0][0] < A4_PT - EDGE_PT - 60
    assert places["note"][1] > legend[0][1] + 8


def test_a_machine_without_its_library_has_all_but_the_pdf(tmp_path, monkeypatch):
    folder, heard = write_results(tmp_path, names=("R1",), steps=400), Listener()
    (folder / "report.html").write_text("of an earlier report")
    (folder / "report.pdf").write_bytes(b"%PDF of an earlier report")
    (tmp_path / "modules" / "weasyprint").mkdir(parents=True)
    broken = "print('which library')\nraise OSError('cannot load library pango')\n"
    (tmp_path / "modules" / "weasyprint" / "__init__.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))

    made = gr.write_report(folder, reporter=heard)
    assert "report.pdf" not in {path.name for path in made.outputs}
    assert not (folder / "report.pdf").exists()
    told = [level for level, text in heard.messages if "pip install gis_radar[pdf]" in text]
    assert told == ["warning"]
    assert (folder / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


@pytest.mark.parametrize(
    ("fails", "reason"),
    [("raise ValueError('odd')", "ValueError: odd"),
     ("import os; os.abort()", "WeasyPrint ended with -6")],
)  # fmt: skip
def test_a_library_that_fails_is_one_line(tmp_path, monkeypatch, fails, reason):
    (tmp_path / "weasyprint.py").write_text(fails)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(OutputError, match=rf"a\.pdf: cannot be written: {reason}$"):
        write_pdf(content_of(), tmp_path / "a.pdf")


def test_no_line_ends_between_a_number_and_its_percent_sign():
    assert bound_percents("it is not 0 %, nor 20 % or more") == (
        "it is not 0\u202f%, nor 20\u202f% or more"
    )
    assert bound_percents(None) is None

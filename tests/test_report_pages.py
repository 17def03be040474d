"""Pages of a report on paper: what a reader of the PDF sees, by its text."""

from __future__ import annotations

from datetime import UTC, datetime
from io import BytesIO
from types import SimpleNamespace
from zoneinfo import ZoneInfo

import pypdf
import pytest
from PIL import Image

from gis_radar.report.content import Fact, Figure, Table
from gis_radar.report.pages import Paper, _add_facts, _add_map, _add_table, _composed, bound
from gis_radar.report.report import _lane_columns
from gis_radar.steps import Clock
from gis_radar.words import speaking


def a_paper():
    named = SimpleNamespace(
        measure="occupancy", title="T", subtitle="", zone="UTC", made_by="gis_radar"
    )  # fmt: skip
    paper = Paper(named)
    paper.add_page()
    return paper


def places_of(paper):
    """Return where on the first page each piece of text begins: from the left, from below."""
    found = {}
    page = pypdf.PdfReader(BytesIO(bytes(paper.output()))).pages[0]

    def note(text, _, matrix, *__):
        if text.strip():
            found[text.strip()] = (matrix[4], matrix[5])

    page.extract_text(visitor_text=note)
    return found


def words_of(columns, cells):
    """Write a table of one row; return the words that stand on the page."""
    paper = a_paper()
    _add_table(paper, Table(name="t", caption="Lanes", columns=columns, rows=[cells]))
    page = pypdf.PdfReader(BytesIO(bytes(paper.output()))).pages[0]
    return page.extract_text().split()


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("lane", ["7", "10944738", str(2**63 - 1)])
def test_heads_and_numbers_of_lanes_are_not_broken(language, lane):
    with speaking(language):
        columns = _lane_columns(None, "occupancy")
        cells = [lane, "too few tracks", "north-west", *["12.3 % ± 1.2 %"] * (len(columns) - 3)]
        found = words_of(columns, cells)
    for column in columns:
        for word in f"{column.title} {column.unit}".split():
            assert word in found
    assert lane in found


def test_streets_of_a_full_table_are_not_broken():
    """As in a town: four digits of length, five of a lane, and why a lane has no rank."""
    with speaking("de"):
        moment = datetime(2025, 6, 12, tzinfo=UTC)
        clock = Clock(zone=ZoneInfo("Europe/Berlin"), first=moment, last=moment)
        columns = _lane_columns(clock, "occupancy")
        cells = ["17863", "zu wenig davon einsehbar", "Bahnhofsvorplatz (West), Nordost",
                 "27,8 ± 24,4 %", "41", "1 700", "100 %", "100 ± 26 % bei 1 266 m", "194,3",
                 "23:13:20 bis 23:13:40: 35 ± 4 %"]  # fmt: skip
        found = words_of(columns, cells)
    assert {"einsehbar", "Bahnhofsvorplatz"} <= set(found)


def test_what_a_figure_rests_on_stands_in_its_field():
    rests = "19 Spuren, 61 % der Länge; der erste von 3 Fahrstreifen mit Rang"
    facts = [Fact("Aufgezeichnet", "40 s", "in 40 s"), Fact("Sensoren", "3", "R1"),
             Fact("Höchster Fahrstreifen", "17863: 28 %", rests), Fact("Vierte", "4")]  # fmt: skip
    paper = a_paper()
    _add_facts(paper, SimpleNamespace(facts=facts))
    places = places_of(paper)
    assert rests not in places  # on one line it would be too small to read
    last = min(y for text, (_, y) in places.items() if text in rests)
    assert last > places["Vierte"][1] + 10


def test_no_figures_take_no_room():
    paper = a_paper()
    begin = paper.get_y()
    _add_facts(paper, SimpleNamespace(facts=[]))
    assert paper.get_y() == pytest.approx(begin + 2.0)
    paper.output()  # closes its fonts


def test_the_legend_of_a_flat_map_ends_above_the_words_below_it():
    picture = BytesIO()
    Image.new("RGB", (300, 60), "white").save(picture, "PNG")
    flat = Figure(
        png=picture.getvalue(), width=300, height=60, alt="", caption="Below the map"
    )  # fmt: skip
    paper = a_paper()
    part = SimpleNamespace(whole=flat, overlay=None, caption="and the note")
    _add_map(paper, SimpleNamespace(map=part, measure="occupancy"))
    places = places_of(paper)
    assert places["Below the map"][1] < places["not visible"][1] - 8


def test_no_line_ends_between_a_number_and_its_percent_sign():
    assert bound("it is not 0 %, nor 20 % or more") == ("it is not 0\u202f%, nor 20\u202f% or more")
    assert bound(None) is None


def test_an_overlay_of_another_size_lies_on_its_map():
    """Versions of Matplotlib differ by a pixel in how large they draw."""
    pictures = []
    for size in ((40, 30), (41, 30)):
        place = BytesIO()
        Image.new("RGBA", size, (255, 0, 0, 255)).save(place, "PNG")
        pictures.append(place.getvalue())
    assert _composed(*pictures, 100).size == (40, 30)

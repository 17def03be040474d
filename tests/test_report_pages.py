"""Pages of a report on paper: what a reader of the PDF sees, by its text."""

from __future__ import annotations

from io import BytesIO
from types import SimpleNamespace

import pypdf
import pytest
from PIL import Image

from gis_radar.report.content import Table
from gis_radar.report.pages import Paper, _add_table, _composed, bound
from gis_radar.report.report import _lane_columns
from gis_radar.words import speaking


def words_of(columns, cells):
    """Write a table of one row; return the words that stand on the page."""
    named = SimpleNamespace(
        measure="coverage", title="T", subtitle="", zone="UTC", made_by="gis_radar"
    )  # fmt: skip
    paper = Paper(named)
    paper.add_page()
    _add_table(paper, Table(name="t", caption="Lanes", columns=columns, rows=[cells]))
    page = pypdf.PdfReader(BytesIO(bytes(paper.output()))).pages[0]
    return page.extract_text().split()


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("lane", ["7", "10944738", str(2**63 - 1)])
def test_heads_and_numbers_of_lanes_are_not_broken(language, lane):
    with speaking(language):
        columns = _lane_columns(None, "coverage")
        cells = [lane, "too few tracks", "north-west", *["12.3 % ± 1.2 %"] * (len(columns) - 3)]
        found = words_of(columns, cells)
    for column in columns:
        for word in f"{column.title} {column.unit}".split():
            assert word in found
    assert lane in found


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

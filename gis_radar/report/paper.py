"""The report as PDF: the same content, laid out for A4."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from fpdf.enums import XPos, YPos
from PIL import Image

from gis_radar.heatmap import style
from gis_radar.report.canvas import HATCH, Picture, image_of
from gis_radar.report.content import Content, Frame
from gis_radar.report.sheets import (
    FONT,
    INK,
    MARGIN,
    SOFT,
    WASH,
    Paper,
    add_figure,
    add_frame,
    add_table,
)

ACCENT, AMBER, AMBER_WASH = (0, 81, 158), (178, 106, 0), (255, 246, 224)
LEGEND, GAP = 44.0, 4.0
TALLEST_MAP, TALLEST_PLAN, TALLEST_FIGURE = 165.0, 165.0, 120.0
ACROSS, THUMB_PIXELS, MAP_PIXELS = 4, 420, 1500


def write_pdf(content: Content, path: Path) -> None:
    """Write the report as PDF.

    Parameters
    ----------
    content : Content
        What it says.
    path : Path
        The file. The same content gives the same bytes.
    """
    paper = Paper(content)
    # Not the time of writing: what was made of the same data is the same.
    paper.set_creation_date(content.until)
    paper.add_page()
    _add_title(paper, content)
    _add_map(paper, content)
    _add_frames(paper, content)
    _add_lanes(paper, content)
    paper.chapter("Sensors", 60)
    add_table(paper, content.sensors)
    for figure in content.sensor_figures:
        add_figure(paper, figure, TALLEST_FIGURE)
    paper.chapter("What the numbers rest on")
    add_table(paper, content.quality)
    paper.chapter("Settings and sources", 70)
    add_table(paper, content.settings)
    add_table(paper, content.sources)
    _add_words(paper, content)
    paper.output(str(path))


def _add_title(paper: Paper, content: Content) -> None:
    paper.start_section("In short")
    paper.say("TRAFFIC OCCUPANCY REPORT", size=8, bold=True, colour=ACCENT)
    paper.ln(0.5)
    paper.say(content.title, size=22, bold=True)
    paper.ln(1)
    paper.say(content.subtitle, size=11)
    paper.say(f"All times: {content.zone}.", size=9, colour=SOFT)
    paper.ln(3)
    _add_facts(paper, content)
    paper.say(
        "The map shows in which share of the observed time radar hit each half metre of lane. "
        "Compare one place over time; the figures count neither vehicles nor queues (see: What "
        "the words mean)."
    )
    if content.remarks:
        paper.ln(2)
        paper.say("Read this first", bold=True, size=9.5)
        paper.ln(1)
        for remark in content.remarks:
            _add_remark(paper, remark)


def _add_facts(paper: Paper, content: Content) -> None:
    """Draw the figures side by side."""
    top, width = paper.get_y(), (paper.epw - 2 * (len(content.facts) - 1)) / len(content.facts)
    for i, (name, value) in enumerate(content.facts):
        left = MARGIN + i * (width + 2)
        paper.set_fill_color(WASH)
        paper.rect(left, top, width, 13.5, style="F")
        paper.set_fill_color(ACCENT)
        paper.rect(left, top, 0.9, 13.5, style="F")
        paper.set_xy(left + 2, top + 1.8)
        paper.set_font(FONT, size=6.8)
        paper.set_text_color(SOFT)
        paper.cell(width - 2, 3.5, name)
        paper.set_font(FONT, "B", 9)
        while paper.get_string_width(value) > width - 4 and paper.font_size_pt > 5:
            paper.set_font_size(paper.font_size_pt - 0.5)
        paper.set_text_color(INK)
        paper.set_xy(left + 2, top + 6.2)
        paper.cell(width - 2, 5, value)
    paper.set_xy(MARGIN, top + 17)


def _add_remark(paper: Paper, text: str) -> None:
    paper.set_font(FONT, size=8)
    paper.set_text_color(INK)
    paper.set_fill_color(AMBER_WASH)
    paper.set_draw_color(AMBER)
    paper.multi_cell(
        0, 4.2, text, align="L", fill=True, border="L", padding=(1, 3),
        new_x=XPos.LMARGIN, new_y=YPos.NEXT,
    )  # fmt: skip
    paper.ln(1)


def _add_map(paper: Paper, content: Content) -> None:
    part = content.map
    paper.chapter("Map, whole time", 150)
    note_room = 22.0
    width = paper.epw - LEGEND - GAP
    height = min(width * part.height / part.width, TALLEST_MAP, paper.room - note_room)
    width = height * part.width / part.height
    top = paper.get_y()
    image = _composed(part.whole.picture, part.overlay, MAP_PIXELS)
    alt = f"Map of occupancy, {part.whole.label}. {part.whole.text}"
    paper.image(image, MARGIN, top, width, height, alt_text=alt)
    add_frame(paper, MARGIN, top, width, height)
    _add_legend(paper, MARGIN + width + GAP, top)
    paper.set_xy(MARGIN, top + height + 2)
    paper.say(part.whole.text, size=8.5)
    paper.say(part.caption, size=7.5, colour=SOFT)


def _add_legend(paper: Paper, left: float, top: float) -> None:
    """Draw the classes of the map, highest first."""
    paper.set_xy(left, top)
    paper.set_font(FONT, "B", 7.5)
    paper.set_text_color(INK)
    paper.cell(LEGEND, 4, style.LEGEND_TITLE)
    paper.set_xy(left, top + 4)
    paper.set_font(FONT, size=7.5)
    paper.set_text_color(SOFT)
    paper.cell(LEGEND, 4, "in which a tile is hit")
    rows = [(level.colour, level.label) for level in reversed(style.levels())]
    paper.set_text_color(INK)
    for i, (colour, label) in enumerate([*rows, (style.NOT_OBSERVED, style.NOT_OBSERVED_LABEL)]):
        y = top + 10 + i * 6
        paper.set_draw_color(SOFT)
        paper.set_fill_color(*bytes.fromhex(colour[1:]))
        paper.rect(left, y, 9, 4.6, style="DF")
        if i == len(rows):
            paper.set_draw_color(*bytes.fromhex(HATCH[1:]))
            for k in range(1, 6):
                paper.line(left + 1.8 * k - 1.2, y + 4.5, left + 1.8 * k, y + 0.1)
        paper.set_xy(left + 11, y)
        paper.cell(LEGEND - 11, 4.6, label)


def _add_frames(paper: Paper, content: Content) -> None:
    """Lay the intervals out as small maps, row by row."""
    part = content.map
    if not part.frames:
        return
    width = (paper.epw - GAP * (ACROSS - 1)) / ACROSS
    height = width * part.height / part.width
    tall = height + 16.0
    paper.chapter("The map through time", tall + 25)
    if part.note:
        paper.say(part.note, size=8, colour=SOFT)
        paper.ln(2)
    for first in range(0, len(part.frames), ACROSS):
        if paper.room < tall:
            paper.add_page()
        top = paper.get_y()
        for i, frame in enumerate(part.frames[first : first + ACROSS]):
            _add_frame(paper, frame, (MARGIN + i * (width + GAP), top, width, height))
        paper.set_xy(MARGIN, top + tall)


def _add_frame(paper: Paper, frame: Frame, box: tuple[float, float, float, float]) -> None:
    left, top, width, height = box
    alt = f"Map of occupancy, {frame.label}. {frame.text}"
    image = _composed(frame.picture, None, THUMB_PIXELS)
    paper.image(image, left, top, width, height, alt_text=alt)
    add_frame(paper, left, top, width, height)
    paper.set_xy(left, top + height + 1)
    paper.set_font(FONT, "B", 6.8)
    paper.set_text_color(INK)
    paper.multi_cell(width, 3.3, frame.label, align="L", new_x=XPos.LEFT, new_y=YPos.NEXT)
    paper.set_font(FONT, size=6)
    paper.set_text_color(SOFT)
    paper.multi_cell(width, 2.9, frame.text, align="L", new_x=XPos.LEFT, new_y=YPos.NEXT)


def _add_lanes(paper: Paper, content: Content) -> None:
    paper.chapter("Lanes", 190)
    add_figure(paper, content.lane_figure, TALLEST_PLAN)
    add_table(paper, content.lanes)


def _add_words(paper: Paper, content: Content) -> None:
    paper.chapter("What the words mean")
    for term, meaning in content.definitions:
        if paper.room < 22:
            paper.add_page()
        paper.say(term, size=8.5, bold=True)
        paper.say(meaning, size=8.5)
        paper.ln(1.8)


def _composed(picture: Picture, overlay: bytes | None, width: int) -> Image.Image:
    """Return a map as it is seen, with what lies over it, no wider than that."""
    image = image_of(picture).convert("RGBA")
    if overlay is not None:
        image = Image.alpha_composite(image, Image.open(BytesIO(overlay)).convert("RGBA"))
    image.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
    return image.convert("RGB")

"""Sheets of A4 for a report: running head, page numbers, paragraphs, tables, pictures."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import matplotlib as mpl
from fpdf import FPDF, ViewerPreferences
from fpdf.enums import TableBordersLayout, TableCellFillMode, XPos, YPos
from fpdf.fonts import FontFace

from gis_radar.report.content import Content, Figure, Table

INK, SOFT, LINE = (29, 33, 38), (89, 97, 106), (213, 218, 222)
WASH = (243, 245, 247)
MARGIN, TOP, FOOT = 16.0, 20.0, 18.0
FONT = "DejaVu"


class Paper(FPDF):
    """Pages of A4 with a running head and page numbers.

    Parameters
    ----------
    content : Content
        Whose title and time stand on each page.
    """

    def __init__(self, content: Content) -> None:
        super().__init__(format="A4")
        self._running = f"{content.title}: traffic occupancy"
        self._foot = f"Times: {content.zone}. Made by {content.made_by}."
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self.add_font(FONT, "", fonts / "DejaVuSans.ttf")
        self.add_font(FONT, "B", fonts / "DejaVuSans-Bold.ttf")
        self.c_margin = 0.0  # text and pictures begin at one line
        self.set_margins(MARGIN, TOP, MARGIN)
        self.set_auto_page_break(auto=True, margin=FOOT)
        self.set_lang("en")
        self.set_title(f"{content.title}: traffic occupancy, {content.subtitle}")
        self.set_creator(content.made_by)
        self.set_subject("Occupancy of lanes, from roadside radar")
        self.viewer_preferences = ViewerPreferences(display_doc_title=True)
        self.alias_nb_pages()

    def header(self) -> None:
        """Write the running head, but on the first page, which has the title."""
        if self.page_no() == 1:
            return
        self.set_y(10.0)
        self.say(self._fitting(self._running, self.epw), size=7.5, colour=SOFT)
        self.set_draw_color(LINE)
        self.line(MARGIN, 15.0, self.w - MARGIN, 15.0)
        self.set_y(TOP)

    def footer(self) -> None:
        """Write the page number, and in which zone the times are."""
        self.set_y(-12.0)
        self.set_font(FONT, size=7.5)
        self.set_text_color(SOFT)
        self.cell(self.epw * 0.8, 4, self._fitting(self._foot, self.epw * 0.78))
        self.cell(self.epw * 0.2, 4, f"Page {self.page_no()} of {{nb}}", align="R")

    def _fitting(self, text: str, width: float) -> str:
        """Return a text that fits on one line."""
        self.set_font(FONT, size=7.5)
        if self.get_string_width(text) <= width:
            return text
        while text and self.get_string_width(f"{text}…") > width:
            text = text[:-1]
        return f"{text}…"

    def say(
        self,
        text: str,
        *,
        size: float = 9.0,
        bold: bool = False,
        colour: tuple[int, int, int] = INK,
        width: float = 0.0,
    ) -> None:
        """Write a paragraph below what is there."""
        self.set_font(FONT, "B" if bold else "", size)
        self.set_text_color(colour)
        self.multi_cell(width, size * 0.5, text, align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)

    def chapter(self, title: str, least: float = 45.0) -> None:
        """Begin a chapter; on a new page where less than `least` millimetres are left."""
        if self.room < least:
            self.add_page()
        self.ln(5)
        self.start_section(title)
        self.say(title, size=14, bold=True)
        self.set_draw_color(INK)
        self.set_line_width(0.4)
        self.line(MARGIN, self.get_y() + 1, self.w - MARGIN, self.get_y() + 1)
        self.set_line_width(0.2)
        self.ln(3.5)

    @property
    def room(self) -> float:
        """Millimetres left on the page."""
        return float(self.h - FOOT - self.get_y())


def add_figure(paper: Paper, figure: Figure, tallest: float) -> None:
    """Draw a picture with its caption, on a new page where it does not fit."""
    height = min(paper.epw * figure.height / figure.width, tallest)
    width = height * figure.width / figure.height
    if paper.room < height + 14:
        paper.add_page()
    top = paper.get_y() + 2
    paper.image(BytesIO(figure.png), MARGIN, top, width, height, alt_text=figure.alt)
    add_frame(paper, MARGIN, top, width, height)
    paper.set_xy(MARGIN, top + height + 1.5)
    paper.say(figure.caption, size=8, colour=SOFT)
    paper.ln(2)


def add_table(paper: Paper, content: Table) -> None:
    """Draw a table; its head comes again on each page."""
    if paper.room < 30:
        paper.add_page()
    paper.ln(1)
    paper.say(content.caption, size=9.5, bold=True)
    paper.ln(1)
    if content.rows:
        _add_rows(paper, content)
    if content.note:
        paper.ln(1.5)
        paper.say(content.note, size=7.5, colour=SOFT)
    paper.ln(2)


def _add_rows(paper: Paper, content: Table) -> None:
    paper.set_font(FONT, size=7)
    paper.set_text_color(INK)
    paper.set_draw_color(LINE)
    paper.set_fill_color(255)
    columns = content.columns
    with paper.table(
        col_widths=tuple(column.width for column in columns),
        text_align=tuple("RIGHT" if column.is_number else "LEFT" for column in columns),
        headings_style=FontFace(emphasis="BOLD", color=INK, fill_color=LINE),
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        cell_fill_color=WASH, cell_fill_mode=TableCellFillMode.EVEN_ROWS,
        line_height=3.6, padding=(0.8, 1.2), repeat_headings=1, v_align="T",
    ) as table:  # fmt: skip
        table.row([f"{each.title}\n{each.unit}" if each.unit else each.title for each in columns])
        for cells in content.rows:
            table.row(list(cells))


def add_frame(paper: Paper, left: float, top: float, width: float, height: float) -> None:
    """Draw a thin line around a picture."""
    paper.set_draw_color(LINE)
    paper.rect(left, top, width, height)

"""Write a report's content as one HTML file with all inside, and the same as PDF on A4."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import matplotlib as mpl
import numpy as np
from fpdf import FPDF, ViewerPreferences
from fpdf.enums import MethodReturnValue, TableBordersLayout, TableCellFillMode, XPos, YPos
from fpdf.fonts import FontFace
from fpdf.line_break import BREAKING_SPACE_SYMBOLS_STR
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image

from gis_radar.arrays import Floats
from gis_radar.heatmap import style
from gis_radar.heatmap.picture import INK, SENSOR, SOFT, STRIPE, legend_in_words
from gis_radar.report.content import WORDS, Content, Figure, MapSeries, Table, Terms
from gis_radar.words import THIN, current_language, tr

LINE, WASH, AMBER, AMBER_WASH = "#d5dade", "#f3f5f7", "#b26a00", "#fff6e0"
MARGIN, TOP, FOOT = 16.0, 20.0, 18.0  # of a page, millimetres, as all lengths here
FONT = "DejaVu"
LEGEND, GAP = 44.0, 4.0
BESIDE = 1.0  # of a cell, on either side of its text
TALLEST_MAP = 165.0
LEAST_SHARE = 0.8  # of a picture's height where room is scarce
TITLE, HEADING, LEAD, BODY, SMALL, CELL = (
    22.0,
    14.0,
    11.0,
    9.5,
    8.5,
    8.0,
)  # points; no words are smaller
CROWDED = (7.5, 7.0)  # but those of a table that is wider than the page
FACTS_ACROSS = 3
REST = 3.6  # of a line below a figure
MAP_PIXELS = 1500  # width of the map

Box = tuple[float, float, float, float]  # left, top, width, height, millimetres


def page_of(content: Content) -> str:
    """Return the page; all text of others is escaped, and the policy lets nothing else in."""
    named = style.WORDS[content.measure]
    hatched = {style.NOT_OBSERVED: "unseen", style.UNCERTAIN: "unsure"}
    legend = [
        (hatched.get(colour, f"class-{colour[1:]}"), colour, label)
        for colour, label in legend_in_words(content.measure)
    ]
    classes = "".join(
        f".{name} {{ background: {colour}; }}\n"
        for name, colour, _ in legend
        if colour not in hatched
    )
    css, script = _part("page.css") + classes + _map_css(content.map), _part("page.js")
    return _template().render(
        report=content,
        legend=legend,
        legend_title=tr(named.title),
        legend_subtitle=tr(named.subtitle),
        words=WORDS[content.measure],
        language=current_language(),
        tr=tr,
        css=Markup(css),  # noqa: S704 - our own file
        script=Markup(script),  # noqa: S704 - our own file
        policy=_policy(css, script),
        data_uri=_data_uri,
        share=lambda part: f"{part * 100:.6g}%",
    )


def _policy(css: str, script: str) -> str:
    """Return the Content-Security-Policy: pictures in the page, our style, our script."""
    return (
        "default-src 'none'; img-src data:; "
        f"style-src '{_hash(css)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _map_css(part: MapSeries) -> str:
    """Return how large the map may be: whole in the window, and beside its words on paper."""
    shape = f"{part.whole.width} / {part.whole.height}"
    return (
        "@media screen and (min-width: 52rem) { .plate { grid-template-columns: "
        f"minmax(0, calc(max(22rem, min(58rem, 88vh)) * {shape})) 18rem; }} }}\n"
        f"@media print {{ .large .sheet {{ max-width: calc(116mm * {shape}); }} }}\n"
    )


def _data_uri(picture: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(picture).decode()


@cache
def _template() -> Template:
    text = _part("page.html")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        finalize=bound,
    )  # fmt: skip
    return environment.from_string(text)


def bound(value: Any) -> Any:
    """Return a text in which no line ends between a number and its percent sign."""
    is_plain = isinstance(value, str) and not isinstance(value, Markup)
    return re.sub(r"(\d) %", rf"\1{THIN}%", value) if is_plain else value


def _part(name: str) -> str:
    return files("gis_radar.report").joinpath(name).read_text(encoding="utf-8")


class Paper(FPDF):
    """Pages of A4 with a running head and page numbers.

    Parameters
    ----------
    content : Content
        Whose title and time stand on each page.
    """

    def __init__(self, content: Content) -> None:
        super().__init__(format="A4")
        words = WORDS[content.measure]
        self._running = f"{content.title}: {tr(words.title)}"
        text = "Times: {zone}. Made by {software}."
        self._foot = tr(text, zone=content.zone, software=content.made_by)
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self.add_font(FONT, "", fonts / "DejaVuSans.ttf")
        self.add_font(FONT, "B", fonts / "DejaVuSans-Bold.ttf")
        self.c_margin = 0.0  # text and pictures begin at one line
        self.set_margins(MARGIN, TOP, MARGIN)
        self.set_auto_page_break(auto=True, margin=FOOT)
        self.set_lang(current_language())
        self.set_title(f"{self._running}, {content.subtitle}")
        self.set_creator(content.made_by)
        self.set_subject(tr(words.kind))
        self.viewer_preferences = ViewerPreferences(display_doc_title=True)
        self.alias_nb_pages()

    def header(self) -> None:
        """Write the running head, but on the first page, which has the title."""
        if self.page_no() == 1:
            return
        self.set_y(10.0)
        self.write_paragraph(self._fitting(self._running, self.epw), size=SMALL, colour=SOFT)
        self.set_draw_color(LINE)
        self.line(MARGIN, 15.0, self.w - MARGIN, 15.0)
        self.set_y(TOP)

    def footer(self) -> None:
        """Write the page number, and in which zone the times are."""
        self.set_y(-12.0)
        self.write_with(SMALL, colour=SOFT)
        self.cell(self.epw * 0.8, 4, self._fitting(self._foot, self.epw * 0.78))
        page = tr("Page {n} of {all}", n=self.page_no(), all="{nb}")
        self.cell(self.epw * 0.2, 4, page, align="R")

    def _fitting(self, text: str, width: float) -> str:
        """Return a text that fits on one line."""
        self.set_font(FONT, size=SMALL)
        if self.get_string_width(text) <= width:
            return text
        while text and self.get_string_width(f"{text}…") > width:
            text = text[:-1]
        return f"{text}…"

    def write_with(self, size: float, *, bold: bool = False, colour: str = INK) -> None:
        """Take a font for what is written next."""
        self.set_font(FONT, "B" if bold else "", size)
        self.set_text_color(colour)

    def write_line(
        self, left: float, top: float, text: str, size: float, *, bold: bool = False,
        colour: str = INK, width: float = LEGEND,
    ) -> None:  # fmt: skip
        """Write a line at a place, smaller where it would be too wide."""
        self.write_with(size, bold=bold, colour=colour)
        while self.get_string_width(text) > width and self.font_size_pt > 5:
            self.set_font_size(self.font_size_pt - 0.5)
        self.set_xy(left, top)
        self.cell(width, 4.0, text)

    def write_paragraph(
        self,
        text: str,
        *,
        size: float = BODY,
        bold: bool = False,
        colour: str = INK,
        width: float = 0.0,
    ) -> None:
        """Write a paragraph below what is there."""
        self.write_with(size, bold=bold, colour=colour)
        self.multi_cell(
            width, size * 0.5, bound(text), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT
        )

    def chapter(self, title: str, least: float = 45.0) -> None:
        """Begin a chapter; on a new page where less than `least` millimetres are left."""
        if self.room < least:
            self.add_page()
        self.ln(5)
        self.start_section(title)
        self.write_paragraph(title, size=HEADING, bold=True)
        self.set_draw_color(INK)
        self.set_line_width(0.4)
        self.line(MARGIN, self.get_y() + 1, self.w - MARGIN, self.get_y() + 1)
        self.set_line_width(0.2)
        self.ln(3.5)

    @property
    def room(self) -> float:
        """Millimetres left on the page."""
        return float(self.h - FOOT - self.get_y())


def _add_figure(paper: Paper, figure: Figure) -> None:
    """Draw a picture with its caption, on a new page where it does not fit, or hardly smaller."""
    height = min(paper.epw * figure.height / figure.width, figure.tallest_mm)
    paper.write_with(SMALL)
    caption_mm = paper.multi_cell(
        0, SMALL * 0.5, figure.caption, align="L", dry_run=True, output=MethodReturnValue.HEIGHT
    )
    below = 6.0 + cast("float", caption_mm)
    if paper.room - below < LEAST_SHARE * height:
        paper.add_page()
    height = min(height, paper.room - below)
    width = height * figure.width / figure.height
    top = paper.get_y() + 2
    _add_picture(paper, BytesIO(figure.png), figure.alt, (MARGIN, top, width, height))
    paper.set_xy(MARGIN, top + height + 1.5)
    paper.write_paragraph(figure.caption, size=SMALL, colour=SOFT)
    paper.ln(2)


def _add_terms(paper: Paper, part: Terms) -> None:
    for term, meaning in part.terms:
        if paper.room < 22:
            paper.add_page()
        paper.write_with(BODY)
        text = bound(f"**{term}:** {meaning}")
        paper.multi_cell(
            0, BODY * 0.5, text, align="L", markdown=True, new_x=XPos.LMARGIN, new_y=YPos.NEXT
        )
        paper.ln(1.8)


def _add_table(paper: Paper, content: Table) -> None:
    """Draw a table; its head comes again on each page."""
    if paper.room < 30:
        paper.add_page()
    paper.ln(1)
    paper.write_paragraph(content.caption, bold=True)
    paper.ln(1)
    if content.rows:
        _add_rows(paper, content)
    if content.note:
        paper.ln(1.5)
        paper.write_paragraph(content.note, size=SMALL, colour=SOFT)
    for name, text in content.files:
        paper.ln(0.5)
        paper.write_with(SMALL, colour=SENSOR)
        paper.cell(paper.get_string_width(name) + 0.5, 4.0, name, link=name)
        paper.write_with(SMALL, colour=SOFT)
        paper.cell(0, 4.0, f": {text}", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    paper.ln(2)


def _add_rows(paper: Paper, content: Table) -> None:
    size, widths = _fitted(paper, content)
    paper.write_with(size)
    paper.set_draw_color(LINE)
    paper.set_fill_color(255)
    columns = content.columns
    with paper.table(
        col_widths=widths,
        text_align=tuple("RIGHT" if column.is_number else "LEFT" for column in columns),
        headings_style=FontFace(emphasis="BOLD", color=INK, fill_color=LINE),
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        cell_fill_color=WASH, cell_fill_mode=TableCellFillMode.EVEN_ROWS,
        line_height=4.0, padding=(0.8, BESIDE), repeat_headings=1, v_align="T",
    ) as table:  # fmt: skip
        table.row([f"{each.title}\n{each.unit}" if each.unit else each.title for each in columns])
        for cells in content.rows:
            table.row(list(map(bound, cells)))


def _fitted(paper: Paper, content: Table) -> tuple[float, tuple[float, ...]]:
    """Return the size of a table's words, and its columns' shares of the page.

    No word is broken where there is room for it: in smaller letters, if need be.
    """
    wanted = np.array([column.width for column in content.columns])
    wanted *= paper.epw / wanted.sum()
    for size in (CELL, *CROWDED):
        heads, cells = _longest_words(paper, content, size)
        if (widths := _shares(wanted, np.maximum(heads, cells))) is not None:
            return size, widths
    heads, _ = _longest_words(paper, content, CELL)
    return CELL, _shares(wanted, heads) or tuple(wanted)


def _longest_words(paper: Paper, content: Table, size: float) -> tuple[Floats, Floats]:
    """Return by column how wide the longest word of its head is, and of its cells."""
    paper.write_with(size, bold=True)
    heads = [_longest_word(paper, f"{each.title} {each.unit}") for each in content.columns]
    paper.write_with(size)
    cells = [_longest_word(paper, " ".join(texts)) for texts in zip(*content.rows, strict=True)]
    return np.array(heads), np.array(cells)


def _shares(wanted: Floats, least: Floats) -> tuple[float, ...] | None:
    """Return widths of columns, none below its least; None where the page is too narrow."""
    over = wanted - least
    lacking = -over[over < 0].sum()
    if lacking > over[over > 0].sum():
        return None
    # what columns lack is taken from the others by what they have to spare
    spare = np.maximum(over, 0.0)
    return tuple(least + spare * (1.0 - lacking / max(spare.sum(), 1e-9)))


def _longest_word(paper: Paper, text: str) -> float:
    """Return the width that the longest word of a cell takes, with the room beside it."""
    words = re.split(f"[\n{BREAKING_SPACE_SYMBOLS_STR}]", text)
    return max(paper.get_string_width(each) for each in words) + 2 * BESIDE + 0.1


def _add_picture(paper: Paper, picture: Image.Image | BytesIO, alt: str, box: Box) -> None:
    """Draw a picture with a thin line around it."""
    paper.image(picture, *box, alt_text=alt)
    paper.set_draw_color(LINE)
    paper.rect(*box)


def write_pdf(content: Content, path: Path) -> None:
    """Write the report as PDF.

    Parameters
    ----------
    content : Content
        What to write.
    path : Path
        The file. The same content gives the same bytes.
    """
    paper = Paper(content)
    # Not the time of writing: what was made of the same data is the same.
    paper.set_creation_date(content.until)
    paper.add_page()
    _add_title(paper, content)
    _add_map(paper, content)
    for chapter in content.chapters:
        paper.chapter(chapter.title, chapter.least_mm)
        for part in chapter.parts:
            if isinstance(part, Table):
                _add_table(paper, part)
            elif isinstance(part, Figure):
                _add_figure(paper, part)
            else:
                _add_terms(paper, part)
    paper.output(str(path))


def _add_title(paper: Paper, content: Content) -> None:
    paper.start_section(tr("In short"))
    kind = tr(WORDS[content.measure].kind).upper()
    paper.write_paragraph(kind, size=SMALL, bold=True, colour=SENSOR)
    paper.ln(0.5)
    paper.write_paragraph(content.title, size=TITLE, bold=True)
    paper.ln(1)
    paper.write_paragraph(content.subtitle, size=LEAD)
    paper.write_paragraph(tr("All times: {zone}.", zone=content.zone), colour=SOFT)
    paper.ln(3)
    _add_facts(paper, content)
    see = tr("see: What the words mean")
    paper.write_paragraph(f"{content.intro} ({see}).")
    if content.remarks:
        paper.ln(2)
        paper.write_paragraph(tr("Read this first"), bold=True)
        paper.ln(1)
        for remark in content.remarks:
            _add_remark(paper, remark)
    paper.chapter(tr("What this rests on"), 60.0)
    _add_table(paper, content.basis)


def _add_facts(paper: Paper, content: Content) -> None:
    """Draw the figures in rows."""
    begin, width = paper.get_y(), (paper.epw - 2 * (FACTS_ACROSS - 1)) / FACTS_ACROSS
    paper.write_with(SMALL)
    rests = [paper.multi_cell(width - 5, REST, fact.rests, align="L", padding=0, dry_run=True,
                              output=MethodReturnValue.HEIGHT)
             for fact in content.facts]  # fmt: skip
    tall = 14.2 + max((cast("float", each) for each in rests), default=0.0)
    for i, fact in enumerate(content.facts):
        row, column = divmod(i, FACTS_ACROSS)
        left, top = MARGIN + column * (width + 2), begin + row * (tall + 2)
        paper.set_fill_color(WASH)
        paper.rect(left, top, width, tall, style="F")
        paper.set_fill_color(SENSOR)
        paper.rect(left, top, 0.9, tall, style="F")
        paper.write_line(left + 3, top + 1.7, fact.name, SMALL, colour=SOFT, width=width - 5)
        paper.write_line(left + 3, top + 7.0, fact.value, LEAD, bold=True, width=width - 5)
        paper.set_xy(left + 3, top + 12.6)
        paper.write_with(SMALL, colour=SOFT)
        paper.multi_cell(width - 5, REST, fact.rests, align="L", padding=0)
    paper.set_xy(MARGIN, begin + -(-len(content.facts) // FACTS_ACROSS) * (tall + 2) + 2)


def _add_remark(paper: Paper, text: str) -> None:
    paper.write_with(BODY)
    paper.set_fill_color(AMBER_WASH)
    paper.set_draw_color(AMBER)
    paper.multi_cell(
        0, 4.6, text, align="L", fill=True, border="L", padding=(1, 3),
        new_x=XPos.LMARGIN, new_y=YPos.NEXT,
    )  # fmt: skip
    paper.ln(1)


def _add_map(paper: Paper, content: Content) -> None:
    part, figure = content.map, content.map.whole
    paper.chapter(tr("Map, whole time"), 150)
    note_room = 26.0
    width = paper.epw - LEGEND - GAP
    shape = figure.height / figure.width
    height = min(width * shape, TALLEST_MAP, paper.room - note_room)
    top = paper.get_y()
    image = _composed(figure.png, part.overlay, MAP_PIXELS)
    _add_picture(paper, image, figure.alt, (MARGIN, top, height / shape, height))
    beside = _add_legend(paper, MARGIN + height / shape + GAP, top, content.measure)
    paper.set_xy(MARGIN, max(top + height, beside) + 2)
    paper.write_paragraph(figure.caption)
    paper.write_paragraph(part.caption, size=SMALL, colour=SOFT)


def _add_legend(paper: Paper, left: float, top: float, measure: str) -> float:
    """Draw the classes of the map, highest first; return where it ends."""
    named, classes = style.WORDS[measure], legend_in_words(measure)
    paper.write_line(left, top, tr(named.title), BODY, bold=True)
    paper.write_line(left, top + 4.4, tr(named.subtitle), SMALL, colour=SOFT)
    for i, (colour, label) in enumerate(classes):
        y = top + 10.5 + i * 6
        _add_swatch(paper, left, y, colour)
        paper.write_line(left + 11, y + 0.3, label, SMALL, width=LEGEND - 11)
    return top + 10.5 + len(classes) * 6


def _add_swatch(paper: Paper, left: float, top: float, colour: str) -> None:
    """Draw a field of a colour; what is uncertain is hatched, over pale colours and deep ones."""
    paper.set_draw_color(SOFT)
    pale, deep = style.RAMP[0], style.RAMP[4]
    if colour == style.UNCERTAIN:
        for x, fill in ((left, pale), (left + 4.5, deep)):
            paper.set_fill_color(fill)
            paper.rect(x, top, 4.5, 4.6, style="F")
    else:
        paper.set_fill_color(colour)
        paper.rect(left, top, 9, 4.6, style="F")
    for k in range(1, 6) if colour in {style.NOT_OBSERVED, style.UNCERTAIN} else ():
        x, low, high = left + 1.8 * k - 1.2, 4.5, 0.1
        paper.set_draw_color(STRIPE)
        if colour == style.UNCERTAIN:
            low, high = high, low
            paper.set_draw_color(style.HATCH_DARK if k < 3 else style.HATCH_LIGHT)
        paper.line(x, top + low, x + 1.2, top + high)
    paper.set_draw_color(SOFT)
    paper.rect(left, top, 9, 4.6)


def _composed(picture: bytes, overlay: bytes | None, width: int) -> Image.Image:
    """Return a map with its overlay, no wider than that."""
    image: Image.Image = Image.open(BytesIO(picture))
    if overlay is not None:
        # Versions of Matplotlib round the size of a picture up or down.
        over = Image.open(BytesIO(overlay)).convert("RGBA").resize(image.size)
        image = Image.alpha_composite(image.convert("RGBA"), over)
    image = image.convert("RGB")
    image.thumbnail((width, 4 * width), Image.Resampling.LANCZOS)
    return image

"""Write a report's content as one HTML file with all inside."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import sys
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FunctionLoader, StrictUndefined, Template
from markupsafe import Markup

from gis_radar.base import (
    THIN_SPACE,
    OutputError,
    Text,
    current_language,
    run_child,
    scratch_folder,
    tr,
)
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.picture import legend_in_words
from gis_radar.products.report.content import REPORT_WORDS, Content, MapSeries
from gis_radar.products.report.printing import MISSING


def page_of(content: Content) -> str:
    """Return the page; texts are escaped, and its policy loads nothing from elsewhere."""
    map_words = style.MAP_WORDS[content.measure]
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
    return render_page(
        _part("page.html"),
        css=classes + _size_and_page_css(content.map),
        script=_part("page.js"),
        report=content,
        legend=legend,
        legend_title=tr(map_words.title),
        legend_subtitle=tr(map_words.subtitle),
        words=REPORT_WORDS[content.measure],
    )


def render_page(template: str, *, css: str, script: str = "", **values: Any) -> str:
    """Return a page in the look of the report, whose policy lets in only what it holds.

    Parameters
    ----------
    template : str
        Jinja template with `css`, `script`, `policy` and `language`; it may take the macros of
        `parts.html`.
    css, script : str
        Rules after those of the report, and the only script.
    **values
        Further values of the template; their texts are escaped.
    """
    style = _part("page.css") + css
    page: str = _compiled(template).render(
        css=Markup(style),  # noqa: S704 - our own file
        script=Markup(script),  # noqa: S704 - our own file
        policy=_policy(style, script),
        language=current_language(),
        **values,
    )
    return page


def _policy(css: str, script: str) -> str:
    """Return the Content-Security-Policy: pictures in the page, our style, our script."""
    return (
        "default-src 'none'; img-src data:; "
        f"style-src '{_hash(css)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _size_and_page_css(part: MapSeries) -> str:
    """Return CSS for the size of the map, in the window and on paper, and for page numbers."""
    shape = f"{part.whole.width} / {part.whole.height}"
    page = tr("Page {n} of {all}", n='" counter(page) "', all='" counter(pages) "')
    return (
        "@media screen and (min-width: 52rem) { .plate { grid-template-columns: "
        f"minmax(0, calc(max(22rem, min(58rem, 88vh)) * {shape})) 18rem; }} }}\n"
        f"@media print {{ .large {{ flex: none; width: min(128mm, calc(95mm * {shape})); }} "
        f'@page {{ @bottom-right {{ content: "{page}"; }} }} }}\n'
    )


def _data_uri(picture: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(picture).decode()


@cache
def _compiled(template: str) -> Template:
    """Return a template that is compiled once: that takes longer than to fill it in."""
    return _environment().from_string(template)


@cache
def _environment() -> Environment:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        finalize=bound_percents, loader=FunctionLoader(_part),
    )  # fmt: skip
    environment.globals |= {"tr": tr, "data_uri": _data_uri, "share": _share}
    return environment


def _share(part: float) -> str:
    """Return a share of a width as SVG takes it."""
    return f"{part * 100:.6g}%"


def bound_percents(value: Any) -> Any:
    """Return a text in which no line ends between a number and its percent sign."""
    is_plain = isinstance(value, str) and not isinstance(value, Markup)
    return re.sub(r"(\d) %", rf"\1{THIN_SPACE}%", value) if is_plain else value


def _part(name: str) -> str:
    return files("gis_radar.products.report").joinpath(name).read_text(encoding="utf-8")


_FONT = "DejaVu Sans of Matplotlib"  # the same on every machine
_FONT_FILES = {"normal": "DejaVuSans.ttf", "bold": "DejaVuSans-Bold.ttf"}


def write_pdf(content: Content, path: Path) -> None:
    """Write the page as PDF, with the map of the whole time.

    Nothing is written where WeasyPrint, or a system library that it calls, is missing. It runs in a
    process of its own: Pango ends its process where memory runs out.

    Parameters
    ----------
    content : Content
        Content of the report.
    path : Path
        The file. The same content gives the same bytes.

    Raises
    ------
    OutputError
        If the file cannot be written, or WeasyPrint fails.
    """
    still = replace(content, map=replace(content.map, frames=()))
    with scratch_folder() as folder:
        (folder / "page.html").write_text(page_of(still), encoding="utf-8")
        (folder / "letters.css").write_text(_font_css(), encoding="utf-8")
        # Not the time of writing, so that the same data give the same bytes.
        date = content.until.isoformat(timespec="seconds")
        command = (
            sys.executable,
            "-P",
            "-m",
            "gis_radar.products.report.printing",
            folder,
            path,
            date,
        )
        with Path(os.devnull).open("rb") as nothing, (folder / "said").open("w+b") as error_file:
            code = run_child(
                list(map(str, command)), stdin=nothing, stderr=error_file, waiting=lambda _: None,
                environment={**os.environ, "TMPDIR": str(folder)},
            )  # fmt: skip
            error_file.seek(0)
            lines = error_file.read().decode(errors="replace").strip().splitlines()
    if code not in {0, MISSING}:
        reason = lines[-1] if lines and code > 0 else Text("WeasyPrint ended with {}", code)
        raise OutputError("{}: cannot be written: {}", path, reason)


def _font_css() -> str:
    """Return CSS that sets all text in the font that Matplotlib brings along."""
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    faces = [
        f'@font-face {{ font-family: "{_FONT}"; font-weight: {weight}; '
        f"src: url({(folder / name).as_uri()}); }}"
        for weight, name in _FONT_FILES.items()
    ]
    family = f'{{ font-family: "{_FONT}"; }}'
    return "\n".join([*faces, f"body {family} @page {family}"])

"""Write a report as PDF: its page on A4, laid out by WeasyPrint where that is installed."""

from __future__ import annotations

from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl

from gis_radar.report.content import WORDS, Content
from gis_radar.report.pages import page_of
from gis_radar.words import tr

FONT = "DejaVu Sans of Matplotlib"  # the same letters, whatever fonts the machine has
LETTERS = {"normal": "DejaVuSans.ttf", "bold": "DejaVuSans-Bold.ttf"}


@cache
def weasyprint() -> Any | None:
    """Return the package; None where it, or a system library that it calls, is missing."""
    try:
        with redirect_stdout(StringIO()):  # it prints which library is missing
            import weasyprint  # noqa: PLC0415 - of the extra pdf
            from weasyprint.text import fonts  # noqa: F401, PLC0415
    except (ImportError, OSError):
        return None
    weasyprint.LOGGER.setLevel("CRITICAL")  # it remarks on each rule that is for browsers
    return weasyprint


def write_pdf(content: Content, path: Path) -> None:
    """Write the page as PDF, with the map of the whole time.

    Parameters
    ----------
    content : Content
        What to write.
    path : Path
        The file. The same content gives the same bytes.
    """
    if (library := weasyprint()) is None:
        raise ModuleNotFoundError("weasyprint")
    still = replace(content, map=replace(content.map, frames=()))
    fonts = library.text.fonts.FontConfiguration()
    # The page brings its pictures along; nothing else is fetched.
    reader = library.urls.URLFetcher(allowed_protocols=("data", "file"))
    letters = library.CSS(string=_letters(), font_config=fonts, url_fetcher=reader)
    page = library.HTML(string=page_of(still), url_fetcher=reader)
    paper = page.render(stylesheets=[letters], font_config=fonts)
    paper.metadata.description = tr(WORDS[content.measure].kind)
    # Not the time of writing: what was made of the same data is the same.
    paper.metadata.created = content.until.isoformat(timespec="seconds")
    paper.write_pdf(path, pdf_tags=True)


def _letters() -> str:
    """Return CSS that sets all words in the letters that Matplotlib brings along."""
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    faces = [
        f'@font-face {{ font-family: "{FONT}"; font-weight: {weight}; '
        f"src: url({(folder / name).as_uri()}); }}"
        for weight, name in LETTERS.items()
    ]
    return "\n".join(
        [*faces, f'body {{ font-family: "{FONT}"; }} @page {{ font-family: "{FONT}"; }}']
    )

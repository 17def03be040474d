"""Lay out a page as PDF: the process that :mod:`~gis_radar.products.report.pages` starts."""

from __future__ import annotations

import sys
from pathlib import Path

MISSING = 69  # exit code where WeasyPrint, or a system library that it calls, is missing


def print_page(folder: Path, path: str, date: str) -> None:
    """Write `page.html` of a folder as PDF, by its style and `letters.css`.

    Parameters
    ----------
    folder : Path
        The folder.
    path : str
        The PDF.
    date : str
        Date of the PDF, ISO 8601.
    """
    try:
        from weasyprint import CSS, HTML, LOGGER  # noqa: PLC0415 - of the extra pdf
        from weasyprint.text.fonts import FontConfiguration  # noqa: PLC0415
        from weasyprint.urls import URLFetcher  # noqa: PLC0415
    except (ImportError, OSError):
        sys.exit(MISSING)
    LOGGER.setLevel("CRITICAL")  # it warns of each CSS rule that is for browsers
    fonts = FontConfiguration()
    # The page brings its pictures along; nothing else is fetched.
    fetcher = URLFetcher(allowed_protocols=("data", "file"))
    font_css = CSS(folder / "letters.css", font_config=fonts, url_fetcher=fetcher)
    page = HTML(string=(folder / "page.html").read_text(encoding="utf-8"), url_fetcher=fetcher)
    document = page.render(stylesheets=[font_css], font_config=fonts)
    document.metadata.created = date
    document.write_pdf(path, pdf_tags=True)


if __name__ == "__main__":
    print_page(Path(sys.argv[1]), sys.argv[2], sys.argv[3])

"""Write a report as PDF: its page on A4, laid out by WeasyPrint where that is installed."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

from gis_radar.base import OutputError, Text, run_child, scratch_folder
from gis_radar.products.report.content import Content
from gis_radar.products.report.pages import page_of
from gis_radar.products.report.printing import MISSING

FONT = "DejaVu Sans of Matplotlib"  # the same letters, whatever fonts the machine has
LETTERS = {"normal": "DejaVuSans.ttf", "bold": "DejaVuSans-Bold.ttf"}


def write_pdf(content: Content, path: Path) -> None:
    """Write the page as PDF, with the map of the whole time.

    Nothing is written where WeasyPrint, or a system library that it calls, is missing. It runs in a
    process of its own: Pango ends its process where memory runs out.

    Parameters
    ----------
    content : Content
        What to write.
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
        (folder / "letters.css").write_text(_letters(), encoding="utf-8")
        # Not the time of writing: what was made of the same data is the same.
        made = content.until.isoformat(timespec="seconds")
        command = (
            sys.executable,
            "-P",
            "-m",
            "gis_radar.products.report.printing",
            folder,
            path,
            made,
        )
        with Path(os.devnull).open("rb") as nothing, (folder / "said").open("w+b") as said:
            code = run_child(
                list(map(str, command)), stdin=nothing, stderr=said, waiting=lambda _: None,
                environment={**os.environ, "TMPDIR": str(folder)},
            )  # fmt: skip
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines()
    if code not in {0, MISSING}:
        reason = lines[-1] if lines and code > 0 else Text("WeasyPrint ended with {}", code)
        raise OutputError("{}: cannot be written: {}", path, reason)


def _letters() -> str:
    """Return CSS that sets all words in the letters that Matplotlib brings along."""
    folder = Path(mpl.get_data_path()) / "fonts" / "ttf"
    faces = [
        f'@font-face {{ font-family: "{FONT}"; font-weight: {weight}; '
        f"src: url({(folder / name).as_uri()}); }}"
        for weight, name in LETTERS.items()
    ]
    family = f'{{ font-family: "{FONT}"; }}'
    return "\n".join([*faces, f"body {family} @page {family}"])

"""Texts of the plugin in the language of QGIS: English in the code, others from the catalogue.

The catalogue is that of gis_radar: `base/languages` in the package, below `resources` in the zip.
"""

from __future__ import annotations

import runpy
from functools import cache
from pathlib import Path

# Clockwise from north, as the command line takes them.
WINDS = (
    "north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west",
)  # fmt: skip
HERE = Path(__file__).resolve().parent


def shared(name: str) -> Path:
    """Return a file that the plugin shares with gis_radar: its own copy, or the checkout's.

    Parameters
    ----------
    name : str
        From the folder of the package, as tools/plugin_zip.py lists it.
    """
    installed = HERE / "resources"
    return (installed if installed.is_dir() else HERE.parents[1] / "gis_radar") / name


@cache
def dictionary(language: str) -> dict[str, str]:
    """Return the translations into a language (`de`), empty where there are none."""
    folder = shared("base/languages")
    path = folder / language / "LC_MESSAGES" / "gis_radar.po"
    if not path.is_file():
        return {}
    # Not imported: QGIS's Python has no gis_radar.
    words: dict[str, str] = runpy.run_path(str(folder / "po.py"))["read_catalogue"](path)
    return words


def language() -> str:
    """Return the language of QGIS, as two letters."""
    try:
        from qgis.core import QgsApplication  # noqa: PLC0415 - words work without QGIS
    except ImportError:
        return "en"
    qgis = QgsApplication.instance()
    # The locale does not know of `qgis --lang de`.
    return str(qgis.translation() or qgis.locale())[:2] if qgis else "en"


def speaks_german() -> bool:
    """Return whether dates and numbers are written the German way."""
    return language() == "de"


def tr(text: str) -> str:
    """Return a text in the language of QGIS."""
    return dictionary(language()).get(text, text)

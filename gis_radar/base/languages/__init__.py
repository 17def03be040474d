"""Translations: texts are English in the code, other languages come from a catalogue.

There is one catalogue a language for the package and the QGIS plugin, in gettext's format:
`de/LC_MESSAGES/gis_radar.po`, by English text and sorted. Errors, hints and warnings have a hole
`{}` for each value; in the translation `{0}` is the first of them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from gis_radar.base.languages.po import read_catalogue

LANGUAGES = ("en", "de")
# the environment variable that the plugin sets for its worker
_LANGUAGE_VARIABLE = "GIS_RADAR_LANGUAGE"
_SYSTEM_VARIABLES = ("LANGUAGE", "LC_ALL", "LC_MESSAGES", "LANG")  # as gettext asks them


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Return the translations into a language by English text; none for English itself."""
    path = Path(__file__).with_name(language) / "LC_MESSAGES" / "gis_radar.po"
    return read_catalogue(path) if path.is_file() else {}


def users_language(*, chosen_only: bool = False) -> str:
    """Return the language that the environment names; English where it has no catalogue.

    Parameters
    ----------
    chosen_only : bool
        Whether only `GIS_RADAR_LANGUAGE` counts, and not the language of the system.
    """
    names = (_LANGUAGE_VARIABLE,) if chosen_only else (_LANGUAGE_VARIABLE, *_SYSTEM_VARIABLES)
    wanted = next((os.environ[name] for name in names if os.environ.get(name)), "")
    short = (each[:2] for each in wanted.split(":"))
    return next((each for each in short if each in LANGUAGES), LANGUAGES[0])


def translated(text: str, language: str) -> str:
    """Return a text in a language, in English where there is no translation."""
    return catalogue(language).get(text, text)


def column_title(title: str, language: str) -> str:
    """Return the title of a column in a language; `Hit (s) 2025-06-12T07:30Z` ends in a time."""
    words, _, time = title.rpartition(" ") if title.endswith("Z") else (title, "", "")
    return f"{translated(words, language)} {time}".strip()


def class_label(label: str, language: str) -> str:
    """Return the label of a class of a legend in a language: `2 to 5 %` has words in it."""
    if label in catalogue(language):
        return translated(label, language)
    for words in ("never hit", "no vehicle", "uncertain", "up to", " to "):
        label = label.replace(words, translated(words, language))
    return label.replace(".", ",") if language == "de" else label

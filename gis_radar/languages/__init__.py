"""The words that people read in their language: English in the code, others from a catalogue.

There is one catalogue for the package and the QGIS plugin, `de.json`, by English text and sorted.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

LANGUAGES = ("en", "de")


@cache
def catalogue(language: str) -> dict[str, str]:
    """Return the translations into a language by English text; none for English itself."""
    path = files(__package__) / f"{language}.json"
    if not path.is_file():
        return {}
    words: dict[str, str] = json.loads(path.read_text(encoding="utf-8"))
    return words


def translated(text: str, language: str) -> str:
    """Return a text in a language, in English where there is no translation."""
    return catalogue(language).get(text, text)


def class_label(label: str, language: str) -> str:
    """Return the label of a class of a legend in a language: `2 to 5 %` has words in it."""
    if label in catalogue(language):
        return translated(label, language)
    for words in ("never hit", "no vehicle", "uncertain", "up to", " to "):
        label = label.replace(words, translated(words, language))
    return label.replace(".", ",") if language == "de" else label

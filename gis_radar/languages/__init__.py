"""The words that people read in their language: English in the code, others from a catalogue.

There is one catalogue for the package and the QGIS plugin, `de.json`, by English text and sorted.
Errors, hints and warnings, which the package alone says, have one of their own,
`de_messages.json`: by the English text with a hole `{}` for each value; in the translation `{0}`
is the first of them.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

LANGUAGES = ("en", "de")


def catalogue(language: str) -> dict[str, str]:
    """Return the translations into a language by English text; none for English itself."""
    return _read(f"{language}.json")


def messages(language: str) -> dict[str, str]:
    """Return the translations of errors, hints and warnings by English text with holes."""
    return _read(f"{language}_messages.json")


@cache
def _read(name: str) -> dict[str, str]:
    path = files(__package__) / name
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

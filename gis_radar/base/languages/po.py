"""Read gettext's catalogues as text (PO): they need not be compiled before use.

The QGIS plugin reads its catalogue by this file, too, in a Python that has no gis_radar.
"""

from __future__ import annotations

import json
from pathlib import Path


def read_catalogue(path: Path) -> dict[str, str]:
    """Return the translations in a catalogue by text; singular and plural are separate entries.

    Parameters
    ----------
    path : Path
        A file of entries with a blank line between them, as Babel writes it.
    """
    by_text: dict[str, str] = {}
    for entry in path.read_text(encoding="utf-8").split("\n\n"):
        texts: list[str] = []
        translations: list[str] = []
        current = texts
        for line in entry.splitlines():
            keyword, _, quoted = line.partition(" ")
            if line.startswith('"'):
                current[-1] += json.loads(line)
            elif keyword.startswith("msg"):
                current = texts if keyword.startswith("msgid") else translations
                current.append(json.loads(quoted))
        by_text.update(zip(texts, translations))  # noqa: B905 - read by Python 3.9, too
    by_text.pop("", None)  # the header
    return by_text

"""Click's messages of wrong usage as texts of ours, so that the catalogue can translate them."""

from __future__ import annotations

import re

from gis_radar.base import Text

CLICK_TEXTS = (
    "Missing argument {}.",
    "Missing option {}.",
    "Missing command.",
    "Got unexpected extra argument ({})",
    "Got unexpected extra arguments ({})",
    "Option {} requires an argument.",
    "Option {} does not take a value.",
    "No such command {}.",
    "No such command {}. Did you mean {}?",
    "No such command {}. (Did you mean one of: {}?)",
    "No such option {}.",
    "No such option {}. Did you mean {}?",
    "No such option {}. (Did you mean one of: {}?)",
    "Invalid value for {}: {}",
    "{} is not a valid integer.",
    "{} is not a valid float.",
    "{} is not one of {}.",
)
"""Click's messages, with a hole for each value; a test provokes each."""


def text_of_click(text: str, quoted: str = "") -> Text:
    """Return a message of click as a template with values; an unknown one as it is.

    `quoted` is a text of this package that the message may quote.
    """
    if isinstance(quoted, Text) and text == quoted:
        return quoted
    for template in CLICK_TEXTS:
        if found := re.fullmatch("(.+)".join(map(re.escape, template.split("{}"))), text):
            return Text(template, *(text_of_click(value, quoted) for value in found.groups()))
    return Text(text)

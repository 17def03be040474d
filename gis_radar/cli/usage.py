"""Wrong usage as click reports it: its sentences, which have their German in our catalogue."""

from __future__ import annotations

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
"""What click says, with a hole for each value; a test calls for each."""

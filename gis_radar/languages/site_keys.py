"""Keys of the site file for options: what a message says to a reader who knows the site file."""

from __future__ import annotations

import re

KEYS = {
    "--clock": "clock in [sensor.convert]",
    "--columns": "columns in [sensor.convert]",
    "--crs": "crs in [map]",
    "--cycle": "cycle in [[sensor]]",
    "--guess-crs": "guess in [[sensor]]",
    "--length": "length in [tiles]",
    "--map-crs": "crs in [map]",
    "--max-range": "max_range_m in [sensor.view]",
    "--method": "method in [[sensor]]",
    "--origin": "origin in [map]",
    "--recording": "recordings in [[sensor]]",
    "--road": "road in [scan]",
    "--scan": "files in [scan]",
    "--scan-crs": "crs in [scan]",
    "--sensor": "sensor in [sensor.convert]",
    "--subtype": "subtypes in [map]",
    "--time-unit": "time_unit in [sensor.convert]",
    "--together": "tied in [[sensor]]",
}
_PHRASES = {"set the view's max_range_m or --max-range": "set max_range_m in [sensor.view]"}
_CYCLE = re.compile(r"--cycle (\S+)=(\S+)")
_OPTION = re.compile("|".join(sorted(map(re.escape, KEYS), key=len, reverse=True)))
_COMMAND = re.compile(r"(gis-radar [a-z]+(?: --[a-z-]+)*)")  # a command line to type stays as it is


def keys_for_options(text: str) -> str:
    """Return a text with keys of the site file for options of the command line.

    Examples
    --------
    >>> keys_for_options("not tiled: 2 crosswalk (use --subtype)")
    'not tiled: 2 crosswalk (use subtypes in [map])'
    """
    for phrase, by in _PHRASES.items():
        text = text.replace(phrase, by)
    text = _CYCLE.sub(r'cycle = "\2" in [[sensor]] \1', text)
    parts = _COMMAND.split(text)
    parts[::2] = [_OPTION.sub(lambda found: KEYS[found[0]], each) for each in parts[::2]]
    return "".join(parts)

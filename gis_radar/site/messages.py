"""Messages of a run in the terms of its site file: keys for options, local times for UTC.

The library's messages name options of commands; readers of a run's messages know its site file.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePath
from typing import Any

from gis_radar.base import GisRadarError, Text, localised, zone_of

# Replacements of values, such as options, and of templates of texts.
KEYS = {
    "--accept": "accept = true in [[sensor]]",
    "--clock": "clock in [sensor.convert]",
    "--columns": "columns in [sensor.convert]",
    "--compass": "compass in [[sensor]]",
    "--crs": "crs in [map]",
    "--cycle": "cycle in [[sensor]]",
    "--guess-crs": "guess in [[sensor]]",
    "--length": "length in [tiles]",
    "--map-crs": "crs in [map]",
    "--max-range": "max_range_m in [sensor.view]",
    "--method": "method in [[sensor]]",
    "--origin": "origin in [map]",
    "--road": "road in [scan]",
    "--scan": "files in [scan]",
    "--scan-crs": "crs in [scan]",
    "--sensor": "sensor in [sensor.convert]",
    "--subtype": "subtypes in [map]",
    "--time-unit": "time_unit in [sensor.convert]",
    "--together": "tied in [[sensor]]",
    "--cycle {}={}ms": 'cycle = "{1}ms" in [[sensor]] {0}',
    "the view's max_range_m or {}": "max_range_m in [sensor.view]",
}
_PATH_BEGIN = r"""(?<![^\s'"`(\[,;:=])"""  # so that no folder is cut out of a longer path


def in_site_words(text: str, timezone: str, folder: Path | None = None) -> Text:
    """Return a message with keys of the site file for options, and local times for UTC.

    Files are named relative to the folder of the site, if it is given.

    Examples
    --------
    >>> in_site_words(Text("not tiled: {} (use {})", "2 crosswalk", "--subtype"), "Europe/Berlin")
    'not tiled: 2 crosswalk (use subtypes in [map])'
    >>> in_site_words(Text("no frame from {} on", "2025-06-12T07:30Z"), "Europe/Berlin")
    'no frame from 2025-06-12 09:30 UTC+02:00 on'
    """
    zone = zone_of(timezone)
    inside = re.compile(_PATH_BEGIN + re.escape(f"{folder}{os.sep}"))

    def reworded(value: Any) -> Any:
        if isinstance(value, Text) and value.values:
            return Text(KEYS.get(value.template, value.template), *map(reworded, value.values))
        if not isinstance(value, str | PurePath):
            return value
        shown = KEYS.get(str(value)) or localised(str(value), zone)
        shown = shown if folder is None else inside.sub("", shown)
        return value if shown == value else shown  # unchanged, so that a Text keeps its template

    return Text(reworded(Text(text)))


def error_in_site_words(
    error: GisRadarError, timezone: str, folder: Path | None = None
) -> GisRadarError:
    """Change an error's texts, in place, as :func:`in_site_words` does; return the error."""
    error.message = in_site_words(error.message, timezone, folder)
    error.hint = in_site_words(error.hint, timezone, folder)
    error.args = (error.message, *error.args[1:])
    for part in error.parts:
        error_in_site_words(part, timezone, folder)
    return error

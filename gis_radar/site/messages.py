"""Messages of a run in the words of its site file: keys for options, the site's clock for UTC.

The library speaks of options, as its commands are used alone; a run's reader knows its site file.
"""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any

from gis_radar.base import Clock, GisRadarError, Text, zone_of

# What stands for a value, or for a text by its template.
KEYS = {
    "--accept": "accept = true in [[sensor]]",
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
    "--cycle {}={}ms": 'cycle = "{1}ms" in [[sensor]] {0}',
    "the view's max_range_m or {}": "max_range_m in [sensor.view]",
}
_PATH_BEGIN = r"""(?<![^\s'"`(\[,;:=])"""  # else a folder would be cut from amid another path


def in_site_words(text: str, timezone: str, folder: Path | None = None) -> Text:
    """Return a message with keys of the site file for options, and times of the site for UTC.

    Files are named from the folder of the site on, where it is given.

    Examples
    --------
    >>> in_site_words(Text("not tiled: {} (use {})", "2 crosswalk", "--subtype"), "Europe/Berlin")
    'not tiled: 2 crosswalk (use subtypes in [map])'
    >>> in_site_words(Text("no frame from {} on", "2025-06-12T07:30Z"), "Europe/Berlin")
    'no frame from 2025-06-12 09:30 UTC+02:00 on'
    """
    any_time = datetime(1970, 1, 1, tzinfo=UTC)
    clock = Clock(zone=zone_of(timezone), first=any_time, last=any_time)
    inside = re.compile(_PATH_BEGIN + re.escape(f"{folder}{os.sep}"))

    def told(value: Any) -> Any:
        if isinstance(value, Text) and value.values:
            return Text(KEYS.get(value.template, value.template), *map(told, value.values))
        if not isinstance(value, str | PurePath):
            return value
        shown = KEYS.get(str(value)) or clock.localised(str(value))
        shown = shown if folder is None else inside.sub("", shown)
        return value if shown == value else shown  # a text of one word stays one

    return Text(told(Text(text)))


def error_in_site_words(
    error: GisRadarError, timezone: str, folder: Path | None = None
) -> GisRadarError:
    """Translate an error into the words of the site file, as :func:`in_site_words` does."""
    error.message = in_site_words(error.message, timezone, folder)
    error.hint = in_site_words(error.hint, timezone, folder)
    error.args = (error.message, *error.args[1:])
    for part in error.parts:
        error_in_site_words(part, timezone, folder)
    return error

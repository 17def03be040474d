"""Messages of a run in the words of its site file: keys for options, the site's clock for UTC.

The library speaks of options, as its commands are used alone; a run's reader knows its site file.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime

from gis_radar.errors import GisRadarError
from gis_radar.steps import Clock, zone_of

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


def in_site_words(text: str, timezone: str) -> str:
    """Return a message with keys of the site file for options, and times of the site for UTC.

    Examples
    --------
    >>> in_site_words("not tiled: 2 crosswalk (use --subtype)", "Europe/Berlin")
    'not tiled: 2 crosswalk (use subtypes in [map])'
    >>> in_site_words("no frame from 2025-06-12T07:30Z on", "Europe/Berlin")
    'no frame from 2025-06-12 09:30 UTC+02:00 on'
    """
    for phrase, by in _PHRASES.items():
        text = text.replace(phrase, by)
    text = _CYCLE.sub(r'cycle = "\2" in [[sensor]] \1', text)
    parts = _COMMAND.split(text)
    parts[::2] = [_OPTION.sub(lambda found: KEYS[found[0]], each) for each in parts[::2]]
    text = "".join(parts)
    any_time = datetime(1970, 1, 1, tzinfo=UTC)
    return Clock(zone=zone_of(timezone), first=any_time, last=any_time).localised(text)


def error_in_site_words(error: GisRadarError, timezone: str) -> GisRadarError:
    """Let an error speak as :func:`in_site_words` does."""
    error.message = in_site_words(error.message, timezone)
    error.hint = in_site_words(error.hint, timezone)
    error.args = (error.message, *error.args[1:])
    return error

"""Messages of a run in the words of its site file: keys for options, the site's clock for UTC.

The library speaks of options, as its commands are used alone; a run's reader knows its site file.
"""

from __future__ import annotations

import os
import re
from datetime import UTC, datetime
from pathlib import Path

from gis_radar.errors import GisRadarError
from gis_radar.languages.site_keys import keys_for_options
from gis_radar.steps import Clock, zone_of

_PATH_BEGIN = r"""(?<![^\s'"`(\[,;:=])"""  # else a folder would be cut from amid another path


def in_site_words(text: str, timezone: str, folder: Path | None = None) -> str:
    """Return a message with keys of the site file for options, and times of the site for UTC.

    Files are named from the folder of the site on, where it is given.

    Examples
    --------
    >>> in_site_words("not tiled: 2 crosswalk (use --subtype)", "Europe/Berlin")
    'not tiled: 2 crosswalk (use subtypes in [map])'
    >>> in_site_words("no frame from 2025-06-12T07:30Z on", "Europe/Berlin")
    'no frame from 2025-06-12 09:30 UTC+02:00 on'
    """
    if folder is not None:
        text = re.sub(_PATH_BEGIN + re.escape(f"{folder}{os.sep}"), "", text)
    any_time = datetime(1970, 1, 1, tzinfo=UTC)
    return Clock(zone=zone_of(timezone), first=any_time, last=any_time).localised(
        keys_for_options(text)
    )


def error_in_site_words(
    error: GisRadarError, timezone: str, folder: Path | None = None
) -> GisRadarError:
    """Translate an error into the words of the site file, as :func:`in_site_words` does."""
    error.message = in_site_words(error.message, timezone, folder)
    error.hint = in_site_words(error.hint, timezone, folder)
    error.args = (error.message, *error.args[1:])
    return error

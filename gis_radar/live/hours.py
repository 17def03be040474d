"""Full hours since 1970, UTC: what the live system stores by."""

from __future__ import annotations

from datetime import UTC, datetime

from gis_radar.site.hours import HOUR_STEPS
from gis_radar.steps import STEP_US

HOUR_US = HOUR_STEPS * STEP_US
LIVE_RECORDING = "live"  # in the place of a recording's name, in the manifest of an hour


def hour_name(hour: int) -> str:
    """Return the name of an hour's folder, such as 2026-11-23T07Z."""
    return datetime.fromtimestamp(hour * 3600, tz=UTC).strftime("%Y-%m-%dT%HZ")

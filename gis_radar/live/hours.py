"""Full hours since 1970, UTC: what the live system stores by."""

from __future__ import annotations

from datetime import UTC, datetime

from gis_radar.steps import STEP_US, STEPS_PER_SECOND

HOUR_STEPS = 3600 * STEPS_PER_SECOND
HOUR_US = HOUR_STEPS * STEP_US
_NAME = "%Y-%m-%dT%HZ"
LIVE_RECORDING = "live"  # in the place of a recording's name, in the manifest of an hour


def hour_name(hour: int) -> str:
    """Return the name of an hour's folder, such as 2026-11-23T07Z."""
    return datetime.fromtimestamp(hour * 3600, tz=UTC).strftime(_NAME)


def hour_of(name: str) -> int | None:
    """Return the hour of a folder of that name; None where it is another name."""
    try:
        begin = datetime.strptime(name, _NAME).replace(tzinfo=UTC)
    except ValueError:
        return None
    return round(begin.timestamp()) // 3600

"""Hours of local time, kept as the UTC second in which each begins."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache
from zoneinfo import ZoneInfo

import numpy as np

from gis_radar.arrays import Integers

HOUR_S = 3600
QUARTER_S = 900  # zones differ from UTC by whole quarters of an hour
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def hour_begins(time_us: Integers, zone: ZoneInfo) -> Integers:
    """Return for each time the UTC second in which its hour of local time began.

    Parameters
    ----------
    time_us : (n,) int64 array
        Microseconds since the UNIX epoch.
    zone : ZoneInfo
        Whose hours. Where clocks are set back, the hour that comes twice is two hours.
    """
    quarter, place = np.unique(time_us // (QUARTER_S * 1_000_000), return_inverse=True)
    begin = [_hour_begin(int(number), zone) for number in quarter]
    return np.asarray(np.array(begin, np.int64)[place])


@cache
def _hour_begin(quarter: int, zone: ZoneInfo) -> int:
    second = quarter * QUARTER_S
    local = moment(second).astimezone(zone)
    return second - local.minute * 60 - local.second


def moment(second: int) -> datetime:
    """Return a UNIX second as a UTC time."""
    return _EPOCH + timedelta(seconds=second)
